"""The materials of PhysGaussian's simulator as laws of torch_mpm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...geometry.vectors import norm
from ...laws import FixedCorotated, Material, QuarticSand, isotropic
from ...laws.parameters import evaluate, store
from .parameters import check_gradients, check_material

if TYPE_CHECKING:
    from ...state.state import State

LEAST_STRETCH = 0.01
"""Lower bound of a stretch in logarithms."""
NORM_OFFSET = 1e-6
"""Added to the norm of the strain deviator in the von Mises return maps."""


class StretchPlasticity(Material):
    """Return map in the logarithms of the stretches, with parameters as numbers or tensors [] or [P].

    Args:
        E, nu: Young's modulus [Pa] and Poisson's ratio.
        others: further parameters by name.
    """

    def __init__(self, E: Any, nu: Any, **others: Any) -> None:
        super().__init__()
        self._named = ("E", "nu", *others)
        for name, value in {"E": E, "nu": nu, **others}.items():
            store(self, name, value)

    def initial(self, name: str, state: State) -> Tensor:
        """History begins with the parameter of its name; without one, with one."""
        start = evaluate(name, getattr(self, name), state) if name in self._named else 1.0
        return torch.zeros_like(state.mass) + start

    def _column(self, name: str, state: State) -> Any:
        """A parameter that broadcasts with [P, D]."""
        value = evaluate(name, getattr(self, name), state)
        return value[:, None] if isinstance(value, Tensor) and value.dim() else value

    def _moduli(self, state: State) -> tuple[Any, Any]:
        E, nu = self._column("E", state), self._column("nu", state)
        return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        return ~state.F.isfinite().all((1, 2))


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
            return mapped, _stretched_hencky(mapped, mu, lam), limit + 2 * mu * xi * excess

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
            clamped, mean, deviator = _deviator(sigma)
            size = norm(deviator)[:, None]
            trial = 2 * mu * size
            flows = (trial > limit) & (size > 0)
            fluidity = 2 * mu * clamped.square().mean(1, keepdim=True) * dt
            kept = trial - (trial - limit) * fluidity / (fluidity + viscosity).clamp_min(1e-30)
            share = torch.where(flows, kept, 1) / torch.where(flows, trial, 1)
            mapped = torch.where(flows, (mean + share * deviator).exp(), sigma)
            return mapped, _stretched_hencky(mapped, mu, lam)

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
    """

    extra_fields = ("yield_stress", "intact")
    softening: Any
    xi: Any

    def __init__(self, E: Any, nu: Any, yield_stress: Any, softening: Any = 0.1, xi: Any = 0.0) -> None:
        super().__init__(E, nu, yield_stress=yield_stress, softening=softening, xi=xi)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        limit, intact = state.extra["yield_stress"][:, None], state.extra["intact"][:, None]
        full_mu, full_lam = self._moduli(state)
        softening, xi = (self._column(name, state) for name in ("softening", "xi"))

        def flow(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            whole = (intact > 0) & (limit > 0)
            mapped, excess = _von_mises(sigma, full_mu, torch.where(whole, limit, torch.inf))
            size = norm(_deviator(sigma)[2])[:, None]
            softened = limit - softening * excess * size / (size + NORM_OFFSET)
            left = torch.where((softened > 0) | (excess == 0), intact, 0)
            mu, lam = full_mu * left, full_lam * left
            J = mapped.prod(1, keepdim=True)
            tau = 2 * mu * (mapped - 1) * mapped + lam * J * (J - 1)
            return mapped, tau, softened + 2 * mu * xi * excess, left

        F, stress, limit, left = isotropic(state.F, flow)
        return {"F": F, "yield_stress": limit[:, 0], "intact": left[:, 0]}, stress


def _deviator(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Stretches bounded from below [P, D], and the mean [P, 1] and the deviator [P, D] of their logarithms."""
    clamped = sigma.clamp_min(LEAST_STRETCH)
    strain = clamped.log()
    mean = strain.mean(1, keepdim=True)
    return clamped, mean, strain - mean


def _von_mises(sigma: Tensor, mu: Any, limit: Tensor) -> tuple[Tensor, Tensor]:
    """Stretches [P, D] with |dev 2 μ ε| ≤ limit, and the excess of the strain, [P, 1]."""
    _, mean, deviator = _deviator(sigma)
    size = norm(deviator)[:, None]
    stiffness = 2 * mu * torch.ones_like(size)
    flows = stiffness * size > limit
    size = torch.where(flows, size, 1) + NORM_OFFSET
    bound = torch.where(flows, limit, 0) / torch.where(flows, stiffness, 1)
    mapped = torch.where(flows, (mean + bound / size * deviator).exp(), sigma)
    return mapped, torch.where(flows, size - bound, 0)


def _stretched_hencky(sigma: Tensor, mu: Any, lam: Any) -> Tensor:
    """The simulator's stress of metal and foam: (2 μ ε + λ tr ε) σ, the Kirchhoff stress of Hencky's law times σ."""
    strain = sigma.clamp_min(LEAST_STRETCH).log()
    return (2 * mu * strain + lam * strain.sum(1, keepdim=True)) * sigma


def law_of(parameters: Mapping[str, Any]) -> Material:
    """Law of the parameters of a simulator, under the names of `set_parameters_dict`.

    Raises:
        ValueError, TypeError: for snow, which has no stress in PhysGaussian, an unknown material, or one that lacks a
            parameter.
    """
    kind = parameters.get("material", "jelly")
    if isinstance(kind, Material):
        check_gradients(parameters, (), "a law")
        return kind
    if kind == "snow":
        raise ValueError(
            "material 'snow' has no stress in the simulator that this class stands for: its particles fly apart. Pass "
            "a law instead, such as material=torch_mpm.Snow(E=1.4e5, nu=0.2)"
        )
    check_material(kind, parameters)
    E, nu = parameters["E"], parameters["nu"]
    if kind == "jelly":
        return FixedCorotated(E=E, nu=nu)
    if kind == "sand":
        angle = math.pi / 180 * parameters.get("friction_angle", 25.0)
        return QuarticSand(E=E, nu=nu, friction_angle=angle, energy="hencky")
    limit = parameters["yield_stress"]
    xi = parameters.get("xi", 0.0) if parameters.get("hardening", 0) == 1 else 0.0
    if kind == "metal":
        return Metal(E, nu, limit, xi)
    if kind == "foam":
        return Foam(E, nu, limit, parameters.get("plastic_viscosity", 0.0))
    return Plasticine(E, nu, limit, parameters.get("softening", 0.1), xi)
