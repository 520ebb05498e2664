"""Values of parameters that users give in several forms: one stored form, and the checks of these values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..cuda_graphs.capture import is_readable
from ..errors import REAL, check_number, shape_of

Value = float | Sequence[Any] | np.ndarray | Tensor
"""A number; a tensor or an array [], [B], [D] or [B, D]; a list or tuple of D components, numbers or arrays [] or [B],
which are stacked on the last axis; or a list of B lists of D numbers, [B, D]. Results of functions may have tensors in
the place of arrays; values that are stored may not: a stack of tensors would neither follow their writes nor a second
backward pass."""


def as_value(name: str, value: Any, like: Tensor | None = None) -> Any:
    """A `Value` in its stored form: a number, a tuple of numbers or of such tuples of one length, or a tensor.

    Numbers, lists and arrays become numbers, which are valid on any device.

    Args:
        name: of the parameter, for messages.
        value: the value that was given.
        like: dtype and device of components that stand beside tensors; None for those of the first tensor.

    Raises:
        TypeError, ValueError: for a value of another form.
    """
    if isinstance(value, (Tensor, *REAL)):
        return value if isinstance(value, Tensor) else float(check_number(name, value, "a number", lambda v: True))
    if isinstance(value, (Mapping, Set)):
        raise TypeError(f"{name} must be numbers in an order, got {type(value).__name__}")
    if hasattr(value, "__array__"):
        return _of_array(name, np.asarray(value))
    if isinstance(value, (str, type)) or not hasattr(value, "__len__"):
        return check_number(name, value)  # It raises.
    parts = list(value)
    if any(_is_list(part) for part in parts):
        return _of_rows(name, [as_value(name, part, like) for part in parts], like)
    if any(isinstance(part, Tensor) for part in parts):
        return _of_components(name, parts, like)
    if any(hasattr(part, "__array__") and np.ndim(part) for part in parts):
        try:
            return _of_array(name, np.stack(np.broadcast_arrays(*parts), -1))
        except ValueError:
            raise _unlike(name, parts) from None
    return tuple(as_value(name, part.item() if isinstance(part, np.ndarray) else part) for part in parts)


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple))


def _has_tensors(value: Any) -> bool:
    """Whether tensors are in a list."""
    return _is_list(value) and any([isinstance(part, Tensor) or _has_tensors(part) for part in value])


def _of_array(name: str, array: np.ndarray) -> Any:
    """Numbers of an array."""
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{name} must be numbers, got an array of {array.dtype}")
    return _frozen(array.astype(np.float64).tolist())


def _frozen(value: Any) -> Any:
    return tuple(_frozen(part) for part in value) if isinstance(value, list) else value


def _of_rows(name: str, rows: Sequence[Any], like: Tensor | None) -> Any:
    """Rows of numbers, one of each scene."""
    if len({shape_of_value(row) for row in rows}) > 1 or not all(shape_of_value(row) for row in rows):
        raise ValueError(f"{name} must have one list of D numbers for each scene, got {_shapes(rows)}")
    if not any(isinstance(row, Tensor) for row in rows):
        return tuple(rows)
    return torch.stack(_as_tensors(rows, like))


def _of_components(name: str, parts: Sequence[Any], like: Tensor | None) -> Tensor:
    """Components on the last axis, some of them tensors."""
    values = [part if isinstance(part, Tensor) else as_value(name, part) for part in parts]
    try:
        return torch.stack(torch.broadcast_tensors(*_as_tensors(values, like)), -1)
    except RuntimeError as error:
        if len({p.device for p in parts if isinstance(p, Tensor)}) > 1:
            raise ValueError(f"{name} must have components on one device: {error}") from None
        raise _unlike(name, values) from None


def _as_tensors(values: Sequence[Any], like: Tensor | None) -> list[Tensor]:
    """Tensors unchanged, and numbers as tensors like them."""
    model = next(v for v in values if isinstance(v, Tensor)) if like is None else like
    dtype = model.dtype if model.is_floating_point() else torch.get_default_dtype()
    return [v if isinstance(v, Tensor) else filled(v, model, dtype) for v in values]


def _unlike(name: str, parts: Sequence[Any]) -> ValueError:
    return ValueError(f"{name} must have components of shape [] or [B], got {_shapes(parts)}")


def _shapes(parts: Sequence[Any]) -> str:
    return ", ".join(str(list(shape_of_value(part))) for part in parts)


def filled(value: Any, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Numbers as a tensor with the dtype and device of `like`. Neither few numbers, which are filled in on the device,
    nor many, which are copied to it, wait for the device.
    """
    dtype = like.dtype if dtype is None else dtype
    numbers = value if isinstance(value, (tuple, list)) else (value,)
    if like.is_cpu or not 0 < len(numbers) <= 3 or not all(isinstance(a, (int, float)) for a in numbers):
        host = torch.tensor(value, dtype=dtype, device="cpu")
        return host if like.is_cpu else host.to(like.device, non_blocking=True)
    entries = [torch.full((), a, dtype=dtype, device=like.device) for a in numbers]
    return entries[0] if numbers is not value else torch.stack(entries)


def to_device(value: Tensor, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """A tensor on a device, which is not waited for; copies to the host wait, since the host reads them at once.

    Pinned memory is copied on the host first: its owner may write to it before the device has read it.
    """
    if device.type == "cpu":
        return value.to(device, dtype)
    if value.is_cpu and value.is_pinned():
        value = value.clone(memory_format=torch.contiguous_format)
    return value.to(device, dtype, non_blocking=True)


def shape_of_value(value: Any) -> tuple[int, ...]:
    """Shape of a stored value."""
    if isinstance(value, Tensor) or hasattr(value, "__array__"):
        return tuple(value.shape)
    return (len(value), *shape_of_value(value[0])) if _is_list(value) and value else (0,) * _is_list(value)


def numbers_of(value: Any) -> Sequence[float]:
    """All numbers of a stored value; none of tensors that cannot be read without waiting for a device."""
    if isinstance(value, Tensor):
        return value.detach().double().reshape(-1).tolist() if is_readable(value) else []
    return [number for part in value for number in numbers_of(part)] if _is_list(value) else [value]


# ---- checks. Values of tensors are read where that neither waits for a device nor ends a compiled function.


def finite(name: str, value: Any, expected: str = "finite") -> Any:
    """Finite numbers, in their stored form; None unchanged."""
    if value is None:
        return None
    if _has_tensors(value):
        raise TypeError(f"{name} must be numbers or one tensor, got tensors in a list: stack them (torch.stack)")
    value = as_value(name, value)
    if isinstance(value, Tensor):
        if value.is_complex() or value.dtype == torch.bool:
            raise TypeError(f"{name} must have a real dtype, got {value.dtype}")
        valid = not is_readable(value) or bool(value.detach().isfinite().all())
    else:
        valid = all(map(math.isfinite, numbers_of(value)))
    if not valid:
        raise ValueError(f"{name} must be {expected}, got {value}")
    return value


def constant(name: str, value: Any) -> Any:
    """Finite numbers; neither None nor a function."""
    if value is None or callable(value):
        raise TypeError(f"{name} must be numbers or a tensor, got {shape_of(value)}")
    return finite(name, value)


def direction(name: str, value: Any) -> Any:
    """Vectors that are finite and not zero."""
    value = constant(name, value)
    if isinstance(value, Tensor):
        valid = not is_readable(value) or value.dim() == 0 or bool((value.detach() != 0).any(-1).all())
    else:
        rows = value if _is_list(value) and value and _is_list(value[0]) else [value]
        valid = all(any(numbers_of(row)) for row in rows)
    if not valid:
        raise ValueError(f"{name} must not be zero, got {value}")
    return value


def not_negative(name: str, value: Any, expected: str = ">= 0") -> Any:
    """Numbers that are finite and not negative."""
    value = constant(name, value)
    if isinstance(value, Tensor):
        valid = not is_readable(value) or bool((value.detach() >= 0).all())
    else:
        valid = min(numbers_of(value), default=-1) >= 0
    if not valid:
        raise ValueError(f"{name} must be {expected}, got {value}")
    return value


def positive(name: str, value: Any) -> Any:
    """Numbers that are finite and positive."""
    value = finite(name, value, "positive and finite")
    if value is None or any(number <= 0 for number in numbers_of(value)):
        raise ValueError(f"{name} must be positive and finite, got {value}")
    return value


def friction(name: str, value: Any) -> Any:
    """A Coulomb coefficient."""
    return not_negative(name, finite(name, value, "a finite number >= 0"), "a finite number >= 0")


def extent(name: str, value: Any) -> Any:
    """Lengths: finite, not negative and without gradient."""
    value = not_negative(name, value)
    if isinstance(value, Tensor) and value.requires_grad:
        raise ValueError(f"{name} must not require grad: which nodes are inside is not differentiable")
    return value
