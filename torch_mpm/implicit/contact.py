"""Which components of the node velocities may move, and what Coulomb friction does to them.

Friction at a node adds to the energy of a step what it would dissipate,

    D(v) = c |u_T − s_T|,   c = Σ μ λ,

with the components T of its velocity u that no bound holds, the velocity s of the surface, and the impulses λ with
which the bounds hold the others: the gradient of the energy there. c counts as constant while E + D is minimised, and
follows the gradient from iterate to iterate (lagged friction, as in Li et al. 2020), so that the residual is that of
Coulomb's law itself. D is not smoothed: a node at rest on its surface sticks, as an equality, while the gradient along
it is at most c, and a step that would turn the motion of a node round ends at rest.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from .bounds import NodeBounds, rounding_of
from .system import ImplicitSystem


@dataclasses.dataclass
class Limit:
    """The friction that nodes can have, at most c [N, 1] [kg m/s] along T, bool [N, D], where c > 0."""

    size: Tensor
    along: Tensor

    def renewed(self, by: Limit, where: Tensor) -> Limit:
        """Another one for some nodes, bool [N, 1]."""
        return Limit(torch.where(where, by.size, self.size), torch.where(where, by.along, self.along))


@dataclasses.dataclass
class Friction:
    """Friction of nodes at velocities v; in the axes of the nodes.

    Attributes:
        bounds: whose friction it is.
        limit: how much it can be.
        relative: u − s along T, exactly zero at rest [N, D] [m/s].
        direction: of the motion, or where a node at rest is pulled from, of the pull [N, D]; of length one or zero.
        sticks: bool [N, 1].
    """

    bounds: NodeBounds
    limit: Limit
    relative: Tensor
    direction: Tensor
    sticks: Tensor

    def force(self) -> Tensor:
        """The gradient of D by the velocities of nodes that do not stick [N, D] [kg m/s]."""
        return self.bounds.turned(torch.where(self.sticks, 0, self.limit.size) * self.direction)

    def gain(self, v: Tensor) -> Tensor:
        """D at other velocities, less D here, with the same limit [N] [J]."""
        there = self._relative_of(v).norm(dim=1)
        return self.limit.size[:, 0] * (there - self.relative.norm(dim=1))

    def clamped(self, v: Tensor) -> Tensor:
        """Velocities after a step: at rest on the surface where they have turned round."""
        relative = self._relative_of(v)
        turned = (relative * self.direction).sum(1, keepdim=True) <= 0
        u = torch.where(self.limit.along & turned, self._surface(), self.bounds.turned(v))
        return torch.where((self.limit.along & turned).any(1, keepdim=True), self.bounds.turned(u), v)

    def curvature(self, starting: Tensor | None = None) -> Tensor | None:
        """Second derivative of D [N, D, D] [kg]: c/|u| across the motion, as if nodes that start to move had speeds
        `starting` [N, 1] [m/s]; without these for nodes that do move alone.

        None in 2-D, where there is no direction across.
        """
        dim = self.limit.along.shape[1]
        if dim == 2:
            return None
        speed = self.relative.norm(dim=1, keepdim=True)
        speed = speed if starting is None else torch.where(speed > 0, speed, starting)
        modulus = torch.where(self.sticks | (speed == 0), 0, self.limit.size / torch.where(speed > 0, speed, 1))
        across = (
            torch.diag_embed(self.limit.along.to(modulus.dtype)) - self.direction[:, :, None] * self.direction[:, None]
        )
        return self.bounds.turned_blocks(modulus[:, :, None] * across)

    def coupling(self, gradient: Tensor) -> Tensor:
        """∂c/∂g [N, D] at the gradient g of the energy [N, D], for nodes that move."""
        friction = self.bounds.friction
        assert friction is not None
        pressed = (friction * self.bounds.turned(gradient) > 0) & ~self.limit.along
        return self.bounds.turned(
            torch.where(pressed & ~self.sticks & self.limit.along.any(1, keepdim=True), friction, 0)
        )

    def _surface(self) -> Tensor:
        assert self.bounds.surface is not None
        return self.bounds.surface

    def _relative_of(self, v: Tensor) -> Tensor:
        return torch.where(self.limit.along, self.bounds.turned(v) - self._surface(), 0)


@dataclasses.dataclass
class Contact:
    """What bounds and friction make of velocities and the gradient of the energy there.

    Attributes:
        free: components that the step is to find, in the axes of the nodes, bool [N, D].
        gradient: of the energy and of friction, without the components that are not free [N, D] [kg m/s].
        friction: None where there is none.
    """

    free: Tensor
    gradient: Tensor
    friction: Friction | None = None

    def holds(self, system: ImplicitSystem) -> Tensor:
        """Components that a bound or friction gives the velocity of the surface, bool [N, D]."""
        return ~self.free & (system.mass > 0)[:, None]

    def missed(self, system: ImplicitSystem, bounds: NodeBounds, v: Tensor) -> Tensor:
        """How far held components of node velocities v are from the velocity that holds them [N, D] [m/s]: zero, but
        its derivatives by the bounds are not."""
        u = bounds.turned(v)
        given = torch.where((u - bounds.lower).abs() <= (u - bounds.upper).abs(), bounds.lower, bounds.upper)
        if self.friction is not None and bounds.surface is not None:
            given = torch.where(self.friction.limit.along & self.friction.sticks, bounds.surface, given)
        holds = self.holds(system)
        return bounds.turned(torch.where(holds, u - torch.where(holds, given, 0), 0))


def contact_at(
    system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor, gradient: Tensor, limit: Limit | None = None
) -> Contact:
    """Contact at node velocities v [N, D] [m/s], from the gradient of the energy there [N, D] [kg m/s]; differentiable
    by that gradient and by the bounds. The limit of friction is that of the gradient, or as given."""
    massive = (system.mass > 0)[:, None].expand_as(v)
    if bounds is None:
        return Contact(massive, gradient)
    free = massive & bounds.free(v, gradient)
    if bounds.friction is None:
        return Contact(free, bounds.kept(gradient, free))
    friction = _friction(bounds, v, gradient, free, _limit(bounds, gradient, free) if limit is None else limit)
    free = free & ~(friction.limit.along & friction.sticks)
    return Contact(free, bounds.kept(gradient + friction.force(), free), friction)


def pressed(bounds: NodeBounds, gradient: Tensor, free: Tensor) -> Tensor:
    """What each component that is not free, held by a gradient [N, D] [kg m/s], adds to the friction of its node: μ λ
    [N, D] [kg m/s]."""
    assert bounds.friction is not None
    return torch.where(free, 0, bounds.friction * bounds.turned(gradient)).clamp_min(0)


def _limit(bounds: NodeBounds, gradient: Tensor, free: Tensor) -> Limit:
    size = pressed(bounds, gradient, free).sum(1, keepdim=True)
    return Limit(size, free & (size > 0))


def _friction(bounds: NodeBounds, v: Tensor, gradient: Tensor, free: Tensor, limit: Limit) -> Friction:
    assert bounds.surface is not None
    relative = torch.where(limit.along, bounds.turned(v) - bounds.surface, 0)
    speed = relative.norm(dim=1, keepdim=True)
    at_rest = speed <= rounding_of(torch.maximum(v.abs(), bounds.surface.abs()))
    relative = torch.where(at_rest, 0, relative)
    pull = torch.where(limit.along & free, -bounds.turned(gradient), 0).detach()
    strength = pull.norm(dim=1, keepdim=True)
    towards, length = torch.where(at_rest, pull, relative), torch.where(at_rest, strength, speed)
    direction = towards / torch.where(length > 0, length, 1)
    return Friction(bounds, limit, relative, direction, at_rest & (strength <= limit.size))
