"""Laws that read the temperature, as the fused op computes them: the compiled laws of the phases of a material, and
tables of what depends on the temperature."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

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
    liquid: Material | None
    coherency: float
    expansion: Any
    """Linear expansion over the temperature; None without."""


def phases_of(law: Material) -> Phases:
    """The phases of a law; another law than `ThermalExpansion` and `Melting` is its only phase."""
    expansion = None
    if type(law) is ThermalExpansion:
        expansion, law = law.coefficient, law.law
    if type(law) is Melting:
        return Phases(law.solid, law.liquid, law.coherency, expansion)
    return Phases(law, None, 1.0, expansion)


def laws_in(law: Material) -> list[Material]:
    """The laws of the phases."""
    if type(law) not in THERMAL:
        return [law]
    phases = phases_of(law)
    return [phases.solid] if phases.liquid is None else [phases.solid, phases.liquid]


def is_thermal(law: Material) -> bool:
    """Whether a law expands, melts, or has parameters that are functions of the temperature."""
    return type(law) in THERMAL or (isinstance(law, CompiledLaw) and law.has_functions)


Tables = list[tuple[int, Tensor]]
"""Numbers of parameters, `EXPANSION` or `COHERENCY`, with knots and values [2, K]."""


def tables_of_expansion(coefficient: Any, x: Tensor) -> Tables | None:
    """The table of an expansion, on the device of x; None where it is neither one number nor a `Table`."""
    if coefficient is None:
        return []
    if type(coefficient) is Table:
        rows = [t.to(x.device, torch.float64) for t in (coefficient.temperature, coefficient.value)]
        return [(EXPANSION, torch.stack(rows))]
    if callable(coefficient) and not isinstance(coefficient, Tensor):
        return None
    number = torch.as_tensor(coefficient, dtype=torch.float64)
    return [(EXPANSION, torch.stack([number.new_zeros(1), number.reshape(1)]))] if number.numel() == 1 else None


def tables_of_parameters(law: CompiledLaw, x: Tensor) -> Tables | None:
    """Tables of the parameters of a compiled law that depend on the temperature, for particles at x [P, D]; None where
    one is not piecewise linear, or others differ between particles or scenes. Cached while nothing has changed, unless
    they are differentiated."""
    if not law.has_functions:
        return []
    given = [value for name, value in law._stored().items() if law._range(name) is not None]
    functions = [value for value in given if callable(value) and not isinstance(value, Tensor)]
    others = [value for value in given if isinstance(value, Tensor)]
    if any([type(f) is not Table for f in functions]) or any([value.numel() > 1 for value in others]):
        return None
    numbers = [value for value in given if isinstance(value, (float, int))]
    contents = [tensor for f in functions for tensor in (f.temperature, f.value)]
    if torch.is_grad_enabled() and any([t.requires_grad for t in (*others, *contents)]):
        return _tables_of_functions(law, functions, x)
    key = (x.dtype, x.device, x.shape[1], *numbers, *others, *contents)
    return law._kept_tables.get(key, lambda: _tables_of_functions(law, functions, x), x)


def _tables_of_functions(law: CompiledLaw, functions: list[Table], x: Tensor) -> Tables | None:
    """Tables of parameters that are computed from functions; None where one is not linear between their knots."""
    dim = x.shape[1]
    knots = torch.cat([f.temperature.to(x.device, torch.float64) for f in functions]).unique()
    middles = (knots[1:] + knots[:-1]) / 2
    points = torch.cat([knots, middles])
    rows: Any = Overlay(
        None, temperature=points, x=points.new_zeros(len(points), dim), F=points.new_zeros(len(points), dim, dim),
        J=points, ids=None, scene=None, scenes=1, dt=0.0,
    )  # fmt: skip
    tables: Tables = []
    for number, values in enumerate(law._arguments(rows)[1]):
        if values.dim() == 0:
            continue
        at_knots, between = values[: len(knots)], values[len(knots) :]
        error = (between - (at_knots[1:] + at_knots[:-1]) / 2).abs().max()
        if not bool(error <= 1e-12 * values.abs().max()):
            return None
        tables.append((number, torch.stack([knots, at_knots]).to(x)))
    return tables


@torch.no_grad()
def why_not_thermal(law: Material, x: Tensor, melts: bool) -> str | None:
    """Reason why the fused op does not compute a law that reads the temperature, for particles at x; None if it does.
    `melts`: whether the heat of the step computes liquid fractions."""
    phases = phases_of(law)
    if phases.liquid is not None and not melts:
        return "a law melts, and the heat has no melting point"
    if tables_of_expansion(phases.expansion, x) is None:
        return "an expansion is neither one number nor a table"
    if any([tables_of_parameters(part, x) is None for part in laws_in(law)]):  # type: ignore[arg-type]
        return "a parameter of the law is a function, and its heat changes the temperature"
    return None
