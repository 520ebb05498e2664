"""Compiled laws, one or those of a mixture, as the ops take them that call laws by their names."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from .compiled import CompiledLaw
from .material import Material
from .mixture import Mixture


class LawCalls(NamedTuple):
    """Arguments of ops that call laws."""

    names: str
    """Of the compiled laws, with commas."""
    options: list[int]
    parameters: list[Tensor]
    """Of all laws, one after another; likewise the history."""
    history: list[Tensor]
    history_names: list[list[str]]
    """Of each law."""
    material: Tensor | None
    """The law of each particle; None for a single law."""

    @property
    def variables(self) -> list[int]:
        """Numbers of history tensors of the laws."""
        return [len(names) for names in self.history_names]


def laws_of(law: Material) -> list[Material]:
    """A law, or those of a plain mixture."""
    return list(law.laws) if type(law) is Mixture else [law]  # type: ignore[arg-type]


def law_calls(law: Material, state: Any) -> LawCalls:
    """The calls of compiled laws for a state, which may have a time step `dt`.

    Raises:
        ValueError: where the state has no material, or one that the mixture does not have, as `Mixture.check_material`.
    """
    laws: list[CompiledLaw] = laws_of(law)  # type: ignore[assignment]
    material = law.check_material(state) if isinstance(law, Mixture) else None
    return LawCalls(
        ",".join(part._name(state) for part in laws),
        [part.option_bits() for part in laws],
        [parameter for part in laws for parameter in part._arguments(state)[1]],
        [variable for part in laws for variable in part._history(state)],
        [part.history_names() for part in laws],
        material if len(laws) > 1 else None,
    )
