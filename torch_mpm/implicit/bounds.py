"""What walls and obstacles allow the velocities of nodes: bounds of their components, in axes of each node."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..boundaries import Obstacle, Walls
from ..boundaries.walls import Face
from ..geometry.vectors import product
from ..grid.grid import Blocks
from .mirrors import reflected_inside

ON_FACE = 1e-6
"""Share of dx within which a node is at a wall, as the grid update has it."""


@dataclasses.dataclass
class NodeBounds:
    """`lower` ≤ u ≤ `upper` for the components u = v − 2 w (w · v) of each node's velocity.

    The reflection by the unit vector w (none where it is zero) takes one axis to the normal of an obstacle and leaves
    alone those that walls hold, so that all bounds are those of components.

    Attributes:
        lower, upper: [N, D] [m/s], equal where a component is given, infinite where it is free.
        mirror: w [N, D], or None where there are no obstacles.
        friction: Coulomb's coefficient of the surface that bounds a component [N, D], negative where it presses down on
            the component from above, zero where none does; None without friction.
        surface: velocity of the surface that rubs a node, in its axes [N, D] [m/s]; with friction alone.
        crossable: whether there may be bounds that a step can cross, or friction: the components that are held are then
            a part of what a step must find.
        owner: what bounds a component, int32 [N, D]: the number of an obstacle, or that of a face after them; -1 for
            nothing. None where nobody asks.
    """

    lower: Tensor
    upper: Tensor
    mirror: Tensor | None = None
    friction: Tensor | None = None
    surface: Tensor | None = None
    owner: Tensor | None = None
    crossable: bool = False

    def detached(self) -> NodeBounds:
        """The same, detached."""
        rest = (self.mirror, self.friction, self.surface)
        mirror, friction, surface = (None if t is None else t.detach() for t in rest)
        return NodeBounds(
            self.lower.detach(), self.upper.detach(), mirror, friction, surface, self.owner, self.crossable
        )

    def moves(self) -> bool:
        """Whether a gradient is wanted of where the surfaces are and how they move."""
        parts = (self.lower, self.upper, self.mirror, self.surface)
        return any(part is not None and part.requires_grad for part in parts)

    def turned(self, v: Tensor) -> Tensor:
        """Velocities [N, D] to the axes of the nodes, and back: the same reflection."""
        if self.mirror is None:
            return v
        return v - 2 * self.mirror * (self.mirror * v).sum(-1, keepdim=True)

    def clamped(self, v: Tensor) -> Tensor:
        """The nearest velocities within the bounds."""
        return self.turned(self.turned(v).clamp(self.lower, self.upper))

    def change(self, before: Tensor, after: Tensor) -> Tensor:
        """Difference of velocities [N, D], without the rounding of components that stay where they are held."""
        difference = self.turned(after - before)
        held = (self.lower.isfinite() | self.upper.isfinite()).any(-1, keepdim=True)
        stays = held & (difference.abs() <= rounding_of(torch.maximum(before.abs(), after.abs())))
        return torch.where(held, self.turned(torch.where(stays, 0, difference)), after - before)

    def free(self, v: Tensor, gradient: Tensor) -> Tensor:
        """Components in the axes of the nodes that may move, bool [N, D]: not at a bound, or with a gradient of the
        energy that pulls them off it. Friction, which may hold them too, is not looked at."""
        u, slope = self.turned(v), self.turned(gradient)
        rounding = rounding_of(v)
        at_lower = (u <= self.lower + rounding) & (slope >= 0)
        at_upper = (u >= self.upper - rounding) & (slope <= 0)
        return ~(at_lower | at_upper | (self.lower == self.upper))

    def kept(self, v: Tensor, free: Tensor) -> Tensor:
        """Vectors of nodes [N, D] without their components that are not free. What a solve is given in held components
        would leak into it by rounding, and grow."""
        return self.turned(torch.where(free, self.turned(v), 0))

    def held_normals(self, free: Tensor) -> Tensor | None:
        """Normals of obstacles along which nodes are not free, zero for the others [N, D]; None without obstacles."""
        if self.mirror is None:
            return None
        # w is the axis and ± the normal, so that its largest component is that of the axis.
        axis = torch.nn.functional.one_hot(self.mirror.abs().argmax(-1), free.shape[1]).bool()
        has_normal = (self.mirror != 0).any(-1, keepdim=True)
        return self.turned((axis & ~free & has_normal).to(self.mirror.dtype))

    def turned_blocks(self, blocks: Tensor) -> Tensor:
        """Matrices [N, D, D] to the axes of the nodes, and back."""
        if self.mirror is None:
            return blocks
        eye = torch.eye(blocks.shape[-1], dtype=blocks.dtype, device=blocks.device)
        w = self.mirror.to(blocks.dtype)
        turn = eye - 2 * w[:, :, None] * w[:, None, :]
        return product(product(turn, blocks), turn)


def rounding_of(v: Tensor) -> Tensor:
    """How far two reflections may take a component of node velocities [N, D] from where it was [N, 1] [m/s]."""
    return 64 * torch.finfo(v.dtype).eps * v.abs().amax(-1, keepdim=True)


def node_bounds(
    blocks: Blocks, walls: Walls | None, obstacles: list[Any], like: Tensor, time: float | Tensor, owners: bool = False
) -> NodeBounds | None:
    """The bounds that walls and obstacles set; None without any.

    Of several obstacles at a node, one that is sticky counts, otherwise the first. Where walls and an obstacle rub a
    node, its velocity relative to the obstacle counts.

    Args:
        blocks: the active blocks.
        walls, obstacles: as a `Step` has them.
        like: gives dtype and device.
        time: [s].
        owners: whether the bounds are to tell whose they are.

    Raises:
        NotImplementedError: for boundaries that are no obstacles.

    A mirror bounds the nodes on its plane alone; it shows obstacles to the nodes behind it as they are before it.

    Differentiable as `Obstacle.forward` is.
    """
    if walls is None and not obstacles:
        return None
    positions = blocks.node_positions(like.dtype)
    lower = torch.full_like(positions, -math.inf)
    bounds = NodeBounds(lower, torch.full_like(positions, math.inf))
    faces = () if walls is None else walls.faces(blocks.grid)
    rough = any(f.friction != 0 for f in faces) or any(rubs(o) for o in obstacles)
    bounds.crossable = rough or any(getattr(s, "kind", "") == "separate" for s in (*faces, *obstacles))
    if rough:
        bounds.friction, bounds.surface = torch.zeros_like(lower), torch.zeros_like(lower)
    if owners:
        bounds.owner = torch.full(positions.shape, -1, dtype=torch.int32, device=positions.device)
    if walls is not None:
        _add_walls(bounds, blocks, faces, positions, len(obstacles))
    scene = blocks.node_scene() if blocks.grid.scenes > 1 else None
    sign: Tensor | None = None
    if obstacles and any(f.kind == "mirror" for f in faces):
        positions, sign = reflected_inside(faces, positions)
    for number, obstacle in enumerate(obstacles):
        _add_obstacle(bounds, obstacle, number, positions, sign, scene, blocks.grid.scenes, time)
    return bounds


def rubs(obstacle: Any) -> bool:
    """Whether an obstacle has friction."""
    friction = getattr(obstacle, "friction", 0.0)
    return isinstance(friction, Tensor) or friction != 0


def _add_walls(bounds: NodeBounds, blocks: Blocks, faces: Sequence[Face], positions: Tensor, first: int) -> None:
    """The faces, of which the first has the given number as an owner."""
    for number, face in enumerate(faces):
        axis, above = divmod(number, 2)
        if face.kind == "open":
            continue
        at = positions[:, axis]
        near = ON_FACE * blocks.grid.dx
        touching = at >= face.plane - near if above else at <= face.plane + near
        if face.kind == "mirror":
            touching &= (at - face.plane).abs() <= near
        axes = slice(None) if face.kind == "sticky" else slice(axis, axis + 1)
        rows = touching[:, None]
        low, high = bounds.lower[:, axes], bounds.upper[:, axes]
        if face.kind != "separate" or not above:
            low.copy_(torch.where(rows, low.clamp_min(0), low))
        if face.kind != "separate" or above:
            high.copy_(torch.where(rows, high.clamp_max(0), high))
        if bounds.owner is not None:
            owner = bounds.owner[:, axes]
            owner.masked_fill_(rows & (owner < 0), first + number)
        if bounds.friction is not None:
            bounds.friction[:, axis].masked_fill_(touching, -face.friction if above else face.friction)


def _add_obstacle(
    bounds: NodeBounds,
    obstacle: Any,
    number: int,
    positions: Tensor,
    sign: Tensor | None,
    scene: Tensor | None,
    scenes: int,
    time: float | Tensor,
) -> None:
    if not isinstance(obstacle, Obstacle):
        raise NotImplementedError(
            f"an implicit step takes obstacles alone as boundaries, got {type(obstacle).__name__}"
        )
    obstacle.check_scenes(positions.shape[1], scenes)
    contact = obstacle.contact_at(positions, scene, time)
    if contact is None:
        return
    touching, normal, surface_velocity = contact
    surface = torch.zeros_like(positions) if surface_velocity is None else surface_velocity.expand_as(positions)
    if sign is not None:
        normal, surface = sign * normal, sign * surface
    if obstacle.kind == "sticky":
        rows = touching[:, None] & (bounds.lower != bounds.upper)  # what a wall holds stays
        surface = bounds.turned(surface)
        bounds.lower = torch.where(rows, surface, bounds.lower)
        bounds.upper = torch.where(rows, surface, bounds.upper)
        if bounds.owner is not None:
            bounds.owner.masked_fill_(rows, number)
        return
    normal = torch.where(bounds.lower.isfinite() | bounds.upper.isfinite(), 0, normal)
    length = normal.norm(dim=-1, keepdim=True)
    taken = torch.zeros_like(touching) if bounds.mirror is None else (bounds.mirror != 0).any(-1)
    rows = (touching & ~taken)[:, None] & (length > 1e-3)
    normal = normal / torch.where(length > 0, length, 1)
    axis = torch.nn.functional.one_hot(normal.abs().argmax(-1), positions.shape[1]).to(normal.dtype)
    side = torch.where((normal * axis).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(normal.dtype)
    # The reflection that takes the axis to −side times the normal, whose difference does not cancel.
    w = axis * side + normal
    w = w / w.norm(dim=-1, keepdim=True)
    old = torch.zeros_like(w) if bounds.mirror is None else bounds.mirror
    bounds.mirror = torch.where(rows, w, old)
    speed = (surface * normal).sum(-1, keepdim=True)
    limit = torch.where(side > 0, -speed, speed)  # of the component along the axis, u = −side v · n
    fixed = obstacle.kind == "slip"
    entry = rows & (axis > 0)
    bounds.lower = torch.where(entry & ((side < 0) | fixed), limit, torch.where(entry, -math.inf, bounds.lower))
    bounds.upper = torch.where(entry & ((side > 0) | fixed), limit, torch.where(entry, math.inf, bounds.upper))
    if bounds.owner is not None:
        bounds.owner.masked_fill_(entry, number)
    if bounds.friction is not None and bounds.surface is not None and rubs(obstacle):
        friction = obstacle.friction
        if isinstance(friction, Tensor):
            friction = obstacle.at_nodes("friction", positions, (), scene)[..., None]
        bounds.friction = torch.where(entry, -side * friction, bounds.friction)
        bounds.surface = torch.where(rows, bounds.turned(surface), bounds.surface)
