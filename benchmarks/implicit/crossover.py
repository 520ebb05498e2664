"""Costs of explicit and implicit steps of slow motion by the size of the body, for `Step.explain`.

The gripper of the quasi-static study in 2-D, and a cube in its place in 3-D, with E = 1e8 Pa and plates of 1 cm/s, in
float32, on CPUs on one thread; P particles. Implicit steps are those in which a plate moves by 5% of a cell. Least
squares of relative errors: an explicit step takes a + b P, an implicit one A + B P; iterations of conjugate gradients
grow little with the size. "faster": time of explicit steps for the same motion over that of implicit ones; "says": the
result of `torch_mpm.implicit.compare`.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

import torch_mpm as mpm
from torch_mpm.implicit.comparison import MOVED, compare

from ..common import one_thread
from .quasistatic import SPEED, StepOf, gripper

CASES = {
    "cpu": {2: (8, 16, 32, 64, 96), 3: (6, 8, 12, 16, 24)},
    "cuda": {2: (16, 64, 256, 1024), 3: (12, 24, 48, 96)},
}
E = 1e8


def seconds_of(step: mpm.Step, state: mpm.State, n: int, dt: float) -> tuple[float, mpm.State]:
    """Time of each of n steps, the smaller of two runs."""
    cuda = state.x.is_cuda
    clock = time.perf_counter if cuda else time.process_time
    times = []
    for _ in range(2):
        start = clock()
        end = mpm.rollout(step, state, n, dt)
        if cuda:
            torch.cuda.synchronize()
        times.append((clock() - start) / n)
    return min(times), end


@one_thread()
def crossover(device: str, quick: bool) -> list[dict[str, Any]]:
    rows = []
    for dim, sizes in CASES[device].items():
        for cells in sizes[:2] if quick else sizes:
            made: tuple[mpm.State, StepOf] = gripper(E, cells, torch.float32, dim)
            state, step_of = made
            state = state.to(device)
            explicit, implicit = step_of("explicit"), step_of("implicit")
            limit = float(explicit.stable_dt(state, cfl=0.5)[0])
            length = MOVED * explicit.grid.dx / SPEED
            with torch.no_grad():
                count = max(20, min(1000, 2_000_000 // len(state)))
                of_explicit, _ = seconds_of(explicit, state, count, limit)
                of_implicit, end = seconds_of(implicit, state, 3, length)
            report = implicit.solve_report
            assert report is not None and bool(report.converged.all() & end.x.isfinite().all())
            rows.append({"dim": dim, "cells": cells, "particles": len(state), "explicit [us]": 1e6 * of_explicit,
                         "implicit [ms]": 1e3 * of_implicit, "Newton": int(report.iterations[0]),
                         "conjugate gradients": int(report.cg_iterations[0]), "dt / limit": length / limit,
                         "faster": of_explicit / limit * length / of_implicit,
                         "says": compare(explicit, state, SPEED).faster})  # fmt: skip
    return rows


def fitted(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The constants, and the largest factor between the fit and a measured time."""
    found = []
    for dim in (2, 3):
        own = [row for row in rows if row["dim"] == dim]
        P = np.array([row["particles"] for row in own], dtype=float)
        explicit = np.array([row["explicit [us]"] for row in own]) * 1e-6
        implicit = np.array([row["implicit [ms]"] for row in own]) * 1e-3
        (a, b), off = _least_squares([P**0, P], explicit)
        (A, B), off_too = _least_squares([P**0, P], implicit)
        found.append({"dim": dim, "a [us]": 1e6 * a, "b [ns]": 1e9 * b, "A [ms]": 1e3 * A, "B [us]": 1e6 * B,
                      "off, explicit": off, "off, implicit": off_too})  # fmt: skip
    return found


def _least_squares(columns: list[Any], values: Any) -> tuple[list[float], float]:
    """Non-negative coefficients, and the largest factor between the fit and a value."""
    from scipy.optimize import nnls

    matrix = np.stack(columns, 1)
    coefficients, _ = nnls(matrix / values[:, None], np.ones_like(values))
    ratio = matrix @ coefficients / values
    return coefficients.tolist(), float(max(ratio.max(), 1 / ratio.min()))
