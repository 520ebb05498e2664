"""Rigid bodies in pictures: a triangle mesh (3-D) or an outline (2-D) in body coordinates, and a pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..geometry import surface_mesh
from ..geometry.surface_mesh import Array, SurfaceMesh, frame_of

GREY = (0.62, 0.64, 0.68)


@dataclass(frozen=True)
class Shape:
    """A rigid shape at a pose: world = position + rotation @ body.

    `vertices` [V, D] in metres, `faces` int [T, 3] (3-D triangles) or None (2-D, the vertices are a closed outline),
    `position` [D], `rotation` [D, D], `color` RGB and `opacity` in 0..1. Made by `plane`, `box`, `sphere`, `capsule`,
    `cylinder` and `mesh` below.
    """

    vertices: Array
    faces: Array | None
    position: Array
    rotation: Array
    color: tuple[float, float, float] = GREY
    opacity: float = 1.0

    def posed(self, position: npt.ArrayLike, rotation: npt.ArrayLike | None = None) -> Shape:
        """The same shape at another `position` [D] and `rotation` ([D, D] matrix, or an angle in radians in 2-D)."""
        turned = self.rotation if rotation is None else rotation_matrix(rotation, self.dim)
        return replace(self, position=vector("position", position, self.dim), rotation=turned)

    def moved(self, position: npt.ArrayLike, rotation: npt.ArrayLike) -> Shape:
        """The shape after a rigid motion of the world: x becomes position + rotation @ x."""
        turn, shift = rotation_matrix(rotation, self.dim), vector("position", position, self.dim)
        return replace(self, position=shift + turn @ self.position, rotation=turn @ self.rotation)

    @property
    def dim(self) -> int:
        return int(self.vertices.shape[1])

    def world(self) -> Array:
        """Vertices [V, D] in world coordinates."""
        return self.position + self.vertices @ self.rotation.T


def vector(name: str, value: npt.ArrayLike, dim: int | None = None) -> Array:
    """`value` as float64 [D]."""
    out = np.asarray(value, dtype=np.float64)
    if out.ndim != 1 or out.shape[0] not in ((2, 3) if dim is None else (dim,)):
        raise ValueError(f"{name} must have shape [{dim or '2 or 3'}], got {list(out.shape)}")
    return out


def rotation_matrix(rotation: npt.ArrayLike, dim: int) -> Array:
    """Rotation matrix [D, D]; in 2-D also given as an angle in radians."""
    out = np.asarray(rotation, dtype=np.float64)
    if out.ndim == 0 and dim == 2:
        return np.array([[np.cos(out), -np.sin(out)], [np.sin(out), np.cos(out)]])
    if out.shape != (dim, dim):
        raise ValueError(f"rotation must have shape [{dim}, {dim}], got {list(out.shape)}")
    return out


def plane(point: npt.ArrayLike, normal: npt.ArrayLike, size: float, color: tuple[float, float, float] = GREY) -> Shape:
    """Plate of side `size` [m] around `point`, with its visible side along `normal`; a thick line in 2-D."""
    at, n = vector("point", point), vector("normal", normal)
    return _along(surface_mesh.plate(0 * at, _up(at), size), at, n / np.linalg.norm(n), color)


def box(
    center: npt.ArrayLike,
    size: npt.ArrayLike,
    rotation: npt.ArrayLike | None = None,
    color: tuple[float, float, float] = GREY,
) -> Shape:
    """A box with edge lengths `size` [D] in metres around `center` [D]."""
    at = vector("center", center)
    dim = at.shape[0]
    turned = np.eye(dim) if rotation is None else rotation_matrix(rotation, dim)
    vertices, faces = surface_mesh.cuboid(vector("size", size, dim))
    return Shape(vertices, faces, at, turned, color)


def sphere(center: npt.ArrayLike, radius: float, color: tuple[float, float, float] = GREY) -> Shape:
    """A sphere (a disc in 2-D) of `radius` [m] around `center` [D]."""
    at = vector("center", center)
    return _along(surface_mesh.capsule(0.0, radius, _up(at)), at, _up(at), color)


def capsule(a: npt.ArrayLike, b: npt.ArrayLike, radius: float, color: tuple[float, float, float] = GREY) -> Shape:
    """All points within `radius` [m] of the segment from `a` to `b` ([D] each)."""
    middle, axis, half = _segment(a, b)
    return _along(surface_mesh.capsule(half, radius, _up(middle)), middle, axis, color)


def cylinder(a: npt.ArrayLike, b: npt.ArrayLike, radius: float, color: tuple[float, float, float] = GREY) -> Shape:
    """A closed cylinder of `radius` [m] from `a` to `b` ([D] each); a rectangle in 2-D."""
    middle, axis, half = _segment(a, b)
    if len(middle) == 2:
        return _along(surface_mesh.cuboid(2 * np.array([radius, half])), middle, axis, color)
    profile = np.array([[0, -half], [radius, -half], [radius, half], [0, half]], dtype=np.float64)
    return _along(surface_mesh.revolved(profile, _up(middle)), middle, axis, color)


def mesh(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike | None = None,
    position: npt.ArrayLike | None = None,
    rotation: npt.ArrayLike | None = None,
    color: tuple[float, float, float] = GREY,
) -> Shape:
    """Triangles `faces` int [T, 3] over `vertices` [V, 3], or the closed outline `vertices` [V, 2]."""
    v = np.asarray(vertices, dtype=np.float64)
    if v.ndim != 2 or v.shape[1] not in (2, 3):
        raise ValueError(f"vertices must have shape [V, 2] or [V, 3], got {list(v.shape)}")
    dim = int(v.shape[1])
    f = None if faces is None else np.asarray(faces, dtype=np.int64)
    if dim == 3 and (f is None or f.ndim != 2 or f.shape[1] != 3):
        raise ValueError(f"faces must have shape [T, 3] for a 3-D mesh, got {None if f is None else list(f.shape)}")
    at = np.zeros(dim) if position is None else vector("position", position, dim)
    turned = np.eye(dim) if rotation is None else rotation_matrix(rotation, dim)
    return Shape(v, f, at, turned, color)


def _up(like: Array) -> Array:
    """The y axis."""
    return np.eye(len(like))[1]


def _along(piece: SurfaceMesh, center: Array, axis: Array, color: tuple[float, float, float]) -> Shape:
    """Body created along the y axis, rotated to the unit vector `axis`."""
    return Shape(piece.vertices, piece.faces, center, frame_of(axis), color)


def _segment(a: npt.ArrayLike, b: npt.ArrayLike) -> tuple[Array, Array, float]:
    """Middle, direction (y where there is none) and half length of a segment."""
    start, end = vector("a", a), vector("b", b)
    length = float(np.linalg.norm(end - start))
    return 0.5 * (start + end), (end - start) / length if length > 0 else _up(start), 0.5 * length


@dataclass(frozen=True)
class Samples:
    """Points [N, 3] m spread over a surface, normals [N, 3] there, and the radius [m] of the disc that each
    represents.
    """

    points: Array
    normals: Array
    radius: float


def surface_samples(obstacle: Shape, count: int) -> Samples:
    """About `count` evenly spread points on an obstacle's triangles."""
    assert obstacle.faces is not None
    corners = obstacle.world()[obstacle.faces]
    normals = _normals(corners)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    face, weights, radius = sample_triangles(corners, count)
    return Samples(np.einsum("nk,nkd->nd", weights, corners[face]), normals[face], radius)


def _normals(corners: Array) -> Array:
    """Normals of triangles [T, 3, 3], twice as long as their areas."""
    edges = corners[:, 1:] - corners[:, :1]
    normals: Array = np.cross(edges[:, 0], edges[:, 1])
    return normals


def sample_triangles(corners: Array, count: int) -> tuple[Array, Array, float]:
    """About `count` evenly spread points on triangles [T, 3, 3]: the triangle of each [N], the weights of its corners
    [N, 3], and the radius of the disc that it represents.
    """
    area = 0.5 * np.linalg.norm(_normals(corners), axis=1)
    per_face = np.ceil(count * area / max(float(area.sum()), 1e-300)).astype(np.int64)
    face = np.repeat(np.arange(len(area)), per_face)
    # The plastic number's sequence (Roberts 2018) fills the unit square evenly; folding maps it to the triangle.
    uv = np.arange(1, len(face) + 1)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]) % 1
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    weights = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)
    return face, weights, float(np.sqrt(area.sum() / max(len(face), 1)))
