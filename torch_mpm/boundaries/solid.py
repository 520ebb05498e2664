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

from ..geometry.shapes import Sampled, Shape
from ..geometry.vectors import norm, unit
from . import constraints
from .constraints import KINDS, Constraints
from .walls import Face

if TYPE_CHECKING:
    from .obstacles import Obstacle

REACH = 3.0
"""How far from free space nodes of a step meet its faces, in dx."""
SEAM = 0.1
"""Half of it, in dx, is the width of gaps and the height of steps that count as closed."""
MOST_FACES, MOST_COMPILED = 12, 6
"""Faces that a node looks at, the nearest ones; and in compiled functions, where absent ones cost as much as others."""
FEET_AT_ONCE = 2**19
"""Feet that are computed together where values may not be looked at."""
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
        sees: how far from free space nodes meet its faces, in dx.
    """

    obstacles: Sequence[Obstacle]
    acts: Sequence[Tensor | None]
    positions: Tensor
    scene: Tensor | None
    time: float | Tensor
    dx: float | None
    faces: Sequence[Face] = ()
    sees: float = REACH

    def __post_init__(self) -> None:
        """Rounding is that of the largest coordinate, of nodes beyond these too."""
        largest = self.positions.detach().abs().amax() if len(self.positions) else self.positions.new_zeros(())
        self.rounding = 16 * torch.finfo(self.positions.dtype).eps * largest
        size = 1e-3 * largest if self.dx is None else torch.full_like(largest, SEAM * self.dx)
        self.seam = torch.maximum(4 * self.rounding, size)
        self.unit = 1e-3 * self.seam
        self.reach = math.inf if self.dx is None else self.sees * self.dx

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

    def kinds(self) -> Tensor:
        """Numbers of `KINDS`, int64 [K]."""
        return self.constants([KINDS[o.kind] for o in self.obstacles])

    def constants(self, values: Sequence[int | bool | float]) -> Tensor:
        """A tensor of numbers, without a copy to the device."""
        return torch.stack([torch.full((), value, device=self.positions.device) for value in values])

    def frictions(self, x: Tensor) -> Tensor:
        """Of the obstacles at nodes x [N, D], [N, K], without gradient."""
        columns = [
            x.new_full((len(x),), o.friction)
            if isinstance(o.friction, float)
            else o.at_nodes("friction", x, (), self.scene).detach().expand(len(x))
            for o in self.obstacles
        ]
        return torch.stack(columns, 1)

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

    def is_covered(self, k: int, node: _Nearest) -> Tensor:
        """Whether a step of the height of a seam from the points that are nearest to nodes leads into another obstacle,
        a wall, or deeper into their own obstacle [N]. Values of an inexact distance rise there, even if a point is not
        on the surface."""
        ahead = self.obstacles[k].signed_distance(node.first + self.seam * node.normal, self.scene, self.time)
        return ~(ahead - node.start > 0.25 * self.seam) | ~self.is_free(node.first, node.normal, k)

    def is_free(self, at: Tensor, step: Tensor, but: int | None = None) -> Tensor:
        """Whether a step [N, D] of the height of a seam from points of surfaces [N, D] leads into free space [N], but
        for one obstacle."""
        clear = self.distances(at + self.seam * step) > self.seam / 2
        result = torch.stack([c for k, c in enumerate(clear.unbind(1)) if k != but] or [clear[:, 0] | True], 1).all(1)
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
            if obstacle.is_absent(solid.scene, solid.time):
                continue  # its pose may have no derivative
            if k > 0 and not (_may_join(solid.obstacles) and _may_be(own)):
                continue
            mine = own[:, None]
            _, found = obstacle.height_of_face(at, self.face[:, k], solid.scene, solid.time)
            normal = torch.where(mine, found, normal)
            moves = obstacle.matter_velocity(self.position, solid.scene, solid.time)
            if moves is not None:
                velocity = torch.where(mine, moves, velocity)
            value = obstacle.friction
            if not isinstance(value, float):
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
    met = meeting.constraints()
    changes = meeting.sign[:, None] * met.changes(v)
    owner = torch.where(met.owner == -2, met.owner[:, :1], met.owner)
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
        if constraints.reads_values(positions):
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
    [N]. Without gradient.

    Points see faces at any distance. Faces of shapes that are known by their distance alone are found near a point: far
    ones are looked for where a point is still inside.
    """
    far = dataclasses.replace(solid, sees=math.inf)
    if all(map(_has_faces, solid.obstacles)):
        solid = far
    x, moved, inside = _moved_out(solid)
    if solid is not far and _may_be(inside):
        x = torch.where(inside[:, None], _moved_out(far)[0], x)
    return x, moved


def _moved_out(solid: SolidNodes) -> tuple[Tensor, Tensor, Tensor]:
    """`moved_to_surface`, and which points are still inside."""
    x = solid.positions.detach()
    inside = (solid.distances(x) < -solid.rounding).any(1)
    moved = torch.zeros_like(inside)
    for _ in range(PASSES):
        if not _may_be(inside):
            break
        meeting = find_surfaces(dataclasses.replace(solid, positions=x))
        if meeting is None:
            break
        whole = _nearest_foot(meeting.solid, meeting.position, meeting.owner[:, 0])
        foot = torch.where(meeting.foot.isnan(), whole, meeting.foot)
        foot = foot if meeting.nodes is None else x.index_copy(0, meeting.nodes, foot)
        foot = torch.where(inside[:, None], foot, x)
        step = unit(foot - x)
        x, moved = foot, moved | inside
        in_seam = inside & (step != 0).any(1) & ~solid.is_free(x, step)
        inside = (solid.distances(x) < -solid.rounding).any(1) | in_seam
    return x, moved, inside


def _is_closed(face: Face) -> bool:
    return face.kind != "open" and math.isfinite(face.plane)


def _has_faces(obstacle: Obstacle) -> bool:
    """Whether the shape knows its faces."""
    return type(obstacle.shape).surface_faces is not Shape.surface_faces


def _may_join(obstacles: Sequence[Obstacle]) -> bool:
    """Whether surfaces of obstacles may join at inner edges."""
    return len(obstacles) > 1 or not obstacles[0].shape.is_smooth


# ---- faces near nodes


@dataclasses.dataclass
class _Candidates:
    """Faces of nodes [N, F].

    Attributes:
        owner, face: of each column, int64 [F].
        flat: whether heights are linear, bool [N, F].
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

    def members(self, rows: Tensor, member: Tensor) -> _Candidates:
        """Some faces of some nodes, int64 [M], [M, F]."""
        own = rows[:, None]
        return _Candidates(
            *(value[own, member] for value in (self.owner, self.face, self.flat, self.at)),
            *(value[own, member] for value in (self.height, self.normal, self.depth)),
        )

    def nearest(self, most: int, solid: SolidNodes, x: Tensor) -> _Candidates:
        """The nearest `most` of each node, in an order that does not depend on that of obstacles and outlines: by the
        depth in steps of `solid.unit`, the kind, the friction and the normal. Columns of the first two are then those
        of each node [N, M]."""
        order = torch.arange(self.depth.shape[1], device=x.device).expand_as(self.depth)
        kind = solid.kinds()[self.owner].expand_as(self.depth)
        friction = solid.frictions(x)[:, self.owner]
        size, normal = -rounded(self.normal.abs(), 1e-3), -rounded(self.normal, 1e-3)
        keys = [*normal.unbind(2)[::-1], *size.unbind(2)[::-1], -friction, kind, rounded(self.depth, solid.unit)]
        for key in keys:  # the last one first
            order = order.gather(1, key.gather(1, order).sort(stable=True, dim=1).indices)
        order = order[:, :most]
        if constraints.reads_values(self.depth):
            present = self.depth.isfinite().sum(1).amax() if len(self.depth) else 1
            order = order[:, : max(1, int(present))]
        wide = order[:, :, None].expand(-1, -1, self.at.shape[2])
        return _Candidates(
            self.owner[order],
            self.face[order],
            self.flat.gather(1, order),
            self.at.gather(1, wide),
            self.height.gather(1, order),
            self.normal.gather(1, wide),
            self.depth.gather(1, order),
        )


def _faces_near(solid: SolidNodes, x: Tensor, distance: Tensor) -> _Candidates:
    parts: list[list[Tensor]] = [[] for _ in range(7)]

    def add(k: int, face: int, flat: bool | Tensor, at: Tensor, height: Tensor, normal: Tensor, depth: Tensor) -> None:
        values = (
            solid.constants([k])[0],
            solid.constants([face])[0],
            solid.constants([flat])[0].expand(len(x)) if isinstance(flat, bool) else flat,
            at,
            height,
            normal,
            depth,
        )
        for part, value in zip(parts, values, strict=True):
            part.append(value)

    for k, obstacle in enumerate(solid.obstacles):
        acts = distance[:, k] < torch.inf
        found = obstacle.faces_at(x, solid.scene, solid.time)
        if found is None:
            _add_distance(solid, k, x, distance, add)
            continue
        near = acts & (distance[:, k] <= solid.reach)
        alone = found.height.shape[1] == 1
        for f in range(found.height.shape[1]):
            height, normal = found.height[:, f], found.normal[:, f]
            sees = near & (height <= solid.seam / 2) & (-height <= solid.reach) & (found.beyond[:, f] <= solid.reach)
            sees = sees & ((normal * normal).sum(1) > 0.5)
            flat = found.flat if isinstance(found.flat, bool) else found.flat[:, f] <= solid.reach
            add(k, -1 if alone else f, flat, x, height, normal, torch.where(sees, -height, torch.inf))
    owner, face = (torch.stack(part) for part in parts[:2])
    flat, at, height, normal, depth = (torch.stack(part, 1) for part in parts[2:])
    return _Candidates(owner, face, flat, at, height.nan_to_num(posinf=0.0), normal, depth)


def _add_distance(solid: SolidNodes, k: int, x: Tensor, distance: Tensor, add: Any) -> None:
    """Faces of a shape that is known by its distance alone: its surface; where faces join at the point nearest to a
    node, the planes that free space sees around that; and where that point is covered, or the node is beside the shape,
    those of the faces that neighbours of the node see."""
    obstacle, acts = solid.obstacles[k], distance[:, k] < torch.inf
    node = _nearest(solid, k, x, distance)
    height, normal, first = node.height, node.normal, node.first
    sees = nearest = acts & (height <= solid.seam / 2) & (-height <= solid.reach) & ((normal * normal).sum(1) > 0.5)
    away = _away(solid, obstacle)
    around = [first + away * lean for lean in _leaning(normal)]
    seen = _surfaces(solid, obstacle, around)
    behind = [sees & (above < 0) for above, _ in seen]
    if _may_be(torch.stack(behind)):  # these see the face that they are behind, from before it
        around = [
            torch.where(moves[:, None], at + (0.3 * away - above)[:, None] * toward, at)
            for at, (above, toward), moves in zip(around, seen, behind, strict=True)
        ]
        seen = _surfaces(solid, obstacle, around)
    planes = [(at, above, toward) for at, (above, toward) in zip(around, seen, strict=True)]
    free = [plane[1] >= 0 for plane in planes]
    differs = [there & _join(solid, node, *plane) for there, plane in zip(free, planes, strict=True)]
    joins = nearest & torch.stack(differs).any(0)
    wanted = [there & joins for there in free]
    if math.isfinite(solid.reach):
        beside = acts & (height > solid.rounding) & (height <= solid.reach)
        ridge = joins & node.ridge
        covered = beside | ridge | (sees & solid.is_covered(k, node))
        sees = sees | beside
        if _may_be(covered):
            ways = [way[::-1] for way in itertools.product((0.0, 1.0, -1.0), repeat=x.shape[1]) if any(way)]
            columns = [torch.stack([x.new_full((), step) for step in way]).expand_as(x) for way in ways]
            turned = [obstacle.turned(way, solid.scene, solid.time) for way in columns]
            neighbours = [x + solid.reach * way for way in turned]
            surfaces = _surfaces(solid, obstacle, neighbours)
            on_faces = _are_on_faces(solid, obstacle, neighbours, surfaces)
            for at, (above, toward), on_face in zip(neighbours, surfaces, on_faces, strict=True):
                planes.append((at, above, toward))
                wanted.append(covered & (above >= 0) & on_face)
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


def rounded(depth: Tensor, unit: float | Tensor) -> Tensor:
    """Depths in steps of a unit."""
    return (depth / unit + 0.5).floor()


def _may_be(mask: Tensor) -> bool:
    """Whether a mask [N] is anywhere set, where looking is free."""
    return not constraints.reads_values(mask) or bool(mask.any())


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


class _Nearest(NamedTuple):
    """The surface that a shape known by its distance alone has next to each node.

    Attributes:
        height, normal: distance of the node [n] [m], and the normal there [n, D].
        first: the nearest point by these [n, D].
        start: distance of that [n] [m]. It is not zero where the distance is inexact or has a ridge.
        ridge: whether the node may be equally deep below several faces, bool [n]. Another obstacle or a wall may cover
            one of them.
        slack: how far its distances are from exact ones at a ridge [m]. Samples round it by a quarter of their spacing.
    """

    height: Tensor
    normal: Tensor
    first: Tensor
    start: Tensor
    ridge: Tensor
    slack: Tensor


def _nearest(solid: SolidNodes, k: int, x: Tensor, distance: Tensor) -> _Nearest:
    obstacle = solid.obstacles[k]
    height, normal = obstacle.surface_at(x, solid.scene, solid.time)
    first = x - height[:, None] * normal
    start = obstacle.signed_distance(first, solid.scene, solid.time)
    slack = 0.5 * solid.seam + 0.25 * _spacing(obstacle)
    own = torch.full(x.shape[:1], k, device=x.device)
    return _Nearest(height, normal, first, start, (start < -slack) & _has_others(solid, x, distance, own), slack)


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
    skips = constraints.reads_values(x)
    foot = torch.full_like(x, torch.nan)
    if skips and not bool((searched := _needs_search(solid, x, distance, around)).all()):
        rows = searched.nonzero()[:, 0]
        if len(rows) > 0:
            parts = _feet(solid.chosen(rows), x[rows], distance[rows])
            for whole, part in zip((owner, face, at, foot), parts, strict=True):
                whole[rows] = part
        return owner, face, at, foot
    distance = _without_others(solid, x, distance, around)
    most = MOST_COMPILED if torch.compiler.is_compiling() else MOST_FACES
    faces = _faces_near(solid, x, distance).nearest(most, solid, x)
    best = _Best(solid, faces, x)
    for count in range(1, dim + 1):
        reversed_groups = sorted(g[::-1] for g in itertools.combinations(range(faces.depth.shape[1]), count))
        if reversed_groups:
            best.consider([group[::-1] for group in reversed_groups])
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
    kind = torch.where(first, solid.kinds(), len(KINDS) + 1)
    return torch.where(kind == kind.amin(1, keepdim=True), solid.frictions(x), -1).argmax(1)


def _needs_search(solid: SolidNodes, x: Tensor, distance: Tensor, around: Tensor) -> Tensor:
    """Where a node may meet more than the nearest point of the obstacle around it, bool [n]."""
    near = _has_others(solid, x, distance, around)
    for k, obstacle in enumerate(solid.obstacles):
        own = (around == k) & ~near
        rows = own.nonzero()[:, 0]
        if len(rows) == 0 or obstacle.shape.is_smooth:
            continue
        joins = torch.ones_like(rows, dtype=torch.bool)
        if not _has_faces(obstacle):
            part = solid.chosen(rows)
            node = _nearest(part, k, x[rows], distance[rows])
            away = _away(solid, obstacle)
            joins = part.is_covered(k, node) | ((node.normal * node.normal).sum(1) <= 0.5)
            around_it = [node.first + away * lean for lean in _leaning(node.normal)]
            for at, (above, toward) in zip(around_it, _surfaces(part, obstacle, around_it), strict=True):
                joins = joins | (above < 0) | _join(solid, node, at, above, toward)
        near[rows] = joins
    return near


def _join(solid: SolidNodes, node: _Nearest, at: Tensor, above: Tensor, toward: Tensor) -> Tensor:
    """Whether the plane that points `at` see differs from that of the nearest point of the surface, and goes through
    that or behind it, as where faces join at an inner edge; it is before a rounded body. Bool [n].

    A node that is equally deep below several faces has a normal between theirs, and the point is still inside. There
    the planes join that are no deeper than the node."""
    height, cosine = above + (toward * (node.first - at)).sum(1), (toward * node.normal).sum(1)
    ridge = node.height * (1 - cosine) - node.slack
    lowest = torch.where(node.ridge, ridge, -0.5 * solid.seam)
    return (cosine < SAME) & (height >= lowest)


def _away(solid: SolidNodes, obstacle: Obstacle) -> Tensor:
    """How far around the nearest point of a shape that is known by its distance alone its faces are seen from [m]."""
    return (2.5 * solid.seam).clamp_min(1.5 * _spacing(obstacle))


def _spacing(obstacle: Obstacle) -> float:
    """Spacing of the samples of a shape [m], by which they round edges; zero of other shapes."""
    return float(obstacle.shape.spacing) if isinstance(obstacle.shape, Sampled) else 0.0


def _surfaces(solid: SolidNodes, obstacle: Obstacle, points: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
    """`Obstacle.surface_at` of several points [N, D] of each node."""
    count = len(points)
    scene = None if solid.scene is None else solid.scene.repeat(count)
    height, normal = obstacle.surface_at(torch.cat(list(points)), scene, solid.time)
    return list(zip(height.chunk(count), normal.chunk(count), strict=True))


def _are_on_faces(
    solid: SolidNodes, obstacle: Obstacle, points: Sequence[Tensor], seen: Sequence[tuple[Tensor, Tensor]]
) -> list[Tensor]:
    """Whether the nearest points of the surface to several points [N, D] of each node, by their distance and normal,
    are on faces [N]: a step against the normal of an outer edge is less deep than it is long."""
    step = solid.seam.clamp_min(_spacing(obstacle))
    below = [at - (above + step)[:, None] * toward for at, (above, toward) in zip(points, seen, strict=True)]
    scene = None if solid.scene is None else solid.scene.repeat(len(points))
    distance = obstacle.signed_distance(torch.cat(below), scene, solid.time)
    return list((distance <= -SAME * step).chunk(len(points)))


def _has_others(solid: SolidNodes, x: Tensor, distance: Tensor, around: Tensor) -> Tensor:
    """Where another obstacle, or a wall, is as near as the surface of the obstacle around a node, bool [n]."""
    own = distance.gather(1, around[:, None])
    away = 2 * solid.seam - own
    near = (distance <= away).sum(1, keepdim=True) > 1
    for number, face in enumerate(solid.faces):
        if _is_closed(face):
            axis, up = number // 2, 1 - 2 * (number % 2)
            near = near | (up * (x[:, axis, None] - face.plane) <= away)
    return near[:, 0]


def _without_others(solid: SolidNodes, x: Tensor, distance: Tensor, around: Tensor) -> Tensor:
    """Distances [n, K], infinite but for a convex obstacle around a node where no other one, nor a wall, is as near as
    its surface: its faces are not combined with those of others."""
    near = _has_others(solid, x, distance, around)[:, None]
    convex = solid.constants([o.shape.is_convex for o in solid.obstacles])
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
        known = solid.constants([_has_faces(o) for o in solid.obstacles])
        self.by_distance = ~known[faces.owner]
        self.kinds = solid.kinds()[faces.owner]
        self.frictions = solid.frictions(x).gather(1, faces.owner)
        self.kind, self.friction = torch.zeros_like(self.members[:, 0]), torch.zeros_like(self.depth)
        self.step = torch.zeros_like(x)

    def consider(self, groups: Sequence[Sequence[int]]) -> None:
        """Feet on groups of as many faces each: those that are wanted where `reads_values` holds, else all, in parts
        that memory holds; at once in a compiled function, which parts would make long."""
        if constraints.reads_values(self.x):
            self._consider_wanted(torch.tensor(groups, device=self.x.device))
            return
        size = len(groups) if torch.compiler.is_compiling() else max(1, FEET_AT_ONCE // max(1, len(self.x)))
        for first in range(0, len(groups), size):
            self._consider_all(groups[first : first + size])

    def _consider_all(self, groups: Sequence[Sequence[int]]) -> None:
        n, count, nodes = len(self.x), len(groups), torch.arange(len(self.x), device=self.x.device)
        member = torch.stack([self.solid.constants(group) for group in groups]).repeat(n, 1)
        rows = nodes.repeat_interleave(count)
        faces, solid = self.faces.members(rows, member), self.solid.chosen(rows)
        depth = self._depth(faces)
        found, at, step = _solve(solid, faces, self.x[rows])
        found = found & depth.isfinite() & self._are_exposed(solid, faces, at, step)
        first = found.view(n, count)
        for key in (depth, *self._rank(rows, member, step)):
            values = torch.where(first, key.view(n, count).to(self.x.dtype), torch.inf)
            first = first & (values == values.amin(1, keepdim=True))
        best = nodes * count + first.int().argmax(1)
        self._keep(nodes, member[best], depth[best], at[best], step[best], found[best])

    def _consider_wanted(self, groups: Tensor) -> None:
        depth = rounded(self.faces.depth[:, groups].amax(2), self.solid.unit)
        rows, group = (depth.isfinite() & (depth <= self.depth[:, None])).nonzero().unbind(1)
        if len(rows) == 0:
            return
        member = groups[group]
        found, at, step = _solve(self.solid.chosen(rows), self.faces.members(rows, member), self.x[rows])
        rows, member, at, step = rows[found], member[found], at[found], step[found]
        faces = self.faces.members(rows, member)
        exposed = self._are_exposed(self.solid.chosen(rows), faces, at, step)
        rows, member, at, step = rows[exposed], member[exposed], at[exposed], step[exposed]
        depth = self._depth(self.faces.members(rows, member))
        first = _first_of_each(rows, [depth, *self._rank(rows, member, step)])
        rows, member, depth, at, step = rows[first], member[first], depth[first], at[first], step[first]
        self._keep(rows, member, depth, at, step, torch.ones_like(rows, dtype=torch.bool))

    def _depth(self, faces: _Candidates) -> Tensor:
        return rounded(faces.depth.amax(1), self.solid.unit)

    def _rank(self, rows: Tensor, member: Tensor, step: Tensor) -> list[Tensor]:
        """Numbers that order equally deep feet [M]. The least one comes first; ties compare the next number."""
        kind = self.kinds[rows[:, None], member].amin(1)
        friction = self.frictions[rows[:, None], member].amax(1)
        size, own = rounded(step.abs(), 1e-3), rounded(step, 1e-3)
        return [kind, -friction, *(-size).unbind(1), *(-own).unbind(1)]

    def _keep(self, rows: Tensor, member: Tensor, depth: Tensor, at: Tensor, step: Tensor, found: Tensor) -> None:
        """Keeps feet that come before the best ones of their nodes; as deep ones of more faces do."""
        known = [self.kind[rows], -self.friction[rows], *self._rank_of_best(rows)]
        before = torch.zeros_like(found)
        rank = self._rank(rows, member, step)
        for mine, other in zip(rank[::-1], known[::-1], strict=True):
            before = torch.where(mine != other, mine < other, before)
        count = (self.members[rows] >= 0).sum(1)
        before = torch.where(count != member.shape[1], count < member.shape[1], before)
        better = found & ((depth < self.depth[rows]) | ((depth == self.depth[rows]) & before))
        padded = torch.nn.functional.pad(member, (0, self.members.shape[1] - member.shape[1]), value=-1)
        changes = {"kind": rank[0], "friction": -rank[1], "step": step, "depth": depth, "at": at, "members": padded}
        for name, value in changes.items():
            known_value = getattr(self, name)
            mask = better if value.dim() == 1 else better[:, None]
            setattr(self, name, known_value.index_copy(0, rows, torch.where(mask, value, known_value[rows])))

    def _rank_of_best(self, rows: Tensor) -> list[Tensor]:
        step = self.step[rows]
        return [*(-rounded(step.abs(), 1e-3)).unbind(1), *(-rounded(step, 1e-3)).unbind(1)]

    def _are_exposed(self, solid: SolidNodes, faces: _Candidates, at: Tensor, step: Tensor) -> Tensor:
        """Whether the faces of feet are there on the side where they bound free space, and that is free, bool [M]."""
        seam = solid.seam
        result = torch.ones_like(at[:, 0], dtype=torch.bool)
        near = torch.stack([_nearness(solid, obstacle) for obstacle in solid.obstacles])
        by_distance = solid.constants([not _has_faces(o) for o in solid.obstacles])
        count = faces.owner.shape[1]
        if count > 1 and any(_spacing(o) > 0 for o in solid.obstacles):
            result = _are_inner(solid, faces, at, step)
        for j in range(count):
            owner = faces.owner[:, j]
            _, normal = _height(solid, faces, j, at)
            # At an edge the normal of a shape that is known by its distance alone is not defined.
            normal = torch.where(by_distance[owner][:, None], faces.normal[:, j], normal)
            beside = _distance_from(solid, owner, at + seam * (step - normal))
            result = result & (beside <= near[owner])
        return result & solid.is_free(at, step)


def _are_inner(solid: SolidNodes, faces: _Candidates, at: Tensor, step: Tensor) -> Tensor:
    """Whether the edges of feet look inwards, as csrc/grid/solid.h has it, bool [M]."""
    count = faces.owner.shape[1]
    normal = torch.stack([_height(solid, faces, j, at)[1] for j in range(count)], 1)
    eye = torch.eye(count, dtype=at.dtype, device=at.device).expand(len(at), -1, -1)
    dual = torch.linalg.solve_ex(normal @ normal.mT, eye)[0] @ normal
    spacing = solid.constants([_spacing(o) for o in solid.obstacles]).to(at.dtype)[faces.owner]
    result = torch.ones_like(at[:, 0], dtype=torch.bool)
    for j in range(count):
        point = at + spacing[:, j, None] * (step - 2 * dual[:, j])
        inside = _distance_from(solid, faces.owner[:, j], point) <= 0
        result = result & (inside | (spacing[:, j] == 0))
    return result


def _height(solid: SolidNodes, faces: _Candidates, j: int, at: Tensor) -> tuple[Tensor, Tensor]:
    """Of points [M, D] above the face number j of each [M], and the normal there [M, D]."""
    normal = faces.normal[:, j]
    height = faces.height[:, j] + (normal * (at - faces.at[:, j])).sum(1)
    for k, obstacle in enumerate(solid.obstacles):
        own = ~faces.flat[:, j] & (faces.owner[:, j] == k)
        if not _may_be(own):
            continue
        rows = own.nonzero()[:, 0] if constraints.reads_values(at) else torch.arange(len(at), device=at.device)
        scene = None if solid.scene is None else solid.scene[rows]
        above, toward = obstacle.height_of_face(at[rows], faces.face[rows, j], scene, solid.time)
        above, toward = torch.where(own[rows], above, height[rows]), torch.where(own[rows, None], toward, normal[rows])
        height, normal = height.index_copy(0, rows, above), normal.index_copy(0, rows, toward)
    return height, normal


def _distance_from(solid: SolidNodes, owner: Tensor, x: Tensor) -> Tensor:
    """Of points [M, D] from one obstacle of each, int64 [M], [M]."""
    result = torch.full_like(x[:, 0], torch.inf)
    for k, obstacle in enumerate(solid.obstacles):
        own = owner == k
        if not _may_be(own):
            continue
        rows = own.nonzero()[:, 0] if constraints.reads_values(x) else torch.arange(len(x), device=x.device)
        scene = None if solid.scene is None else solid.scene[rows]
        distance = obstacle.signed_distance(x[rows], scene, solid.time)
        result = result.index_copy(0, rows, torch.where(own[rows], distance, result[rows]))
    return result


def _solve(solid: SolidNodes, faces: _Candidates, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the foot of nodes x [M, D] on all of their faces exists, its position [M, D], and the step out of it."""
    count = faces.owner.shape[1]
    at, step, found = x, x, torch.ones_like(x[:, 0], dtype=torch.bool)
    for _ in range(1 if count == 1 else 3):
        heights = (_height(solid, faces, j, at) for j in range(count))
        height, normal = (torch.stack(part, 1) for part in zip(*heights, strict=True))
        rest = (normal * (at - x)[:, None]).sum(2) - height
        gram = normal @ normal.mT
        independent = constraints.independent(gram)
        eye = torch.eye(count, dtype=gram.dtype, device=gram.device)
        gram = torch.where(independent[:, None, None], gram, eye)
        both = torch.linalg.solve_ex(gram, torch.stack([rest, torch.ones_like(rest)], 2))[0]
        share, ones = both.unbind(2)
        slack = solid.seam / 2 if count > 1 else solid.rounding
        found = found & independent & (share >= -slack).all(1)
        at = torch.where(found[:, None], x + (share[:, :, None] * normal).sum(1), x)
        step = (ones[:, :, None] * normal).sum(1)
    return found & (norm(at - x) <= solid.reach), at, step


def _nearness(solid: SolidNodes, obstacle: Obstacle) -> Tensor:
    """How far from the surface of an obstacle a point beside the foot may be [m]. Tangents of edges, as distances alone
    show them, leave the surface; samples round edges."""
    seam, spacing = solid.seam, _spacing(obstacle)
    return seam / 2 + 0.5 * spacing if spacing > 0 or _has_faces(obstacle) else seam / 4


def _first_of_each(rows: Tensor, keys: Sequence[Tensor]) -> Tensor:
    """Positions of the least keys of each row, int64 [M], the first key first; of equal ones the first."""
    order = torch.arange(len(rows), device=rows.device)
    for key in (*reversed(keys), rows):
        order = order[key[order].sort(stable=True).indices]
    ordered = rows[order]
    is_first = torch.ones_like(ordered, dtype=torch.bool)
    is_first[1:] = ordered[1:] != ordered[:-1]
    return order[is_first]
