"""When the steps of a call begin."""

from __future__ import annotations

import itertools
from bisect import bisect_left
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from .ops.arguments import split_dt

if TYPE_CHECKING:
    from .state import State


def clocks(state: State, dt: float | Tensor, scenes: int) -> tuple[float, Tensor | None, Tensor | None]:
    """The time step [s] as a number, or times that and a time in float64 for each scene [B]."""
    number, scene_dt = split_dt(dt, scenes, state.x)
    if scene_dt is None and not isinstance(state.time, Tensor):
        return number, None, None
    each_dt = state.x.new_ones(scenes) if scene_dt is None else scene_dt.contiguous()
    time = state.time
    if not isinstance(time, Tensor):
        time = state.x.new_full((1,), time, dtype=torch.float64)
    return number, each_dt, time.detach().reshape(-1).expand(scenes).contiguous()


def time_after(time: float | Tensor, dt: float | Tensor, n: int = 1) -> float | Tensor:
    """The time n steps later, in float64 and rounded as single steps do."""
    dt = dt.double() if isinstance(dt, Tensor) else dt
    for _ in range(n):
        time = time + dt
    return time


def time_like(time: float | Tensor, like: Tensor) -> float | Tensor:
    """A time as functions of the user's get it: a number, or a tensor with the dtype of `like`."""
    return time.to(like.dtype) if isinstance(time, Tensor) else time


def requires_grad(value: float | Tensor) -> bool:
    """Whether a time or time step has a gradient now."""
    return isinstance(value, Tensor) and value.requires_grad and torch.is_grad_enabled()


class StepTimes(NamedTuple):
    """The times [s] at which n steps begin."""

    tensor: Tensor
    """[n] or, where scenes have clocks of their own, [n, B], in float64."""
    numbers: list[float] | None
    """The same where all scenes have one time, which the host knows."""

    @classmethod
    @torch.no_grad()
    def of(cls, state: State, n: int, dt: float | Tensor, scenes: int) -> StepTimes:
        """Added up as single steps do."""
        number, scene_dt, scene_time = clocks(state, dt, scenes)
        if scene_dt is None or scene_time is None:
            count = torch.arange(n, dtype=torch.float64, device=state.x.device)
            numbers = itertools.accumulate(itertools.repeat(number, n - 1), initial=float(state.time))
            return cls(float(state.time) + count * number, list(numbers))
        times = [scene_time]
        for _ in range(n - 1):
            times.append(times[-1] + number * scene_dt.double())
        return cls(torch.stack(times), None)

    def within(self, start: float, end: float) -> slice:
        """The steps that begin in [start, end), where the host knows; else all."""
        if self.numbers is None:
            return slice(0, len(self.tensor))
        return slice(bisect_left(self.numbers, start), bisect_left(self.numbers, end))
