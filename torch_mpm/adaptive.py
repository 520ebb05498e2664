"""Time steps that the stability limit of each scene decides, without the host."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from .checkpoints import Checkpoints
from .errors import NUMBER_OR_TENSOR, check_count, check_number, shape_of
from .graphs import CHUNK, replay_all
from .orders import in_no_order, put_back, put_in_order
from .rollouts import follows_paths, in_chunks, obstacle_to_substeps, rollout, wants_gradient
from .state import State
from .step import Step

SEGMENT = 16
"""Substeps between two choices of dt."""
MOST_SEGMENTS = 64
"""Before the host asks again how many substeps are left."""
MOST_SUBSTEPS = 2**16
"""Of a scene in a call: one whose limit shrinks without end must not keep all others."""
LEAST_REPLAYS = 3
"""Segments for which one is recorded."""
ROUNDING = 1e-9
"""Of a number of substeps, that one more is not taken for it."""


class Arrival(NamedTuple):
    """What `rollout_to` returns; figures of each scene [B] on the device of the particles."""

    state: State
    """Its time is a number if all scenes have come to one, else a tensor [B]."""
    arrived: Tensor
    """Whether a scene is at its time, bool. One stays behind whose limit is zero, as that of a particle without mass
    is, or that has taken `most` substeps."""
    substeps: Tensor
    """That a scene has taken, int64."""
    largest_cfl: Tensor
    """Largest share of the stability limit that the dt of a segment was at its beginning or end, float64; above 1 the
    limit has become smaller than dt within a segment."""


def rollout_to(
    step: Step,
    state: State,
    time: float | Tensor,
    *,
    cfl: float = 0.5,
    longest: float = math.inf,
    every: int = SEGMENT,
    most: int = MOST_SUBSTEPS,
    checkpoint: int | Checkpoints | None = None,
) -> Arrival:
    """Take every scene to a time, in substeps of its own length and number.

    Every so many substeps each scene has a new dt: `cfl` of the limit of `Step.stable_dt` in its present state, or a
    little less, so that equal substeps end at its time. Scenes that have arrived stand still, as paused ones do. All
    of this is computed where the particles are. The host waits when it asks how many substeps are left: at the
    beginning, after 64 segments at most, and before the last one.

    Args:
        step: what moves the particles; with `every` > 1 in one op per segment where `rollout` can do so.
        state: the particles; its time is a number, or a tensor [B].
        time: the time of their end [s], a number, or a tensor of shape [], [1] or [B]. Scenes that are later already
            stand still, and so do those whose entry is not finite, which do not arrive.
        cfl: share of the limit, positive and finite; see `stable_dt`.
        longest: the longest dt that is wanted [s].
        every: substeps from one choice of dt to the next. With one, dt is chosen for every substep.
        most: substeps of a scene at most.
        checkpoint: as of `rollout`, for each segment.

    Returns:
        The state, and of each scene whether it has arrived, its substeps and its largest CFL number.

    Differentiable as `rollout` with these dt, which are constants for autograd.

    Raises:
        TypeError, ValueError: for a wrong argument, or what `rollout` raises.
    """
    if not isinstance(step, Step):
        raise TypeError(f"step must be a Step, whose stability limit is known, got {shape_of(step)}")
    check_number("cfl", cfl, "positive and finite", lambda v: 0 < v < math.inf)
    check_number("longest", longest, "positive", lambda v: v > 0)
    check_count("every", every, 1)
    check_count("most", most, 1)
    given = step.prepare(state)
    unsorted = in_no_order(given, most)
    start = put_in_order(step, given) if unsorted else given
    clocks = Clocks(step, start, time, cfl, longest, most)
    while (left := clocks.look()) > 0:
        segments = min(max(left // every, 1), MOST_SEGMENTS)
        clocks.advance(segments, min(left, every), checkpoint)
    arrival = clocks.arrival()
    return arrival._replace(state=put_back(step, arrival.state, start, given)) if unsorted else arrival


class Clocks:
    """A state whose scenes have times and time steps of their own, float64 [B]: a float32 clock would not arrive.

    Graphs read and write the tensors, so each stays the same.
    """

    def __init__(self, step: Step, state: State, time: float | Tensor, cfl: float, longest: float, most: int) -> None:
        self.step, self.state, self.cfl, self.longest, self.most = step, state, cfl, longest, most
        self.end = _per_scene("time", time, step.grid.scenes, state.x)
        self.now = _per_scene("the time of the state", state.time, step.grid.scenes, state.x)
        self.substeps = torch.zeros_like(self.now, dtype=torch.int64)
        self.largest_cfl = torch.zeros_like(self.now)
        self._end = time
        self._dt = torch.zeros_like(self.now)

    @torch.no_grad()
    def look(self) -> int:
        """The most substeps that a scene may still take; waits for the device."""
        self.state = self._at_its_time(self.state)
        left = torch.minimum(self._left(self._limit(self.state)), self.most - self.substeps)
        return int(left.amax()) if len(left) else 0

    def advance(self, segments: int, n: int, checkpoint: int | Checkpoints | None) -> None:
        """Some segments of n substeps each."""
        if segments < LEAST_REPLAYS + 1 or not self._replays():
            for _ in range(segments):
                state, dt = self._next(self.state, n)
                self.state = rollout(self.step, state, n, dt, checkpoint)
            return

        def segment(state: State) -> State:
            state, dt = self._next(state, n)
            return in_chunks(self.step, state, n, dt)

        # The first one makes what steps keep.
        self.state = replay_all(self.step, segment, segment(self.state), segments - 1, max(CHUNK // n, 1))

    def _replays(self) -> bool:
        """Whether segments are replays of a CUDA graph."""
        step, state = self.step, self.state
        if not state.x.is_cuda or follows_paths(step) or wants_gradient(step, state):
            return False
        return obstacle_to_substeps(step, state, self._dt.to(state.x.dtype)) is None

    @torch.no_grad()
    def _next(self, state: State, n: int) -> tuple[State, Tensor]:
        """The state at its time, and dt of its next n substeps: zero for scenes that have arrived."""
        state = self._at_its_time(state)
        limit = self._limit(state)
        left = self._left(limit)
        moves = left > 0
        self._dt.copy_(torch.where(moves, (self.end - self.now) / left.clamp(min=n), 0.0))
        self.now.copy_(torch.where(moves & (left <= n), self.end, self.now + n * self._dt))
        self.substeps += n * moves
        self._count_cfl(limit)
        return state, self._dt.to(state.x.dtype, copy=True)

    @torch.no_grad()
    def arrival(self) -> Arrival:
        state = self._at_its_time(self.state)
        self._limit(state)
        arrived = self.now >= self.end
        if not isinstance(self._end, Tensor) and bool((self.now == self.end).all()):
            state = state.replace(time=float(self._end))
        return Arrival(state, arrived, self.substeps, self.largest_cfl)

    def _at_its_time(self, state: State) -> State:
        return state.replace(time=self.now.to(state.x.dtype, copy=True))

    def _limit(self, state: State) -> Tensor:
        """The longest stable dt of each scene, which the dt before was a share of."""
        limit = 1 / self.step.survey(state, judge=False).rate
        self._count_cfl(limit)
        return limit

    def _count_cfl(self, limit: Tensor) -> None:
        share = torch.nan_to_num(self._dt / limit, nan=0.0)
        self.largest_cfl.copy_(torch.maximum(self.largest_cfl, share))

    def _left(self, limit: Tensor) -> Tensor:
        """Substeps until the end of each scene, in float64; zero for those that have arrived or cannot."""
        dt, span = (self.cfl * limit).clamp(max=self.longest), self.end - self.now
        left = torch.ceil(span / dt * (1 - ROUNDING)).clamp(min=1)
        return torch.where((span > 0) & span.isfinite() & (dt > 0) & (self.substeps < self.most), left, 0.0)


def _per_scene(name: str, time: float | Tensor, scenes: int, like: Tensor) -> Tensor:
    """A time of each scene in float64 [B], on the device of a tensor."""
    if not isinstance(time, Tensor):
        return like.new_full((scenes,), check_number(name, time, kinds=NUMBER_OR_TENSOR), dtype=torch.float64)
    if time.dim() > 1 or time.numel() not in (1, scenes):
        raise ValueError(f"{name} must be a number or have shape [], [1] or [B] = [{scenes}], got {shape_of(time)}")
    if time.device != like.device:
        raise ValueError(f"{name} must be on the device of x, {like.device}, got {time.device}")
    return time.detach().double().reshape(-1).expand(scenes).clone()
