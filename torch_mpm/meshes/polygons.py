"""Triangles of the polygons of a mesh file."""

from __future__ import annotations

import numpy as np

from ..geometry.surface_mesh import Array

FLAT = 1e-9
"""Turn of a corner to the wrong side that is rounding, in areas of the polygon."""
MOST_CORNERS = 5000
"""Largest number of corners of a polygon that is not convex: its time grows with their square and more."""


def triangulated(vertices: Array, corners: Array, sizes: Array) -> Array:
    """Triangles int64 [T, 3] of polygons, which cover each polygon once, in the order of the polygons.

    Convex polygons are fans about their first corner. Others are cut ear by ear (Meisters 1975) in the plane normal to
    their mean normal (Newell); a hole may be joined to the outline by an edge that is passed twice.

    Args:
        vertices: positions float64 [V, 3].
        corners: vertices of all polygons, one after another, int64 [C].
        sizes: number of corners of each polygon, int64 [P]; those with fewer than 3 are skipped.

    Raises:
        ValueError: for a polygon of more than `MOST_CORNERS` corners that is not convex.
    """
    first = np.cumsum(sizes) - sizes
    made, owner = [np.empty((0, 3), dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for size in np.unique(sizes[sizes >= 3]).tolist():
        which = np.flatnonzero(sizes == size)
        polygons = corners[first[which, None] + np.arange(size)]
        hub = np.broadcast_to(polygons[:, :1], (len(which), size - 2))
        fans = np.stack([hub, polygons[:, 1:-1], polygons[:, 2:]], 2)
        for k in np.flatnonzero(~_convex(vertices[polygons])).tolist():
            fans[k] = polygons[k][_ears(_in_plane(vertices[polygons[k]]))]
        made.append(fans.reshape(-1, 3))
        owner.append(np.repeat(which, size - 2))
    return np.concatenate(made)[np.argsort(np.concatenate(owner), kind="stable")]


def _convex(x: Array) -> Array:
    """Whether polygons [P, n, 3] turn to one side only at all corners, bool [P]; also where they are not finite."""
    if x.shape[1] == 3:
        return np.ones(len(x), dtype=bool)
    x = np.where(np.isfinite(x).all((1, 2), keepdims=True), x, 0.0)
    sides = np.roll(x, -1, axis=1) - x
    normal = _normal(x)
    turns = np.einsum("pni,pi->pn", np.cross(np.roll(sides, 1, axis=1), sides), normal)
    convex: Array = (turns >= -FLAT * np.square(normal).sum(1, keepdims=True)).all(1)
    return convex


def _normal(x: Array) -> Array:
    """Twice the area vector of polygons [..., n, 3], [..., 3]."""
    arm = x - x[..., :1, :]
    total: Array = np.cross(arm, np.roll(arm, -1, axis=-2)).sum(-2)
    return total


def _in_plane(x: Array) -> Array:
    """Corners [n, 3] of a polygon in the plane normal to its normal, counter-clockwise, [n, 2]."""
    normal = _normal(x)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axes = np.stack([across, np.cross(normal, across)], 1)
    length = np.linalg.norm(axes, axis=0)
    plane: Array = (x - x[0]) @ (axes / np.where(length > 0, length, 1))
    return plane


def _ears(x: Array) -> Array:
    """Triangles [n - 2, 3] of the corners of a polygon [n, 2]."""
    if len(x) > MOST_CORNERS:
        raise ValueError(f"a face of {len(x)} corners is not convex: triangulate it in a modelling program")
    left, made, at = np.arange(len(x)), [], 0
    while len(left) > 3:
        at = _ear(x[left], at)
        made.append(left[[at - 1, at, (at + 1) % len(left)]])
        left = np.delete(left, at)
    return np.stack([*made, left])


def _ear(x: Array, start: int) -> int:
    """Corner of a polygon [n, 2] whose triangle with its neighbours contains no other corner, the first from `start`.

    The corner of the smallest turn where there is no such corner, as in polygons that intersect themselves.
    """
    before, after = np.roll(x, 1, axis=0), np.roll(x, -1, axis=0)
    turn = _cross(x - before, after - x)
    reflex = x[turn <= 0]
    for k in (np.arange(len(x)) + start) % len(x):
        a, b, c = before[k], x[k], after[k]
        if turn[k] > 0 and not (_within(reflex, a, b, c) & _apart(reflex, a, b, c)).any():
            return int(k)
    return int(np.argmin(np.abs(turn)))


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def _within(x: Array, *corners: Array) -> Array:
    """Whether points [m, 2] lie in a counter-clockwise triangle or on its edges."""
    a, b, c = corners
    within: Array = (_cross(b - a, x - a) >= 0) & (_cross(c - b, x - b) >= 0) & (_cross(a - c, x - c) >= 0)
    return within


def _apart(x: Array, *corners: Array) -> Array:
    """Whether points [m, 2] are at none of the corners."""
    apart: Array = np.all([(x != corner).any(1) for corner in corners], axis=0)
    return apart
