"""Work and precision where motion is slow: a gripper that squeezes rubber, and a block that settles under its weight.

Gripper: two sticky plates close on a square of rubber (side 0.2 m, ρ = 1000 kg/m³, ν = 0.45, plane strain, 16 cells, 4
particles in each) at 1 cm/s each for a second, until it is a tenth shorter. Explicit steps go in one op, at half their
limit. Errors are the RMS of displacements over the RMS displacement: "in time" against explicit steps of half the
length on the same lattice, "in all" against explicit steps on a lattice twice as fine, whose particles are averaged
where the coarse ones are; the latter is mostly the gap of about half a cell at a plate. "faster": time of the explicit
run of the same type over that of the row. Times are those of the processor, on one thread, so that other programs of
the machine count little; the least of two where it is below 5 s. At equal error: the fastest implicit run whose error
in time is at most half the error in all of explicit steps, and the fastest with 1%.

Settling: the same block on a sticky floor, weight switched on at once; until its displacement stays within 1% of the
static equilibrium on the same lattice for a period of its slowest vibration (4 H/c). Implicit steps are as long as
that period. `equilibrium` is one step of 1000 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.implicit import Implicit, equilibrium

from ..common import one_thread

SIDE, DENSITY, NU, SPEED = 0.2, 1000.0, 0.45, 0.01
MODULI = (1e6, 1e7, 1e8, 1e9)
CELLS = 16
STEPS = (5, 10, 20, 50, 100)
"""Numbers of implicit steps in a second."""
StepOf = Callable[..., mpm.Step]


def gripper(E: float, cells: int = CELLS, dtype: torch.dtype = torch.float64, dim: int = 2) -> tuple[mpm.State, StepOf]:
    """A block between two plates that close, and its steps by integrator."""
    half, rest = SIDE / 2, (0.0,) * (dim - 1)
    grid = mpm.Grid(SIDE / cells, (-SIDE,) * dim, (SIDE,) * dim)
    points = mpm.seed.box((-half,) * dim, (half,) * dim, grid, per_cell=2**dim)
    state = mpm.State.at_rest(points, DENSITY, dtype=dtype)
    plates = [
        mpm.Plane((-half, *rest), (1.0, *rest), kind="sticky", velocity=(SPEED, *rest)),
        mpm.Plane((half, *rest), (-1.0, *rest), kind="sticky", velocity=(-SPEED, *rest)),
    ]
    law, gravity = mpm.NeoHookean(E=E, nu=NU), (0.0, -9.8, 0.0)[:dim]
    return state, lambda integrator: mpm.Step(grid, law, gravity, boundaries=plates, integrator=integrator)


def taken(step: mpm.Step, state: mpm.State, n: int, duration: float = 1.0) -> tuple[mpm.State, float]:
    """State after n steps, and the time of the faster of two runs, or of a single long one."""
    least = float("inf")
    with torch.no_grad():
        for _ in range(2):
            start = time.process_time()
            end = mpm.rollout(step, state, n, duration / n)
            least = min(least, time.process_time() - start)
            if least > 5:
                break
    return end, least


def explicit_steps(step: mpm.Step, state: mpm.State, cfl: float = 0.5, duration: float = 1.0) -> int:
    return int(duration / float(step.stable_dt(state, cfl=cfl)[0])) + 1


def displacement(state: mpm.State, end: mpm.State) -> Tensor:
    return (end.x - state.x).double()


def on_coarse(fine: mpm.State, values: Tensor, coarse: mpm.State) -> Tensor:
    """Means of the values of the four fine particles at the position of each coarse one at rest."""
    spacing = SIDE / CELLS / 2

    def number(x: Tensor) -> Tensor:
        i = ((x + SIDE / 2) / spacing).floor().long()
        return i[:, 0] * 10_000 + i[:, 1]

    places, owner = number(coarse.x).sort()
    row = owner[torch.searchsorted(places, number(fine.x))]
    return torch.zeros_like(coarse.x).index_add_(0, row, values) / 4


def relative(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm() / b.norm())


@one_thread()
def squeeze(quick: bool) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for E in MODULI[:1] if quick else MODULI:
        state, step_of = gripper(E)
        explicit = step_of("explicit")
        n = explicit_steps(explicit, state)
        in_time = displacement(state, taken(explicit, state, 2 * n)[0])
        fine, fine_of = gripper(E, 2 * CELLS)
        fine_end, _ = taken(fine_of("explicit"), fine, n if quick else 2 * n)
        in_all = on_coarse(fine, displacement(fine, fine_end), state)
        base: dict[torch.dtype, float] = {}
        cases = [(torch.float64, None, 0.0), *((torch.float64, k, 1e-4) for k in STEPS), (torch.float64, 10, 1e-2),
                 (torch.float32, None, 0.0), (torch.float32, 10, 1e-4)]  # fmt: skip
        for dtype, k, tolerance in cases[:4] if quick else cases:
            start, make = gripper(E, dtype=dtype)
            step = make("explicit" if k is None else Implicit(tolerance))
            end, seconds = taken(step, start, k or n)
            step.check(end)
            base.setdefault(dtype, seconds)
            u = displacement(start, end)
            rows.append({"E": E, "dtype": str(dtype)[6:], "integrator": "explicit" if k is None else "implicit",
                         "tolerance": tolerance or None, "steps": k or n, "error in time": relative(u, in_time),
                         "error in all": relative(u, in_all), "time [s]": seconds,
                         "faster": base[dtype] / seconds})  # fmt: skip
    return rows


def at_equal_error(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The fastest implicit run in float64 whose time error is small compared with that of the lattice, and that with
    1%.
    """
    found = []
    for E in dict.fromkeys(row["E"] for row in rows):
        own = [row for row in rows if row["E"] == E and row["dtype"] == "float64"]
        explicit, implicit = own[0], own[1:]
        equal = [r for r in implicit if r["error in time"] <= 0.5 * explicit["error in all"]]
        one = [r for r in implicit if r["error in time"] <= 0.01]
        row: dict[str, Any] = {"E": E, "error of explicit steps": explicit["error in all"]}
        for name, kept in (("equal error", equal), ("1% in time", one)):
            best = max(kept, key=lambda r: r["faster"], default=None)
            row |= {f"steps, {name}": best and best["steps"], f"faster, {name}": best and best["faster"]}
        found.append(row)
    return found


@one_thread()
def settling(quick: bool) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    grid = mpm.Grid(SIDE / CELLS, (-SIDE, 0.0), (SIDE, 2 * SIDE))
    points = mpm.seed.box((-SIDE / 2, 0.0), (SIDE / 2, SIDE), grid, per_cell=4)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    for E in MODULI[:1] if quick else (1e6, 1e8):
        law = mpm.NeoHookean(E=E, nu=NU)
        period = 4 * SIDE * (DENSITY / E) ** 0.5

        def step_of(integrator: Any, law: mpm.NeoHookean = law) -> mpm.Step:
            return mpm.Step(grid, law, (0.0, -9.8), "sticky", integrator=integrator)

        with torch.no_grad():
            rest = displacement(state, equilibrium(step_of(Implicit(1e-9)), state, 1e3))
            start = time.process_time()
            one = displacement(state, equilibrium(step_of(Implicit(1e-6)), state, 1e3))
            at_once = time.process_time() - start
        steps = explicit_steps(step_of("explicit"), state, duration=period / 8)
        for name, per_look, most in (("explicit", steps, 300 * 8), ("implicit", 1, 100)):
            taken_steps, seconds, last = settled(step_of(name), state, rest, per_look, period, most)
            rows.append({"E": E, "integrator": name, "dt [s]": period / (8 * steps if name == "explicit" else 1),
                         "steps": taken_steps, "last error": last, "time [s]": seconds})  # fmt: skip
        rows.append({"E": E, "integrator": "equilibrium", "dt [s]": 1e3, "steps": 1, "last error": relative(one, rest),
                     "time [s]": at_once})  # fmt: skip
    return rows


def settled(
    step: mpm.Step, state: mpm.State, rest: Tensor, per_look: int, period: float, most: int
) -> tuple[int | None, float, float]:
    """Steps and time until the error stays below 1% for a period, and the error then; None where `most` looks do
    not see it. An implicit look is a period, an explicit one an eighth."""
    looks = 8 if per_look > 1 else 1
    seconds, quiet, end, error = 0.0, 0, state, 1.0
    for k in range(most):
        start = time.process_time()
        with torch.no_grad():
            end = mpm.rollout(step, end, per_look, period / looks / per_look)
        seconds += time.process_time() - start
        error = relative(displacement(state, end), rest)
        quiet = quiet + 1 if error < 0.01 else 0
        if quiet == looks:
            return (k + 1) * per_look, seconds, error
    return None, seconds, error
