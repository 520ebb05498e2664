"""Steps with conditions that change with the time, and with positions between two bounds, as in other simulators."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..grid.grid import Grid
from ..laws import Material
from ..rollouts import rollout
from ..state.state import State
from ..step.particle_operations import Operations, Timed
from ..step.step import Step


class Clipped(Timed):
    """Moves positions between two bounds [m], numbers."""

    def __init__(self, lower: float, upper: float) -> None:
        super().__init__()
        self.lower, self.upper = lower, upper

    def forward(self, state: State, dt: float | Tensor) -> State:
        return state.replace(x=state.x.clamp(self.lower, self.upper))


class ActingStep:
    """A step whose boundaries and operations on particles change with the time."""

    def __init__(self, step: Step) -> None:
        self.step = step
        self._acting: tuple[list[Any], list[Any]] = ([], [])

    def with_conditions(
        self, nodes: list[Any], operations: list[Any], transfer: str = "apic", flip: float = 0.0
    ) -> Step:
        """The step with boundaries, operations and a transfer."""
        step = self.step
        if (step.transfer, step.flip) != (transfer, flip):
            step.transfer, step.flip = transfer, flip
        if nodes != self._acting[0]:
            step.boundaries = nodes  # type: ignore[assignment]
        if operations != self._acting[1]:
            step.on_particles = Operations(operations) if operations else None
        self._acting = list(nodes), list(operations)
        return step


class ClippedRollout:
    """Rollouts whose positions may be clamped after each step.

    Several steps with bounds are computed without clamping, on a smaller grid that reports any particle of any step
    beyond the bounds, and again with an operation that clamps if there was one; from then on they are clamped.

    Args:
        law: the material.
        gravity: see `Step`.
        grid: the lattice.
        bounds: of positions [m], multiples of dx; None without.
        stress_form: see `Step`.
        make: class of the steps.
    """

    def __init__(
        self,
        law: Material,
        gravity: Any,
        grid: Grid,
        bounds: tuple[float, float] | None = None,
        stress_form: str = "gradient",
        make: type[Step] = Step,
    ) -> None:
        self._make = make
        self._law, self._gravity, self._bounds, self._stress_form = law, gravity, bounds, stress_form
        self.whole = self._acting(grid)
        self._clip = None if bounds is None else Clipped(*bounds)
        self._narrow: ActingStep | None = None
        self._leaves = bounds is None or bounds[1] - bounds[0] < 3 * grid.dx

    def _acting(self, grid: Grid) -> ActingStep:
        return ActingStep(self._make(grid, self._law, gravity=self._gravity, stress_form=self._stress_form))

    def run(
        self, state: State, n: int, dt: float, nodes: list[Any], operations: list[Any], transfer: str = "apic",
        flip: float = 0.0, checkpoint: Any = None,
    ) -> State:  # fmt: skip
        """State n steps later; see `torch_mpm.rollout`."""
        arguments = nodes, operations, transfer, flip
        if self._bounds is None or self._clip is None or n == 0:
            return rollout(self.whole.with_conditions(*arguments), state, n, dt, checkpoint)
        if n > 1 and not self._leaves:
            step = self._within(self._bounds).with_conditions(*arguments)
            after = rollout(step, state, n, dt, checkpoint)
            with torch.no_grad():
                left = bool(step.failures().failed.any())
            if not left:
                return after.replace(x=after.x.clamp(*self._bounds))
            self._leaves = True
        state = rollout(self.whole.with_conditions(*arguments), state, 1, dt)
        if n > 1:
            step = self.whole.with_conditions(nodes, [self._clip, *operations], transfer, flip)
            state = rollout(step, state, n - 1, dt, checkpoint)
        return state.replace(x=state.x.clamp(*self._bounds))

    def _within(self, bounds: tuple[float, float]) -> ActingStep:
        """The step on a grid that reports particles beyond the bounds: those more than a cell outside its domain."""
        if self._narrow is None:
            grid = self.whole.step.grid
            low, high = bounds[0] + grid.dx, bounds[1] - grid.dx
            self._narrow = self._acting(Grid(grid.dx, (low,) * 3, (high,) * 3, grid.scenes))
        return self._narrow
