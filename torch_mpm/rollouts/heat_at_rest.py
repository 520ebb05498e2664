"""`Heat` alone in the fused op: steps of a fluid at rest, which has no stress and therefore stays there. A call without
gradients only conducts its heat."""

from __future__ import annotations

import functools
from typing import Any, TypeGuard

import torch

from ..boundaries import Obstacle
from ..heat.heat import Heat, present_volume
from ..laws import WeaklyCompressible
from ..laws.parameters import has_hooks
from ..state.state import State
from ..step.step import Step
from .fused_heat import HELD


def is_heat(step: Any) -> TypeGuard[Heat]:
    """Whether the step is a `Heat` alone, of no derived class."""
    return type(step) is Heat


def why_not_at_rest(heat: Heat) -> str | None:
    """Reason why steps of a body at rest are not those of the heat; None if they are."""
    if has_hooks(heat):
        return "there are hooks"
    if heat.plastic_heating:
        return "its heat is that of plastic flow, too"
    if any(obstacle.moves for obstacle in _held(heat)):
        return "an obstacle that holds a temperature moves"
    return None


def _held(heat: Heat) -> list[Obstacle]:
    """The obstacles that hold a temperature, each once."""
    regions = [term.region for term in heat.boundaries.entries if type(term) in HELD]
    return list(dict.fromkeys(region for region in regions if isinstance(region, Obstacle)))


@functools.cache
def _fluid() -> WeaklyCompressible:
    """Made once, since that takes longer than a step of few particles."""
    return WeaklyCompressible(1.0)


def step_at_rest(heat: Heat) -> Step:
    """A step with this heat, of a fluid whose pressure is zero at its rest volume. Both have one status."""
    step = Step(heat.grid, _fluid(), boundaries=_held(heat), heat=heat)
    step._error_status, step._rests = heat._error_status, True
    return step


def state_at_rest(state: State) -> State:
    """The state for `step_at_rest`: at rest, with the present volume as that at rest."""
    volume = present_volume(state)
    still = {"v": torch.zeros_like(state.v), "C": None, "F": None, "J": torch.ones_like(state.mass)}
    return state.replace(**still, volume=volume, x_residual=None, impulse=None)


def heated(state: State, end: State) -> State:
    """The state with the heat and the time of another one."""
    return state.replace(temperature=end.temperature, extra=state.extra | end.extra, time=end.time)
