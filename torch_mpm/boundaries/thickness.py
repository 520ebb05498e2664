"""Walls that are too thin for the grid: what material on one side does to the nodes of the other."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor

from ..errors import ThinWallWarning
from ..geometry import shapes
from .obstacles import Obstacle

LEAST = 4.0
"""Thickness of a wall in dx below which it is reported: the nodes that material at it sees on both sides, two each."""


def thinnest(shape: shapes.Shape) -> float:
    """Thickness of the thinnest wall of a box or a revolved shape [m], as far as numbers or tensors on the CPU show it;
    infinite for other shapes, which may be thin on purpose."""
    if isinstance(shape, shapes.Box):
        return min(_numbers(shape.size), default=math.inf)
    if isinstance(shape, shapes.Revolved):
        values = _numbers(shape.outline)
        return _thinnest_of_polygon(list(zip(values[::2], values[1::2], strict=True)))
    return math.inf


def thin_walls(boundaries: Sequence[Any], dx: float) -> Iterator[str]:
    """A sentence about each obstacle that is thinner than `LEAST`."""
    for number, boundary in enumerate(boundaries):
        if isinstance(boundary, Obstacle) and (found := thinnest(boundary.shape)) < LEAST * dx * (1 - 1e-6):
            yield (
                f"obstacle {number} ({boundary.shape.name}) is {found / dx:.2g} dx thick where it is thinnest, and "
                f"material passes through walls that are thinner than {LEAST:g} dx unless another obstacle is behind: "
                f"make it {LEAST * dx:.3g} m thick, or refine the grid"
            )


def warn_of_thin_walls(boundaries: Sequence[Any], dx: float) -> None:
    for found in thin_walls(boundaries, dx):
        warnings.warn(found, ThinWallWarning, stacklevel=4)


def _numbers(value: Any) -> list[float]:
    if isinstance(value, Tensor):
        return [] if value.device.type != "cpu" else value.detach().double().reshape(-1).tolist()
    return [number for item in value for number in (_numbers(item) if hasattr(item, "__len__") else [float(item)])]


def _thinnest_of_polygon(corners: Sequence[tuple[float, float]]) -> float:
    """The least way through an anticlockwise polygon from the middle of an edge, straight in; what lies on the axis is
    as thick again on its other side."""
    edges = list(zip(corners, [*corners[1:], *corners[:1]], strict=True))
    least = math.inf
    for start, end in edges:
        size = math.dist(start, end)
        if size == 0 or start[0] == end[0] == 0:
            continue
        middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]))
        inward = ((start[1] - end[1]) / size, (end[0] - start[0]) / size)
        for other in edges:
            way = _crossing(middle, inward, *other)
            if way is not None and way > 1e-9 * size:
                least = min(least, 2 * way if other[0][0] == other[1][0] == 0 else way)
    return least


def _crossing(
    point: tuple[float, float], direction: tuple[float, float], a: tuple[float, float], b: tuple[float, float]
) -> float | None:
    """How far a ray goes from a point to a segment; None where it misses that."""
    edge = (b[0] - a[0], b[1] - a[1])
    determinant = direction[0] * edge[1] - direction[1] * edge[0]
    if determinant == 0:
        return None
    arm = (a[0] - point[0], a[1] - point[1])
    way = (arm[0] * edge[1] - arm[1] * edge[0]) / determinant
    along = (arm[0] * direction[1] - arm[1] * direction[0]) / determinant
    return way if way > 0 and 0 <= along <= 1 else None
