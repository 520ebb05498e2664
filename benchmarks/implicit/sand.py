"""Numerical cohesion of sand in implicit steps.

A full energy resists the trial tension that the return map removes only after the solve; the unilateral one has none.

Cohesion: a block of sand is pulled apart at 2 /s in one step. Result: remaining fraction of the rate, 1 without
cohesion.

Clump: a block of 8 × 4 cells of 2.5 cm flies apart at 2 /s along x for a quarter of a second without weight, which
extends it by a half. Results: fraction of that extension, 1 without cohesion; tensile impulse between the halves,
relative to the momentum of each at the start. Explicit steps take half of their limit.

Collapse: a column of 10 × 20 cells of 1 cm (φ = 30°), so stiff that its foot is compressed by 2%, is released on a
rough floor and spreads for 6 √(H/g), by APIC, which damps at each transfer, and by FLIP. Results: run-out (half the
width that holds 98% of the mass, minus the initial half width, relative to the latter) and height of the deposit.
Times are those of the processor, on one thread.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import torch

import torch_mpm as mpm
from torch_mpm.implicit import Implicit

from ..accuracy.runout import DENSITY, GRAVITY, stiffness
from ..catalogue.scenes import short_bar
from ..common import one_thread

ENERGIES = ("full", "unilateral")
CLUMP_DT = (1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 5e-2)
COLLAPSE_DT = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)
INSIDE_DT = 1e-3
"""Least dt of a collapse with the return map inside the solve, which takes long."""
INTEGRATORS = {
    "after the solve": lambda: Implicit(1e-4),
    "inside the solve": lambda: Implicit(1e-4, plasticity="inside"),
}
"""Where the return map acts, and how."""


def cohesion() -> list[dict[str, Any]]:
    rows = []
    for E, dt in itertools.product((1e6, 1e7), (1e-3, 1e-2, 5e-2)):
        grid, state = short_bar(2, density=1600.0)
        C = torch.zeros(len(state), 2, 2, dtype=torch.float64)
        C[:, 0, 0] = 2.0
        r = state.x - state.x.mean(0)
        state = state.replace(v=(C @ r[:, :, None])[:, :, 0], C=C)
        row: dict[str, Any] = {"E": E, "dt [s]": dt, "strain": 2 * dt}
        for energy in ("full", "unilateral"):
            law = mpm.QuarticSand(E=E, nu=0.3, friction_angle=0.6, energy=energy)
            after = mpm.Step(grid, law, integrator=Implicit(1e-8))(state, dt)
            assert after.C is not None
            row[energy] = float(after.C[:, 0, 0].mean()) / 2
        rows.append(row)
    return rows


def pulled(cells: tuple[int, int], dx: float, rate: float) -> tuple[mpm.Grid, mpm.State]:
    """A block that is pulled apart along x, in the middle of a box six times as long."""
    half = torch.tensor(cells, dtype=torch.float64) * dx / 2
    box = [n * dx * 3 for n in cells]
    grid = mpm.Grid(dx, [-b for b in box], box)
    points = mpm.seed.box((-half).tolist(), half.tolist(), grid, per_cell=4)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    C = torch.zeros(len(state), 2, 2, dtype=torch.float64)
    C[:, 0, 0] = rate
    return grid, state.replace(v=(C @ state.x[:, :, None])[:, :, 0], C=C)


def runs(
    grid: mpm.Grid,
    state: mpm.State,
    duration: float,
    lengths: tuple[float, ...],
    stiff: dict[str, Any],
    inside_from: float = 0.0,
    **about: Any,
) -> list[dict[str, Any]]:
    """A row of each energy and dt, with the state at the end as "end"; the return map inside from a given dt on."""
    rows = []
    for energy in ENERGIES:
        law = mpm.QuarticSand(**stiff, friction_angle=torch.pi / 6, energy=energy)
        explicit = mpm.Step(grid, law, **about)
        n = int(duration / float(explicit.stable_dt(state, cfl=0.5)[0])) + 1
        cases: list[tuple[str, Any, int]] = [("explicit", "explicit", n)]
        for (name, make), dt in itertools.product(INTEGRATORS.items(), lengths):
            if name == "inside the solve" and dt < inside_from:
                continue
            cases.append((name, make(), round(duration / dt)))
        for name, integrator, steps in cases:
            start, end, converged = time.process_time(), state, 0
            step = mpm.Step(grid, law, **about, integrator=integrator)
            with torch.no_grad():
                if name == "explicit":
                    end = mpm.rollout(step, end, steps, duration / steps)
                else:
                    for _ in range(steps):
                        end = step(end, duration / steps)
                        converged += int(step.solve_report.converged[0])  # type: ignore[union-attr]
            rows.append({"energy": energy, "return map": name, "dt [s]": duration / steps,
                         "converged": None if name == "explicit" else f"{converged} of {steps}",
                         "time [s]": time.process_time() - start, "end": end})  # fmt: skip
    return rows


@one_thread()
def clump(quick: bool) -> list[dict[str, Any]]:
    grid, state = pulled((8, 4), 0.025, 2.0)
    rows = runs(grid, state, 0.25, CLUMP_DT[3:4] if quick else CLUMP_DT, {"E": 1e7, "nu": 0.3})
    for row in rows:
        row["spread"] = float(row["end"].x[:, 0].std() / state.x[:, 0].std() - 1) / 0.5
        right = state.x[:, 0] > 0
        row["tensile impulse"] = 1 - float(row["end"].v[right, 0].sum() / state.v[right, 0].sum())
    return rows


@one_thread()
def collapse(quick: bool) -> list[dict[str, Any]]:
    dx, half, height = 0.01, 0.05, 0.2
    grid = mpm.Grid(dx, (-0.6, 0.0), (0.6, 0.3))
    points = mpm.seed.box((-half, 0.0), (half, height), grid, per_cell=4)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    mu, lam = stiffness(height, 0.02)
    walls = mpm.Walls(("open", ("sticky", "open")))
    duration = 6 * (height / GRAVITY) ** 0.5
    lengths = COLLAPSE_DT[-1:] if quick else COLLAPSE_DT
    rows = []
    for transfer in ("flip",) if quick else ("apic", "flip"):
        about = {"gravity": (0.0, -GRAVITY), "walls": walls, "transfer": transfer}
        rows += [
            {"transfer": transfer, **row}
            for row in runs(grid, state, duration, lengths, {"mu": mu, "lam": lam}, INSIDE_DT, **about)
        ]
    for row in rows:
        x = row["end"].x
        width = torch.quantile(x[:, 0], 0.99) - torch.quantile(x[:, 0], 0.01)
        row["run-out"] = float(width / 2 - half) / half
        row["height / H"] = float(x[:, 1].max()) / height
    return rows


def without_states(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name != "end"} for row in rows]
