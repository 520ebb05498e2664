"""The contact op against `Obstacle.apply` in plain torch, of one obstacle after another."""

import math

import pytest
import torch
from helpers import random_blocks
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.boundaries import Obstacle
from torch_mpm.ops import contact, fusible

KINDS = ["sticky", "slip", "separate"]


def vector(dim: int, *values: float) -> tuple[float, ...]:
    return values[:dim]


def turn(dim: int, *values: float) -> float | tuple[float, ...]:
    return values[0] if dim == 2 else values


def shapes(dim: int, **options: object) -> list[Obstacle]:
    at = vector(dim, 0.55, 0.35, 0.4)
    return [
        mpm.Plane(at, vector(dim, 0.5, 2.0, -0.3), **options),
        mpm.Sphere(at, 0.25, **options),
        mpm.Box(at, vector(dim, 0.5, 0.3, 0.6), **options),
        mpm.Capsule(at, vector(dim, 0.15, 0.2, -0.1), 0.15, **options),
    ]


def inputs(dim: int, device: str, scenes: int = 1) -> tuple[mpm.Blocks, Tensor]:
    """Blocks of the unit box and velocities as a view of rows, as `grid_update` returns them."""
    grid = mpm.Grid(0.07, (0.0,) * dim, (1.0, 0.8, 0.7)[:dim], scenes=scenes)
    blocks = random_blocks(grid, device)
    rows = torch.randn(blocks.node_count, 1 + dim, dtype=torch.float64).to(device)
    return blocks, rows[:, 1:]


def in_turn(blocks: mpm.Blocks, velocity: Tensor, obstacles: list[Obstacle], time: float | Tensor) -> Tensor:
    positions = blocks.node_positions(velocity.dtype)
    scene = None if blocks.grid.scenes == 1 else blocks.node_scene()
    for obstacle in obstacles:
        velocity = obstacle.apply(velocity, positions, scene, time, 0.1)
    return velocity


def assert_same(blocks: mpm.Blocks, velocity: Tensor, obstacles: list[Obstacle], time: float | Tensor = 0.0) -> int:
    """The op agrees where blocks are; the number of nodes that changed."""
    active = blocks.active_nodes()
    expected, got = in_turn(blocks, velocity, obstacles, time), contact(blocks, velocity, obstacles, time)
    torch.testing.assert_close(got[active], expected[active], rtol=0, atol=1e-12)
    untouched = (expected == velocity).all(1) & active
    assert torch.equal(got[untouched], velocity[untouched])
    return int((~untouched & active).sum())


@pytest.mark.parametrize("shape", [0, 1, 2, 3], ids=["plane", "sphere", "box", "capsule"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_is_the_contact_of_the_obstacle(device, dim, shape, kind, friction):
    blocks, velocity = inputs(dim, device)
    moving = {
        "velocity": vector(dim, 0.2, -0.1, 0.3), "rotation": turn(dim, 0.7, -0.3, 0.8),
        "angular_velocity": turn(dim, -1.3, 1.1, -0.7), "start": -0.2,
    }  # fmt: skip
    for motion in ({}, moving):
        (obstacle,) = shapes(dim, kind=kind, friction=friction, **motion)[shape : shape + 1]
        assert assert_same(blocks, velocity, [obstacle], 0.13) > 5


def test_obstacles_act_one_after_another(device, dim):
    """Overlapping bodies of every kind, more than fit into one call; and the order matters."""
    blocks, velocity = inputs(dim, device)
    several = [o for kind, mu in (("slip", 0.3), ("separate", 0.2)) for o in shapes(dim, kind=kind, friction=mu)]
    assert_same(blocks, velocity, several)
    assert_same(blocks, velocity, several * 3)
    assert not torch.equal(contact(blocks, velocity, several, 0.0), contact(blocks, velocity, several[::-1], 0.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_node_on_the_surface_counts(device, dim, dtype):
    grid = mpm.Grid(0.07, (0.0,) * dim, (0.7,) * dim)
    blocks = random_blocks(grid, device, share=1.0)
    velocity = torch.ones(blocks.node_count, dim, device=device, dtype=dtype)
    for i in (3, 4, 7):
        floor = mpm.Plane(vector(dim, 0.0, i * 0.07, 0.0), vector(dim, 0.0, 1.0, 0.0), "sticky")
        stopped = (contact(blocks, velocity, [floor], 0.0) == 0).all(1)
        expected = (blocks.node_indices()[:, 1] - 3 <= i) & blocks.active_nodes()
        assert torch.equal(stopped, expected)


def test_scenes_have_their_own_times_and_parameters(device, dim):
    B = 3
    blocks, velocity = inputs(dim, device, B)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, dtype=torch.float64).to(device)

    ball = mpm.Sphere(
        random(B, dim), 0.2 + random(B), "slip", friction=random(B), velocity=random(B, dim) - 0.5,
        angular_velocity=random(*((B,) if dim == 2 else (B, 3))), end=0.5,
    )  # fmt: skip
    other = mpm.Box(vector(dim, 0.5, 0.5, 0.5), vector(dim, 0.5, 0.5, 0.5), "sticky", scene=1)
    time = torch.tensor([0.1, 0.3, 0.6], dtype=torch.float64, device=device)
    assert assert_same(blocks, velocity, [ball, other], time) > 5
    assert assert_same(blocks, velocity, [ball, other], 0.2) > 5
    after = contact(blocks, velocity, [ball], time)
    last = blocks.node_scene() == 2
    assert torch.equal(after[last], velocity[last])  # the ball is gone


def test_start_and_end(device, dim):
    blocks, velocity = inputs(dim, device)
    wall = mpm.Sphere((0.5,) * dim, 0.3, "sticky", start=0.1, end=2.0)
    for time, acts in [(0.0999, False), (0.1, True), (1.999, True), (2.0, False)]:
        assert (assert_same(blocks, velocity, [wall], time) > 0) == acts
        assert (
            assert_same(blocks, velocity, [wall], torch.tensor(time, dtype=torch.float64, device=device)) > 0
        ) == acts


def test_changed_parameters_are_seen(device, dim):
    blocks, velocity = inputs(dim, device)
    at = torch.full((dim,), 0.5, dtype=torch.float64, device=device)
    ball = mpm.Sphere(at, 0.3, "sticky")
    first = contact(blocks, velocity, [ball], 0.0)
    assert torch.equal(contact(blocks, velocity, [ball], 0.0), first)
    at += 0.2
    assert_same(blocks, velocity, [ball])
    assert not torch.equal(contact(blocks, velocity, [ball], 0.0), first)
    ball.radius = 0.1
    assert_same(blocks, velocity, [ball])
    assert_same(blocks, velocity.float().double(), [ball, mpm.Plane(at.clone(), (1.0,) * dim)])


@pytest.mark.parametrize("kind", KINDS)
def test_degenerate_nodes_are_finite(device, dim, kind):
    """The centre of each shape, a half axis of zero, and NaN in one node far away."""
    grid = mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim)
    blocks = random_blocks(grid, device, share=1.0)
    at = (0.5,) * dim
    options = {"kind": kind, "friction": 0.3}
    bodies = [mpm.Sphere(at, 0.2, **options), mpm.Capsule(at, (0.0,) * dim, 0.2, **options), mpm.Box(at, at, **options)]
    velocity = torch.zeros(blocks.node_count, dim, dtype=torch.float64, device=device)
    far = int((blocks.node_positions(torch.float64) - 0.9).norm(dim=1).argmin())
    velocity[far] = math.nan
    velocity.requires_grad_()
    after = contact(blocks, velocity, bodies, 0.0)
    others = torch.arange(len(after), device=device) != far
    (grad,) = torch.autograd.grad(after[others].sum(), velocity)
    assert after[others].isfinite().all() and grad[others].isfinite().all()


# ---- derivatives


@pytest.mark.parametrize("kind", KINDS)
def test_gradients(device, dim, kind):
    blocks, velocity = inputs(dim, device)
    velocity.requires_grad_()
    bodies = shapes(dim, kind=kind, friction=0.3, angular_velocity=turn(dim, -1.3, 1.1, -0.7))
    weight = torch.randn_like(velocity) * blocks.active_nodes()[:, None]
    (expected,) = torch.autograd.grad((in_turn(blocks, velocity, bodies, 0.1) * weight).sum(), velocity)
    (grad,) = torch.autograd.grad((contact(blocks, velocity, bodies, 0.1) * weight).sum(), velocity)
    torch.testing.assert_close(grad, expected, rtol=0, atol=1e-12)


def test_gradcheck(dim):
    grid = mpm.Grid(0.25, (0.0,) * dim, (0.5,) * dim)
    blocks = random_blocks(grid, share=0.6)
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64, requires_grad=True)
    bodies = shapes(dim, kind="separate", friction=0.3, velocity=vector(dim, 0.1, -0.2, 0.3))[1:3]

    def function(velocity: Tensor) -> Tensor:
        return contact(blocks, velocity, bodies, 0.1)

    assert torch.autograd.gradcheck(function, (velocity,), fast_mode=True)
    assert torch.autograd.gradgradcheck(function, (velocity,), fast_mode=True)


def test_what_is_differentiated_otherwise_is_left_to_torch():
    ball = mpm.Sphere((0.5, 0.5), 0.1)
    assert fusible(ball, 0.0) and fusible(ball, torch.tensor(0.0))
    assert not fusible(ball, torch.tensor(0.0, requires_grad=True))
    grad = torch.tensor([0.5, 0.5], requires_grad=True)
    assert not fusible(mpm.Sphere(grad, 0.1), 0.0) and not fusible(mpm.Plane((0.0, 0.0), grad), 0.0)
    assert not fusible(mpm.Sphere((0.5, 0.5), 0.1, friction=grad[0]), 0.0)
    assert not fusible(mpm.Sphere(lambda t: t[..., None].expand(2), 0.1), 0.0)
    assert not fusible(mpm.SDF(lambda x: x.norm(dim=1) - 1, (0.5, 0.5)), 0.0)
    assert not fusible(object(), 0.0)


def test_a_step_takes_both_ways(dim, device):
    """The same obstacles with and without a parameter that requires grad; a user's boundary between them."""

    class Brake:
        def apply(self, velocity, positions, scene, time, dt):
            return 0.5 * velocity

    grid = mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim)
    points = mpm.seed.box((0.2,) * dim, (0.8,) * dim, grid, per_cell=2**dim)
    state = mpm.State.at_rest(points, 1000.0, (1.0,) * dim, dtype=torch.float64, device=device)
    results = []
    for leaf in (False, True):
        mu = torch.tensor(0.3, dtype=torch.float64, device=device, requires_grad=leaf)
        first, second, third = shapes(dim, kind="separate", friction=mu, velocity=vector(dim, 0.3, 0.1, 0.2))[1:]
        step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[first, second, Brake(), third])
        results.append(mpm.rollout(step, state, 3, 1e-3))
    torch.testing.assert_close(results[0].x, results[1].x, rtol=0, atol=1e-12)
    torch.testing.assert_close(results[0].v, results[1].v, rtol=0, atol=1e-12)


@pytest.mark.cuda
def test_a_step_with_obstacles_is_captured(dim):
    grid = mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim, max_blocks=5**dim)
    state = mpm.State.at_rest(mpm.seed.box((0.2,) * dim, (0.8,) * dim, grid), 1000.0, (1.0,) * dim, device="cuda")
    sdf = mpm.SDF(lambda x: x.norm(dim=1) - 0.1, (0.4,) * dim)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), walls="mirror", boundaries=[*shapes(dim), sdf], transfer="pic")
    with torch.no_grad():
        expected = step(state, 1e-3)
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            got = step(state, 1e-3)
        graph.replay()
    torch.testing.assert_close(got.x, expected.x)
    torch.testing.assert_close(got.v, expected.v)


# ---- the op itself


def op_arguments(dim: int, device: str) -> list:
    blocks, velocity = inputs(dim, device)
    table = torch.rand(1, 4, 10 if dim == 2 else 17, dtype=torch.float64).to(device)
    kinds = [[0, 1, 2, 3], [1, 2, 3, 2], [-1, -1, 0, -1], [0.0] * 4, [math.inf] * 4]
    return [velocity, table, *kinds, None, 0.1, *blocks.packed]


def test_opcheck(device, dim):
    arguments = op_arguments(dim, device)
    arguments[0] = arguments[0].clone().requires_grad_()
    torch.library.opcheck(torch.ops.torch_mpm.contact, tuple(arguments))
    plain = [arguments[0].detach(), *arguments[1:]]
    torch.library.opcheck(torch.ops.torch_mpm.contact_backward, (torch.randn_like(plain[0]), *plain))


def test_compile(dim):
    blocks, velocity = inputs(dim, "cpu")
    bodies = shapes(dim, kind="separate", friction=0.3)
    compiled = torch.compile(lambda v: contact(blocks, v, bodies, 0.1), fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(velocity), contact(blocks, velocity, bodies, 0.1))


def test_the_op_checks_what_memory_safety_needs(dim):
    arguments = op_arguments(dim, "cpu")
    velocity, table = arguments[:2]
    op = torch.ops.torch_mpm.contact
    for position, value in [
        (0, velocity[:-1]), (0, velocity[:, 0]), (0, velocity.float()), (1, table[:, :, :-1]), (1, table[0]),
        (1, table.float()), (1, table[:0]), (1, table.mT.contiguous().mT), (1, table.repeat(1, 5, 1)), (2, [0]),
        (2, [0, 1, 2, 4]), (2, [-1, 1, 2, 3]), (3, [0, 1, 2, 3]), (3, [4, 1, 2, 3]), (4, []), (5, [0.0]), (6, [0.0]),
        (7, torch.zeros(0, dtype=torch.float64)), (7, torch.zeros(1)), (9, []),
    ]:  # fmt: skip
        with pytest.raises(RuntimeError):
            op(*arguments[:position], value, *arguments[position + 1 :])


def test_messages(dim):
    blocks, velocity = inputs(dim, "cpu", 3)
    ball = mpm.Sphere((0.5,) * dim, 0.2)
    for arguments, message in [
        ((velocity[:-1], [ball], 0.0), r"velocity must have shape \[N, D\]"),
        ((velocity, [ball], torch.zeros(2, dtype=torch.float64)), r"time must be a number or have shape"),
        ((velocity, [mpm.Sphere((0.5,) * (5 - dim), 0.2)], 0.0), "position must have shape"),
        ((velocity, [mpm.Sphere(torch.zeros(2, dim), 0.2)], 0.0), "must be given once or per scene, B = 3, got 2"),
    ]:
        with pytest.raises(ValueError, match=message):
            contact(blocks, *arguments)
    with pytest.raises(NotImplementedError, match="vmap"):
        torch.vmap(lambda v: contact(blocks, v, [ball], 0.0))(torch.stack([velocity] * 2))


def test_nothing_to_do(device, dim):
    blocks, velocity = inputs(dim, device)
    assert contact(blocks, velocity, [], 0.0) is velocity
    none = random_blocks(mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim), device, share=0.0, unused=0)
    assert contact(none, torch.zeros(0, dim, device=device), shapes(dim), 0.0).shape == (0, dim)
