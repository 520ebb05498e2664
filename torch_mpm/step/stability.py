"""The largest stable time step of an explicit step, estimated from the state.

Let a_p be the largest tangent modulus of particle p in the current deformation (`Material.stiffness`), η_p its
viscosity, V_p and m_p its rest volume and mass. For any particle layout, the gradient that a particle gathers obeys
|∇v|² ≤ (Λ/dx²) Σ_i N_i |v_i|², with a Λ of the kernel and the stress form. Therefore the eigenvalues of M⁻¹H, with H
the tangent stiffness or the viscous matrix on the grid and M the lumped mass, are at most

    λ_e = max_p a_p V_p Λ/(m_p dx²)   and   λ_v = max_p 2 η_p V_p Λ/(m_p dx²).

A mode of these eigenvalues, of whose grid velocity one particle round trip retains the fraction s (0 ≤ s ≤ 1), is
advanced by v ← s v − dt λ_e u − dt λ_v v, u ← u + dt v, which is stable while

    dt² λ_e / 2 + dt λ_v ≤ 1 + s.

With APIC the stiffest modes are retained fully: a mode of y λ, y ≤ 1, has s ≥ y, and y = 1 is the worst case, so s = 1
gives the limit; it is dx/c with ρ c² = a for the quadratic MLS form. PIC and FLIP may lose the stiffest modes: s = 0.
An isolated particle reaches the limit (tests/test_cfl.py). Speed is added so that no particle moves by more than dx in
a step.

That is the linear limit. A step must not invert a particle either: it multiplies F by I + dt ∇v, or J by 1 + dt tr ∇v,
so that changes of more than one in a step change the sign. With the velocity v_p + C_p (x_i − x_p) and the stress τ_p
of each particle on the nodes, the bound on |∇v| above gives, for similar particles,

    |∇v| ≤ g + dt h,   g² = Λ |v_p|²/dx² + |C_p|²,   h = |τ_p| V_p Λ/(m_p dx²),

and |tr ∇v| at most √D times that. dt (g + dt h) may be a half: no stretch and no volume decreases by more than half in
a step; otherwise the pressure of a fluid would rise by orders of magnitude at once. Speeds are those of particles and
of the obstacles near them; two colliding bodies have both. Near rest and below a third of the speed of sound (fluids: a
fifth) this is no limit. It is a bound for similar neighbours, and was measured for others
(benchmarks/stability/adversarial.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..boundaries import Obstacle
from ..errors import NUMBER_OR_TENSOR, check_number, check_real, shape_of
from ..grid.grid import Grid, check_grid
from ..laws.calls import law_calls, laws_of
from ..laws.compiled import CompiledLaw
from ..laws.custom import as_law
from ..laws.material import Material
from ..laws.thermal import Melting, ThermalExpansion
from ..ops.arguments import check_choice
from ..ops.survey import Survey, law_figures, survey
from ..state.state import State, check_state

GRADIENT_BOUND = {
    # Λ = dx² D⁻¹ of the MLS form: Σ_i N_i |D⁻¹ (x_i − x_p)|² per axis.
    ("mls", "quadratic"): 4.0,
    ("mls", "cubic"): 3.0,
    # The supremum of Σ_i N_i'²/N_i per axis over all positions of the particle.
    ("gradient", "quadratic"): 6.0,
    ("gradient", "cubic"): 3.137,
}


class LawDiagnostics(NamedTuple):
    """Values of a law at the particles, for a stability report."""

    stress: Tensor
    """Kirchhoff stress [P, D, D] [Pa]."""
    stiffness: Tensor
    """Tangent modulus [P] [Pa]."""
    energy: Tensor | None
    """Energy density [P] [J/m³], where requested."""


@torch.no_grad()
def stable_dt(
    grid: Grid,
    law: Material,
    state: State,
    cfl: float = 1.0,
    transfer: str = "apic",
    stress_form: str = "mls",
    speed: Tensor | None = None,
    previous: float | Tensor | None = None,
) -> Tensor:
    """Estimate of the largest stable time step of each scene, times `cfl`, without synchronising with the device.

    It has no gradient: a dt is a constant of the steps that it is chosen for.

    With cfl = 1 and dt computed before every step no rollout of the stability benchmark inverted a particle. Use 0.5,
    the default of `Step.stable_dt`, where dt is computed less often or user code acts on the grid.

    The limit oscillates with the strain of the particles. A dt that follows it feeds energy into undamped particles,
    such as isolated ones (docs/limitations.md). Therefore pass the previous dt as `previous`: it is returned while it
    is between half of the result without it and that result.

    Args:
        grid: the lattice.
        law: the material, for its `stiffness` and `viscosity`.
        state: the particles.
        cfl: fraction of the limit, positive and finite. The limit holds for the current state, which a step may
            stiffen.
        transfer: "apic", "pic" or "flip".
        stress_form: "mls" or "gradient".
        speed: speed of the obstacles near each particle [P] [m/s], or None; `Step.stable_dt` gives it.
        previous: dt of the previous step [s], a number or a tensor [], [1] or [B]; None for none.

    Returns:
        dt [B] [s], constant for autograd; inf for a scene without particles, or without stress, stiffness, viscosity
        and speed. A particle without mass makes it zero; particles that are not finite are ignored.

    Raises:
        TypeError, ValueError: for a cfl that is not positive and finite, an unknown transfer or stress form, or a wrong
            `previous`.
    """
    check_grid(grid)
    check_state(state)
    law = as_law("law", law)
    check_number("cfl", cfl, "positive and finite", lambda v: 0 < v < math.inf)
    check_choice("transfer", transfer, ("apic", "pic", "flip"))
    if stress_form not in ("mls", "gradient"):
        raise ValueError(f"stress_form must be 'gradient' or 'mls', got {stress_form!r}")
    law.check_parameters(len(state), grid.scenes)
    state = state.of_scenes(grid.scenes)
    found = stability_report(grid, law, state, law_diagnostics(law, state, False), transfer, stress_form, speed)
    return chosen_dt(cfl / found.rate, previous).to(state.x.dtype)


def chosen_dt(longest: Tensor, previous: float | Tensor | None) -> Tensor:
    """dt of each scene [B]: the previous one while it is between half of the longest and the longest, otherwise the
    longest.

    Raises:
        TypeError, ValueError: for a wrong `previous`.
    """
    if previous is None:
        return longest
    scenes = len(longest)
    if not isinstance(previous, Tensor):
        previous = longest.new_full((1,), float(check_real("previous", previous, NUMBER_OR_TENSOR)))
    if previous.dim() > 1 or previous.numel() not in (1, scenes):
        raise ValueError(
            f"previous must be a number or have shape [], [1] or [B] = [{scenes}], got {shape_of(previous)}"
        )
    if previous.device != longest.device:
        raise ValueError(f"previous must be on the device of x, {longest.device}, got {previous.device}")
    return torch.where((longest / 2 <= previous) & (previous <= longest), previous, longest)


@torch.no_grad()
def stability_report(
    grid: Grid,
    law: Material,
    state: State,
    diagnostics: LawDiagnostics,
    transfer: str,
    stress_form: str,
    speed: Tensor | None = None,
    obstacles: Sequence[Obstacle] = (),
) -> Survey:
    """Limit of the time step, speed and validity of each scene, for a state with all fields."""
    grid.check_resolution(state.x.dtype)
    bound = GRADIENT_BOUND[stress_form, grid.kernel] / grid.dx**2
    return survey(
        grid,
        state,
        diagnostics.stress,
        diagnostics.stiffness,
        bound,
        kept=2.0 if transfer == "apic" and stress_form == "mls" else 1.0,  # 1 + s
        volumetric="J" in law.state_fields,
        viscosity=law.viscosity(state),
        energy=diagnostics.energy,
        speed=speed,
        obstacles=obstacles,
        reach=2 * math.sqrt(grid.dim) * grid.dx,  # largest distance of a particle's nodes
    )


def law_diagnostics(law: Material, state: State, with_energy: bool) -> LawDiagnostics:
    """Stress, stiffness and, with `with_energy`, energy density of a law."""
    if type(law) is ThermalExpansion:
        return law_diagnostics(law.law, law._elastic(state), with_energy)
    if type(law) is Melting:
        return _melting_diagnostics(law, state, with_energy)
    if all(isinstance(part, CompiledLaw) and part.figures_are_compiled() for part in laws_of(law)):
        calls = law_calls(law, state)
        how = ",".join(calls.names), calls.options, calls.parameters, calls.history, calls.variables
        return LawDiagnostics(*law_figures(state, *how, calls.material, with_energy))
    energy = law.energy_density(state) if with_energy else None
    return LawDiagnostics(law.stress(state), law.stiffness(state), energy)


def _melting_diagnostics(law: Melting, state: State, with_energy: bool) -> LawDiagnostics:
    """Values of a material that melts: F and J of its phases, and their parameters, are computed once."""
    part = law._consistent(state)
    solid, liquid = (law_diagnostics(phase, part, with_energy) for phase in (law.solid, law.liquid))
    energy = None
    if solid.energy is not None and liquid.energy is not None:
        energy = law._blended(state, solid.energy, liquid.energy)
    stress = law._stress_of_phases(state, solid.stress, liquid.stress)
    return LawDiagnostics(stress, law._blended(state, solid.stiffness, liquid.stiffness), energy)
