"""Calls of the fused op: many steps of a `Step` of compiled parts."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..boundaries.damping import split_damping
from ..errors import check_count, check_flag, shape_of
from ..grid.topology import Status
from ..laws.calls import LawCalls, law_calls
from ..ops.autograd import dispatch
from ..ops.contact import obstacle_arguments
from ..ops.grid_update import per_scene, wall_arguments
from ..ops.substeps import ARGUMENTS
from ..ops.transfer import STRESS_FORMS
from ..signals import interruptible
from ..state.state import State, check_state
from ..step.clocks import StepTimes, clocks, requires_grad, time_after
from ..step.pause import paused
from ..step.step import Step
from .checkpoints import binomial, offloading
from .facts import differentiates, follows_paths
from .fused_heat import heat_arguments, heat_changes
from .plan import SCHEDULES, RolloutPlan
from .reasons import why_not_fused
from .sorting import STEPS_IN_ORDER, STEPS_WITH_HEAT, restore_order, sort_particles
from .steps import MovingBodies, Steps


def in_calls(steps: Steps, state: State, plan: RolloutPlan) -> State:
    """The state after the steps, by calls of the fused op as planned. Unless the plan stores all steps, the backward
    pass of the op recomputes them."""
    step, n, dt, *_ = steps
    assert plan.facts is not None and isinstance(step, Step)
    with_gradient, checkpoints = plan.facts.gradients, plan.checkpoints
    if plan.sorts:
        return _in_order(steps, state, plan)
    schedule = plan.schedule if plan.forced else None

    def advance(state: State, count: int, first: int = 0) -> State:
        while count > 0:
            call = plan.call(count, step.grid.max_blocks)
            steps_now = min(count, plan.steps_per_call) if with_gradient else call.steps
            state = substeps(step, state, steps_now, dt, plan.stores_all, call.max_blocks, schedule, steps.bodies)
            count -= steps_now
        return state

    if not with_gradient or plan.stores_all:
        return advance(state, n)
    if checkpoints is not None and checkpoints.states is not None and n > 0:
        return binomial(advance, step.prepare(state), n, checkpoints, step, in_op=True)
    with offloading(checkpoints, state):
        return advance(state, n)


def _in_order(steps: Steps, state: State, plan: RolloutPlan) -> State:
    """`in_calls` for particles that are sorted every `STEPS_IN_ORDER` or `STEPS_WITH_HEAT` steps, and restored to their
    order at the end."""
    step, n = steps.step, steps.n
    assert plan.facts is not None and isinstance(step, Step)
    end = given = step.prepare(state)
    most = n if plan.facts.gradients or step._rests else STEPS_IN_ORDER if step.heat is None else STEPS_WITH_HEAT
    plan = plan.of_sorted()
    for first in range(0, n, most):
        start = sort_particles(step, end)
        end = in_calls(steps.part(min(most, n - first), first), start, plan)
    return restore_order(step, end, start, given)


def substeps(
    step: Step,
    state: State,
    n: int,
    dt: float | Tensor,
    records: bool = False,
    blocks: int | None = None,
    schedule: str | None = None,
    bodies: MovingBodies | None = None,
) -> State:
    """The state n steps later, by one call of the op, which also moves the bodies; `why_not_fused` must be None.

    With `records` the inputs of the adjoint are stored; otherwise the backward pass recomputes the steps. The pool has
    room for at least `blocks` blocks; None for as many as the grid has.

    Raises:
        ValueError: for a dt that is not positive and finite, or a material without a law.
        GridOverflowError: on the CPU, where a grid of fixed `max_blocks` is full.
    """

    def advanced(state: State, dt: float | Tensor) -> State:
        return _substeps(step, state, n, dt, records, blocks, schedule, bodies)

    return paused(advanced, step._error_status, step.prepare(state), dt, step.grid.scenes, n)


def substeps_arguments(
    step: Step, state: State, n: int, dt: float | Tensor, records: bool = False, blocks: int | None = None
) -> dict[str, Any]:
    """The arguments of `torch.ops.torch_mpm.substeps` by name, for training code that calls the op itself.

    The op does not support paused scenes: each entry of a tensor dt must be positive. `Step.check` does not include the
    steps of the op, which returns its own status; `previous_status` is the status before the steps.

    Args:
        step, state, n, dt: as `rollout`; n at most 65536.
        records: whether the op stores the inputs of the adjoint; otherwise its backward pass recomputes the steps.
        blocks: number of blocks of the pool; None for as many as the grid has now. On CUDA they must suffice for all
            steps.

    Raises:
        ValueError: the op does not support the steps; with the reason.
    """
    if not isinstance(step, Step):
        raise TypeError(f"step must be a Step, got {shape_of(step)}")
    check_count("n", n, 1)
    check_flag("records", records)
    if blocks is not None:
        check_count("blocks", blocks)
    check_state(state)
    if (reason := why_not_fused(step, state, n, dt)) is not None:
        raise ValueError(f"step must be one that `substeps` supports, got a step that it does not: {reason}")
    arguments, _ = _arguments(step, step.with_residual(step.prepare(state), dt), n, dt, records, blocks)
    return dict(zip(ARGUMENTS, arguments, strict=True))


def _arguments(
    step: Step,
    state: State,
    n: int,
    dt: float | Tensor,
    records: bool,
    blocks: int | None,
    schedule: str | None = None,
) -> tuple[tuple[Any, ...], list[list[str]]]:
    """Arguments of the op in its order, and the names of the history of each law, for a prepared state."""
    grid, law = step.grid, step.law
    damping, boundaries = split_damping(step.boundaries.entries)
    number, scene_dt, scene_time = clocks(state, dt, grid.scenes)
    times = StepTimes.of(state, n, dt, grid.scenes) if boundaries and follows_paths(step) else None
    pool = grid.pool(state.x, state.scene)
    law.check_parameters(len(state), grid.scenes)
    apic = step.transfer == "apic"
    wants_C = step._keeps_C or step.heat is not None
    table, *others = obstacle_arguments(boundaries, state.x, grid.scenes, times)
    of_table = table is not None and table.requires_grad
    with_gradient = torch.is_grad_enabled() and (of_table or differentiates(step, state, dt))
    rests = step._rests and not (with_gradient or step.boundaries.reads_time)
    calls = NO_CALLS if rests else law_calls(law, state, dt, step.heat is not None)
    arguments = (
        *(state.x, state.v, state.mass, state.volume, state.C, state.F, state.J),
        None if state.x_residual is None else state.x_residual.detach(),
        *(calls.history, state.scene, state.ids, calls.material, step._error_status.status_for(state.x)),
        *(",".join(calls.names), calls.options, calls.parameters, calls.variables),
        *(int(n), number, apic, (step._flip_share, damping), wants_C, STRESS_FORMS[step.stress_form]),
        _gravity(step, state.x),
        *wall_arguments(step.walls, grid),
        *(table, *others),
        *(0.0 if scene_time is not None else float(state.time), grid.scenes),
        *(pool if blocks is None else max(pool, blocks), grid.grows, not with_gradient, with_gradient and records),
        *(state.impulse, scene_dt, scene_time, *heat_arguments(step, state)),
        *(calls.thermal, calls.tables, *grid.packed),
        -1 if schedule is None else SCHEDULES.index(schedule),
    )
    return arguments, calls.history_names


NO_CALLS = LawCalls([], [], [], [], [], [], None, [], [])
"""No law, for a body at rest."""


def _substeps(
    step: Step,
    state: State,
    n: int,
    dt: float | Tensor,
    records: bool,
    blocks: int | None,
    schedule: str | None,
    bodies: MovingBodies | None,
) -> State:
    """`substeps` of a prepared state, where no scene is paused."""
    grid, errors = step.grid, step._error_status
    errors.begin(state, grid.scenes)
    arguments, history_names = _arguments(step, state, n, dt, records, blocks, schedule)
    rests = arguments[ARGUMENTS.index("laws")] == ""
    op = torch.ops.torch_mpm.substeps
    if bodies is not None:
        op = torch.ops.torch_mpm.substeps_with_bodies
        tensors, others = bodies.arguments
        arguments = ([bodies.rows, *tensors], *others, *arguments)
    results = interruptible(dispatch, op, *arguments)
    x, v, C, F, J, history, status, impulse, time, residual, heat, heat_status, _, *of_bodies = results
    if bodies is not None:
        bodies.follow(*of_bodies)
    if rests:  # One activation, while the status counts the steps.
        status[0, Status.ACTIVATIONS] += n - 1
    errors.follow(errors.status, status)
    grid.watch(status)
    if status.is_cpu:  # The op has enlarged the pool, or stopped.
        grid.follow(status[0].tolist()[Status.BLOCKS_WANTED if grid.grows else Status.BLOCKS_NOW])
    extra, temperature = _history(state, history_names, history), state.temperature
    if step.heat is not None:
        temperature, of_heat = heat_changes(step.heat, state, heat, heat_status)
        extra |= of_heat
        C = C if step._keeps_C else None
    before = state.time
    now = time_after(before, dt, n) if time is None else _in_shape(time.detach(), before, dt)
    if requires_grad(dt) or requires_grad(before):
        known: Any = before + n * (dt.double() if isinstance(dt, Tensor) else dt)
        now = now + (known - known.detach())  # Adds the gradient, and not a value.
    residual = None if residual is None else residual.detach()
    moved = {"x": x, "v": v, "C": C, "F": F, "J": J, "temperature": temperature, "x_residual": residual}
    return state.with_results(moved | {"extra": extra, "time": now, "impulse": impulse})


def _in_shape(times: Tensor, time: float | Tensor, dt: float | Tensor) -> Tensor:
    """Times of scenes in the shape of `time + dt`: one value if neither has a value per scene."""
    shape = max((tuple(t.shape) for t in (time, dt) if isinstance(t, Tensor)), key=lambda s: (len(s), s))
    return times if times.shape == shape or not len(times) else times[:1].reshape(shape)


def _gravity(step: Step, x: Tensor) -> Tensor | None:
    gravity = step.gravity_like(x)
    if not isinstance(step.gravity, Tensor):
        return gravity  # Numbers, as [B, D].
    return None if gravity is None else per_scene(gravity, x, step.grid.scenes, step.grid.dim)


def _history(state: State, names: list[list[str]], columns: Tensor | None) -> dict[str, Tensor]:
    """The history of all laws by name; each particle has that of its law."""
    extra, first = dict(state.extra), 0
    for number, own_names in enumerate(names):
        for name in own_names:
            before = extra[name]
            width = 1 if before.dim() == 1 else before.shape[1] ** 2
            assert columns is not None
            value = columns[:, first] if before.dim() == 1 else columns[:, first : first + width].view_as(before)
            if len(names) > 1:
                assert state.material is not None
                own = (state.material == number).reshape(-1, *(1,) * (before.dim() - 1))
                value = torch.where(own, value, before)
            extra[name] = value
            first += width
    return extra
