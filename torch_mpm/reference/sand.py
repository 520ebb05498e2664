"""The sand model of csrc/materials/quartic*.h in plain torch, written from its definitions; the root by bisection."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .material import per_particle
from .svd import svd3

QUARTIC_COEFFICIENT = 6.254421582537118
ENERGIES = ("full", "unilateral", "hencky", "mixed")
ELASTIC, CONE, APEX, INVALID = range(4)


def friction_alpha(angle: Tensor, dim: int) -> Tensor:
    """Slope α of the Drucker-Prager cone |dev τ| + α tr τ = 0 for a friction angle [rad].

    In 3-D it meets the Mohr-Coulomb surface in triaxial compression (Klár et al. 2016); in 2-D everywhere.
    """
    sine = torch.sin(angle)
    return sine / math.sqrt(2) if dim == 2 else math.sqrt(2 / 3) * 2 * sine / (3 - sine)


def energy_density(h: Tensor, mu: Tensor, lam: Tensor, energy: str) -> Tensor:
    """ψ [P] of Hencky strains h [P, D]."""
    trace = h.sum(1)
    if energy == "hencky":
        return mu * h.square().sum(1) + lam / 2 * trace**2
    if energy != "full":
        h, trace = h.clamp(max=0), trace.clamp(max=0)
    return QUARTIC_COEFFICIENT * (mu * (h**4).sum(1) + lam / 2 * trace**4)


def principal_stress(h: Tensor, mu: Tensor, lam: Tensor, energy: str) -> Tensor:
    """τ [P, D] of Hencky strains h [P, D]."""
    mu, lam, trace = mu[:, None], lam[:, None], h.sum(1, keepdim=True)
    if energy == "hencky":
        return 2 * mu * h + lam * trace
    if energy != "full":
        h, trace = h.clamp(max=0), trace.clamp(max=0)
    return QUARTIC_COEFFICIENT * (4 * mu * h**3 + 2 * lam * trace**3)


def yield_value(h: Tensor, mu: Tensor, lam: Tensor, alpha: Tensor, energy: str) -> Tensor:
    """|dev τ| + α tr τ [P], with the full energy for "mixed"."""
    stress = principal_stress(h, mu, lam, "full" if energy == "mixed" else energy)
    return (stress - stress.mean(1, keepdim=True)).norm(dim=1) + alpha * stress.sum(1)


def nearest_extension(h: Tensor) -> Tensor:
    """The nearest h ≥ 0 [P, D] of the same trace ≥ 0 (projection onto a simplex; Held, Wolfe and Crowder 1974)."""
    ordered = h.sort(1, descending=True).values
    count = torch.arange(1, h.shape[1] + 1, dtype=h.dtype, device=h.device)
    shifts = (ordered.cumsum(1) - h.sum(1, keepdim=True)) / count
    last = (ordered > shifts).sum(1, keepdim=True) - 1
    return (h - shifts.gather(1, last.clamp(min=0))).clamp(min=0)


def return_map_strain(
    h: Tensor, mu: Tensor, lam: Tensor, alpha: Tensor, energy: str, apex: str = "zero"
) -> tuple[Tensor, Tensor]:
    """The mapped strain [P, D] and the branch [P] of trial strains h, for μ > 0 and positive bulk modulus."""
    p = h.mean(1, keepdim=True)
    deviator = h - p
    outside = yield_value(h, mu, lam, alpha, energy) > 0
    low, high = torch.zeros_like(mu), torch.ones_like(mu)
    for _ in range(200):
        middle = (low + high) / 2
        above = yield_value(p + middle[:, None] * deviator, mu, lam, alpha, energy) > 0
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    on_cone = outside & (p[:, 0] < 0)
    at_apex = outside & (p[:, 0] >= 0)
    at_rest = nearest_extension(h) if apex == "keep" else torch.zeros_like(h)
    mapped = torch.where(on_cone[:, None], p + ((low + high) / 2)[:, None] * deviator, h)
    mapped = torch.where(at_apex[:, None], at_rest, mapped)
    return mapped, torch.where(on_cone, CONE, torch.where(at_apex, APEX, ELASTIC)).int()


def quartic_return_map(
    F: Tensor,
    mu: Tensor,
    lam: Tensor,
    alpha: Tensor,
    scene: Tensor | None = None,
    energy: str = "unilateral",
    apex: str = "zero",
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """F, τ, branch, multiplier and dissipated energy; see `torch_mpm.ops.quartic_return_map`."""
    mu, lam, alpha = (per_particle(p, scene, F.shape[0]) for p in (mu, lam, alpha))
    meaningful = F.isfinite().all(2).all(1)
    meaningful = meaningful & (torch.linalg.det(torch.where(meaningful[:, None, None], F, 0)) > 0)
    safe = torch.where(meaningful[:, None, None], F, torch.eye(F.shape[1], dtype=F.dtype, device=F.device))
    U, sigma, V = svd3(safe)
    h = sigma.log()
    if apex == "none":
        mapped, branch = h, torch.zeros_like(mu, dtype=torch.int32)
    else:
        mapped, branch = return_map_strain(h, mu, lam, alpha, energy, apex)
    moved = meaningful & (branch != ELASTIC)
    stress = (U * principal_stress(mapped, mu, lam, energy)[:, None, :]) @ U.mT
    lost = energy_density(h, mu, lam, energy) - energy_density(mapped, mu, lam, energy)
    return (
        torch.where(moved[:, None, None], (U * mapped.exp()[:, None, :]) @ V.mT, F),
        torch.where(meaningful[:, None, None], stress, 0),
        torch.where(meaningful, branch, INVALID),
        torch.where(moved, (h - mapped).norm(dim=1), 0),
        torch.where(moved, lost, 0),
    )
