"""The materials of PhysGaussian's simulator as laws of torch_mpm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...geometry.vectors import norm
from ...laws import FixedCorotated, Material, QuarticSand, WeaklyCompressible, isotropic
from ..constitutive import lame
from .clay import NonAssociativeCamClay
from .distortion import DistortionalFluid, StretchedNeoHookean
from .parameters import hardens
from .stretches import StretchPlasticity, strain_deviator, stretched_hencky
from .viscous_branch import ViscousJelly

if TYPE_CHECKING:
    from ...state.state import State

FLUID_EXPONENT = 1.1
"""Exponent of the pressure of fluids, K (J^-γ − 1)."""
NORM_OFFSET = 1e-6
"""Added to the norm of the strain deviator in the von Mises return maps."""


class Metal(StretchPlasticity):
    """Von Mises plasticity, |dev (2 μ ε)| ≤ y, with the stress (2 μ ε + λ tr ε) σ; ε are the logarithms of stretches σ.

    State: state.extra["yield_stress"], which hardens by 2 μ ξ Δγ.

    Args:
        E, nu, yield_stress: [Pa], -, [Pa]: numbers or tensors [] or [P].
        xi: ξ, likewise; 0 without hardening.
    """

    extra_fields = ("yield_stress",)
    xi: Any

    def __init__(self, E: Any, nu: Any, yield_stress: Any, xi: Any = 0.0) -> None:
        super().__init__(E, nu, yield_stress=yield_stress, xi=xi)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        mu, lam = self._moduli(state)
        limit, xi = state.extra["yield_stress"][:, None], self._column("xi", state)

        def flow(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            mapped, excess = _von_mises(sigma, mu, limit)
            return mapped, stretched_hencky(mapped, mu, lam), limit + 2 * mu * xi * excess

        F, stress, limit = isotropic(state.F, flow)
        return {"F": F, "yield_stress": limit[:, 0]}, stress


class Foam(StretchPlasticity):
    """Viscoplasticity, |dev (2 μ ε)| ≤ √(2/3) y with a viscosity; stress as `Metal`.

    Args:
        E, nu, yield_stress: [Pa], -, [Pa]: numbers or tensors [] or [P].
        plastic_viscosity: [Pa s], likewise.
    """

    rate_dependent = True
    plastic_viscosity: Any

    def __init__(self, E: Any, nu: Any, yield_stress: Any, plastic_viscosity: Any = 0.0) -> None:
        super().__init__(E, nu, yield_stress=yield_stress, plastic_viscosity=plastic_viscosity)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        mu, lam = self._moduli(state)
        limit = math.sqrt(2 / 3) * self._column("yield_stress", state)
        viscosity = self._column("plastic_viscosity", state)
        dt = getattr(state, "dt", 0.0)  # Outside a step there is no flow.

        def flow(sigma: Tensor) -> tuple[Tensor, Tensor]:
            clamped, mean, deviator = strain_deviator(sigma)
            size = norm(deviator)[:, None]
            trial = 2 * mu * size
            flows = (trial > limit) & (size > 0)
            fluidity = 2 * mu * clamped.square().mean(1, keepdim=True) * dt
            kept = trial - (trial - limit) * fluidity / (fluidity + viscosity).clamp_min(1e-30)
            share = torch.where(flows, kept, 1) / torch.where(flows, trial, 1)
            mapped = torch.where(flows, (mean + share * deviator).exp(), sigma)
            return mapped, stretched_hencky(mapped, mu, lam)

        F, stress = isotropic(state.F, flow)
        return {"F": F}, stress


class Plasticine(StretchPlasticity):
    """Von Mises plasticity as `Metal` that softens and breaks, with fixed corotated stress.

    State: state.extra["yield_stress"], which falls by the plastic strain times `softening`, and state.extra["intact"],
        zero from the step on in which the yield stress has reached zero: the particle then has no stress.

    Args:
        E, nu, yield_stress: [Pa], -, [Pa]: numbers or tensors [] or [P].
        softening: [Pa], likewise.
        xi: hardening of the yield stress as for `Metal`; 0 for none.
        corotated: whether the stress is fixed corotated, as in PhysGaussian, or that of `Metal`, as in PhysFlow.
    """

    extra_fields = ("yield_stress", "intact")
    softening: Any
    xi: Any

    def __init__(
        self, E: Any, nu: Any, yield_stress: Any, softening: Any = 0.1, xi: Any = 0.0, corotated: bool = True
    ) -> None:
        super().__init__(E, nu, yield_stress=yield_stress, softening=softening, xi=xi)
        self.corotated = corotated

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        limit, intact = state.extra["yield_stress"][:, None], state.extra["intact"][:, None]
        full_mu, full_lam = self._moduli(state)
        softening, xi = (self._column(name, state) for name in ("softening", "xi"))

        def flow(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            whole = (intact > 0) & (limit > 0)
            mapped, excess = _von_mises(sigma, full_mu, torch.where(whole, limit, torch.inf))
            size = norm(strain_deviator(sigma)[2])[:, None]
            softened = limit - softening * excess * size / (size + NORM_OFFSET)
            left = torch.where((softened > 0) | (excess == 0), intact, 0)
            mu, lam = full_mu * left, full_lam * left
            J = mapped.prod(1, keepdim=True)
            tau = 2 * mu * (mapped - 1) * mapped + lam * J * (J - 1)
            tau = tau if self.corotated else stretched_hencky(mapped, mu, lam)
            return mapped, tau, softened + 2 * mu * xi * excess, left

        F, stress, limit, left = isotropic(state.F, flow)
        return {"F": F, "yield_stress": limit[:, 0], "intact": left[:, 0]}, stress


def _von_mises(sigma: Tensor, mu: Any, limit: Tensor) -> tuple[Tensor, Tensor]:
    """Stretches [P, D] with |dev 2 μ ε| ≤ limit, and the excess of the strain, [P, 1]."""
    _, mean, deviator = strain_deviator(sigma)
    size = norm(deviator)[:, None]
    stiffness = 2 * mu * torch.ones_like(size)
    flows = stiffness * size > limit
    size = torch.where(flows, size, 1) + NORM_OFFSET
    bound = torch.where(flows, limit, 0) / torch.where(flows, stiffness, 1)
    mapped = torch.where(flows, (mean + bound / size * deviator).exp(), sigma)
    return mapped, torch.where(flows, size - bound, 0)


def law_of(kind: str, parameters: Mapping[str, Any]) -> Material:
    """Law of a kind of material with parameters in SI units under the names of `set_parameters_dict`.

    Raises:
        ValueError: for snow, which has no stress in PhysGaussian.
    """
    if kind == "snow":
        raise ValueError(
            "material 'snow' has no stress in the simulator that this class stands for: its particles fly apart. Pass "
            "a law instead, such as material=torch_mpm.Snow(E=1.4e5, nu=0.2)"
        )
    if kind in ("fluid", "fluid of bulk"):
        bulk = parameters["bulk_modulus" if kind == "fluid" else "bulk"]
        return WeaklyCompressible(bulk_modulus=FLUID_EXPONENT * bulk, gamma=FLUID_EXPONENT)
    if kind == "stationary":
        return FixedCorotated(mu=0.0, lam=0.0)
    if kind == "newtonian of mu and bulk":
        return DistortionalFluid(mu=parameters["mu"], bulk=parameters["bulk"])
    return _solid(kind, parameters["E"], parameters["nu"], parameters)


def _solid(kind: str, E: Any, nu: Any, parameters: Mapping[str, Any]) -> Material:
    """Law of a material with Young's modulus and Poisson's ratio."""
    xi = parameters.get("xi", 0.0) if hardens(kind, parameters) else 0.0
    if kind == "jelly":
        return FixedCorotated(E=E, nu=nu)
    if kind == "viscous jelly":
        return ViscousJelly(E, nu, *(parameters[name] for name in ("mu_N", "lam_N", "viscosity")))
    if kind in ("sand", "sand of an angle"):
        angle = math.pi / 180 * parameters.get("friction_angle", 25.0)
        return QuarticSand(E=E, nu=nu, friction_angle=angle, energy="hencky")
    if kind in ("newtonian", "neo-hookean"):
        mu, lam = lame(E, nu)
        if kind == "newtonian":
            return DistortionalFluid(mu=mu, bulk=lam + 2 / 3 * mu)
        return StretchedNeoHookean(E, nu)
    if kind == "watermelon":
        return NonAssociativeCamClay(E, nu, xi=xi, hardens=hardens(kind, parameters), **_clay(parameters))
    limit = parameters["yield_stress"]
    if kind in ("metal", "hardening metal"):
        return Metal(E, nu, limit, xi)
    if kind == "foam":
        return Foam(E, nu, limit, parameters.get("plastic_viscosity", 0.0))
    softening = parameters.get("softening", 0.1 if kind == "plasticine" else 0.0)
    return Plasticine(E, nu, limit, softening, xi, corotated=kind == "plasticine")


def _clay(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Slope, cohesion and initial history of the clay of a friction angle [degrees]."""
    angle = parameters.get("friction_angle", 45.0)
    sine = torch.deg2rad(angle).sin() if isinstance(angle, Tensor) else math.sin(math.radians(angle))
    slope = 6 * sine / (3 - sine)
    return {"slope": slope, "beta": parameters["beta"], "log_plastic_volume": parameters.get("alpha_0", -0.04)}
