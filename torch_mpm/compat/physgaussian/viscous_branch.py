"""The viscoelastic jelly of Physics3D: fixed corotated with a viscous branch in parallel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...laws import FixedCorotated, isotropic
from ...ops.svd import polar
from .stretches import LEAST_STRETCH, StretchPlasticity

if TYPE_CHECKING:
    from ...state.state import State


class ViscousJelly(StretchPlasticity):
    """Fixed corotated stress plus that of a branch with a deformation F_N of its own, which relaxes.

    In each step the Hencky strains ε of F_N become A (ε − B tr ε) with A = 1/(1 + dt α), B = dt β/(1 + dt (α + 3 β)),
    α = 2 μ_N/η, β = 2 (2 μ_N + 3 λ_N)/(9 η) − 2 μ_N/(3 η). Its stress is the symmetric part of U τ Vᵀ with the singular
    vectors of F_N and τ = 2 μ_N ε_new + λ_N tr ε (arXiv 2406.04338, section 3.2, and its program).
    State: state.extra["viscous_map"], F⁻¹ F_N − 1, which steps leave as it is.

    Args:
        E, nu: of the elastic part [Pa], -: numbers or tensors [] or [P].
        mu_N, lam_N: μ_N and λ_N [Pa], likewise.
        viscosity: η [Pa s], likewise.
    """

    extra_fields = ("viscous_map",)
    rate_dependent = True
    mu_N: Any
    lam_N: Any
    viscosity_N: Any

    def __init__(self, E: Any, nu: Any, mu_N: Any, lam_N: Any, viscosity: Any) -> None:
        super().__init__(E, nu, mu_N=mu_N, lam_N=lam_N, viscosity_N=viscosity)
        self.elastic = FixedCorotated(E=E, nu=nu)

    def initial(self, name: str, state: State) -> Tensor:
        return state.x.new_zeros(len(state.x), 3, 3)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        F, eye = state.F, torch.eye(3, dtype=state.F.dtype, device=state.F.device)
        trial = F @ (state.extra["viscous_map"] + eye)
        relaxed, stress = isotropic(trial, lambda sigma: self._branch(sigma, state))
        turned = stress @ polar(trial).R
        _, elastic = self.elastic.update(state)
        return {"viscous_map": torch.linalg.solve_ex(F, relaxed)[0] - eye}, elastic + (turned + turned.mT) / 2

    def _branch(self, sigma: Tensor, state: State) -> tuple[Tensor, Tensor]:
        """Stretches of F_N after relaxation, and principal stresses."""
        mu, lam, eta = (self._column(name, state) for name in ("mu_N", "lam_N", "viscosity_N"))
        dt = getattr(state, "dt", 0.0)  # Outside a step there is no flow.
        alpha = 2 * mu / eta
        beta = 2 * (2 * mu + 3 * lam) / (9 * eta) - 2 * mu / (3 * eta)
        strain = sigma.clamp_min(LEAST_STRETCH).log()
        trace = strain.sum(1, keepdim=True)
        new = (strain - dt * beta / (1 + dt * (alpha + 3 * beta)) * trace) / (1 + dt * alpha)
        return new.exp(), 2 * mu * new + lam * trace
