"""What walls and obstacles allow the velocities of nodes: bounds of their components, in axes of each node."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..boundaries import Obstacle, Walls
from ..boundaries.constraints import KINDS
from ..boundaries.solid import Meeting, SolidNodes, find_surfaces
from ..boundaries.walls import Face
from ..geometry.vectors import product
from ..grid.grid import Blocks

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
        tilt: what the direction of a component's bound has beside its axis [N, D, D]: zero, but its derivative is not;
            None where no gradient of it is wanted.
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
    tilt: Tensor | None = None

    def detached(self) -> NodeBounds:
        """The same, detached."""
        rest = (self.mirror, self.friction, self.surface)
        mirror, friction, surface = (None if t is None else t.detach() for t in rest)
        return NodeBounds(
            self.lower.detach(), self.upper.detach(), mirror, friction, surface, self.owner, self.crossable
        )

    def moves(self) -> bool:
        """Whether a gradient is wanted of where the surfaces are and how they move."""
        parts = (self.lower, self.upper, self.mirror, self.surface, self.tilt)
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

    Obstacles act as one solid (csrc/grid/solid.h). Of the surfaces of an inner edge that are both oblique to the
    lattice, in 3-D, the second counts along the nearest axis beside the first. Where several surfaces rub a node, its
    velocity relative to the last obstacle that does counts.

    Args:
        blocks: the active blocks.
        walls, obstacles: as a `Step` has them.
        like: gives dtype and device.
        time: [s].
        owners: whether `NodeBounds.owner` is set.

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
    if obstacles:
        _add_obstacles(bounds, blocks, faces, obstacles, positions, time)
    return bounds


def rubs(obstacle: Any) -> bool:
    """Whether an obstacle has friction."""
    friction = getattr(obstacle, "friction", 0.0)
    return not (isinstance(friction, float) and friction == 0)


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


def _add_obstacles(
    bounds: NodeBounds,
    blocks: Blocks,
    faces: Sequence[Face],
    obstacles: list[Any],
    positions: Tensor,
    time: float | Tensor,
) -> None:
    """All obstacles as one solid: what is sticky first, then surfaces along the axes, then others."""
    for obstacle in obstacles:
        if not isinstance(obstacle, Obstacle):
            raise NotImplementedError(
                f"an implicit step takes obstacles alone as boundaries, got {type(obstacle).__name__}"
            )
        obstacle.check_scenes(positions.shape[1], blocks.grid.scenes)
    scene = blocks.node_scene() if blocks.grid.scenes > 1 else None
    acts = [blocks.active_nodes()] * len(obstacles)
    meeting = find_surfaces(SolidNodes(obstacles, acts, positions, scene, time, blocks.grid.dx, faces))
    if meeting is None:
        return
    surfaces = [_Surface.of(meeting, k, len(positions)) for k in range(positions.shape[1])]
    for surface in surfaces:
        _add_sticky(bounds, surface)
    for surface in surfaces:
        _add_along_axis(bounds, surface)
    for surface in surfaces:
        _add_oblique(bounds, surface)


@dataclasses.dataclass
class _Surface:
    """One of the surfaces that each node meets.

    Attributes:
        there: bool [N, 1].
        alone: whether it is the only one, bool [N, 1].
        owner: int32 [N, 1].
        kind: a number of `KINDS` [N, 1].
        friction: [N, 1].
        normal, velocity: [N, D].
    """

    there: Tensor
    alone: Tensor
    owner: Tensor
    kind: Tensor
    friction: Tensor
    normal: Tensor
    velocity: Tensor

    @classmethod
    def of(cls, meeting: Meeting, k: int, nodes: int) -> _Surface:
        found = meeting.surface_of(k)
        columns = (
            meeting.owner[:, k : k + 1] >= 0,
            (meeting.owner >= 0).sum(1, keepdim=True) == 1,
            meeting.owner[:, k : k + 1].to(torch.int32),
            found.kind[:, None],
            found.friction[:, None],
            meeting.sign * found.normal,
            meeting.sign * found.velocity,
        )
        if meeting.nodes is None:
            return cls(*columns)
        rows = meeting.nodes
        return cls(*(column.new_zeros(nodes, column.shape[1]).index_copy(0, rows, column) for column in columns))


def _add_sticky(bounds: NodeBounds, surface: _Surface) -> None:
    rows = surface.there & (surface.kind == KINDS["sticky"]) & (bounds.lower != bounds.upper)  # what a wall holds stays
    bounds.lower = torch.where(rows, surface.velocity, bounds.lower)
    bounds.upper = torch.where(rows, surface.velocity, bounds.upper)
    if bounds.owner is not None:
        bounds.owner = torch.where(rows, surface.owner, bounds.owner)


def _add_along_axis(bounds: NodeBounds, surface: _Surface) -> None:
    """Of a normal along an axis at a node that meets others: a bound of that component as it is."""
    normal = surface.normal
    held = bounds.lower.isfinite() | bounds.upper.isfinite()
    entry = surface.there & ~surface.alone & (surface.kind != KINDS["sticky"]) & _is_along_axis(normal) & ~held
    side = normal.detach().sign()
    if normal.requires_grad:
        tilt = torch.where(entry[:, :, None], (side[:, :, None] * (normal - normal.detach())[:, None]), 0)
        bounds.tilt = tilt if bounds.tilt is None else bounds.tilt + tilt
    _bound(bounds, surface, entry, side, (surface.velocity * normal).sum(-1, keepdim=True))


def _is_along_axis(normal: Tensor) -> Tensor:
    """The axes along which normals are, bool [N, D]."""
    return normal.detach().abs() > 1 - 1e-6


def _add_oblique(bounds: NodeBounds, surface: _Surface) -> None:
    """Of any other normal: the first is turned to an axis, what others have beside it counts along the nearest one."""
    normal = surface.normal
    other = surface.alone | ~_is_along_axis(normal).any(-1, keepdim=True)
    oblique = surface.there & (surface.kind != KINDS["sticky"]) & other
    taken = torch.zeros_like(oblique) if bounds.mirror is None else (bounds.mirror != 0).any(-1, keepdim=True)
    held = bounds.lower.isfinite() | bounds.upper.isfinite()
    seen = torch.where(held, 0, torch.where(taken, bounds.turned(normal), normal))
    length = seen.norm(dim=-1, keepdim=True)
    rows = oblique & (length > 1e-3)
    seen = seen / torch.where(length > 0, length, 1)
    axis = torch.nn.functional.one_hot(seen.abs().argmax(-1), seen.shape[1]).to(seen.dtype)
    side = torch.where((seen * axis).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(seen.dtype)
    # The reflection that takes the axis to −side times the normal, whose difference does not cancel.
    w = axis * side + seen
    w = w / w.norm(dim=-1, keepdim=True)
    old = torch.zeros_like(w) if bounds.mirror is None else bounds.mirror
    bounds.mirror = torch.where(rows & ~taken, w, old)
    velocity = torch.where(taken, bounds.turned(surface.velocity), surface.velocity)
    speed = (velocity * seen).sum(-1, keepdim=True)
    _bound(bounds, surface, rows & (axis > 0), torch.where(taken, side, -side), speed)


def _bound(bounds: NodeBounds, surface: _Surface, entry: Tensor, side: Tensor, speed: Tensor) -> None:
    """Bounds of some components, bool [N, D], in the axes of the nodes, by a surface whose normal has the sign `side`
    along them and a normal velocity `speed` [N, 1]."""
    limit = side * speed
    fixed = surface.kind == KINDS["slip"]
    bounds.lower = torch.where(entry & ((side > 0) | fixed), limit, bounds.lower)
    bounds.upper = torch.where(entry & ((side < 0) | fixed), limit, bounds.upper)
    if bounds.owner is not None:
        bounds.owner = torch.where(entry, surface.owner, bounds.owner)
    if bounds.friction is None or bounds.surface is None:
        return
    rubs_first = (bounds.friction == 0).all(-1, keepdim=True) | (surface.friction.detach() > 0)
    rubs_here = entry.any(-1, keepdim=True) & rubs_first
    bounds.friction = torch.where(entry, side * surface.friction, bounds.friction)
    bounds.surface = torch.where(rubs_here, bounds.turned(surface.velocity), bounds.surface)
