"""Where the solve of implicit steps converges.

A bar of 8 × 4 cells in 2-D, float64, first compressed to 80%, stretched to five times its length, or spinning by a
radian per step; three steps of dt times the explicit limit of the bar at rest. Newton's and all conjugate gradients
iterations of the worst step. "no" did not converge in 30 Newton iterations; every result was finite.
"""

from __future__ import annotations

import itertools
from typing import Any

import torch

import torch_mpm as mpm

from ..common import one_thread

MODULI, RATIOS = (1e3, 1e6, 1e10), (0.0, 0.3, 0.499)
MULTIPLES = (1.0, 10.0, 100.0, 1e4)
STARTS = ("compressed", "stretched", "spinning")


def bar(E: float, nu: float = 0.3, dx: float = 0.125) -> tuple[mpm.Grid, mpm.State, mpm.NeoHookean, float]:
    """8 × 4 cells in the middle of a box, and its explicit limit [s]."""
    grid = mpm.Grid(dx, (-4.0, -4.0), (5.0, 5.0))
    points = mpm.seed.box((0.0, 0.25), (1.0, 0.75), grid, per_cell=4)
    state = mpm.State.at_rest(points, density=1000.0, dtype=torch.float64)
    law = mpm.NeoHookean(E=E, nu=nu)
    return grid, state, law, float(mpm.Step(grid, law).stable_dt(state, cfl=1.0)[0])


def turning(state: mpm.State, rate: float) -> mpm.State:
    C = torch.zeros(len(state), 2, 2, dtype=torch.float64)
    C[:, 0, 1], C[:, 1, 0] = -rate, rate
    r = state.x - state.x.mean(0)
    return state.replace(v=(C @ r[:, :, None])[:, :, 0], C=C)


def started(state: mpm.State, start: str, dt: float) -> mpm.State:
    if start == "spinning":
        return turning(state, 1.0 / dt)
    share = {"compressed": 0.8, "stretched": 5.0}[start]
    F = torch.eye(2, dtype=torch.float64).repeat(len(state), 1, 1)
    F[:, 0, 0] = share
    x = state.x.clone()
    x[:, 0] *= share
    return state.replace(x=x, F=F)


@one_thread()
def stability(quick: bool) -> list[dict[str, Any]]:
    rows = []
    choices = itertools.product(MODULI[1:2] if quick else MODULI, RATIOS[1:2] if quick else RATIOS, STARTS)
    for E, nu, start in choices:
        row: dict[str, Any] = {"E": E, "nu": nu, "start": start}
        for multiple in MULTIPLES[1:3] if quick else MULTIPLES:
            grid, state, law, limit = bar(E, nu)
            step = mpm.Step(grid, law, integrator="implicit")
            state = started(state, start, multiple * limit)
            worst, converged = (0, 0), True
            for _ in range(3):
                state = step(state, multiple * limit)
                report = step.solve_report
                assert report is not None and bool(state.x.isfinite().all() & state.v.isfinite().all())
                converged = converged and bool(report.converged.all())
                worst = max(worst, (int(report.iterations[0]), int(report.cg_iterations[0])))
            row[f"{multiple:g}"] = f"{worst[0]}, {worst[1]}" if converged else "no"
        rows.append(row)
    return rows
