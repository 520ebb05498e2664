"""The clay of GaussianFluent ("watermelon"): non-associative Cam-Clay of Wolper et al. 2019."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...geometry.vectors import norm
from ...laws import isotropic
from .distortion import principal_stress
from .stretches import StretchPlasticity

if TYPE_CHECKING:
    from ...state.state import State

LEAST = 1e-4
"""Margin of the yield surface [Pa or Pa²] within which nothing flows or hardens."""


class NonAssociativeCamClay(StretchPlasticity):
    """Non-associative Cam-Clay (Wolper et al. 2019, "CD-MPM", section 4.2) on τ = μ J^(−2/3) dev b + κ/2 (J² − 1).

    Flow keeps the volume, or projects to an apex; the pressure p₀ = κ (10⁻⁵ + sinh(ξ max(−ln J_p, 0))) follows the
    plastic volume where the material hardens.
    State: state.extra["log_plastic_volume"], ln J_p.

    Args:
        E, nu: [Pa] and -: numbers or tensors [] or [P].
        slope: M of the critical state, likewise.
        beta: cohesion β, likewise.
        xi: ξ, likewise.
        log_plastic_volume: ln J_p at the start, likewise.
        hardens: whether ln J_p changes.
    """

    extra_fields = ("log_plastic_volume",)

    def __init__(self, E: Any, nu: Any, slope: Any, beta: Any, xi: Any, log_plastic_volume: Any, hardens: bool) -> None:
        super().__init__(E, nu, slope=slope, beta=beta, xi=xi, log_plastic_volume=log_plastic_volume)
        self.hardens = hardens

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        mu, lam = self._moduli(state)
        kappa = lam + 2 / 3 * mu
        M, beta, xi = (self._column(name, state) for name in ("slope", "beta", "xi"))
        log_J = state.extra["log_plastic_volume"][:, None]
        limit = kappa * (1e-5 + (xi * (-log_J).clamp_min(0)).sinh())

        def flow(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            mapped, moved = self._mapped(sigma, mu, kappa, M, beta, limit)
            return mapped, principal_stress(mapped, mu, kappa), log_J + (moved if self.hardens else 0 * moved)

        F, stress, log_J = isotropic(state.F, flow)
        return {"F": F, "log_plastic_volume": log_J[:, 0]}, stress

    def _mapped(self, sigma: Tensor, mu: Any, kappa: Any, M: Any, beta: Any, limit: Tensor) -> tuple[Tensor, Tensor]:
        """Stretches after flow [P, 3], and the change of ln J_p [P, 1]."""
        J, square = sigma.prod(1, keepdim=True), sigma.square()
        mean = square.mean(1, keepdim=True)
        tau = principal_stress(sigma, mu, kappa)
        p = -tau.mean(1, keepdim=True)
        s = tau + p
        half = 1.5 * (1 + 2 * beta)
        bound = M * M * (p + beta * limit) * (p - limit)
        above, below = p > limit, p < -beta * limit
        yields = (half * s.square().sum(1, keepdim=True) + bound >= LEAST) & ~above & ~below
        apex = torch.where(above, 1 - 2 * limit / kappa, 1 + 2 * beta * limit / kappa).sqrt()
        size = norm(s)[:, None].clamp_min(1e-10)
        inner = torch.where(yields, -bound / half, 1).clamp_min(1e-30).sqrt()
        sheared = (J.pow(2 / 3) / mu * inner / size * s + mean).clamp_min(1e-30).sqrt()
        mapped = torch.where(above | below, apex.pow(1 / 3), torch.where(yields, sheared, sigma))
        moved = torch.where(above | below, (J / torch.where(above | below, apex, 1)).log(), 0)
        compacts = yields & (limit > LEAST) & (p < limit - LEAST) & (p > LEAST - beta * limit)
        hardened = _hardening(J, p, size, M, beta, limit, kappa)
        return mapped, torch.where(compacts, hardened, moved)


def _hardening(J: Tensor, p: Tensor, size: Tensor, M: Any, beta: Any, limit: Tensor, kappa: Any) -> Tensor:
    """Change of ln J_p [P, 1] where the line from the trial state to the centre of the ellipse meets it."""
    centre = (1 - beta) * limit / 2
    along, across = centre - p, -(1.5**0.5) * size
    length = (along * along + across * across).sqrt().clamp_min(1e-10)
    along, across = along / length, across / length
    c = M * M * (centre + beta * limit) * (centre - limit)
    b = M * M * along * (2 * centre - limit + beta * limit)
    a = M * M * along * along + (1 + 2 * beta) * across * across
    root = (b * b - 4 * a * c).clamp_min(0).sqrt()
    first, second = (centre + (-b + sign * root) / (2 * a) * along for sign in (1, -1))
    meets = torch.where((p - centre) * (first - centre) > 0, first, second)
    squared = 1 - 2 * meets / kappa
    projected = squared.abs().clamp_min(1e-30).sqrt()
    return torch.where(projected > LEAST, (J / projected).log(), 0)
