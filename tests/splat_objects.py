"""Gaussians for tests: random ones, and shells of a sphere and of a torus."""

import math

import numpy as np
import torch
from torch import Tensor

from torch_mpm import splats
from torch_mpm.render.camera import Camera, framing


def random_gaussians(
    count: int, degree: int = 3, dtype: torch.dtype = torch.float64, size: float = 0.05, seed: int = 0
) -> splats.Gaussians:
    """In the unit cube, with deviations of 0.3 to 1.3 of a size [m]."""
    generator = torch.Generator().manual_seed(seed)
    x, widths, turns = (torch.rand(count, n, dtype=dtype, generator=generator) for n in (3, 3, 4))
    opacity = 0.05 + 0.9 * torch.rand(count, dtype=dtype, generator=generator)
    harmonics = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, dtype=dtype, generator=generator)
    return splats.Gaussians.from_factors(x, size * (0.3 + widths), turns - 0.5, opacity, harmonics)


def shell(x: Tensor, normals: Tensor, spacing: float) -> splats.Gaussians:
    """Flat opaque Gaussians on a surface."""
    across = torch.eye(3, dtype=x.dtype)[normals.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, across), dim=1)
    second = torch.linalg.cross(normals, first)
    axes = spacing * torch.stack([first, second, 0.1 * normals], 2)
    return splats.Gaussians(x, axes, torch.full_like(x[:, 0], 3.0), 0.5 * torch.ones(len(x), 1, 3, dtype=x.dtype))


def sphere(radius: float, center: tuple[float, float, float], count: int) -> splats.Gaussians:
    k = torch.arange(count, dtype=torch.float64)
    z, angle = 1 - 2 * (k + 0.5) / count, k * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    normals = torch.stack([r * angle.cos(), r * angle.sin(), z], 1)
    x = torch.tensor(center, dtype=torch.float64) + radius * normals
    return shell(x, normals, radius * math.sqrt(4 * math.pi / count))


def torus(major: float, minor: float, count: int) -> splats.Gaussians:
    """Around the y axis."""
    k = torch.arange(count, dtype=torch.float64)
    a, b = (2 * math.pi * (k * step % 1) for step in (0.7548776662466927, 0.5698402909980532))
    ring = torch.stack([a.cos(), 0 * a, a.sin()], 1)
    normals = b.cos()[:, None] * ring + b.sin()[:, None] * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return shell(major * ring + minor * normals, normals, math.sqrt(4 * math.pi**2 * major * minor / count))


def unit_cube_camera(width: int, height: int) -> Camera:
    return framing(np.zeros(3), np.ones(3), np.array([0.0, 1.0, 0.0]), (width, height), 28.0, 18.0)


def random_rotations(count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    turns = torch.linalg.qr(torch.randn(count, 3, 3, dtype=dtype)).Q
    return turns * torch.linalg.det(turns)[:, None, None]
