"""Stiffness of any law, by automatic differentiation of its stress."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..ops.autograd import graph_at_once
from .parameters import Overlay

if TYPE_CHECKING:
    from ..state.state import State
    from .material import Material


def differentiated_stiffness(law: Material, state: State) -> Tensor:
    """Upper bound, over velocity gradients G with |G| = 1, of |dτ/dF : G F| and of the second variation of the energy.

    The tangent A = ∂τ/∂G, [D², D²] for each particle, is evaluated at the deformation after the law; the second
    variation is G : A G − tr(Gᵀ τ Gᵀ). The Schatten norm (Σ σᵢ⁸)^(1/8) of each of these matrices lies between its
    largest singular value and D^(1/4) ≤ 1.32 times that.

    Returns:
        [P] [Pa], constant for autograd. Zero where it is not finite, as is the stress of a particle without a
        meaningful state.
    """
    fields = [name for name in law.state_fields if name in ("F", "J") and getattr(state, name) is not None]
    with torch.inference_mode(False), torch.no_grad():
        given: Any = Overlay(state, **{name: getattr(state, name).clone() for name in fields})
        changes, _ = law.update(given)
        leaves = {name: changes.get(name, getattr(given, name)).detach().clone().requires_grad_() for name in fields}
        history = {name: value for name, value in changes.items() if name in law.extra_fields}
        moved: Any = Overlay(given, **leaves, extra={**state.extra, **history})
        with torch.enable_grad(), graph_at_once():
            _, stress = law.update(moved)
            tangent = _tangent(stress, leaves)
        eye = torch.eye(stress.shape[1], dtype=stress.dtype, device=stress.device)
        turning = torch.einsum("ja,pib->pijab", eye, stress.detach()).reshape(tangent.shape)
        bound = torch.maximum(_largest(tangent), _largest(tangent - (turning + turning.mT) / 2))
        for name, value in leaves.items():
            J = value if name == "J" else torch.linalg.det(value.where(value.isfinite(), torch.nan))
            bound = torch.where(J > 0, bound, 0)
        return torch.where(bound.isfinite(), bound, 0)


def _tangent(stress: Tensor, leaves: dict[str, Tensor]) -> Tensor:
    """∂τ/∂G [P, D², D²] with dF = G F and dJ = J tr G."""
    rows = []
    for entry in stress.flatten(1).unbind(1):
        row = torch.zeros_like(stress, requires_grad=False)
        if entry.requires_grad:
            grads = torch.autograd.grad(entry.sum(), list(leaves.values()), retain_graph=True, allow_unused=True)
            for (name, leaf), grad in zip(leaves.items(), grads, strict=True):
                if grad is not None and name == "F":
                    row += grad @ leaf.detach().mT
                elif grad is not None:
                    row.diagonal(dim1=1, dim2=2).add_((grad * leaf.detach())[:, None])
        rows.append(row.flatten(1))
    return torch.stack(rows, 1)


def _largest(matrix: Tensor) -> Tensor:
    """Schatten norm of order 8 of matrices [P, N, N], a bound of their largest singular value."""
    size = matrix.abs().amax((1, 2))
    scaled = matrix / torch.where(size > 0, size, 1)[:, None, None]
    square = scaled.mT @ scaled
    return size * (square @ square).norm(dim=(1, 2)) ** 0.25
