"""Compiled laws, one or those of a mixture, as arguments of ops that call laws by name."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from .active import FIBRE, Active
from .compiled import CompiledLaw
from .material import Material
from .mixture import Mixture
from .parameters import Overlay
from .thermal_calls import COHERENCY, is_thermal, phases_of, tables_of_expansion, tables_of_parameters


class LawCalls(NamedTuple):
    """Arguments of ops that call laws."""

    names: str
    """Names of the compiled laws: commas between materials, a plus before a contribution to the stress of a
    material.
    """
    options: list[int]
    """Number of parameters of each law; likewise the number of its history tensors."""
    variables: list[int]
    parameters: list[Tensor]
    """Parameters of all laws, one after another; likewise the history."""
    history: list[Tensor]
    history_names: list[list[str]]
    """Options of each material."""
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
    names: list[str] = []
    each: list[tuple[int, list[Tensor], list[Tensor]]] = []  # Per law: options, parameters, history.
    history_names: list[list[str]] = []
    thermal: list[int] = []
    tables: list[Tensor] = []

    def add(own: CompiledLaw) -> str:
        with_dt: Any = state if dt is None or not own.rate_dependent else Overlay(state, dt=dt)
        each.append((own.option_bits(), own._arguments(with_dt)[1], own._history(state)))
        return own._name(state)

    def add_tables(found: list[tuple[int, Tensor]] | None) -> None:
        assert found is not None
        for what, table in found:
            thermal.extend((len(each) - 1, what, len(tables)))
            tables.append(table.to(state.x).contiguous())

    for part in laws:
        if not heated or not is_thermal(part):
            own: CompiledLaw = passive(part)  # type: ignore[assignment]
            names.append(add(own))
            history_names.append(own.history_names())
            if isinstance(part, Active):
                names[-1] += f"+{FIBRE}"
                each.append((0, part.fibre_parameters(state), []))
            continue
        phases = phases_of(part)
        solid: CompiledLaw = phases.solid  # type: ignore[assignment]
        liquid: CompiledLaw | None = phases.liquid  # type: ignore[assignment]
        names.append(add(solid))
        add_tables(tables_of_parameters(solid, state.x))
        add_tables(tables_of_expansion(phases.expansion))
        history_names.append(solid.history_names())
        if liquid is not None:
            names[-1] += f"~{add(liquid)}"
            add_tables(tables_of_parameters(liquid, state.x))
            add_tables([(COHERENCY, state.x.new_tensor([[0.0], [phases.coherency]]))])
    return LawCalls(
        ",".join(names),
        [options for options, _, _ in each],
        [len(history) for _, _, history in each],
        [parameter for _, parameters, _ in each for parameter in parameters],
        [variable for _, _, history in each for variable in history],
        history_names,
        material if len(laws) > 1 else None,
        thermal,
        tables,
    )
