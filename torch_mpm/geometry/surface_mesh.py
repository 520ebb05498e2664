"""Surfaces of shapes as triangles (3-D) or closed outlines (2-D), for drawing, sampling and filling."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

TURNS = 64
"""Number of sides of a surface of revolution."""


class SurfaceMesh(NamedTuple):
    """Vertices [V, D] [m], and triangles int [T, 3] (3-D) or None (2-D: the vertices are a closed outline)."""

    vertices: Array
    faces: Array | None


def plate(middle: Array, normal: Array, size: float) -> SurfaceMesh:
    """Square of side `size` [m] around `middle`, with its visible side along `normal`; a thick line in 2-D."""
    frame = frame_of(normal / np.linalg.norm(normal))
    if len(middle) == 2:
        thick = 0.01 * size
        flat = np.array([[-0.5 * size, -thick], [0.5 * size, -thick], [0.5 * size, 0], [-0.5 * size, 0]])
        return SurfaceMesh(middle + flat @ frame.T, None)
    square = 0.5 * size * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], dtype=np.float64)
    return SurfaceMesh(middle + square @ frame.T, np.array([[0, 2, 1], [0, 3, 2]]))


def cuboid(size: Array) -> SurfaceMesh:
    """A box with edge lengths `size` [D] [m] around the origin."""
    if len(size) == 2:
        return SurfaceMesh(0.5 * size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), None)
    corners = np.array([[(i & 1), (i >> 1) & 1, i >> 2] for i in range(8)]) * 2.0 - 1.0
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return SurfaceMesh(0.5 * size * corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


def capsule(half_length: float, radius: float, axis: Array) -> SurfaceMesh:
    """All points within `radius` of the segment of half length `half_length` [m] along the unit vector `axis` [D]."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 33)
    # The cap's equator appears twice, at both ends of the straight part.
    angle = np.concatenate([angle[:17], angle[16:]])
    shift = np.where(np.arange(angle.size) < 17, -half_length, half_length)
    profile = np.stack([radius * np.cos(angle), radius * np.sin(angle) + shift], axis=1)
    if len(axis) == 3:
        return revolved(profile, axis)
    outline = np.concatenate([profile, profile[::-1] * [-1, 1]])
    return SurfaceMesh(outline @ frame_of(axis).T, None)


def ring(outline: Array, axis: Array) -> list[SurfaceMesh]:
    """Closed polygon (radius, height) [K, 2] revolved about `axis` [D]; in 2-D the polygon and its mirror image."""
    if len(axis) == 3:
        return [revolved(np.concatenate([outline, outline[:1]]), axis)]
    return [SurfaceMesh(outline * [side, 1.0] @ frame_of(axis).T, None) for side in (1.0, -1.0)]


def revolved(profile: Array, axis: Array) -> SurfaceMesh:
    """Profile (radius, height) [K, 2] revolved about the unit vector `axis` [3], without edges on the axis."""
    phi = 2 * np.pi * np.arange(TURNS) / TURNS
    radius, height = profile[:, 0][:, None], profile[:, 1][:, None]
    v = np.stack([radius * np.cos(phi), height + 0 * phi, radius * np.sin(phi)], axis=-1).reshape(-1, 3)
    (edges,) = np.nonzero((profile[:-1, 0] > 0) | (profile[1:, 0] > 0))
    i, j = np.meshgrid(edges, np.arange(TURNS), indexing="ij")
    k = (j + 1) % TURNS
    a, b, c, d = i * TURNS + j, i * TURNS + k, (i + 1) * TURNS + k, (i + 1) * TURNS + j
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    return SurfaceMesh(v @ frame_of(axis).T, faces)


def frame_of(axis: Array) -> Array:
    """Rotation [D, D] of the y axis to the unit vector `axis` [D]."""
    if len(axis) == 2:
        return np.stack([np.array([axis[1], -axis[0]]), axis], axis=1)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    return np.stack([u, axis, np.cross(u, axis)], axis=1)
