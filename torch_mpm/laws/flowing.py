"""Plastic flow inside an implicit step: stress after the return map of a trial deformation, and its tangent.

The Kirchhoff stress of the mapped state is as isotropic in the trial deformation as that of an elastic law, so that its
derivative, the consistent tangent (Simo and Taylor 1985), has the form of csrc/laws/tangent.h with derivatives through
the map. The step needs it for velocity gradients that change F by dF = L F₀.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..geometry.vectors import determinant
from ..ops.autograd import graph_at_once
from ..ops.svd import svd3
from .parameters import Overlay

if TYPE_CHECKING:
    from .material import Material


def flowing_stress(law: Material, state: Any, before: Any) -> Tensor:
    """τ F⁻ᵀ F₀ᵀ [P, D, D] [Pa] of the stress τ after the return map of a trial F; zero where F is not finite or has no
    volume. Differentiable as `law.update` is."""
    stress = law.update(state)[1]
    volume = determinant(state.F.detach())[:, None, None]
    valid = (volume > 0) & (volume < torch.inf)
    eye = torch.eye(state.F.shape[1], dtype=stress.dtype, device=stress.device)
    inverse = torch.linalg.inv_ex(torch.where(valid, state.F, eye))[0]  # Gradients must not meet a NaN.
    return torch.where(valid, stress @ (before.F @ inverse).mT, 0)


def flowing_tangent(law: Material, state: Any, before: Any, weight: Tensor, projected: bool) -> Tensor:
    """Derivative of `flowing_stress` by L times a weight [P], in the form of `torch_mpm.ops.law_tangent` [P, n].

    For a flow that is not associated, as that of sand, the symmetric part. Zero where it is not finite.
    """
    dim = state.x.shape[1]
    U, stretch, V = svd3(state.F)
    pairs = [(i, j) for i in range(dim) for j in range(i + 1, dim)]
    moduli, shears = _principal_derivatives(law, state, stretch, pairs)
    diagonal = weight[:, None, None] * 0.5 * (moduli + moduli.mT)
    even, odd = (weight[:, None] * part for part in (shears[0] + shears[1], shears[0] - shears[1]))
    if projected:
        diagonal, even, odd = _positive_part(diagonal), even.clamp_min(0), odd.clamp_min(0)
    upper = [diagonal[:, i, j] for i in range(dim) for j in range(i, dim)]
    B = before.F @ V
    entries = torch.cat([U.flatten(1), B.flatten(1), torch.stack(upper, 1), even, odd], 1)
    finite = entries.isfinite().all(1) & (stretch > 0).all(1)
    return torch.where(finite[:, None], entries, 0)


def flowing_skew(law: Material, state: Any, weight: Tensor) -> Tensor:
    """Nonsymmetric part of the derivative of `flowing_stress`: the skew part of the block between the stretches, in the
    axes of the tangent, times a weight [P, D, D]. Zero where it is not finite.
    """
    stretch = svd3(state.F)[1]
    moduli, _ = _principal_derivatives(law, state, stretch, [])
    skew = 0.5 * weight[:, None, None] * (moduli - moduli.mT)
    valid = skew.isfinite().all((1, 2), True) & (stretch > 0).all(1)[:, None, None]
    return torch.where(valid, skew, 0)


def _principal_derivatives(
    law: Material, state: Any, stretch: Tensor, pairs: list[tuple[int, int]]
) -> tuple[Tensor, Tensor]:
    """Derivatives of P = τ F⁻ᵀ at F = diag(σ) [Pa]: ∂Pᵢᵢ/∂Fⱼⱼ [P, D, D], and of pairs, ∂Pᵢⱼ/∂Fᵢⱼ and ∂Pᵢⱼ/∂Fⱼᵢ [2, P,
    pairs], from those of τ, which are correct at equal stretches too.
    """
    with torch.inference_mode(False), torch.enable_grad(), graph_at_once():
        F = torch.diag_embed(stretch.detach()).requires_grad_()
        moved: Any = Overlay(state, F=F)
        stress = law.update(moved)[1]

        def by_F(i: int, j: int) -> Tensor:
            return torch.autograd.grad(stress[:, i, j].sum(), F, retain_graph=True)[0] / stretch[:, j, None, None]

        rows = [by_F(i, i).diagonal(dim1=1, dim2=2) for i in range(stretch.shape[1])]
        shears = stretch.new_empty(2, len(stretch), len(pairs))
        for k, (i, j) in enumerate(pairs):
            gradient = by_F(i, j)
            shears[0, :, k], shears[1, :, k] = gradient[:, i, j], gradient[:, j, i]
    turned = stress.detach().diagonal(dim1=1, dim2=2) / stretch  # by F⁻ᵀ: dF⁻ᵀ = −F⁻ᵀ dFᵀ F⁻ᵀ
    for k, (i, j) in enumerate(pairs):
        shears[1, :, k] -= turned[:, i] / stretch[:, j]
    return torch.stack(rows, 1) - torch.diag_embed(turned / stretch), shears


def _positive_part(a: Tensor) -> Tensor:
    """Symmetric matrices [P, D, D] without their negative eigenvalues."""
    finite = a.isfinite().all((1, 2), True)
    eigenvalues, axes = torch.linalg.eigh(torch.where(finite, a, 0))
    return torch.where(finite, (axes * eigenvalues.clamp_min(0)[:, None, :]) @ axes.mT, torch.nan)
