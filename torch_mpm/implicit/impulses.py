"""Impulses of the material on obstacles and walls in an implicit step.

At the solution the gradient of the energy at a node with contact is the impulse of its surfaces. Along bounded
components it belongs to the bounding surface; along the others it is friction, shared by the pressing surfaces in
proportion to their limits.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..ops.impulses import impulse_of_nodes
from .bounds import NodeBounds
from .contact import contact_at, pressed
from .system import ImplicitSystem


def boundary_impulses(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor, surfaces: int) -> Tensor:
    """Impulses of nodes with the velocities of a solution on obstacles and faces.

    Args:
        system: system of the solve.
        bounds: bounds with the `owner` of each.
        v: solution [N, D] [m/s].
        surfaces: number of obstacles and faces.

    Returns:
        [B, surfaces, D + 1 or 3] [N s, N m s], float64, exact to the tolerance of the solve. Differentiable by all
        inputs of the solution and the residual.
    """
    if bounds is None or bounds.owner is None:
        return impulse_of_nodes(system.blocks, torch.zeros_like(v))[:, None].expand(-1, surfaces, -1)
    gradient = system.residual(v)
    contact = contact_at(system, bounds, v, gradient)
    held, across = contact.holds(system), torch.zeros_like(v)
    given = bounds.turned(gradient)
    shares = across
    if contact.friction is not None:
        limit = contact.friction.limit
        across = torch.where(limit.along, given, 0)
        held = held & ~limit.along
        shares = pressed(bounds, gradient, ~held) / torch.where(limit.size > 0, limit.size, 1)
    along = torch.diag_embed(torch.where(held, given, 0))
    taken = -(along + shares[:, :, None] * across[:, None, :])  # Indices [N, component, D], in the axes of the nodes.
    parts = [bounds.turned(part) for part in taken.unbind(1)]
    return torch.stack([_taken_by(system, bounds.owner, parts, number) for number in range(surfaces)], 1)


def _taken_by(system: ImplicitSystem, owner: Tensor, parts: list[Tensor], number: int) -> Tensor:
    """Impulse on one surface from the parts of the momentum of each component of the nodes."""
    own = [torch.where(owner[:, k, None] == number, part, 0) for k, part in enumerate(parts)]
    return impulse_of_nodes(system.blocks, torch.stack(own).sum(0))
