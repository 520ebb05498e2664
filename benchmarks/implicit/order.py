"""Order in dt against fine explicit steps, and in dx against analytic solutions.

In dt: the bar of the stability study starts to vibrate in its first mode (E = 1e5 Pa, FLIP), for 0.02 s; RMS error of
positions over the RMS displacement, against 2000 explicit steps.

In dx: static equilibrium with ν = 0 of a column under its weight, u(y) = −ρ g/E (H y − y²/2), which stands on a sticky
wall or on a mirror, relative RMS error of the displacements; and of a cantilever ten times as long as high, in plane
strain, the relative error of the sag at its end, w = q L⁴/(8 E I) + q L²/(2 κ G A) after Timoshenko, whose theory
itself is good to some 0.1% for such a beam.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch

import torch_mpm as mpm
from torch_mpm.implicit import Implicit, equilibrium

from ..common import one_thread, order_of
from .stability import bar

KERNELS = ("quadratic", "cubic")


def in_time(quick: bool) -> list[dict[str, Any]]:
    grid, state, law, _ = bar(1e5)
    wave = 0.2 * torch.sin(torch.pi * (state.x[:, 0] - 0.5))
    state = state.replace(v=torch.stack([wave, 0 * wave], 1))
    duration, counts = 0.02, (4, 8) if quick else (4, 8, 16, 32, 64, 128)
    with torch.no_grad():
        exact = mpm.rollout(mpm.Step(grid, law, transfer="flip"), state, 2000, duration / 2000).x
        scale = (exact - state.x).norm()
        errors = []
        for n in counts:
            step = mpm.Step(grid, law, transfer="flip", integrator=Implicit(1e-8))
            errors.append(float((mpm.rollout(step, state, n, duration / n).x - exact).norm() / scale))
    lengths = [duration / n for n in counts]
    return [{"dt [s]": dt, "error": error, "order": order}
            for dt, error, order in zip(lengths, errors, order_of(lengths, errors), strict=True)]  # fmt: skip


def column(cells: int, kernel: str, wall: str = "sticky") -> float:
    dx = 1.0 / cells
    grid = mpm.Grid(dx, (0.0, 0.0), (8 * dx, 1.0 + 8 * dx), kernel=kernel)
    points = mpm.seed.box((3 * dx, 0.0), (5 * dx, 1.0), grid, per_cell=4)
    state = mpm.State.at_rest(points, density=1000.0, dtype=torch.float64)
    walls = mpm.Walls(("open", (wall, "open")))
    step = mpm.Step(grid, mpm.Hencky(E=1e9, nu=0.0), (0.0, -1.0), walls, integrator=Implicit(1e-9))
    u = (equilibrium(step, state, 1e2).x - state.x)[:, 1]
    y = state.x[:, 1]
    exact = -1e-6 * (y - y.square() / 2)
    return float((u - exact).norm() / exact.norm())


def beam(cells: int, kernel: str) -> float:
    """Relative error of the sag of a cantilever of a height in cells, clamped by a plane."""
    h, E, g = 0.1, 1e7, 0.05
    dx = h / cells
    grid = mpm.Grid(dx, (-0.2, -0.4), (1.1 + 2 * dx, 0.4), kernel=kernel)
    points = mpm.seed.box((-4 * dx, -h / 2), (1.0, h / 2), grid, per_cell=4)
    state = mpm.State.at_rest(points, density=1000.0, dtype=torch.float64)
    clamp = mpm.Plane((0.0, 0.0), (1.0, 0.0), kind="sticky")
    integrator = Implicit(1e-7, max_cg_iterations=10_000)
    step = mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.0), (0.0, -g), boundaries=[clamp], integrator=integrator)
    sag = float((state.x - equilibrium(step, state, 1e3).x)[:, 1].max())
    q = 1000.0 * g * h
    return abs(sag / (q / (8 * E * h**3 / 12) + q / (2 * 5 / 6 * E / 2 * h)) - 1)


@one_thread()
def in_space(quick: bool) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    bodies: tuple[tuple[str, Callable[[int, str], float], int], ...] = (
        ("column", column, 64),
        ("column on a mirror", functools.partial(column, wall="mirror"), 64),
        ("beam", beam, 16),
    )
    for body, measure, most in bodies:
        sizes = [4, 8] if quick else [n for n in (2, 4, 8, 16, 32, 64) if n <= most]
        for kernel in KERNELS:
            with torch.no_grad():
                errors = [measure(n, kernel) for n in sizes]
            orders = order_of([1 / n for n in sizes], errors)
            rows += [{"body": body, "kernel": kernel, "cells": n, "error": error, "order": order}
                     for n, error, order in zip(sizes, errors, orders, strict=True)]  # fmt: skip
    return rows
