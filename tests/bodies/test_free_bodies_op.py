"""The ops of free bodies against Newton's method in torch, which differentiates the contact of the nodes."""

import math

import pytest
import torch
from cases.impulses import F64
from oracle import free_bodies as reference
from pairs import in_pairs

import torch_mpm as mpm
from torch_mpm.bodies import Body, Driven, FreeBodies, Hinge, Part, Slider
from torch_mpm.bodies.solution import Solution
from torch_mpm.ops.free_bodies import JOINTS
from torch_mpm.rollouts.plan import SCHEDULES

OPTIONS = {
    torch.float32: {"rtol": 2e-4, "atol": 2e-4},
    F64: {"rtol": 1e-10, "atol": 1e-11},
}
AT = (1.02, 1.18, 0.97)


def joint_of(name, dim):
    if name == "hinge":
        return Hinge((1.3, 1.4, 1.0)[:dim], None if dim == 2 else (0.2, 0.1, 1.0))
    return {"free": None, "slider": Slider((0.3, -1.0, 0.1)[:dim]), "driven": Driven()}[name]


def shape_of(name, dim, **options):
    if name == "box":
        return mpm.Box((0.0,) * dim, (0.4, 0.3, 0.35)[:dim], **options)
    if name == "cup":
        outline = [(0, -0.2), (0.25, -0.2), (0.25, 0.2), (0.15, 0.2), (0.15, -0.1), (0, -0.1)]
        return mpm.Revolved((0.0,) * dim, outline, **options)
    return mpm.Sphere((0.0,) * dim, 0.2, **options)


def made(
    dim, device, dtype, joint="free", shape="sphere", kind="separate", friction=0.4, scenes=1, walls=None, pool=None
):
    """A block of particles, and on it a body with the joint, of two parts, and a light free ball beside it that may
    share nodes with it; rows [B, 2, ...]."""
    grid = mpm.Grid(0.1, (0.0,) * dim, (2.0,) * dim, scenes=scenes, max_blocks=pool)
    gravity = (0.5, -9.8, 0.3)[:dim]
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), gravity, walls)
    low = (0.6, 0.6, 0.6) if walls is None else (0.0, 0.6, 0.6)
    one = mpm.State.at_rest(mpm.seed.box(low[:dim], (1.4, 1.0, 1.4)[:dim], grid, per_cell=2**dim), 1000.0, None, dtype)
    state = mpm.State.concatenate([one] * scenes, scene=True) if scenes > 1 else one
    turn = 0.3 if dim == 2 else (0.1, -0.2, 0.3)
    parts = [
        Part(shape_of(shape, dim, kind=kind, friction=friction), (0.02, 0.01, 0.0)[:dim], turn),
        mpm.Sphere((0.0,) * dim, 0.1, friction=friction),
    ]
    inertia = 0.8 if dim == 2 else (0.6, 0.8, 1.1)
    bodies = [Body(parts, 30.0, inertia, joint=joint_of(joint, dim)), Body(mpm.Sphere((0.0,) * dim, 0.15), 2.0, 0.02)]
    place = [AT, (0.68 if walls is None else 0.1, 1.1, 1.0)]
    turned = [0.2] if dim == 2 else [math.cos(0.2), 0.0, math.sin(0.2), 0.0]
    rows = torch.zeros(scenes, 2, 6 if dim == 2 else 13, dtype=F64)
    for k in range(2):
        rows[:, k, :dim] = torch.tensor(place[k][:dim], dtype=F64)
        rows[:, k, dim : dim + len(turned)] = torch.tensor(turned, dtype=F64)
    velocity = rows[..., dim + len(turned) :]
    velocity[:, 1, 1] = -1.0
    if joint in ("free", "driven"):
        velocity[:, 0, :dim] = torch.tensor((0.2, -1.0, 0.1)[:dim], dtype=F64)
        velocity[:, 0, dim:] = 0.7
    rows[:, 1, 1] += 0.03 * torch.arange(scenes)
    return FreeBodies(step, bodies), state.to(device), rows.to(device)


def compare(bodies, state, rows, n=5, wrenches=None, in_one_op=True, dt=2e-3):
    """The rows and the report of steps in one op, or by an op for each step, which equal those of the oracle."""
    wanted, expected, _ = reference.steps(bodies, state, rows, n, dt, wrenches)
    if not in_one_op:
        bodies.step.on_particles = lambda state, dt: state
    with torch.no_grad():
        end, after = bodies.advance(state, rows, n, dt, wrenches)
    bodies.check()
    for found, exact in ((after, expected), (end.v, wanted.v), (end.x, wanted.x)):
        torch.testing.assert_close(found, exact, **OPTIONS[state.x.dtype])
    return after


@pytest.mark.parametrize(
    *in_pairs(
        dtype=[torch.float32, F64],
        joint=JOINTS,
        shape=["sphere", "box", "cup"],
        in_one_op=[True, False],
        scenes=[1, 3],
        walls=[None, "slip", "mirror"],
        groups={("kind", "friction"): [("separate", 0.4), ("separate", 0.0), ("slip", 0.4), ("sticky", 0.0)]},
    )
)
def test_equals_steps_from_python(dim, device, kind, friction, dtype, joint, shape, in_one_op, scenes, walls):
    bodies, state, rows = made(dim, device, dtype, joint, shape, kind, friction, scenes, walls)
    given = torch.full((len(rows), 2, 3 if dim == 2 else 6), 0.3, dtype=F64, device=device)
    after = compare(bodies, state, rows, wrenches=given, in_one_op=in_one_op)
    moved = (after - rows).abs()[..., -3 if dim == 2 else -6 :]
    assert float(moved[:, 1].max()) > 1e-2  # the ball has met the block


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_report(dim, device, dtype):
    """Iterations of each scene alone, which may end before those of others; residuals within the tolerance."""
    bodies, state, rows = made(dim, device, dtype, scenes=2)
    rows[1, :, 1] += 0.5  # far from the material
    with torch.no_grad():
        bodies.advance(state, rows, 1, 2e-3)
    report, (*_, expected) = bodies.report, reference.steps(bodies, state, rows[:, :], 1, 2e-3)
    assert report.iterations[0] == expected[0, 0] >= 1
    assert report.iterations[1] == 0
    assert report.residual.shape == (2, 2)
    assert bool(report.converged.all())


@pytest.mark.parametrize("walls", [None, "mirror"])
@pytest.mark.parametrize(("kind", "friction"), [("separate", 0.4), ("slip", 0.4), ("sticky", 0.0)])
@pytest.mark.parametrize("shape", ["sphere", "cup"])
def test_solution_and_its_derivative(dim, device, shape, kind, friction, walls):
    """Velocities, and the derivative of the residual, at nodes that meet one surface or several."""
    bodies, state, rows = made(dim, device, F64, "free", shape, kind, friction, 1, walls)
    compared = []

    class Both(reference.InTorch):
        def _solved(self, blocks, contact):
            own, expected = Solution._solved(self, blocks, contact), super()._solved(blocks, contact)
            for found, exact in zip(own, expected, strict=True):
                torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-10)
            compared.append(float((expected[1] - torch.eye(expected[1].shape[1]).to(expected[1])).abs().max()))
            return expected

    for _ in range(5):
        bodies.step.on_grid = hook = Both(bodies, rows, 2e-3, None)
        with torch.no_grad():
            state = bodies.step(state, 2e-3)
        rows = hook.rows
    assert max(compared) > 0.1


def test_momentum_of_body_and_nodes(dim, device):
    """What the nodes lose the bodies gain, also where no iteration is allowed."""
    bodies, state, rows = made(dim, device, F64, kind="slip")
    for most in (0, 20):
        arguments = list(arguments_of(bodies, state, rows))
        arguments[8] = most
        after, end, report, *_ = torch.ops.torch_mpm.free_bodies(*arguments)
        velocity, mass = arguments[:2]
        lost = (mass[:, None] * (velocity - after)).sum(0)
        fallen = bodies.gravity_like(rows).flatten() * 2e-3
        columns = slice(3, 5) if dim == 2 else slice(7, 10)
        gained = sum(body.mass * ((end - rows)[0, k, columns] - fallen) for k, body in enumerate(bodies.bodies))
        assert float(lost.abs().max()) > 1e-2
        torch.testing.assert_close(lost, gained, rtol=0, atol=1e-12)
        assert (float(report[0, 1:].max()) > 1e-6) == (most == 0)


@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_many_scenes(dim, device, dtype):
    """Bodies of many scenes move as those of few. CUDA uses fewer threads for each of many scenes."""
    bodies, state, rows = made(dim, device, dtype, shape="box", scenes=2, walls="slip")
    _, expected = bodies.advance(state, rows, 2, 2e-3)
    times = 128
    bodies, state, _ = made(dim, device, dtype, shape="box", scenes=2 * times, walls="slip")
    _, after = bodies.advance(state, rows.repeat(times, 1, 1), 2, 2e-3)
    bodies.check()
    torch.testing.assert_close(after, expected.repeat(times, 1, 1), **OPTIONS[dtype])


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_large_pool(device, dtype):
    """A scene for which CUDA has the most threads."""
    compare(*made(3, device, dtype, shape="box", kind="slip", walls="slip", pool=300))


@pytest.mark.parametrize("kind", ["slip", "sticky"])
def test_a_body_around_all_of_the_material(dim, device, kind):
    """All nodes are in contact, more than the kernel on CUDA stores the surfaces of."""
    bodies, state, rows = made(dim, device, F64)
    around = Body(mpm.Sphere((0.0,) * dim, 1.5, kind, friction=0.2), 100.0, 5.0)
    bodies = FreeBodies(bodies.step, [around, bodies.bodies[1]])
    compare(bodies, state, rows, n=3)


@pytest.mark.parametrize("count", [7, 14])
def test_many_bodies(count, device):
    """Numbers of a scene that shared memory on CUDA has no room for: sums of several warps, and any."""
    grid = mpm.Grid(0.1, (0.0,) * 3, (2.0, 1.6, 1.0))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), (0.0, -9.8, 0.0))
    points = mpm.seed.box((0.3, 0.4, 0.3), (1.7, 0.7, 0.7), grid, per_cell=8)
    state = mpm.State.at_rest(points, 1000.0, None, F64, device)
    balls = [Body(mpm.Sphere((0.0,) * 3, 0.08, friction=0.3), 2.0 + k, 0.01 + 0.002 * k) for k in range(count)]
    rows = torch.zeros(1, count, 13, dtype=F64)
    k = torch.arange(count)
    rows[0, :, 0], rows[0, :, 1], rows[0, :, 2] = 0.4 + 0.19 * (k % 7), 0.77, 0.4 + 0.2 * (k // 7)
    rows[..., 3], rows[..., 8], rows[..., 10] = 1.0, -1.0, 0.5
    after = compare(FreeBodies(step, balls), state, rows.to(device), n=2)
    assert float((after - rows.to(device))[..., 7:].abs().amax(2).min()) > 1e-3  # all have met the block


@torch.no_grad()
def test_results_do_not_depend_on_the_number_of_threads():
    """Nor do those of a second call, bit by bit."""
    arguments = arguments_of(*made(3, "cpu", torch.float32, scenes=3))
    results = []
    for threads in (1, 2, 2):
        torch.set_num_threads(threads)
        results.append(torch.ops.torch_mpm.free_bodies(*arguments))
    for others in results[1:]:
        for found, expected in zip(others, results[0], strict=True):
            assert torch.equal(found, expected)


def arguments_of(bodies, state, rows, dt=2e-3):
    """Arguments of the op in a step from a state."""
    seen = []

    def hook(blocks, velocity, mass, dt):
        seen.append((blocks, velocity, mass))
        return velocity

    bodies.step.on_grid = hook
    with torch.no_grad():
        bodies.step(state, dt)
    bodies.step.on_grid = None
    blocks, velocity, mass = seen[0]
    return (velocity.contiguous(), mass, *bodies.given(velocity, rows, None), dt, True, *blocks.packed, [], [])


def test_op(dim, device):
    bodies, state, rows = made(dim, device, F64)
    torch.library.opcheck(torch.ops.torch_mpm.free_bodies, arguments_of(bodies, state, rows))


@pytest.mark.parametrize(
    ("place", "change", "error"),
    [
        (1, lambda mass: mass[1:], "mass must have shape"),
        (1, lambda mass: mass.float(), "mass must be float64"),
        (2, lambda bodies: bodies[:5], "bodies must be rows, obstacles"),
        (2, lambda bodies: [bodies[0][:, :1], *bodies[1:]], "rows of bodies must have shape"),
        (2, lambda bodies: [bodies[0].float(), *bodies[1:]], "rows of bodies must be float64"),
        (2, lambda bodies: [*bodies[:3], bodies[3][:, 1:], *bodies[4:]], "constants of bodies must have shape"),
        (2, lambda bodies: [*bodies[:5], bodies[5].new_zeros(2, 2)], "gravity of bodies must have shape"),
        (2, lambda bodies: [*bodies, bodies[0]], "wrenches of bodies must have shape"),
        (6, lambda owner: [0, 0, 2], "body_owner must be below 2"),
        (6, lambda owner: owner[1:], "body_owner must have an entry per obstacle"),
        (7, lambda joint: [0, 4], "body_joint must be 0 to 3"),
        (7, lambda joint: [], "body_joint must have an entry per body"),
        (8, lambda most: -1, "max_iterations must be 0 to 1000"),
        (9, lambda tolerance: 0.0, "tolerance must be positive"),
        (10, lambda dt: -1.0, "dt must be positive"),
    ],
)
def test_wrong_arguments_of_the_op(place, change, error, device):
    arguments = list(arguments_of(*made(2, device, F64)))
    arguments[place] = change(arguments[place])
    with pytest.raises(RuntimeError, match=error):
        torch.ops.torch_mpm.free_bodies(*arguments)


def test_the_op_has_no_derivative(device):
    arguments = list(arguments_of(*made(2, device, F64)))
    arguments[0] = arguments[0].clone().requires_grad_()
    after, *_ = torch.ops.torch_mpm.free_bodies(*arguments)
    with pytest.raises(NotImplementedError, match="has no derivative"):
        after.sum().backward()


# ---- many steps in one op


CASES = {
    "plain": {},
    "flip": {"flip": 0.9},
    "cubic": {"kernel": "cubic"},
    "deterministic": {"deterministic": True},
    "impulses": {},
    "heat": {},
}


def step_of(device, dtype, case="plain"):
    """A step with an obstacle and a block that falls on it, with a body on top; 2-D."""
    options = CASES[case]
    grid = mpm.Grid(0.1, (0.0, 0.0), (2.0, 2.0), **({} if case == "flip" else options))
    floor = mpm.Box((1.0, 0.3), (1.6, 0.4), friction=0.3)
    heat = mpm.Heat(grid, 1.0, 100.0) if case == "heat" else None
    flip = options if case == "flip" else {}
    law = mpm.NeoHookean(E=1e4, nu=0.3)
    step = mpm.Step(grid, law, (0.0, -9.8), "slip", boundaries=[floor], heat=heat, **flip)
    points = mpm.seed.box((0.6, 0.52), (1.4, 1.0), grid, per_cell=4)
    state = mpm.State.at_rest(points, 1000.0, (0.0, -1.0), dtype, device)
    if case == "impulses":
        state = step.with_impulses(state)
    if case == "heat":
        state = state.replace(temperature=300 + 50 * state.x[:, 0])
    body = Body(mpm.Sphere((0, 0), 0.2, friction=0.3), 20.0, 0.4)
    rows = torch.tensor([[[1.05, 1.21, 0.0, 0.3, -1.0, 1.0]]], dtype=F64, device=device)
    return FreeBodies(step, [body]), state, rows


@torch.no_grad()
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("schedule", ["per_step", "sorted_cpu"])
def test_schedules(case, schedule, device):
    """With obstacles, and activations that last, for each schedule as by an op for each step."""
    if device == "cuda" and schedule == "sorted_cpu":
        pytest.skip("a schedule of the CPU")
    bodies, state, rows = step_of(device, F64, case)
    number = SCHEDULES.index(schedule)
    now, _, (tensors, others) = first_of(bodies, state, rows)
    given = dict(mpm.substeps_arguments(bodies.step, bodies.step.prepare(state), 24, 1e-3), schedule=number)
    *results, after, report = torch.ops.torch_mpm.substeps_with_bodies([now, *tensors], *others, *given.values())
    assert torch.ops.torch_mpm.latest_schedule(state.x) == number
    bodies.step.on_particles = lambda state, dt: state
    end, expected = bodies.advance(state, rows, 24, 1e-3)
    torch.testing.assert_close(after, expected, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(results[0], end.x, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(results[7], end.impulse, rtol=1e-9, atol=1e-9)
    if case == "heat":
        torch.testing.assert_close(results[10][:, 0], end.temperature, rtol=1e-9, atol=0)
    assert float(report[:, 1:].max()) <= 1e-12


def first_of(bodies, state, rows):
    (now, *tensors), *others = bodies.given(state.x, rows, None)
    return now, now.new_zeros(1, 2), (tensors, tuple(others))


@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_parts_of_a_rollout_and_clocks(dtype, device):
    """Many calls of the op, and scenes with times of their own."""
    bodies, state, rows = step_of(device, dtype)
    _, at_once = bodies.advance(state, rows, 90, 5e-4)
    bodies, state, rows = step_of(device, dtype)
    for n in (1, 30, 59):
        state, rows = bodies.advance(state, rows, n, 5e-4)
    torch.testing.assert_close(rows, at_once, **OPTIONS[dtype])
    bodies, state, rows = step_of(device, dtype)
    state = state.replace(time=torch.zeros(1, dtype=F64, device=device))
    torch.testing.assert_close(bodies.advance(state, rows, 90, 5e-4)[1], at_once, **OPTIONS[dtype])


@torch.no_grad()
def test_many_steps_conserve_momentum(dim, device):
    """In one op, linear momentum of the material and both bodies to rounding; gravity and joints act on neither."""
    bodies, state, rows = made(dim, device, F64, joint="free", kind="slip")
    bodies.step.gravity = None
    place = 3 if dim == 2 else 7

    def momentum(state, rows):
        of_bodies = sum(body.mass * rows[0, k, place : place + dim] for k, body in enumerate(bodies.bodies))
        return (state.mass[:, None] * state.v).sum(0) + of_bodies

    state = bodies.step.prepare(state)
    end, after = bodies.advance(state, rows, 40, 1e-3)
    bodies.check()
    assert float((after - rows)[..., place:].abs().max()) > 0.1
    torch.testing.assert_close(
        momentum(end, after), momentum(state, rows), rtol=0, atol=1e-12 * float(state.mass.sum())
    )


def test_the_op_of_many_steps_refuses_gradients(device):
    bodies, state, rows = step_of(device, F64)
    now, _, (tensors, others) = first_of(bodies, state, rows)
    given = mpm.substeps_arguments(bodies.step, state, 2, 1e-3)
    op = torch.ops.torch_mpm.substeps_with_bodies
    with pytest.raises(RuntimeError, match="bodies are computed without gradients"):
        op([now, *tensors], *others, *dict(given, resident=False).values())
    end = op([now, *tensors], *others, *dict(given, v=state.v.clone().requires_grad_()).values())
    with pytest.raises(NotImplementedError, match="have no derivative"):
        end[0].sum().backward()


def test_the_op_of_many_steps(device):
    bodies, state, rows = step_of(device, F64)
    now, _, (tensors, others) = first_of(bodies, state, rows)
    given = mpm.substeps_arguments(bodies.step, state, 2, 1e-3)
    torch.library.opcheck(torch.ops.torch_mpm.substeps_with_bodies, ([now, *tensors], *others, *given.values()))
