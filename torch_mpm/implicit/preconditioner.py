"""The node blocks of the Hessian, whose inverses precondition linear solves and measure residuals."""

from __future__ import annotations

import torch
from torch import Tensor

from .bounds import NodeBounds
from .contact import Contact
from .system import ImplicitSystem


def preconditioned(
    system: ImplicitSystem, bounds: NodeBounds | None, blocks: Tensor, contact: Contact, total_mass: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """B⁻¹ of the free components, its product with the gradient, and the residual of each scene [m/s]."""
    inverse = inverse_blocks(bounds, blocks, contact.free)
    change = times(inverse, contact.gradient)
    return inverse, change, (system.node_sum(contact.gradient * change).abs() / total_mass).sqrt()


def inverse_blocks(bounds: NodeBounds | None, blocks: Tensor, free: Tensor) -> Tensor:
    """B⁻¹ of the free components of node blocks [N, D, D] [1/kg], zero for the others."""
    dtype, blocks = blocks.dtype, blocks.double()
    # Rounding of stiff blocks may leave a negative eigenvalue, with which a residual could seem to be zero.
    ridge = 16 * torch.finfo(dtype).eps * blocks.diagonal(dim1=1, dim2=2).sum(1)
    blocks = blocks + torch.diag_embed(ridge[:, None].expand(blocks.shape[:2]))
    if bounds is not None:
        blocks = bounds.turned_blocks(blocks)
    both = free[:, :, None] & free[:, None, :]
    blocks = torch.where(both, blocks, 0) + torch.diag_embed((~free).double())
    inverse = torch.where(both, _inverse(blocks), 0)
    if bounds is not None:
        inverse = bounds.turned_blocks(inverse)
    inverse = (inverse + inverse.mT) / 2
    return inverse.to(dtype)


def _inverse(a: Tensor) -> Tensor:
    """Of symmetric matrices [N, 2 or 3, 2 or 3]."""
    scale = a.diagonal(dim1=1, dim2=2).rsqrt()
    a = a * scale[:, :, None] * scale[:, None, :]
    if a.shape[-1] == 2:
        rows = [[a[:, 1, 1], -a[:, 0, 1]], [-a[:, 1, 0], a[:, 0, 0]]]
        cofactors = torch.stack([torch.stack(row, -1) for row in rows], -2)
        determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    else:
        first, second, third = a.unbind(-1)
        rows3 = [torch.linalg.cross(second, third), torch.linalg.cross(third, first), torch.linalg.cross(first, second)]
        cofactors = torch.stack(rows3, -2)
        determinant = (first * rows3[0]).sum(-1)
    return cofactors / determinant[:, None, None] * scale[:, :, None] * scale[:, None, :]


def times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """[N, D, D] times [N, D]."""
    return (matrices * vectors[:, None, :]).sum(-1)
