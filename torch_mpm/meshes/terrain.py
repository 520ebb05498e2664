"""Bodies between an open height surface and a flat face."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry.surface_mesh import Array
from .closed import ClosedMesh, edge_uses, merged_equal, places


def on_lattice(heights: Array, lower: tuple[float, ...], spacing: float, axis: int) -> tuple[Array, Array]:
    """Vertices [X Y, 3] and triangles of heights [X, Y] over a lattice that begins at `lower` [m]."""
    along = [start + spacing * np.arange(n) for start, n in zip(lower, heights.shape, strict=True)]
    flat = np.stack(np.meshgrid(*along, indexing="ij"), -1)
    vertices = np.insert(flat.reshape(-1, 2), axis, heights.reshape(-1), axis=1)
    index = np.arange(heights.size).reshape(heights.shape)
    a, b, c, d = (part.reshape(-1) for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def closed_to(source: Any, vertices: Array, faces: Array, level: float, axis: int) -> ClosedMesh:
    """Body between a surface with one height at each position and a flat face, with vertical sides.

    Args:
        source: name of the surface in messages.
        vertices, faces: of the surface, float64 [V, 3] [m] and int64 [T, 3].
        level: coordinate of the flat face [m], below the whole surface or above it.
        axis: the vertical axis.

    Raises:
        ValueError: for a level between the heights, and for a surface that is vertical somewhere or folds over itself.
    """
    lowest, highest = float(vertices[faces, axis].min()), float(vertices[faces, axis].max())
    if lowest <= level <= highest:
        raise ValueError(
            f"level must be below the terrain or above it, whose heights are {lowest:g} to {highest:g} m, got {level:g}"
        )
    vertices, faces, merged = merged_equal(vertices, faces)
    corners = vertices[faces]
    rise = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, axis]
    if not rise.all():
        upright = corners[rise == 0]
        raise ValueError(f"{len(upright)} triangles of terrain {source} are vertical, {places(upright)}")
    faces = np.where((rise > 0)[:, None], faces, faces[:, ::-1])
    edges, which, sign = edge_uses(faces)
    uses, balance = np.bincount(which, minlength=len(edges)), np.bincount(which, sign, len(edges))
    folded = edges[(uses > 2) | (uses == 2) & (balance != 0)]
    if len(folded):
        raise ValueError(
            f"terrain {source} has several heights over a place: it folds over itself at {len(folded)} edges, "
            f"{places(vertices[folded])}"
        )
    rim = uses[which] == 1
    start, end = np.where((sign == 1)[:, None], edges[which], edges[which, ::-1])[rim].T
    flat = vertices.copy()
    flat[:, axis] = level
    count = len(vertices)
    sides = [np.stack([end, start, start + count], 1), np.stack([end, start + count, end + count], 1)]
    closed = np.concatenate([faces, faces[:, ::-1] + count, *sides])
    changes = (f"{merged} vertices at positions of others were merged",) if merged else ()
    return ClosedMesh(np.concatenate([vertices, flat]), closed if level < lowest else closed[:, ::-1].copy(), changes)
