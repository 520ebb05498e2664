"""The largest stable time step of an explicit step, estimated from the state.

Let a_p be the largest tangent modulus of particle p in the current deformation (`Material.stiffness`), η_p its
viscosity, V_p and m_p its rest volume and mass. For any particle layout, the gradient that a particle gathers obeys
|∇v|² ≤ (Λ/dx²) Σ_i N_i |v_i|², with a Λ of the kernel and the stress form. Therefore the eigenvalues of M⁻¹H, with H
the tangent stiffness or the viscous matrix on the grid and M the lumped mass, are at most

    λ_e = max_p a_p V_p Λ/(m_p dx²)   and   λ_v = max_p 2 η_p V_p Λ/(m_p dx²).

A mode of these eigenvalues, of which one particle round trip keeps the part s of the grid velocity (0 ≤ s ≤ 1), is
advanced by v ← s v − dt λ_e u − dt λ_v v, u ← u + dt v, which is stable while

    dt² λ_e / 2 + dt λ_v ≤ 1 + s.

With APIC the stiffest modes are kept whole: a mode of y λ, y ≤ 1, has s ≥ y, and y = 1 is the worst case, so s = 1
gives the limit; it is dx/c with ρ c² = a for the quadratic MLS form. PIC and FLIP may lose the stiffest modes: s = 0.
An isolated particle reaches the limit (tests/test_cfl.py). Speed is added so that none moves by more than dx in a step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .errors import check_number

if TYPE_CHECKING:
    from .grid import Grid
    from .materials import Material
    from .state import State

GRADIENT_BOUND = {
    # Λ = dx² D⁻¹ of the MLS form: Σ_i N_i |D⁻¹ (x_i − x_p)|² per axis.
    ("mls", "quadratic"): 4.0,
    ("mls", "cubic"): 3.0,
    # The supremum of Σ_i N_i'²/N_i per axis over all positions of the particle.
    ("gradient", "quadratic"): 6.0,
    ("gradient", "cubic"): 3.137,
}


@torch.no_grad()
def stable_dt(
    grid: Grid, law: Material, state: State, cfl: float = 1.0, transfer: str = "apic", stress_form: str = "mls"
) -> Tensor:
    """Estimate of the largest stable time step of each scene, times `cfl`, without synchronising with the device.

    Args:
        grid: the lattice.
        law: the material, for its `stiffness` and `viscosity`.
        state: the particles.
        cfl: fraction of the limit, positive. The limit holds for the current deformation, which a step may stiffen.
        transfer: "apic"; anything else is limited as "pic" is.
        stress_form: "mls" or "gradient".

    Returns:
        dt [B] [s], constant for autograd; inf for a scene without particles, or without stiffness, viscosity and
        speed. A particle without mass makes it zero; one that is not finite is left out.

    Raises:
        ValueError: for a cfl that is not positive, or an unknown stress form.
    """
    check_number("cfl", cfl, "positive", lambda v: v > 0)
    if (stress_form, grid.kernel) not in GRADIENT_BOUND:
        raise ValueError(f"stress_form must be 'gradient' or 'mls', got {stress_form!r}")
    kept = 2.0 if transfer == "apic" and stress_form == "mls" else 1.0  # 1 + s
    inverse_inertia = GRADIENT_BOUND[stress_form, grid.kernel] / grid.dx**2 * state.volume / state.mass
    elastic = law.stiffness(state) * inverse_inertia
    viscosity = law.viscosity(state)
    if viscosity is None:
        rate = (elastic / (2 * kept)).sqrt()
    else:
        viscous = 2 * viscosity * inverse_inertia
        rate = (viscous + (viscous.square() + 2 * kept * elastic).sqrt()) / (2 * kept)
    rate = (rate + state.v.norm(dim=1) / grid.dx).nan_to_num(nan=0.0, posinf=torch.inf)
    if state.scene is None:
        fastest = rate.amax().reshape(1) if len(rate) else rate.new_zeros(1)
    else:
        scene = state.scene.clamp(0, grid.scenes - 1).long()
        fastest = rate.new_zeros(grid.scenes).scatter_reduce(0, scene, rate, "amax")
    return cfl / fastest
