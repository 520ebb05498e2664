"""Compiled laws, one or those of a mixture, as arguments of ops that call laws by name."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from .active import FIBRE, Active
from .compiled import CompiledLaw
from .material import Material
from .mixture import Mixture
from .parameters import Overlay
from .thermal_calls import (
    is_thermal,
    parts_of_call,
    phases_of,
    table_of_coherency,
    tables_of_expansion,
)


class LawCalls(NamedTuple):
    """Arguments of ops that call laws."""

    names: list[str]
    """Names of the compiled laws of each material, with a plus before a contribution to the stress."""
    options: list[int]
    """Options of each law."""
    variables: list[int]
    """Number of history tensors of each law."""
    parameters: list[Tensor]
    """Parameters of all laws, one after another; likewise the history."""
    history: list[Tensor]
    history_names: list[list[str]]
    """Names of the history of each material."""
    material: Tensor | None
    """Material of each particle; None for a single one."""
    thermal: list[int]
    """What depends on the temperature: a law, a parameter of it, `EXPANSION` or `COHERENCY`, and a table, each by its
    number."""
    tables: list[Tensor]
    """Temperatures and values [2, K]; of one temperature: a number."""


def laws_of(law: Material) -> list[Material]:
    """A law, or the laws of a plain mixture."""
    return list(law.laws) if type(law) is Mixture else [law]  # type: ignore[arg-type]


def passive(law: Material) -> Material:
    """A law without its muscles."""
    return law.law if type(law) is Active else law


def law_calls(law: Material, state: Any, dt: float | Tensor | None = None, heated: bool = False) -> LawCalls:
    """Calls of compiled laws for a state and a time step [s]; some may be `Active`.

    Without `dt` rate-dependent laws use that of the state. Where a call is `heated`, its temperatures change, laws may
    expand and melt, and `why_not_thermal` must be None for those that do or that have functions.

    Raises:
        ValueError: where the state has no material, or one that the mixture does not have, as `Mixture.check_material`.
    """
    laws = laws_of(law)
    material = law.check_material(state) if isinstance(law, Mixture) else None
    calls = LawCalls([], [], [], [], [], [], material if len(laws) > 1 else None, [], [])
    for part in laws:
        if heated and is_thermal(part):
            _add_phases(calls, part, state, dt)
            continue
        own: CompiledLaw = passive(part)  # type: ignore[assignment]
        name = _add(calls, own, state, dt)
        calls.history_names.append(own.history_names())
        if isinstance(part, Active):
            name += f"+{FIBRE}"
            calls.options.append(0)
            calls.variables.append(0)
            calls.parameters.extend(part.fibre_parameters(state))
        calls.names.append(name)
    return calls


def _add(
    calls: LawCalls, law: CompiledLaw, state: Any, dt: float | Tensor | None, parameters: list[Tensor] | None = None
) -> str:
    """Add a law to calls; returns its name. The parameters are those of the state unless they are given."""
    with_dt: Any = state if dt is None or not law.rate_dependent else Overlay(state, dt=dt)
    calls.options.append(law.option_bits())
    calls.parameters.extend(law._arguments(with_dt)[1] if parameters is None else parameters)
    history = law._history(state)
    calls.variables.append(len(history))
    calls.history.extend(history)
    return law._name(state)


def _add_phases(calls: LawCalls, law: Material, state: Any, dt: float | Tensor | None) -> None:
    """Add the laws of a material that reads the temperature, and their tables."""
    phases = phases_of(law)
    solid: CompiledLaw = phases.solid  # type: ignore[assignment]
    melting, x = phases.melting, state.x

    def add_tables(found: list[tuple[int, Tensor]] | None) -> None:
        assert found is not None
        for what, table in found:
            calls.thermal.extend((len(calls.options) - 1, what, len(calls.tables)))
            calls.tables.append(table)

    def add_phase(phase: CompiledLaw) -> str:
        found = parts_of_call(phase, x)
        assert found is not None
        parameters, tables = found
        name = _add(calls, phase, state, dt, parameters)
        add_tables(tables)
        return name

    name = add_phase(solid)
    if phases.expanding is not None:
        add_tables(tables_of_expansion(phases.expanding, x))
    calls.history_names.append(solid.history_names())
    if melting is not None:
        liquid: CompiledLaw = melting.liquid  # type: ignore[assignment]
        name += f"~{add_phase(liquid)}"
        add_tables(table_of_coherency(melting, x))
    calls.names.append(name)
