"""Search structures of a closed mesh, computed once: triangles above a point, nearest triangle, volumes."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from ..geometry.surface_mesh import Array
from .nearest import Tree
from .winding import Columns


class MeshIndex:
    """Search structures for the triangles of a closed mesh, built on first use.

    Args:
        vertices: float64 [V, 3] [m], on the CPU.
        faces: int64 [T, 3].
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        self.vertices, self.faces = vertices.clone(), faces.clone()

    def describes(self, vertices: Tensor, faces: Tensor) -> bool:
        """Whether the vertices and triangles are unchanged."""
        return torch.equal(vertices, self.vertices) and torch.equal(faces, self.faces)

    def inside(self, x: Tensor) -> Tensor:
        """Whether the winding number is not zero, bool [N], of points [N, 3] [m] on the CPU."""
        return torch.from_numpy(self._columns.winding(_numpy(x)) != 0)

    def nearest(self, x: Tensor) -> Tensor:
        """Index of the nearest triangle, int64 [N], to each of the points [N, 3] [m] on the CPU."""
        return torch.from_numpy(self._tree.nearest(_numpy(x)))

    @functools.cached_property
    def volumes(self) -> tuple[float, float]:
        """See `Columns.volumes`."""
        return self._columns.volumes()

    @functools.cached_property
    def _columns(self) -> Columns:
        return Columns(self.vertices.numpy(), self.faces.numpy())

    @functools.cached_property
    def _tree(self) -> Tree:
        return Tree(self.vertices.numpy()[self.faces.numpy()])


def _numpy(x: Tensor) -> Array:
    return x.detach().to(torch.float64).numpy()
