"""The laws in principal strains of csrc/laws in plain torch, from their definitions; roots by bisection."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .material import per_particle
from .svd import svd3

ELASTIC, PLASTIC, INVALID = 0, 1, 3

Flow = Callable[..., tuple[Tensor, list[Tensor], Tensor]]


@dataclasses.dataclass(frozen=True)
class PrincipalLaw:
    """One law. All functions take Hencky strains h [P, D], a list of parameters and a list of history, [P] each.

    Attributes:
        parameters: names, in the order of the op.
        history: names of the history variables.
        energy: ψ [P].
        stress: principal Kirchhoff stresses [P, D].
        flow: mapped strains, new history and whether the state yields; None for an elastic law.
        heat: dissipated energy [P] of trial and mapped strains, parameters, history before and after.
    """

    parameters: tuple[str, ...]
    history: tuple[str, ...]
    energy: Callable[..., Tensor]
    stress: Callable[..., Tensor]
    flow: Flow | None
    heat: Callable[..., Tensor] | None = None


def _hencky_energy(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> Tensor:
    return p[0] * h.square().sum(1) + p[1] / 2 * h.sum(1) ** 2


def _hencky_stress(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> Tensor:
    return 2 * p[0][:, None] * h + (p[1] * h.sum(1))[:, None]


def _corotated_energy(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> Tensor:
    return p[0] * (h.exp() - 1).square().sum(1) + p[1] / 2 * (h.sum(1).exp() - 1) ** 2


def _corotated_stress(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> Tensor:
    sigma, J = h.exp(), h.sum(1).exp()
    return 2 * p[0][:, None] * sigma * (sigma - 1) + (p[1] * J * (J - 1))[:, None]


def _hardened(p: Sequence[Tensor], q: Sequence[Tensor]) -> list[Tensor]:
    factor = (p[4] * (1 - q[0].exp())).exp()
    return [factor * p[0], factor * p[1]]


def _snow_energy(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> Tensor:
    return _corotated_energy(h, _hardened(p, q), q)


def _snow_stress(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> Tensor:
    return _corotated_stress(h, _hardened(p, q), q)


def _snow_flow(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], Tensor]:
    sigma = h.exp()
    mapped = sigma.clamp((1 - p[2])[:, None], (1 + p[3])[:, None])
    return mapped.log(), [q[0] + (h - mapped.log()).sum(1)], (mapped != sigma).any(1)


def _shear(h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean [P, 1], deviator [P, D] and its norm [P]."""
    mean = h.mean(1, keepdim=True)
    return mean, h - mean, (h - mean).norm(dim=1)


def _radial(h: Tensor, kappa: Tensor, plastic: Tensor, shift: Tensor | None = None) -> Tensor:
    mean, deviator, _ = _shear(h)
    moved = mean if shift is None else mean + shift[:, None]
    return torch.where(plastic[:, None], moved + kappa[:, None] * deviator, h)


def _von_mises_flow(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], Tensor]:
    mu, _, strength, modulus = p
    norm = _shear(h)[2]
    excess = 2 * mu * norm - math.sqrt(2 / 3) * (strength + modulus * q[0])
    plastic = excess > 0
    multiplier = torch.where(plastic, excess / (2 * mu + 2 / 3 * modulus), 0)
    mapped = _radial(h, 1 - multiplier / norm.where(plastic, torch.ones_like(norm)), plastic)
    return mapped, [q[0] + math.sqrt(2 / 3) * multiplier], plastic


def _bisect(residual: Callable[[Tensor], Tensor], low: Tensor, high: Tensor) -> Tensor:
    """Zero of a residual that is negative at `low` and positive at `high`."""
    for _ in range(200):
        middle = (low + high) / 2
        positive = residual(middle) > 0
        low, high = torch.where(positive, low, middle), torch.where(positive, middle, high)
    return (low + high) / 2


def _viscoplastic_flow(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], Tensor]:
    mu, _, strength, consistency, exponent, dt = p
    trial = math.sqrt(2) * mu * _shear(h)[2]
    plastic = (trial > strength) & (mu * dt > 0)

    def residual(rate: Tensor) -> Tensor:  # Stress of the rate, and the remaining elastic strain.
        return strength + consistency * rate**exponent + mu * dt * rate - trial

    safe = torch.where(plastic, mu * dt, 1)
    rate = _bisect(residual, torch.zeros_like(trial), (trial - strength).clamp(min=0) / safe)
    kappa = (trial - mu * dt * rate) / torch.where(plastic, trial, 1)
    return _radial(h, kappa, plastic), [], plastic


def _cam_clay_flow(h: Tensor, p: Sequence[Tensor], q: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], Tensor]:
    mu, lam, M, initial, theta, beta = p
    dim = h.shape[1]
    bulk, shear = lam + 2 * mu / dim, math.sqrt((6 - dim) / 2) * 2 * mu * _shear(h)[2]
    pressure = -bulk * h.sum(1)

    def ellipse(w: Tensor) -> tuple[Tensor, Tensor]:
        """Half axis and cosine after the plastic compaction w."""
        consolidation = initial * (theta * (w - q[0])).clamp(-10, 10).exp()
        size = (1 + beta) / 2 * consolidation
        return size, (pressure - bulk * w - (1 - beta) / 2 * consolidation) / size

    size, start = ellipse(torch.zeros_like(bulk))
    plastic = shear**2 + (M * size) ** 2 * (start**2 - 1) > 0
    side = torch.where(start < 0, -1.0, 1.0).to(h.dtype)

    def residual(w: Tensor) -> Tensor:
        """Negative while the state after a compaction |w| is outside of the yield surface."""
        size, cosine = ellipse(side * w)
        sine = (1 - cosine**2).clamp(min=0).sqrt()
        flowed = side * (sine * ((6 - dim) * mu * side * w + M**2 * size * cosine) - M * cosine * shear)
        before = torch.where(side * cosine > 1, -1.0, flowed)
        return torch.where(side * cosine < 0, 1.0, before)

    largest = (start * size).abs() / bulk
    compaction = side * _bisect(residual, torch.zeros_like(bulk), largest)
    size, cosine = ellipse(compaction)
    radius = torch.where(
        cosine.abs() > 0.5,
        shear / (1 + (6 - dim) * mu * compaction / (M**2 * size * cosine)),
        M * size * (1 - cosine**2).clamp(min=0).sqrt(),
    )
    kappa = torch.where(shear > 0, radius / torch.where(shear > 0, shear, 1), 1)
    return _radial(h, kappa, plastic, compaction / dim), [torch.where(plastic, q[0] - compaction, q[0])], plastic


def _plastic_work(stress: Tensor, h: Tensor, mapped: Tensor) -> Tensor:
    return (stress * (h - mapped)).sum(1)


def _hencky_heat(
    h: Tensor, mapped: Tensor, p: Sequence[Tensor], before: Sequence[Tensor], after: Sequence[Tensor]
) -> Tensor:
    return _plastic_work(_hencky_stress(mapped, p, after), h, mapped)


def _von_mises_heat(
    h: Tensor, mapped: Tensor, p: Sequence[Tensor], before: Sequence[Tensor], after: Sequence[Tensor]
) -> Tensor:
    """Plastic work minus the work of hardening H ε̄ dε̄, both by backward Euler."""
    return _hencky_heat(h, mapped, p, before, after) - p[3] * after[0] * (after[0] - before[0])


def _snow_heat(
    h: Tensor, mapped: Tensor, p: Sequence[Tensor], before: Sequence[Tensor], after: Sequence[Tensor]
) -> Tensor:
    stored = _snow_energy(mapped, p, after) - _snow_energy(mapped, p, before)
    return _plastic_work(_snow_stress(mapped, p, after), h, mapped) - stored


LAWS = {
    "fixed_corotated": PrincipalLaw(("mu", "lam"), (), _corotated_energy, _corotated_stress, None),
    "hencky": PrincipalLaw(("mu", "lam"), (), _hencky_energy, _hencky_stress, None),
    "von_mises": PrincipalLaw(
        ("mu", "lam", "yield_stress", "hardening"),
        ("plastic_strain",),
        _hencky_energy,
        _hencky_stress,
        _von_mises_flow,
        _von_mises_heat,
    ),
    "herschel_bulkley": PrincipalLaw(
        ("mu", "lam", "yield_stress", "consistency", "exponent", "dt"),
        (),
        _hencky_energy,
        _hencky_stress,
        _viscoplastic_flow,
        _hencky_heat,
    ),
    "snow": PrincipalLaw(
        ("mu", "lam", "critical_compression", "critical_stretch", "hardening"),
        ("log_plastic_volume",),
        _snow_energy,
        _snow_stress,
        _snow_flow,
        _snow_heat,
    ),
    "cam_clay": PrincipalLaw(
        ("mu", "lam", "critical_slope", "consolidation", "hardening", "cohesion"),
        ("log_plastic_volume",),
        _hencky_energy,
        _hencky_stress,
        _cam_clay_flow,
        _hencky_heat,
    ),
}


def _strains(F: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Whether F is meaningful, and U, h, V of these; of the identity for the others."""
    meaningful = F.isfinite().all(2).all(1)
    meaningful = meaningful & (torch.linalg.det(torch.where(meaningful[:, None, None], F, 0)) > 0)
    safe = torch.where(meaningful[:, None, None], F, torch.eye(F.shape[1], dtype=F.dtype, device=F.device))
    U, sigma, V = svd3(safe)
    return meaningful, U, sigma.log(), V


def principal_update(
    law: str, F: Tensor, parameters: Sequence[Tensor], history: Sequence[Tensor] = (), scene: Tensor | None = None
) -> tuple[Tensor, Tensor, list[Tensor], Tensor, Tensor]:
    """F, τ, history, dissipated energy and branch; see `torch_mpm.ops.principal_update`."""
    this = LAWS[law]
    p = [per_particle(v, scene, F.shape[0]) for v in parameters]
    meaningful, U, h, V = _strains(F)
    mapped, moved, plastic = h, list(history), torch.zeros_like(meaningful)
    if this.flow is not None:
        mapped, moved, plastic = this.flow(h, p, history)
    plastic = plastic & meaningful
    stress = (U * this.stress(mapped, p, moved)[:, None, :]) @ U.mT
    heat = torch.zeros_like(h[:, 0])
    if this.heat is not None:
        heat = this.heat(h, mapped, p, history, moved).clamp(min=0)
    branch = torch.where(plastic, PLASTIC, ELASTIC)
    return (
        torch.where(plastic[:, None, None], (U * mapped.exp()[:, None, :]) @ V.mT, F),
        torch.where(meaningful[:, None, None], stress, 0),
        [torch.where(plastic, new, old) for new, old in zip(moved, history, strict=True)],
        torch.where(plastic, heat, 0),
        torch.where(meaningful, branch, INVALID).int(),
    )


def principal_energy(
    law: str, F: Tensor, parameters: Sequence[Tensor], history: Sequence[Tensor] = (), scene: Tensor | None = None
) -> Tensor:
    """See `torch_mpm.ops.principal_energy`."""
    p = [per_particle(v, scene, F.shape[0]) for v in parameters]
    meaningful, _, h, _ = _strains(F)
    return torch.where(meaningful, LAWS[law].energy(h, p, history), torch.inf)
