"""Obstacles of the scenes of data sets on uniform grids, for models on grids."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter, ValidationError
from torch import Tensor

from ..boundaries import Obstacle
from ..scene import schema
from ..scene.places import obstacle
from .frame_transfer import Array

_OBSTACLE: TypeAdapter[Any] = TypeAdapter(schema.AnyObstacle)


def obstacles_of(words: dict[str, Any]) -> list[Obstacle]:
    """Obstacles of a scene file.

    Raises:
        ValueError: for words that are not an obstacle.
    """
    try:
        return [obstacle(_OBSTACLE.validate_python(item), None) for item in words.get("obstacle", [])]
    except (ValidationError, TypeError) as error:
        raise ValueError(f"obstacle: {error}") from None


def obstacle_mask(obstacles: Sequence[Obstacle], centres: Sequence[Tensor], times: Array) -> Array:
    """Cells whose centre is inside an obstacle.

    Args:
        obstacles: obstacles of one scene.
        centres: coordinates of the cells along each axis [m].
        times: times of the frames [T] [s].

    Returns:
        float32 [T, X, Y(, Z)], 1 inside and 0 outside.
    """
    points = torch.cartesian_prod(*centres)
    mask = np.zeros((len(times), *map(len, centres)), np.float32)
    for body in obstacles:
        inside: Array | None = None
        for k, time in enumerate(times.tolist()):
            if inside is None or body.reads_time:
                inside = body.contains(points, None, time).reshape(mask.shape[1:]).numpy()
            mask[k][inside] = 1
    return mask
