"""Heat of a step in the fused op: its arguments and results, and the reasons why the op does not conduct it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..boundaries.damping import split_damping
from ..geometry.values import to_device
from ..heat.boundaries import (
    STEFAN_BOLTZMANN,
    Convection,
    Fixed,
    FixedSurface,
    Flux,
    FreeSurface,
    Radiation,
    Source,
)
from ..heat.heat import GRADIENT, TRANSFERS, Heat
from ..laws.parameters import PerMaterial, check_length, evaluate, needed_temperature
from ..laws.thermal import LIQUID
from ..state.state import State
from ..step.step import Step


def why_not_fused_heat(step: Step, state: State, n: int, dt: float | Tensor) -> str | None:
    """Reason why the fused op does not conduct the heat of n steps; None if it does."""
    heat = step.heat
    assert heat is not None
    if type(heat) is not Heat:
        return f"{type(heat).__name__} may do more than a Heat"
    if heat.grid is not step.grid:
        return "its heat has another grid"
    if (reason := _why_not_boundaries(step, heat)) is not None:
        return reason
    if heat.method != "cg":
        return f"its heat is solved by {heat.method}"
    if step.stress_form != "mls":
        return "it conducts heat with another stress form than mls"
    if any(_is_function(value) for value in heat.parameter_values):
        return "a parameter of its heat is a function"
    return None


HELD = (Fixed, FixedSurface)
NUMBERS: dict[type, tuple[str, ...]] = {
    Flux: ("flux",),
    Convection: ("coefficient", "ambient"),
    Radiation: ("emissivity", "ambient"),
}
"""Terms of the free surface, in the order of csrc/heat/transfer.h, and their numbers."""
MOST_TERMS = 15
"""Such terms in a call of the op: `kMostHeatTerms` in csrc/heat/transfer.h without that of heat from inside."""


def _why_not_boundaries(step: Step, heat: Heat) -> str | None:
    """Reason why the op does not support the boundaries of the heat; None if it does."""
    terms = heat.boundaries.entries
    for term in terms:
        if type(term) not in (*HELD, *NUMBERS, Source):
            return f"its heat has a boundary of the user, {type(term).__name__}"
        if type(term) in HELD and not any(term.region is obstacle for obstacle in step.boundaries.entries):
            return f"the region of {type(term).__name__} is no obstacle of the step"
        if type(term) in NUMBERS and type(term.surface) is not FreeSurface:
            return f"{type(term).__name__} acts on points of a surface"
        for name in _names(term):
            value = getattr(term, name)
            if _is_function(value):
                return f"{name} of {type(term).__name__} is a function"
            if type(term) is Source or not isinstance(value, Tensor):
                continue
            if value.shape not in ((), (1,), (heat.grid.scenes,)):
                return f"{name} of {type(term).__name__} has other values than one for each scene"
    if sum(type(term) in NUMBERS for term in terms) > MOST_TERMS:
        return f"its heat has more than {MOST_TERMS} terms of the free surface"
    for kind, reason in ((FixedSurface, "several surfaces are held"), (Source, "there are several sources of heat")):
        if sum([type(term) is kind for term in terms]) > 1:
            return reason
    return None


def _names(term: Any) -> tuple[str, ...]:
    """Names of the numbers of a boundary."""
    return ("temperature",) if type(term) in HELD else NUMBERS.get(type(term), ("power",))


def _terms(heat: Heat, state: State) -> tuple[list[int], Tensor, Tensor]:
    """Terms of the free surface and their numbers [K, B, 2], and the power of the source; empty where absent."""
    terms, like, scenes = heat.boundaries.entries, state.mass, heat.grid.scenes
    kinds = list(NUMBERS)
    surfaces = [term for term in terms if type(term) in NUMBERS]
    given = [(kinds.index(type(term)), *(getattr(term, name) for name in _names(term))) for term in surfaces]
    if any([isinstance(value, Tensor) for row in given for value in row]):
        numbers = _numbers_of(given, like, scenes)
    else:
        key = like.dtype, like.device, scenes, given
        numbers = heat._kept_terms.get(key, lambda: _numbers_of(given, like, scenes), like)
    power = next((term.power for term in terms if type(term) is Source), None)
    of_source = like.new_empty(0) if power is None else _tensor("power", power, state, scenes)
    return [kind for kind, *_ in given], numbers, of_source


def _numbers_of(terms: list[tuple[Any, ...]], like: Tensor, scenes: int) -> Tensor:
    """Numbers of terms [K, B, 2], each given with the number of its kind."""
    kinds, rows = list(NUMBERS), []
    for kind, *given in terms:
        values = [_of_scenes(value, like, scenes) for value in given]
        if kinds[kind] is Radiation:
            values[0] = STEFAN_BOLTZMANN * values[0]
        rows.append(torch.stack([values[0], values[-1]], 1))
    return torch.stack(rows).contiguous() if rows else like.new_empty(0)


def _held(step: Step, x: Tensor) -> tuple[list[int], int, Tensor]:
    """Numbers of the obstacles that hold a temperature, that of a `FixedSurface` last; whether there is one; and the
    temperatures [K, B]."""
    assert step.heat is not None
    held = [term for term in step.heat.boundaries.entries if type(term) in HELD]
    terms = sorted(held, key=lambda term: type(term) is FixedSurface)
    if not terms:
        return [], 0, x.new_empty(0)
    scenes, (_, obstacles) = step.grid.scenes, split_damping(step.boundaries.entries)
    numbers = [next(k for k, o in enumerate(obstacles) if o is term.region) for term in terms]
    rows = [_of_scenes(term.temperature, x, scenes) for term in terms]
    return numbers, int(type(terms[-1]) is FixedSurface), torch.stack(rows)


def _of_scenes(value: Any, like: Tensor, scenes: int) -> Tensor:
    """A value for each scene [B], from one of a shape that `_why_not_boundaries` supports."""
    return _like(value, like).reshape(-1).expand(scenes)


def _like(value: Any, like: Tensor) -> Tensor:
    """A tensor of the dtype and on the device of another one, which is not waited for. A number is written by a
    kernel."""
    if isinstance(value, Tensor):
        return to_device(value, like.device, like.dtype)
    return torch.full((), float(value), dtype=like.dtype, device=like.device)


def _is_function(value: Any) -> bool:
    """Whether a parameter depends on the temperature, or may do so."""
    if isinstance(value, PerMaterial):
        return any(_is_function(part) for part in value.values())
    return callable(value) and not isinstance(value, Tensor)


def _tensor(name: str, value: Any, state: State, scenes: int) -> Tensor:
    """A parameter as the op takes it; values of particles in the order of the state.

    Raises:
        ValueError: for another shape.
    """
    check_length(name, value, len(state), scenes)
    of_particles = isinstance(value, PerMaterial) or getattr(value, "shape", None) == (len(state),)
    number = evaluate(name, value, state) if of_particles else value
    return _like(number, state.mass)


def heat_arguments(step: Step, state: State) -> tuple[Any, ...]:
    """The arguments of the op from `heat` to `heat_boundaries`."""
    heat = step.heat
    if heat is None:
        return [], [], [], [], [], []
    temperature, scenes = needed_temperature(state), heat.grid.scenes
    names = ("conductivity", "specific_heat", "melting_point", "latent_heat")
    given = list(zip(names, heat.parameter_values, strict=False))
    if all([isinstance(value, (float, int)) for _, value in given]):
        mass = state.mass
        key = mass.dtype, mass.device, *(value for _, value in given)
        values = heat._kept_numbers.get(key, lambda: [_like(value, mass) for _, value in given], mass)
    else:
        values = [_tensor(name, value, state, scenes) for name, value in given]
    melting = [state.extra[LIQUID], *values[2:]] if heat.melts else []
    gradient = [state.extra[GRADIENT]] if heat.affine else []
    numbers, surface, temperatures = _held(step, state.x)
    terms, of_terms, power = _terms(heat, state)
    options = [TRANSFERS.index(heat.transfer), heat.max_iterations, surface]
    boundaries = [temperatures, of_terms, power] if heat.boundaries.entries else []
    tensors = [temperature, *values[:2], *melting, *gradient]
    scalars = [heat.tolerance, heat.reference, heat.plastic_heating, heat.adjoint_tolerance]
    return tensors, options, scalars, numbers, terms, boundaries


def heat_changes(heat: Heat, state: State, packed: Tensor, status: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Temperature after the steps, and the other fields of heat by their keys in `State.extra`; stores the status, and
    later that of the adjoint solves."""
    heat.count(status)
    if packed.grad_fn is not None:
        packed.grad_fn.report = heat.count_adjoint  # type: ignore[attr-defined]
    dim, extra, first = state.x.shape[1], {}, 1
    if heat.affine:
        extra[GRADIENT] = packed[:, first : first + dim]
        first += dim
    if heat.melts:
        extra[LIQUID] = packed[:, first]
    return packed[:, 0], extra
