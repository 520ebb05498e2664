"""Errors with a message that says what to do, and the checks of arguments that many functions share."""

from __future__ import annotations

import torch
from torch import Tensor

FLOATING = (torch.float32, torch.float64)


class SimulationError(RuntimeError):
    """The state of a simulation is no longer meaningful: a particle left the grid, is not finite, or is inverted."""


class GridOverflowError(SimulationError):
    """More blocks are active than the grid has room for."""


class DamagedFileError(ValueError):
    """A file of a run is damaged, was changed by another program, or is of another kind."""

    def __init__(self, path: object, problem: str, remedy: str) -> None:
        super().__init__(f"{path}: {problem}; {remedy}")


def shape_of(x: object) -> str:
    return str(list(x.shape)) if isinstance(x, Tensor) else type(x).__name__


def check_positions(x: Tensor, dim: int, scene: Tensor | None, scenes: int) -> None:
    if not isinstance(x, Tensor) or x.dim() != 2 or x.shape[1] != dim:
        raise ValueError(f"x must have shape [P, {dim}], got {shape_of(x)}")
    if x.dtype not in FLOATING:
        raise TypeError(f"x must be float32 or float64, got {x.dtype}")
    if scene is None:
        if scenes != 1:
            raise ValueError(f"scene must be given, int32 [P], for a grid of {scenes} scenes")
        return
    if scene.shape != x.shape[:1]:
        raise ValueError(f"scene must have shape [{x.shape[0]}], got {shape_of(scene)}")
    if scene.dtype != torch.int32:
        raise TypeError(f"scene must be int32, got {scene.dtype}")
    if scene.device != x.device:
        raise ValueError(f"scene must be on the device of x, {x.device}, got {scene.device}")


def check_like(name: str, value: Tensor | None, x: Tensor, shape: tuple[int, ...], symbols: str) -> None:
    """Check an optional floating tensor against x; `symbols` names its shape in the message."""
    if value is None:
        return
    if not isinstance(value, Tensor) or value.shape != shape:
        raise ValueError(f"{name} must have shape {symbols} = {list(shape)}, got {shape_of(value)}")
    if value.dtype != x.dtype:
        raise TypeError(f"{name} must have the dtype of x, {x.dtype}, got {value.dtype}")
    if value.device != x.device:
        raise ValueError(f"{name} must be on the device of x, {x.device}, got {value.device}")
