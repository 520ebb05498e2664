"""Rings."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ...cuda_graphs.capture import is_readable
from .. import surface_mesh
from ..surface_mesh import Array, SurfaceMesh
from ..values import Value, direction, extent
from ..vectors import norm, unit
from .base import Faces, SceneKey, SceneWords, Shape, around_origin, ball_volume, in_meridian, one_face, split_along


class Torus(Shape):
    """All points within a radius of a circle around the origin; in 2-D two discs.

    Args:
        ring: axis of the circle, as long as the radius of the circle [m]: D numbers, or a tensor [D] or [B, D].
        radius: [m], a number, or a tensor [] or [B]; below the radius of the circle.
    """

    name = "torus"
    RANKS: ClassVar = {"ring": 1, "radius": 0}
    CHECKS: ClassVar = {"ring": direction, "radius": extent}
    arguments = ("ring", "radius")
    is_smooth = True
    number, vector = 6, "ring"
    words = SceneWords(
        "Ring: all points near a circle; in 2-D two discs.",
        {
            "center": SceneKey("point", "centre of the circle [m]"),
            "axis": SceneKey("vector", "direction of the axis of the circle"),
            "ring_radius": SceneKey("length", "radius of the circle [m]"),
            "radius": SceneKey("length", "distance from the circle [m]; below its radius"),
        },
    )

    def __init__(self, ring: Value, radius: float | Tensor) -> None:
        self.ring, self.radius = ring, radius
        given = self.value_of("ring"), self.value_of("radius")
        if all(is_readable(value) for value in given if isinstance(value, Tensor)):
            axis, small = (torch.as_tensor(value, dtype=torch.float64, device="cpu").detach() for value in given)
            circle = axis.norm(dim=-1)
            if not bool((small < circle).all()):
                raise ValueError(f"radius must be below that of the circle, {circle.tolist()} m, got {radius}")

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        ring = self.at_nodes("ring", x, x.shape[1:], scene)
        axis = unit(ring)
        along, across = split_along(x, axis)
        offset = torch.cat([norm(across)[:, None] - norm(ring).unsqueeze(-1), along], 1)
        normal = unit(offset)
        distance = norm(offset) - self.at_nodes("radius", x, (), scene)
        return distance, in_meridian(normal, across, axis)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        return one_face(*self.surface(x, scene), False)

    def volume(self, dim: int, scene: int = 0) -> float:
        """By Pappus's theorem."""
        section = ball_volume(2, float(self.of_scene("radius", 0, scene)))
        return section * (2 if dim == 2 else 2 * math.pi * float(self.of_scene("ring", 1, scene).norm()))

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        ring, radius = self.of_scene("ring", 1, scene), self.of_scene("radius", 0, scene)
        return around_origin((ring.square().sum() - ring.square()).clamp_min(0).sqrt() + radius)

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        ring, radius = self.of_scene("ring", 1, scene).numpy(), float(self.of_scene("radius", 0, scene))
        away, angle = np.linalg.norm(ring), np.linspace(0, 2 * np.pi, surface_mesh.TURNS, endpoint=False)
        outline = np.stack([away + radius * np.cos(angle), radius * np.sin(angle)], 1)
        return surface_mesh.ring(outline, ring / away)

    @classmethod
    def from_words(cls, words: Any) -> tuple[Shape, Any]:
        size = words.ring_radius / math.hypot(*direction("axis", words.axis))
        return cls([size * a for a in words.axis], words.radius), words.center
