"""All obstacles of a scene as one solid, in torch operations: the surfaces that nodes inside it meet.

The rules are those of csrc/grid/solid.h, which explains them. What is found, the faces and the points where their
normals are read, has no gradient; normals, velocities and friction that are evaluated from it do.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..geometry.shapes import Box, Capsule, Plane, Sampled, Shape, Sphere
from ..geometry.vectors import norm
from .constraints import KINDS, Constraints
from .walls import Face

if TYPE_CHECKING:
    from .obstacles import Obstacle

REACH = 3.0
"""How far from free space nodes meet its faces, in dx."""
SEAM = 0.1
"""Half of it, in dx, is the width of gaps and the height of steps that count as closed."""
MOST_FACES, MOST_AT_ONCE = 12, 6
"""Faces that a node looks at, the nearest ones; and where values may not be looked at, so that absent ones cost as much
as others."""
PASSES = 3
"""Passes that move a point to a surface: those from deep inside several obstacles may need more than one."""
SAME = 0.94
"""Cosine between normals that count as one, of shapes that are known by their distance alone."""


@dataclasses.dataclass
class SolidNodes:
    """Nodes and the obstacles that they may meet.

    Attributes:
        obstacles: K of them.
        acts: which nodes each of them may act on, bool [N], or None for all.
        positions: of the nodes [N, D] [m].
        scene: of each node, int32 [N], or None for one scene.
        time: [s], a number or a tensor [] or [B].
        dx: node distance [m]; None for nodes of no lattice, whose seams are a share of their coordinates.
        faces: of the domain.
    """

    obstacles: Sequence[Obstacle]
    acts: Sequence[Tensor | None]
    positions: Tensor
    scene: Tensor | None
    time: float | Tensor
    dx: float | None
    faces: Sequence[Face] = ()

    def __post_init__(self) -> None:
        """Rounding is that of the largest coordinate, of nodes beyond these too."""
        largest = self.positions.detach().abs().amax() if len(self.positions) else self.positions.new_zeros(())
        self.rounding = 16 * torch.finfo(self.positions.dtype).eps * largest
        size = 1e-3 * largest if self.dx is None else torch.full_like(largest, SEAM * self.dx)
        self.seam = torch.maximum(4 * self.rounding, size)
        self.unit = 1e-3 * self.seam
        self.reach = math.inf if self.dx is None else REACH * self.dx

    def chosen(self, rows: Tensor) -> SolidNodes:
        """Some of the nodes, int64 [n]."""
        other = dataclasses.replace(
            self,
            acts=[None if a is None else a[rows] for a in self.acts],
            positions=self.positions[rows],
            scene=None if self.scene is None else self.scene[rows],
        )
        other.rounding, other.seam, other.unit = self.rounding, self.seam, self.unit
        return other

    def distances(self, x: Tensor) -> Tensor:
        """Of points [N, ..., D] around each node from each obstacle [N, ..., K] [m]; infinite where it does not act."""
        inner = x.shape[1:-1]
        count = math.prod(inner)
        points = x.reshape(-1, x.shape[-1])
        scene = None if self.scene is None else self.scene.repeat_interleave(count)
        found = []
        for obstacle, acts in zip(self.obstacles, self.acts, strict=True):
            distance = obstacle.signed_distance(points, scene, self.time).reshape(len(x), *inner)
            if acts is not None:
                distance = torch.where(acts.reshape(-1, *[1] * len(inner)), distance, torch.inf)
            found.append(distance)
        return torch.stack(found, -1)

    def is_free(self, at: Tensor, step: Tensor) -> Tensor:
        """Whether a step [N, D] of the height of a seam from points of surfaces [N, D] leads into free space [N]."""
        result = (self.distances(at + self.seam * step) > self.seam / 2).all(1)
        for number, face in enumerate(self.faces):
            if _is_closed(face):
                axis, up = number // 2, 1 - 2 * (number % 2)
                looks = (up * (at[:, axis] - face.plane) <= self.seam) & (-up * step[:, axis] > 0.7)
                result = result & ~looks
        return result

    def within_walls(self, x: Tensor, inset: float | Tensor = 0.0) -> tuple[Tensor, Tensor]:
        """Positions [N, D] within the walls, and the signs of velocities there: −1 behind mirrors."""
        x, sign = x.clone(), torch.ones_like(x)
        for number, face in enumerate(self.faces):
            if _is_closed(face):
                axis, up = number // 2, 1 - 2 * (number % 2)
                height = up * (x[:, axis] - face.plane)
                if face.kind == "mirror":
                    sign[:, axis] = torch.where(height < 0, -1, sign[:, axis])
                    height = height.abs()
                x[:, axis] = face.plane + up * torch.maximum(height, torch.zeros_like(height) + inset)
        return x, sign

    def at_walls(self, x: Tensor) -> Tensor:
        """Which walls positions within them are at, bool [N, 2 D]."""
        near = self.rounding + 1e-5 * self.seam
        columns = [
            (1 - 2 * (number % 2)) * (x[:, number // 2] - face.plane) <= near
            if _is_closed(face)
            else torch.zeros_like(x[:, 0], dtype=torch.bool)
            for number, face in enumerate(self.faces)
        ]
        return torch.stack(columns, 1) if columns else x.new_zeros(len(x), 2 * x.shape[1], dtype=torch.bool)


class Surface(NamedTuple):
    """One surface that each node meets.

    Attributes:
        kind: a number of `KINDS`, int64 [n]; 0 for none.
        friction: [n].
        normal, velocity: unit normal into the material and velocity of the surface [n, D].
    """

    kind: Tensor
    friction: Tensor
    normal: Tensor
    velocity: Tensor


@dataclasses.dataclass
class Meeting:
    """The surfaces that nodes meet.

    Attributes:
        nodes: rows of the nodes that may meet one, int64 [n], or None for all N.
        position: of these within the walls [n, D] [m].
        sign: of velocities there [n, D].
        owner: obstacle of each face, int64 [n, D], −1 for none; the first comes first.
        face: number of it, −1 for the whole surface [n, D].
        at: where its normal is read [n, D, D].
        walls: which walls a node is at, bool [n, 2 D].
        foot: the nearest point of free space, where one was found [n, D] [m]; NaN elsewhere.
        solid: these nodes.
    """

    nodes: Tensor | None
    position: Tensor
    sign: Tensor
    owner: Tensor
    face: Tensor
    at: Tensor
    walls: Tensor
    foot: Tensor
    solid: SolidNodes

    def constraints(self) -> Constraints:
        """Differentiable by the poses, motions and friction of obstacles."""
        parts = [self.surface_of(k) for k in range(self.position.shape[1])]
        kind, friction, normal, velocity = (torch.stack(part, 1) for part in zip(*parts, strict=True))
        result = Constraints(self.owner, kind, friction, normal, velocity)
        return result if not self.solid.faces else result.with_walls(self.solid.faces, self.walls)

    def surface_of(self, k: int) -> Surface:
        """The surface of the face number k of each node."""
        at, owner, solid = self.at[:, k], self.owner[:, k], self.solid
        kind, friction = torch.zeros_like(owner), torch.zeros_like(at[:, 0])
        normal, velocity = torch.zeros_like(at), torch.zeros_like(at)
        for number, obstacle in enumerate(solid.obstacles):
            own = owner == number
            if k > 0 and not _may_join(solid.obstacles):
                break
            mine = own[:, None]
            _, found = obstacle.height_of_face(at, self.face[:, k], solid.scene, solid.time)
            normal = torch.where(mine, found, normal)
            moves = obstacle.matter_velocity(self.position, solid.scene, solid.time)
            if moves is not None:
                velocity = torch.where(mine, moves, velocity)
            value = obstacle.friction
            if isinstance(value, Tensor):
                value = obstacle.at_nodes("friction", at, (), solid.scene)
            friction = torch.where(own, value, friction)
            kind = torch.where(own, KINDS[obstacle.kind], kind)
        return Surface(kind, friction, normal, velocity)


def after_contact(velocity: Tensor, solid: SolidNodes) -> tuple[Tensor, list[Tensor]]:
    """Node velocities [N, D] [m/s] after contact with obstacles as one solid, and the changes by each of these.

    The changes that walls make beside an obstacle count as those of the first. Differentiable, twice.
    """
    unchanged = [torch.zeros_like(velocity) for _ in solid.obstacles]
    meeting = find_surfaces(solid)
    if meeting is None:
        return velocity, unchanged
    v = velocity if meeting.nodes is None else velocity[meeting.nodes]
    touching = (meeting.owner[:, :1] >= 0).expand_as(v)
    # A NaN outside does not reach the gradient of the parameters.
    v = meeting.sign * torch.where(touching, v, 0)
    constraints = meeting.constraints()
    changes = meeting.sign[:, None] * constraints.changes(v)
    owner = torch.where(constraints.owner == -2, constraints.owner[:, :1], constraints.owner)
    by_obstacle = []
    for number in range(len(solid.obstacles)):
        change = torch.where((owner == number)[:, :, None], changes, 0).sum(1)
        if meeting.nodes is not None:
            change = torch.zeros_like(velocity).index_add(0, meeting.nodes, change)
        by_obstacle.append(change)
    return velocity + torch.stack(by_obstacle).sum(0), by_obstacle


def find_surfaces(solid: SolidNodes) -> Meeting | None:
    """The surfaces that nodes meet; None where no obstacle is near. On the CPU the rest looks at nodes inside alone."""
    with torch.no_grad():
        positions = solid.positions.detach()
        x, sign = solid.within_walls(positions)
        distance = solid.distances(x)
        inside = (distance <= solid.rounding).any(1)
        walls = solid.at_walls(x)
        if solid.faces:  # a gap between an obstacle and a wall
            beside = solid.within_walls(positions, solid.seam)[0]
            there = solid.distances(beside)
            closed = ~inside & walls.any(1) & (there <= solid.rounding).any(1)
            x, distance = torch.where(closed[:, None], beside, x), torch.where(closed[:, None], there, distance)
            inside = inside | closed
        rows = None
        if positions.device.type == "cpu" and not torch.compiler.is_compiling():
            rows = inside.nonzero()[:, 0]
            if len(rows) == 0:
                return None
            solid, inside, x, distance = solid.chosen(rows), inside[rows], x[rows], distance[rows]
            sign, walls = sign[rows], walls[rows]
        owner, face, at, foot = _feet(solid, x, distance)
        owner = torch.where(inside[:, None], owner, -1)
        return Meeting(rows, x, sign, owner, face, at, walls, foot, solid)


def moved_to_surface(solid: SolidNodes) -> tuple[Tensor, Tensor]:
    """Positions [N, D] [m], those inside obstacles moved to the nearest point of free space, and which have moved, bool
    [N]. Without gradient."""
    x = solid.positions.detach()
    moved = torch.zeros_like(x[:, 0], dtype=torch.bool)
    for _ in range(PASSES):
        inside = (solid.distances(x) < -solid.rounding).any(1)
        if not _may_be(inside):
            break
        meeting = find_surfaces(dataclasses.replace(solid, positions=x))
        if meeting is None:
            break
        whole = _nearest_foot(meeting.solid, meeting.position, meeting.owner[:, 0])
        foot = torch.where(meeting.foot.isnan(), whole, meeting.foot)
        foot = foot if meeting.nodes is None else x.index_copy(0, meeting.nodes, foot)
        x, moved = torch.where(inside[:, None], foot, x), moved | inside
    return x, moved


def _is_closed(face: Face) -> bool:
    return face.kind != "open" and math.isfinite(face.plane)


def _is_plain(obstacle: Obstacle) -> bool:
    """Whether the shape is convex and its surface is one face."""
    return type(obstacle.shape) in (Plane, Sphere, Capsule)


def _has_faces(obstacle: Obstacle) -> bool:
    """Whether the shape knows its faces."""
    return type(obstacle.shape).surface_faces is not Shape.surface_faces


def _may_join(obstacles: Sequence[Obstacle]) -> bool:
    """Whether surfaces of obstacles may join at inner edges."""
    return len(obstacles) > 1 or not _is_plain(obstacles[0])


# ---- faces near nodes


@dataclasses.dataclass
class _Candidates:
    """Faces of nodes [N, F].

    Attributes:
        owner, face: of each column, int64 [F].
        flat: whether its heights are linear, bool [F].
        at, height, normal: a point [N, F, D], its height [N, F] and the normal there [N, F, D].
        depth: of the nodes [N, F] [m]; infinite for faces that a node does not look at.
    """

    owner: Tensor
    face: Tensor
    flat: Tensor
    at: Tensor
    height: Tensor
    normal: Tensor
    depth: Tensor

    def nearest(self, most: int, unit: Tensor) -> _Candidates:
        """The nearest `most` of each node, by depths in steps of `unit` [m], so that rounding does not order what is
        equally deep; columns of the first three are then those of each node [N, M]."""
        order = rounded(self.depth, unit).sort(stable=True, dim=1).indices[:, :most]
        if self.depth.device.type == "cpu" and not torch.compiler.is_compiling():
            present = self.depth.isfinite().sum(1).amax() if len(self.depth) else 1
            order = order[:, : max(1, int(present))]
        wide = order[:, :, None].expand(-1, -1, self.at.shape[2])
        return _Candidates(
            self.owner[order],
            self.face[order],
            self.flat[order],
            self.at.gather(1, wide),
            self.height.gather(1, order),
            self.normal.gather(1, wide),
            self.depth.gather(1, order),
        )


def _faces_near(solid: SolidNodes, x: Tensor, distance: Tensor) -> _Candidates:
    parts: list[list[Tensor]] = [[] for _ in range(7)]

    def add(k: int, face: int, flat: bool, at: Tensor, height: Tensor, normal: Tensor, depth: Tensor) -> None:
        values = (torch.tensor(k), torch.tensor(face), torch.tensor(flat), at, height, normal, depth)
        for part, value in zip(parts, values, strict=True):
            part.append(value)

    for k, obstacle in enumerate(solid.obstacles):
        acts = distance[:, k] < torch.inf
        found = obstacle.faces_at(x, solid.scene, solid.time)
        if found is None:
            _add_distance(solid, k, x, acts, add)
            continue
        near = acts & (distance[:, k] <= solid.reach)
        alone = found.height.shape[1] == 1
        for f in range(found.height.shape[1]):
            height, normal = found.height[:, f], found.normal[:, f]
            sees = near & (height <= solid.seam / 2) & (-height <= solid.reach) & (found.beyond[:, f] <= solid.reach)
            sees = sees & ((normal * normal).sum(1) > 0.5)
            add(k, -1 if alone else f, found.flat, x, height, normal, torch.where(sees, -height, torch.inf))
    owner, face, flat = (torch.stack(part).to(x.device) for part in parts[:3])
    at, height, normal, depth = (torch.stack(part, 1) for part in parts[3:])
    return _Candidates(owner, face, flat, at, height.nan_to_num(posinf=0.0), normal, depth)


def _add_distance(solid: SolidNodes, k: int, x: Tensor, acts: Tensor, add: Any) -> None:
    """Faces of a shape that is known by its distance alone: its surface; where faces join at the point nearest to a
    node, the planes that free space sees around that; and where that point is covered, or the node is beside the shape,
    those that neighbours of the node see."""
    obstacle = solid.obstacles[k]
    height, normal = obstacle.surface_at(x, solid.scene, solid.time)
    sees = acts & (height <= solid.seam / 2) & (-height <= solid.reach) & ((normal * normal).sum(1) > 0.5)
    nearest, first = sees, x - height[:, None] * normal
    away = 2.5 * solid.seam
    if isinstance(obstacle.shape, Sampled):
        away = away.clamp_min(1.5 * obstacle.shape.spacing)
    planes = []
    for lean in _leaning(normal):
        at = first + away * lean
        above, toward = obstacle.surface_at(at, solid.scene, solid.time)
        behind = above < 0
        if _may_be(sees & behind):  # it sees the face that it is behind, from before it
            at = torch.where(behind[:, None], at + (0.3 * away - above)[:, None] * toward, at)
            above, toward = obstacle.surface_at(at, solid.scene, solid.time)
        planes.append((at, above, toward))
    free = [plane[1] >= 0 for plane in planes]
    differs = [there & ((plane[2] * normal).sum(1) < SAME) for there, plane in zip(free, planes, strict=True)]
    joins = nearest & torch.stack(differs).any(0)
    wanted = [there & joins for there in free]
    if math.isfinite(solid.reach):
        beside = acts & (height > solid.rounding) & (height <= solid.reach)
        covered = beside | (sees & ~solid.is_free(first, normal))
        sees = sees | beside
        for way in itertools.product((0.0, 1.0, -1.0), repeat=x.shape[1]):
            if any(way) and _may_be(covered):
                at = x + solid.reach * obstacle.turned(x.new_tensor(way[::-1]).expand_as(x), solid.scene, solid.time)
                above, toward = obstacle.surface_at(at, solid.scene, solid.time)
                planes.append((at, above, toward))
                wanted.append(covered & (above >= 0))
    # At an edge the normal is not defined, and distances rise more slowly along it.
    is_a_face = obstacle.signed_distance(first + solid.seam * normal, solid.scene, solid.time) > 0.8 * solid.seam
    for flat, own in ((False, ~joins), (True, joins & is_a_face)):
        add(k, -1, flat, x, height, normal, torch.where(nearest & own, -height, torch.inf))
    known: list[tuple[Tensor, Tensor]] = []
    for (at, above, toward), looked_for in zip(planes, wanted, strict=True):
        depth = -(above + (toward * (x - at)).sum(1))
        own = sees & looked_for & ((toward * toward).sum(1) > 0.5) & (depth >= -solid.seam) & (depth <= solid.reach)
        for other, has in known:
            own = own & ~(has & ((other * toward).sum(1) > SAME))
        known.append((toward, own))
        add(k, -1, True, at, above, toward, torch.where(own, depth, torch.inf))


def rounded(depth: Tensor, unit: Tensor) -> Tensor:
    """Depths in steps of a unit."""
    return (depth / unit + 0.5).floor()


def _may_be(mask: Tensor) -> bool:
    """Whether a mask [N] is anywhere set, where looking is free."""
    return torch.compiler.is_compiling() or mask.device.type != "cpu" or bool(mask.any())


def _leaning(axis: Tensor) -> list[Tensor]:
    """Unit vectors [N, D], and directions at 55° to them, evenly around."""
    half, root = math.cos(math.radians(55)), math.sin(math.radians(55))
    if axis.shape[1] == 2:
        turned = torch.stack([-axis[:, 1], axis[:, 0]], 1)
        return [axis, half * axis - root * turned, half * axis + root * turned]
    x, y, z = axis.unbind(1)
    sign = torch.where(z < 0, -1, 1).to(axis.dtype)
    f = -1 / (sign + z)
    g = x * y * f
    u = torch.stack([1 + sign * x * x * f, sign * g, -sign * x], 1)
    w = torch.stack([g, sign + y * y * f, -y], 1)
    turns = [(1.0, 0.0), (0.5, math.sqrt(0.75)), (-0.5, math.sqrt(0.75))]
    return [axis, *(half * axis + turn * (c * u + s * w) for turn in (root, -root) for c, s in turns)]


# ---- feet


def _feet(solid: SolidNodes, x: Tensor, distance: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Owner and number [n, D] of the faces that nodes meet, where their normals are read [n, D, D], and their feet
    [n, D]."""
    dim = x.shape[1]
    around = _around(solid, x, distance)
    owner = torch.full((len(x), dim), -1, device=x.device)
    owner[:, 0] = around
    face = torch.full_like(owner, -1)
    at = x[:, None].expand(-1, dim, -1).clone()
    if not _may_join(solid.obstacles) and not solid.faces:
        return owner, face, at, torch.full_like(x, torch.nan)
    skips = x.device.type == "cpu" and not torch.compiler.is_compiling()
    distance = _without_others(solid, x, distance, around)
    faces = _faces_near(solid, x, distance).nearest(MOST_FACES if skips else MOST_AT_ONCE, solid.unit)
    best = _Best(solid, faces, x)
    for count in range(1, dim + 1):
        for members in itertools.combinations(range(faces.depth.shape[1]), count):
            best.consider(members)
    found = best.members >= 0
    member = best.members.clamp_min(0)
    has = found[:, :1]
    owner = torch.where(has, torch.where(found, faces.owner.gather(1, member), -1), owner)
    face = torch.where(found, faces.face.gather(1, member), face)
    planes = faces.flat.gather(1, member) & best.by_distance.gather(1, member) & found
    wide = member[:, :, None].expand(-1, -1, dim)
    foot = torch.where(has, best.at, torch.nan)
    return owner, face, torch.where(planes[:, :, None], faces.at.gather(1, wide), at), foot


def _around(solid: SolidNodes, x: Tensor, distance: Tensor) -> Tensor:
    """The least deep obstacle that each node is in, int64 [n]; of equally deep ones the stricter, and then that of more
    friction."""
    depth = rounded(-distance.masked_fill(distance > solid.rounding, -torch.inf), solid.unit)
    first = depth == depth.amin(1, keepdim=True)
    kinds = torch.tensor([KINDS[o.kind] for o in solid.obstacles], device=x.device)
    kind = torch.where(first, kinds, len(KINDS) + 1)
    friction = torch.stack([_friction_of(o, solid, x) for o in solid.obstacles], 1)
    return torch.where(kind == kind.amin(1, keepdim=True), friction, -1).argmax(1)


def _friction_of(obstacle: Obstacle, solid: SolidNodes, x: Tensor) -> Tensor:
    """[n]"""
    value = obstacle.friction
    if isinstance(value, Tensor):
        return obstacle.at_nodes("friction", x, (), solid.scene).detach().expand(len(x))
    return x.new_full((len(x),), value)


def _without_others(solid: SolidNodes, x: Tensor, distance: Tensor, around: Tensor) -> Tensor:
    """Distances [n, K], infinite but for a convex obstacle around a node where no other one, nor a wall, is as near as
    its surface: its faces are not combined with those of others."""
    own = distance.gather(1, around[:, None])
    away = 2 * solid.seam - own
    near = (distance <= away).sum(1, keepdim=True) > 1
    for number, face in enumerate(solid.faces):
        if _is_closed(face):
            axis, up = number // 2, 1 - 2 * (number % 2)
            near = near | (up * (x[:, axis, None] - face.plane) <= away)
    convex = torch.tensor([_is_plain(o) or type(o.shape) is Box for o in solid.obstacles], device=x.device)
    others = torch.arange(distance.shape[1], device=x.device) != around[:, None]
    return torch.where(others & ~near & convex[around][:, None], torch.inf, distance)


def _nearest_foot(solid: SolidNodes, x: Tensor, around: Tensor) -> Tensor:
    """The point of the surface of one obstacle of each node, int64 [n], that is nearest to it [n, D]."""
    foot = x
    for k, obstacle in enumerate(solid.obstacles):
        own = around == k
        if _may_be(own):
            distance, normal = obstacle.surface_at(x, solid.scene, solid.time)
            foot = torch.where(own[:, None], x - distance[:, None] * normal, foot)
    return foot


class _Best:
    """The best foot of each node so far."""

    def __init__(self, solid: SolidNodes, faces: _Candidates, x: Tensor) -> None:
        n, dim = x.shape
        self.solid, self.faces, self.x = solid, faces, x
        self.depth = torch.full_like(x[:, 0], torch.inf)
        self.at = x.clone()
        self.members = torch.full((n, dim), -1, device=x.device)
        known = torch.tensor(
            [type(o.shape).surface_faces is not Shape.surface_faces for o in solid.obstacles], device=x.device
        )
        self.by_distance = ~known[faces.owner]
        kinds = torch.tensor([KINDS[o.kind] for o in solid.obstacles], device=x.device)
        self.kinds = kinds[faces.owner]
        self.frictions = torch.zeros_like(faces.depth)
        for k, obstacle in enumerate(solid.obstacles):
            value = obstacle.friction
            if isinstance(value, Tensor):
                value = obstacle.at_nodes("friction", x, (), solid.scene)[..., None].detach()
            self.frictions = torch.where(faces.owner == k, value, self.frictions)
        self.kind, self.friction = torch.zeros_like(self.members[:, 0]), torch.zeros_like(self.depth)
        self.step = torch.zeros_like(x)
        self.unit = solid.unit

    def consider(self, members: Sequence[int]) -> None:
        depth = self.faces.depth[:, list(members)].amax(1)
        depth = rounded(depth, self.unit)
        wanted = depth.isfinite() & (depth <= self.depth)
        if not _may_be(wanted):
            return
        found, at, step = self._solve(members)
        found = found & wanted
        if not _may_be(found):
            return
        found = found & self._is_exposed(members, at, step)
        kind, friction = self.kinds[:, list(members)].amin(1), self.frictions[:, list(members)].amax(1)
        better = found & ((depth < self.depth) | self._comes_first(members, kind, friction, step))
        self.kind, self.friction = torch.where(better, kind, self.kind), torch.where(better, friction, self.friction)
        self.step = torch.where(better[:, None], step, self.step)
        self.depth = torch.where(better, depth, self.depth)
        self.at = torch.where(better[:, None], at, self.at)
        padded = torch.tensor([*members, *[-1] * (self.members.shape[1] - len(members))], device=at.device)
        self.members = torch.where(better[:, None], padded, self.members)

    def _height(self, member: int, at: Tensor) -> tuple[Tensor, Tensor]:
        """Of points [N, D] above a face of each node [N], and the normal there [N, D]."""
        faces, solid = self.faces, self.solid
        normal = faces.normal[:, member]
        height = faces.height[:, member] + (normal * (at - faces.at[:, member])).sum(1)
        flat = faces.flat[:, member]
        for k, obstacle in enumerate(solid.obstacles):
            own = ~flat & (faces.owner[:, member] == k)
            if not _may_be(own):
                continue
            above, toward = obstacle.height_of_face(at, faces.face[:, member], solid.scene, solid.time)
            height, normal = torch.where(own, above, height), torch.where(own[:, None], toward, normal)
        return height, normal

    def _solve(self, members: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Where the foot exists, its position [N, D], and the step out of it [N, D]."""
        count = len(members)
        at, step, found = self.x, self.x, torch.ones_like(self.x[:, 0], dtype=torch.bool)
        for _ in range(1 if count == 1 else 3):
            height, normal = (
                torch.stack(part, 1) for part in zip(*(self._height(m, at) for m in members), strict=True)
            )
            rest = (normal * (at - self.x)[:, None]).sum(2) - height
            gram = normal @ normal.mT
            independent = _least_pivot(gram) > 1e-3
            eye = torch.eye(count, dtype=gram.dtype, device=gram.device)
            gram = torch.where(independent[:, None, None], gram, eye)
            both = torch.linalg.solve_ex(gram, torch.stack([rest, torch.ones_like(rest)], 2))[0]
            share, ones = both.unbind(2)
            slack = self.solid.seam / 2 if count > 1 else self.solid.rounding
            found = found & independent & (share >= -slack).all(1)
            at = torch.where(found[:, None], self.x + (share[:, :, None] * normal).sum(1), self.x)
            step = (ones[:, :, None] * normal).sum(1)
        found = found & (norm(at - self.x) <= self.solid.reach)
        return found, at, step

    def _is_exposed(self, members: Sequence[int], at: Tensor, step: Tensor) -> Tensor:
        solid, faces, seam = self.solid, self.faces, self.solid.seam
        result = torch.ones_like(at[:, 0], dtype=torch.bool)
        near = torch.stack([self._nearness(obstacle) for obstacle in solid.obstacles])
        for member in members:
            _, normal = self._height(member, at)
            # At an edge the normal of a shape that is known by its distance alone is not defined.
            normal = torch.where(self.by_distance[:, member, None], faces.normal[:, member], normal)
            owner = faces.owner[:, member]
            beside = solid.distances(at + seam * (step - normal)).gather(1, owner[:, None])[:, 0]
            result = result & (beside <= near[owner])
        return result & solid.is_free(at, step)

    def _nearness(self, obstacle: Obstacle) -> Tensor:
        """How far from the surface of an obstacle a point beside the foot may be [m]. Tangents of edges, as distances
        alone show them, leave the surface; samples round edges."""
        seam, shape = self.solid.seam, obstacle.shape
        if isinstance(shape, Sampled):
            return seam / 2 + 0.5 * shape.spacing
        return seam / 2 if _has_faces(obstacle) else seam / 4

    def _comes_first(self, members: Sequence[int], kind: Tensor, friction: Tensor, step: Tensor) -> Tensor:
        """Whether a foot as deep as the best one of each node comes first."""
        result = torch.zeros_like(kind, dtype=torch.bool)
        for mine, other in ((step, self.step), (step.abs(), self.step.abs())):  # the sizes first
            for axis in range(step.shape[1] - 1, -1, -1):
                differs = (mine[:, axis] - other[:, axis]).abs() > 1e-3
                result = torch.where(differs, mine[:, axis] > other[:, axis], result)
        result = torch.where(friction != self.friction, friction > self.friction, result)
        result = torch.where(kind != self.kind, kind < self.kind, result)
        count = (self.members >= 0).sum(1)
        return torch.where(count != len(members), count < len(members), result)


def _least_pivot(gram: Tensor) -> Tensor:
    """The least pivot of the elimination of Gram matrices [N, n, n], [N]."""
    g, least = gram, gram[:, 0, 0]
    for k in range(gram.shape[1] - 1):
        pivot = g[:, k, k]
        safe = torch.where(pivot > 0, pivot, 1)
        g = g - g[:, :, k, None] * g[:, None, k, :] / safe[:, None, None]
        least = torch.minimum(least, g[:, k + 1, k + 1])
    return least
