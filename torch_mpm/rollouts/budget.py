"""Memory of a rollout with gradients: what is stored, and how many steps fit into a budget."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

from torch import Tensor

from ..state.state import State
from ..step.step import Step
from .checkpoints import Checkpoints, fitting
from .memory import state_bytes, step_bytes
from .steps import Steps

PADDING = 87 * 64
"""Largest padding between two rows of particles on the CPU [bytes], csrc/common/tensors.h."""
EVERYTHING = Checkpoints(memory=sys.float_info.max)
"""Checkpoints with unlimited memory: all steps are stored."""


KEPT_BYTES = {"cpu": 2**24, "cuda": 2**29}
"""Memory that the backward pass of one op may use for its steps, even if sqrt(n) steps need less [bytes]: the size of
the caches of a CPU; on CUDA enough that the kernels hide the time of Python."""


def within_budget(steps: Steps, state: State, fused: bool) -> Checkpoints | None:
    """Checkpoints of steps that fit into their budget of memory, if they have one; `EVERYTHING` if all steps fit."""
    checkpoints = steps.checkpoints
    if checkpoints is None or checkpoints.memory is None or checkpoints is EVERYTHING:
        return checkpoints
    sizes = bytes_kept(steps.step, state, steps.dt, fused)
    return fitting(checkpoints.memory, steps.n, *sizes, checkpoints.offload) or EVERYTHING


def bytes_kept(
    step: Callable[[State, float | Tensor], State], state: State, dt: float | Tensor, fused: bool
) -> tuple[int, int]:
    """Sizes of a stored state and of a step that the backward pass recomputes, in one op or not [bytes]."""
    if isinstance(step, Step):
        state = step.prepare(state)
    return state_bytes(state), bytes_of_a_substep(state) if fused else step_bytes(step, state, dt)


def steps_of_a_call(state: State, n: int) -> int:
    """Default number of steps between two stored states, for rollouts in one op."""
    return max(math.isqrt(n), KEPT_BYTES[state.x.device.type] // max(bytes_of_a_substep(state), 1), 1)


def bytes_of_a_substep(state: State) -> int:
    """Upper bound of the memory that the backward pass of the op uses per step of a solid [bytes]: for the particles
    with their history and heat, and half as much as without these for the grid."""
    D, size = state.x.shape[1], state.x.element_size()
    rows = len(state) + (0 if state.x.is_cuda else PADDING // size)
    history = sum(t[0].numel() for t in state.extra.values()) if len(state) else 0
    both = 0 if state.F is None or state.J is None else 2 + D * D  # J before and after laws that melt, and a stress.
    heat = 0 if state.temperature is None else 2  # With the dissipated energy; its other fields are in `extra`.
    return rows * (3 * (2 * D + 4 * D * D) // 2 + both + history + heat) * size
