"""The sand model of csrc/laws/quartic*.h in plain torch, written from its definitions; the root by bisection."""

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


def flow_step(h: Tensor, c: Tensor, unilateral: bool) -> Tensor:
    """x [P, D] with x + c dev t = h and t the cubes of x, or of its negative parts: c > 0 [P], tr x = tr h.

    With x + c t = h + w each xᵢ is the root of a cubic; w is bisected for the trace.
    """
    c, trace = c[:, None], h.sum(1, keepdim=True)

    def roots(w: Tensor) -> Tensor:
        k = (3 * c).sqrt()
        x = 2 / k * torch.sinh(torch.asinh(1.5 * k * (h + w)) / 3)
        return torch.where(h + w > 0, h + w, x) if unilateral else x

    t = c * (h.clamp(max=0) if unilateral else h) ** 3
    low, high = t.amin(1, keepdim=True), t.amax(1, keepdim=True)
    for _ in range(60):
        middle = (low + high) / 2
        above = roots(middle).sum(1, keepdim=True) > trace
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return roots((low + high) / 2)


def exact_flow(h: Tensor, mu: Tensor, lam: Tensor, alpha: Tensor, energy: str) -> Tensor:
    """The point [P, D] of the yield surface with h = x + c dev t(x) for strains h outside it of negative trace.

    The first root in c > 0, bisected; then Newton's method on all D + 1 equations, whose Jacobian is written out.
    """
    unilateral, (P, D) = energy == "unilateral", h.shape
    scale = h.mean(1, keepdim=True).abs()
    h, one = h / scale, torch.ones_like(mu)
    low, high = -40 * one, 40 * one
    for _ in range(40):
        middle = (low + high) / 2
        above = yield_value(flow_step(h, middle.exp(), unilateral), one, lam / mu, alpha, energy) > 0
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    log_c = (low + high) / 2
    x = flow_step(h, log_c.exp(), unilateral)
    deviatoric = torch.eye(D, dtype=h.dtype, device=h.device) - 1 / D
    for _ in range(8):
        c, t = log_c.exp()[:, None], (x.clamp(max=0) if unilateral else x) ** 3
        slope = 3 * (x.clamp(max=0) if unilateral else x) ** 2
        d = t @ deviatoric
        size = d.norm(dim=1, keepdim=True)
        trace = t.sum(1) + D / 2 * lam / mu * x.sum(1) ** 3
        y_slope = slope * (d / size + alpha[:, None]) + alpha[:, None] * (1.5 * D * lam / mu * x.sum(1) ** 2)[:, None]
        jacobian = torch.zeros(P, D + 1, D + 1, dtype=h.dtype, device=h.device)
        jacobian[:, :D, :D] = torch.eye(D, dtype=h.dtype, device=h.device) + c[:, :, None] * deviatoric * slope[:, None]
        jacobian[:, :D, D] = c * d
        jacobian[:, D, :D] = y_slope / size
        residual = torch.cat([x + c * d - h, 1 + (alpha * trace)[:, None] / size], 1)
        step = torch.linalg.solve(jacobian, residual)
        x, log_c = x - step[:, :D], log_c - step[:, D]
    return x * scale


def return_map_strain(
    h: Tensor, mu: Tensor, lam: Tensor, alpha: Tensor, energy: str, apex: str = "zero", flow: str = "radial"
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
    if flow == "exact" and energy != "hencky" and bool(on_cone.any()):
        mapped[on_cone] = exact_flow(h[on_cone], mu[on_cone], lam[on_cone], alpha[on_cone], energy)
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
    flow: str = "radial",
    cohesion: Tensor | None = None,
    volume_correction: Tensor | None = None,
) -> tuple[Tensor, ...]:
    """F, τ, branch, multiplier, dissipated energy, volume correction; see `torch_mpm.ops.quartic_return_map`."""
    corrects, zero = volume_correction is not None and apex == "zero", torch.zeros_like(mu)
    mu, lam, alpha, cohesion = (
        per_particle(zero if p is None else p, scene, F.shape[0]) for p in (mu, lam, alpha, cohesion)
    )
    volume = torch.zeros_like(mu) if volume_correction is None else volume_correction
    torn = (volume > 0) & corrects
    cohesion = torch.where(torn, 0, cohesion)
    meaningful = F.isfinite().all(2).all(1)
    meaningful = meaningful & (torch.linalg.det(torch.where(meaningful[:, None, None], F, 0)) > 0)
    safe = torch.where(meaningful[:, None, None], F, torch.eye(F.shape[1], dtype=F.dtype, device=F.device))
    U, sigma, V = svd3(safe)
    h = sigma.log()
    trial = h + (volume / F.shape[1] - cohesion)[:, None]
    if apex == "none":
        mapped, branch = trial, torch.zeros_like(mu, dtype=torch.int32)
    else:
        mapped, branch = return_map_strain(trial, mu, lam, alpha, energy, apex, flow)
    mapped = mapped + cohesion[:, None]
    tears = torch.zeros_like(torn)
    if corrects:
        tears = (branch == APEX) | (torn & (trial.sum(1) >= 0))
        mapped, branch = torch.where(tears[:, None], 0, mapped), torch.where(tears, APEX, branch)
    moved = meaningful & ((branch != ELASTIC) | (volume != 0))
    stress = (U * principal_stress(mapped, mu, lam, energy)[:, None, :]) @ U.mT
    heat = dissipation(h, mapped, branch, torch.where(tears & ~torn, cohesion, 0), torn, mu, lam, energy)
    return (
        torch.where(moved[:, None, None], (U * mapped.exp()[:, None, :]) @ V.mT, F),
        torch.where(meaningful[:, None, None], stress, 0),
        torch.where(meaningful, branch, INVALID),
        torch.where(moved, (h - mapped).norm(dim=1), 0),
        torch.where(moved, heat, 0),
        torch.where(moved, volume + h.sum(1) - mapped.sum(1), volume),
    )


def dissipation(
    h: Tensor,
    mapped: Tensor,
    branch: Tensor,
    tearing: Tensor,
    torn: Tensor,
    mu: Tensor,
    lam: Tensor,
    energy: str,
) -> Tensor:
    """Energy [P] that the map turns into heat: the work of its stress on the plastic strain, and the immediate loss.

    The immediate loss is the energy of the strain at which sand tears [P], and at the apex of the unilateral energy all
    of it.
    """
    work = (principal_stress(mapped, mu, lam, energy) * (h - mapped)).sum(1)
    edge = tearing[:, None].expand_as(h)
    tear = energy_density(edge, mu, lam, energy) + (principal_stress(edge, mu, lam, energy) * (h - edge)).sum(1)
    heat = torch.where(tearing > 0, tear, work)
    if energy != "unilateral":
        return heat
    return torch.where((branch == APEX) & ~torn, energy_density(h, mu, lam, energy), heat)
