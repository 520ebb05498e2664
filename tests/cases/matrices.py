"""Random rotations and deformation gradients."""

import torch
from torch import Tensor


def rotations(count: int, dim: int) -> Tensor:
    """Evenly distributed rotations [count, dim, dim], float64."""
    Q, R = torch.linalg.qr(torch.randn(count, dim, dim, dtype=torch.float64))
    Q = Q * R.diagonal(dim1=1, dim2=2).sign()[:, None, :]
    Q[:, :, 0] *= torch.linalg.det(Q).sign()[:, None]
    return Q


def deformation(h: Tensor) -> Tensor:
    """Deformation gradients of given Hencky strains [P, D] with random axes."""
    return rotations(*h.shape) * h.exp()[:, None, :] @ rotations(*h.shape).mT
