"""Planes, balls, boxes and capsules."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ...ops.pointwise import fuses, pointwise
from .. import surface_mesh
from ..surface_mesh import Array, SurfaceMesh
from ..values import Value, constant, direction, extent, numbers_of
from ..vectors import norm, unit
from .base import Faces, SceneKey, SceneWords, Shape, around_origin, ball_volume, one_face


class Plane(Shape):
    """Half-space behind a plane through the origin.

    Args:
        normal: direction out of the half-space: D numbers, or a tensor [D] or [B, D]; of any length but zero.
    """

    name = "plane"
    RANKS: ClassVar = {"normal": 1}
    CHECKS: ClassVar = {"normal": direction}
    arguments = ("normal",)
    is_smooth = is_convex = True
    number, vector = 0, "normal"
    words = SceneWords(
        "Half-space behind a plane.",
        {
            "center": SceneKey("point", "a point of the plane [m]"),
            "normal": SceneKey("vector", "direction out of the half-space"),
        },
    )

    normal: Any  # Numbers or a tensor.

    def __init__(self, normal: Value) -> None:
        self.normal = normal

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        normal = unit(self.at_nodes("normal", x, x.shape[1:], scene))
        return (x * normal).sum(1), normal.expand_as(x)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        return one_face(*self.surface(x, scene), True)

    def volume(self, dim: int, scene: int = 0) -> float:
        return math.inf

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return around_origin(torch.full((dim,), math.inf, dtype=torch.float64))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        normal = self.of_scene("normal", 1, scene).numpy()
        middle = 0.5 * (lower + upper)
        foot = middle - (middle @ normal) / (normal @ normal) * normal
        return [surface_mesh.plate(foot, normal, float(np.linalg.norm(upper - lower)))]


class Sphere(Shape):
    """A ball around the origin; a disc in 2-D.

    Args:
        radius: [m], a number, or a tensor [] or [B].
    """

    name = "sphere"
    RANKS: ClassVar = {"radius": 0}
    CHECKS: ClassVar = {"radius": extent}
    arguments = ("radius",)
    is_smooth = is_convex = True
    number = 1
    words = SceneWords(
        "Ball; a disc in 2-D.",
        {"center": SceneKey("point", "centre [m]"), "radius": SceneKey("length", "radius [m]")},
    )

    def __init__(self, radius: float | Tensor) -> None:
        self.radius = radius

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return self.signed_distance(x, scene), unit(x)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        return one_face(*self.surface(x, scene), False)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        return norm(x) - self.at_nodes("radius", x, (), scene)

    def contains(self, x: Tensor) -> Tensor:
        return norm(x) <= self.at_nodes("radius", x, (), None)

    def volume(self, dim: int, scene: int = 0) -> float:
        return ball_volume(dim, float(self.of_scene("radius", 0, scene)))

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return around_origin(self.of_scene("radius", 0, scene).expand(dim))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return [surface_mesh.capsule(0.0, float(self.of_scene("radius", 0, scene)), np.eye(len(lower))[1])]


class Box(Shape):
    """A box around the origin with edges along the axes.

    Args:
        size: edge lengths [m]: D numbers, or a tensor [D] or [B, D].
    """

    name = "box"
    RANKS: ClassVar = {"size": 1}
    CHECKS: ClassVar = {"size": extent}
    arguments = ("size",)
    is_convex = True
    number, vector = 2, "size"
    words = SceneWords(
        "Box, turned by its rotation.",
        {"center": SceneKey("point", "centre [m]"), "size": SceneKey("vector", "edge lengths [m]")},
    )

    def __init__(self, size: Value) -> None:
        self.size = size

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The normal is that of the nearest face, inside the one of the axis with the least negative distance."""
        depth = self._depth(x, scene)
        nearest = torch.arange(x.shape[1], device=x.device) == depth.argmax(1, keepdim=True)
        return self._distance(depth), nearest * torch.where(x < 0, -1, 1).to(x.dtype)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        """The lower and the upper one of each axis in turn."""
        half = 0.5 * self.at_nodes("size", x, x.shape[1:], scene)
        height = torch.stack([-x - half, x - half], 2).flatten(1)
        axes = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
        normal = torch.stack([-axes, axes], 1).flatten(0, 1)
        return Faces(height, normal.expand(len(x), -1, -1), torch.zeros_like(height), True)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        size = self.at_nodes("size", x, x.shape[1:], scene)
        if fuses(x, size):
            return pointwise("box_distance", x.shape[1], x, size)[0]
        return self._distance(self._depth(x, scene))

    def contains(self, x: Tensor) -> Tensor:
        return (self._depth(x, None) <= 0).all(1)

    def _depth(self, x: Tensor, scene: Tensor | None) -> Tensor:
        """Distances of points behind the faces of each axis [N, D] [m], negative inside."""
        return x.abs() - 0.5 * self.at_nodes("size", x, x.shape[1:], scene)

    def _distance(self, depth: Tensor) -> Tensor:
        """Normal by the distances behind the faces."""
        return norm(depth.clamp_min(0)) + depth.amax(1).clamp_max(0)

    def volume(self, dim: int, scene: int = 0) -> float:
        return float(self.of_scene("size", 1, scene).prod())

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return around_origin(0.5 * self.of_scene("size", 1, scene))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return [surface_mesh.cuboid(self.of_scene("size", 1, scene).numpy())]

    def thinnest_wall(self) -> float:
        return min(numbers_of(self.value_of("size")), default=math.inf)

    @classmethod
    def from_row(cls, vector: Tensor, radius: Tensor, data: Tensor) -> Box:
        return cls(vector.detach())


class Capsule(Shape):
    """All points within a radius of a segment around the origin.

    Args:
        half_axis: one end of the segment [m]: D numbers, or a tensor [D] or [B, D]. The other end is opposite.
        radius: [m], a number, or a tensor [] or [B].
    """

    name = "capsule"
    RANKS: ClassVar = {"half_axis": 1, "radius": 0}
    CHECKS: ClassVar = {"half_axis": constant, "radius": extent}
    arguments = ("half_axis", "radius")
    is_smooth = is_convex = True
    number, vector = 3, "half_axis"
    words = SceneWords(
        "All points near a segment.",
        {
            "a": SceneKey("point", "one end of the segment [m]"),
            "b": SceneKey("point", "other end of the segment [m]"),
            "radius": SceneKey("length", "distance from the segment [m]"),
        },
    )

    def __init__(self, half_axis: Value, radius: float | Tensor) -> None:
        self.half_axis, self.radius = half_axis, radius

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        offset = self._offset(x, scene)
        return self._distance(offset, scene), unit(offset)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        return one_face(*self.surface(x, scene), False)

    def signed_distance(self, x: Tensor, scene: Tensor | None = None) -> Tensor:
        return self._distance(self._offset(x, scene), scene)

    def _distance(self, offset: Tensor, scene: Tensor | None) -> Tensor:
        return norm(offset) - self.at_nodes("radius", offset, (), scene)

    def _offset(self, x: Tensor, scene: Tensor | None) -> Tensor:
        """Vectors from the nearest points of the segment to points [N, D] [m]."""
        axis = self.at_nodes("half_axis", x, x.shape[1:], scene)
        squared = (axis * axis).sum(-1, keepdim=True)
        along = (x * axis).sum(1, keepdim=True) / torch.where(squared > 0, squared, 1)
        return x - along.clamp(-1, 1) * axis

    def volume(self, dim: int, scene: int = 0) -> float:
        radius = float(self.of_scene("radius", 0, scene))
        length = 2 * float(self.of_scene("half_axis", 1, scene).norm())
        return ball_volume(dim - 1, radius) * length + ball_volume(dim, radius)

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return around_origin(self.of_scene("half_axis", 1, scene).abs() + self.of_scene("radius", 0, scene))

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        half = self.of_scene("half_axis", 1, scene).numpy()
        length = float(np.linalg.norm(half))
        axis = half / length if length > 0 else np.eye(len(lower))[1]
        return [surface_mesh.capsule(length, float(self.of_scene("radius", 0, scene)), axis)]

    @classmethod
    def from_words(cls, words: Any) -> tuple[Shape, Any]:
        half = [0.5 * (q - p) for p, q in zip(words.a, words.b, strict=True)]
        return cls(half, words.radius), [0.5 * (p + q) for p, q in zip(words.a, words.b, strict=True)]
