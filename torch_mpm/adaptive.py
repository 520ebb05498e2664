"""Time steps that the stability limit of each scene decides, without the host."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from .boundaries.control import control_step
from .boundaries.motion import PACE
from .cfl import chosen_dt
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
    dt: Tensor
    """What the latest substeps of a scene were as long as, or a little less, so that equal ones end at its time [s],
    float64; to be the `previous` of the next call. Zero without substeps."""


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
    previous: float | Tensor | None = None,
) -> Arrival:
    """Take every scene to a time, in substeps of its own length and number.

    The dt of a scene is `cfl` of the limit of `Step.stable_dt`, or a little less, so that equal substeps end at its
    time. Every so many substeps the limit is computed anew, and a dt that is below this share of it or above half of
    that stays: one that followed the limit would feed energy into particles that oscillate (docs/limitations.md). The
    substeps of a scene depend on its own limit alone, so its result does not depend on the scenes beside it; on grids
    that are not `deterministic`, up to rounding. A scene with no more than `every` substeps left pauses until all
    others have as few, and its last ones follow in one segment without a new choice. All of this is computed where the
    particles are. The host waits when it reads how many substeps are left: at the beginning, after 64 segments at most,
    and before the last ones.

    Args:
        step: what moves the particles; with `every` > 1 in one op per segment where `rollout` can do so.
        state: the particles; its time is a number, or a tensor [B].
        time: the time of their end [s], a number, or a tensor of shape [], [1] or [B]. Scenes that are later already
            stand still, and so do those whose entry is not finite, which do not arrive.
        cfl: share of the limit, positive and finite; see `stable_dt`.
        longest: the longest dt that is wanted [s].
        every: substeps from one choice of dt to the next. With one, dt is chosen before every substep.
        most: substeps of a scene at most.
        checkpoint: as of `rollout`, for each segment.
        previous: dt of the substep before [s], a number, or a tensor [], [1] or [B], where calls follow one another:
            `arrival.dt` of the call before. None, or zero, for none.

    Returns:
        The state, and of each scene whether it has arrived, its substeps, its largest CFL number and its latest dt.

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
    given = _compensated(step, step.prepare(state), cfl, longest)
    unsorted = in_no_order(given, most)
    start = put_in_order(step, given) if unsorted else given
    clocks = Clocks(step, start, time, cfl, longest, most, previous)
    with control_step(step, start, most, PACE, clocks.seconds) as left:
        while (counts := clocks.look()) and counts[-1] > every:
            clocks.advance(min((counts[-1] - 1) // every, MOST_SEGMENTS), every, checkpoint)
        clocks.finish(counts, checkpoint)
        arrival = clocks.arrival()
        arrival = arrival._replace(state=left(arrival.state))
    return arrival._replace(state=put_back(step, arrival.state, start, given)) if unsorted else arrival


def _compensated(step: Step, state: State, cfl: float, longest: float) -> State:
    """With the residual of positions where the first substeps need it; waits for the device, as `Clocks.look` does."""
    if step.compensated is None and state.x_residual is None:
        limit = step.stable_dt(state, cfl)
        longest = min(longest, float(torch.where(limit > 0, limit, math.inf).amin())) if len(limit) else longest
    return step.with_residual(state, longest)


class Clocks:
    """A state whose scenes have times and time steps of their own, float64 [B]: a float32 clock would not arrive.

    Graphs read and write the tensors, so each stays the same.
    """

    def __init__(
        self,
        step: Step,
        state: State,
        time: float | Tensor,
        cfl: float,
        longest: float,
        most: int,
        previous: float | Tensor | None,
    ) -> None:
        self.step, self.state, self.cfl, self.longest, self.most = step, state, cfl, longest, most
        self.end = _per_scene("time", time, step.grid.scenes, state.x)
        self.now = _per_scene("the time of the state", state.time, step.grid.scenes, state.x)
        self.substeps = torch.zeros_like(self.now, dtype=torch.int64)
        self.largest_cfl = torch.zeros_like(self.now)
        self.seconds: float | Tensor = (self.end - self.now).clamp(min=0)
        """That are left at the beginning."""
        if not isinstance(time, Tensor) and not isinstance(state.time, Tensor):
            self.seconds = max(time - state.time, 0.0)
        self._end = time
        self._bound = _per_scene("previous", 0.0 if previous is None else previous, step.grid.scenes, state.x)
        self._dt = torch.zeros_like(self.now)
        self._left = torch.zeros_like(self.substeps)  # substeps until the end, of `most` at most

    @torch.no_grad()
    def look(self) -> list[int]:
        """The different numbers of substeps that scenes have left, in ascending order; waits for the device."""
        self.state = self._at_its_time(self.state)
        self._choose(self.state)
        return [count for count in self._left.unique().tolist() if count > 0]

    def advance(self, segments: int, n: int, checkpoint: int | Checkpoints | None) -> None:
        """Some segments of n substeps each, of the scenes that have more of them left."""
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

    def finish(self, counts: list[int], checkpoint: int | Checkpoints | None) -> None:
        """The last substeps of each scene, which `look` has counted."""
        taken = 0
        for count in counts:
            dt = torch.where(self._left >= count, self._dt, 0.0).to(self.state.x.dtype)
            self.state = rollout(self.step, self.state, count - taken, dt, checkpoint)
            taken = count
        self._take(self._left)

    def _replays(self) -> bool:
        """Whether segments are replays of a CUDA graph."""
        step, state = self.step, self.state
        if not state.x.is_cuda or follows_paths(step) or wants_gradient(step, state):
            return False
        return obstacle_to_substeps(step, state, self._dt.to(state.x.dtype)) is None

    @torch.no_grad()
    def _next(self, state: State, n: int) -> tuple[State, Tensor]:
        """The state at its time, and dt of its next n substeps: zero for scenes that have no more than n left."""
        state = self._at_its_time(state)
        self._choose(state)
        moves = self._left > n
        self._take(torch.where(moves, n, 0))
        return state, torch.where(moves, self._dt, 0.0).to(state.x.dtype)

    @torch.no_grad()
    def _take(self, count: Tensor) -> None:
        """Count so many substeps of each scene."""
        span = self.end - self.now
        arrives = (count > 0) & (count * self._dt >= span * (1 - ROUNDING))
        self.now.copy_(torch.where(arrives, self.end, self.now + count * self._dt))
        self.substeps += count

    @torch.no_grad()
    def arrival(self) -> Arrival:
        state = self._at_its_time(self.state)
        self._limit(state)
        arrived = self.now >= self.end
        if not isinstance(self._end, Tensor) and bool((self.now == self.end).all()):
            state = state.replace(time=float(self._end))
        return Arrival(state, arrived, self.substeps, self.largest_cfl, self._bound)

    def _at_its_time(self, state: State) -> State:
        return state.replace(time=self.now.clone())

    def _limit(self, state: State) -> Tensor:
        """The longest stable dt of each scene, of which the dt before is a share."""
        limit = 1 / self.step.survey(state, judge=False).rate
        self._count_cfl(limit, self.substeps > 0)
        return limit

    def _count_cfl(self, limit: Tensor, moves: Tensor) -> None:
        share = torch.where(moves, torch.nan_to_num(self._dt / limit, nan=0.0), 0.0)
        self.largest_cfl.copy_(torch.maximum(self.largest_cfl, share))

    def _choose(self, state: State) -> None:
        """dt and the substeps until its end of each scene; none for those that have arrived or cannot."""
        limit, span = self._limit(state), self.end - self.now
        longest = (self.cfl * limit).clamp(max=self.longest)
        bound = chosen_dt(longest, self._bound)
        left = torch.ceil(span / bound * (1 - ROUNDING)).clamp(min=1)
        moves = (span > 0) & span.isfinite() & (longest > 0) & (self.substeps < self.most)
        self._bound.copy_(torch.where(moves, bound, self._bound))
        self._dt.copy_(torch.where(moves, span / left, self._dt))
        self._left.copy_(torch.where(moves, torch.minimum(left, self.most - self.substeps), 0.0))
        self._count_cfl(limit, moves)


def _per_scene(name: str, time: float | Tensor, scenes: int, like: Tensor) -> Tensor:
    """A time of each scene in float64 [B], on the device of a tensor."""
    if not isinstance(time, Tensor):
        return like.new_full((scenes,), check_number(name, time, kinds=NUMBER_OR_TENSOR), dtype=torch.float64)
    if time.requires_grad and torch.is_grad_enabled():
        raise ValueError(f"{name} must not require grad: the dt of rollout_to are constants")
    if time.dim() > 1 or time.numel() not in (1, scenes):
        raise ValueError(f"{name} must be a number or have shape [], [1] or [B] = [{scenes}], got {shape_of(time)}")
    if time.device != like.device:
        raise ValueError(f"{name} must be on the device of x, {like.device}, got {time.device}")
    return time.detach().double().reshape(-1).expand(scenes).clone()
