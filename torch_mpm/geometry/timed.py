"""Values that a function of time returns, at one time or at the times of several scenes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..errors import shape_of
from .values import Value, as_value

Path = Callable[[Tensor], Value]
"""A vector as a function of time, [] or [B] to [D] or [B, D], in the forms of `geometry.values.Value`."""

REFUSALS = RuntimeError, TypeError, ValueError, IndexError
"""Errors of functions of numbers that are given a tensor of a torch transform, or several times, as the time."""

T = TypeVar("T")


def tried(call: Callable[[], T]) -> tuple[T | None, Exception | None]:
    """Result of a call, or None and the error with which a function refuses its time. Lack of memory is no refusal."""
    try:
        return call(), None
    except torch.OutOfMemoryError:
        raise
    except REFUSALS as error:
        return None, error


def at_each(function: Callable[[Tensor], Tensor], times: Tensor) -> Tensor:
    """Results of a function of one time, stacked over times: by vmap, or one by one where it reads the value of a time.

    A wrong function raises its error in the second form.
    """
    rows, _ = tried(lambda: torch.vmap(function)(times))
    return torch.stack([function(time) for time in times.unbind()]) if rows is None else rows


def vector_at(name: str, function: Path, time: Tensor) -> Tensor:
    """The vector that a function of time returns, as a tensor [D] or [B, D]; `name` is that of the function.

    A function of times [B] must return [B, D]. One that does not, since it is written for one time, is called with the
    time of each scene. So is one that returns [D, D], which could be its components on the first axis.

    Raises:
        TypeError: for a result that is neither a tensor nor numbers.
        ValueError: for a result of another shape.
    """
    if time.dim() == 0:
        return _as_vector(name, function(time), time)
    vector, problem = tried(lambda: _as_vector(name, function(time), time))
    per_scene = vector is not None and vector.dim() == 2 and len(vector) == len(time)
    if vector is not None and per_scene and vector.shape[1] != len(time):
        return vector
    rows, refusal = tried(lambda: _of_scenes(name, function, time))
    if rows is not None:
        return rows
    if vector is not None and per_scene:  # of a function of times [B] alone
        return vector
    assert refusal is not None
    raise refusal from problem


def _of_scenes(name: str, function: Path, time: Tensor) -> Tensor:
    """Vectors [B, D] of a function that is called with the time of each scene, and may return those of all scenes."""
    rows = at_each(lambda one: _as_vector(name, function(one), one), time)
    if rows.dim() == 3 and rows.shape[1] in (1, len(time)):
        return rows[:, 0] if rows.shape[1] == 1 else rows.diagonal(dim1=0, dim2=1).mT
    if rows.dim() != 2:
        raise ValueError(f"{name} must return [D] or [B, D] at a time, with B = {len(time)}, got {shape_of(rows[0])}")
    return rows


def _as_vector(name: str, value: Any, time: Tensor) -> Tensor:
    """What a function has returned, as a tensor."""
    if value is None or isinstance(value, str):
        raise TypeError(f"{name} must return a tensor, an array or numbers at a time, got {shape_of(value)}")
    if not isinstance(value, Tensor):
        value = as_value(f"the result of {name}", value, time)
    if not isinstance(value, Tensor):
        value = torch.tensor(value, dtype=torch.float64, device="cpu").to(time.device, non_blocking=True)
    if value.is_complex() or value.dtype == torch.bool:
        raise TypeError(f"{name} must return real numbers at a time, got {value.dtype}")
    if value.dim() not in (1, 2):
        raise ValueError(f"{name} must return [D] or [B, D] at a time, got {list(value.shape)}")
    return value
