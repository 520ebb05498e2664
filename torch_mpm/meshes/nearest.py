"""Nearest triangle of a mesh: a tree of boxes, traversed level by level."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..geometry.surface_mesh import Array

POINTS, PAIRS = 2**14, 2**18
"""Number of points that are looked up together, and of point-box pairs, which bound the memory."""


class Tree:
    """Binary tree of boxes around triangles sorted along a space-filling curve.

    Args:
        corners: of the triangles, float64 [T, 3, 3] [m].
    """

    def __init__(self, corners: Array) -> None:
        order = np.argsort(_morton(corners.mean(1)), kind="stable")
        leaves = 1 << (len(order) - 1).bit_length()
        self._order = np.append(order, np.full(leaves - len(order), order[-1]))
        self._corners = corners[self._order]
        boxes, inner = np.stack([self._corners.min(1), self._corners.max(1)], 1), self._corners.mean(1)
        self._levels = [(boxes, inner)]  # Boxes [N, 2, 3] and a point of the mesh in each [N, 3], from leaves to root.
        while len(boxes) > 1:
            boxes, inner = _joined(boxes, inner)
            self._levels.append((boxes, inner))
        self._levels.reverse()

    def nearest(self, x: Array) -> Array:
        """Index of the nearest triangle to each of the points [N, 3] [m], int64 [N]."""
        order = np.argsort(_morton(x), kind="stable")  # Neighbours visit the same boxes.
        found = np.empty(len(x), dtype=np.int64)
        for first in range(0, len(x), POINTS):
            part = order[first : first + POINTS]
            found[part] = self._nearest(x[part])
        return found

    def _nearest(self, x: Array) -> Array:
        bound, least, found = np.full(len(x), np.inf), np.full(len(x), np.inf), np.zeros(len(x), dtype=np.int64)
        waiting = [(0, np.arange(len(x)), np.zeros(len(x), dtype=np.int64))]
        while waiting:
            level, point, box = waiting.pop()
            boxes, inner = self._levels[level]
            np.minimum.at(bound, point, _squared(x[point] - inner[box]) * (1 + 1e-9))  # Farther triangles are ignored.
            near = _squared_to_box(x[point], boxes[box]) <= bound[point]
            point, box = point[near], box[near]
            if level == len(self._levels) - 1:
                squared = self._squared_to_triangle(x[point], box)
                nearest = np.argsort(-squared, kind="stable")  # The last of several entries of a point is stored.
                nearest = nearest[squared[nearest] < least[point[nearest]]]
                least[point[nearest]], found[point[nearest]] = squared[nearest], self._order[box[nearest]]
                continue
            point, box = np.repeat(point, 2), np.stack([2 * box, 2 * box + 1], 1).reshape(-1)
            for first in range(0, len(point), PAIRS):
                waiting.append((level + 1, point[first : first + PAIRS], box[first : first + PAIRS]))
        return found

    def _squared_to_triangle(self, x: Array, leaf: Array) -> Array:
        """Squared distances [M] [m²] of points from the triangles of leaves."""
        points, corners = torch.from_numpy(x), torch.from_numpy(self._corners[leaf])
        return _squared((points - nearest_on_triangles(points, corners)).numpy())


def nearest_on_triangles(x: Tensor, corners: Tensor) -> Tensor:
    """Nearest points of triangles [..., 3, 3] to points [..., 3], [..., 3]; differentiable."""
    edge = corners.roll(-1, -2) - corners
    arm = x[..., None, :] - corners
    squared = (edge * edge).sum(-1)
    along = (arm * edge).sum(-1) / torch.where(squared > 0, squared, 1)
    on_edges = corners + along.clamp(0, 1)[..., None] * edge
    normal = torch.linalg.cross(edge[..., 0, :], edge[..., 1, :])
    area = (normal * normal).sum(-1, keepdim=True)
    height = (arm[..., 0, :] * normal).sum(-1, keepdim=True) / torch.where(area > 0, area, 1)
    on_plane = x - height * normal
    left = (torch.linalg.cross(edge, arm) * normal[..., None, :]).sum(-1) >= 0  # Of each edge, from above.
    above = left.all(-1, keepdim=True) & (area > 0)
    distance = (x[..., None, :] - on_edges).square().sum(-1)
    nearest = distance.argmin(-1)[..., None, None].expand(*distance.shape[:-1], 1, 3)
    return torch.where(above, on_plane, on_edges.gather(-2, nearest)[..., 0, :])


def _joined(boxes: Array, inner: Array) -> tuple[Array, Array]:
    """Boxes [N, 2, 3] around pairs of boxes, and the more central of their points of the mesh [N, 3]."""
    boxes, inner = boxes.reshape(-1, 2, 2, 3), inner.reshape(-1, 2, 3)
    around = np.stack([boxes[:, :, 0].min(1), boxes[:, :, 1].max(1)], 1)
    middle = np.square(inner - around.mean(1)[:, None]).sum(2).argmin(1)
    return around, inner[np.arange(len(inner)), middle]


def _squared_to_box(x: Array, boxes: Array) -> Array:
    """Squared distances [M] [m²] of points from boxes [M, 2, 3]."""
    return _squared(np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 1]), 0))


def _squared(v: Array) -> Array:
    return np.einsum("md,md->m", v, v)


def _morton(x: Array) -> Array:
    """Positions of points [N, 3] on a space-filling curve, uint64 [N]: interleaved 21 bits of each coordinate."""
    lower, upper = x.min(0, initial=np.inf), x.max(0, initial=-np.inf)
    cell = ((x - lower) * ((2**21 - 1) / max(float((upper - lower).max()), 1e-300))).astype(np.uint64)
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F)):
        cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
    for shift, mask in ((4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
        cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
    return cell[:, 0] | (cell[:, 1] << np.uint64(1)) | (cell[:, 2] << np.uint64(2))
