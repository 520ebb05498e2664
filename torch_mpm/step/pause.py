"""Paused scenes: those whose entry of a tensor dt is zero, negative or NaN."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import is_traced
from ..ops.arguments import per_particle, split_dt
from ..state.state import PARTICLE_FIELDS, State
from .status import ErrorStatus


def paused(
    advanced: Callable[[State, float | Tensor], State],
    status: ErrorStatus,
    state: State,
    dt: float | Tensor,
    scenes: int,
    steps: int = 1,
) -> State:
    """`advanced(state, dt)` with scenes paused by a tensor dt; `status` counts its invalid entries, once for each of
    the steps that `advanced` computes.
    """
    if not isinstance(dt, Tensor):
        return advanced(state, dt)
    split_dt(dt, scenes, state.x)  # checks dt
    if _all_move(dt):
        status.counts(scenes, dt.device)  # A compiled step then finds it.
        return advanced(state, dt)
    dt, moving, refused = split_paused(dt, state, scenes)
    status.refuse(refused, scenes, steps)
    after = standing(state, advanced(state, dt), moving)
    if after.impulse is None or state.impulse is None:
        return after
    return after.replace(impulse=torch.where((dt > 0).reshape(-1, 1, 1), after.impulse, state.impulse))


def _all_move(dt: Tensor) -> bool:
    """Whether no scene is paused, where this is known without waiting for a device."""
    return dt.device.type == "cpu" and not is_traced(dt) and bool((dt > 0).all())


def split_paused(dt: Tensor, state: State, scenes: int) -> tuple[Tensor, Tensor, Tensor]:
    """A tensor dt [s] with zero for every paused scene, without synchronising.

    Args:
        dt: of shape [], [1] or [B].
        state: the particles.
        scenes: B.

    Returns:
        dt in its shape; moving particles, bool [P]; and negative or NaN entries of dt, bool in the shape of dt.
    """
    moving, refused = dt > 0, ~(dt >= 0)
    if dt.numel() <= 1:  # This includes the particles of a batch without scenes, which no step moves.
        particles = moving.reshape(-1)[:1].expand(len(state)) if dt.numel() else dt.new_zeros(len(state)).bool()
    else:
        assert state.scene is not None
        particles = per_particle(moving, state.scene.clamp(0, scenes - 1), len(state))
    return torch.where(moving, dt, 0), particles, refused


def standing(before: State, after: State, moving: Tensor) -> State:
    """State after a step with every field unchanged for the particles that do not move; differentiable.

    Fields that the step has added, such as C in the first one, are zero there.
    """

    def field(old: Tensor | None, new: Any) -> Any:
        if new is old or not isinstance(new, Tensor):
            return new
        rows = moving.reshape(-1, *(1,) * (new.dim() - 1))
        return torch.where(rows, new, torch.zeros_like(new) if old is None else old)

    extra = {name: field(before.extra.get(name), new) for name, new in after.extra.items()}
    return after.replace(
        **{name: field(getattr(before, name), getattr(after, name)) for name in PARTICLE_FIELDS}, extra=extra
    )
