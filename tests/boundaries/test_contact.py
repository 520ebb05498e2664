"""The contact op against torch operations, of one obstacle and of several as one solid, and by cases."""

import math

import pytest
import torch
from helpers import random_blocks
from oracle.contact import contact_velocity
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.boundaries import Obstacle
from torch_mpm.boundaries.solid import SolidNodes, after_contact
from torch_mpm.geometry.shapes import Cylinder, Shape
from torch_mpm.ops import contact, fusible
from torch_mpm.ops.contact import MAX_OBSTACLES

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
        mpm.Revolved(at, DRUM, vector(dim, 0.2, 1.0, -0.4), **options),
        Obstacle(mpm.shapes.Torus(vector(dim, 0.15, 0.2, -0.1), 0.16), at, **options),
    ]


NAMES = ["plane", "sphere", "box", "capsule", "revolved", "torus"]
DRUM = ((0.1, -0.2), (0.2, 0.05), (0.12, 0.2), (0.3, 0.3), (0.35, -0.3))
"""Walls of a vessel with a hole along its axis, an edge that looks inwards, and a reentrant corner."""


def inputs(dim: int, device: str, scenes: int = 1, dx: float = 0.07) -> tuple[mpm.Blocks, Tensor]:
    """Blocks of the unit box and velocities as a view of rows, as `grid_update` returns them."""
    grid = mpm.Grid(dx, (0.0,) * dim, (1.0, 0.8, 0.7)[:dim], scenes=scenes)
    blocks = random_blocks(grid, device)
    rows = torch.randn(blocks.node_count, 1 + dim, dtype=torch.float64).to(device)
    return blocks, rows[:, 1:]


def in_torch(blocks: mpm.Blocks, velocity: Tensor, obstacles: list[Obstacle], time: float | Tensor) -> Tensor:
    positions = blocks.node_positions(velocity.dtype)
    scene = None if blocks.grid.scenes == 1 else blocks.node_scene()
    for first in range(0, len(obstacles), MAX_OBSTACLES):
        group = obstacles[first : first + MAX_OBSTACLES]
        acts = [blocks.active_nodes()] * len(group)
        velocity, _ = after_contact(velocity, SolidNodes(group, acts, positions, scene, time, blocks.grid.dx))
    return velocity


def assert_same(blocks: mpm.Blocks, velocity: Tensor, obstacles: list[Obstacle], time: float | Tensor = 0.0) -> int:
    """The op agrees where blocks are; the number of nodes that changed."""
    active = blocks.active_nodes()
    expected, got = in_torch(blocks, velocity, obstacles, time), contact(blocks, velocity, obstacles, time)
    torch.testing.assert_close(got[active], expected[active], rtol=0, atol=1e-12)
    untouched = (expected == velocity).all(1) & active
    assert torch.equal(got[untouched], velocity[untouched])
    return int((~untouched & active).sum())


def moving(dim: int) -> dict[str, object]:
    return {
        "velocity": vector(dim, 0.2, -0.1, 0.3), "rotation": turn(dim, 0.7, -0.3, 0.8),
        "angular_velocity": turn(dim, -1.3, 1.1, -0.7), "start": -0.2,
    }  # fmt: skip


@pytest.mark.parametrize(*in_pairs(shape=NAMES, kind=KINDS, friction=[0.0, 0.4], dim=[2, 3]))
def test_is_the_contact_of_the_obstacle(device, dim, shape, kind, friction):
    blocks, velocity = inputs(dim, device)
    for motion in ({}, moving(dim)):
        obstacle = shapes(dim, kind=kind, friction=friction, **motion)[NAMES.index(shape)]
        assert assert_same(blocks, velocity, [obstacle], 0.13) > 5


@pytest.mark.parametrize("shape", NAMES)
@pytest.mark.parametrize("kind", KINDS)
def test_is_coulomb_friction_case_by_case(device, dim, shape, kind):
    """With the normal from differences of the distance, and the velocity of the surface from those of the pose."""
    blocks, velocity = inputs(dim, device)
    obstacle = shapes(dim, kind=kind, friction=0.4, **moving(dim))[NAMES.index(shape)]
    x, time, h = blocks.node_positions(torch.float64), 0.13, 1e-6

    def distance(points: Tensor) -> Tensor:
        return obstacle.signed_distance(points, None, time)

    axes = torch.eye(dim, dtype=torch.float64, device=device)
    normal = torch.stack([(distance(x + h * e) - distance(x - h * e)) / (2 * h) for e in axes], 1)
    pose, ahead, behind = (obstacle.pose(time + t, x) for t in (0.0, h, -h))
    body = (x - pose.centre) @ pose.rotation
    surface = ((ahead.centre + body @ ahead.rotation.mT) - (behind.centre + body @ behind.rotation.mT)) / (2 * h)
    after = contact(blocks, velocity, [obstacle], time)
    bent = (normal.norm(dim=1) - 1).abs() > 1e-7  # where two faces are equally near, or a corner is nearest
    inside = (distance(x) <= 0) & blocks.active_nodes() & ~bent
    if shape == "revolved":  # near a reentrant corner there are two faces
        faces = obstacle.shape.surface(body, None)[1]
        inside &= (faces @ pose.rotation.mT - normal).norm(dim=1) < 1e-6
        for shift in torch.cat([axes, -axes]) * 0.1 * blocks.grid.dx:
            inside &= (obstacle.shape.surface(body + shift, None)[1] - faces).norm(dim=1) < 0.1
    expected = surface + contact_velocity(velocity - surface, normal, kind, 0.4)
    assert int(inside.sum()) > 5
    torch.testing.assert_close(after[inside], expected[inside], rtol=0, atol=1e-7)


def test_obstacles_act_as_one_solid(device, dim):
    """Overlapping bodies of every shape and of two kinds, in any order, and more than fit into one call."""
    blocks, velocity = inputs(dim, device, dx=0.07 if dim == 2 else 0.2)
    several = [o for kind, mu in (("slip", 0.3), ("separate", 0.2)) for o in shapes(dim, kind=kind, friction=mu)]
    assert_same(blocks, velocity, several)
    active = blocks.active_nodes()
    for other in (several[::-1], several[3:] + several[:3]):
        torch.testing.assert_close(
            contact(blocks, velocity, other, 0.0)[active], contact(blocks, velocity, several, 0.0)[active]
        )
    many = several * 7
    in_turn = contact(blocks, contact(blocks, velocity, many[:MAX_OBSTACLES], 0.0), many[MAX_OBSTACLES:], 0.0)
    assert torch.equal(contact(blocks, velocity, many, 0.0)[active], in_turn[active])


def test_nodes_without_mass_keep_their_velocity(device, dim):
    """And have its adjoint; the others are as without masses."""
    blocks, velocity = inputs(dim, device)
    mass = (torch.rand(blocks.node_count, dtype=torch.float64) < 0.5).double().to(device)
    bodies = shapes(dim, kind="separate", friction=0.3)
    velocity.requires_grad_()
    everywhere, after = (contact(blocks, velocity, bodies, 0.0, mass=m) for m in (None, mass))
    active, empty = blocks.active_nodes(), mass == 0
    expected = torch.where(empty[:, None], velocity, everywhere)
    assert torch.equal(after[active], expected[active])
    weight = torch.randn_like(velocity) * active[:, None]
    grads = [torch.autograd.grad((value * weight).sum(), velocity)[0] for value in (after, expected)]
    torch.testing.assert_close(*grads)


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


def leaves_of(dim: int, device: str, scenes: int | None = None) -> dict[str, Tensor]:
    """What contact is differentiated by, the same for all scenes or different."""
    values = {
        "position": vector(dim, 0.55, 0.35, 0.4), "velocity": vector(dim, 0.2, -0.1, 0.3),
        "rotation": turn(dim, 0.7, -0.3, 0.8), "angular_velocity": turn(dim, -1.3, 1.1, -0.7), "friction": 0.3,
        "direction": vector(dim, 0.15, 0.2, -0.1),
    }  # fmt: skip
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    if scenes is not None:
        tensors = {n: t + 0.05 * torch.rand(scenes, *t.shape, dtype=torch.float64) for n, t in tensors.items()}
    return {name: t.to(device).requires_grad_() for name, t in tensors.items()}


def made(shape: str, dim: int, direction: Tensor, **options: object) -> Obstacle:
    return {
        "plane": lambda: mpm.Plane(normal=direction, **options),
        "sphere": lambda: mpm.Sphere(radius=0.25, **options),
        "box": lambda: mpm.Box(size=vector(dim, 0.5, 0.3, 0.6), **options),
        "capsule": lambda: mpm.Capsule(half_axis=direction, radius=0.15, **options),
        "revolved": lambda: mpm.Revolved(outline=DRUM, axis=direction, **options),
        "torus": lambda: Obstacle(mpm.shapes.Torus(direction, 0.16), **options),
    }[shape]()


@pytest.mark.parametrize("kind", KINDS)
def test_gradients(device, dim, kind):
    blocks, velocity = inputs(dim, device, dx=0.07 if dim == 2 else 0.2)
    velocity.requires_grad_()
    bodies = shapes(dim, kind=kind, friction=0.3, angular_velocity=turn(dim, -1.3, 1.1, -0.7))
    weight = torch.randn_like(velocity) * blocks.active_nodes()[:, None]
    (expected,) = torch.autograd.grad((in_torch(blocks, velocity, bodies, 0.1) * weight).sum(), velocity)
    (grad,) = torch.autograd.grad((contact(blocks, velocity, bodies, 0.1) * weight).sum(), velocity)
    torch.testing.assert_close(grad, expected, rtol=0, atol=1e-12)


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("shape", NAMES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scenes", [1, 3])
def test_gradients_of_the_obstacle(device, dim, shape, kind, scenes):
    """Two obstacles, so that the second sees what the first has done; one of them shared by the scenes."""
    blocks, velocity = inputs(dim, device, scenes)
    velocity = velocity.clone().requires_grad_()
    leaves = leaves_of(dim, device, None if scenes == 1 else scenes)
    options = {name: leaf for name, leaf in leaves.items() if name != "direction"}
    body = made(shape, dim, leaves["direction"], kind=kind, **options)
    mu = torch.tensor(0.2, dtype=torch.float64, device=device, requires_grad=True)
    floor = mpm.Plane(vector(dim, 0.5, 0.5, 0.5), vector(dim, 0.3, 1.0, 0.2), "slip", friction=mu, scene=0)
    active = blocks.active_nodes()
    weight = torch.randn_like(velocity) * active[:, None]
    time = 0.1 if scenes == 1 else torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, device=device)
    wanted = [velocity, mu, *leaves.values()]
    results = []
    for after in (in_torch, contact):
        value = (after(blocks, velocity, [body, floor], time) * weight).sum()
        results.append(torch.autograd.grad(value, wanted, allow_unused=True, materialize_grads=True))
    for name, expected, grad in zip(("velocity", "mu", *leaves), *results, strict=True):
        torch.testing.assert_close(grad, expected, rtol=1e-10, atol=1e-10, msg=lambda m, name=name: f"{name}: {m}")
    assert all(grad.abs().max() > 0 for grad in results[1][2:4])  # position and velocity


@pytest.mark.parametrize("kind", ["slip", "separate"])
def test_friction_of_zero_has_a_gradient(device, kind):
    grid = mpm.Grid(0.25, (0.0, 0.0), (0.5, 0.5))
    blocks = random_blocks(grid, device, share=1.0)
    velocity = torch.tensor([2.0, -3.0], dtype=torch.float64, device=device).expand(blocks.node_count, 2)
    mu = torch.zeros((), dtype=torch.float64, device=device, requires_grad=True)
    ground = mpm.Plane((0.0, 9.0), (0.0, 1.0), kind, friction=mu)
    after = contact(blocks, velocity, [ground], 0.0)[blocks.active_nodes()]
    (grad,) = torch.autograd.grad(after[:, 0].mean(), mu)
    assert float(grad) == pytest.approx(-3.0, rel=1e-14)  # the tangential velocity is 2 - 3 friction


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("shape", NAMES)
def test_gradcheck(dim, shape):
    grid = mpm.Grid(0.25, (0.0,) * dim, (0.5,) * dim)
    blocks = random_blocks(grid, share=0.6)
    velocity = torch.randn(blocks.node_count, dim, dtype=torch.float64, requires_grad=True)
    leaves = leaves_of(dim, "cpu")

    def function(velocity: Tensor, *values: Tensor) -> Tensor:
        given = dict(zip(leaves, values, strict=True))
        body = made(shape, dim, given.pop("direction"), kind="separate", **given)
        other = mpm.Sphere((0.4,) * dim, 0.3, "slip", friction=given["friction"])
        return contact(blocks, velocity, [body, other], 0.1)

    arguments = (velocity, *leaves.values())
    assert torch.autograd.gradcheck(function, arguments, fast_mode=True)
    assert torch.autograd.gradgradcheck(function, arguments, fast_mode=True)


def test_what_the_kernel_takes():
    ball = mpm.Sphere((0.5, 0.5), 0.1)
    assert fusible(ball, 0.0) and fusible(ball, torch.tensor(0.0))
    assert not fusible(ball, torch.tensor(0.0, requires_grad=True))
    leaf = torch.tensor([0.5, 0.5], requires_grad=True)
    assert fusible(mpm.Sphere(leaf, 0.1, friction=leaf[0]), 0.0) and fusible(mpm.Plane((0.0, 0.0), leaf), 0.0)
    assert fusible(mpm.Revolved((0.5, 0.5), DRUM), 0.0) and fusible(Obstacle(Cylinder((0, 0, 1), 1), (0, 0, 0)), 0.0)
    assert not fusible(mpm.Sphere(lambda t: t[..., None].expand(2), 0.1), 0.0)
    assert not fusible(mpm.SDF(lambda x: x.norm(dim=1) - 1, (0.5, 0.5)), 0.0)
    assert not fusible(object(), 0.0)

    class Soft(mpm.Sphere):
        def forward(self, velocity, positions, scene, time, dt):
            return velocity

    assert not fusible(Soft((0.5, 0.5), 0.1), 0.0)


def test_a_shape_of_ones_own_acts_by_torch_operations(dim, device):
    class Ball(Shape):
        def surface(self, x, scene=None):
            return x.norm(dim=1) - 0.2, torch.nn.functional.normalize(x, dim=1)

    blocks, velocity = inputs(dim, device)
    own = Obstacle(Ball(), (0.5,) * dim, "slip", friction=0.3, velocity=vector(dim, 0.3, 0.1, 0.2))
    ball = mpm.Sphere((0.5,) * dim, 0.2, "slip", friction=0.3, velocity=vector(dim, 0.3, 0.1, 0.2))
    assert not fusible(own, 0.0)
    with pytest.raises(TypeError, match=r"obstacles\[0\] must be an obstacle of one of plane, sphere"):
        contact(blocks, velocity, [own], 0.0)
    active = blocks.active_nodes()
    expected = contact(blocks, velocity, [ball], 0.1)[active]
    torch.testing.assert_close(in_torch(blocks, velocity, [own], 0.1)[active], expected, rtol=0, atol=1e-12)


def test_a_step_takes_both_ways(dim, device):
    """The same obstacles in the kernel, in it with a parameter that requires grad, and of shapes that it does not know;
    between them a boundary of the user's."""

    class Brake:
        def apply(self, velocity, positions, scene, time, dt):
            return 0.5 * velocity

    grid = mpm.Grid(0.1, (0.0,) * dim, (1.0,) * dim)
    points = mpm.seed.box((0.2,) * dim, (0.8,) * dim, grid, per_cell=2**dim)
    state = mpm.State.at_rest(points, 1000.0, (1.0,) * dim, dtype=torch.float64, device=device)
    results, grads = [], []
    for leaf, hook in ((False, False), (True, False), (True, True)):
        mu = torch.tensor(0.3, dtype=torch.float64, device=device, requires_grad=leaf)
        bodies = shapes(dim, kind="separate", friction=mu, velocity=vector(dim, 0.3, 0.1, 0.2))[1:]
        for body in bodies if hook else ():
            body.shape.__class__ = type("Own", (type(body.shape),), {})  # a shape that the kernel does not know
        assert all(fusible(body, 0.0) != hook for body in bodies)
        step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[*bodies[:2], Brake(), *bodies[2:]])
        results.append(mpm.rollout(step, state, 3, 1e-3))
        if leaf:
            grads += torch.autograd.grad(results[-1].v.square().sum(), mu)
    for result in results[1:]:
        torch.testing.assert_close(result.x, results[0].x, rtol=0, atol=1e-12)
        torch.testing.assert_close(result.v, results[0].v, rtol=0, atol=1e-12)
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-9, atol=0)
    assert grads[0] != 0


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
    table = torch.rand(1, 5, 10 if dim == 2 else 17, dtype=torch.float64).to(device)
    outline = torch.tensor(DRUM[::-1], dtype=torch.float64, device=device).reshape(-1)
    kinds = [[0, 1, 2, 3, 4], [0, 0, 0, 0, 10], [1, 2, 3, 2, 2], [-1, -1, 0, -1, -1], [0.0] * 5, [math.inf] * 5]
    return [velocity, table, outline, *kinds, None, 0.1, *blocks.packed]


def test_opcheck(device, dim):
    arguments = op_arguments(dim, device)
    arguments[0], arguments[1] = arguments[0].clone().requires_grad_(), arguments[1].requires_grad_()
    torch.library.opcheck(torch.ops.torch_mpm.contact, tuple(arguments))
    plain = [arguments[0].detach(), arguments[1].detach(), *arguments[2:]]
    for wants_rows in (False, True):
        given = (torch.randn_like(plain[0]), wants_rows, *plain)
        torch.library.opcheck(torch.ops.torch_mpm.contact_backward, given)


def test_compile(dim):
    blocks, velocity = inputs(dim, "cpu")
    bodies = shapes(dim, kind="separate", friction=0.3)
    compiled = torch.compile(lambda v: contact(blocks, v, bodies, 0.1), fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(velocity), contact(blocks, velocity, bodies, 0.1))


def test_the_op_checks_what_memory_safety_needs(dim):
    arguments = op_arguments(dim, "cpu")
    velocity, table, outline = arguments[:3]
    op = torch.ops.torch_mpm.contact
    for position, value in [
        (0, velocity[:-1]), (0, velocity[:, 0]), (0, velocity.float()), (1, table[:, :, :-1]), (1, table[0]),
        (1, table.float()), (1, table[:0]), (1, table.mT.contiguous().mT), (1, table.repeat(1, 4, 1)),
        (2, outline[:-1]), (2, outline.float()), (2, outline.reshape(-1, 2)), (2, outline.repeat(2)[::2]), (3, [0]),
        (3, [0, 1, 2, 3, 4, 7]), (3, [-1, 1, 2, 3, 4, 6]), (4, [0, 0, 0, 0, 9, 0]), (4, [0, 0, 0, 0, -1, 0]),
        (4, [10, 0, 0, 0, 10, 0]), (5, [0, 1, 2, 3, 3, 3]), (5, [4, 1, 2, 3, 3, 3]), (6, []), (7, [0.0]), (8, [0.0]),
        (9, torch.zeros(0, dtype=torch.float64)), (9, torch.zeros(1)), (11, []), (12, []), (13, []),
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
        (
            (velocity, [mpm.Sphere(torch.zeros(2, dim), 0.2)], 0.0),
            r"position must be given once .* with B = 3, got \[2, ",
        ),
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
