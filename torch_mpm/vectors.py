"""Lengths and directions of vectors, with gradients that are finite everywhere, and products with small matrices."""

from __future__ import annotations

import torch
from torch import Tensor


def norm(v: Tensor) -> Tensor:
    """Length of vectors [..., D], with gradient zero at the zero vector."""
    squared = (v * v).sum(-1)
    return torch.where(squared > 0, torch.where(squared > 0, squared, 1).sqrt(), 0)


def unit(v: Tensor) -> Tensor:
    """Directions of vectors [..., D]; zero for the zero vector."""
    length = norm(v)[..., None]
    return torch.where(length > 0, v / torch.where(length > 0, length, 1), 0)


def transform(matrix: Tensor, v: Tensor) -> Tensor:
    """Matrix [D, D] or [N, D, D] times vectors [N, D]."""
    return v @ matrix.mT if matrix.dim() == 2 else (matrix @ v[..., None])[..., 0]


def product(A: Tensor, B: Tensor) -> Tensor:
    """Product of small matrices [P, D, K] and [P, K, E], many of them, for which batched library calls are slow."""
    result = A[:, :, 0, None] * B[:, 0, None, :]
    for k in range(1, A.shape[2]):
        result = torch.addcmul(result, A[:, :, k, None], B[:, k, None, :])
    return result


def determinant(F: Tensor) -> Tensor:
    """det F of [P, D, D], without the factorisation of `torch.linalg.det`."""
    if F.shape[1] == 2:
        return F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
    return (F[:, 0] * torch.linalg.cross(F[:, 1], F[:, 2])).sum(1)
