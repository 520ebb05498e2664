"""Objects of Gaussian splats for measurements and tests: shells of flat opaque Gaussians."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_mpm import splats


def shell(x: Tensor, normals: Tensor, spacing: float, degree: int = 0) -> splats.Gaussians:
    """Grey Gaussians at points [N, 3] of a surface with unit normals [N, 3], as wide as their spacing [m]."""
    across = torch.eye(3, dtype=x.dtype)[normals.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, across), dim=1)
    axes = spacing * torch.stack([first, torch.linalg.cross(normals, first), 0.1 * normals], 2)
    harmonics = torch.zeros(len(x), (degree + 1) ** 2, 3, dtype=x.dtype)
    harmonics[:, 0] = 0.5
    return splats.Gaussians(x, axes, torch.full_like(x[:, 0], 3.0), harmonics)


def sphere(radius: float, center: tuple[float, float, float], count: int, degree: int = 0) -> splats.Gaussians:
    """Around a centre [m], in float64."""
    k = torch.arange(count, dtype=torch.float64)
    z, angle = 1 - 2 * (k + 0.5) / count, k * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    normals = torch.stack([r * angle.cos(), r * angle.sin(), z], 1)
    x = torch.tensor(center, dtype=torch.float64) + radius * normals
    return shell(x, normals, radius * math.sqrt(4 * math.pi / count), degree)


def torus(major: float, minor: float, count: int, degree: int = 0) -> splats.Gaussians:
    """Around the y axis, in float64."""
    k = torch.arange(count, dtype=torch.float64)
    a, b = (2 * math.pi * (k * step % 1) for step in (0.7548776662466927, 0.5698402909980532))
    ring = torch.stack([a.cos(), 0 * a, a.sin()], 1)
    normals = b.cos()[:, None] * ring + b.sin()[:, None] * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    spacing = math.sqrt(4 * math.pi**2 * major * minor / count)
    return shell(major * ring + minor * normals, normals, spacing, degree)
