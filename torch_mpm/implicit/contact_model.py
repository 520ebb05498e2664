"""Contact in the quadratic model of an implicit step: held components, and friction.

Near the velocities of an iterate the energy has a quadratic model, whose minimum within bounds and with friction is
found by the primal-dual active set strategy (Hintermüller, Ito and Kunisch 2003): solve with some components held, hold
those that have crossed their bound, release those on which their bound would have to pull, and solve again. Friction
has the limit c = Σ μ λ of the impulses λ with which bounds hold the node in the model. A node at rest on its surface
sticks while its tangential load is at most c; above c it slips along the load. A slipping node sticks again where its
motion reverses.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from .bounds import NodeBounds, rounding_of
from .contact import Limit
from .system import ImplicitSystem


@dataclasses.dataclass
class ModelContact:
    """Contact at velocities of the nodes.

    Attributes:
        v: the velocities; held components are exactly those of their surfaces [N, D] [m/s].
        free: the other components, in the axes of the nodes, bool [N, D].
        limit: limit of friction; None without friction.
        direction: direction of slip, in the axes of the nodes, of length one or zero [N, D]; None without friction.
        force: friction on slipping nodes, as a part of the gradient [N, D] [kg m/s]; None without friction.
        across: its derivative by the velocities across the motion [N, D, D] [kg]; None without friction and in 2-D.
    """

    v: Tensor
    free: Tensor
    limit: Limit | None = None
    direction: Tensor | None = None
    force: Tensor | None = None
    across: Tensor | None = None

    def kept(self, before: ModelContact, where: Tensor) -> ModelContact:
        """The same with the velocities and limits of other contact at some nodes, bool [N, 1]."""
        v, limit = torch.where(where, before.v, self.v), self.limit
        if limit is not None and before.limit is not None:
            size = torch.where(where, before.limit.size, limit.size)
            limit = Limit(size, torch.where(where, before.limit.along, limit.along))
        return dataclasses.replace(self, v=v, limit=limit)


class ContactModel:
    """Contact with the quadratic model of the energy.

    Args:
        system, bounds: system and bounds of the nodes; no bounds without walls and obstacles.
        blocks: node blocks of the Hessian [N, D, D] [kg].
    """

    def __init__(self, system: ImplicitSystem, bounds: NodeBounds | None, blocks: Tensor) -> None:
        self._bounds = bounds
        self._massive = (system.mass > 0)[:, None].expand(blocks.shape[:2])
        self._stiffness = blocks.diagonal(dim1=1, dim2=2).mean(1, keepdim=True)

    def at(self, v: Tensor, gradient: Tensor, before: ModelContact | None = None, lets_go: bool = True) -> ModelContact:
        """Contact at velocities [N, D] [m/s] with the gradient of the model [N, D] [kg m/s], after other contact. Held
        components are released only with `lets_go`.
        """
        bounds = self._bounds
        if bounds is None:
            return ModelContact(v, self._massive)
        u, slope, near = bounds.turned(v), bounds.turned(gradient), rounding_of(v)
        low, high = u - bounds.lower, u - bounds.upper  # Crossed where negative and positive.
        at_lower = (low < -near) | ((low <= near) & (slope > 0))
        at_upper = (high > near) | ((high >= -near) & (slope < 0))
        kept = torch.zeros_like(at_lower)
        if before is not None and not lets_go:
            kept = self._massive & ~before.free
            at_lower = at_lower | (kept & (low.abs() <= near))
            at_upper = (at_upper & ~at_lower) | (kept & (high.abs() <= near))
        held = self._massive & (at_lower | at_upper | (bounds.lower == bounds.upper))
        target = torch.where(at_upper, bounds.upper, bounds.lower)
        if bounds.friction is None or bounds.surface is None:
            return ModelContact(_placed(bounds, v, u, held, target), self._massive & ~held)
        # The stiffness of the node converts the penetration to a normal force.
        press = slope - torch.where(held, self._stiffness * (u - target), 0)
        size = torch.where(held, bounds.friction * press, 0).clamp_min(0).sum(1, keepdim=True)
        limit = Limit(size, self._massive & ~held & (size > 0))
        slips, direction, speed = self._slip(u, slope, limit, near, None if before is None else before.direction)
        sticks = limit.along & (~slips | (kept & limit.along).any(1, keepdim=True))
        direction = torch.where(sticks, 0, direction)
        v = _placed(bounds, v, u, held | sticks, torch.where(sticks, bounds.surface, target))
        free, force = self._massive & ~(held | sticks), bounds.turned(size * direction)
        if v.shape[1] == 2:
            return ModelContact(v, free, limit, direction, force)
        rate = torch.where(speed > 0, size / torch.where(speed > 0, speed, 1), 0)
        plane = torch.diag_embed((limit.along & ~sticks).to(rate.dtype)) - direction[:, :, None] * direction[:, None, :]
        return ModelContact(v, free, limit, direction, force, bounds.turned_blocks(rate[:, :, None] * plane))

    def _slip(
        self, u: Tensor, slope: Tensor, limit: Limit, near: Tensor, before: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Slipping nodes, bool [N, 1], their direction, [N, D], and their speed, estimated where they begin to slip,
        [N, 1] [m/s].
        """
        assert self._bounds is not None and self._bounds.surface is not None
        surface = self._bounds.surface
        relative = torch.where(limit.along, u - surface, 0)
        pull = torch.where(limit.along, -slope, 0)
        speed, strength = relative.norm(dim=1, keepdim=True), pull.norm(dim=1, keepdim=True)
        moves = speed > torch.maximum(near, rounding_of(surface))
        begins = ~moves & (strength > limit.size)
        if before is not None:
            moves = moves & ~((relative * before).sum(1, keepdim=True) < 0)
        along = torch.where(begins, pull / torch.where(strength > 0, strength, 1), 0)
        along = torch.where(moves, relative / torch.where(speed > 0, speed, 1), along)
        start = (strength - limit.size) / torch.where(self._stiffness > 0, self._stiffness, 1)
        return moves | begins, along, torch.where(moves, speed, torch.where(begins, start, 0))


def _placed(bounds: NodeBounds, v: Tensor, u: Tensor, held: Tensor, target: Tensor) -> Tensor:
    """Velocities v, u in the axes of the nodes, whose held components are exactly those of their surfaces: a rounding
    difference at a node at rest would count as motion.
    """
    return torch.where(held.any(1, keepdim=True), bounds.turned(torch.where(held, target, u)), v)
