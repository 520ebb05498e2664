"""Obstacles as one solid: nodes against the corner that they are behind, in every way to describe it."""

import copy
import functools
import itertools
import math
from typing import Any

import pytest
import torch
from helpers import random_blocks
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import shapes
from torch_mpm.boundaries import Obstacle
from torch_mpm.boundaries.constraints import KINDS, Constraints
from torch_mpm.boundaries.solid import SolidNodes, after_contact
from torch_mpm.boundaries.thickness import thin_walls
from torch_mpm.geometry.vectors import unit
from torch_mpm.implicit.bounds import node_bounds
from torch_mpm.ops import contact, contact_impulses
from torch_mpm.ops.impulses import impulse_of_nodes

DX = 0.05
LOWER, UPPER, TOP, WALL = 0.3, 0.7, 0.8, 0.25
"""Free space is a tank: from LOWER to UPPER, open above; its walls reach to TOP."""


def box(lower: list[float], upper: list[float], **options: object) -> mpm.Box:
    middle = [0.5 * (a + b) for a, b in zip(lower, upper, strict=True)]
    return mpm.Box(middle, [b - a for a, b in zip(lower, upper, strict=True)], **options)


def boxes(dim: int, floor: float, wall: float, **options: object) -> list[Obstacle]:
    """A floor and walls along all other axes. The floor reaches `floor` beyond the inner faces, and the walls stand on
    a level `wall` below the floor's upper face; they overlap at their corners."""
    sides = [axis for axis in range(dim) if axis != 1]
    out = {axis: (LOWER - WALL, UPPER + WALL) for axis in sides}
    lower, upper = [LOWER - floor] * dim, [UPPER + floor] * dim
    lower[1], upper[1] = LOWER - WALL, LOWER
    result: list[Obstacle] = [box(lower, upper, **options)]
    for axis in sides:
        for end in (0, 1):
            lower, upper = ([out[i][k] if i in out else 0.0 for i in range(dim)] for k in (0, 1))
            lower[1], upper[1] = LOWER - wall, TOP
            lower[axis], upper[axis] = (LOWER - WALL, LOWER) if end == 0 else (UPPER, UPPER + WALL)
            result.append(box(lower, upper, **options))
    return result


def planes(dim: int, **options: object) -> list[Obstacle]:
    result: list[Obstacle] = [mpm.Plane([LOWER] * dim, [float(i == 1) for i in range(dim)], **options)]
    for axis, up in itertools.product([i for i in range(dim) if i != 1], (1.0, -1.0)):
        at = [LOWER if up > 0 else UPPER] * dim
        result.append(mpm.Plane(at, [up * (i == axis) for i in range(dim)], **options))
    return result


class Tank(shapes.Shape):
    """Everything but the tank: a shape of one's own, by its exact distance."""

    def surface(self, x: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            distance = self._distance(leaf)
            (normal,) = torch.autograd.grad(distance.sum(), leaf)
        return distance.detach(), unit(normal)

    def _distance(self, x: Tensor) -> Tensor:
        above = x.new_full((), math.inf)
        sides = [x[:, i] - (0 if i == 1 else -0.2) for i in range(x.shape[1])]
        sides += [above - x[:, i] if i == 1 else 0.2 - x[:, i] for i in range(x.shape[1])]
        height = torch.stack(sides, 1)
        below = (-height).clamp_min(0)
        outside = torch.where((below > 0).any(1), (below.square().sum(1) + 1e-300).sqrt(), 0)
        return torch.where((height < 0).any(1), -outside, height.amin(1))


def tank(dim: int, form: str, **options: object) -> list[Obstacle]:
    at = [0.5, LOWER, 0.5][:dim]
    match form:
        case "floor under walls":
            return boxes(dim, WALL, 0.0, **options)
        case "floor between walls":
            return boxes(dim, 0.0, WALL, **options)
        case "overlapping":
            return boxes(dim, 0.24, 0.24, **options)
        case "planes":
            return planes(dim, **options)
        case "own shape":
            return [Obstacle(Tank(), at, **options)]
        case "sdf":
            whole = Tank()
            return [mpm.SDF(lambda x: whole.surface(x)[0], at, normal=lambda x: whole.surface(x)[1], **options)]
        case "sdf of boxes":
            parts = boxes(dim, WALL, 0.0)
            distances = [functools.partial(part.signed_distance, scene=None, time=0.0) for part in parts]
            return [mpm.SDF(functools.partial(d), [0.0] * dim, **options) for d in distances]
        case "samples of boxes":
            return [Obstacle(sampled, [0.0] * dim, **options) for sampled in sampled_boxes(dim)]
    raise ValueError(form)


@functools.cache
def sampled_boxes(dim: int) -> list[shapes.Sampled]:
    """Samples of the boxes, whose faces are on nodes of their lattice."""
    lower, upper = [LOWER - WALL - DX] * dim, [UPPER + WALL + DX] * dim
    distances = [obstacle.shape for obstacle in tank(dim, "sdf of boxes")]
    return [shapes.Sampled.of(shape, lower, upper, 0.25 * DX) for shape in distances]


FORMS = ["floor under walls", "floor between walls", "overlapping", "planes", "own shape", "sdf", "sdf of boxes"]


def nodes(dim: int, device: str, at: float = 0.0) -> tuple[mpm.Blocks, Tensor]:
    """Blocks around the tank and velocities, with nodes on its faces or beside them."""
    upper = [0.9 + at] * dim
    grid = mpm.Grid(DX, (0.15 + at,) * dim, upper if dim == 2 else [upper[0], 0.5 + at, 0.5 + at])
    blocks = random_blocks(grid, device)
    return blocks, torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)


def expected_in_tank(blocks: mpm.Blocks, velocity: Tensor, kind: str) -> tuple[Tensor, Tensor]:
    """Which nodes behind the walls are tested, and their velocities: the components along which they are behind."""
    x, after = blocks.node_positions(torch.float64), velocity.clone()
    tested = blocks.active_nodes() & (x[:, 1] < TOP - 3 * DX)
    behind, deep = torch.zeros_like(tested), torch.zeros_like(x[:, 0])
    for axis in range(x.shape[1]):
        low, high = x[:, axis] <= LOWER + 1e-9, x[:, axis] >= UPPER - 1e-9
        if axis == 1:
            high = torch.zeros_like(low)
        depth = torch.maximum(LOWER - x[:, axis], x[:, axis] - UPPER if axis != 1 else LOWER - x[:, axis])
        tested &= depth < 2.01 * DX
        deep += depth.clamp_min(0).square()
        behind |= low | high
        v = after[:, axis]
        after[:, axis] = torch.where(low, v.clamp_min(0) if kind == "separate" else 0.0, v)
        after[:, axis] = torch.where(high, v.clamp_max(0) if kind == "separate" else 0.0, after[:, axis])
    if kind == "sticky":
        after = torch.where(behind[:, None], 0, velocity)
    return tested & (deep < (2.99 * DX) ** 2), after


KINDS_AND_PLACES = [("separate", 0.0), ("separate", 0.4 * DX), ("slip", 0.4 * DX), ("sticky", 0.4 * DX)]


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("kind", "at"), KINDS_AND_PLACES)
def test_nodes_behind_a_corner_meet_all_its_faces(device, dim, form, kind, at):
    if dim == 3 and (kind == "slip" or (kind == "sticky" and form not in ("floor under walls", "own shape"))):
        pytest.skip("2-D has it")
    blocks, velocity = nodes(dim, device, at)
    tested, expected = expected_in_tank(blocks, velocity, kind)
    step = mpm.Step(blocks.grid, mpm.NeoHookean(E=1e5, nu=0.3), boundaries=tank(dim, form, kind=kind))
    obstacles = step.boundaries.entries
    for after in in_every_way(blocks, velocity, obstacles):
        torch.testing.assert_close(after[tested], expected[tested], rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", ["floor under walls", "sdf of boxes", "samples of boxes"])
@pytest.mark.parametrize("at", [0.0, 0.5 * DX])
def test_nodes_equally_deep_below_two_faces_meet_the_free_one(device, dim, form, at):
    """Nodes in walls that stand on the floor, as far from its level as from the tank: distances have a ridge there."""
    if dim == 2 and at > 0:
        pytest.skip("no block has such a node")
    blocks, velocity = nodes(dim, device, at)
    tested, expected = expected_in_tank(blocks, velocity, "slip")
    x = blocks.node_positions(torch.float64)
    depths = torch.maximum(LOWER - x, x - UPPER)
    depths[:, 1] = -1
    ridge = (depths.amax(1) - (x[:, 1] - LOWER)).abs() < 1e-9
    tested = tested & ridge & ((depths > 0).sum(1) == 1)
    obstacles = tank(dim, form, kind="slip")
    assert bool(tested.any())
    for after in in_every_way(blocks, velocity, obstacles):
        torch.testing.assert_close(after[tested], expected[tested], rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", ["floor under walls", "sdf of boxes", "samples of boxes"])
def test_nodes_below_a_wall_meet_its_face_not_its_edge(device, dim, form):
    """Nodes in the floor, of whose neighbours some see the lower edges of the walls that stand on it."""
    blocks, velocity = nodes(dim, device, 0.4 * DX)
    tested, expected = expected_in_tank(blocks, velocity, "separate")
    x = blocks.node_positions(torch.float64)
    tested = tested & (x[:, 1] < LOWER - 0.5 * DX)
    obstacles = tank(dim, form, kind="separate")
    assert bool(tested.any())
    for after in in_every_way(blocks, velocity, obstacles):
        torch.testing.assert_close(after[tested], expected[tested], rtol=0, atol=1e-9)


def in_every_way(blocks: mpm.Blocks, velocity: Tensor, obstacles: list[Obstacle]) -> list[Tensor]:
    """Velocities after contact in torch operations and, where it takes the obstacles, in the kernel, in both orders."""
    found = [in_torch(blocks, velocity, obstacles)]
    if all(mpm.ops.fusible(o, 0.0) for o in obstacles):
        found += [contact(blocks, velocity, given, 0.0) for given in (obstacles, obstacles[::-1])]
    return found


def in_torch(
    blocks: mpm.Blocks,
    velocity: Tensor,
    obstacles: list[Obstacle],
    walls: mpm.Walls | None = None,
    time: float = 0.0,
) -> Tensor:
    positions = blocks.node_positions(velocity.dtype)
    faces = () if walls is None else walls.faces(blocks.grid)
    acts = [blocks.active_nodes()] * len(obstacles)
    solid = SolidNodes(obstacles, acts, positions, None, time, blocks.grid.dx, faces)
    return after_contact(velocity, solid)[0]


# ---- several constraints


def nearest_allowed(v: Tensor, normal: Tensor, speed: Tensor, fixed: Tensor) -> Tensor:
    """The nearest velocity to v [D] with n · v ≥ s, or = s where fixed, by Dykstra's projections in turn."""
    corrections = torch.zeros_like(normal)
    for _ in range(800):
        for i in range(len(normal)):
            trial = v + corrections[i]
            lack = speed[i] - trial @ normal[i]
            v = trial + (lack if fixed[i] else lack.clamp_min(0)) * normal[i]
            corrections[i] = trial - v
    return v


@pytest.mark.parametrize("count", [2, 3])
def test_several_surfaces_leave_the_nearest_velocity_that_all_allow(dim, count):
    count = min(count, dim)
    torch.manual_seed(1)
    for _ in range(6):
        normal = torch.nn.functional.normalize(torch.randn(count, dim, dtype=torch.float64), dim=1)
        if float(torch.linalg.det(normal @ normal.mT)) < 0.2:
            continue
        v, surface = torch.randn(dim, dtype=torch.float64), torch.randn(count, dim, dtype=torch.float64)
        fixed = torch.rand(count) < 0.3
        kind = torch.where(fixed, KINDS["slip"], KINDS["separate"])
        constraints = Constraints(
            torch.arange(count)[None],
            kind[None],
            torch.zeros(1, count, dtype=torch.float64),
            normal[None],
            surface[None],
        )
        expected = nearest_allowed(v, normal, (normal * surface).sum(1), fixed)
        got = v + constraints.changes(v[None])[0].sum(0)
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-6)


def test_friction_in_an_inner_edge_is_that_of_both_surfaces():
    """A velocity into a floor and a wall and along their edge: it loses μ₁ λ₁ + μ₂ λ₂ along that, and stops there."""
    kind = torch.full((1, 2), KINDS["separate"])
    normal, rest = torch.eye(3, dtype=torch.float64)[None, :2], torch.zeros(1, 2, 3, dtype=torch.float64)
    friction = torch.tensor([[0.3, 0.2]], dtype=torch.float64)
    constraints = Constraints(torch.arange(2)[None], kind, friction, normal, rest)
    for along, left in ((3.0, 3.0 - 0.3 * 1.0 - 0.2 * 2.0), (0.5, 0.0)):
        v = torch.tensor([[-1.0, -2.0, along]], dtype=torch.float64)
        after = v + constraints.changes(v).sum(1)
        torch.testing.assert_close(after, v.new_tensor([[0.0, 0.0, left]]))


# ---- seams, walls, steps


def resting_on(obstacles: list[Obstacle], walls: str | None, steps: int) -> mpm.State:
    """A block that slides over a floor at y = 0 without friction."""
    grid = mpm.Grid(0.05, (0.0, -0.3), (1.6, 0.6))
    block = mpm.State.at_rest(mpm.seed.box((0.2, 0.0), (0.4, 0.2), grid, per_cell=4), 1000.0, velocity=(2.0, 0.0))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), gravity=(0, -9.8), walls=walls, boundaries=obstacles)
    state = mpm.rollout(step, block, n=steps, dt=2e-3)
    step.check(state)
    return state


def seams(form: str) -> list[Obstacle]:
    if form == "sdf of a union":  # two boxes that touch between nodes, and at one
        parts = [shapes.Box((b - a, 0.4)) for a, b in ((-0.3, 0.45), (0.45, 0.58), (0.58, 1.9))]
        middles = [torch.tensor([0.5 * (a + b), -0.2]) for a, b in ((-0.3, 0.45), (0.45, 0.58), (0.58, 1.9))]

        def distance(x: Tensor) -> Tensor:
            each = [part.signed_distance(x - at.to(x)) for part, at in zip(parts, middles, strict=True)]
            return torch.stack(each).amin(0)

        return [mpm.SDF(distance, (0.0, 0.0))]
    ends = [-0.3, *(0.35 + 0.1 * k + 0.013 * (k % 3) for k in range(10)), 1.9]
    lap = 0.03 if form == "overlapping" else 0.0
    return [box([a - lap, -0.3], [b + lap, 0.0]) for a, b in itertools.pairwise(ends)]


@pytest.mark.filterwarnings("ignore::torch_mpm.ThinWallWarning")
@pytest.mark.parametrize("form", ["touching", "overlapping", "sdf of a union"])
def test_a_block_slides_over_seams(form):
    steps = 72 if form == "sdf of a union" else 150
    state = resting_on(seams(form), None, steps)
    assert float(state.x[:, 0].mean()) == pytest.approx(0.3 + 2.0 * steps * 2e-3, rel=1e-2)
    assert float(state.v[:, 0].mean()) == pytest.approx(2.0, rel=1e-2)
    assert float(state.x[:, 1].min()) > -0.01


def stop_at_sides(velocity: Tensor, x: Tensor, end: tuple[float, ...]) -> None:
    """Set velocities into walls at 0 and `end`, on all axes but the second, to zero, as the grid update does."""
    for axis in {*range(len(end))} - {1}:
        velocity[(x[:, axis] <= 1e-9) | (x[:, axis] >= end[axis] - 1e-9), axis] = 0


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("reach", [0.0, 0.3, 3.0, -0.05])
@pytest.mark.parametrize("walls", ["slip", "separate", "mirror"])
def test_a_box_as_wide_as_the_domain_has_no_end_faces(device, dim, reach, walls):
    """It ends at the walls, beyond them or just before; nodes beyond the walls meet its upper face alone."""
    end = (0.6, 0.6, 0.5)[:dim]
    grid = mpm.Grid(DX, (0.0,) * dim, end)
    blocks, lower = random_blocks(grid, device), [-reach * DX] * dim
    upper = [e + reach * DX for e in end]
    lower[1], upper[1] = 0.1, 0.5
    floor, velocity = box(lower, upper), torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)
    x = blocks.node_positions(torch.float64)
    tested = blocks.active_nodes() & (x[:, 1] > 0.5 - 2.01 * DX)
    expected = velocity.clone()
    expected[:, 1] = torch.where(x[:, 1] <= 0.5 + 1e-9, velocity[:, 1].clamp_min(0), velocity[:, 1])
    sides = [walls if axis != 1 else "open" for axis in range(dim)]
    faces = mpm.Walls(sides)
    stop_at_sides(velocity, x, end)
    stop_at_sides(expected, x, end)
    for after in (contact(blocks, velocity, [floor], 0.0, faces), in_torch(blocks, velocity, [floor], faces)):
        torch.testing.assert_close(after[tested], expected[tested], rtol=0, atol=1e-9)


ALONG_WALLS = {
    "floor": {},
    "moves along the walls": {"velocity": (0.0, -0.4, 0.0)},
    "moves into a wall": {"velocity": (0.5, -0.4, 0.3)},
    "tilted": {"rotation": 1e-3},
    "almost tilted": {"rotation": 1e-8},
    "round": {},
}


@pytest.mark.parametrize(*in_pairs(walls=["slip", "separate", "mirror", "sticky"], form=list(ALONG_WALLS), dim=[2, 3]))
def test_a_surface_between_walls_acts_as_torch_operations_have_it(device, dim, walls, form):
    """The kernel skips the search for surfaces where the surface and its velocity are parallel to walls."""
    options = dict(ALONG_WALLS[form])
    if "velocity" in options:
        options["velocity"] = options["velocity"][:dim]
    if "rotation" in options and dim == 3:
        options["rotation"] = (options["rotation"], 0.0, 0.7 * options["rotation"])
    middle = (0.3, 0.287, 0.25)[:dim]  # No node is as near to both faces of the box.
    if form == "round":  # A drum that turns about the last axis.
        outline = [(0.15, -1.0), (0.15, 1.0), (0.4, 1.0), (0.4, -1.0)]
        axis = {"axis": (0.0, 0.0, 1.0), "angular_velocity": (0.0, 0.0, 2.0)} if dim == 3 else {}
        solid = mpm.Revolved(middle, outline, friction=0.4, **axis)
    else:
        solid = mpm.Box(middle, (3.0, 0.2, 3.0)[:dim], friction=0.4, **options)
    end = (0.6, 0.6, 0.5)[:dim]
    blocks = random_blocks(mpm.Grid(DX, (0.0,) * dim, end), device)
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)
    faces = mpm.Walls([walls if axis != 1 else "open" for axis in range(dim)])
    stop_at_sides(velocity, blocks.node_positions(torch.float64), end)
    expected, found = in_torch(blocks, velocity, [solid], faces), contact(blocks, velocity, [solid], 0.0, faces)
    active = blocks.active_nodes()
    assert bool((expected[active] != velocity[active]).any())
    torch.testing.assert_close(found[active], expected[active], rtol=0, atol=1e-7 if form == "almost tilted" else 1e-9)


# ---- impulses and gradients


def corner(dim: int, leaf: Tensor, **options: object) -> list[Obstacle]:
    """Two boxes and a plane, turned and moving, whose inner edges are where nodes are."""
    angle = leaf[0] if dim == 2 else torch.cat([leaf[0:1] * 0.3, leaf[0:1] * 0.2, leaf[0:1]])
    at = torch.cat([leaf[1:3], leaf.new_zeros(dim - 2) + 0.5])
    wide = [1.2, 0.5, 1.2][:dim]
    tall = [0.3, 0.9, 1.2][:dim]
    motion = {"velocity": leaf[3 : 3 + dim], "rotation": angle}
    plane = torch.cat([leaf.new_tensor([-1.0]), leaf[0:1] * 0.5, leaf.new_zeros(dim - 2)])
    return [
        mpm.Box(at, wide, friction=leaf[6], **motion, **options),
        mpm.Box(at + at.new_tensor([-0.3, 0.5, 0.0][:dim]), tall, friction=0.2, rotation=angle, **options),
        mpm.Plane([0.75, 0.5, 0.5][:dim], plane, friction=leaf[6] * 0.5, **options),
    ]


LEAF = (0.2, 0.5, 0.3, 0.4, -0.3, 0.2, 0.3)


@pytest.mark.parametrize("kind", ["separate", "slip"])
def test_gradients_of_corners_are_those_of_differences(device, dim, kind):
    grid = mpm.Grid(0.12, (0.0,) * dim, (0.9,) * dim)
    blocks = random_blocks(grid, device)
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)
    active, weight = blocks.active_nodes()[:, None], torch.randn_like(velocity)
    leaf = torch.tensor(LEAF, dtype=torch.float64, device=device)

    def total(leaf: Tensor, v: Tensor, fused: bool = True) -> Tensor:
        obstacles = corner(dim, leaf, kind=kind)
        after = contact(blocks, v, obstacles, 0.0) if fused else in_torch(blocks, v, obstacles)
        return (weight * torch.where(active, after, 0)).sum()

    inputs = (leaf.requires_grad_(), velocity.requires_grad_())
    fused = torch.autograd.grad(total(*inputs), inputs)
    composed = torch.autograd.grad(total(*inputs, fused=False), inputs)
    for a, b in zip(fused, composed, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-8)
    with torch.no_grad():
        for i in (3, 4, 6):  # what does not move nodes from one surface to another
            step = torch.zeros_like(leaf)
            step[i] = 1e-6
            slope = (total(leaf + step, velocity) - total(leaf - step, velocity)) / 2e-6
            assert float(fused[0][i]) == pytest.approx(float(slope), rel=1e-5, abs=1e-6)
        direction = torch.randn_like(velocity)
        slope = (total(leaf, velocity + 1e-7 * direction) - total(leaf, velocity - 1e-7 * direction)) / 2e-7
        assert float((fused[1] * direction).sum()) == pytest.approx(float(slope), rel=1e-5)


CUP = ((0.0, -0.3), (0.35, -0.3), (0.35, 0.2), (0.2, 0.2), (0.2, -0.1), (0.0, -0.1))


def with_curved_faces(form: str, dim: int, motion: dict[str, Tensor]) -> list[Obstacle]:
    """Obstacles with inner edges. The last one moves, turns and has friction."""
    ball, rod = shapes.Sphere(0.25), shapes.Capsule([0.2, 0.05, 0.1][:dim], 0.15)
    floor = box([-0.1, 0.0, -0.1][:dim], [1.1, 0.4, 1.1][:dim], friction=0.2)
    match form:
        case "box and sphere":
            return [floor, Obstacle(ball, kind="slip", **motion)]
        case "box and capsule":
            return [floor, Obstacle(rod, kind="separate", **motion)]
        case "two spheres":
            return [mpm.Sphere([0.7, 0.3, 0.5][:dim], 0.3, "slip", friction=0.2), Obstacle(ball, **motion)]
        case "cup":
            return [Obstacle(shapes.Revolved(CUP), **motion)]
    raise ValueError(form)


def motion_of(dim: int, device: str) -> dict[str, Tensor]:
    turns = ([0.2, 0.1, -0.3], [0.7, -0.4, 0.5])
    rotation, spin = (turn[0] if dim == 2 else turn for turn in turns)
    values = {"position": [0.4313, 0.5227, 0.4679][:dim], "velocity": [0.31, -0.23, 0.13][:dim]}
    values |= {"rotation": rotation, "angular_velocity": spin, "friction": 0.3}
    return {name: torch.tensor(v, dtype=torch.float64, device=device).requires_grad_() for name, v in values.items()}


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("form", ["box and sphere", "box and capsule", "two spheres", "cup"])
@pytest.mark.parametrize("fused", [True, False])
def test_gradients_by_the_pose_of_curved_faces_are_those_of_differences(device, dim, form, fused):
    grid = mpm.Grid(0.0713 if dim == 2 else 0.11, (0.0,) * dim, (0.9,) * dim)
    blocks = random_blocks(grid, device)
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)
    active, weight = blocks.active_nodes()[:, None], torch.randn_like(velocity)
    given = motion_of(dim, device)

    def after(motion: dict[str, Tensor]) -> Tensor:
        obstacles = with_curved_faces(form, dim, motion)
        return torch.where(active, (contact if fused else in_torch)(blocks, velocity, obstacles, time=0.1), 0)

    grads = torch.autograd.grad((weight * after(given)).sum(), list(given.values()))
    with torch.no_grad():
        for (name, value), grad in zip(given.items(), grads, strict=True):
            direction = torch.ones_like(value)
            ends = [after(given | {name: value + step * direction}) for step in (1e-6, -1e-6)]
            slope = (ends[0] - ends[1]) / 2e-6
            stays = (slope.abs() < 1e3).all(1, keepdim=True)  # of the same faces on both sides
            assert int((~stays).sum()) <= 1
            found = float((weight * torch.where(stays, slope, 0)).sum())
            assert float((grad * direction).sum()) == pytest.approx(found, rel=1e-6, abs=1e-6), name


@pytest.mark.parametrize("form", ["box and sphere", "cup"])
def test_gradients_of_a_rollout_by_the_pose_are_those_of_differences(device, dim, form):
    grid = mpm.Grid(0.08, (0.0,) * dim, (1.0,) * dim)
    points = mpm.seed.box([0.15, 0.42, 0.35][:dim], [0.35, 0.6, 0.5][:dim], grid, per_cell=2**dim)
    state = mpm.State.at_rest(points, 1000.0, dtype=torch.float64, device=device)
    given = motion_of(dim, device)

    def height(motion: dict[str, Tensor]) -> Tensor:
        obstacles = with_curved_faces(form, dim, motion)
        step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), gravity=(0, -9.8, 0)[:dim], boundaries=obstacles)
        end = mpm.rollout(step, state, 6, 1e-3)
        return (end.v * torch.tensor([0.3, 1.0, -0.5][:dim], dtype=torch.float64, device=device)).sum()

    grads = torch.autograd.grad(height(given), list(given.values()))
    with torch.no_grad():
        for (name, value), grad in zip(given.items(), grads, strict=True):
            direction = torch.ones_like(value)
            ends = [float(height(given | {name: value + step * direction})) for step in (1e-6, -1e-6)]
            slope = (ends[0] - ends[1]) / 2e-6
            assert float((grad * direction).sum()) == pytest.approx(slope, rel=1e-4, abs=1e-5), name


# ---- the kernel and torch operations


def any_shape(kind: int, dim: int, random: torch.Generator) -> shapes.Shape:
    def numbers(low: float, high: float, *size: int) -> Any:
        return (low + (high - low) * torch.rand(size, generator=random, dtype=torch.float64)).tolist()

    direction = unit(torch.randn(1, dim, generator=random, dtype=torch.float64))[0].tolist()
    match kind:
        case 0:
            return shapes.Plane(direction)
        case 1:
            return shapes.Sphere(numbers(0.1, 0.35))
        case 2:
            return shapes.Box(numbers(0.3, 0.8, dim))
        case 3:
            return shapes.Capsule([0.3 * d for d in direction], numbers(0.1, 0.2))
        case 4:
            return shapes.Revolved(CUP, direction)
    return sampled_cup(dim)


@functools.cache
def sampled_cup(dim: int) -> shapes.Sampled:
    return shapes.Sampled.of(shapes.Revolved(CUP), [-0.5] * dim, [0.5] * dim, 0.043)


def any_obstacles(count: int, dim: int, random: torch.Generator) -> list[Obstacle]:
    found = []
    for _ in range(count):
        shape, kind = (int(torch.randint(n, (), generator=random)) for n in (6, 3))
        turn = torch.randn((3,) if dim == 3 else (), generator=random, dtype=torch.float64).tolist()
        at = (0.1 + 0.8 * torch.rand(dim, generator=random, dtype=torch.float64)).tolist()
        motion = {"velocity": torch.randn(dim, generator=random, dtype=torch.float64).tolist(), "rotation": turn}
        friction = 0.5 * float(torch.rand((), generator=random))
        kinds = ["sticky", "slip", "separate"]
        found.append(Obstacle(any_shape(shape, dim, random), at, kinds[kind], friction, **motion))
    return found


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("walls", [None, "separate", "mirror"])
def test_the_kernel_is_what_torch_operations_are(device, dim, dtype, walls):
    """For obstacles of all shapes, but for nodes where two surfaces are equally near to rounding."""
    if dim == 3 and (dtype == torch.float32 or walls == "separate"):
        pytest.skip("2-D has it")
    grid = mpm.Grid(1 / 12 if dim == 2 else 1 / 7, (0.0,) * dim, (1.0,) * dim)
    differs = met = 0
    for seed in range(8 if dim == 2 else 2 if walls is None else 1):
        random = torch.Generator().manual_seed(seed + (0 if walls is None else len(walls)))
        obstacles = any_obstacles(1 + seed % 4 if dim == 2 else 3, dim, random)
        blocks = random_blocks(grid, device)
        velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device, dtype)
        faces = None if walls is None else mpm.Walls(walls)
        after, active = contact(blocks, velocity, obstacles, 0.0, faces), blocks.active_nodes()
        expected = in_torch(blocks, velocity, obstacles, faces)
        tolerance = 1e-9 if dtype == torch.float64 else 1e-3
        differs += int((((after - expected).abs().amax(1) > tolerance) & active).sum())
        met += int(((expected != velocity).any(1) & active).sum())
    assert met > 90 and differs <= met // 500


def any_outline(random: torch.Generator) -> list[tuple[float, float]]:
    """A star around a point, beside the axis or with tips on it."""
    count = int(torch.randint(5, 12, (), generator=random))
    radii = (0.15 + 0.6 * torch.rand(count, generator=random, dtype=torch.float64)).tolist()
    if count % 2:
        return [
            (0.8 + r * math.cos(t), r * math.sin(t)) for i, r in enumerate(radii) for t in [2 * math.pi * i / count]
        ]
    turns = [math.pi * (i / (count - 1) - 0.5) for i in range(count)]
    corners = [(r * math.cos(t), r * math.sin(t)) for r, t in zip(radii, turns, strict=True)]
    return [(0.0, corners[0][1]), *corners[1:-1], (0.0, corners[-1][1])]


def test_nodes_in_an_outline_meet_all_its_faces_that_join(device, dim):
    """A node may be no deeper below the line of a second face, whose edge is farther away."""
    grid = mpm.Grid(0.1, (-2.0,) * dim, (2.0,) * dim)
    blocks = grid.activate(torch.rand(4000, dim, dtype=torch.float64, device=device) * 3 - 1.5)
    random = torch.Generator().manual_seed(3)
    for seed in range(30 if dim == 2 else 6):
        turn = torch.randn((3,) if dim == 3 else (), generator=random, dtype=torch.float64).tolist()
        shape = shapes.Revolved(any_outline(random), ([0.0] * (dim - 1) + [1.0]))
        obstacle = Obstacle(shape, [0.0037 + 0.02 * seed] * dim, "slip", rotation=turn)
        velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64, device=device)
        after, expected = contact(blocks, velocity, [obstacle], 0.0), in_torch(blocks, velocity, [obstacle])
        active = blocks.active_nodes()
        torch.testing.assert_close(after[active], expected[active], rtol=0, atol=1e-9)


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (0.6, 0.8, 0.0)])
@pytest.mark.parametrize("at", [0.0, 0.013])
def test_nodes_behind_the_tip_of_a_cone_meet_both_sides_of_it(device, dim, axis, at):
    """Of a solid with a hollow cone in it, as two planes have it; nodes may be on the axis."""
    grid = mpm.Grid(0.1, (-2.0,) * dim, (2.0,) * dim)
    blocks = grid.activate(torch.rand(4000, dim, dtype=torch.float64, device=device) - 0.5)
    turn = math.atan2(axis[0], axis[1])  # of y to the axis
    cone = Obstacle(shapes.Revolved([(0, -2), (2, -2), (2, 1.6), (0, 0)], axis[:dim]), [at, *[0.0] * (dim - 1)], "slip")
    sides = []
    for angle in (math.atan2(2, 1.6), math.pi - math.atan2(2, 1.6)):
        normal = [math.cos(angle - turn), math.sin(angle - turn), 0.0]
        sides.append(mpm.Plane([at, *[0.0] * (dim - 1)], normal[:dim], kind="slip"))
    x = blocks.node_positions(torch.float64)
    velocity = torch.zeros_like(x)
    velocity[:, 1] = -1.0
    arm = x - x.new_tensor([at, *[0.0] * (dim - 1)])
    below = arm @ arm.new_tensor(axis[:dim]) < -0.06
    middle = blocks.active_nodes() & below & (arm.norm(dim=1) < 0.29)  # within reach of the tip
    if dim == 3:  # in the plane of the axis and y
        middle &= x[:, 2].abs() < 1e-9
    after = contact(blocks, velocity, [cone], 0.0)[middle]
    expected = contact(blocks, velocity, sides, 0.0)[middle]
    torch.testing.assert_close(after, expected, rtol=0, atol=1e-9)
    assert int((after.abs().amax(1) < 1e-9).sum()) >= 3  # the tip stops nodes


@pytest.mark.parametrize("kind", ["separate", "slip", "sticky"])
def test_impulses_of_corners_add_up_to_the_change_of_momentum(device, dim, kind):
    grid = mpm.Grid(0.12, (0.0,) * dim, (0.9,) * dim)
    blocks = random_blocks(grid, device)
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)
    velocity = torch.where(blocks.active_nodes()[:, None], velocity, 0)
    mass = torch.rand(blocks.node_count, dtype=torch.float64).to(device)
    obstacles = corner(dim, torch.tensor(LEAF, dtype=torch.float64, device=device), kind=kind)
    change = velocity - contact(blocks, velocity, obstacles, 0.0)
    impulses = contact_impulses(blocks, velocity, mass, obstacles, 0.0)
    assert bool((impulses[0].abs().sum(1) > 1e-3).all())
    torch.testing.assert_close(impulses.sum(1), impulse_of_nodes(blocks, mass[:, None] * change))


# ---- implicit steps


@pytest.mark.parametrize(
    *in_pairs(form=["floor under walls", "planes", "own shape"], kind=["separate", "sticky"], dim=[2, 3])
)
def test_implicit_bounds_behind_a_corner_are_those_of_all_its_faces(device, dim, form, kind):
    blocks, velocity = nodes(dim, device)
    tested, expected = expected_in_tank(blocks, velocity, kind)
    bounds = node_bounds(blocks, None, tank(dim, form, kind=kind), velocity, 0.0)
    torch.testing.assert_close(bounds.clamped(velocity)[tested], expected[tested], rtol=0, atol=1e-9)


# ---- particles inside


@pytest.mark.parametrize("form", FORMS)
def test_particles_inside_are_moved_to_the_nearest_surface_and_counted(device, dim, form):
    grid = mpm.Grid(DX, (0.0,) * dim, (1.0,) * dim, scenes=2)
    x = 0.2 + 0.6 * torch.rand(400, dim, dtype=torch.float64)
    x[:, 1] = x[:, 1].clamp_max(TOP - 3 * DX)
    scene = torch.arange(400, dtype=torch.int32) // 300
    points = mpm.seed.Points(
        x.to(device), torch.full((400,), 1e-4, dtype=torch.float64, device=device), scene.to(device)
    )
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), boundaries=tank(dim, form))
    state, moved = step.project(mpm.State.at_rest(points, 1000.0, dtype=torch.float64))
    x = points.x
    lower, upper = x.new_full((dim,), LOWER), x.new_full((dim,), UPPER)
    upper[1] = 1.0
    expected = x.clamp(lower, upper)
    torch.testing.assert_close(state.x, expected, rtol=0, atol=0.051 * DX)  # half a seam
    inside = (expected != x).any(1)
    assert moved.tolist() == [int(inside[points.scene == b].sum()) for b in range(2)]
    assert int(step.project(state)[1].sum()) == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_particles_deep_inside_several_obstacles_are_moved_out_of_all(device, dim, dtype):
    """Also where they are farther than nodes see from the nearest face: a seam in a block of two boxes, and bodies that
    overlap."""
    grid = mpm.Grid(DX, (0.0,) * dim, (1.0,) * dim)
    x = 0.05 + 0.9 * torch.rand(300, dim, dtype=dtype, device=device)
    points = mpm.seed.Points(x, torch.full_like(x[:, 0], 1e-4), None)
    state, size = mpm.State.at_rest(points, 1000.0, dtype=dtype), (0.6,) * (dim - 1)
    halves = [mpm.Box((at, *[0.5] * (dim - 1)), (0.35, *size)) for at in (0.325, 0.675)]
    several = [mpm.Sphere((0.4, *[0.5] * (dim - 1)), 0.3), mpm.Box((0.6,) * dim, (0.5,) * dim)]
    for obstacles in (halves, several):
        step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), boundaries=obstacles)
        end, moved = step.project(state)
        before, after = (torch.stack([o.signed_distance(s.x, None, 0.0) for o in obstacles]) for s in (state, end))
        assert float(after.min()) > -1e-5
        inside = before.amin(0) < -1e-5
        assert abs(int(moved) - int(inside.sum())) <= 2  # rounding at the surface
        assert torch.equal(end.x[before.amin(0) > 1e-5], state.x[before.amin(0) > 1e-5])
        if obstacles is halves:
            depth = torch.cat([0.35 - (x[:, :1] - 0.5).abs(), 0.3 - (x[:, 1:] - 0.5).abs()], 1).amin(1)
            way = (end.x - x).norm(dim=1)
            torch.testing.assert_close(way[inside], depth[inside], rtol=0, atol=0.051 * DX)


# ---- thin walls


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 4])
@pytest.mark.parametrize("thick", [0.025, 0.04, 0.06])
def test_walls_of_sampled_shapes_are_as_thick_as_they_are(dim, thick, angle):
    """A hollow vessel that is turned against the samples, a ball, and a wall without a sample inside."""
    spacing, c, s = 0.01, math.cos(angle), math.sin(angle)

    def vessel(x):
        a, b = (c * x[:, 0] + s * x[:, 1], c * x[:, 1] - s * x[:, 0])
        x = torch.stack([a, b, *x.T[2:]], 1)
        outer, inner = (half - x.abs() for half in (0.15, 0.15 - thick))
        opened = torch.cat([inner[:, :1], x[:, 1:2] + 0.15 - thick, inner[:, 2:]], 1)  # above
        return torch.maximum(-outer.amin(1), opened.amin(1))

    corner = [0.23] * dim
    shapes = [mpm.shapes.SDF(vessel), mpm.shapes.Sphere(thick)]
    found = [mpm.shapes.Sampled.of(one, [-a for a in corner], corner, spacing).thinnest_wall() for one in shapes]
    assert thick <= found[0] + 1e-9 and found[0] < thick + 1.01 * spacing
    assert 2 * thick <= found[1] + 1e-9 and found[1] < 2 * thick + 1.01 * spacing
    thin = mpm.shapes.Sampled.of(mpm.shapes.Box([0.004] * dim), [-0.105] * dim, [0.105] * dim, spacing)
    assert thin.thinnest_wall() == spacing


def test_thin_walls_are_reported_by_name():
    cup = [(0, 0), (0.12, 0), (0.12, 0.2), (0.08, 0.2), (0.08, 0.04), (0, 0.04)]
    thin = [(r, z - 0.01 if z == 0.04 else z) for r, z in cup]
    walls = [mpm.Box((0, 0), (1.0, 0.04)), mpm.Box((0, 0), (1.0, 0.03)), mpm.Revolved((0, 0), cup)]
    walls += [mpm.Revolved((0, 0), thin), mpm.Revolved((0, 0), thin[3:] + thin[:3]), mpm.Sphere((0, 0), 0.001)]
    found = list(thin_walls(walls, 0.01))
    names = ["obstacle 1 (box)", "obstacle 3 (revolved)", "obstacle 4 (revolved)"]
    assert [line.split(" is ")[0] for line in found] == names
    assert all("is 3 dx thick" in line for line in found)
    grid = mpm.Grid(0.01, (0.0, 0.0), (0.2, 0.2))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), boundaries=walls[1:2])
    with pytest.warns(mpm.ThinWallWarning, match="obstacle 0 .box. is 3 dx thick") as found:
        step.check()
    assert found[0].filename == __file__


def test_walls_of_samples_are_computed_once(monkeypatch):
    """Until other samples are assigned; also for a copy and for a shape from the table of a kernel."""
    shape = mpm.shapes.Sampled.of(mpm.shapes.Box([0.3, 0.04]), [-0.2] * 2, [0.2] * 2, 0.01)
    thick = shape.thinnest_wall()
    with monkeypatch.context() as patch:
        patch.setattr(torch.nn.functional, "max_pool2d", None)
        assert shape.thinnest_wall() == copy.deepcopy(shape).thinnest_wall() == thick
    shape.values = shape.values + 0.01
    assert shape.thinnest_wall() == pytest.approx(thick - 0.02, abs=1e-12)
    like = torch.zeros(1, 2, dtype=torch.float64)
    other = mpm.shapes.Sampled.from_row(like, like, shape.data(like))
    assert other.thinnest_wall() == shape.thinnest_wall()
