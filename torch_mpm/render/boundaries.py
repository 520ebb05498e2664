"""Shapes to draw for the obstacles of a simulation at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..geometry.surface_mesh import Array, SurfaceMesh
from .cloud import contour
from .colors import numpy_of
from .requires import require
from .shapes import GREY, Shape

LEVEL_CELLS = 96
"""Number of cells along the longest side of the domain for shapes that are defined by their distance only."""


def obstacle_shapes(
    obstacle: Any,
    time: float,
    bounds: tuple[npt.ArrayLike, npt.ArrayLike],
    scene: int = 0,
    color: tuple[float, float, float] = GREY,
) -> list[Shape]:
    """Shapes of a `torch_mpm.boundaries.Obstacle` at `time` [s] in scene `scene`: empty while it does not act.

    Infinite shapes are clipped to the domain `bounds` (lower [D], upper [D]).
    """
    lower, upper = (np.asarray(b, dtype=np.float64) for b in bounds)
    absent = not obstacle.start <= time < obstacle.end or obstacle.scene not in (None, scene)
    if absent:
        return []
    pose = obstacle.pose(time)
    at, turn = _of_scene(pose.centre, 1, scene), _of_scene(pose.rotation, 2, scene)
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), -1).reshape(-1, len(lower))
    body = (corners - at) @ turn
    pieces = obstacle.shape.mesh(body.min(0), body.max(0), scene)
    if pieces is None:
        at, turn, pieces = np.zeros(len(lower)), np.eye(len(lower)), _zero_level(obstacle.shape, lower, upper, at, turn)
    return [Shape(piece.vertices, piece.faces, at, turn, color) for piece in pieces]


def _of_scene(value: Any, rank: int, scene: int) -> Array:
    """A parameter of `rank` dimensions, or one per scene, as float64 for `scene`."""
    array = numpy_of(value).astype(np.float64)
    return array if array.ndim == rank else array[scene if len(array) > 1 else 0]


def _zero_level(shape: Any, lower: Array, upper: Array, at: Array, turn: Array) -> list[SurfaceMesh]:
    """Zero level of the distance of a shape at a pose, in world coordinates."""
    torch = require("torch")
    step = float(np.max(upper - lower)) / LEVEL_CELLS
    axes = [np.arange(a - 2 * step, b + 2.5 * step, step) for a, b in zip(lower, upper, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    with torch.no_grad():
        body = torch.as_tensor((nodes.reshape(-1, len(lower)) - at) @ turn, device="cpu")
        field = numpy_of(shape.signed_distance(body)).reshape(nodes.shape[:-1])
    if len(lower) == 2:
        return [SurfaceMesh(ring, None) for ring in require("contourpy").contour_generator(*axes, field.T).lines(0.0)]
    vertices, faces, _, _ = contour(-field, 0.0, step, np.array([a[0] for a in axes]))
    return [SurfaceMesh(vertices, faces)] if len(faces) else []
