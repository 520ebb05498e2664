"""Penalty coupling of a rigid disc and particles in 2-D: what the bodies of the package are measured beside.

Explicit, as in codes of finite elements. Each particle inside the disc is a node in contact:

- a spring pushes it out along the normal, with the stiffness s K A²/V (Hallquist, Goudreau and Benson 1985, CMAME 51).
  The share s is 0.1 by default in LS-DYNA (Theory Manual 2006, "Standard Penalty Formulation"). K is the P-wave modulus
  of the material, V the volume of the particle, and A its area on the surface: in 3-D, K A²/V is K times the spacing
  of the particles;
- a dashpot has a fifth of the critical damping, of the smaller mass and of the frequency of the two masses (the
  same, "Viscous Contact Damping");
- friction is Coulomb's, regularised: proportional to the sliding velocity below `STICK` (Wriggers, Computational
  Contact Mechanics, 2006), and no more than what stops the smaller mass in a step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.bodies import moved

SHARE, DAMPING = 0.1, 0.2
"""Share of the stiffness of the material, and of the critical damping."""
STICK = 0.01
"""Sliding velocity from which friction has its full value [m/s]."""


class Disc(NamedTuple):
    """Radius [m], mass [kg/m], moment of inertia [kg m], and friction coefficient of a disc."""

    radius: float
    mass: float
    inertia: float
    friction: float


def penetration(disc: Disc, x: Tensor, centre: Tensor) -> Tensor:
    """Depth of particles inside a disc [P] [m], negative outside."""
    return disc.radius - (x - centre).norm(dim=1)


def forces(disc: Disc, state: mpm.State, row: Tensor, stiffness: float, dt: float) -> Tensor:
    """Forces on the particles [P, 2] [N/m] for a pose and velocity [6] of the disc and the stiffness of the springs.

    The stiffness is s K [Pa]: A²/V of a particle of the volume h² · 1 m, with the area h · 1 m on the surface, is 1 m.
    """
    depth, arm = penetration(disc, state.x, row[:2]), state.x - row[:2]
    normal = arm / arm.norm(dim=1, keepdim=True)
    frequency = (stiffness * (1.0 / state.mass + 1.0 / disc.mass)).sqrt()
    mass = state.mass.clamp_max(disc.mass)
    dashpot = DAMPING * 2.0 * mass * frequency
    of_surface = row[3:5] + row[5] * torch.stack([-arm[:, 1], arm[:, 0]], 1)
    relative = state.v - of_surface
    approach = (relative * normal).sum(1)
    push = torch.where(depth > 0, (stiffness * depth - dashpot * approach).clamp_min(0.0), 0.0)
    sliding = relative - approach[:, None] * normal
    drag = (disc.friction * push / sliding.norm(dim=1).clamp_min(STICK)).minimum(mass / dt)
    return push[:, None] * normal - drag[:, None] * sliding


def advance(
    step: mpm.Step, disc: Disc, stiffness: float, wrench: Tensor, state: mpm.State, rows: Tensor, n: int, dt: float
) -> tuple[mpm.State, Tensor]:
    """n steps of the particles and of a disc [1, 1, 6], with springs of a stiffness [Pa] and a further wrench [3]."""
    inertia = wrench.new_tensor([disc.mass, disc.mass, disc.inertia])
    for _ in range(n):
        on_particles = forces(disc, state, rows[0, 0], stiffness, dt)
        arm = state.x - rows[0, 0, :2]
        torque = arm[:, 0] * on_particles[:, 1] - arm[:, 1] * on_particles[:, 0]
        of_contact = torch.cat([on_particles, torque[:, None]], 1).sum(0)
        velocity = rows[..., 3:] + dt * (wrench - of_contact) / inertia
        rows = torch.cat([moved(torch.cat([rows[..., :3], velocity], -1), dt), velocity], -1)
        state = step(state.replace(v=state.v + dt * on_particles / state.mass[:, None]), dt)
        if not (bool(rows.isfinite().all()) and float(state.v.abs().max()) < math.inf):
            break
    return state, rows
