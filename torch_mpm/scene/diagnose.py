"""Diagnosis of a failure: repetition of the steps since the last good state, one at a time, with a check of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import SimulationError
from ..state.state import State
from ..step.step import Step


@dataclass(frozen=True)
class Failure:
    """First failed particle: after which step, in which scene, and how."""

    step: int
    time: float
    scene: str
    particle: int
    quantity: str
    advice: str
    good: State

    def __str__(self) -> str:
        where = f"{self.scene}, " if self.scene else ""
        when = f"step {self.step} (t = {self.time:.6g} s)"
        return f"{where}{when}, particle {self.particle}: {self.quantity}.\n{self.advice}"


class SceneFailure(SimulationError):
    """Error of a run that had to stop; ``failure`` names the first failure, or is None where the state shows none."""

    def __init__(self, message: str, failure: Failure | None = None) -> None:
        super().__init__(message)
        self.failure = failure


@torch.no_grad()
def wrong(step: Step, state: State, origin: Sequence[float] | None = None) -> tuple[int, str] | None:
    """Row of the first particle that is not finite, outside the grid or inverted, and a description; in coordinates to
    which those of the state are relative by an origin.
    """
    grid = step.grid
    lower, upper = (torch.tensor(a, dtype=state.x.dtype, device=state.x.device) for a in (grid.lower, grid.upper))
    finite_v = state.v.isfinite().all(1)
    finite_x = state.x.isfinite().all(1)
    outside = ((state.x < lower - grid.dx) | (state.x > upper + grid.dx)).any(1) & finite_x
    meaningless = step.law.invalid(step.prepare(state))
    if not bool((~finite_v | ~finite_x | outside | meaningless).any()):
        return None
    checks: list[tuple[Tensor, str]] = [
        (~finite_v, "velocity"), (~finite_x, "position"), (outside, "position"), (meaningless, "deformation"),
    ]  # fmt: skip
    for bad, name in checks:
        rows = bad.nonzero()
        if len(rows):
            return int(rows[0]), _described(step, state, int(rows[0]), name, origin)
    return None


def _described(step: Step, state: State, row: int, name: str, origin: Sequence[float] | None) -> str:
    value = {"velocity": state.v, "position": state.x}.get(name)
    if value is not None:
        numbers = [f"{v:.4g}" for v in value[row].tolist()]
        if name == "position" and origin is not None:
            numbers = [f"{v + zero:.10g}" for v, zero in zip(value[row].tolist(), origin, strict=True)]
        if not bool(value[row].isfinite().all()):
            return f"its {name} is not finite: [{', '.join(numbers)}]"
        return f"it left the domain, at [{', '.join(numbers)}] m"
    if state.F is not None and "F" in step.law.state_fields:
        volume, what = float(torch.linalg.det(state.F[row].double())), "its deformation gradient is inverted: det F"
        if state.J is not None and "J" in step.law.state_fields and volume == 1:
            volume, what = float(state.J[row]), "its volume ratio is not positive: J"
    else:
        volume, what = (
            float(state.J[row]) if state.J is not None else float("nan"),
            "its volume ratio is not positive: J",
        )
    return f"{what} = {volume:.4g}" if volume <= 0 else f"its deformation is beyond the law: volume ratio {volume:.4g}"


@torch.no_grad()
def replay(
    step: Step,
    state: State,
    dt: float,
    steps: int,
    first_step: int,
    scenes: Sequence[str],
    origin: Sequence[float] | None = None,
) -> Failure | None:
    """Compute ``steps`` steps from a good state and report the first failed particle in the form of `wrong`."""
    for k in range(steps):
        good, limit = state, float(step.stable_dt(state, 1.0).min())
        step.reset()
        try:
            state = step(state, dt)
        except SimulationError:
            break
        found = wrong(step, state, origin)
        if found is not None:
            row, quantity = found
            scene = scenes[int(state.scene[row])] if state.scene is not None else ""
            particle = int(state.ids[row]) if state.ids is not None else row
            time = float(good.time) + dt
            return Failure(first_step + k + 1, time, scene, particle, quantity, _advice(quantity, dt, limit), good)
    return None


def _advice(quantity: str, dt: float, limit: float) -> str:
    if dt > limit:
        return (
            f"Likely cause: the time step {dt:.3g} s is above the stability limit {limit:.3g} s; "
            f"use dt = {0.5 * limit:.2g}, or remove dt and set cfl = 0.5."
        )
    if "left the domain" in quantity:
        return (
            "Likely cause: an open wall, or an emitter or obstacle that pushes outwards; "
            "enlarge the domain or close its walls."
        )
    return (
        f"The time step {dt:.3g} s was below the stability limit {limit:.3g} s. Likely cause: an impact that deforms "
        f"the material too fast; use dt = {0.25 * dt:.2g} (cfl 4 times smaller), or more particles per cell."
    )
