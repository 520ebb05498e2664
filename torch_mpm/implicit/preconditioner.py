"""Node blocks of the Hessian, whose inverses precondition linear solves and measure residuals."""

from __future__ import annotations

from itertools import combinations, product

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
    """B⁻¹ of the free components of symmetric node blocks [N, D, D] [1/kg], zero for the others."""
    dtype, dim, blocks = blocks.dtype, blocks.shape[1], blocks.double()
    # Rounding of stiff blocks may leave a negative eigenvalue, with which a residual could appear to be zero.
    ridge = 16 * torch.finfo(dtype).eps * blocks.diagonal(dim1=1, dim2=2).sum(1)
    if bounds is not None:
        blocks = bounds.turned_blocks(blocks)
    diagonal = [torch.where(free[:, i], blocks[:, i, i] + ridge, 1) for i in range(dim)]
    above = {(i, j): torch.where(free[:, i] & free[:, j], blocks[:, i, j], 0) for i, j in combinations(range(dim), 2)}
    entries = _inverse(diagonal, above)
    kept = [torch.where(free[:, i] & free[:, j], entries[i, j], 0) for i, j in product(range(dim), repeat=2)]
    inverse = torch.stack(kept, 1).unflatten(1, (dim, dim))
    if bounds is not None:
        inverse = bounds.turned_blocks(inverse)
    return inverse.to(dtype)


def _inverse(diagonal: list[Tensor], above: dict[tuple[int, int], Tensor]) -> dict[tuple[int, int], Tensor]:
    """Entries of the inverses of symmetric 2 × 2 or 3 × 3 matrices, from their entries on and above the diagonal."""
    dim = len(diagonal)
    scale = [d.rsqrt() for d in diagonal]
    unit = {(i, j): a * scale[i] * scale[j] for (i, j), a in above.items()}  # With ones on the diagonal.
    if dim == 2:
        cofactors = {(0, 0): torch.ones_like(scale[0]), (0, 1): -unit[0, 1]}
        cofactors[1, 1] = cofactors[0, 0]
        determinant = 1 - unit[0, 1].square()
    else:
        cofactors = {}
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            a, b, c = (unit[min(pair), max(pair)] for pair in ((i, j), (j, k), (i, k)))
            cofactors[i, i] = 1 - b.square()
            cofactors[min(i, j), max(i, j)] = b * c - a
        determinant = cofactors[0, 0] + unit[0, 1] * cofactors[0, 1] + unit[0, 2] * cofactors[0, 2]
    upper = {(i, j): c * scale[i] * scale[j] / determinant for (i, j), c in cofactors.items()}
    return {**upper, **{(j, i): value for (i, j), value in upper.items()}}


def times(matrices: Tensor, vectors: Tensor) -> Tensor:
    """[N, D, D] times [N, D]."""
    return (matrices * vectors[:, None, :]).sum(-1)
