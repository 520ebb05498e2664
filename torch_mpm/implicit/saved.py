"""Objects stored for the backward pass with their tensors saved by autograd.

Tensors that a function stores itself are out of reach of checkpoints, which drop and recompute tensors saved by
autograd, and of hooks, which move them to the host.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from ..laws.parameters import Overlay


@dataclasses.dataclass(frozen=True)
class _Place:
    """Placeholder of a tensor."""

    number: int


def separated(value: Any) -> tuple[Any, list[Tensor]]:
    """Value with placeholders instead of its tensors, and the distinct tensors.

    Lists, tuples, dicts, dataclasses and overlays are traversed; the lattice of a grid and laws are unchanged.
    """
    numbers: dict[int, int] = {}
    tensors: list[Tensor] = []

    def place(t: Tensor) -> _Place:
        if id(t) not in numbers:
            numbers[id(t)] = len(tensors)
            tensors.append(t)
        return _Place(numbers[id(t)])

    return _mapped(value, Tensor, place), tensors


def joined(value: Any, tensors: Sequence[Tensor]) -> Any:
    """Inverse of `separated`."""
    return _mapped(value, _Place, lambda place: tensors[place.number])


def _mapped(value: Any, kind: type, change: Any) -> Any:
    if isinstance(value, kind):
        return change(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_mapped(part, kind, change) for part in value)
    if isinstance(value, dict):
        return {name: _mapped(part, kind, change) for name, part in value.items()}
    if isinstance(value, Overlay) or (dataclasses.is_dataclass(value) and not isinstance(value, _Place)):
        result = object.__new__(type(value))
        for name, part in vars(value).items():
            object.__setattr__(result, name, _mapped(part, kind, change))
        return result
    return value
