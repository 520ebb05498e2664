"""Polygons revolved about an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ...errors import check_number, check_vector, shape_of
from .. import surface_mesh
from ..surface_mesh import Array, SurfaceMesh
from ..values import Value, direction, finite, numbers_of, shape_of_value
from ..vectors import norm, unit
from .base import Faces, SceneKey, SceneWords, Shape, in_meridian, perpendicular, split_along


def _checked_outline(name: str, outline: Any) -> Any:
    """Polygon around the axis, anticlockwise; a tensor must be so."""
    expected = f"{name} must be at least 3 pairs (distance >= 0, position along the axis)"
    if isinstance(outline, Tensor) and outline.requires_grad:
        raise ValueError(f"{name} must not require grad: which nodes are inside is not differentiable")
    value = finite(name, outline)
    shape = shape_of_value(value)
    if len(shape) != 2 or shape[0] < 3 or shape[1] != 2:
        raise ValueError(f"{expected}, got {shape_of(outline) if isinstance(outline, Tensor) else outline}")
    numbers = numbers_of(value)
    corners = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    if not corners:  # A tensor whose values are not read.
        return value
    if min(distance for distance, _ in corners) < 0:
        raise ValueError(f"{expected}, got {outline}")
    area = _polygon_area(corners)
    if area == 0:
        raise ValueError(f"{name} must enclose an area, got {outline}")
    if isinstance(value, Tensor):
        if area < 0:
            raise ValueError(f"{name} as a tensor must be anticlockwise, got {outline}")
        return value
    return corners if area > 0 else corners[::-1]


def _checked_axis(name: str, axis: Any) -> Any:
    return None if axis is None else direction(name, axis)


class Revolved(Shape):
    """Polygon revolved about an axis: a cone, a tube, a funnel, an hourglass, a drum. In 2-D, the polygon and its
    mirror image.

    Args:
        outline: corners of the polygon, K pairs of distance from the axis (≥ 0) and position along it [m] from the
            origin; without self-intersections. As a tensor [K, 2], anticlockwise.
        axis: direction of the axis: D numbers, or a tensor [D] or [B, D]; y by default.
    """

    name = "revolved"
    RANKS: ClassVar = {"axis": 1}
    CHECKS: ClassVar = {"outline": _checked_outline, "axis": _checked_axis}
    arguments = ("outline", "axis")
    number, vector = 4, "axis"
    words = SceneWords(
        "Polygon revolved about an axis: cone, tube, funnel, hourglass, drum; in 2-D the polygon and its mirror image.",
        {
            "outline": SceneKey("outline", "corners of the polygon: distance from the axis and position along it [m]"),
            "center": SceneKey("point", "origin of the positions along the axis [m]"),
            "axis": SceneKey("vector", "direction of the axis; by default y", optional=True),
        },
    )

    def __init__(self, outline: Sequence[Sequence[float]] | Tensor, axis: Value | None = None) -> None:
        self.outline, self.axis = outline, axis

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The normal is that of the nearest edge of the polygon, also where a reentrant corner is nearest."""
        axis, along, across = self._split(x, scene)
        distance, normal = self._polygon(torch.cat([norm(across)[:, None], along], 1))
        return distance, in_meridian(normal, across, axis)

    def surface_faces(self, x: Tensor, scene: Tensor | None = None) -> Faces:
        """One of each edge of the polygon; those on the axis, which are inside the body, are infinitely high. An edge
        that leads to a tip, a point of the axis, has one beyond the axis, too: they join there. Near a tip both are
        planes in the meridian of a point."""
        axis, along, across = self._split(x, scene)
        a = self.parameter("outline", x, (len(self.outline), 2))
        edge = a.roll(-1, 0) - a
        size = norm(edge)
        plane = unit(torch.stack([edge[:, 1], -edge[:, 0]], 1))
        hidden = ((a[:, 0] == 0) & (edge[:, 0] == 0)) | (size == 0)
        to_tip = ((a[:, 0] == 0) != (a.roll(-1, 0)[:, 0] == 0)) & (edge[:, 1] != 0)
        radius, along_axis = norm(across)[:, None], axis.expand_as(x)[:, None]
        on_axis = (radius == 0)[..., None]
        away = torch.where(on_axis & to_tip[:, None], perpendicular(along_axis), unit(across)[:, None])
        found = []
        for side, missing in ((1, hidden), (-1, ~to_tip))[: 2 if self._has_tips() else 1]:
            arm = torch.cat([side * radius, along], 1)[:, None] - a
            foot = (arm * edge).sum(2) / torch.where(size > 0, size, 1)
            normal = side * plane[:, :1] * away + plane[:, 1:] * along_axis
            found.append(
                (
                    torch.where(missing, torch.inf, (arm * plane).sum(2)),
                    torch.where(on_axis, unit(normal), normal),
                    torch.maximum(-foot, foot - size).clamp_min(0),
                    torch.where(to_tip, radius, torch.inf),
                )
            )
        height, normal, beyond, flat = (torch.cat(parts, 1) for parts in zip(*found, strict=True))
        return Faces(height, normal, beyond, True if x.shape[1] == 2 else flat)

    def _has_tips(self) -> bool:
        """Whether edges lead to tips; always where the outline is a tensor, whose values are not read."""
        if isinstance(self.outline, Tensor):
            return True
        ends = zip(self.outline, [*self.outline[1:], self.outline[0]], strict=True)
        return any((a[0] == 0) != (b[0] == 0) and a[1] != b[1] for a, b in ends)

    def _split(self, x: Tensor, scene: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """The axis [D] or [N, D], positions along it [N, 1], and the rest of x [N, D]."""
        axis = unit(self.at_nodes("axis", x, x.shape[1:], scene))
        return axis, *split_along(x, axis)

    def _polygon(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance [N] of points [N, 2] from the polygon, and outward normal [N, 2] of the nearest edge."""
        a = self.parameter("outline", p, (len(self.outline), 2))
        edge = a.roll(-1, 0) - a
        arm = p[:, None] - a
        along = ((arm * edge).sum(2) / (edge * edge).sum(1))[..., None]
        # From a corner the distance is that to the next edge, so that both are the same and the first edge counts.
        offset = norm(torch.where(along < 1, arm - along.clamp_min(0) * edge, arm.roll(-1, 1)))
        # An edge on the axis is inside the body.
        on_axis = (a[:, 0] == 0) & (edge[:, 0] == 0)
        nearest = torch.where(on_axis, torch.inf, offset).argmin(1, keepdim=True)
        # An odd number of edges is crossed by the ray from the point away from the axis.
        straddles = (a[:, 1] > p[:, 1:]) != (a.roll(-1, 0)[:, 1] > p[:, 1:])
        crossing = straddles & ((edge[:, 0] * arm[..., 1] - edge[:, 1] * arm[..., 0]) * edge[:, 1].sign() > 0)
        inside = crossing.sum(1) % 2 == 1
        distance = offset.gather(1, nearest)[:, 0]
        normal = unit(torch.stack([edge[:, 1], -edge[:, 0]], 1))[nearest[:, 0]]
        return torch.where(inside, -distance, distance), normal

    def parameter(self, name: str, like: Tensor, shape: tuple[int, ...]) -> Tensor:
        if name == "axis" and self.axis is None:
            return torch.eye(shape[0], dtype=like.dtype, device=like.device)[1]
        return super().parameter(name, like, shape)

    def volume(self, dim: int, scene: int = 0) -> float:
        corners = self.of_scene("outline", 2, 0).tolist()
        if dim == 2:
            return 2 * _polygon_area(corners)
        # ∮ π r² dz over the edges
        edges = zip(corners, corners[1:] + corners[:1], strict=True)
        return math.pi / 3 * sum((q[1] - p[1]) * (p[0] * p[0] + p[0] * q[0] + q[0] * q[0]) for p, q in edges)

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        axis = torch.from_numpy(self._unit_axis(dim, scene))
        radius, height = self.of_scene("outline", 2, 0)[:, :, None].unbind(1)
        reach = radius * (1 - axis.square()).clamp_min(0).sqrt()
        return (height * axis - reach).amin(0), (height * axis + reach).amax(0)

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return surface_mesh.ring(self.of_scene("outline", 2, 0).numpy(), self._unit_axis(len(lower), scene))

    def _unit_axis(self, dim: int, scene: int) -> Array:
        if self.axis is None:
            return np.eye(dim)[1]
        axis = self.of_scene("axis", 1, scene).numpy()
        return axis / np.linalg.norm(axis)

    def thinnest_wall(self) -> float:
        values = numbers_of(self.value_of("outline"))
        return _thinnest_of_polygon(list(zip(values[::2], values[1::2], strict=True)))

    def data_count(self) -> int:
        return 2 * len(self.outline)

    def data(self, like: Tensor) -> Tensor:
        """The corners."""
        return self.parameter("outline", like, (len(self.outline), 2)).reshape(-1)

    @classmethod
    def from_row(cls, vector: Tensor, radius: Tensor, data: Tensor) -> Shape:
        return Revolved(data.reshape(-1, 2), vector)


class Cylinder(Revolved):
    """A solid cylinder with flat ends around the origin; 3-D only.

    Args:
        half_axis: centre of one end [m], 3 numbers. The other end is opposite.
        radius: [m], positive.
    """

    name = "cylinder"
    number = 4  # a revolved rectangle

    def __init__(self, half_axis: Sequence[float], radius: float) -> None:
        axis = check_vector("half_axis", direction("half_axis", half_axis))
        if len(axis) != 3:
            raise ValueError("a cylinder needs three dimensions; in 2-D use a sphere (a disc) or a box")
        check_number("radius", radius, "positive", lambda v: 0 < v < math.inf)
        half = math.hypot(*axis)
        super().__init__(((0, -half), (radius, -half), (radius, half), (0, half)), axis)


def _polygon_area(corners: Sequence[Sequence[float]]) -> float:
    """Signed area, positive if anticlockwise."""
    edges = zip(corners, [*corners[1:], corners[0]], strict=True)
    return 0.5 * sum(a[0] * b[1] - b[0] * a[1] for a, b in edges)


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
