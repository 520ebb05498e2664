"""Time steps chosen on the device from the stability limit of each scene."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..boundaries.control import control_step
from ..boundaries.motion import PACE
from ..errors import NUMBER_OR_TENSOR, check_count, check_number, shape_of
from ..ops.segment_clock import ALL_LEFT, SegmentClock, segment_clock
from ..state.state import State
from ..step.step import Step
from .checkpoints import Checkpoints
from .facts import facts_of, follows_paths
from .fused_op import in_calls
from .graph_replay import CHUNK, replay_all
from .plan import RolloutPlan, check_plan, plan_call, plan_of_steps
from .run import rollout
from .sorting import STEPS_IN_ORDER, STEPS_WITH_HEAT, restore_order, sort_particles
from .steps import Steps

SEGMENT = 24
"""Substeps between two choices of dt. On an H200 a segment of 512 thousand particles takes as long as six substeps more
than it has: its first and its last substep have an activation, and the limit of all particles is computed."""
MOST_SEGMENTS = 64
"""Segments before the host queries the number of remaining substeps."""
MOST_SUBSTEPS = 2**16
"""Substeps of a scene in a call: a scene whose limit shrinks without bound must not delay the others."""
LEAST_REPLAYS = 3
"""Number of segments from which the capture of a graph pays."""


class RolloutToResult(NamedTuple):
    """Result of `rollout_to`; values per scene [B] on the device of the particles."""

    state: State
    """Final state. Its time is a number if all scenes have the same time, otherwise a tensor [B]."""
    arrived: Tensor
    """Whether a scene reached its time, bool. A scene does not reach it if its limit is zero, such as that of a
    particle without mass, or after `most` substeps.
    """
    substeps: Tensor
    """Number of substeps of a scene, int64."""
    largest_cfl: Tensor
    """Largest ratio of dt to the stability limit at the beginning or end of a segment, float64. A value above 1 means
    that the limit fell below dt within a segment.
    """
    dt: Tensor
    """Length of the latest substeps of a scene [s], or slightly less, so that equal substeps end at its time, float64.
    Pass it as `previous` to the next call. Zero without substeps.
    """


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
    schedule: str | None = None,
    plan: RolloutPlan | None = None,
) -> RolloutToResult:
    """Advance every scene to a given time, in substeps of its own length and number.

    The dt of a scene is `cfl` times the limit of `Step.stable_dt`, or slightly less, so that equal substeps end at its
    time. The limit is recomputed every `every` substeps. A previous dt between half of this share of the limit and the
    whole is kept: a dt that followed the limit would feed energy into oscillating particles (docs/limitations.md).

    The substeps of a scene depend on its own limit only, so its result does not depend on other scenes; on grids that
    are not `deterministic`, up to rounding. A scene with at most `every` remaining substeps pauses until all others
    have as few; the last substeps of all scenes follow in one segment without a new choice.

    All of this is computed on the device of the particles. The host waits when it reads the number of remaining
    substeps: at the beginning, after at most 64 segments, and before the last ones. Particles that `rollout` would sort
    are sorted as often, between segments, and restored to their order at the end; with gradients once.

    Args:
        step: the step; with `every` > 1 in one op per segment where `rollout` can do so.
        state: the particles; its time is a number, or a tensor [B].
        time: final time [s], a number, or a tensor of shape [], [1] or [B]. Scenes that are already later are not
            advanced. Scenes with an entry that is not finite are not advanced and do not arrive.
        cfl: share of the limit, positive and finite; see `stable_dt`.
        longest: upper bound of dt [s].
        every: substeps between two choices of dt. With 1, dt is chosen before every substep.
        most: maximum number of substeps of a scene.
        checkpoint: as in `rollout`, for each segment.
        previous: dt of the previous substep [s], a number, or a tensor [], [1] or [B], for consecutive calls:
            `arrival.dt` of the previous call. None, or zero, for none.
        schedule: schedule of the fused op, as in `rollout`, for each segment.
        plan: the plan of `plan_rollout` for `every` steps with a tensor dt [B], in place of `checkpoint` and
            `schedule`.

    Returns:
        The state, and for each scene whether it has arrived, its number of substeps, its largest CFL number and its
        latest dt.

    Differentiable as `rollout` with these dt, which are constants for autograd.

    Raises:
        TypeError, ValueError: for a wrong argument, or as `rollout`.
    """
    if not isinstance(step, Step):
        raise TypeError(f"step must be a Step, whose stability limit is known, got {shape_of(step)}")
    check_number("cfl", cfl, "positive and finite", lambda v: 0 < v < math.inf)
    check_number("longest", longest, "positive", lambda v: v > 0)
    check_count("every", every, 1)
    check_count("most", most, 1)
    if plan is not None:
        check_plan(plan, checkpoint=checkpoint, schedule=schedule)
    options = {"checkpoint": checkpoint, "schedule": schedule} if plan is None else {"plan": plan}
    given = _compensated(step, step.prepare(state), cfl, longest)
    facts = facts_of(Steps(step, 1, 1.0), given)
    order = plan_call(None, facts._replace(steps=most)).order
    start = sort_particles(step, given) if order > 0 else given
    lasts = None if order != 1 or facts.gradients else STEPS_IN_ORDER if step.heat is None else STEPS_WITH_HEAT
    clocks = Clocks(step, start, time, cfl, longest, most, previous, lasts)
    with (
        step._error_status.call(state) as end_call,
        control_step(step, start, most, PACE, clocks.seconds) as end_motion,
    ):
        while (counts := clocks.remaining()) and counts[-1] > every:
            clocks.advance(min((counts[-1] - 1) // every, MOST_SEGMENTS), every, options)
        clocks.finish(counts, options)
        arrival = clocks.arrival()
        end = end_motion(arrival.state)
        return arrival._replace(state=end_call(restore_order(step, end, clocks.start, given) if order > 0 else end))


def _compensated(step: Step, state: State, cfl: float, longest: float) -> State:
    """State with the residual of positions where the first substeps need it; waits for the device, as
    `Clocks.remaining` does.
    """
    if step.compensated is None and state.x_residual is None:
        limit = step.stable_dt(state, cfl)
        longest = min(longest, float(torch.where(limit > 0, limit, math.inf).amin())) if len(limit) else longest
    return step.with_residual(state, longest)


class Clocks:
    """State whose scenes have times and time steps of their own, in float64: a float32 clock would not reach its end.

    Graphs read and write the table of the clocks, so its address does not change. Particles are sorted again after
    `lasts` substeps; None for never. `start` is the state after the latest sort.
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
        lasts: int | None = None,
    ) -> None:
        self.step, self.state, self.start = step, state, state
        self._lasts, self._since = lasts, 0  # Substeps since the latest sort.
        self._limits = cfl, longest, most
        end = _per_scene("time", time, step.grid.scenes, state.x)
        now = _per_scene("the time of the state", state.time, step.grid.scenes, state.x)
        latest = _per_scene("previous", 0.0 if previous is None else previous, step.grid.scenes, state.x)
        self.seconds: float | Tensor = (end - now).clamp(min=0)
        """Time to compute at the beginning [s]: a number, or [B] float64."""
        if not isinstance(time, Tensor) and not isinstance(state.time, Tensor):
            self.seconds = max(time - state.time, 0.0)
        self._end = time
        zero = torch.zeros_like(now)
        self._table = torch.stack([now, end, latest, zero, zero, zero, zero, zero], 1)
        self._clock = SegmentClock(*self._table.unbind(1))

    @torch.no_grad()
    def remaining(self) -> list[int]:
        """Distinct numbers of remaining substeps of the scenes, in ascending order; waits for the device."""
        self.state, _ = self._begin_segment(self.state, 0)
        return [int(count) for count in self._clock.left.unique().tolist() if count > 0]

    def advance(self, segments: int, n: int, options: dict[str, Any]) -> None:
        """Segments of n substeps each, for scenes with more than n remaining substeps; options of `rollout`."""
        while segments > 0:
            count = segments
            if self._lasts is not None:
                if self._since > 0 and self._since + n > self._lasts:
                    self.state = self.start = sort_particles(self.step, self.state)
                    self._since = 0
                count = min(count, max((self._lasts - self._since) // n, 1))
            self._advance_in_order(count, n, options)
            segments, self._since = segments - count, self._since + count * n

    def _advance_in_order(self, segments: int, n: int, options: dict[str, Any]) -> None:
        """`advance` without a sort."""
        plan = self._plan_of_replays(n, options) if segments > LEAST_REPLAYS else None
        if plan is None:
            for _ in range(segments):
                state, dt = self._begin_segment(self.state, n)
                self.state = rollout(self.step, state, n, dt, **options)
            return

        def segment(state: State) -> State:
            state, dt = self._begin_segment(state, n)
            return in_calls(Steps(self.step, n, dt), state, plan)

        # The first one allocates the status of steps.
        self.state = replay_all(self.step, segment, segment(self.state), segments - 1, max(CHUNK // n, 1))

    def finish(self, counts: list[int], options: dict[str, Any]) -> None:
        """Last substeps of each scene, as counted by `remaining`; options of `rollout`."""
        computed, clock = 0, self._clock
        for count in counts:
            dt = torch.where(clock.left >= count, clock.step, 0.0).to(self.state.x.dtype)
            self.state = rollout(self.step, self.state, count - computed, dt, **options)
            computed = count
        self._update(None, ALL_LEFT)

    def _plan_of_replays(self, n: int, options: dict[str, Any]) -> RolloutPlan | None:
        """The plan of a segment that is replayed as a CUDA graph; None if it cannot be captured."""
        step, state = self.step, self.state
        if not state.x.is_cuda or follows_paths(step):
            return None
        given: RolloutPlan | None = options.get("plan")
        schedule = options.get("schedule") if given is None else given.schedule if given.forced else None
        plan = plan_of_steps(Steps(step, n, self._clock.step.to(state.x.dtype), schedule=schedule), state)
        if plan.executor != "fused" or plan.facts is None or plan.facts.gradients:
            return None
        return plan.of_sorted()  # The particles are sorted, or sorting does not pay.

    @torch.no_grad()
    def _begin_segment(self, state: State, n: int) -> tuple[State, Tensor]:
        """State at its time, and dt of its next n substeps: zero for scenes with at most n remaining."""
        state = self._at_its_time(state)
        self._update(self._rate(state), n)
        return state, self._clock.segment_step.to(state.x.dtype, copy=True)

    @torch.no_grad()
    def arrival(self) -> RolloutToResult:
        """The result, once no scene has substeps left."""
        clock = self._clock
        state = self._at_its_time(self.state)
        self._update(self._rate(state), 0, choose=False)
        if not isinstance(self._end, Tensor) and bool((clock.now == clock.end).all()):
            state = state.replace(time=float(self._end))
        return RolloutToResult(
            state, clock.now >= clock.end, clock.substeps.long(), clock.largest_cfl.clone(), clock.latest.clone()
        )

    def _at_its_time(self, state: State) -> State:
        return state.replace(time=self._clock.now.clone())

    def _rate(self, state: State) -> Tensor:
        """1/dt of the stability limit of each scene [1/s]."""
        return self.step.stability_report(state, with_energy=False).rate

    def _update(self, rate: Tensor | None, n: int, choose: bool = True) -> None:
        self._table.copy_(segment_clock(self._table, rate, *self._limits, choose, n))


def _per_scene(name: str, time: float | Tensor, scenes: int, like: Tensor) -> Tensor:
    """Time of each scene in float64 [B], on the device of a tensor."""
    if not isinstance(time, Tensor):
        return like.new_full((scenes,), check_number(name, time, kinds=NUMBER_OR_TENSOR), dtype=torch.float64)
    if time.requires_grad and torch.is_grad_enabled():
        raise ValueError(f"{name} must not require grad: the dt of rollout_to are constants")
    if time.dim() > 1 or time.numel() not in (1, scenes):
        raise ValueError(f"{name} must be a number or have shape [], [1] or [B] = [{scenes}], got {shape_of(time)}")
    if time.device != like.device:
        raise ValueError(f"{name} must be on the device of x, {like.device}, got {time.device}")
    return time.detach().double().reshape(-1).expand(scenes).clone()
