"""Order of particles: sorted before many steps, and restored after them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..laws import Mixture
from ..state.state import PARTICLE_FIELDS, State, _take_all
from ..step.step import Step

STEPS_IN_ORDER = 1024
"""Number of steps after which particles are sorted again."""
STEPS_WITH_HEAT = 64
"""The same with heat, where more kernels read the particles in the order of the blocks."""


def sort_particles(step: Step, state: State) -> State:
    """Sorted state, with materials marked as checked."""
    if isinstance(step.law, Mixture):
        step.law.check_material(state)
    return step.sorted(state)


def restore_order(step: Step, end: State, start: State, given: State) -> State:
    """The state `end` in the order of `given`. `start` is `given` sorted, and `end` the state after steps from it.
    Differentiable."""
    if isinstance(step.law, Mixture):  # Marks of checked materials exist for the latest ones only.
        step.law.reordered(start.material, given.material)
    ids, before, own = start.ids, _tensors(start), _tensors(given)
    assert ids is not None
    found = {name: own.get(name) for name in _tensors(end)}  # Those of fields that steps do not change remain.
    moved = {name: t for name, t in _tensors(end).items() if t is not None and t is not before.get(name)}
    place = torch.empty_like(ids).scatter_(0, ids, torch.arange(len(ids), device=ids.device))
    if given.ids is not None:  # They refer to the order before an earlier sort.
        place = place.index_select(0, given.ids)
    found |= dict(zip(moved, _take_all(list(moved.values()), place), strict=True))
    extra: dict[str, Any] = {name: found.pop((name,)) for (name,) in [k for k in found if isinstance(k, tuple)]}
    return end.replace(**found, extra=extra)


def _tensors(state: State) -> dict[Any, Tensor | None]:
    """Fields of the particles by name, those of `extra` by (name,)."""
    extra = {(name,): value for name, value in state.extra.items()}
    return {name: getattr(state, name) for name in PARTICLE_FIELDS} | extra
