"""Elastic, plastic, viscoplastic and viscoelastic solids, snow and clay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from ..ops.arguments import per_parameter
from ..ops.law import law_energy
from .compiled import SolidLaw
from .parameters import Value

if TYPE_CHECKING:
    from ..state.state import State

__all__ = [
    "CamClay",
    "FixedCorotated",
    "Hencky",
    "HerschelBulkley",
    "NeoHookean",
    "Snow",
    "Viscoelastic",
    "VonMises",
]


class NeoHookean(SolidLaw):
    """Compressible neo-Hookean solid: τ = μ (F Fᵀ − I) + λ ln J I (Bonet and Wood 2008, section 6.4.3).

    Args:
        E: Young's modulus [Pa], not negative, with nu; or
        nu: Poisson's ratio in (−1, 0.5).
        mu: shear modulus [Pa], not negative (0 is a fluid), with lam; or
        lam: first Lamé parameter [Pa].

    Raises:
        ValueError: for a value outside its range, or another combination of arguments. Values are checked here only,
            not when a tensor is changed or trained.
    """

    name = "neo_hookean"


class FixedCorotated(SolidLaw):
    """Fixed corotated elastic solid (Stomakhin et al. 2012): ψ = μ Σ (σᵢ − 1)² + λ/2 (J − 1)².

    Args:
        E: Young's modulus [Pa], not negative, with nu; or
        nu: Poisson's ratio in (−1, 0.5).
        mu, lam: Lamé parameters [Pa].

    An inverted deformation (det F ≤ 0) has no stress and is reported, as with every law.

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

    State: state.extra["plastic_strain"], the equivalent plastic strain ε̄ (dε̄ = √(2/3) |dh_p|). Dissipated is σ_y dε̄:
    of the plastic work (σ_y + H ε̄) dε̄ hardening stores ½ H ε̄², which is not part of `energy_density`, the elastic
    energy.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`.
        yield_stress: yield stress σ_y in uniaxial tension [Pa], not negative. The shear strength is σ_y/√3, in 2-D
            too.
        hardening: plastic modulus H [Pa], not negative.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name, elastic_name = "von_mises", "hencky"
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
    step, which a `Step` provides; without one (`law.stress(state)` of a state that a step returned) the fluid is
    elastic, which gives the stress before the flow of the coming step. Dissipated is all plastic work.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`, of the elastic strains. The wave speed and so the time step follow
            from them, not from the viscosity.
        yield_stress: yield stress τ_y in shear [Pa], not negative; 0 is a power-law fluid.
        consistency: consistency η [Pa sⁿ], the viscosity for n = 1, not negative; 0 is perfect plasticity.
        exponent: exponent n of the shear rate, positive: below 1 shear thinning, above 1 shear thickening.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name, elastic_name = "herschel_bulkley", "hencky"
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


class Viscoelastic(SolidLaw):
    """Viscoelastic solid that relaxes: neo-Hookean with a parallel Maxwell branch (Reese and Govindjee 1998).

    ψ = ψ_NH(F) + μ_v |dev h|² with the Hencky strains h of the elastic deformation F_e = F F_v⁻¹ of the branch, which
    flows by dh/dt = −dev h/T: backward Euler over the time step with the exponential map. The shear modulus is μ + μ_v
    for fast loads and μ for slow ones. Without a time step (`law.stress(state)` outside of a step) nothing flows.
    State: state.extra["inverse_viscous_deformation"], F_v⁻¹ − 1 [P, D, D].
    Dissipated is τ_v · dh of the flow; `energy_density` counts both springs.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`, of the solid at rest.
        branch_modulus: shear modulus of the Maxwell branch [Pa]
        relaxation_time: time in which the stress of the branch falls to 1/e [s]

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name = "viscoelastic"
    branch_modulus: Any
    relaxation_time: Any

    def _elastic_law(self, state: State, history: Sequence[Tensor]) -> tuple[str, list[Tensor], Sequence[str]]:
        """Out-of-plane stress of the solid; the stress of the branch is a deviator in the plane."""
        return "neo_hookean", self._arguments(state)[1][:2], ()

    def __init__(
        self,
        E: Value | None = None,
        nu: Value | None = None,
        mu: Value | None = None,
        lam: Value | None = None,
        *,
        branch_modulus: Value,
        relaxation_time: Value,
    ) -> None:
        super().__init__(E, nu, mu, lam)
        self._add("branch_modulus", branch_modulus)
        self._add("relaxation_time", relaxation_time)


class Snow(SolidLaw):
    """Snow (Stomakhin et al. 2013): fixed corotated elasticity with stretches clamped to [1 − θ_c, 1 + θ_s].

    Plastic compaction hardens it: μ and λ are multiplied by exp(ξ (1 − J_p)).
    State: state.extra["log_plastic_volume"], ln J_p. Dissipated is the plastic work minus the energy that hardening
    adds to the elastic energy, or zero where that is more: the model is not thermodynamically consistent.

    Args:
        E, nu or mu, lam: as for `FixedCorotated`, of fresh snow (1.4e5 Pa and 0.2 in the paper, density 400 kg/m³).
        critical_compression: compression θ_c beyond which it yields, in [0, 1).
        critical_stretch: stretch θ_s beyond which it yields, not negative; smaller is more brittle.
        hardening: growth ξ of the stiffness with plastic compaction, not negative.

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name, elastic_name = "snow", "fixed_corotated"
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

    def _elastic_moduli(self, state: Any, parameters: list[Tensor], history: Sequence[Tensor]) -> list[Tensor]:
        """μ and λ after hardening. The hardening factor is the energy with μ = 1 and λ = 0 at the stretches 2, 1, 1,
        where that of the elastic law is 1.
        """
        mu, lam, *rest = parameters
        P, D = state.x.shape
        stretches = state.x.new_ones(P, D)
        stretches[:, 0] = 2
        unit = [mu.new_ones(()), mu.new_zeros(()), *rest]
        factor = law_energy(self.name, torch.diag_embed(stretches), unit, history, state.scene, D, state.scenes)
        return [factor * per_parameter(modulus, state.scene, P) for modulus in (mu, lam)]


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
        critical_slope: ratio M = q/p of shear stress to pressure in the critical state, positive. From a friction
            angle φ it is 6 sin φ/(3 − sin φ) in triaxial compression, and 2 sin φ in 2-D.
        consolidation: initial preconsolidation pressure p₀ [Pa], positive.
        hardening: growth Θ of ln p_c with plastic compaction, positive: 1/(λ* − κ*) of the compression and swelling
            indices in ln v over ln p.
        cohesion: isotropic tensile strength β over p_c, in [0, 1].

    Raises:
        ValueError: for a value outside its range, or another combination of arguments.
    """

    name, elastic_name = "cam_clay", "hencky"
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
