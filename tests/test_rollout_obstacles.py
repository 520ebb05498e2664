"""Obstacles that follow paths, and gradients of obstacles, in rollouts in one op: against single steps, whose obstacles
are torch operations, and against finite differences."""

import subprocess
import sys

import pytest
import torch
from cases.rollout_gradients import assert_same, gradients, in_op, moving, single
from cases.rollouts import SOME_TRANSFERS, TRANSFERS, assert_equal, in_one_op, one_by_one
from helpers import TOLERANCE
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box
from torch_mpm.ops.contact import MAX_OBSTACLES
from torch_mpm.rollouts import facts, fused_op

F64, DT = torch.float64, 1e-4


def swinging(t: Tensor) -> list[Tensor]:
    return [0.45 + 0.3 * torch.sin(40 * t), 0.3 + 0 * t, 0.45 + 8 * t]


def smooth(dim: int, device: str):
    return lambda t: torch.stack(swinging(t)[:dim], -1)


def branching(dim: int, device: str):
    """Path that branches on the time, so that it cannot be mapped over several times."""

    def path(t: Tensor) -> Tensor:
        return torch.stack(swinging(t)[:dim], -1) if float(t.max()) < 5e-4 else torch.stack([0.5 + 0 * t] * dim, -1)

    return path


def waypoints(dim: int, device: str):
    points = torch.tensor([[0.4, 0.3, 0.4], [0.5, 0.32, 0.45], [0.45, 0.3, 0.5]], dtype=F64, device=device)
    return mpm.Waypoints(torch.tensor([0.0, 5e-4, 8e-4], dtype=F64, device=device), points[:, :dim])


PATHS = {"smooth": smooth, "branching": branching, "waypoints": waypoints}


def turning(dim: int) -> dict[str, object]:
    return {"angular_velocity": 9.0, "rotation": 0.3} if dim == 2 else {"angular_velocity": (0.0, 9.0, 2.0)}


def bodies(dim: int, path, **options) -> list[mpm.boundaries.Obstacle]:
    """One on a path that turns, one at constant rates that comes later, one at rest, each in the way of the next."""
    away = {"velocity": (2.0, 0.0, 1.0)[:dim], "start": 3e-4, **turning(dim)}
    return [
        mpm.Box(path, (0.3, 0.2, 0.3)[:dim], "separate", friction=0.3, **turning(dim), **options),
        mpm.Sphere((0.55,) * dim, 0.12, "slip", friction=0.2, **away),
        mpm.Plane((0.0, 0.35, 0.0)[:dim], (0.1, 1.0, 0.0)[:dim], "sticky"),
    ]


@pytest.mark.parametrize(
    *in_pairs(
        path=PATHS,
        steps=[(1, F64), (2, torch.float32), (5, F64), (17, torch.float32)],
        transfer=SOME_TRANSFERS,
        dim=[2, 3],
    )
)
def test_paths(path, steps, transfer, dim, device):
    n, dtype = steps
    state = blob(device, dim, dtype=dtype)
    obstacles = bodies(dim, PATHS[path](dim, device))
    step = mpm.Step(unit_box(dim), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=obstacles, **TRANSFERS[transfer]).to(
        device
    )
    assert in_one_op(step, state)
    with torch.no_grad():
        end = mpm.rollout(step, state, n, DT)
        assert_equal(end, one_by_one(step, state, n, DT))
        step.boundaries = obstacles[1:]
        free = mpm.rollout(step, state, n, DT)
    assert float((end.v - free.v).abs().max()) > 0.1


@pytest.mark.parametrize(*in_pairs(scenes=[1, 3], n=[6, 17], dim=[2, 3]))
def test_paths_of_scenes_with_clocks_of_their_own(scenes, n, dim, device):
    state = blob(device, dim, scene=torch.arange(300, dtype=torch.int32) % scenes)
    state = state.replace(scene=state.scene.int(), time=1e-4 * torch.arange(scenes, dtype=F64, device=device))
    dt = 1e-4 * (1 + 0.1 * torch.arange(scenes, dtype=F64, device=device))
    step = mpm.Step(
        unit_box(dim, scenes=scenes), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=bodies(dim, smooth(dim, device))
    )
    with torch.no_grad():
        assert step.explain(state, dt).startswith("all steps in one op")
        assert_equal_clocks(mpm.rollout(step, state, n, dt), one_by_one(step, state, n, dt))


def assert_equal_clocks(a: mpm.State, b: mpm.State) -> None:
    assert float((a.time - b.time).abs().max()) < 1e-15
    assert_equal(a.replace(time=0.0), b.replace(time=0.0))


@pytest.mark.thorough(dim=3)
@torch.no_grad()
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("clocks", [False, True])
def test_paths_in_small_scenes(clocks, deterministic, dim, device):
    """On CUDA a thread block has each scene for all substeps, or one kernel many substeps of a scene; with parameters
    that each scene has, and clocks."""
    sizes, n = (((1, 2000), (40, 4000)), 30) if device == "cuda" else (((1, 300), (5, 500)), 8)
    for scenes, count in sizes:
        scene = (torch.arange(count, device=device) % scenes).int()
        state = blob(device, dim, count, torch.float32).replace(scene=scene)
        grid = unit_box(dim, scenes=scenes, deterministic=deterministic)
        obstacles = bodies(dim, smooth(dim, device))
        obstacles[1].velocity = torch.rand(scenes, dim, device=device)
        step = mpm.Step(grid, mpm.NeoHookean(E=1e3, nu=0.3), boundaries=obstacles)
        dt = DT
        if clocks:
            state = state.replace(time=2e-4 * torch.arange(scenes, device=device))
            dt = DT * (1 + torch.arange(scenes, device=device) / 100)
        assert step.explain(state, dt).startswith("all steps in one op")
        ends = [run(step, state, n, dt).replace(time=0.0) for run in (mpm.rollout, one_by_one)]
        assert_equal(*ends, f"{scenes} scenes")


@torch.no_grad()
@pytest.mark.cuda
def test_paths_among_many_particles():
    """G2P and the next P2G are one kernel here."""
    state = blob("cuda", 3, 2**18, torch.float32)
    step = mpm.Step(unit_box(3, 1 / 40), mpm.NeoHookean(E=1e3, nu=0.3), boundaries=bodies(3, smooth(3, "cuda")))
    assert in_one_op(step, state)
    assert_equal(mpm.rollout(step, state, 20, DT), one_by_one(step, state, 20, DT))


@torch.no_grad()
def test_paths_in_calls_of_few_steps(monkeypatch, device):
    """Where tables of all steps would take too much memory."""
    state, obstacles = blob(device), bodies(3, smooth(3, device))
    step = mpm.Step(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=obstacles)
    expected, calls, whole = one_by_one(step, state, 17, DT), [], fused_op.substeps
    monkeypatch.setattr(facts, "path_bytes", lambda *_: 2**26 // 5)
    monkeypatch.setattr(fused_op, "substeps", lambda *a: calls.append(a[2]) or whole(*a))
    assert_equal(mpm.rollout(step, state, 17, DT), expected)
    assert calls == [5, 5, 5, 2]


@torch.no_grad()
@pytest.mark.parametrize("shape", [(4,), (2, 3), (1, 1, 3), ()])
def test_a_path_of_another_shape_is_refused(shape, device):
    wrong = mpm.Sphere(lambda t: torch.zeros(shape, dtype=t.dtype, device=device) + 0 * t, 0.1)
    step = mpm.Step(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[wrong])
    with pytest.raises((ValueError, RuntimeError), match=r"position must|parameters of obstacles must"):
        mpm.rollout(step, blob(device), 3, DT)


@torch.no_grad()
def test_what_a_path_raises_is_raised(device):
    def lost(t: Tensor) -> Tensor:
        raise LookupError("no such place")

    step = mpm.Step(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[mpm.Sphere(lost, 0.1)])
    with pytest.raises(LookupError, match="no such place"):
        mpm.rollout(step, blob(device), 3, DT)


class Plain(mpm.Sphere):
    """Obstacle evaluated by torch operations, since the kernel does not know its shape."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.shape.__class__ = type("Own", (type(self.shape),), {})


@pytest.mark.thorough(dim=3)
@torch.no_grad()
@pytest.mark.parametrize("count", [17, MAX_OBSTACLES, MAX_OBSTACLES + 1])
def test_many_obstacles(count, dim, device):
    """Pegs that overlap, of all kinds."""
    generator = torch.Generator().manual_seed(6)
    places = (0.3 + 0.4 * torch.rand(count, dim, generator=generator, dtype=F64)).tolist()
    kinds = ("separate", "slip", "sticky")

    def pegs(form):
        return [form(p, 0.05, kinds[k % 3], friction=0.1 * (k % 4)) for k, p in enumerate(places)]

    state = blob(device, dim)
    step, plain = (
        mpm.Step(unit_box(dim), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=pegs(f)) for f in (mpm.Sphere, Plain)
    )
    assert in_one_op(step, state) == (count <= MAX_OBSTACLES) and not in_one_op(plain, state)
    expected = one_by_one(plain, state, 3, DT)
    assert_equal(mpm.rollout(step, state, 3, DT), expected)
    assert_equal(one_by_one(step, state, 3, DT), expected)


@torch.no_grad()
def test_a_time_is_reached_beside_a_path(device):
    state = blob(device, dtype=torch.float32)
    ends = []
    for form in (mpm.Sphere, Plain):
        obstacles = [form(waypoints(3, device), 0.15, "separate").to(device), form((0.55,) * 3, 0.12, "slip")]
        step = mpm.Step(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=obstacles)
        assert in_one_op(step, state) == (form is mpm.Sphere)
        ends.append(mpm.rollout_to(step, state, 3e-3, every=4))
    assert bool(ends[0].arrived.all())
    assert_equal(ends[0].state, ends[1].state)


@torch.no_grad()
@pytest.mark.parametrize("clocks", [False, True])
def test_a_path_is_asked_where_the_obstacle_is(clocks, device):
    """A table of a time between start and end alone; clocks of scenes are known to the device."""
    times = []

    def path(t: Tensor) -> Tensor:
        times.append(t)
        return torch.stack([0.5 + 0 * t, 0.4 + 20 * (t - 3e-4), 0.5 + 0 * t], -1)

    state = blob(device)
    state = state.replace(time=torch.zeros(1, dtype=F64, device=device)) if clocks else state
    step = mpm.Step(
        unit_box(), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[mpm.Sphere(path, 0.15, start=2.5e-4, end=7.5e-4)]
    )
    assert in_one_op(step, state)
    expected = one_by_one(step, state, 10, DT)
    times.clear()
    assert_equal(mpm.rollout(step, state, 10, DT).replace(time=0.0), expected.replace(time=0.0))
    # Once to differentiate it and once to difference it; on CUDA, where differences are not read, also in their middle.
    assert len(times) == (3 if device == "cpu" else 4)


def test_a_path_has_no_gradient_where_the_obstacle_is_not(device):
    """Beside a start at which its speed is infinite."""
    bend = torch.tensor(2.0, dtype=F64, device=device, requires_grad=True)
    path = lambda t: torch.stack([0.4 + bend * (t - 3.5e-4).sqrt(), 0.5 + 0 * t])  # noqa: E731
    step = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[mpm.Sphere(path, 0.15, start=3.5e-4)])
    state = blob(device, 2)
    ends = mpm.rollout(step, state, 8, DT, 3), one_by_one(step, state, 8, DT)
    found = [torch.autograd.grad(end.x.square().sum(), bend)[0] for end in ends]
    assert float(found[1].abs()) > 0
    torch.testing.assert_close(found[0], found[1])


@torch.no_grad()
def test_clocks_of_float32_are_those_of_single_steps(device):
    """They lose digits at late times: position, rotation and start of an obstacle use the same time."""
    state = blob(device, 2, dtype=torch.float32)
    state = state.replace(time=torch.full((1,), 8.0, device=device), v=0.01 * state.v)
    ball = mpm.Box(lambda t: torch.stack([0.3 + 20 * (t - 8), 0.5 + 0 * t], -1), (0.2, 0.3), angular_velocity=3.0)
    step = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e3, nu=0.3), boundaries=[ball])
    dt = torch.full((1,), 1e-5, device=device)
    end, expected = mpm.rollout(step, state, 200, dt), one_by_one(step, state, 200, dt)
    assert torch.equal(end.time, expected.time)
    assert float((end.v - expected.v).abs().max()) < 1e-3 * float(expected.v.abs().max())


PROGRAM = """
import sys, torch, torch_mpm as mpm
grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1))
path = lambda t: torch.stack([0.5 + t, 0.2 + 0 * t], -1)
for place in ((0.5, 0.2), path):
    step = mpm.Step(grid, mpm.Active(mpm.NeoHookean(E=1e4, nu=0.3), (1.0, 0.0)), boundaries=[mpm.Sphere(place, 0.1)])
    state = mpm.State.at_rest(mpm.seed.box((0.3, 0.3), (0.6, 0.6), grid, per_cell=4), dtype=torch.float64)
    v = state.v.clone().requires_grad_()
    for dt in (1e-4, torch.tensor(1e-4, dtype=torch.float64)):
        mpm.rollout(step, state.replace(v=v), 5, dt).x.sum().backward()
print([name for name in ("sympy", "torch._dynamo") if name in sys.modules])
"""


@pytest.mark.thorough
def test_no_compiler_is_imported():
    """The import takes two seconds; torch.broadcast_shapes and forward derivatives cause it."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ---- gradients


def leaf(*values: float, device: str) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.tensor(values if len(values) > 1 else values[0], dtype=F64, device=device))


def trained(dim: int, device: str) -> list[mpm.boundaries.Obstacle]:
    """All that an obstacle has a gradient for."""
    spin = leaf(3.0, device=device) if dim == 2 else leaf(0.5, 3.0, 1.0, device=device)
    turn = leaf(0.2, device=device) if dim == 2 else leaf(0.1, 0.2, 0.3, device=device)
    motion = {"rotation": turn, "angular_velocity": spin}
    middle, away = leaf(*(0.5, 0.45, 0.5)[:dim], device=device), leaf(*(2.0, 1.0, 0.5)[:dim], device=device)
    normal, axis = leaf(*(0.2, 1.0, 0.1)[:dim], device=device), leaf(*(0.1, 0.05, 0.02)[:dim], device=device)
    return [
        mpm.Capsule(middle, axis, 0.12, "separate", friction=leaf(0.4, device=device), velocity=away, **motion),
        mpm.Plane(leaf(*(0.5, 0.36, 0.5)[:dim], device=device), normal, "separate", friction=leaf(0.2, device=device)),
    ]


@pytest.mark.parametrize("every", [1, 3, mpm.Checkpoints(memory=1e9)], ids=str)
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_gradients_of_obstacles(every, transfer, dim, device):
    options = {"boundaries": trained(dim, device), **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(dim), mpm.NeoHookean(E=1e4, nu=0.3), **options)
    state = moving(step, blob(device, dim))
    got, expected = gradients(in_op(every, 7), step, state), gradients(single(7), step, state)
    assert sum(name.startswith("boundaries") for name in expected) == 9
    flat = "boundaries.1.position"  # along which a plane that does not turn is the same
    assert all(float(t.norm()) > 0 for k, t in expected.items() if k.startswith("boundaries") and k != flat)
    assert_same(got, expected, "rollout with FLIP" if "flip" in transfer else "")


@pytest.mark.parametrize("with_impulse", [False, True])
def test_gradients_of_obstacles_of_scenes(with_impulse, dim, device):
    """Gradients of shared parameters and of parameters per scene, also through impulses."""
    scenes = 3
    shared, own = trained(dim, device)
    own.position = torch.nn.Parameter(0.36 + 0.02 * torch.rand(scenes, dim, dtype=F64, device=device))
    shared.velocity = torch.nn.Parameter(2.0 * torch.rand(scenes, dim, dtype=F64, device=device))
    step = mpm.Step(unit_box(dim, scenes=scenes), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[shared, own])
    scene = (torch.arange(300, device=device) % scenes).int()
    state = moving(step, blob(device, dim).replace(scene=scene))
    state = step.with_impulses(state) if with_impulse else state
    assert_same(gradients(in_op(2), step, state), gradients(single(), step, state))


@pytest.mark.parametrize(*in_pairs(path=["waypoints", "function"], dim=[2, 3]))
@pytest.mark.parametrize("every", [2, mpm.Checkpoints(memory=1e9)], ids=str)
def test_gradients_of_paths(path, every, dim, device):
    """Control points as parameters of a module, and a tensor that a function reads, which no module has."""
    way = waypoints(dim, device)
    points = way.position.detach().clone().requires_grad_()
    way.position = torch.nn.Parameter(points.detach().clone())
    bend = torch.tensor(0.3, dtype=F64, device=device, requires_grad=True)
    function = lambda t: torch.stack([0.45 + bend * torch.sin(40 * t), *swinging(t)[1:dim]], -1)  # noqa: E731
    step = mpm.Step(
        unit_box(dim), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=bodies(dim, way if path == "waypoints" else function)
    )
    state, wanted = moving(step, blob(device, dim)), way.position if path == "waypoints" else bend
    found = []
    for run in (in_op(every, 9), single(9)):
        end = run(step, state)
        found.append(torch.autograd.grad((end.x * end.v).sum() + end.v.square().sum(), wanted)[0])
    assert float(found[1].norm()) > 0
    assert float((found[0] - found[1]).norm() / found[1].norm()) < TOLERANCE["rollout"][F64]


def test_the_gradient_of_a_controlled_path_is_that_of_finite_differences(device):
    """A ball that a controller moves through the particles, by what it does to them in 20 steps."""
    time = torch.linspace(0, 2e-3, 5, dtype=F64, device=device)
    points = torch.tensor([[0.4, 0.4], [0.42, 0.41], [0.45, 0.42], [0.47, 0.4], [0.5, 0.4]], dtype=F64, device=device)
    state = blob(device, 2)
    state = state.replace(v=0.1 * state.v)

    def reached(points: Tensor) -> Tensor:
        ball = mpm.Sphere(mpm.Waypoints(time, points), 0.15, "sticky")
        end = mpm.rollout(mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[ball]), state, 20, DT)
        return end.v.square().sum()

    control = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(reached(control), control)
    direction = torch.randn(points.shape, generator=torch.Generator().manual_seed(2), dtype=F64).to(device)
    step = 1e-6
    with torch.no_grad():
        change = (reached(points + step * direction) - reached(points - step * direction)) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(float(change), rel=1e-5)


def test_the_op_itself_with_tables_of_all_steps(device):
    """Fake kernel, autograd and schema."""
    step = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=bodies(2, smooth(2, device)))
    state = step.prepare(blob(device, 2, 40))
    arguments = mpm.substeps_arguments(step, state, 3, DT)
    assert list(arguments["obstacles"].shape) == [3, 1, 3, 10]
    arguments["obstacles"] = arguments["obstacles"].clone().requires_grad_()
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.torch_mpm.substeps.default, tuple(arguments.values()), test_utils=tests)
    with pytest.raises(RuntimeError, match="obstacles must be given once or for each of 4 steps"):
        torch.ops.torch_mpm.substeps(*(arguments | {"n": 4}).values())


# ---- waypoints


def test_waypoints(device):
    way = mpm.Waypoints([0.0, 1.0, 3.0], [[0.0, 0.0], [1.0, 0.0], [1.0, 4.0]]).to(device)
    times = torch.tensor([-1.0, 0.0, 0.25, 1.0, 2.0, 3.0, 9.0], dtype=F64, device=device)
    expected = [[0, 0], [0, 0], [0.25, 0], [1, 0], [1, 2], [1, 4], [1, 4]]
    assert way(times).tolist() == expected
    assert [way(t).tolist() for t in times] == expected
    speeds = [torch.func.jvp(way, (t,), (torch.ones_like(t),))[1].tolist() for t in times]
    assert speeds == [[0, 0], [1, 0], [1, 0], [0, 2], [0, 2], [0, 0], [0, 0]]


@pytest.mark.parametrize(
    "time, position, message",
    [
        ([0.0], [[0.0, 0.0]], r"shapes \[K\] and \[K, D\], K at least 2, got \[1\]"),
        ([0.0, 1.0], [[0.0, 0.0]], r"shapes \[K\] and \[K, D\].* got \[2\] and \[1, 2\]"),
        ([1.0, 0.0], [[0.0, 0.0]] * 2, "time must increase, got"),
        ([0.0, 1.0], [[0.0, 0.0], [1.0]], "position must have D numbers for each time"),
        ([0.0, 1.0], torch.full((2, 2), float("nan")), "position must be finite"),
        ([0.0, float("inf")], [[0.0, 0.0]] * 2, r"time.* must be.*finite|time must increase"),
    ],
)
def test_waypoints_that_are_none(time, position, message):
    with pytest.raises(ValueError, match=message):
        mpm.Waypoints(time, position)
