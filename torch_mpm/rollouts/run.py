"""Rollouts: n steps from a state, by the executor of their plan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import check_count, shape_of
from ..ops.arguments import split_dt
from ..state.state import State, check_state
from ..step.step import Step
from .anomaly import begin, detecting, watch
from .budget import within_budget
from .checkpoints import Checkpoints, as_checkpoints, from_python, offloading
from .fused_op import in_calls
from .gradient_norms import GradientNorms
from .graph_replay import replayed
from .graph_segments import graphed_steps
from .heat_at_rest import heated, is_heat
from .hooks import Hook, Parts
from .plan import RolloutPlan, check_plan, in_steps, plan_of_steps
from .reasons import why_not_fused
from .steps import Steps


def rollout(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    checkpoint: int | Checkpoints | None = None,
    *,
    prefix: int = 0,
    truncate: int | None = None,
    hook: Hook | None = None,
    every: int = 1,
    norms: GradientNorms | None = None,
    graph: int | None = None,
    schedule: str | None = None,
    plan: RolloutPlan | None = None,
) -> State:
    """The state n steps later.

    Args:
        step: a `Step`, a `Heat`, or any function (state, dt) -> state.
        state: the initial state.
        n: number of steps.
        dt: time step [s], as `Step` takes it.
        checkpoint: states to store for the backward pass, which recomputes the steps in between. A number: every
            `checkpoint` steps; the memory is that of n/checkpoint states and of checkpoint steps, and is smallest for
            sqrt(n). A `Checkpoints`: by a number of states or a budget of memory, on the device or on the host. None:
            sqrt(n) states for steps in one op; otherwise all steps are stored.
        prefix: number of first steps that are computed without gradients.
        truncate: number of steps through which gradients pass back at most: the graph is cut before the steps
            n - truncate, n - 2 truncate, ... Without a hook this is a prefix of n - truncate steps. None: all steps.
        hook: called as `hook(state, k)` before step k = 0, every, 2 every, ...; it may read the state, add to a loss,
            or return another state with as many particles. The state at each call is stored.
        every: number of steps between two calls of the hook.
        norms: stores the norm of the gradient at states on the way; see `GradientNorms`.
        graph: number of steps per CUDA graph, for steps that the fused op does not support, user functions included;
            a second graph computes their gradients. It pays for networks in a step, where launching the kernels takes
            longer than running them. The state is stored every `graph` steps, and the backward pass recomputes the
            steps in between. The step stores the graphs for the next rollout; `make_graphed_step` describes when they
            are captured again. `step` must be a `Step` or another module. Without effect on the CPU, and where
            `Step.explain` gives a reason against graphs.
        schedule: schedule of the fused op, see `plan_rollout`; None for the fastest one.
        plan: the plan of `plan_rollout` for these steps, in place of `checkpoint`, `graph` and `schedule`. None: the
            rollout makes it.

    A `Step` of compiled laws without user functions computes all steps in one op, or in a few calls of it. With heat it
    does so if the boundaries of the heat are held obstacles of the step, sources, or terms of the free surface with
    constant numbers; laws may expand or melt, or have a `Table` of the temperature among their parameters. A `Heat`
    alone has the same op, as heat of a body at rest, if its obstacles do not move.
    `Step.explain` returns the executor, the schedule and the reasons. The results are those of single steps. On CUDA
    they are bitwise equal, with two exceptions, which round differently, as all steps on a CPU do:

    - float32 without gradients;
    - many unsorted particles (`state.ids` is None): for 64 steps or more they are sorted first, and restored to their
      order at the end. With heat all of 2^18 particles or more are, every 64 steps, for 128 steps or more.

    The status does not count blocks that exist only between two activations.

    The backward pass of the op recomputes the steps from stored states: one every `checkpoint` steps, by default
    sqrt(n) of them, and more where states are small. A stored state of a solid has 2 D + 2 D² numbers per particle (24
    in 3-D, 96 bytes in float32) and its history. While the backward pass processes `checkpoint` steps, it stores about
    2 D + 4 D² numbers per particle (42 in 3-D) for each of them, those of heat, and at most half as much for the grid.
    If all steps fit into `Checkpoints(memory=...)`, they are stored and not recomputed. Second derivatives need single
    steps.

    On CUDA and without gradients, other steps without user functions are replays of a CUDA graph of one step.
    `make_graphed_step` serves steps with user functions, and `estimate_rollout` returns the memory and time of a
    rollout. Under `torch.autograd.detect_anomaly` a NaN gradient is reported with its operation, substep and scene.

    Raises:
        TypeError, ValueError: for a number of steps that is no whole number or out of range, a schedule that does
            not support the steps, a plan for other steps, or an error of `step`.
    """
    if not callable(step):
        raise TypeError(f"step must be a Step or a function (state, dt) -> state, got {shape_of(step)}")
    check_count("n", n)
    if graph is not None:
        check_count("graph", graph, 1)
    steps = Steps(step, n, dt, as_checkpoints(checkpoint), graph, schedule)
    if plan is not None:
        check_plan(plan, checkpoint=checkpoint, graph=graph, schedule=schedule)
        steps = _as_planned(steps, plan)
    check_state(state)
    if truncate is None and hook is None and norms is None and prefix == 0 and every == 1 and every is not True:
        with steps.call(state) as end_call, steps.control(state) as end_motion:
            return end_call(end_motion(computed(steps, state, plan)))
    with steps.call(state) as end_call:
        return end_call(_in_parts(steps, state, Parts(n, prefix, truncate, hook, every, norms), plan))


def _in_parts(steps: Steps, state: State, parts: Parts, plan: RolloutPlan | None) -> State:
    """The state after the steps of a rollout that is divided by hooks, cuts of the gradient or its norms."""
    step, scales = steps.step, (1, 1.0, steps.dt)
    if isinstance(step, Step):
        state, grid = step.prepare(state), step.grid
        split_dt(steps.dt, grid.scenes, state.x)  # Checks dt.
        scales = grid.scenes, grid.dx, steps.dt
    if torch.is_grad_enabled():  # The parts share the budget of memory: all of their first states are stored.
        lengths = parts.lengths_with_gradient()
        fused = steps.checkpoints is not None and isinstance(step, Step)
        fused = fused and why_not_fused(step, state, steps.n, steps.dt) is None
        with_gradient = steps.part(sum(lengths))
        steps = steps._replace(checkpoints=within_budget(with_gradient, state, fused, lengths))

    def advance(state: State, count: int, k: int) -> State:
        return computed(steps.part(count, k), state, plan)

    return parts.run(advance, state, scales, lambda state, count: steps.part(count).control(state))


def _as_planned(steps: Steps, plan: RolloutPlan) -> Steps:
    """Steps with the checkpoints, graphs and schedule that a plan was made for."""
    graph = plan.steps_per_call if plan.executor == "graph" else None
    schedule = plan.schedule if plan.forced else None
    return steps._replace(checkpoints=plan.checkpoints, graph=graph, schedule=schedule)


def computed(steps: Steps, state: State, given: RolloutPlan | None = None) -> State:
    """The state after the steps, by their plan.

    Raises:
        ValueError: for a given plan with another executor than the plan of these steps.
    """
    step, before = steps.step, state
    if isinstance(step, Step):
        state = step.with_residual(state, steps.dt)
    steps, state = in_steps(steps, state)
    plan = plan_of_steps(steps, state)
    if given is not None and given.executor != plan.executor:
        reason = plan.reasons.get(given.executor, "another executor computes them")
        raise ValueError(f"plan must be one for these steps, got the executor {given.executor!r}: {reason}")
    if plan.executor == "fused":
        end = in_calls(steps, state, plan)
        return heated(before, end) if is_heat(step) else end
    if plan.executor == "replay":
        return replayed(steps, state)
    return _from_python(steps, state, plan)


def _from_python(steps: Steps, state: State, plan: RolloutPlan) -> State:
    """The state after steps launched from Python: single steps, or graphs of several."""
    step, n = steps.step, steps.n
    grid = step.grid if isinstance(step, Step) else None
    checkpoints = None if plan.stores_all else plan.checkpoints

    def advance(state: State, count: int, first: int) -> State:
        if plan.executor == "graph":
            return graphed_steps(steps.part(count, first), state, plan.steps_per_call)
        for k in range(first, first + count):
            mark = begin() if detecting() else None
            before, state = state, step(state, steps.dt)
            if mark is not None:
                watch(before, state, mark, steps.first + k, grid)
        return state

    if checkpoints is not None and n > 0 and _compiles_at_next_call(step):
        state, steps, n = advance(state, 1, 0), steps.part(n - 1, 1), n - 1
    if isinstance(step, Step) and checkpoints is not None and n > 0:
        state = step.prepare(state)
    with offloading(checkpoints, state):
        return from_python(advance, state, n, checkpoints, step, plan.steps_per_call)


def _compiles_at_next_call(step: Any) -> bool:
    """Whether a step for `torch.compile` has never been called.

    Its first call is not recomputed: it creates the status of the step, which is an argument of the code compiled for
    later calls, so that a recomputed first call would save other tensors for the backward pass.
    """
    if not isinstance(step, torch.nn.Module):
        return False
    modules = list(step.modules())
    compiled = any(hasattr(m, "_orig_mod") or m._compiled_call_impl is not None for m in modules)
    return compiled and any(isinstance(m, Step) and m.status is None for m in modules)
