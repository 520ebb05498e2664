"""Obstacles on the grid: shapes against brute force, Coulomb's law, motion, gradients, and no synchronisation."""

import math
import textwrap

import numpy as np
import pytest
import torch
from pairs import in_pairs
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import torch_mpm as mpm
from torch_mpm import boundaries
from torch_mpm.boundaries import Obstacle, constraints, motion

ANGLE = {2: 0.7, 3: (0.4, -0.3, 0.8)}
SPIN = {2: -1.3, 3: (0.5, 1.1, -0.7)}


def cloud(dim: int, device: str = "cpu", count: int = 400, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Node positions around the origin and velocities."""
    generator = torch.Generator().manual_seed(11)
    positions = 2 * torch.rand(count, dim, generator=generator, dtype=torch.float64) - 1
    velocity = torch.randn(count, dim, generator=generator, dtype=torch.float64)
    return positions.to(device, dtype), velocity.to(device, dtype)


def numbers(dim: int, *values: float) -> tuple[float, ...]:
    return values[:dim]


def shapes(dim: int, **options: object) -> list[Obstacle]:
    at = numbers(dim, 0.1, -0.2, 0.05)
    return [
        mpm.Plane(at, numbers(dim, 0.5, 2.0, -0.3), **options),
        mpm.Sphere(at, 0.6, **options),
        mpm.Box(at, numbers(dim, 0.9, 0.5, 1.2), **options),
        mpm.Capsule(at, numbers(dim, 0.3, 0.4, -0.1), 0.35, **options),
        mpm.Revolved(at, HOLLOW, numbers(dim, 0.3, 1.0, -0.2), **options),
        mpm.Obstacle(mpm.shapes.Torus(numbers(dim, 0.1, 0.5, -0.2), 0.3), at, **options),
        mpm.SDF(lambda x: (x * x).sum(1) - 0.4 + 0.3 * x[:, 0], at, **options),
    ]


SHAPES = ["plane", "sphere", "box", "capsule", "revolved", "torus", "sdf"]
HOLLOW = ((0.15, -0.5), (0.45, 0.5), (0.7, 0.5), (0.7, -0.5))
"""A cylinder of radius 0.7 with a conical hole, clockwise."""


def act(
    obstacle: Obstacle, velocity: Tensor, positions: Tensor, scene: Tensor | None = None, time: object = 0.0
) -> Tensor:
    return obstacle.apply(velocity, positions, scene, time, 1e-3)


def surface_velocity(obstacle: Obstacle, positions: Tensor, time: float) -> Tensor:
    """Velocity of the body's matter at world positions, by central differences of its pose."""
    pose = obstacle.pose(time)
    body = (positions - pose.centre) @ pose.rotation
    h = 1e-6
    ahead, behind = obstacle.pose(time + h), obstacle.pose(time - h)
    return ((ahead.centre + body @ ahead.rotation.mT) - (behind.centre + body @ behind.rotation.mT)) / (2 * h)


# ---- shapes


def inside_by_brute_force(shape: str, obstacle: Obstacle, positions: np.ndarray) -> np.ndarray:
    pose = obstacle.pose(0.0)
    body = (positions - pose.centre.numpy()) @ pose.rotation.numpy()
    sizes = vars(obstacle.shape)
    if shape == "plane":
        return body @ np.array(sizes["normal"]) <= 0
    if shape == "sphere":
        return (body**2).sum(1) <= sizes["radius"] ** 2
    if shape == "box":
        return (np.abs(body) <= 0.5 * np.array(sizes["size"])).all(1)
    if shape == "capsule":
        points = np.linspace(-1, 1, 20001)[:, None] * np.array(sizes["half_axis"])
        squared = ((body[:, None] - points[None, ::10]) ** 2).sum(-1).min(1)
        return squared <= sizes["radius"] ** 2
    if shape == "revolved":
        axis = np.array(sizes["axis"]) / np.linalg.norm(sizes["axis"])
        along = body @ axis
        away = np.linalg.norm(body - along[:, None] * axis, axis=1)
        return (np.abs(along) <= 0.5) & (away <= 0.7) & (away >= 0.15 + 0.3 * (along + 0.5))
    if shape == "torus":  # the quartic equation of its surface
        squared, ring = (body**2).sum(1), np.array(sizes["ring"])
        across = squared * (ring @ ring) - (body @ ring) ** 2
        return (squared + ring @ ring - sizes["radius"] ** 2) ** 2 <= 4 * across
    return (body**2).sum(1) - 0.4 + 0.3 * body[:, 0] <= 0


@pytest.mark.parametrize("shape", SHAPES)
def test_which_nodes_are_inside(dim, shape):
    obstacle = shapes(dim, kind="sticky", rotation=ANGLE[dim])[SHAPES.index(shape)]
    positions, velocity = cloud(dim)
    stopped = (act(obstacle, velocity, positions) == 0).all(1).numpy()
    expected = inside_by_brute_force(shape, obstacle, positions.numpy())
    assert 20 < expected.sum() < 380
    assert (stopped == expected).all()


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_are_gradients_of_the_distance(dim, shape):
    obstacle = shapes(dim)[SHAPES.index(shape)]
    positions, _ = cloud(dim)
    distance, normal = obstacle.shape.surface(positions, None)
    inside = distance < 0
    h = 1e-6
    differences = torch.stack(
        [
            (obstacle.shape.surface(positions + h * e, None)[0] - obstacle.shape.surface(positions - h * e, None)[0])
            / (2 * h)
            for e in torch.eye(dim, dtype=torch.float64)
        ],
        1,
    )
    expected = differences / differences.norm(dim=1, keepdim=True)
    torch.testing.assert_close(normal[inside], expected[inside], rtol=0, atol=1e-8)


def test_a_node_on_the_surface_counts(dim, device):
    """Also where position and plane are rounded differently."""
    for dtype in (torch.float32, torch.float64):
        y = (torch.arange(100, dtype=torch.float64) * 0.07).to(device, dtype)
        positions = torch.zeros(100, dim, device=device, dtype=dtype)
        positions[:, 1] = y
        for i in (3, 41, 90):
            plane = mpm.Plane((0.0, i * 0.07, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim], "sticky")
            stopped = (act(plane, torch.ones_like(positions), positions) == 0).all(1)
            assert int(stopped.sum()) == i + 1


# ---- contact


@pytest.mark.parametrize(*in_pairs(shape=SHAPES, kind=["slip", "separate"], friction=[0.0, 0.3], dim=[2, 3]))
def test_coulomb_friction_in_the_frame_of_the_surface(dim, device, shape, kind, friction):
    motion = {"velocity": numbers(dim, 0.7, -0.4, 0.2), "angular_velocity": SPIN[dim], "rotation": ANGLE[dim]}
    obstacle = shapes(dim, kind=kind, friction=friction, **motion)[SHAPES.index(shape)]
    positions, velocity = cloud(dim)
    time = 0.13
    after = act(obstacle, velocity.to(device), positions.to(device), time=time).cpu()
    pose = obstacle.pose(time)
    distance, normal = obstacle.shape.surface((positions - pose.centre) @ pose.rotation, None)
    normal = normal @ pose.rotation.mT
    inside = distance <= 0
    assert torch.equal(after[~inside], velocity[~inside])
    surface = surface_velocity(obstacle, positions, time)
    before, after, normal = (velocity - surface)[inside], (after - surface)[inside], normal[inside]
    normal_before, normal_after = (before * normal).sum(1), (after * normal).sum(1)
    tangent_before = before - normal_before[:, None] * normal
    tangent_after = after - normal_after[:, None] * normal
    pressed = normal_before < 0
    assert 5 < pressed.sum() < len(pressed) - 5
    expected = torch.zeros_like(normal_before) if kind == "slip" else normal_before.clamp_min(0)
    torch.testing.assert_close(normal_after, expected, rtol=0, atol=1e-8)
    speed = tangent_before.norm(dim=1)
    left = (speed - friction * (-normal_before).clamp_min(0)).clamp_min(0)
    torch.testing.assert_close(tangent_after, (left / speed)[:, None] * tangent_before, rtol=0, atol=1e-8)


def test_a_moving_plate_drags(device):
    """Sticky takes the plate's velocity at once; friction at most the tangential velocity that pressure allows."""
    positions = torch.tensor([[0.3, 0.5], [0.3, 0.7]], device=device)
    velocity = torch.tensor([[0.0, -1.0], [0.0, -1.0]], device=device)
    for kind, friction, expected in [("sticky", 0.0, 2.0), ("slip", 0.0, 0.0), ("slip", 0.5, 0.5), ("slip", 5.0, 2.0)]:
        plate = mpm.Plane((0.0, 0.6), (0.0, 1.0), kind, friction=friction, velocity=(2.0, 0.0))
        torch.testing.assert_close(act(plate, velocity, positions).cpu(), torch.tensor([[expected, 0.0], [0.0, -1.0]]))


def test_a_plate_that_comes_closer_pushes(device):
    positions, velocity = torch.zeros(1, 3, device=device), torch.tensor([[1.0, 0.5, 0.0]], device=device)
    plate = mpm.Plane((0.0, 0.1, 0.0), (0.0, 2.0, 0.0), "separate", velocity=(0.0, 3.0, 0.0))
    assert act(plate, velocity, positions).tolist() == [[1.0, 3.0, 0.0]]
    assert act(plate, velocity + 4.0, positions).tolist() == [[5.0, 4.5, 4.0]]  # the node runs away from it


# ---- motion


def test_pose(dim):
    """Position and orientation of a turning, moving body against the matrix exponential."""
    start, time = 0.5, 1.7
    at, velocity = np.arange(1.0, 1.0 + dim), np.linspace(-1, 1, dim)

    def exponential(angle: object) -> np.ndarray:
        if dim == 2:
            cross = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64) * float(angle)
        else:
            x, y, z = angle
            cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        return torch.linalg.matrix_exp(cross).numpy()

    body = mpm.Box(at, (1.0,) * dim, velocity=velocity, rotation=ANGLE[dim], angular_velocity=SPIN[dim], start=start)
    pose = body.pose(time)
    turned = exponential((time - start) * np.array(SPIN[dim])) @ exponential(np.array(ANGLE[dim]))
    np.testing.assert_allclose(pose.centre.numpy(), at + velocity * (time - start), rtol=1e-14)
    np.testing.assert_allclose(pose.rotation.numpy(), turned, atol=1e-14)
    still = mpm.Sphere(at, 0.1).pose(torch.tensor([0.0, 1.0]))
    np.testing.assert_array_equal(still.rotation.numpy(), np.eye(dim))


def test_position_as_a_function_of_time(dim, device):
    """A path given as a function moves and drags like the same path given by its velocity."""
    at, velocity = numbers(dim, 0.1, -0.2, 0.05), numbers(dim, 0.4, 0.3, -0.6)
    positions, speeds = cloud(dim, device)

    def path(time: Tensor) -> Tensor:
        return torch.tensor(at, device=device) + time[..., None] * torch.tensor(velocity, device=device)

    by_function = mpm.Sphere(path, 0.6, "slip", friction=0.2)
    by_velocity = mpm.Sphere(at, 0.6, "slip", friction=0.2, velocity=velocity)
    for time in (0.3, torch.tensor(0.3, device=device, dtype=torch.float64)):
        torch.testing.assert_close(
            act(by_function, speeds, positions, time=time),
            act(by_velocity, speeds, positions, time=time),
            atol=1e-6,
            rtol=0,
        )


def test_swinging_path_has_the_velocity_of_its_derivative():
    swing = mpm.Sphere(lambda t: torch.stack([t.sin(), torch.zeros_like(t)], -1), 0.5, "sticky")
    after = act(
        swing, torch.zeros(1, 2, dtype=torch.float64), torch.tensor([[0.6, 0.1]], dtype=torch.float64), time=0.8
    )
    np.testing.assert_allclose(after.numpy(), [[math.cos(0.8), 0.0]], rtol=1e-14)


def test_start_and_end(dim, device):
    positions, velocity = cloud(dim, device)
    wall = mpm.Sphere((0.0,) * dim, 0.7, "sticky", start=1.0, end=2.0)
    acting = act(wall, velocity, positions, time=1.5)
    assert not torch.equal(acting, velocity)
    for time, expected in [(0.99, velocity), (1.0, acting), (1.99, acting), (2.0, velocity)]:
        assert torch.equal(act(wall, velocity, positions, time=time), expected)
        assert torch.equal(act(wall, velocity, positions, time=torch.tensor(time, device=device)), expected)


# ---- scenes


def test_scenes_have_their_own_times_and_parameters(dim, device):
    """A batch is the same as its scenes one by one."""
    positions, velocity = cloud(dim, device)
    B = 3
    scene = (torch.arange(len(positions), device=device) % (B + 1) - 1).int()  # -1: rows of unused blocks
    generator = torch.Generator().manual_seed(2)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(device)

    spin = random(B) if dim == 2 else random(B, 3)
    at, speed, friction, radius = 0.3 * random(B, dim), random(B, dim), random(B).abs(), 0.5 + 0.1 * random(B)
    time = torch.tensor([0.0, 0.3, 0.6], dtype=torch.float64, device=device)
    batch = mpm.Sphere(at, radius, "slip", friction=friction, velocity=speed, angular_velocity=spin, end=0.5)
    after = act(batch, velocity, positions, scene, time)
    for b in range(B):
        own = scene == b
        alone = mpm.Sphere(
            at[b], radius[b], "slip", friction=friction[b], velocity=speed[b], angular_velocity=spin[b], end=0.5
        )
        torch.testing.assert_close(after[own], act(alone, velocity[own], positions[own], None, float(time[b])))
    assert torch.equal(after[scene == 2], velocity[scene == 2]) and not torch.equal(
        after[scene == 1], velocity[scene == 1]
    )


def test_only_in_its_scene(dim, device):
    positions, velocity = cloud(dim, device)
    scene = (torch.arange(len(positions), device=device) % 3).int()
    after = act(mpm.Sphere((0.0,) * dim, 0.7, "sticky", scene=1), velocity, positions, scene)
    everywhere = act(mpm.Sphere((0.0,) * dim, 0.7, "sticky"), velocity, positions, scene)
    assert torch.equal(after, torch.where((scene == 1)[:, None], everywhere, velocity))
    assert torch.equal(act(mpm.Sphere((0.0,) * dim, 0.7, scene=1), velocity, positions), velocity)


# ---- gradients


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("shape", ["plane", "sphere", "capsule", "sdf", "box"])
@pytest.mark.parametrize("kind", ["sticky", "separate"])
def test_gradcheck(dim, shape, kind):
    positions, velocity = cloud(dim, count=100)
    values = {
        "position": torch.tensor(numbers(dim, 0.1, -0.2, 0.05)),
        "velocity": torch.tensor(numbers(dim, 0.4, 0.3, -0.6)),
        "rotation": torch.tensor(ANGLE[dim]),
        "angular_velocity": torch.tensor(SPIN[dim]),
        "friction": torch.tensor(0.2),
        "extra": torch.tensor(numbers(dim, 0.5, 1.0, -0.3)),
    }
    leaves = [v.double().requires_grad_() for v in values.values()]

    def function(velocity: Tensor, *leaves: Tensor) -> Tensor:
        *motion, extra = leaves
        options = dict(zip(values, motion, strict=False), kind=kind)
        obstacle = {
            "plane": lambda: mpm.Plane(normal=extra, **options),
            "sphere": lambda: mpm.Sphere(radius=0.6, **options),
            "box": lambda: mpm.Box(size=(0.9,) * dim, **options),
            "capsule": lambda: mpm.Capsule(half_axis=extra, radius=0.3, **options),
            "revolved": lambda: mpm.Revolved(outline=HOLLOW, axis=extra, **options),
            "torus": lambda: mpm.Obstacle(mpm.shapes.Torus(extra, 0.3), **options),
            "sdf": lambda: mpm.SDF(lambda x: (x * x * (1 + extra**2)).sum(1) - 0.5, **options),
        }[shape]()
        return act(obstacle, velocity, positions, time=0.2)

    arguments = (velocity.requires_grad_(), *leaves)
    assert torch.autograd.gradcheck(function, arguments, fast_mode=True, eps=1e-7, atol=1e-6)
    assert torch.autograd.gradgradcheck(function, arguments, fast_mode=True, eps=1e-7, atol=1e-5)
    if kind == "separate":  # friction and rotation really have a gradient
        grads = torch.autograd.grad(function(*arguments).square().sum(), leaves, allow_unused=True)
        assert all(grads[i] is not None and grads[i].abs().max() > 0 for i in (0, 1, 3, 4))


@pytest.mark.parametrize("kind", ["slip", "separate"])
def test_friction_of_zero_has_a_gradient(kind):
    friction = torch.zeros((), dtype=torch.float64, requires_grad=True)
    ground = mpm.Plane((0.0, 0.0), (0.0, 1.0), kind, friction=friction)
    after = act(ground, torch.tensor([[2.0, -3.0]], dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64))
    (grad,) = torch.autograd.grad(after[0, 0], friction)
    assert float(grad) == -3.0  # the tangential velocity is 2 - 3 friction


@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_nodes_have_finite_values_and_gradients(dim, device, kind, dtype):
    """The centre of each shape, no tangential velocity, no velocity, hardly any; and NaN in one node far away."""
    at = torch.zeros(dim, dtype=dtype, device=device)
    options = {
        "position": at.clone().requires_grad_(),
        "kind": kind,
        "friction": torch.tensor(0.3, dtype=dtype, device=device, requires_grad=True),
        "velocity": at.clone().requires_grad_(),
        "rotation": torch.zeros(() if dim == 2 else 3, dtype=dtype, device=device, requires_grad=True),
        "angular_velocity": torch.zeros(() if dim == 2 else 3, dtype=dtype, device=device, requires_grad=True),
    }
    axis = torch.eye(dim, dtype=dtype, device=device)[0]
    positions = torch.stack([at, at, at - 0.1 * axis, at - 0.1 * axis, at - 0.1 * axis, at + 5.0, at + 5.0])
    tiny = torch.full_like(at, torch.finfo(dtype).tiny)
    velocity = torch.stack([at, axis, axis, -axis, tiny, axis, at + math.nan]).requires_grad_()
    for obstacle in [
        mpm.Plane(normal=axis, **options),
        mpm.Sphere(radius=0.5, **options),
        mpm.Box(size=(1.0,) * dim, **options),
        mpm.Capsule(half_axis=0 * axis, radius=0.5, **options),
        mpm.Revolved(outline=((0, 0.5), (0.5, 0.5), (0.5, -0.5), (0, -0.5)), axis=axis, **options),
        mpm.SDF(lambda x: x.square().sum(1) - 0.25, **options),
    ]:
        after = act(obstacle, velocity, positions, time=0.1)
        assert after[:-1].isfinite().all() and after[-1].isnan().all()
        parameters = [v for v in options.values() if isinstance(v, Tensor)]
        grads = torch.autograd.grad(after[:-1].sum(), [velocity, *parameters], allow_unused=True)
        assert all(g is None or g.isfinite().all() for g in grads), type(obstacle).__name__
        assert (grads[0][5] == 1).all()


def test_radius_and_size_refuse_gradients():
    leaf = torch.ones((), requires_grad=True)
    for make in (
        lambda: mpm.Sphere((0, 0), leaf),
        lambda: mpm.Box((0, 0), leaf),
        lambda: mpm.Capsule((0, 0), (1, 0), leaf),
    ):
        with pytest.raises(ValueError, match="must not require grad"):
            make()


# ---- inside a captured or compiled step


class NoSynchronisation(TorchDispatchMode):
    """Fails on operations that wait for a device or copy to it."""

    WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "item", "lift_fresh")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        name = func.overloadpacket.__name__
        assert name not in self.WAITING, f"{func} waits for the device"
        assert name != "_to_copy" or (kwargs or {}).get("device") is None, f"{func} copies to a device"
        if name in ("index", "index_put"):
            assert all(i is None or i.dtype != torch.bool for i in args[1]), f"{func} by a mask waits for the device"
        return func(*args, **(kwargs or {}))


def moving_shapes(dim: int, **options: object) -> list[Obstacle]:
    options = {"kind": "separate", "friction": 0.2, "end": 3.0, **options}
    turning = {"rotation": ANGLE[dim], "angular_velocity": SPIN[dim]}
    bodies = shapes(dim, velocity=(0.1,) * dim, **turning, **options)
    return [*bodies, mpm.Sphere(lambda t: torch.stack([t.sin()] * dim, -1), 0.6, **turning, **options)]


@pytest.mark.thorough(dim=3)
def test_nothing_synchronises(dim, monkeypatch):
    monkeypatch.setattr(constraints, "reads_values", lambda x: False)  # as on a GPU
    monkeypatch.setattr(motion, "is_readable", lambda x: False)
    positions, velocity = cloud(dim)
    time = torch.tensor(0.3, dtype=torch.float64)
    scene = (torch.arange(len(positions)) % 2).int()
    forms = [(time, None), (time.repeat(2), scene), (0.3, None)]
    for k, obstacle in enumerate(moving_shapes(dim)):  # each call takes a second
        act(obstacle, velocity, positions, None, time)  # numbers become tensors at the first step
        t, s = forms[k % len(forms)]
        with NoSynchronisation():
            act(obstacle, velocity, positions, s, t)


def test_capture_in_a_graph(dim, device):
    if device != "cuda":
        pytest.skip("graphs are of CUDA")
    positions, velocity = cloud(dim, device)
    time = torch.tensor(0.3, dtype=torch.float64, device=device)
    bodies = moving_shapes(dim)

    def all_bodies() -> Tensor:
        result = velocity
        for body in bodies:
            result = act(body, result, positions, time=time)
        return result

    all_bodies()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = all_bodies()
    time += 0.4
    graph.replay()
    torch.testing.assert_close(captured, all_bodies(), rtol=0, atol=0)


FACES = pytest.param(2, "faces", marks=pytest.mark.slow)  # which take up to half a minute to compile


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize(("dim", "form"), [(2, "pose"), (3, "path"), FACES])
def test_compile(dim, form):
    positions, velocity = cloud(dim)
    time = torch.tensor(0.3, dtype=torch.float64)
    plane, sphere, box, *_, on_path = moving_shapes(dim)  # those with outlines take up to a minute
    bodies = {"pose": [plane, sphere], "path": [sphere, on_path], "faces": [box]}[form]

    def all_bodies(velocity: Tensor, positions: Tensor, time: Tensor) -> Tensor:
        for body in bodies:
            velocity = act(body, velocity, positions, time=time)
        return velocity

    compiled = torch.compile(all_bodies, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(velocity, positions, time), all_bodies(velocity, positions, time))


def test_changed_numbers_take_effect(device):
    positions, velocity = torch.zeros(1, 2, device=device), torch.ones(1, 2, device=device)
    body = mpm.Sphere((0.0, 0.0), 1.0, "sticky", velocity=(1.0, 2.0))
    with torch.inference_mode():
        assert act(body, velocity, positions).tolist() == [[1.0, 2.0]]
    body.velocity = (3.0, 4.0)
    assert act(body, velocity.requires_grad_(), positions).tolist() == [[3.0, 4.0]]


# ---- the example, and bad input


def test_the_example_of_the_docstring(device):
    lines = boundaries.__doc__.split("\n\n")[2].splitlines()
    namespace: dict = {"torch": torch}
    exec(textwrap.dedent("\n".join(lines)), namespace)
    wind = namespace["Wind"](torch.tensor([3.0, 0.0], device=device))
    positions, velocity = torch.tensor([[0.0, 0.2], [0.0, 0.7]], device=device), torch.zeros(2, 2, device=device)
    after = wind(velocity, positions, None, 0.0, 0.5)
    assert after.tolist() == [[0.0, 0.0], [1.5, 0.0]]
    (grad,) = torch.autograd.grad(after.sum(), list(wind.parameters()))
    assert grad.tolist() == [0.5, 0.5]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mpm.Sphere((0, 0), 1, "stick"), "kind must be one of .* got 'stick'"),
        (lambda: mpm.Sphere((0, 0), 1, friction=-1.0), "friction must be a finite number >= 0, got -1.0"),
        (lambda: mpm.Sphere((0, 0), -1), "radius must be >= 0, got -1"),
        (lambda: mpm.Box((0, 0), (1, -1)), "size must be >= 0"),
        (lambda: mpm.Sphere((0, math.nan), 1), "position must be finite"),
        (lambda: mpm.Plane((0, 0), (0, 0)), "normal must not be zero"),
        (lambda: mpm.Sphere((0, 0), 1, start=2.0, end=1.0), "start must be finite and not after end"),
        (lambda: mpm.Sphere((0, 0), 1, scene=-1), "scene must not be negative"),
        (lambda: mpm.Sphere(lambda t: t, 1, velocity=(0, 0)), "velocity must be None where position is a function"),
    ],
)
def test_messages_of_construction(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (mpm.Sphere((0, 0), 1), "position must have 3 numbers per point"),
        (mpm.Sphere((0, 0, 0), 1, velocity=(1, 0)), r"velocity must have shape \[3\] or \[B, 3\], got \[2\]"),
        (
            mpm.Sphere((0, 0, 0), 1, angular_velocity=1.0),
            r"angular_velocity must have shape \[3\] or \[B, 3\], got \[\]",
        ),
        (mpm.Plane((0, 0, 0), (0, 1)), r"normal must have shape \[3\] or \[B, 3\], got \[2\]"),
        (mpm.SDF(lambda x: x, (0, 0, 0), normal=lambda x: x), "distance and normal of an SDF must have shape"),
    ],
)
def test_messages_of_use(obstacle, message):
    with pytest.raises(ValueError, match=message):
        act(obstacle, torch.zeros(4, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match=r"velocity and positions must both have shape \[N, D\]"):
        act(obstacle, torch.zeros(4, 3), torch.zeros(5, 3))
