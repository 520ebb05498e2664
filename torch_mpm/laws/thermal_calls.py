"""Laws that read the temperature, as the fused op computes them: the compiled laws of the phases of a material, and
tables of what depends on the temperature."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..cuda_graphs.capture import DeviceConstantCache
from ..geometry.values import to_device
from .compiled import CompiledLaw
from .material import Material
from .parameters import Overlay, Table
from .thermal import Melting, ThermalExpansion

EXPANSION, COHERENCY = -1, -2
"""What a table gives, in the place of the number of a parameter."""


THERMAL = (ThermalExpansion, Melting)


class Phases(NamedTuple):
    """The parts of a material that is one or two compiled laws, with or without thermal expansion."""

    solid: Material
    """The only law of a material that does not melt."""
    melting: Melting | None
    """The law of solid and liquid; None without."""
    expanding: ThermalExpansion | None
    """The law that expands; None without."""


def phases_of(law: Material) -> Phases:
    """The phases of a law; another law than `ThermalExpansion` and `Melting` is its only phase."""
    expanding = None
    if type(law) is ThermalExpansion:
        expanding, law = law, law.law
    if type(law) is Melting:
        return Phases(law.solid, law, expanding)
    return Phases(law, None, expanding)


def laws_in(law: Material) -> list[Material]:
    """The laws of the phases."""
    if type(law) not in THERMAL:
        return [law]
    phases = phases_of(law)
    return [phases.solid] if phases.melting is None else [phases.solid, phases.melting.liquid]


def is_thermal(law: Material) -> bool:
    """Whether a law expands, melts, or has parameters that are functions of the temperature."""
    return type(law) in THERMAL or (isinstance(law, CompiledLaw) and law.has_functions)


Tables = list[tuple[int, Tensor]]
"""Numbers of parameters, `EXPANSION` or `COHERENCY`, with knots and values [2, K] in the dtype and on the device of the
particles."""


def tables_of_expansion(law: ThermalExpansion, x: Tensor) -> Tables | None:
    """The table of an expansion for particles at x [P, D]; None where it is neither one number nor a `Table`. Cached
    while nothing has changed, unless it is differentiated."""
    given = law.coefficient
    if type(given) is Table:
        rows = given.temperature, given.value
        make = functools.partial(_table_of_rows, EXPANSION, rows, x)
        return make() if _is_differentiated(rows) else _kept(law._kept_table, rows, make, x)
    if isinstance(given, Tensor):
        if given.numel() != 1:
            return None
    elif callable(given):
        return None
    make = functools.partial(_table_of_number, EXPANSION, given, x)
    return make() if _is_differentiated([given]) else _kept(law._kept_table, [given], make, x)


def table_of_coherency(law: Melting, x: Tensor) -> Tables:
    """The table of the coherency for particles at x [P, D]; cached while nothing has changed."""
    make = functools.partial(_table_of_number, COHERENCY, law.coherency, x)
    tables: Tables = _kept(law._kept_table, [law.coherency], make, x)
    return tables


def _table_of_rows(what: int, rows: Sequence[Tensor], x: Tensor) -> Tables:
    return [(what, torch.stack([to_device(row, x.device, x.dtype) for row in rows]))]


def _table_of_number(what: int, number: Any, x: Tensor) -> Tables:
    """The table of a number, which a kernel writes: a copy from the host would wait for the device."""
    if isinstance(number, Tensor):
        value = to_device(number, x.device, x.dtype).reshape(1)
    else:
        value = x.new_full((1,), float(number))
    return [(what, torch.stack([x.new_zeros(1), value]))]


def _is_differentiated(contents: Sequence[Any]) -> bool:
    return torch.is_grad_enabled() and any([isinstance(t, Tensor) and t.requires_grad for t in contents])


def _kept(cache: DeviceConstantCache, contents: Sequence[Any], make: Callable[[], Any], x: Tensor) -> Any:
    """What is made of tensors and numbers for particles at x [P, D], without gradients; from the cache while these have
    not changed."""

    def made() -> Any:
        with torch.no_grad():
            return make()

    return cache.get((x.dtype, x.device, x.shape[1], *contents), made, x)


def tables_of_parameters(law: CompiledLaw, x: Tensor) -> Tables | None:
    """Tables of the parameters of a compiled law that depend on the temperature, for particles at x [P, D]; None where
    one is not piecewise linear, or others differ between particles or scenes.

    Cached while nothing has changed. Where they are differentiated, their knots are, and the values at these are
    computed again.
    """
    found = parts_of_call(law, x)
    return None if found is None else found[1]


def parts_of_call(law: CompiledLaw, x: Tensor) -> tuple[list[Tensor] | None, Tables] | None:
    """Parameters of a law in a call of the op, and tables, which replace those parameters that are functions of the
    temperature: these have any value. The parameters are None where they are those of the state. None where
    `tables_of_parameters` is."""
    found = _at_knots(law, x)
    if found is None:
        return None
    if found.is_differentiated:
        return None, _tables_at(law, found.knots, x)
    is_kept = found.tables and not law.rate_dependent
    return found.parameters if is_kept else None, found.tables


class _AtKnots(NamedTuple):
    """What is computed of a law at the knots of its functions of the temperature."""

    knots: Tensor
    """Of all functions [K], float64."""
    tables: Tables
    parameters: list[Tensor]
    """All parameters in the dtype of the particles; those that have tables at the first knot [1]."""
    is_differentiated: bool = False


def _at_knots(law: CompiledLaw, x: Tensor) -> _AtKnots | None:
    if not law.has_functions:
        return _AtKnots(x.new_empty(0), [], [])
    given = [value for name, value in law._stored().items() if law._range(name) is not None]
    functions = [value for value in given if callable(value) and not isinstance(value, Tensor)]
    others = [value for value in given if isinstance(value, Tensor)]
    if any([type(f) is not Table for f in functions]) or any([value.numel() > 1 for value in others]):
        return None
    numbers = [value for value in given if isinstance(value, (float, int))]
    tensors = [*others, *(tensor for f in functions for tensor in (f.temperature, f.value))]
    found = _kept(law._kept_tables, [*numbers, *tensors], lambda: _tables_of_functions(law, functions, x), x)
    return None if found is None else found._replace(is_differentiated=_is_differentiated(tensors))


def _tables_of_functions(law: CompiledLaw, functions: list[Table], x: Tensor) -> _AtKnots | None:
    """Tables of the parameters that are computed from functions; None where one is not linear between the knots. Waits
    for the device."""
    knots = torch.cat([f.temperature.to(x.device, torch.float64) for f in functions]).unique()
    middles = (knots[1:] + knots[:-1]) / 2
    for _, values in _parameters_at(law, torch.cat([knots, middles]), x):
        at_knots, between = values[: len(knots)], values[len(knots) :]
        error = (between - (at_knots[1:] + at_knots[:-1]) / 2).abs().max()
        if not bool(error <= 1e-12 * values.abs().max()):
            return None
    first = [values.to(x) for values in law._arguments(_rows_at(knots[:1], x))[1]]
    return _AtKnots(knots, _tables_at(law, knots, x), first)


def _tables_at(law: CompiledLaw, knots: Tensor, x: Tensor) -> Tables:
    """Tables of the parameters that depend on the temperature, with these knots [K]."""
    return [(number, torch.stack([knots, values]).to(x)) for number, values in _parameters_at(law, knots, x)]


def _parameters_at(law: CompiledLaw, temperature: Tensor, x: Tensor) -> list[tuple[int, Tensor]]:
    """Numbers of the parameters that depend on the temperature, with their values at temperatures [K]."""
    found = enumerate(law._arguments(_rows_at(temperature, x))[1])
    return [(number, values) for number, values in found if values.dim() > 0]


def _rows_at(temperature: Tensor, x: Tensor) -> Any:
    """Particles at temperatures [K]."""
    count, dim = len(temperature), x.shape[1]
    return Overlay(
        None, temperature=temperature, x=temperature.new_zeros(count, dim), F=temperature.new_zeros(count, dim, dim),
        J=temperature, ids=None, scene=None, scenes=1, dt=0.0,
    )  # fmt: skip


@torch.no_grad()
def why_not_thermal(law: Material, x: Tensor, melts: bool) -> str | None:
    """Reason why the fused op does not compute a law that reads the temperature, for particles at x; None if it does.
    `melts`: whether the heat of the step computes liquid fractions."""
    phases = phases_of(law)
    if phases.melting is not None and not melts:
        return "a law melts, and the heat has no melting point"
    if phases.expanding is not None and tables_of_expansion(phases.expanding, x) is None:
        return "an expansion is neither one number nor a table"
    if any([tables_of_parameters(part, x) is None for part in laws_in(law)]):  # type: ignore[arg-type]
        return "a parameter of the law is a function, and its heat changes the temperature"
    return None
