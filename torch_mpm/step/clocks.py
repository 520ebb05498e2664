"""Start times of the steps of a call."""

from __future__ import annotations

import itertools
from bisect import bisect_left
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..ops.arguments import split_dt

if TYPE_CHECKING:
    from ..state.state import State


def clocks(state: State, dt: float | Tensor, scenes: int) -> tuple[float, Tensor | None, Tensor | None]:
    """Time step [s] as a number, or time steps and times in float64 for each scene [B]."""
    number, scene_dt = split_dt(dt, scenes, state.x)
    time = state.scene_time
    if scene_dt is None and time is None:
        return number, None, None
    each_dt = state.x.new_ones(scenes) if scene_dt is None else scene_dt.contiguous()
    if time is None:
        time = state.x.new_full((1,), float(state.time), dtype=torch.float64)
    return number, each_dt, time.detach().reshape(-1).expand(scenes).contiguous()


def time_after(time: float | Tensor, dt: float | Tensor, n: int = 1) -> float | Tensor:
    """Time n steps later, in float64 and rounded as in single steps."""
    if isinstance(dt, Tensor):
        dt = dt.double()
    elif isinstance(dt, np.generic):  # whose sum with a number may be in float32
        dt = float(dt)
    for _ in range(n):
        time = time + dt
    return time


def time_like(time: float | Tensor, like: Tensor) -> float | Tensor:
    """Time as an argument of user functions: a number, or a tensor with the dtype of `like`."""
    return time.to(like.dtype) if isinstance(time, Tensor) else time


def requires_grad(value: float | Tensor | None) -> bool:
    """Whether a time or time step has a gradient at present."""
    return isinstance(value, Tensor) and value.requires_grad and torch.is_grad_enabled()


class StepTimes(NamedTuple):
    """Start times [s] of n steps."""

    tensor: Tensor
    """Times [n] or, where scenes have separate clocks, [n, B], in float64."""
    numbers: list[float] | None
    """Times as numbers on the host, if all scenes have the same time; otherwise None."""

    @classmethod
    @torch.no_grad()
    def of(cls, state: State, n: int, dt: float | Tensor, scenes: int) -> StepTimes:
        """Accumulated as in single steps."""
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
        """Steps that begin in [start, end), if the times are numbers on the host; otherwise all."""
        if self.numbers is None:
            return slice(0, len(self.tensor))
        return slice(bisect_left(self.numbers, start), bisect_left(self.numbers, end))
