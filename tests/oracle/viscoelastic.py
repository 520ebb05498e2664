"""The viscoelastic law in plain torch, from its definition: the branch by the eigenvectors of b_e = F_e F_eᵀ."""

from __future__ import annotations

import torch
from torch import Tensor


def viscoelastic_update(
    F: Tensor,
    mu: Tensor,
    lam: Tensor,
    branch_modulus: Tensor,
    relaxation_time: Tensor,
    dt: Tensor,
    inverse_viscous_deformation: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """τ [P, D, D], F_v⁻¹ − 1 [P, D, D] and dissipated energy [P]; parameters [P] each, det F > 0."""
    identity = torch.eye(F.shape[1], dtype=F.dtype, device=F.device)
    elastic = F @ (identity + inverse_viscous_deformation)
    square, axes = torch.linalg.eigh(elastic @ elastic.mT)
    h = square.log() / 2
    deviator = h - h.mean(1, keepdim=True)
    flowed = deviator / (1 + dt / relaxation_time)[:, None]
    principal = 2 * branch_modulus[:, None] * flowed
    stress = axes @ torch.diag_embed(principal) @ axes.mT
    stress = stress + mu[:, None, None] * (F @ F.mT - identity)
    stress = stress + (lam * torch.linalg.det(F).log())[:, None, None] * identity
    factor = axes @ torch.diag_embed((flowed - deviator).exp()) @ axes.mT
    inverse = torch.linalg.solve(F, factor @ elastic)
    return stress, inverse - identity, (principal * (deviator - flowed)).sum(1)
