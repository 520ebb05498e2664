"""Arguments that may require grad: their gradient is preserved, or they are refused by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import check_number, check_vector

Numbers = Sequence[float] | Tensor
"""Numbers, or a tensor of them."""


def requires_grad(value: Any) -> bool:
    """Whether a tensor, or one in a list, requires grad."""
    if isinstance(value, (list, tuple)):
        return any(requires_grad(part) for part in value)
    return isinstance(value, Tensor) and value.requires_grad


def refuse_grad(reason: str, **arguments: Any) -> None:
    """Check that no argument requires grad.

    Raises:
        ValueError: with the name of an argument, and the reason why it has no gradient.
    """
    for name, value in arguments.items():
        if requires_grad(value):
            raise ValueError(f"{name} must not require grad: {reason}")


VECTORS = {"point": 3, "size": 3, "normal": 3, "half_height_and_radius": 2}
"""Lengths of the arguments of conditions that are not single numbers."""


def check_fixed(reason: str, **arguments: Any) -> None:
    """Check arguments of conditions that have no gradient: numbers, or as many of them as `VECTORS` has.

    Raises:
        TypeError, ValueError: with the name of an argument, what was expected and what came.
    """
    refuse_grad(reason, **arguments)
    for name, value in arguments.items():
        if name in VECTORS:
            vector(name, value, torch.empty(0), VECTORS[name])
        else:
            number(name, value)


def number(name: str, value: Any) -> float:
    """A number, or a tensor of one entry as a number; not NaN.

    Raises:
        TypeError, ValueError: for other arguments.
    """
    return float(check_number(name, _number(value), "a number", lambda v: v == v))


def vector(name: str, value: Any, like: Tensor, length: int = 3) -> tuple[float, ...] | Tensor:
    """Three or `length` numbers; or a tensor of them, in the dtype and on the device of another one, where one requires
    grad.

    Raises:
        TypeError, ValueError: for other arguments.
    """
    if not requires_grad(value):
        single = isinstance(value, (list, tuple))
        return check_vector(name, [_number(part) for part in value] if single else value, length)
    if not isinstance(value, Tensor):
        value = torch.stack([torch.as_tensor(part, dtype=like.dtype, device=like.device) for part in value])
    if tuple(value.shape) != (length,):
        raise ValueError(f"{name} must have {length} numbers, got {list(value.shape)}")
    result: Tensor = value.to(like)
    return result


def _number(value: Any) -> Any:
    """A tensor [] as a number."""
    return value.item() if isinstance(value, Tensor) and value.numel() == 1 else value
