"""Closed triangle meshes, and terrain."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...cuda_graphs.capture import is_traced, is_transformed
from ...errors import check_number, check_vector, shape_of
from ...meshes import closed, terrain
from ...meshes.index import MeshIndex
from ...meshes.nearest import nearest_on_triangles
from ..surface_mesh import Array, SurfaceMesh
from ..vectors import norm, unit
from .base import Shape

PAIRS = 2**20
"""Number of point-triangle pairs that are compared at once, which bounds the memory."""
UNLIKE = 1e-3
"""Relative difference between the volume inside a mesh and that by its normals from which on it is reported."""


ROUNDING = 1e-12
"""Share of the volume of its bounding box up to which the volume inside a mesh is rounding."""


class Mesh(Shape):
    """Inside of a closed triangle mesh, scaled about its origin: points of non-zero winding number.

    So parts may overlap, and each may be inside out; a part of opposite orientation inside another is a cavity. Files
    with textures or normals have several vertices at a position, which are merged. On the CPU search trees are used. On
    other devices, and where torch traces or transforms a function, every point is compared with every triangle, which
    suits small meshes only.

    Args:
        source: a file that trimesh reads (.obj, .ply, .stl, .glb, ...) or a `trimesh.Trimesh`.
        scale: factor on its coordinates.

    Attributes:
        changes: sentences on the repairs that closed the mesh (see `torch_mpm.meshes.closed.load`).

    Raises:
        ImportError: without trimesh.
        OSError: for a file that cannot be read.
        ValueError: for a mesh that is not closed, or a scale that is not positive.
    """

    name = "mesh"

    def __init__(self, source: str | Path | Any, scale: float = 1.0) -> None:
        scale = float(check_number("scale", scale, "positive", lambda v: 0 < v < math.inf))
        vertices, faces, changes = closed.load(source)
        signed, filled = self._set(source, closed.ClosedMesh(vertices * scale, faces, changes))
        if abs(filled - abs(signed)) > UNLIKE * filled:
            warnings.warn(
                f"mesh {source}: parts overlap or are inside out one against another: the volume inside is "
                f"{filled:.4g} m³, which bodies get, and that by the normals {abs(signed):.4g} m³",
                stacklevel=2,
            )

    def _set(self, source: Any, mesh: closed.ClosedMesh) -> tuple[float, float]:
        """Set the vertices and triangles, and return the volume by the normals and the volume inside [m³]."""
        self.vertices, self.faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
        self.changes, self._index = mesh.changes, MeshIndex(self.vertices, self.faces)
        signed, filled = self._index.volumes
        check_number(f"the volume of {self.name} {source}", filled, "positive", lambda v: 0 < v < math.inf)
        if filled <= ROUNDING * float((self.vertices.amax(0) - self.vertices.amin(0)).prod()):
            raise ValueError(
                f"{self.name} {source} encloses no volume: its winding number is zero everywhere, as where parts of "
                "opposite orientation coincide; remove one of them"
            )
        return signed, filled

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        index, corners = self._searched(x), self._corners(x)
        if index is not None:
            nearest = nearest_on_triangles(x, corners[index.nearest(x)])
        else:
            nearest = torch.cat([_nearest_of_all(part, corners) for part in self._chunks(x)])
        offset = x - nearest
        side = torch.where(self.contains(x.detach()), -1, 1).to(x.dtype)
        return side * norm(offset), side[:, None] * unit(offset)

    def contains(self, x: Tensor) -> Tensor:
        """Whether the winding number is above 1/2 (Jacobson et al. 2013; angles: Van Oosterom and Strackee 1983)."""
        if (index := self._searched(x)) is not None:
            return index.inside(x)
        corners = self._corners(x)
        return torch.cat([_winding_number(part, corners).abs() > 0.5 for part in self._chunks(x)])

    def volume(self, dim: int, scene: int = 0) -> float:
        """Volume inside [m³], exact where parts do not overlap, otherwise to 1e-4."""
        return self._current_index().volumes[1]

    def bounds(self, dim: int, scene: int = 0) -> tuple[Tensor, Tensor]:
        return self.vertices.cpu().amin(0), self.vertices.cpu().amax(0)

    def mesh(self, lower: Array, upper: Array, scene: int = 0) -> list[SurfaceMesh]:
        return [SurfaceMesh(self.vertices.cpu().numpy(), self.faces.cpu().numpy())]

    def _searched(self, x: Tensor) -> MeshIndex | None:
        """Search trees for points; None where each is compared with every triangle."""
        hidden = x.device.type != "cpu" or is_traced(x) or is_transformed()
        return None if hidden else self._current_index()

    def _current_index(self) -> MeshIndex:
        """Rebuilt where the vertices or triangles have changed."""
        vertices, faces = self.vertices.detach().to("cpu", torch.float64), self.faces.cpu()
        if not self._index.describes(vertices, faces):
            self._index = MeshIndex(vertices, faces)
        return self._index

    def _corners(self, like: Tensor) -> Tensor:
        """[T, 3, 3]"""
        return self.vertices.to(like)[self.faces.to(like.device)]

    def _chunks(self, x: Tensor) -> Sequence[Tensor]:
        return x.split(max(1, PAIRS // len(self.faces)))


class Terrain(Mesh):
    """Ground below an open height surface, or space above it; 3-D only.

    Vertical sides and a flat face close it. As an obstacle it should extend 3 cells beyond open faces of the domain.
    `Sampled.of(terrain, lower, upper, spacing)`, with corners outside the closed body, acts in the kernel.

    Args:
        source: heights [X, Y] [m] at the nodes of a horizontal lattice, a tensor or an array; or an open surface, a
            file that trimesh reads or a `trimesh.Trimesh`, without vertical or overhanging parts.
        level: coordinate of the flat face [m]. Where it is below the whole surface, the body is the ground; where it is
            above, the space over the ground.
        lower: the first node of the lattice of heights [m], 2 numbers.
        spacing: distance of the nodes of heights [m].
        axis: the vertical axis, 0, 1 or 2. The lattice of heights lies along the other two, in their order.
        scale: factor on the coordinates of a file, applied before `level`.

    Raises:
        ImportError, OSError: as `Mesh`.
        TypeError, ValueError: for other arguments, a level between the heights, or several heights at one position.
    """

    name = "terrain"

    def __init__(
        self,
        source: Tensor | Array | str | Path | Any,
        level: float,
        lower: Sequence[float] | None = None,
        spacing: float | None = None,
        axis: int = 2,
        scale: float = 1.0,
    ) -> None:
        level = float(check_number("level", level))
        scale = float(check_number("scale", scale, "positive", lambda v: 0 < v < math.inf))
        if axis not in (0, 1, 2):
            raise ValueError(f"axis must be 0, 1 or 2, got {axis}")
        if isinstance(source, Tensor | np.ndarray):
            heights = torch.as_tensor(source).detach().to("cpu", torch.float64)
            if heights.dim() != 2 or min(heights.shape) < 2 or not bool(heights.isfinite().all()):
                raise ValueError(f"heights must be finite numbers [X, Y], 2 or more each, got {shape_of(heights)}")
            if lower is None or spacing is None:
                raise ValueError("heights need the first node of their lattice, lower, and its spacing")
            step = float(check_number("spacing", spacing, "positive", lambda v: 0 < v < math.inf))
            name: Any = "heights"
            surface = terrain.on_lattice(heights.numpy(), check_vector("lower", lower, 2), step, axis)
        else:
            if lower is not None or spacing is not None:
                raise ValueError("lower and spacing belong to heights on a lattice, not to a mesh")
            name, surface = source, closed.triangles(source)
        signed, filled = self._set(name, terrain.closed_to(name, surface[0] * scale, surface[1], level, axis))
        if abs(filled - abs(signed)) > UNLIKE * filled:
            raise ValueError(f"terrain {name} has several heights over a place: parts of it lie above each other")


def _winding_number(x: Tensor, corners: Tensor) -> Tensor:
    """Solid angles of triangles [T, 3, 3] from points [N, 3], [N]."""
    a, b, c = (corners[None, :, k] - x[:, None] for k in range(3))
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    determinant = (a * torch.linalg.cross(b, c)).sum(-1)
    denominator = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return torch.atan2(determinant, denominator).sum(1) / (2 * math.pi)


def _nearest_of_all(x: Tensor, corners: Tensor) -> Tensor:
    """Nearest point of triangles [T, 3, 3] to each of the points [N, 3], [N, 3]."""
    candidates = nearest_on_triangles(x[:, None], corners[None])
    nearest = (x[:, None] - candidates).square().sum(-1).argmin(1)
    return candidates[torch.arange(len(x), device=x.device), nearest]
