"""Plastic flow inside an implicit step: stress after the return map of a trial deformation, and its tangent.

The Kirchhoff stress of the mapped state is as isotropic in the trial deformation as that of an elastic law, so that its
derivative, the consistent tangent (Simo and Taylor 1985), has the form of csrc/laws/tangent.h with derivatives through
the map. The step asks for velocity gradients that move F by dF = L F₀.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..ops.svd import svd3
from ..parameters import Overlay

if TYPE_CHECKING:
    from .material import Material


def flowing_stress(law: Material, state: Any, before: Any) -> Tensor:
    """τ F⁻ᵀ F₀ᵀ [P, D, D] [Pa] of the stress τ after the return map of a trial F."""
    stress = law.update(state)[1]
    inverse = torch.linalg.inv_ex(state.F)[0]
    return torch.where(state.F.isfinite().all((1, 2), True), stress @ (before.F @ inverse).mT, stress)


def flowing_tangent(law: Material, state: Any, before: Any, weight: Tensor, projected: bool) -> Tensor:
    """The derivative of `flowing_stress` by L times a weight [P], as `torch_mpm.ops.law_tangent` has it [P, n].

    Of a flow that is not associated, as that of sand, the symmetric part. Zero where it is not finite.
    """
    dim = state.x.shape[1]
    U, stretch, V = svd3(state.F)
    stress, moduli, quotients = _principal_derivatives(law, state, stretch)
    scale = weight[:, None, None] / (stretch[:, :, None] * stretch[:, None, :])
    diagonal = scale * (0.5 * (moduli + moduli.mT) - torch.diag_embed(stress))
    pairs = [(i, j) for i in range(dim) for j in range(i + 1, dim)]
    h = stretch.abs().log()
    evens, odds = [], []
    for (i, j), quotient in zip(pairs, quotients, strict=True):
        half, mean = 0.5 * (h[:, i] - h[:, j]), 0.5 * (stress[:, i] + stress[:, j])
        sinhc = _sinhc(half)
        evens.append(scale[:, i, j] * (quotient * half.cosh() / sinhc - mean))
        odds.append(scale[:, i, j] * (mean - quotient * half * half * sinhc / half.cosh()))
    even, odd = torch.stack(evens, 1), torch.stack(odds, 1)
    if projected:
        diagonal, even, odd = _positive_part(diagonal), even.clamp_min(0), odd.clamp_min(0)
    upper = [diagonal[:, i, j] for i in range(dim) for j in range(i, dim)]
    B = before.F @ V
    entries = torch.cat([U.flatten(1), B.flatten(1), torch.stack(upper, 1), even, odd], 1)
    finite = entries.isfinite().all(1) & (stretch > 0).all(1)
    return torch.where(finite[:, None], entries, 0)


def flowing_skew(law: Material, state: Any, weight: Tensor) -> Tensor:
    """What is not symmetric in the derivative of `flowing_stress`: the skew part of the block between the stretches, in
    the axes of the tangent, times a weight [P, D, D]. Zero where it is not finite."""
    stretch = svd3(state.F)[1]
    _, moduli, _ = _principal_derivatives(law, state, stretch, shears=False)
    skew = 0.5 * weight[:, None, None] * (moduli - moduli.mT) / (stretch[:, :, None] * stretch[:, None, :])
    valid = skew.isfinite().all((1, 2), True) & (stretch > 0).all(1)[:, None, None]
    return torch.where(valid, skew, 0)


def _principal_derivatives(
    law: Material, state: Any, stretch: Tensor, shears: bool = True
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Principal stresses [P, D], their derivatives by the Hencky strains [P, D, D], and (τᵢ − τⱼ)/(hᵢ − hⱼ) [P] of each
    pair: how the stress turns where diag(σ) is sheared, dτᵢⱼ = (τᵢ − τⱼ) σⱼ²/(σᵢ² − σⱼ²), which has a limit at equal
    stretches."""
    dim = stretch.shape[1]
    with torch.inference_mode(False), torch.enable_grad():
        F = torch.diag_embed(stretch.detach()).requires_grad_()
        moved: Any = Overlay(state, F=F)
        stress = law.update(moved)[1]

        def by_F(i: int, j: int) -> Tensor:
            return torch.autograd.grad(stress[:, i, j].sum(), F, retain_graph=True)[0]

        rows = [by_F(i, i).diagonal(dim1=1, dim2=2) * stretch for i in range(dim)]
        quotients = []
        for i in range(dim if shears else 0):
            for j in range(i + 1, dim):
                gap = stretch[:, i].abs().log() - stretch[:, j].abs().log()
                quotients.append(2 * stretch[:, i] * by_F(i, j)[:, i, j] * _sinhc(gap))
    return stress.detach().diagonal(dim1=1, dim2=2), torch.stack(rows, 1), quotients


def _sinhc(x: Tensor) -> Tensor:
    """sinh x/x."""
    small = x.abs() < 1e-3
    return torch.where(small, 1 + x * x / 6, x.sinh() / torch.where(small, 1, x))


def _positive_part(a: Tensor) -> Tensor:
    """Symmetric matrices [P, D, D] without their negative eigenvalues."""
    finite = a.isfinite().all((1, 2), True)
    eigenvalues, axes = torch.linalg.eigh(torch.where(finite, a, 0))
    return torch.where(finite, (axes * eigenvalues.clamp_min(0)[:, None, :]) @ axes.mT, torch.nan)
