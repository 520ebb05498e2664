"""Errors with messages that state a remedy, and the checks of arguments that many functions share."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from .step.failures import Failures

FLOATING = (torch.float32, torch.float64)
LARGEST = {dtype: torch.finfo(dtype).max for dtype in FLOATING}


def default_dtype() -> torch.dtype:
    """Default dtype of torch, or float32 if that is a half precision, too coarse for positions."""
    dtype = torch.get_default_dtype()
    return dtype if dtype in FLOATING else torch.float32


class SimulationError(RuntimeError):
    """Invalid state of a simulation: a particle left the grid, is not finite, or is inverted.

    Attributes:
        failures: `Failures` of the scenes, as returned by `Step.failures`; None where unknown.
    """

    def __init__(self, message: str, failures: Failures | None = None) -> None:
        super().__init__(message)
        self.failures = failures


class GridOverflowError(SimulationError):
    """More active blocks than `max_blocks` of the grid."""


class PrecisionWarning(UserWarning):
    """The precision of the chosen dtype is too coarse for the computation."""


class FrontWarning(UserWarning):
    """Steps are too long for the fronts between phases, which lag behind."""


class LockingWarning(UserWarning):
    """A nearly incompressible body bends too little on the lattice."""


class ThinWallWarning(UserWarning):
    """A wall is so thin that material on one side moves the nodes on the other."""


class DamagedFileError(ValueError):
    """File of a run that is damaged, was changed by another program, or is of another kind.

    The first argument alone is a complete message: so pickle and data loaders create the error of another process.
    """

    def __init__(self, path: object, problem: str = "", remedy: str = "") -> None:
        super().__init__(f"{path}: {problem}; {remedy}" if problem else str(path))


def shape_of(x: object) -> str:
    return str(list(x.shape)) if isinstance(x, Tensor) else type(x).__name__


REAL = (float, int, torch.SymFloat, torch.SymInt, numbers.Real)
"""Types of a number; the first of them is found without a search."""


NUMBER_OR_TENSOR = "a number or a tensor"


def is_finite(value: object) -> bool:
    """Whether a value is a number that a float can hold, and neither infinite nor NaN."""
    if isinstance(value, int):  # math.isfinite raises OverflowError for those that no float can hold.
        return abs(value) <= LARGEST[torch.float64]
    return isinstance(value, float) and math.isfinite(value)


def check_real(name: str, value: Any, kinds: str = "a number") -> float:
    """A number that a float can hold, including infinity and NaN; `kinds` describes other accepted types."""
    if not isinstance(value, REAL):
        raise TypeError(f"{name} must be {kinds}, got {_described(value)}")
    if isinstance(value, int) and not is_finite(value):
        raise ValueError(f"{name} must be finite, got a whole number of {value.bit_length()} bits")
    return value  # type: ignore[return-value]


def check_number(
    name: str,
    value: Any,
    expected: str = "finite",
    holds: Callable[[float], bool] = math.isfinite,
    kinds: str = "a number",
) -> float:
    """A number for which `holds` is true; `expected` describes it."""
    if not holds(check_real(name, value, kinds)):
        raise ValueError(f"{name} must be {expected}, got {value}")
    return value


MOST_COUNT = 2**63 - 1
"""Of the integers of ops."""


def check_count(name: str, value: Any, least: int = 0) -> int:
    """An integer, not a bool."""
    if isinstance(value, bool) or not isinstance(value, (int, numbers.Integral, torch.SymInt)):
        raise TypeError(f"{name} must be a whole number, got {_described(value)}")
    if value < least:
        expected = f"be at least {least}" if least else "not be negative"
        raise ValueError(f"{name} must {expected}, got {value}")
    if isinstance(value, int) and value > MOST_COUNT:
        raise ValueError(f"{name} must be below 2^63, got {value}")
    return value  # type: ignore[return-value]


def check_flag(name: str, value: Any) -> bool:
    """True or False, or a number equal to one of them."""
    if isinstance(value, Tensor) or value not in (True, False):
        raise TypeError(f"{name} must be True or False, got {_described(value)}")
    return bool(value)


def check_dtype(dtype: Any) -> None:
    """The dtype of a state, or None."""
    if dtype is not None and not isinstance(dtype, torch.dtype):
        raise TypeError(f"dtype must be torch.float32 or torch.float64, got {_described(dtype)}")
    if dtype is not None and dtype not in FLOATING:
        raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")


def check_device(device: Any) -> None:
    """A device, or None; torch decides which devices are valid."""
    if device is None or isinstance(device, torch.device):
        return
    if isinstance(device, bool) or not isinstance(device, (str, int)):
        raise TypeError(f"device must be a torch.device or its name, got {_described(device)}")
    try:
        torch.device(device)
    except (RuntimeError, OverflowError, ValueError) as error:
        raise ValueError(f"device must be a torch.device or its name, got {device!r}: {error}") from None


def check_numbers(name: str, value: Any, expected: str = "numbers") -> tuple[float, ...]:
    """Finite numbers, from a list or an array of one dimension."""
    if isinstance(value, Tensor) and value.requires_grad:
        raise ValueError(f"{name} must be {expected}, got a tensor that requires grad, which numbers have not")
    values = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise TypeError(f"{name} must be {expected}, got {_described(value)}")
    return tuple(float(check_number(name, a)) for a in values)


def check_vector(name: str, value: Any, dim: int | None = None) -> tuple[float, ...]:
    """D finite numbers."""
    expected = f"{dim or '2 or 3'} numbers"
    numbers = check_numbers(name, value, expected)
    if len(numbers) not in ((dim,) if dim else (2, 3)):
        raise ValueError(f"{name} must have {expected}, got {value}")
    return numbers


def _described(value: object) -> str:
    return f"{type(value).__name__} {value!r}" if isinstance(value, (str, bool, float)) else shape_of(value)


def check_positions(x: Tensor, dim: int, scene: Tensor | None, scenes: int) -> None:
    if not isinstance(x, Tensor) or x.dim() != 2 or x.shape[1] != dim:
        raise ValueError(f"x must have shape [P, {dim}], got {shape_of(x)}")
    if x.dtype not in FLOATING:
        raise TypeError(f"x must be float32 or float64, got {x.dtype}")
    if scene is None:
        if scenes != 1:
            raise ValueError(f"scene must be given, int32 [P], for a grid of {scenes} scenes")
        return
    check_index("scene", scene, x)


def check_particles(x: Tensor, blocks: Any) -> None:
    """Check that positions belong to the particles of an activation, as far as their number shows."""
    check_positions(x, blocks.grid.dim, None, 1)
    if x.shape[0] != blocks.index.shape[0]:
        expected = f"[P, D] = [{blocks.index.shape[0]}, {blocks.grid.dim}]"
        raise ValueError(f"x must have the shape of the positions that were activated, {expected}, got {shape_of(x)}")
    check_positions(x, blocks.grid.dim, blocks.scene, blocks.grid.scenes)


def check_index(name: str, index: Tensor | None, x: Tensor, dtype: torch.dtype = torch.int32, of: str = "x") -> None:
    """Check an optional integer per particle [P] against a particle tensor that messages call `of`."""
    if index is None:
        return
    if not isinstance(index, Tensor) or index.shape != x.shape[:1]:
        raise ValueError(f"{name} must have shape [{x.shape[0]}], got {shape_of(index)}")
    if index.dtype != dtype:
        raise TypeError(f"{name} must be {str(dtype).removeprefix('torch.')}, got {index.dtype}")
    if index.device != x.device:
        raise ValueError(f"{name} must be on the device of {of}, {x.device}, got {index.device}")


def check_like(
    name: str, value: Tensor | None, x: Tensor, shape: tuple[int, ...], symbols: str, needed: bool = False
) -> None:
    """Check a floating tensor against x, which may be absent unless it is `needed`; `symbols` names its shape in the
    message.
    """
    if value is None and not needed:
        return
    if not isinstance(value, Tensor) or value.shape != shape:
        raise ValueError(f"{name} must have shape {symbols} = {list(shape)}, got {shape_of(value)}")
    if value.dtype != x.dtype:
        raise TypeError(f"{name} must have the dtype of x, {x.dtype}, got {value.dtype}")
    if value.device != x.device:
        raise ValueError(f"{name} must be on the device of x, {x.device}, got {value.device}")
