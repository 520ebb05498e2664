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


def composed(a: Tensor, b: Tensor) -> Tensor:
    """Rotation vector [..., 3] [rad] of the rotation by b followed by a, with an angle of at most π; by quaternions.

    Twice differentiable where the angle is below π.
    """
    (p, u), (q, v) = quaternion(a), quaternion(b)
    scalar = p * q - (u * v).sum(-1, keepdim=True)
    vector = p * v + q * u + torch.linalg.cross(*torch.broadcast_tensors(u, v))
    return rotation_vector(scalar, vector)


def rotation_vector(scalar: Tensor, vector: Tensor) -> Tensor:
    """Rotation vector [..., 3] [rad], with an angle of at most π, of quaternions of unit length, their scalar [..., 1]
    and vector [..., 3].

    Twice differentiable where the angle is below π.
    """
    scalar, vector = scalar.abs(), torch.where(scalar < 0, -vector, vector)
    half = norm(vector)[..., None]
    small = half < 1e-9  # Here atan2(half, scalar)/half is 1 to rounding, as scalar is.
    return 2 * vector * torch.where(small, 1.0, torch.atan2(half, scalar) / torch.where(small, 1.0, half))


def quaternion(turn: Tensor) -> tuple[Tensor, Tensor]:
    """Scalar [..., 1] and vector [..., 3] of the quaternion of a rotation vector."""
    half = 0.5 * norm(turn)[..., None]
    share = torch.where(half > 0, half.sin() / torch.where(half > 0, half, 1), 1)
    return half.cos(), 0.5 * share * turn


def transform(matrix: Tensor, v: Tensor) -> Tensor:
    """Matrix [D, D] or [N, D, D] times vectors [N, D]."""
    return v @ matrix.mT if matrix.dim() == 2 else (matrix @ v[..., None])[..., 0]


def product(A: Tensor, B: Tensor) -> Tensor:
    """Product of small matrices [P, D, K] and [P, K, E], for large P, for which batched library calls are slow."""
    result = A[:, :, 0, None] * B[:, 0, None, :]
    for k in range(1, A.shape[2]):
        result = torch.addcmul(result, A[:, :, k, None], B[:, k, None, :])
    return result


def determinant(F: Tensor) -> Tensor:
    """det F of [P, D, D], without the factorisation of `torch.linalg.det`."""
    if F.shape[1] == 2:
        return F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
    return (F[:, 0] * torch.linalg.cross(F[:, 1], F[:, 2])).sum(1)
