"""Singular value decomposition of NCLaw, with finite gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ...ops.svd import svd3

NEAR = 0.5
"""Exponent of the rounding error: stretches with a smaller relative gap are treated as equal."""


class SVD(nn.Module):
    """F [P, 3, 3] -> U, σ and Vᵀ with rotations U and V; the smallest σ has the sign of det F.

    Gradients are finite at equal stretches, and correct for functions of σ and of R = U Vᵀ, such as the stress of
    NCLaw's networks. The common rotation of the axes of two equal stretches is neglected there: for U diag(f(σ)) Uᵀ and
    U diag(f(σ)) Vᵀ use `torch_mpm.isotropic`, whose gradients are correct everywhere.
    """

    def forward(self, F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        U, sigma, V = _Decomposition.apply(F)
        return U, sigma, V.mT


class _Decomposition(torch.autograd.Function):
    """With a = skew Uᵀ ∂U, b = skew Vᵀ ∂V: U and V rotate together by (a + b)/2 over the gap of two stretches, and
    against each other by (a − b)/2 over their sum, on which alone R depends.
    """

    @staticmethod
    def forward(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return svd3(F)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.save_for_backward(*output)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_U: Tensor, grad_sigma: Tensor, grad_V: Tensor) -> Tensor:
        U, sigma, V = ctx.saved_tensors
        row, column = sigma[:, :, None], sigma[:, None, :]
        a, b = _skew(U.mT @ grad_U), _skew(V.mT @ grad_V)
        gap, total = column - row, column + row
        near = gap.abs() <= torch.finfo(sigma.dtype).eps ** NEAR * total.abs()
        opposite = total == 0
        together = torch.where(near, 0, (a + b) / 2) / torch.where(near, 1, gap)
        against = torch.where(opposite, 0, (a - b) / 2) / torch.where(opposite, 1, total)
        return U @ (torch.diag_embed(grad_sigma) + together + against) @ V.mT


def _skew(m: Tensor) -> Tensor:
    return m - m.mT
