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

from ..shapes import Capsule, Plane, Sampled, Shape, Sphere
from .constraints import KINDS, Constraints
from .walls import Face

if TYPE_CHECKING:
    from .obstacles import Obstacle

REACH = 3.0
"""Depth in dx below which a face does not act."""
SEAM = 0.1
"""Half of it, in dx, is the width of gaps and the height of steps that count as closed."""
MOST_FACES, MOST_AT_ONCE = 12, 6
"""Faces that a node looks at, the nearest ones; and where values may not be looked at, so that absent ones cost as much
as others."""
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
        self.reach = math.inf if self.dx is None else REACH * self.dx

    def chosen(self, rows: Tensor) -> SolidNodes:
        """Some of the nodes, int64 [n]."""
        other = dataclasses.replace(
            self,
            acts=[None if a is None else a[rows] for a in self.acts],
            positions=self.positions[rows],
            scene=None if self.scene is None else self.scene[rows],
        )
        other.rounding, other.seam = self.rounding, self.seam
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
        solid: these nodes.
    """

    nodes: Tensor | None
    position: Tensor
    sign: Tensor
    owner: Tensor
    face: Tensor
    at: Tensor
    walls: Tensor
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
        owner, face, at = _feet(solid, x, distance)
        owner = torch.where(inside[:, None], owner, -1)
        return Meeting(rows, x, sign, owner, face, at, walls, solid)


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

    def nearest(self, most: int) -> _Candidates:
        """At most so many for each node; columns of the first three are then those of each node [N, M]."""
        count = min(most, self.depth.shape[1])
        order = self.depth.topk(count, 1, largest=False, sorted=True).indices
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
            sees = near & (height <= solid.rounding) & (-height <= solid.reach) & (found.beyond[:, f] <= solid.reach)
            sees = sees & ((normal * normal).sum(1) > 0.5)
            add(k, -1 if alone else f, found.flat, x, height, normal, torch.where(sees, -height, torch.inf))
    owner, face, flat = (torch.stack(part).to(x.device) for part in parts[:3])
    at, height, normal, depth = (torch.stack(part, 1) for part in parts[3:])
    return _Candidates(owner, face, flat, at, height.nan_to_num(posinf=0.0), normal, depth)


def _add_distance(solid: SolidNodes, k: int, x: Tensor, acts: Tensor, add: Any) -> None:
    """Faces of a shape that is known by its distance alone: its surface; where faces join at the point nearest to a
    node, the planes that free space sees around that; and where that point is covered, or the node is beside
    the shape, those that neighbours of the node see."""
    obstacle = solid.obstacles[k]
    height, normal = obstacle.surface_at(x, solid.scene, solid.time)
    deepest = math.sqrt(x.shape[1]) * solid.reach  # of the point where faces join
    sees = acts & (height <= solid.rounding) & (-height <= deepest) & ((normal * normal).sum(1) > 0.5)
    nearest, first = sees, x - height[:, None] * normal
    away = 2.5 * solid.seam
    if isinstance(obstacle.shape, Sampled):
        away = away.clamp_min(1.5 * obstacle.shape.spacing)
    planes = []
    for lean in _leaning(normal):
        at = first + away * lean
        planes.append((at, *obstacle.surface_at(at, solid.scene, solid.time)))
    free = [plane[1] >= -0.02 * away for plane in planes]
    differs = [there & ((plane[2] * normal).sum(1) < SAME) for there, plane in zip(free, planes, strict=True)]
    joins = torch.stack(differs).any(0)
    wanted = [there & joins for there in free]
    if math.isfinite(solid.reach) and (len(solid.obstacles) > 1 or solid.faces):
        beside = acts & (height > solid.rounding) & (height <= solid.reach)
        covered = beside | (sees & ~solid.is_free(first, normal))
        sees = sees | beside
        for way in itertools.product((0.0, 1.0, -1.0), repeat=x.shape[1]):
            if any(way):
                at = x + solid.reach * obstacle.turned(x.new_tensor(way).expand_as(x), solid.scene, solid.time)
                above, toward = obstacle.surface_at(at, solid.scene, solid.time)
                planes.append((at, above, toward))
                wanted.append(covered & (above > 0))
    for flat, own in ((False, ~joins), (True, joins)):  # at an inner edge itself the normal is not defined
        add(k, -1, flat, x, height, normal, torch.where(nearest & own, -height, torch.inf))
    known: list[tuple[Tensor, Tensor]] = []
    for (at, above, toward), looked_for in zip(planes, wanted, strict=True):
        depth = -(above + (toward * (x - at)).sum(1))
        own = sees & looked_for & ((toward * toward).sum(1) > 0.5) & (depth >= -solid.seam) & (depth <= solid.reach)
        for other, has in known:
            own = own & ~(has & ((other * toward).sum(1) > SAME))
        known.append((toward, own))
        add(k, -1, True, at, above, toward, torch.where(own, depth, torch.inf))


def _leaning(axis: Tensor) -> list[Tensor]:
    """Unit vectors [N, D], and directions at 25° and 55° to them, evenly around."""
    return [axis, *(lean for angle in (25.0, 55.0) for lean in _around(axis, math.radians(angle)))]


def _around(axis: Tensor, angle: float) -> list[Tensor]:
    half, root = math.cos(angle), math.sin(angle)
    if axis.shape[1] == 2:
        turned = torch.stack([-axis[:, 1], axis[:, 0]], 1)
        return [half * axis - root * turned, half * axis + root * turned]
    x, y, z = axis.unbind(1)
    sign = torch.where(z < 0, -1, 1).to(axis.dtype)
    f = -1 / (sign + z)
    g = x * y * f
    u = torch.stack([1 + sign * x * x * f, sign * g, -sign * x], 1)
    w = torch.stack([g, sign + y * y * f, -y], 1)
    turns = [(1.0, 0.0), (0.5, math.sqrt(0.75)), (-0.5, math.sqrt(0.75))]
    return [half * axis + turn * (c * u + s * w) for turn in (root, -root) for c, s in turns]


# ---- feet


def _feet(solid: SolidNodes, x: Tensor, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Owner and number [n, D] of the faces that nodes meet, and where their normals are read [n, D, D]."""
    dim = x.shape[1]
    around = distance.masked_fill(distance > solid.rounding, -torch.inf).argmax(1)
    owner = torch.full((len(x), dim), -1, device=x.device)
    owner[:, 0] = around
    face = torch.full_like(owner, -1)
    at = x[:, None].expand(-1, dim, -1).clone()
    if not _may_join(solid.obstacles) and not solid.faces:
        return owner, face, at
    skips = x.device.type == "cpu" and not torch.compiler.is_compiling()
    faces = _faces_near(solid, x, distance).nearest(MOST_FACES if skips else MOST_AT_ONCE)
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
    several = (found.sum(1) > 1)[:, None, None]
    at = torch.where(several, best.at[:, None], at)
    return owner, face, torch.where(planes[:, :, None], faces.at.gather(1, wide), at)


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
        self.unit = 1e-3 * solid.seam  # of depths, so that rounding does not tell apart what is equally deep

    def consider(self, members: Sequence[int]) -> None:
        depth = self.faces.depth[:, list(members)].amax(1)
        depth = (depth / self.unit + 0.5).floor()
        wanted = depth.isfinite() & (depth <= self.depth)
        if not torch.compiler.is_compiling() and wanted.device.type == "cpu" and not bool(wanted.any()):
            return
        found, at, step = self._solve(members)
        found = found & wanted
        if not torch.compiler.is_compiling() and wanted.device.type == "cpu" and not bool(found.any()):
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
            if not torch.compiler.is_compiling() and own.device.type == "cpu" and not bool(own.any()):
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
            found = found & independent & (share >= -self.solid.seam / 2).all(1)
            at = self.x + (share[:, :, None] * normal).sum(1)
            step = (ones[:, :, None] * normal).sum(1)
        return found, at, step

    def _is_exposed(self, members: Sequence[int], at: Tensor, step: Tensor) -> Tensor:
        solid, faces, seam = self.solid, self.faces, self.solid.seam
        result = torch.ones_like(at[:, 0], dtype=torch.bool)
        spacing = torch.tensor(
            [0.5 * o.shape.spacing if isinstance(o.shape, Sampled) else 0.0 for o in solid.obstacles],
            dtype=at.dtype,
            device=at.device,
        )
        for member in members:
            _, normal = self._height(member, at)
            owner = faces.owner[:, member]
            beside = solid.distances(at + seam * (step - normal)).gather(1, owner[:, None])[:, 0]
            result = result & (beside <= seam / 2 + spacing[owner])
        return result & solid.is_free(at, step)

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
