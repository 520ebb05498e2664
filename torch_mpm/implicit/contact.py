"""Free components of the node velocities, and Coulomb friction on them.

Friction at a node adds its dissipation to the energy of a step,

    D(v) = c |u_T − s_T|,   c = Σ μ λ,

with the components T of its velocity u without an active bound, the velocity s of the surface, and the impulses λ with
which the bounds hold the others: the gradient of the energy there. D is not smoothed: a node at rest on its surface
sticks, as an equality, while the gradient along it is at most c. The residual is that of Coulomb's law, with the c of
the iterate itself; a step of Newton's method uses the c of its end (`contact_model`).
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from .bounds import NodeBounds, rounding_of
from .system import ImplicitSystem


@dataclasses.dataclass
class Limit:
    """Possible friction of nodes, at most c [N, 1] [kg m/s] along T, bool [N, D], where c > 0."""

    size: Tensor
    along: Tensor

    def slope(self, bounds: NodeBounds, v: Tensor) -> Tensor:
        """∂D/∂v [N, D] [kg m/s] of nodes that move at velocities v [N, D] [m/s]."""
        return bounds.turned(self.size * _unit(self._relative(bounds, v))[0])

    def excess(self, bounds: NodeBounds, start: Tensor, end: Tensor) -> Tensor:
        """Increase of D between two velocities beyond its slope [N] [J]; without cancellation for nodes that move
        on.
        """
        direction, _ = _unit(self._relative(bounds, start))
        relative = self._relative(bounds, end)
        along, speed = (direction * relative).sum(1, keepdim=True), relative.norm(dim=1, keepdim=True)
        across = (relative - along * direction).square().sum(1, keepdim=True)
        forward, both = along > 0, speed + along
        return (self.size * torch.where(forward, across / torch.where(forward, both, 1), speed - along))[:, 0]

    def _relative(self, bounds: NodeBounds, v: Tensor) -> Tensor:
        assert bounds.surface is not None
        return torch.where(self.along, bounds.turned(v) - bounds.surface, 0)


def _unit(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors [N, D] with the length one or zero, and their lengths [N, 1]."""
    length = vectors.norm(dim=1, keepdim=True)
    return vectors / torch.where(length > 0, length, 1), length


@dataclasses.dataclass
class Friction:
    """Friction of nodes at velocities v, in the axes of the nodes.

    Attributes:
        bounds: the bounds that exert it.
        limit: its maximum.
        relative: u − s along T, exactly zero at rest [N, D] [m/s].
        direction: direction of the motion, or of the tangential load of a node at rest that begins to slip [N, D]; of
            length one or zero.
        sticks: bool [N, 1].
    """

    bounds: NodeBounds
    limit: Limit
    relative: Tensor
    direction: Tensor
    sticks: Tensor

    def force(self) -> Tensor:
        """Gradient of D by the velocities of nodes that do not stick [N, D] [kg m/s]."""
        return self.bounds.turned(torch.where(self.sticks, 0, self.limit.size) * self.direction)

    def curvature(self) -> Tensor | None:
        """Second derivative of D [N, D, D] [kg]: c/|u| across the motion of nodes that move.

        None in 2-D, where there is no direction across.
        """
        dim = self.limit.along.shape[1]
        if dim == 2:
            return None
        speed = self.relative.norm(dim=1, keepdim=True)
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


@dataclasses.dataclass
class Contact:
    """Effect of bounds and friction on velocities and the gradient of the energy.

    Attributes:
        free: unknown components of the step, in the axes of the nodes, bool [N, D].
        gradient: gradient of the energy and of friction, without the components that are not free [N, D] [kg m/s].
        friction: None without friction.
    """

    free: Tensor
    gradient: Tensor
    friction: Friction | None = None

    def holds(self, system: ImplicitSystem) -> Tensor:
        """Components that a bound or friction holds at the velocity of the surface, bool [N, D]."""
        return ~self.free & (system.mass > 0)[:, None]

    def missed(self, system: ImplicitSystem, bounds: NodeBounds, v: Tensor) -> Tensor:
        """Difference between held components of node velocities v and the velocity of their surface [N, D] [m/s]: zero,
        but its derivatives by the bounds are not.
        """
        u = bounds.turned(v)
        given = torch.where((u - bounds.lower).abs() <= (u - bounds.upper).abs(), bounds.lower, bounds.upper)
        if self.friction is not None and bounds.surface is not None:
            given = torch.where(self.friction.limit.along & self.friction.sticks, bounds.surface, given)
        holds = self.holds(system)
        missed = u - torch.where(holds, given, 0)
        if bounds.tilt is not None:
            missed = missed + (bounds.tilt * v[:, None]).sum(2)
        return bounds.turned(torch.where(holds, missed, 0))


def contact_at(system: ImplicitSystem, bounds: NodeBounds | None, v: Tensor, gradient: Tensor) -> Contact:
    """Contact at node velocities v [N, D] [m/s], from the gradient of the energy there [N, D] [kg m/s]; differentiable
    by that gradient and by the bounds.
    """
    massive = (system.mass > 0)[:, None].expand_as(v)
    if bounds is None:
        return Contact(massive, gradient)
    free = massive & bounds.free(v, gradient)
    if bounds.tilt is not None:
        held = torch.where(free, 0, bounds.turned(gradient))
        gradient = gradient - (held[:, :, None] * bounds.tilt).sum(1)
    if bounds.friction is None:
        return Contact(free, bounds.kept(gradient, free))
    friction = _friction(bounds, v, gradient, free, _limit(bounds, gradient, free))
    free = free & ~(friction.limit.along & friction.sticks)
    return Contact(free, bounds.kept(gradient + friction.force(), free), friction)


def pressed(bounds: NodeBounds, gradient: Tensor, free: Tensor) -> Tensor:
    """Contribution of each component that is not free, held by a gradient [N, D] [kg m/s], to the friction of its node:
    μ λ [N, D] [kg m/s].
    """
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
