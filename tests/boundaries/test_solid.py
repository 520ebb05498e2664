"""Obstacles as one solid: nodes against the corner that they are behind, in every way to describe it."""

import functools
import itertools
import math

import pytest
import torch
from helpers import random_blocks
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import shapes
from torch_mpm.boundaries import Obstacle
from torch_mpm.boundaries.constraints import KINDS, Constraints
from torch_mpm.boundaries.solid import SolidNodes, after_contact
from torch_mpm.implicit.bounds import node_bounds
from torch_mpm.ops import contact, contact_impulses
from torch_mpm.ops.impulses import impulse_of_nodes
from torch_mpm.vectors import unit

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
        case "sdf of a union":
            parts = boxes(dim, WALL, 0.0)
            distances = [functools.partial(part.signed_distance, scene=None, time=0.0) for part in parts]
            return [mpm.SDF(functools.partial(d), [0.0] * dim, **options) for d in distances]
    raise ValueError(form)


FORMS = ["floor under walls", "floor between walls", "overlapping", "planes", "own shape", "sdf", "sdf of a union"]


def nodes(dim: int, device: str, at: float = 0.0) -> tuple[mpm.Blocks, Tensor]:
    """Blocks around the tank and velocities, with nodes on its faces or beside them."""
    grid = mpm.Grid(DX, (at,) * dim, (1.0 + at,) * dim)
    blocks = random_blocks(grid, device)
    return blocks, torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)


def expected_in_tank(blocks: mpm.Blocks, velocity: Tensor, kind: str) -> tuple[Tensor, Tensor]:
    """Which nodes behind the walls are tested, and their velocities: the components along which they are behind."""
    x, after = blocks.node_positions(torch.float64), velocity.clone()
    tested = blocks.active_nodes() & (x[:, 1] < TOP - 3 * DX)
    behind = torch.zeros_like(tested)
    for axis in range(x.shape[1]):
        low, high = x[:, axis] <= LOWER + 1e-9, x[:, axis] >= UPPER - 1e-9
        if axis == 1:
            high = torch.zeros_like(low)
        depth = torch.maximum(LOWER - x[:, axis], x[:, axis] - UPPER if axis != 1 else LOWER - x[:, axis])
        tested &= depth < 2.01 * DX
        behind |= low | high
        v = after[:, axis]
        after[:, axis] = torch.where(low, v.clamp_min(0) if kind == "separate" else 0.0, v)
        after[:, axis] = torch.where(high, v.clamp_max(0) if kind == "separate" else 0.0, after[:, axis])
    if kind == "sticky":
        after = torch.where(behind[:, None], 0, velocity)
    return tested, after


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["separate", "slip", "sticky"])
@pytest.mark.parametrize("at", [0.0, 0.4 * DX])
def test_nodes_behind_a_corner_meet_all_its_faces(device, dim, form, kind, at):
    blocks, velocity = nodes(dim, device, at)
    tested, expected = expected_in_tank(blocks, velocity, kind)
    step = mpm.Step(blocks.grid, mpm.NeoHookean(E=1e5, nu=0.3), boundaries=tank(dim, form, kind=kind))
    for obstacles in (step.boundaries.entries, step.boundaries.entries[::-1]):
        after = contact_of(blocks, velocity, obstacles)
        torch.testing.assert_close(after[tested], expected[tested], rtol=0, atol=1e-9)


def contact_of(blocks: mpm.Blocks, velocity: Tensor, obstacles: list[Obstacle]) -> Tensor:
    """As a step has it, and for the shapes of the kernel as torch operations have it."""
    if not all(mpm.ops.fusible(o, 0.0) for o in obstacles):
        return in_torch(blocks, velocity, obstacles)
    active, after = blocks.active_nodes(), contact(blocks, velocity, obstacles, 0.0)
    torch.testing.assert_close(after[active], in_torch(blocks, velocity, obstacles)[active], rtol=0, atol=1e-9)
    return after


def in_torch(blocks: mpm.Blocks, velocity: Tensor, obstacles: list[Obstacle], walls: mpm.Walls | None = None) -> Tensor:
    positions = blocks.node_positions(velocity.dtype)
    faces = () if walls is None else walls.faces(blocks.grid)
    solid = SolidNodes(obstacles, [None] * len(obstacles), positions, None, 0.0, blocks.grid.dx, faces)
    return after_contact(velocity, solid)[0]


# ---- several constraints


def nearest_allowed(v: Tensor, normal: Tensor, speed: Tensor, fixed: Tensor) -> Tensor:
    """The nearest velocity to v [D] with n · v ≥ s, or = s where fixed, by Dykstra's projections in turn."""
    corrections = torch.zeros_like(normal)
    for _ in range(4000):
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
    for _ in range(25):
        normal = torch.nn.functional.normalize(torch.randn(count, dim, dtype=torch.float64), dim=1)
        if float(torch.linalg.det(normal @ normal.mT)) < 0.05:
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
    """A velocity into a floor and a wall and along their edge: it loses μ₁ λ₁ + μ₂ λ₂ along the edge, and stops there."""
    kind = torch.full((1, 2), KINDS["separate"])
    normal, rest = torch.eye(3, dtype=torch.float64)[None, :2], torch.zeros(1, 2, 3, dtype=torch.float64)
    friction = torch.tensor([[0.3, 0.2]], dtype=torch.float64)
    constraints = Constraints(torch.arange(2)[None], kind, friction, normal, rest)
    for along, left in ((3.0, 3.0 - 0.3 * 1.0 - 0.2 * 2.0), (0.5, 0.0)):
        v = torch.tensor([[-1.0, -2.0, along]], dtype=torch.float64)
        after = v + constraints.changes(v).sum(1)
        torch.testing.assert_close(after, v.new_tensor([[0.0, 0.0, left]]))


# ---- seams, walls, steps


def resting_on(obstacles: list[Obstacle], walls: str | None, steps: int = 150) -> mpm.State:
    """A block that slides over a floor at y = 0 without friction."""
    grid = mpm.Grid(0.05, (0.0, -0.3), (1.6, 0.6))
    block = mpm.State.at_rest(mpm.seed.box((0.2, 0.0), (0.4, 0.2), grid, per_cell=4), 1000.0, velocity=(2.0, 0.0))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), gravity=(0, -9.8), walls=walls, boundaries=obstacles)
    state = mpm.rollout(step, block, n=steps, dt=2e-3)
    step.check(state)
    return state


def seams(form: str) -> list[Obstacle]:
    ends = [-0.3, *(0.35 + 0.1 * k + 0.013 * (k % 3) for k in range(10)), 1.9]
    lap = 0.03 if form == "overlapping" else 0.0
    parts = [box([a - lap, -0.3], [b + lap, 0.0]) for a, b in itertools.pairwise(ends)]
    if form == "sdf":
        return [mpm.SDF(part.shape.signed_distance, part.position) for part in parts]
    if form == "own":
        for part in parts:
            part.register_forward_hook(lambda *_: None)
    return parts


@pytest.mark.parametrize("form", ["touching", "overlapping"])
def test_a_block_slides_over_ten_seams(form):
    state = resting_on(seams(form), None)
    assert float(state.x[:, 0].mean()) > 0.85
    assert float(state.v[:, 0].mean()) == pytest.approx(2.0, rel=1e-2)
    assert float(state.x[:, 1].min()) > -0.01


@pytest.mark.parametrize("reach", [0.0, 0.3, 3.0, -0.05])
@pytest.mark.parametrize("walls", ["slip", "separate", "mirror"])
def test_a_box_as_wide_as_the_domain_has_no_end_faces(device, dim, reach, walls):
    """It ends at the walls, beyond them or just before; nodes beyond the walls meet its upper face alone."""
    grid = mpm.Grid(DX, (0.0,) * dim, (1.0,) * dim)
    blocks, lower = random_blocks(grid, device), [-reach * DX] * dim
    upper = [1.0 + reach * DX] * dim
    lower[1], upper[1] = 0.1, 0.5
    floor, velocity = box(lower, upper), torch.randn(blocks.node_count, dim, dtype=torch.float64).to(device)
    x = blocks.node_positions(torch.float64)
    tested = blocks.active_nodes() & (x[:, 1] > 0.5 - 2.01 * DX)
    expected = velocity.clone()
    expected[:, 1] = torch.where(x[:, 1] <= 0.5 + 1e-9, velocity[:, 1].clamp_min(0), velocity[:, 1])
    sides = [walls if axis != 1 else "open" for axis in range(dim)]
    faces = mpm.Walls(sides)
    for axis in range(dim):  # what the grid update leaves of the velocity there
        if axis != 1:
            beyond = (x[:, axis] <= 1e-9) | (x[:, axis] >= 1 - 1e-9)
            velocity[:, axis] = torch.where(beyond, 0, velocity[:, axis])
            expected[:, axis] = torch.where(beyond, 0, expected[:, axis])
    for after in (contact(blocks, velocity, [floor], 0.0, faces), in_torch(blocks, velocity, [floor], faces)):
        torch.testing.assert_close(after[tested], expected[tested], rtol=0, atol=1e-9)


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


@pytest.mark.parametrize("form", ["floor under walls", "overlapping", "planes", "own shape", "sdf of a union"])
@pytest.mark.parametrize("kind", ["separate", "slip", "sticky"])
def test_implicit_bounds_behind_a_corner_are_those_of_all_its_faces(device, dim, form, kind):
    blocks, velocity = nodes(dim, device)
    tested, expected = expected_in_tank(blocks, velocity, kind)
    bounds = node_bounds(blocks, None, tank(dim, form, kind=kind), velocity, 0.0)
    torch.testing.assert_close(bounds.clamped(velocity)[tested], expected[tested], rtol=0, atol=1e-9)
