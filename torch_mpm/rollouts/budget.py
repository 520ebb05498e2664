"""Memory of a rollout with gradients: what is stored, and how many steps fit into a budget."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Sequence

from torch import Tensor

from ..state.state import State
from ..step.step import Step
from .checkpoints import Checkpoints, Needs, fitting
from .memory import state_bytes, step_bytes
from .op_memory import needs_of_op, recorded_bytes, stored_bytes
from .steps import Steps

EVERYTHING = Checkpoints(memory=sys.float_info.max)
"""Checkpoints with unlimited memory: all steps are stored."""


KEPT_BYTES = {"cpu": 2**24, "cuda": 2**29}
"""Memory that the backward pass of one op may use for its steps, even if sqrt(n) steps need less [bytes]: the size of
the caches of a CPU; on CUDA enough that the kernels hide the time of Python."""


def within_budget(steps: Steps, state: State, fused: bool, lengths: Sequence[int] = ()) -> Checkpoints | None:
    """Checkpoints of steps that fit into their budget of memory, if they have one; `EVERYTHING` if all steps fit.

    `lengths` are the numbers of steps of several rollouts one after another. The budget is that of all of them: their
    states are stored at the same time, and the backward pass recomputes one rollout after another.
    """
    checkpoints = steps.checkpoints
    if checkpoints is None or checkpoints.memory is None or checkpoints is EVERYTHING:
        return checkpoints
    needs = needs_of(steps.step, state, steps.dt, fused)
    if len(lengths) <= 1:
        return fitting(checkpoints.memory, steps.n, needs, checkpoints.offload) or EVERYTHING
    if needs.bytes_of(len(lengths), sum(lengths)) <= checkpoints.memory:
        return EVERYTHING
    needs = needs._replace(state=len(lengths) * needs.state, path=len(lengths) * needs.path)
    found = fitting(checkpoints.memory, max(lengths), needs, checkpoints.offload)
    return found or Checkpoints(every=max(lengths), offload=checkpoints.offload)


def needs_of(step: Callable[[State, float | Tensor], State], state: State, dt: float | Tensor, fused: bool) -> Needs:
    """Memory of a stored state and of steps that the backward pass records, in the fused op or not."""
    if isinstance(step, Step):
        state = step.prepare(state)
    if fused:
        assert isinstance(step, Step)
        return needs_of_op(step, state, dt)
    # Working memory of the operations of a step and of their gradients: up to 1.3 times what the step stores.
    of_state, of_step = state_bytes(state), step_bytes(step, state, dt)
    return Needs(of_state, of_step, 2 * of_step + 3 * of_state)


def steps_of_a_call(step: Step, state: State, n: int) -> int:
    """Default number of steps between two stored states, for rollouts in one op."""
    return max(math.isqrt(n), KEPT_BYTES[state.x.device.type] // max(recorded_bytes(step, state), 1), 1)


def with_parts(checkpoints: Checkpoints, step: Step, state: State, n: int) -> Checkpoints:
    """Checkpoints of n steps of the op by a number of states, with the length of their parts."""
    if checkpoints.states is None or checkpoints.every is not None:
        return checkpoints
    memory = max(KEPT_BYTES[state.x.device.type], checkpoints.states * stored_bytes(step, state))
    parts = -(-n // max(memory // max(recorded_bytes(step, state), 1), 1))
    return dataclasses.replace(checkpoints, every=max(-(-n // max(parts, 1)), 1))
