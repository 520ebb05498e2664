"""From the simulation's obstacles at a time to the shapes that are drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from . import shapes
from .cloud import contour
from .colors import numpy_of
from .requires import require
from .shapes import GREY, Array, Shape

SDF_CELLS = 96  # along the longest side of the domain


def obstacle_shapes(
    obstacle: Any,
    time: float,
    bounds: tuple[npt.ArrayLike, npt.ArrayLike],
    scene: int = 0,
    color: tuple[float, float, float] = GREY,
) -> list[Shape]:
    """Shapes of a `torch_mpm.boundaries.Obstacle` at `time` [s] in scene `scene`: empty while it does not act.

    A plane is drawn as a plate as large as the domain `bounds` (lower [D], upper [D]); an SDF as its zero level there.

    Raises:
        ValueError: the obstacle has a shape that is not known here.
    """
    lower, upper = (np.asarray(b, dtype=np.float64) for b in bounds)
    absent = not obstacle.start <= time < obstacle.end or obstacle.scene not in (None, scene)
    if absent:
        return []
    pose = obstacle.pose(time)
    dim = len(lower)
    at, turn = _of_scene(pose.centre, 1, scene), _of_scene(pose.rotation, 2, scene)
    extents = obstacle.extents()
    if obstacle.shape == "plane":
        normal = turn @ _of_scene(extents["normal"], 1, scene)
        middle = 0.5 * (lower + upper)
        foot = middle - ((middle - at) @ normal) / (normal @ normal) * normal
        return [shapes.plane(foot, normal, float(np.linalg.norm(upper - lower)), color)]
    if obstacle.shape == "sphere":
        return [shapes.sphere(np.zeros(dim), float(_of_scene(extents["radius"], 0, scene)), color).moved(at, turn)]
    if obstacle.shape == "box":
        return [shapes.box(at, _of_scene(extents["size"], 1, scene), turn, color)]
    if obstacle.shape == "capsule":
        half = _of_scene(extents["half_axis"], 1, scene)
        return [shapes.capsule(-half, half, float(_of_scene(extents["radius"], 0, scene)), color).moved(at, turn)]
    if obstacle.shape == "revolved":
        axis = np.eye(dim)[1] if extents["axis"] is None else _of_scene(extents["axis"], 1, scene)
        outline = np.asarray(extents["outline"], dtype=np.float64)
        return [s.moved(at, turn) for s in shapes.ring(outline, np.zeros(dim), axis / np.linalg.norm(axis), color)]
    if obstacle.shape == "sdf":
        return _zero_level(extents["distance"], lower, upper, at, turn, color)
    raise ValueError(f"obstacle.shape must be plane, sphere, box, capsule, revolved or sdf, got {obstacle.shape!r}")


def _of_scene(value: Any, rank: int, scene: int) -> Array:
    """A parameter of `rank` dimensions, or one per scene, as float64 for `scene`."""
    array = numpy_of(value).astype(np.float64)
    return array if array.ndim == rank else array[scene if len(array) > 1 else 0]


def _zero_level(
    distance: Any, lower: Array, upper: Array, at: Array, turn: Array, color: tuple[float, float, float]
) -> list[Shape]:
    torch = require("torch")
    step = float(np.max(upper - lower)) / SDF_CELLS
    axes = [np.arange(a - 2 * step, b + 2.5 * step, step) for a, b in zip(lower, upper, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    with torch.no_grad():
        body = torch.as_tensor((nodes.reshape(-1, len(lower)) - at) @ turn, device="cpu")
        field = numpy_of(distance(body)).reshape(nodes.shape[:-1])
    if len(lower) == 2:
        rings = require("contourpy").contour_generator(*axes, field.T).lines(0.0)
        return [shapes.mesh(ring, color=color) for ring in rings]
    vertices, faces, _, _ = contour(-field, 0.0, step, np.array([a[0] for a in axes]))
    return [shapes.mesh(vertices, faces, color=color)] if len(faces) else []
