"""Random points in boxes, ellipsoids, polygons and meshes, as taichi_elements seeds particles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ... import optional
from ...errors import shape_of
from ...geometry import seed
from ..gradients import refuse_grad


def in_box(corner: Sequence[float], edges: Sequence[float], count: int) -> Tensor:
    """Points [count, D] in a box."""
    return torch.tensor(corner) + torch.rand(count, len(corner)) * torch.tensor(edges)


def in_ellipsoid(center: Sequence[float], radii: Sequence[float], count: int) -> Tensor:
    """Points [count, D] in an ellipsoid."""
    unit = accepted(lambda x: x.square().sum(1) <= 1, len(center), count)
    return torch.tensor(center) + unit * torch.tensor(radii)


def in_polygon(center: Sequence[float], radius: float, sides: int, angle: float, count: int) -> Tensor:
    """Points [count, 2] in a regular polygon with a corner at an angle [rad]."""
    part = 2 * math.pi / sides

    def inside(x: Tensor) -> Tensor:
        phi = torch.atan2(x[:, 1], x[:, 0]).sub(angle).remainder(part)
        return x.norm(dim=1) < math.cos(part / 2) / (part / 2 - phi).cos()

    return torch.tensor(center) + radius * accepted(inside, 2, count)


def in_mesh(triangles: Any, translation: Sequence[float], dx: float, per_cell: float) -> Tensor:
    """Points [P, 3] in a closed mesh of triangles [T, 9] or [T, 3, 3] [m]: one at random in each cube of a lattice,
    where taichi_elements has some in each of its voxels.

    Args:
        triangles: corners.
        translation: displacement of the mesh [m].
        dx: node distance [m].
        per_cell: number of points in a volume of dx³.

    Raises:
        ImportError: without trimesh.
        ValueError: for triangles of another shape, a mesh that is not closed, or one with no space for a point.
    """
    refuse_grad("it is filled with particles", triangles=triangles)
    corners = torch.as_tensor(triangles, dtype=torch.float64, device="cpu")
    if corners.dim() not in (2, 3) or corners.shape[1:].numel() != 9:
        raise ValueError(f"triangles must have shape [T, 9] or [T, 3, 3], got {shape_of(triangles)}")
    trimesh = optional.load("trimesh", "add_mesh", "mesh")
    vertices = corners.reshape(-1, 3).numpy()
    mesh = trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3), process=False)
    region = seed.Mesh(mesh, offset=translation)
    drawn = int(torch.randint(2**62, ()))
    return seed.fill(region, dx, per_cell, method="jittered", seed=drawn, dtype=torch.float32, device="cpu").x


def accepted(inside: Callable[[Tensor], Tensor], dim: int, count: int) -> Tensor:
    """Points [count, D] of the cube [-1, 1]^D inside a shape."""
    found = torch.zeros(0, dim)
    while len(found) < count:
        x = 2 * torch.rand(2 * count, dim) - 1
        found = torch.cat([found, x[inside(x)]])
    return found[:count]
