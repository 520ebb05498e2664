"""Singular value and polar decompositions in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def svd3(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """See `torch_mpm.ops.svd3`."""
    U, sigma, Vh = torch.linalg.svd(F)
    V = Vh.mT
    turn_U, turn_V = torch.linalg.det(U).sign(), torch.linalg.det(V).sign()
    smallest = torch.zeros_like(sigma)
    smallest[..., -1] = 1
    U = U * (1 + smallest * (turn_U[..., None] - 1))[..., None, :]
    V = V * (1 + smallest * (turn_V[..., None] - 1))[..., None, :]
    return U, sigma * (1 + smallest * ((turn_U * turn_V)[..., None] - 1)), V


def polar(F: Tensor) -> tuple[Tensor, Tensor]:
    """See `torch_mpm.ops.polar`."""
    U, sigma, V = svd3(F)
    return U @ V.mT, (V * sigma[..., None, :]) @ V.mT
