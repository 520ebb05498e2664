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

PADDING = 87 * 64
"""Between two rows of particles on the CPU at most [bytes], csrc/common/tensors.h."""
EVERYTHING = Checkpoints(memory=sys.float_info.max)
"""Of a memory into which all steps fit."""


KEPT_BYTES = {"cpu": 2**24, "cuda": 2**29}
"""What the backward pass of one op may hold of its steps, even where sqrt(n) steps need less: what the caches of a CPU
hold, and so much that kernels on CUDA hide the time of Python."""


def resolved(
    kept: Checkpoints,
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    fused: bool,
) -> Checkpoints | None:
    """Checkpoints of n steps that fit into a budget of memory; None where all steps do."""
    assert kept.memory is not None
    return fitting(kept.memory, n, *bytes_kept(step, state, dt, fused), kept.offload)


def bytes_kept(
    step: Callable[[State, float | Tensor], State], state: State, dt: float | Tensor, fused: bool
) -> tuple[int, int]:
    """Of a stored state, and of each step that the backward pass has recomputed, in one op or not [bytes]."""
    if isinstance(step, Step):
        state = step.prepare(state)
    return state_bytes(state), bytes_of_a_substep(state) if fused else step_bytes(step, state, dt)


def steps_of_a_call(state: State, n: int) -> int:
    """Between two kept states of a rollout in one op that says nothing else."""
    return max(math.isqrt(n), KEPT_BYTES[state.x.device.type] // max(bytes_of_a_substep(state), 1), 1)


def bytes_of_a_substep(state: State) -> int:
    """What the backward pass of the op holds of each step of a solid, at most [bytes]: of particles, and half as much
    of the grid."""
    D, size = state.x.shape[1], state.x.element_size()
    rows = len(state) + (0 if state.x.is_cuda else PADDING // size)
    history = sum(t[0].numel() for t in state.extra.values()) if len(state) else 0
    return rows * (3 * (2 * D + 4 * D * D) // 2 + history) * size
