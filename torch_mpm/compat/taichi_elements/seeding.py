"""Random points in boxes, ellipsoids and polygons, as taichi_elements seeds particles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


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


def accepted(inside: Callable[[Tensor], Tensor], dim: int, count: int) -> Tensor:
    """Points [count, D] of the cube [-1, 1]^D inside a shape."""
    found = torch.zeros(0, dim)
    while len(found) < count:
        x = 2 * torch.rand(2 * count, dim) - 1
        found = torch.cat([found, x[inside(x)]])
    return found[:count]
