"""Steps of a rollout as one value, which is planned, divided and computed."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..boundaries.control import Leave, control_step
from ..state.state import State
from ..step.step import Step
from .checkpoints import Checkpoints


@dataclasses.dataclass
class MovingBodies:
    """Free bodies of steps in the fused op, which changes their rows.

    Attributes:
        rows: poses and velocities [B, K, 13] or [B, K, 6] now.
        report: the most iterations and the largest residuals so far [B, 1 + K].
        arguments: those of `torch.ops.torch_mpm.substeps_with_bodies` after the rows, the other tensors first.
    """

    rows: Tensor
    report: Tensor
    arguments: tuple[list[Tensor], tuple[Any, ...]]

    def follow(self, rows: Tensor, report: Tensor) -> None:
        """Take over the results of a call."""
        self.rows, self.report = rows, torch.maximum(self.report, report)


class Steps(NamedTuple):
    """n steps of dt [s], and how they are launched and stored for a backward pass."""

    step: Callable[[State, float | Tensor], State]
    """A `Step`, or any function (state, dt) -> state."""
    n: int
    dt: float | Tensor
    checkpoints: Checkpoints | None = None
    graph: int | None = None
    """Number of steps per CUDA graph, see `rollout`."""
    schedule: str | None = None
    """Forced schedule of the fused op; None for the fastest one."""
    first: int = 0
    """Index of the first step in the rollout."""
    bodies: MovingBodies | None = None
    """Free bodies, which the fused op alone computes."""

    def part(self, n: int, first: int = 0) -> Steps:
        """n of these steps, after the first `first` of them."""
        return self._replace(n=n, first=self.first + first)

    def control(self, state: State) -> contextlib.AbstractContextManager[Leave]:
        """Context of the motion of obstacles in these steps; its function returns the state with their final poses."""
        step: Any = self.step
        return control_step(step, state, self.n, self.dt)

    def call(self, state: State) -> contextlib.AbstractContextManager[Callable[[State], State]]:
        """Context of `ErrorStatus.call`, in which these steps are one call of the step; its function ends the call."""
        step: Any = self.step
        return step._error_status.call(state) if isinstance(step, Step) else contextlib.nullcontext(lambda state: state)
