"""Heat of a step in the fused op: its arguments and results, and the reasons why the op does not conduct it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..heat.heat import GRADIENT, TRANSFERS, Heat
from ..laws.parameters import PerMaterial, check_length, evaluate, needed_temperature
from ..laws.thermal import LIQUID
from ..state.state import State
from ..step.step import Step
from .facts import differentiates


def why_not_fused_heat(step: Step, state: State, dt: float | Tensor) -> str | None:
    """Reason why the fused op does not conduct the heat of a step; None if it does."""
    heat = step.heat
    assert heat is not None
    if state.x.is_cuda:
        return "it conducts heat on a CUDA device"
    if type(heat) is not Heat:
        return f"{type(heat).__name__} may do more than a Heat"
    if heat.grid is not step.grid:
        return "its heat has another grid"
    if len(heat.boundaries):
        return "its heat has boundaries"
    if heat.method != "cg":
        return f"its heat is solved by {heat.method}"
    if heat.plastic_heating:
        return "the law dissipates energy into heat"
    if step.stress_form != "mls":
        return "it conducts heat with another stress form than mls"
    values = _values(heat)
    if any(_is_function(value) for value in values):
        return "a parameter of its heat is a function"
    if torch.is_grad_enabled():
        parts = [part for v in values for part in (v.values() if isinstance(v, PerMaterial) else (v,))]
        if any(t.requires_grad for t in (*parts, *_fields(heat, state)) if isinstance(t, Tensor)) or differentiates(
            step, state, dt
        ):
            return "it conducts heat, and a gradient is wanted"
    return None


def _is_function(value: Any) -> bool:
    """Whether a parameter depends on the temperature, or may do so."""
    if isinstance(value, PerMaterial):
        return any(_is_function(part) for part in value.values())
    return callable(value) and not isinstance(value, Tensor)


def _values(heat: Heat) -> tuple[Any, ...]:
    """Parameters in the order of the op."""
    melting = (heat.melting_point, heat.latent_heat) if heat.melts else ()
    return (heat.conductivity, heat.specific_heat, *melting)


def _fields(heat: Heat, state: State) -> tuple[Tensor | None, ...]:
    return state.temperature, state.extra.get(GRADIENT), state.extra.get(LIQUID)


def heat_arguments(heat: Heat | None, state: State) -> tuple[Any, ...]:
    """The arguments of the op from `heat` to `heat_iterations`."""
    if heat is None:
        return [], None, 0, 0.5, 1
    temperature, scenes = needed_temperature(state), heat.grid.scenes
    names = ("conductivity", "specific_heat", "melting_point", "latent_heat")
    values = []
    for name, value in zip(names, _values(heat), strict=False):
        check_length(name, value, len(state), scenes)
        number = evaluate(name, value, state) if isinstance(value, PerMaterial) else value
        values.append(torch.as_tensor(number, dtype=temperature.dtype, device=temperature.device))
    melting = [state.extra[LIQUID], *values[2:]] if heat.melts else []
    gradient = state.extra[GRADIENT] if heat.affine else None
    return (
        [temperature, *values[:2], *melting],
        gradient,
        TRANSFERS.index(heat.transfer),
        heat.tolerance,
        heat.max_iterations,
    )


def heat_changes(heat: Heat, state: State, packed: Tensor, status: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Temperature after the steps, and the other fields of heat by their keys in `State.extra`; stores the status."""
    heat.count(status)
    dim, extra, first = state.x.shape[1], {}, 1
    if heat.affine:
        extra[GRADIENT] = packed[:, first : first + dim]
        first += dim
    if heat.melts:
        extra[LIQUID] = packed[:, first]
    return packed[:, 0], extra
