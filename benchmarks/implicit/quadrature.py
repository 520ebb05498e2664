"""An experiment: elastic energy summed over parts of cells instead of particles.

The solve of an implicit step sums the energy over particles, so that each product of the Hessian costs a pass over
them. "cells" and "quarters" sum it over one or 2 × 2 parts of each cell instead, at their middles: each with the volume
of its particles, and the rotation-free stretch that gives the mean of their Kirchhoff stresses (as in MPM Lite, arXiv
2602.07853, here with Hencky's law, whose inverse is linear). Particles, masses and nodes stay as they are. 2-D.

Beam: sag of a cantilever of 8 cells' height with ν = 0 in one static step, relative error after Timoshenko. Gripper:
that of the quasi-static study with E = 1e7 Pa in 20 steps; difference of displacements from the same steps with sums
over particles; error of the mean stress across the plates against sums over particles with 64 cells; and largest |F|.
"CG": iterations of conjugate gradients; times: of the processor in all solves, averages included, on one thread.
"""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import ops
from torch_mpm.implicit.bounds import node_bounds
from torch_mpm.implicit.newton import Minimum, Options, minimise
from torch_mpm.implicit.system import ImplicitSystem

from ..common import one_thread

PARTS = {"particles": None, "quarters": 2, "cells": 1}
PER_CELL = (4, 9, 16, 36)


def lame(E: float, nu: float) -> tuple[float, float]:
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def averaged(state: mpm.State, law: mpm.Hencky, width: float) -> mpm.State:
    """One point for the particles of each square of this width: their volume, and the stretch of their mean stress."""
    places = (state.x / width).floor()
    places, owner = places.unique(dim=0, return_inverse=True)

    def sums(values: Tensor) -> Tensor:
        return values.new_zeros(len(places), *values.shape[1:]).index_add_(0, owner, values)

    volume = sums(state.volume)
    stress = sums(state.volume[:, None, None] * law.stress(state)) / volume[:, None, None]
    values, frames = torch.linalg.eigh(stress)
    mu, lam = lame(float(law.E), float(law.nu))  # type: ignore[arg-type]
    strain = (values - lam / (2 * mu + 2 * lam) * values.sum(1, keepdim=True)) / (2 * mu)
    stretch = frames @ torch.diag_embed(strain.exp()) @ frames.mT
    x = (places + 0.5) * width
    return mpm.State(x=x, v=torch.zeros_like(x), mass=sums(state.mass), volume=volume, F=stretch)


def matched(have: mpm.Blocks, want: mpm.Blocks) -> Tensor:
    """The row in `have` of each node of `want`, −1 where there is none."""

    def number(blocks: mpm.Blocks) -> Tensor:
        i = (blocks.node_positions(torch.float64) / blocks.grid.dx).round().long()
        return torch.where((blocks.node_scene() >= 0), (i[:, 0] + 5000) * 10_000 + i[:, 1] + 5000, -1)

    there, rows = number(have).sort()
    wanted = number(want)
    at = torch.searchsorted(there, wanted).clamp_max(len(there) - 1)
    return torch.where((there[at] == wanted) & (wanted >= 0), rows[at], -1)


def stepped(
    step: mpm.Step, state: mpm.State, dt: float, parts: int | None, options: Options
) -> tuple[mpm.State, Minimum, float]:
    """An implicit step with the energy of `parts` along each axis of a cell, None for particles; and its solve."""
    grid, state = step.grid, step.prepare(state)
    blocks = grid.activate(state.x)
    nodes = ops.p2g(blocks, state.x, state.mass, state.v, state.C)
    start, before = ops.grid_update(blocks, nodes, step.gravity_like(state.x), dt), ops.grid_update(blocks, nodes)
    clock = time.process_time()
    if parts is None:
        points, own, row = state, blocks, torch.arange(blocks.node_count)
    else:
        points = averaged(state, step.law, grid.dx / parts)  # type: ignore[arg-type]
        own = grid.activate(points.x)
        row = matched(blocks, own)
    there = (row >= 0)[:, None]
    mass, v, still = (torch.where(there, t[row], 0) for t in (nodes[:, :1], start, before))
    system = ImplicitSystem(own, step.law, points, mass[:, 0].contiguous(), v, dt, step.stress_form, still)
    bounds = node_bounds(own, step.walls, step.boundaries.entries, v, state.time)
    minimum = minimise(system, bounds, options)
    seconds = time.process_time() - clock
    everywhere = node_bounds(blocks, step.walls, step.boundaries.entries, start, state.time)
    velocity = start.clone() if everywhere is None else everywhere.clamped(start)  # of nodes that no point reaches
    velocity[row[row >= 0]] = minimum.v[row >= 0]
    x, v, C, F, _ = ops.g2p_advance(blocks, state.x, velocity, dt, F=state.F, J=None, affine=True, stress_form="mls")
    return state.replace(x=x, v=v, C=C, F=F, time=state.time + dt), minimum, seconds


def beam(per_cell: int, parts: int | None) -> dict[str, Any]:
    h, E, g, cells = 0.1, 1e7, 0.05, 8
    dx = h / cells
    grid = mpm.Grid(dx, (-0.2, -0.4), (1.1, 0.4))
    state = mpm.State.at_rest(mpm.seed.box((-4 * dx, -h / 2), (1.0, h / 2), grid, per_cell=per_cell),
                              density=1000.0, dtype=torch.float64)  # fmt: skip
    clamp = mpm.Plane((0.0, 0.0), (1.0, 0.0), kind="sticky")
    step = mpm.Step(grid, mpm.Hencky(E=E, nu=0.0), (0.0, -g), boundaries=[clamp])
    end, minimum, seconds = stepped(step, state, 1e3, parts, Options(1e-7, 30, 10_000))
    q = 1000.0 * g * h
    sag = float((state.x - end.x)[:, 1].max()) / (q / (8 * E * h**3 / 12) + q / (2 * 5 / 6 * E / 2 * h))
    return {"beam, error": abs(sag - 1), "CG, beam": int(minimum.cg_iterations),
            "time, beam [s]": seconds}  # fmt: skip


def gripper(
    per_cell: int, parts: int | None, exact: Tensor | None, fine: float = 1.0, cells: int = 16
) -> tuple[dict[str, Any], Tensor, float]:
    side, n, speed = 0.2, 20, 0.01
    half = side / 2
    grid = mpm.Grid(side / cells, (-side, -side), (side, side))
    points = mpm.seed.box((-half, -half), (half, half), grid, per_cell=per_cell)
    first = state = mpm.State.at_rest(points, 1000.0, dtype=torch.float64)
    plates = [mpm.Plane((s * half, 0.0), (-s, 0.0), kind="sticky", velocity=(-s * speed, 0.0)) for s in (-1.0, 1.0)]
    step = mpm.Step(grid, mpm.Hencky(E=1e7, nu=0.45), boundaries=plates)
    iterations, seconds, converged = 0, 0.0, True
    for _ in range(n):
        state, minimum, time_of_solve = stepped(step, state, 1.0 / n, parts, Options(1e-6, 30, 2000))
        iterations += int(minimum.cg_iterations)
        seconds += time_of_solve
        converged = converged and bool(minimum.converged)
    u = state.x - first.x
    error = 0.0 if exact is None else float((u - exact).norm() / exact.norm())
    assert state.F is not None
    pressure = float((state.volume * step.law.stress(state)[:, 0, 0]).sum() / state.volume.sum())
    return {"gripper, difference": error, "error of stress": pressure / fine - 1,
            "largest |F|": float(state.F.norm(dim=(1, 2)).max()), "all converged": converged,
            "CG, gripper": iterations, "time, gripper [s]": seconds}, u, pressure  # fmt: skip


@one_thread()
def quadrature(quick: bool) -> list[dict[str, Any]]:
    rows = []
    with torch.no_grad():
        _, _, fine = gripper(4, None, None, cells=16 if quick else 64)
    for per_cell in PER_CELL[:1] if quick else PER_CELL:
        exact = None
        for name, parts in PARTS.items():
            with torch.no_grad():
                of_gripper, u, _ = gripper(per_cell, parts, exact, fine)
                exact = u if exact is None else exact
                rows.append({"per cell": per_cell, "sum over": name, **beam(per_cell, parts), **of_gripper})
    return rows
