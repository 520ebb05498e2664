"""Laws in principal strains: elastic, plastic and viscoplastic solids, snow, clay, and a user's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from ..errors import shape_of
from ..ops.svd import svd3
from ..parameters import Value
from .material import Material, SolidLaw, check_function, check_stiffness, given_stiffness

if TYPE_CHECKING:
    from ..state import State


class FixedCorotated(SolidLaw):
    """Fixed corotated elastic solid (Stomakhin et al. 2012): ψ = μ Σ (σᵢ − 1)² + λ/2 (J − 1)².

    Args:
        E: Young's modulus [Pa], not negative, with nu; or
        nu: Poisson's ratio in (−1, 0.5).
        mu, lam: Lamé parameters [Pa].

    A deformation turned inside out (det F ≤ 0) has no stress and is reported, as with every law.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name = "fixed_corotated"


class Hencky(SolidLaw):
    """Elastic solid with the quadratic energy of logarithmic strains: ψ = μ Σ hᵢ² + λ/2 (tr h)², h = ln σ.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name = "hencky"


class VonMises(SolidLaw):
    """J2 plasticity with linear isotropic hardening on Hencky elasticity (Simo 1992): √(3/2) |dev τ| ≤ σ_y + H ε̄.

    State: state.extra["plastic_strain"], the equivalent plastic strain ε̄ (dε̄ = √(2/3) |dh_p|).
    Dissipated is σ_y dε̄: of the plastic work (σ_y + H ε̄) dε̄ hardening stores ½ H ε̄², which is no part of
    `energy_density`, the elastic energy.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`.
        yield_stress: σ_y in uniaxial tension [Pa], not negative. The shear strength is σ_y/√3, also in 2-D.
        hardening: plastic modulus H [Pa], not negative.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name = "von_mises"
    yield_stress: Any
    hardening: Any

    def __init__(
        self,
        E: Value | None = None,
        nu: Value | None = None,
        mu: Value | None = None,
        lam: Value | None = None,
        *,
        yield_stress: Value,
        hardening: Value = 0.0,
    ) -> None:
        super().__init__(E, nu, mu, lam)
        self._add("yield_stress", yield_stress)
        self._add("hardening", hardening)


class HerschelBulkley(SolidLaw):
    """Viscoplastic fluid on Hencky elasticity: above the yield stress, t = τ_y + η gⁿ (Bingham's fluid for n = 1).

    t = |dev τ|/√2 and g = √2 |dh_p/dt| are shear stress and shear rate in simple shear. Backward Euler over the time
    step, which a `Step` hands over; without one (`law.stress(state)` of a state that a step returned) the fluid is
    elastic, which gives the stress before the flow of the coming step. Dissipated is all plastic work.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`, of the elastic strains. The wave speed and so the time step follow
            from them, not from the viscosity.
        yield_stress: τ_y in shear [Pa], not negative; 0 is a power-law fluid.
        consistency: η [Pa sⁿ], not negative; 0 is perfect plasticity.
        exponent: n, positive: below 1 shear thinning, above 1 shear thickening.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name = "herschel_bulkley"
    yield_stress: Any
    consistency: Any
    exponent: Any

    def __init__(
        self,
        E: Value | None = None,
        nu: Value | None = None,
        mu: Value | None = None,
        lam: Value | None = None,
        *,
        yield_stress: Value,
        consistency: Value,
        exponent: Value = 1.0,
    ) -> None:
        super().__init__(E, nu, mu, lam)
        self._add("yield_stress", yield_stress)
        self._add("consistency", consistency)
        self._add("exponent", exponent)


class Snow(SolidLaw):
    """Snow (Stomakhin et al. 2013): fixed corotated elasticity with stretches clamped to [1 − θ_c, 1 + θ_s].

    Plastic compaction hardens it: μ and λ are multiplied by exp(ξ (1 − J_p)).
    State: state.extra["log_plastic_volume"], ln J_p.
    Dissipated is the plastic work less what hardening adds to the elastic energy, or zero where that is more: the model
    is not consistent thermodynamically.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`, of fresh snow (1.4e5 Pa and 0.2 in the paper, density 400 kg/m³).
        critical_compression: θ_c in [0, 1).
        critical_stretch: θ_s, not negative.
        hardening: ξ, not negative.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name = "snow"
    scene_defaults: ClassVar = {"density": 400.0, "E": 1.4e5, "nu": 0.2}
    critical_compression: Any
    critical_stretch: Any
    hardening: Any

    def __init__(
        self,
        E: Value | None = None,
        nu: Value | None = None,
        mu: Value | None = None,
        lam: Value | None = None,
        *,
        critical_compression: Value = 2.5e-2,
        critical_stretch: Value = 7.5e-3,
        hardening: Value = 10.0,
    ) -> None:
        super().__init__(E, nu, mu, lam)
        self._add("critical_compression", critical_compression)
        self._add("critical_stretch", critical_stretch)
        self._add("hardening", hardening)


class CamClay(SolidLaw):
    """Modified Cam-Clay with cohesion on Hencky elasticity (Borja and Tamagnini 1998; cohesion as Gaume et al. 2018).

    q² + M² (p − p_c)(p + β p_c) ≤ 0 with associated flow and p_c = p₀ exp(−Θ ln J_p): compaction hardens, dilation
    softens. p = −tr τ/D and q = √((6 − D)/2) |dev τ|, in 2-D the difference of the principal stresses. |ln (p_c/p₀)| is
    limited to 10.
    State: state.extra["log_plastic_volume"], ln J_p.
    Dissipated is all plastic work, as if consolidation stored nothing (Collins and Houlsby 1997 let it store a part, in
    isotropic compression a half).

    Args:
        E, nu or mu, lam: as for `FixedCorotated`.
        critical_slope: M, positive: q/p in the critical state. From a friction angle φ it is 6 sin φ/(3 − sin φ) in
            triaxial compression, and 2 sin φ in 2-D.
        consolidation: p₀ [Pa], positive: the preconsolidation pressure at first.
        hardening: Θ, positive: 1/(λ* − κ*) of the compression and swelling indices in ln v over ln p.
        cohesion: β in [0, 1]: isotropic tensile strength over p_c.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name = "cam_clay"
    critical_slope: Any
    consolidation: Any
    hardening: Any
    cohesion: Any

    def __init__(
        self,
        E: Value | None = None,
        nu: Value | None = None,
        mu: Value | None = None,
        lam: Value | None = None,
        *,
        critical_slope: Value,
        consolidation: Value,
        hardening: Value,
        cohesion: Value = 0.0,
    ) -> None:
        super().__init__(E, nu, mu, lam)
        self._add("critical_slope", critical_slope)
        self._add("consolidation", consolidation)
        self._add("hardening", hardening)
        self._add("cohesion", cohesion)


class CustomPrincipalLaw(Material):
    """A law from any module or function of the principal stretches, in ordinary torch code.

    Args:
        function: called with the stretches σ [P, D], in no order that matters: it must treat them alike. Returns the
            principal Kirchhoff stresses [P, D] [Pa], or a pair (stretches, stresses) where a plastic law changes σ.
        stiffness: see `Material.stiffness`; a number, a tensor [P] or a function of the state. None takes it from the
            function by automatic differentiation, each time that `stable_dt` asks.

    The gradient with respect to F holds at equal stretches: differences of the function over a gap of at least the cube
    root of the rounding error stand for its derivative there (relative error about 1e-10 in float64, 1e-5 in float32).
    Particles with det F ≤ 0 or F not finite have no stress, and the function sees them at rest.

    Raises:
        TypeError: for what is no function.
        ValueError: for a number as stiffness that is negative or not finite, or in use for a result of another shape.
    """

    def __init__(
        self,
        function: Callable[[Tensor], Any],
        stiffness: float | Tensor | Callable[[State], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.function = check_function(function)
        self._stiffness = check_stiffness(stiffness)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        if state.F is None:
            raise ValueError("CustomPrincipalLaw needs state.F, which is None")
        good = ~self.invalid(state)[:, None, None]
        F = state.F.where(good, torch.eye(state.x.shape[1], dtype=state.x.dtype, device=state.x.device))
        with torch.no_grad():
            U, _, V = svd3(F)
        sigma = svd3(F).sigma
        mapped, tau = self._evaluate(sigma)
        new, stress = _IsotropicFunction.apply(F, U, sigma.detach(), V, mapped, tau, self._evaluate)
        stress = stress.where(good, torch.zeros((), dtype=stress.dtype, device=stress.device))
        return {} if mapped is sigma else {"F": new.where(good, state.F)}, stress

    def stiffness(self, state: State) -> Tensor:
        return given_stiffness(self._stiffness, state) if self._stiffness is not None else super().stiffness(state)

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        J = torch.linalg.det(state.F.where(state.F.isfinite(), torch.nan))
        return ~((J > 0) & J.isfinite())

    def _evaluate(self, sigma: Tensor) -> tuple[Tensor, Tensor]:
        result = self.function(sigma)
        mapped, tau = result if isinstance(result, tuple) else (sigma, result)
        for name, value in (("stretches", mapped), ("stresses", tau)):
            if not isinstance(value, Tensor) or value.shape != sigma.shape:
                raise ValueError(f"the law must return {name} of shape {list(sigma.shape)}, got {shape_of(value)}")
        return mapped, tau


class _IsotropicFunction(torch.autograd.Function):
    """U diag(mapped) Vᵀ and U diag(tau) Uᵀ for F = U diag(sigma) Vᵀ.

    Its gradient of F is that of turning the principal axes; mapped and tau bring their own.
    """

    @staticmethod
    def forward(
        F: Tensor, U: Tensor, sigma: Tensor, V: Tensor, mapped: Tensor, tau: Tensor, evaluate: Any
    ) -> tuple[Tensor, Tensor]:
        return (U * mapped[:, None, :]) @ V.mT, (U * tau[:, None, :]) @ U.mT

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        *tensors, ctx.evaluate = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, grad_F: Tensor, grad_stress: Tensor) -> Any:
        F, U, sigma, V, mapped, tau = ctx.saved_tensors
        M, N = (_DifferentiatedOnce.apply(t, F) for t in (U.mT @ grad_F @ V, U.mT @ grad_stress @ U))
        turned = None
        if ctx.needs_input_grad[0]:
            principal = torch.zeros_like(M)
            for i in range(sigma.shape[1]):
                for j in range(i + 1, sigma.shape[1]):
                    with torch.no_grad():
                        map_slope, stress_slope = _quotients(ctx.evaluate, sigma, mapped, tau, i, j)
                    total = sigma[:, i] + sigma[:, j]
                    even = map_slope * (M[:, i, j] + M[:, j, i]) / 2
                    odd = (mapped[:, i] + mapped[:, j]) / total * (M[:, i, j] - M[:, j, i]) / 2
                    stress = (N[:, i, j] + N[:, j, i]) * stress_slope / total
                    principal[:, i, j] = even + odd + stress * sigma[:, j]
                    principal[:, j, i] = even - odd + stress * sigma[:, i]
            turned = _DifferentiatedOnce.apply(U @ principal @ V.mT, mapped, tau)
        diagonals = (t.diagonal(dim1=1, dim2=2) for t in (M, N))
        return turned, None, None, None, *diagonals, None


class _DifferentiatedOnce(torch.autograd.Function):
    """A gradient that depends on other tensors in a way that autograd does not see."""

    @staticmethod
    def forward(gradient: Tensor, *others: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        raise NotImplementedError("CustomPrincipalLaw has no second derivatives: differentiate it once")


def _quotients(
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]], sigma: Tensor, mapped: Tensor, tau: Tensor, i: int, j: int
) -> tuple[Tensor, Tensor]:
    """Differences of mapped stretches and stresses i and j over that of the stretches, which is widened where small."""
    middle = (sigma[:, i] + sigma[:, j]) / 2
    least = torch.finfo(sigma.dtype).eps ** (1 / 3) * middle
    near = (sigma[:, i] - sigma[:, j]).abs() < least
    spread = sigma.clone()
    spread[:, i] = torch.where(near, middle + least / 2, sigma[:, i])
    spread[:, j] = torch.where(near, middle - least / 2, sigma[:, j])
    gap = spread[:, i] - spread[:, j]
    wide = evaluate(spread)
    return tuple(  # type: ignore[return-value]
        torch.where(near, w[:, i] - w[:, j], v[:, i] - v[:, j]) / gap for w, v in zip(wide, (mapped, tau), strict=True)
    )
