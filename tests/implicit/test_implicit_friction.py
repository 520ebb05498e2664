"""Coulomb friction in implicit steps: against the block on a slope, explicit steps, and differences of steps."""

import math

import pytest
import torch
from helpers import relative_error
from pairs import in_pairs

import torch_mpm as mpm
from torch_mpm.implicit import Implicit

G = 9.8


def block(dim, device="cpu", dtype=torch.float64, scenes=1, lower=0.0):
    """A block of 4 x 2 (x 2) cells that touches y = lower."""
    grid = mpm.Grid(0.125, (0,) * dim, (4.0,) + (1.5,) * (dim - 1), scenes=scenes)
    ends = (0.5, lower) + (0.5,) * (dim - 2), (1.0, lower + 0.25) + (0.75,) * (dim - 2)
    points = mpm.seed.box(*ends, grid, per_cell=2**dim)
    return grid, mpm.State.at_rest(points, density=1000.0, dtype=dtype, device=device)


def floor(dim, friction, kind="separate"):
    return mpm.Walls(("open", (kind, "open"), "open")[:dim], friction=(0.0, (friction, 0.0), 0.0)[:dim])


def slope_gravity(angle, dim):
    return (G * math.sin(angle), -G * math.cos(angle), 0.0)[:dim]


def mean_speed(state, axis=0):
    return float((state.mass * state.v[:, axis]).sum() / state.mass.sum())


def run(step, state, n, dt):
    for _ in range(n):
        state = step(state, dt)
        assert bool(step.solve_report.converged.all()), step.solve_report
    return state


SLOPES = [
    (2, "wall", torch.float32, "mls"),
    (2, "wall", torch.float64, "gradient"),
    (2, "obstacle", torch.float64, "mls"),
    (2, "slip", torch.float64, "mls"),
    (3, "obstacle", torch.float32, "gradient"),
    (3, "wall", torch.float64, "mls"),
]


@pytest.mark.parametrize(("dim", "boundary", "dtype", "stress_form"), SLOPES)
def test_block_on_a_slope(dim, boundary, dtype, stress_form, device):
    """tan α > μ slides with g (sin α − μ cos α); else the block comes to rest, and stays there."""
    angle, E = 0.4, 1e6
    lower = 0.0 if boundary == "wall" else 0.25
    grid, start = block(dim, device, dtype, lower=lower)
    for friction in (0.2, 0.6):
        step = mpm.Step(
            grid,
            mpm.NeoHookean(E=E, nu=0.3),
            slope_gravity(angle, dim),
            stress_form=stress_form,
            integrator=Implicit(1e-6 if dtype == torch.float64 else 1e-4),
        )
        if boundary == "wall":
            step.walls = floor(dim, friction)
        else:
            kind = "slip" if boundary == "slip" else "separate"
            up = (0.0, 1.0, 0.0)[:dim]
            step.boundaries = [mpm.Plane((0.0, lower, 0.0)[:dim], up, kind, friction=friction)]
        state = run(step, start, 6, 2e-2)
        if friction < math.tan(angle):
            expected = G * (math.sin(angle) - friction * math.cos(angle)) * 0.12
            assert abs(mean_speed(state) / expected - 1) < 0.01
        else:
            nodes = {}
            step.on_grid = lambda blocks, v, m, dt, nodes=nodes: nodes.update(blocks=blocks, v=v, m=m) or v
            settled = run(step, state, 4, 2e-2)
            touching = (nodes["blocks"].node_positions(dtype)[:, 1] <= lower + 1e-6) & (nodes["m"] > 0)
            assert bool(touching.any()) and bool((nodes["v"][touching, 0] == 0).all())  # no creep at all
            assert float((settled.x - state.x)[:, 0].mean().abs()) < 2e-5


def test_explicit_steps_agree(device):
    """A block that slows down on a rough, tilted plane: what the plane took of its momentum along it."""
    grid, start = block(2, device, lower=0.25)
    start = start.replace(v=start.v + torch.tensor((1.0, 0.1), dtype=torch.float64, device=device))
    plane = mpm.Plane((0.5, 0.25), (-0.1, 1.0), friction=0.3)
    lost = []
    for integrator, n in (("explicit", 400), (Implicit(1e-6), 40)):
        law = mpm.NeoHookean(E=1e5, nu=0.3)
        step = mpm.Step(grid, law, (0, -G), boundaries=[plane], integrator=integrator)
        lost.append(float((momentum(start) - momentum(mpm.rollout(step, start, n, 0.1 / n)))[0]))
    assert abs(lost[1] / lost[0] - 1) < 0.1 and lost[0] > 0.2 * float(start.mass.sum() * G * 0.1)


def momentum(state):
    return (state.mass[:, None] * state.v).sum(0)


def test_friction_in_a_short_step_is_that_of_an_explicit_one(dim, device):
    """To second order in dt."""
    grid, state = block(dim, device)
    state = state.replace(v=state.v + torch.tensor((1.0, -0.5, 0.4)[:dim], dtype=torch.float64, device=device))
    differences = []
    for dt in (2e-5, 1e-5):
        ends = [
            mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), walls=floor(dim, 0.3), integrator=integrator)(state, dt).v
            for integrator in ("explicit", Implicit(1e-10))
        ]
        differences.append(float((ends[0] - ends[1]).norm()))
        assert differences[-1] < 0.05 * float((ends[0] - state.v).norm())
    assert 1.9 < differences[0] / differences[1] < 4.4


@pytest.mark.thorough(dim=3)
def test_a_belt_takes_the_block_along(dim, device):
    """A moving surface gives μ g until the block has its velocity."""
    grid, start = block(dim, device, lower=0.25)
    belt = mpm.Plane((0.0, 0.25, 0.0)[:dim], (0, 1, 0)[:dim], friction=0.3, velocity=(0.3, 0.0, 0.4)[:dim])
    step = mpm.Step(grid, mpm.NeoHookean(E=1e6, nu=0.3), (0, -G, 0)[:dim], boundaries=[belt], integrator=Implicit(1e-6))
    speed = 0.3 if dim == 2 else 0.5
    state = run(step, start, 4, 1e-2)
    along = torch.tensor((0.3, 0.0, 0.4)[:dim], dtype=torch.float64, device=device) / speed
    gained = float((momentum(state) / state.mass.sum()) @ along)
    assert abs(gained / (0.3 * G * 0.04) - 1) < 0.05
    state = run(step, state, 8, 4e-2)
    assert abs(float((momentum(state) / state.mass.sum()) @ along) / speed - 1) < 0.01


def test_each_scene_has_its_own_friction(device):
    grid, one = block(2, device, scenes=3, lower=0.25)
    friction = torch.tensor([0.0, 0.2, 0.6], dtype=torch.float64, device=device)
    together = mpm.State.concatenate(
        [one.replace(scene=torch.full((len(one),), b, dtype=torch.int32, device=device)) for b in range(3)]
    )
    plane = mpm.Plane((0.0, 0.25), (0.0, 1.0), friction=friction)
    step = mpm.Step(
        grid,
        mpm.NeoHookean(E=1e6, nu=0.3),
        slope_gravity(0.4, 2),
        boundaries=[plane],
        integrator=Implicit(1e-8),
    )
    state = run(step, together, 3, 2e-2)
    for b in range(3):
        own = mpm.Step(
            mpm.Grid(grid.dx, grid.lower, grid.upper),
            mpm.NeoHookean(E=1e6, nu=0.3),
            slope_gravity(0.4, 2),
            boundaries=[mpm.Plane((0.0, 0.25), (0.0, 1.0), friction=float(friction[b]))],
            integrator=Implicit(1e-8),
        )
        assert relative_error(state.x[together.scene == b], run(own, one, 3, 2e-2).x) < 1e-8


def test_a_corner_rubs_on_both_walls(device):
    """Pressed into an edge of two walls by equal forces and pulled along it: friction of both."""
    grid = mpm.Grid(0.125, (0.0,) * 3, (1.0, 1.0, 2.0))
    points = mpm.seed.box((0.0, 0.0, 0.5), (0.25, 0.25, 1.0), grid, per_cell=8)
    state = mpm.State.at_rest(points, density=1000.0, dtype=torch.float64, device=device)
    walls = mpm.Walls((("separate", "open"), ("separate", "open"), "open"), friction=((0.2, 0.0), (0.3, 0.0), 0.0))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e6, nu=0.0), (-G, -G, G), walls, integrator=Implicit(1e-6))
    state = run(step, state, 4, 2e-2)
    assert abs(mean_speed(state, 2) / (G * (1 - 0.5) * 0.08) - 1) < 0.01


def sliding(dim, device, friction, mu, v):
    grid, state = block(dim, device, lower=0.25)
    plane = mpm.Plane((0.0, 0.25, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim], friction=friction)
    law = mpm.NeoHookean(mu=mu, lam=2e5)
    integrator = Implicit(1e-11, max_iterations=100, adjoint_tolerance=1e-11)
    step = mpm.Step(grid, law, slope_gravity(0.4, dim), boundaries=[plane], integrator=integrator)
    end = run(step, state.replace(v=v), 1, 5e-3)
    weights = torch.sin(torch.arange(len(state), device=device, dtype=torch.float64))[:, None]
    return (weights * end.v).sum() + end.v.square().sum()


@pytest.mark.parametrize("slides", [True, False])
def test_gradients_with_friction(dim, slides, device):
    """Gradients by stiffness, velocities and coefficient against differences; none by the latter for sticking nodes."""
    _, state = block(dim, device, lower=0.25)
    torch.manual_seed(0)
    v = 0.02 * torch.randn(len(state), dim, dtype=torch.float64).to(device)
    v[:, 0] += 1.0 if slides else 0.0
    v[:, 1] -= 0.1
    values = [
        torch.tensor(0.3 if slides else 3.0, dtype=torch.float64, device=device),
        torch.tensor(4e5, dtype=torch.float64, device=device),
        v,
    ]
    leaves = [t.clone().requires_grad_() for t in values]
    grads = torch.autograd.grad(sliding(dim, device, *leaves), leaves)
    for k, grad in enumerate(grads):
        direction = torch.randn_like(values[k]) * values[k].abs().mean()
        h, ends = 1e-6, []
        for sign in (1, -1):
            moved = [t + sign * h * direction if i == k else t for i, t in enumerate(values)]
            with torch.no_grad():
                ends.append(sliding(dim, device, *moved))
        difference = (ends[0] - ends[1]) / (2 * h)
        if not slides and k == 0:
            assert float(grad.abs()) == 0 and float(difference.abs()) < 1e-8
        else:
            assert relative_error((grad * direction).sum(), difference) < 1e-5, k


def test_gradients_with_friction_in_float32(dim, device, one_thread):
    """Against float64, for a block so stiff that rounding leaves a residual above the tolerance."""
    grads = []
    for dtype in (torch.float64, torch.float32):
        grid, state = block(dim, device, dtype, lower=0.25)
        friction = torch.tensor(0.3, dtype=dtype, device=device, requires_grad=True)
        plane = mpm.Plane((0.0, 0.25, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim], friction=friction)
        integrator = Implicit(1e-9 if dtype == torch.float64 else 1e-4, max_iterations=100)
        law = mpm.NeoHookean(E=1e7, nu=0.3)
        step = mpm.Step(grid, law, slope_gravity(0.4, dim), boundaries=[plane], integrator=integrator)
        end = run(step, state.replace(v=state.v + torch.tensor([1.0, -0.3, 0.2][:dim]).to(state.v)), 1, 2e-2)
        grads += torch.autograd.grad(end.v.square().sum(), friction)
        assert step.integrator.adjoint_converged.tolist() == [True]
    assert relative_error(*grads) < 5e-3


def test_a_bad_scene_leaves_the_others_alone(device):
    grid, one = block(2, device, scenes=2)
    scenes = [one.replace(scene=torch.full((len(one),), b, dtype=torch.int32, device=device)) for b in range(2)]
    together = mpm.State.concatenate(scenes)
    step = mpm.Step(
        grid, mpm.NeoHookean(E=1e6, nu=0.3), slope_gravity(0.4, 2), floor(2, 0.3), integrator=Implicit(1e-8)
    )
    good = step(together, 1e-2)
    v = together.v.clone()
    v[len(one) + 3] = torch.nan
    bad = step(together.replace(v=v), 1e-2)
    assert step.solve_report.converged.tolist() == [True, False]
    # On CUDA sums of atomics differ by rounding, and with them the solve within its tolerance.
    torch.testing.assert_close(bad.x[: len(one)], good.x[: len(one)], rtol=0, atol=1e-9 if device == "cuda" else 0)


@pytest.mark.parametrize("count", [0, 1])
def test_no_particle_and_one(count, dim, device):
    grid, state = block(dim, device)
    state = state.replace(**{n: getattr(state, n)[:count] for n in ("x", "v", "mass", "volume")})
    step = mpm.Step(
        grid, mpm.NeoHookean(E=1e5, nu=0.3), slope_gravity(0.4, dim), floor(dim, 0.3), integrator=Implicit(1e-6)
    )
    after = step(state, 0.1)
    assert len(after) == count and bool(step.solve_report.converged.all()) and bool(after.x.isfinite().all())


def oblique(shape, angle, friction, dim, kind, device, dtype):
    """A grid, a block on a slope that is inclined against the lattice by an angle, between the nodes, the obstacle that
    is the slope, and the direction down it."""
    dx, place = 0.1, torch.tensor([0.011, 0.037, 0.0][:dim])
    along = torch.tensor([math.cos(angle), -math.sin(angle), 0.0][:dim])
    up = torch.tensor([math.sin(angle), math.cos(angle), 0.0][:dim])
    grid = mpm.Grid(dx, (-0.3, -0.8, 0.0)[:dim], (1.3, 0.8, 0.6)[:dim])
    points = mpm.seed.box((0.0, 0.0, 0.2)[:dim], (0.6, 0.2, 0.4)[:dim], grid, per_cell=2**dim)
    x = points.x[:, :1] * along + points.x[:, 1:2] * up + place
    if dim == 3:
        x[:, 2] = points.x[:, 2]
    state = mpm.State.at_rest(mpm.seed.Points(x, points.volume, None), 1000.0, dtype=dtype, device=device)
    middle = place + 0.3 * along
    rest = {"kind": kind, "friction": friction}
    if shape == "plane":
        return grid, state, mpm.Plane(place.tolist(), up.tolist(), **rest), along
    if shape == "sphere":
        return grid, state, mpm.Sphere((middle - 20 * up).tolist(), 20.0, **rest), along
    turn = -angle if dim == 2 else (0.0, 0.0, -angle)
    box = mpm.Box((middle - 0.4 * up).tolist(), (3.0, 0.8, 3.0)[:dim], rotation=turn, **rest)
    return grid, state, box, along


OBLIQUE = [
    *((shape, kind, 2, torch.float64) for shape in ("plane", "box", "sphere") for kind in ("separate", "slip")),
    ("plane", "separate", 2, torch.float32),
    ("plane", "separate", 3, torch.float64),
]


@pytest.mark.parametrize(
    *in_pairs({("shape", "kind", "shape_dim", "dtype"): OBLIQUE}, friction=[0.1, 0.27], degrees=[17, 24, 45])
)
def test_a_block_slides_down_a_slope_that_is_oblique_to_the_lattice(
    shape, kind, shape_dim, dtype, degrees, friction, device
):
    """Every step converges, in as few iterations as on the axes of the lattice, and the block has a speed of
    g (sin α − μ cos α) t, but for its elastic settling."""
    angle, n, dt = math.radians(degrees), 5 if shape_dim == 2 else 3, 0.02
    grid, state, slope, along = oblique(shape, angle, friction, shape_dim, kind, device, dtype)
    gravity = (0.0, -G, 0.0)[:shape_dim]
    step = mpm.Step(grid, mpm.NeoHookean(E=1e6, nu=0.3), gravity, boundaries=[slope], integrator=Implicit(1e-4))
    speeds = []
    for _ in range(n):
        state = step(state, dt)
        assert bool(step.solve_report.converged.all()) and int(step.solve_report.iterations) <= 6, step.solve_report
        speeds.append(float((momentum(state) / state.mass.sum()).cpu().double() @ along.double()))
    expected = G * (math.sin(angle) - friction * math.cos(angle)) * n * dt
    assert abs(speeds[-1] - expected) < 0.08 * G * math.sin(angle) * n * dt
    assert abs(speeds[-1] - speeds[0] - (1 - 1 / n) * expected) < 0.03 * G * math.sin(angle) * n * dt


@pytest.mark.parametrize(("degrees", "slope_dim"), [(10, 2), (24, 2), (38, 2), (24, 3)])
def test_a_block_sticks_to_a_slope_that_is_oblique_to_the_lattice(degrees, slope_dim, device):
    """Nodes held along and normal to the surface have a velocity of exactly zero."""
    dim = slope_dim
    grid, state, slope, _ = oblique("plane", math.radians(degrees), 2.0, dim, "separate", device, torch.float64)
    nodes = {}
    step = mpm.Step(
        grid,
        mpm.NeoHookean(E=1e6, nu=0.3),
        (0.0, -G, 0.0)[:dim],
        boundaries=[slope],
        integrator=Implicit(1e-4),
        on_grid=lambda blocks, v, m, dt: nodes.update(blocks=blocks, v=v, m=m) or v,
    )
    run(step, state, 3, 2e-2)
    inside = slope.contains(nodes["blocks"].node_positions(torch.float64), None, 0.0) & (nodes["m"] > 0)
    assert float((nodes["v"][inside] == 0).all(1).double().mean()) > 0.5
