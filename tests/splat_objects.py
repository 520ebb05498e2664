"""Random Gaussians, rotations, and a camera for tests."""

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


def unit_cube_camera(width: int, height: int) -> Camera:
    return framing(np.zeros(3), np.ones(3), np.array([0.0, 1.0, 0.0]), (width, height), 28.0, 18.0)


def random_rotations(count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    turns = torch.linalg.qr(torch.randn(count, 3, 3, dtype=dtype)).Q
    return turns * torch.linalg.det(turns)[:, None, None]
