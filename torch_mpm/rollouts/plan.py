"""Plans of rollouts: executor and schedule, chosen once before the first step, as a value."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from ..errors import check_count, shape_of
from ..ops.arguments import check_choice, split_dt
from ..state.state import State, check_state
from ..step.step import Step
from .budget import EVERYTHING, steps_of_a_call, with_parts, within_budget
from .checkpoints import Checkpoints, as_checkpoints
from .facts import Facts, facts_of
from .heat_at_rest import is_heat, state_at_rest, step_at_rest, why_not_at_rest
from .reasons import why_not_fused, why_not_graphs, why_not_replay
from .steps import Steps

Executor = Literal["fused", "replay", "graph", "loop"]
SCHEDULES = ("per_step", "fused_g2p2g", "persistent", "block_per_scene", "sorted_cpu")
"""Schedules of the fused op, in the order of csrc/rollout/plan.h."""
_WORDS = {
    "fused": "all steps in one op",
    "replay": "from a CUDA graph of one step",
    "graph": "from CUDA graphs",
    "loop": "step by step",
}


class CallPlan(NamedTuple):
    """The plan of one call of the fused op."""

    schedule: str
    max_blocks: int | None
    """Least number of blocks of its pool; None for those of the grid."""
    steps: int
    """Largest number of steps of the call."""
    order: int
    """Order of the particles: 0 as given; 1 sorted before the call and restored after it; 2 sorted by the schedule
    itself."""
    reasons: tuple[tuple[str, str], ...]
    """Why each other schedule was not chosen."""


@functools.lru_cache(maxsize=1024)
def plan_call(schedule: str | None, facts: Facts) -> CallPlan:
    """The plan of the next call of the fused op.

    Raises:
        RuntimeError: for a schedule that does not support the call.
    """
    number = -1 if schedule is None else SCHEDULES.index(schedule)
    chosen, blocks, steps, order, reasons = torch.ops.torch_mpm.plan_substeps(number, *facts)
    reasons_by_name = tuple(tuple(line.split(": ", 1)) for line in reasons.splitlines())
    return CallPlan(SCHEDULES[chosen], None if blocks < 0 else blocks, steps, order, reasons_by_name)


@dataclasses.dataclass(frozen=True)
class RolloutPlan:
    """Executor and schedule of a rollout, and the reasons against the others; `str` returns both in words.

    Attributes:
        executor: "fused" for calls of one op; "replay" for replays of a CUDA graph of one step; "graph" for CUDA graphs
            of some steps with their gradients (`rollout(graph=)`); "loop" for steps from Python.
        schedule: of the first call of the fused op, see docs/schedules; None for other executors.
        steps_per_call: steps of a call of the op, or of a graph, at most.
        max_blocks: least number of blocks of the pool of the first call; None for those of the grid.
        sorts: whether particles are sorted before the steps, and restored to their order after them.
        checkpoints: which states are stored for the backward pass; None for those of the fused op itself, or for all.
            Those by a budget of memory, or by a number of states, have the length of their parts and the number of
            states.
        reasons: why each other executor and schedule was not chosen, by name.
        forced: whether the schedule was given. Otherwise each call chooses in the same way.
        facts: facts of the first call; None for other executors.
    """

    executor: Executor
    schedule: str | None
    steps_per_call: int
    max_blocks: int | None
    sorts: bool
    checkpoints: Checkpoints | None
    reasons: dict[str, str]
    forced: bool = False
    facts: Facts | None = dataclasses.field(default=None, repr=False, compare=False)

    @property
    def stores_all(self) -> bool:
        """Whether all that the backward pass needs is stored, and no step is recomputed."""
        return self.checkpoints is EVERYTHING

    def call(self, n: int, max_blocks: int | None) -> CallPlan:
        """The plan of a call with n steps left, from a pool of `max_blocks`."""
        facts, blocks = self.facts, -1 if max_blocks is None else max_blocks
        assert facts is not None
        if facts.steps != n:
            facts = facts._replace(steps=n)
        if facts.cuda and facts.max_blocks != blocks:
            facts = facts._replace(max_blocks=blocks)
        return plan_call(self.schedule if self.forced else None, facts)

    def of_sorted(self) -> RolloutPlan:
        """The plan for particles that were sorted."""
        assert self.facts is not None
        return dataclasses.replace(self, sorts=False, facts=self.facts._replace(sorted=True))

    def headline(self) -> str:
        """Executor and schedule in words."""
        words = _WORDS[self.executor]
        if self.executor == "fused":
            assert self.facts is not None
            words = "all steps between two stored states in one op" if self.facts.gradients else words
            return f"{words} (executor fused, schedule {self.schedule})"
        if self.executor == "graph":
            words += f" of {self.steps_per_call} steps"
        return f"{words}, because {self.reasons['fused']} (executor {self.executor})"

    def __str__(self) -> str:
        others = [f"not {name}: {reason}" for name, reason in self.reasons.items()]
        return "\n".join([self.headline(), *others])


def check_plan(plan: Any, **others: Any) -> None:
    """Check the plan of a caller, and that the arguments which it replaces are None."""
    if any(value is not None for value in others.values()):
        *first, last = others
        raise ValueError(f"{', '.join(first)} and {last} must be None with a plan, which has them")
    if not isinstance(plan, RolloutPlan):
        raise TypeError(f"plan must be a RolloutPlan or None, got {shape_of(plan)}")


def plan_rollout(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    *,
    checkpoint: int | Checkpoints | None = None,
    graph: int | None = None,
    schedule: str | None = None,
) -> RolloutPlan:
    """Plan of `rollout` with these arguments.

    Nothing is computed or changed, and the host does not wait for the device. Exceptions, with a budget of memory: one
    step from Python is computed and dropped to measure its memory, and the active blocks of a grid without a pool are
    counted.

    Args:
        step, state, n, dt, checkpoint, graph: as `rollout`.
        schedule: the schedule of the fused op: "per_step", "fused_g2p2g", "persistent", "block_per_scene" or
            "sorted_cpu" (docs/schedules). None: the fastest one.

    Raises:
        TypeError, ValueError: for a wrong argument, and for a schedule that does not support the steps, with the
            reason.
    """
    if not callable(step):
        raise TypeError(f"step must be a Step or a function (state, dt) -> state, got {shape_of(step)}")
    check_count("n", n)
    if graph is not None:
        check_count("graph", graph, 1)
    checkpoints = as_checkpoints(checkpoint)
    check_state(state)
    if isinstance(step, Step):
        split_dt(dt, step.grid.scenes, state.x)
    return plan_of_steps(Steps(step, n, dt, checkpoints, graph, schedule), state)


def in_steps(steps: Steps, state: State) -> tuple[Steps, State]:
    """A `Heat` alone as a `Step` of a body at rest, with its state, if the fused op supports it; others as they are."""
    heat = steps.step
    if not is_heat(heat) or why_not_at_rest(heat) is not None:
        return steps, state
    step = step_at_rest(heat)
    if why_not_fused(step, state, steps.n, steps.dt) is not None:
        return steps, state
    return steps._replace(step=step), state_at_rest(state)


def plan_of_steps(steps: Steps, state: State) -> RolloutPlan:
    """`plan_rollout` for arguments that were checked."""
    if steps.schedule is not None:
        check_choice("schedule", steps.schedule, SCHEDULES)
    steps, state = in_steps(steps, state)
    against_fused = why_not_fused(steps.step, state, steps.n, steps.dt)
    checkpoints = None if steps.checkpoints is None else _checkpoints_that_fit(steps, state, against_fused is None)
    if against_fused is None:
        return _fused(steps, state, checkpoints)
    if steps.schedule is not None:
        raise ValueError(
            f"schedule must be None for steps that the fused op does not support, got {steps.schedule!r}: "
            f"{against_fused}"
        )
    reasons = {"fused": against_fused}
    against_replay = why_not_replay(steps, state)
    if against_replay is None:
        reasons |= {"graph": "replays of one step suffice without user functions", "loop": "a graph is faster"}
        return RolloutPlan("replay", None, 1, None, False, checkpoints, reasons)
    reasons["replay"] = against_replay
    against_graph = why_not_graphs(steps, state)
    if against_graph is None and steps.graph is not None:
        reasons["loop"] = "graphs are faster"
        return RolloutPlan("graph", None, max(min(steps.graph, steps.n), 1), None, False, checkpoints, reasons)
    reasons["graph"] = against_graph or "rollout(graph=...) launches some steps as a graph"
    return RolloutPlan("loop", None, 1, None, False, checkpoints, reasons)


def _checkpoints_that_fit(steps: Steps, state: State, fused: bool) -> Checkpoints | None:
    """Checkpoints without a budget of memory; `EVERYTHING` where all steps fit, None where nothing is stored."""
    if not torch.is_grad_enabled():
        return None
    return within_budget(steps, state, fused)


_INSTEAD = {name: "the op computes all steps" for name in ("replay", "graph", "loop")}


def _fused(steps: Steps, state: State, checkpoints: Checkpoints | None) -> RolloutPlan:
    """The plan for the fused op."""
    facts = facts_of(steps, state, checkpoints is EVERYTHING)
    plan = _planned(steps.schedule, facts)
    if checkpoints is None and not facts.gradients:
        return plan
    step, steps_per_call = steps.step, plan.steps_per_call
    assert isinstance(step, Step)
    if facts.gradients and checkpoints is not EVERYTHING:
        checkpoints = None if checkpoints is None else with_parts(checkpoints, step, state, steps.n)
        every = None if checkpoints is None else checkpoints.every
        steps_per_call = min(steps_per_call, every or steps_of_a_call(step, state, steps.n))
    return dataclasses.replace(plan, steps_per_call=steps_per_call, checkpoints=checkpoints)


@functools.lru_cache(maxsize=1024)
def _planned(schedule: str | None, facts: Facts) -> RolloutPlan:
    """The plan for facts, without gradients."""
    try:
        call = plan_call(schedule, facts)
    except RuntimeError as error:
        _, name, reason = str(error).partition("\n")[0].partition("schedule must")  # After the place in C++.
        if not name:
            raise
        raise ValueError(name + reason) from None
    reasons = {**_INSTEAD, **dict(call.reasons)}
    sorts, forced = call.order == 1, schedule is not None
    return RolloutPlan("fused", call.schedule, call.steps, call.max_blocks, sorts, None, reasons, forced, facts)
