"""Compiled laws, one or those of a mixture, as arguments of ops that call laws by name."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from .active import FIBRE, Active
from .compiled import CompiledLaw
from .material import Material
from .mixture import Mixture
from .parameters import Overlay


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


def laws_of(law: Material) -> list[Material]:
    """A law, or the laws of a plain mixture."""
    return list(law.laws) if type(law) is Mixture else [law]  # type: ignore[arg-type]


def passive(law: Material) -> Material:
    """A law without its muscles."""
    return law.law if type(law) is Active else law


def law_calls(law: Material, state: Any, dt: float | Tensor | None = None) -> LawCalls:
    """Calls of compiled laws for a state and a time step [s]; some may be `Active`.

    Without `dt` rate-dependent laws use that of the state.

    Raises:
        ValueError: where the state has no material, or one that the mixture does not have, as `Mixture.check_material`.
    """
    laws = laws_of(law)
    material = law.check_material(state) if isinstance(law, Mixture) else None
    names: list[str] = []
    each: list[tuple[int, list[Tensor], list[Tensor]]] = []  # Per law: options, parameters, history.
    history_names: list[list[str]] = []
    for part in laws:
        own: CompiledLaw = passive(part)  # type: ignore[assignment]
        with_dt: Any = state if dt is None or not own.rate_dependent else Overlay(state, dt=dt)
        names.append(own._name(state))
        each.append((own.option_bits(), own._arguments(with_dt)[1], own._history(state)))
        history_names.append(own.history_names())
        if isinstance(part, Active):
            names[-1] += f"+{FIBRE}"
            each.append((0, part.fibre_parameters(state), []))
    return LawCalls(
        ",".join(names),
        [options for options, _, _ in each],
        [len(history) for _, _, history in each],
        [parameter for _, parameters, _ in each for parameter in parameters],
        [variable for _, _, history in each for variable in history],
        history_names,
        material if len(laws) > 1 else None,
    )
