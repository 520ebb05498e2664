"""One heat step as a linear map: it never grows, it diffuses at once as later, and a paused scene stays as it is."""

import dataclasses
import functools
import math

import pytest
import torch
from cases.heat import FLOAT, block, grid_around, random_like
from helpers import relative_error

import torch_mpm as mpm
from benchmarks import common, report
from benchmarks.catalogue import scenes
from benchmarks.stability import heat_step
from benchmarks.stability.heat_step import LIMIT, TRANSFERS, Case, matrix, measure
from torch_mpm.heat.boundaries import Convection, Fixed, FixedSurface, FreeSurface, Source

# ---- growth

JUMPS = (
    Case(2, "quadratic", "lattice", 4, "hybrid", 0.2, 1e2),
    Case(2, "quadratic", "random", 4, "hybrid", 0.05, 1e4, "capacity"),
    Case(2, "cubic", "poisson", 4, "hybrid", 1e6, 1e8, at="random", boundary="held"),
    Case(2, "quadratic", "lattice", 1, "hybrid", 1e-3, 1e8, "capacity", "random", "exchange"),
    Case(3, "quadratic", "random", 1, "hybrid", 1.0, 1e2),
)


@pytest.mark.parametrize("transfer", TRANSFERS)
@pytest.mark.parametrize("case", JUMPS, ids=lambda case: f"{case.dim}-{case.layout}-{case.jump}-{case.contrast:g}")
def test_no_jump_makes_a_step_grow(case, transfer):
    """Neither the largest eigenvalue nor the norm with the energy exceeds 1; and the map is symmetric, as is proven."""
    case = dataclasses.replace(case, transfer=transfer)
    found = measure(case)
    assert found["radius"] < LIMIT and found["norm"] < LIMIT
    A = matrix(case)
    assert float((A - A.T).abs().max()) < 1e-12


@pytest.mark.thorough
def test_table_of_the_benchmark():
    """Its quick form has every variant, and its tables have the results of the cases."""
    chosen = list(heat_step.cases(quick=True))
    variants = {(case.jump, case.at, case.boundary) for case in chosen}
    assert len(variants) == 12 and {case.transfer for case in chosen} == set(TRANSFERS)
    rows = [measure(case) for case in chosen]
    assert max(heat_step.excess(row) for row in rows) < LIMIT
    found = {"environment": common.environment(), **heat_step.summary(rows)}
    assert heat_step.text(found).count("< 1e-12") == 24 and "100 cases" in report.heat_step(found)
    rows[7]["radius"] = 0.07
    assert "7.0e-02" in report.heat_step({**found, **heat_step.summary(rows)})


def test_matrix_is_the_step():
    """The benchmark's solve against that of the library."""
    case = Case(2, "quadratic", "random", 4, "hybrid", 0.3, 1e2)
    kind = functools.partial(mpm.Heat, tolerance=1e-12)
    torch.testing.assert_close(matrix(case, kind), matrix(case), rtol=0, atol=1e-9)


@pytest.mark.parametrize("boundary", [None, Fixed, FixedSurface])
@pytest.mark.parametrize("jump", ["conductivity", "capacity"])
def test_heat_at_a_jump_does_not_grow(device, boundary, jump):
    """300 steps with r = 0.2 over a jump by 100, insulated and beside a held plane: temperatures keep their range."""
    state = block(2, device, n=4)
    state = state.replace(temperature=random_like(state.mass))
    share = torch.where(state.x[:, 0] < state.x[:, 0].mean(), 1.0, 0.01).to(FLOAT)
    kappa, capacity = (share, 1.0) if jump == "conductivity" else (1.0, share)
    held = [boundary(mpm.Plane((0.2, 0.2), (1.0, 0.0)), 0.5)] if boundary else []
    heat = mpm.Heat(grid_around(2, 4), kappa, capacity, held)
    dt = 0.2 * heat.grid.dx**2 * 2.0 * (0.01 if jump == "capacity" else 1.0)
    with torch.no_grad():
        end = mpm.rollout(heat, state, 300, dt)
    heat.check()
    assert -0.1 < float(end.temperature.min()) and float(end.temperature.max()) < 1.1


def two_materials(n, contrast, r, transfer="hybrid", time=0.02):
    """RMS error of the slowest mode of an insulated bar whose right half conducts better, against implicit Euler."""

    def flux(w):  # of cos wx from the left, and of A cos v(1 − x) with v = w/√contrast from the right
        v = w / math.sqrt(contrast)
        return w * math.sin(w / 2) * math.cos(v / 2) + contrast * v * math.sin(v / 2) * math.cos(w / 2)

    low, high = math.pi, 2 * math.pi
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if flux(middle) > 0 else (low, middle)
    w, v, dx = low, low / math.sqrt(contrast), 1 / n
    bar = scenes.block((0, 0), (1, 2 * dx), dx, density=1.0)
    x = bar.x[:, 0].clone()
    left, scale = x < 0.5, math.cos(w / 2) / math.cos(v / 2)
    theta = torch.where(left, torch.cos(w * x), scale * torch.cos(v * (1 - x)))
    steps = round(time * contrast * n * n / r)
    heat = mpm.Heat(
        mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5)), torch.where(left, 1.0, contrast), 1.0, transfer=transfer,
    )  # fmt: skip
    with torch.no_grad():
        end = mpm.rollout(heat, bar.replace(x=bar.x + 0.37 * dx, temperature=theta), steps, time / steps)
    return relative_error(end.temperature, (1 + w * w * time / steps) ** -steps * theta)


def test_mode_of_two_materials():
    """The bend at the interface costs an order, to all transfers alike; the hybrid does not add to it."""
    coarse, fine = (two_materials(n, 10.0, 0.1) for n in (8, 16))
    assert fine < 0.6 * coarse and fine < 0.06
    assert fine < 0.5 * two_materials(16, 10.0, 0.1, "apic")


# ---- first steps


def cosine(n=16, kernel="quadratic", jitter=0.0, dtype=FLOAT):
    """cos πx cos πy in a square, with its gradient beside it, and Heat for it."""
    state = block(n=n, density=1.0, jitter=jitter)
    x = math.pi * (state.x - 0.37 / n)
    theta = torch.cos(x).prod(1)
    slope = -math.pi * torch.stack([torch.sin(x[:, a]) * torch.cos(x[:, 1 - a]) for a in (0, 1)], 1)
    return state.replace(temperature=theta).to(dtype=dtype), slope.to(dtype), grid_around(n=n, kernel=kernel)


@pytest.mark.parametrize("jitter", [0.0, 0.4])
def test_first_steps_conduct_as_later_ones(kernel, jitter):
    """200 steps with r = 1e-5 change a field without a gradient by what they change it with the exact one."""
    state, slope, grid = cosine(kernel=kernel, jitter=jitter)
    heat = mpm.Heat(grid, 1.0, 1.0, tolerance=1e-10)
    given = state.replace(extra={"temperature_gradient": slope})
    with torch.no_grad():
        change, expected = (mpm.rollout(heat, s, 200, 1e-5 / 16**2).temperature - s.temperature for s in (state, given))
    assert relative_error(change, expected) < 0.05


@pytest.mark.parametrize("transfer", ["hybrid", "apic"])
def test_gradient_starts_from_the_grid(device, dim, transfer):
    """Gradient of a linear temperature, also at the surface; equal in a batch, alone, sorted and in a step."""
    state = block(dim, device, n=8 if dim == 2 else 4)
    slope = torch.tensor([1.0, -2.0, 0.5][:dim], dtype=FLOAT, device=device)
    state = state.replace(temperature=3 + state.x @ slope)
    grid = grid_around(dim, 8 if dim == 2 else 4)
    heat = mpm.Heat(grid, 1.0, 1.0, transfer=transfer)
    gradient = heat.prepare(state).extra["temperature_gradient"]
    expected = slope.expand_as(gradient)
    middle = ((state.x - state.x.mean(0)).abs() < 0.25).all(1)
    assert relative_error(gradient[middle], expected[middle]) < 0.03
    assert relative_error(gradient, expected) < 0.1
    given = state.replace(extra={"temperature_gradient": 2 * gradient})
    assert heat.prepare(given) is given
    step = mpm.Step(grid, mpm.NeoHookean(E=1.0, nu=0.3), heat=heat)
    torch.testing.assert_close(step.prepare(state).extra["temperature_gradient"], gradient, rtol=1e-12, atol=1e-12)
    rows = step.prepare(state.sorted(grid)).restored().extra["temperature_gradient"]
    torch.testing.assert_close(rows, gradient, rtol=1e-9, atol=1e-9)
    both = mpm.State.concatenate([state, state.replace(temperature=-state.temperature)], scene=True)
    batch = mpm.Heat(grid_around(dim, 8 if dim == 2 else 4, scenes=2), 1.0, 1.0, transfer=transfer).prepare(both)
    expected = torch.cat([gradient, -gradient])
    torch.testing.assert_close(batch.extra["temperature_gradient"], expected, rtol=1e-9, atol=1e-9)


def test_heat_without_a_gradient_is_compiled_and_differentiated():
    state, _, grid = cosine(n=4)
    heat = mpm.Heat(grid, 1.0, 1.0, tolerance=1e-12)

    def loss(theta):
        return heat(state.replace(temperature=theta), 1e-3).temperature.square().sum()

    theta = state.temperature.clone().requires_grad_()
    (expected,) = torch.autograd.grad(loss(theta), theta)
    direction = random_like(theta)
    with torch.no_grad():
        slope = (loss(theta + 1e-6 * direction) - loss(theta - 1e-6 * direction)) / 2e-6
    assert float(expected @ direction) == pytest.approx(float(slope), rel=1e-6)
    got = torch.compile(loss, backend="eager", fullgraph=True)(theta)
    torch.testing.assert_close(torch.autograd.grad(got, theta)[0], expected)


# ---- a paused scene


def paused_batch(device="cpu"):
    one = block(2, device, n=4, low=0.2, high=0.7, density=10.0, jitter=0.2)
    one = one.replace(temperature=random_like(one.mass))
    two = one.replace(temperature=3 * random_like(one.mass, 9))
    dt = torch.tensor([0.0, 1e-2], dtype=FLOAT, device=device, requires_grad=True)
    return two, mpm.State.concatenate([one, two], scene=True), dt


@pytest.mark.parametrize("method", ["cg", "multigrid"])
@pytest.mark.parametrize("transfer", TRANSFERS)
def test_paused_scene_keeps_its_heat_and_its_gradients(device, transfer, method):
    """dt = 0 in one scene of two: nothing changes in it, gradients are those of nothing, the other is as alone."""
    two, both, dt = paused_batch(device)
    options = {"transfer": transfer, "method": method, "melting_point": 1.0, "latent_heat": 2.0, "tolerance": 1e-12}

    def terms():
        return [
            Fixed(mpm.Plane((0.0, 0.4), (0.0, 1.0)), 5.0),
            Convection(FreeSurface(), 3.0, 4.0),
            Source(lambda t: 1 + t),
        ]

    inputs = [t.clone().requires_grad_() for t in (both.temperature, both.x, both.mass)]
    kappa, capacity = (torch.tensor([2.0, 3.0], dtype=FLOAT, device=device, requires_grad=True) for _ in range(2))
    heat = mpm.Heat(grid_around(n=4, scenes=2), kappa, capacity, terms(), **options)
    start = heat.prepare(both.replace(temperature=inputs[0], x=inputs[1], mass=inputs[2]))
    end = mpm.rollout(heat, start, 2, dt)
    heat.check()
    still = end.scene == 0
    for name in ("temperature", *(f"extra.{k}" for k in end.extra)):
        before, after = (s.extra[name[6:]] if name.startswith("extra.") else getattr(s, name) for s in (start, end))
        assert torch.equal(after[still], before[still]), name
    single = mpm.Heat(grid_around(n=4), 3.0, 3.0, terms(), **options)
    alone = mpm.rollout(single, two, 2, 1e-2).temperature
    torch.testing.assert_close(end.temperature[~still], alone, rtol=1e-9, atol=1e-9)
    found = torch.autograd.grad(end.temperature.square().sum(), [*inputs, kappa, capacity, dt])
    assert all(bool(g.isfinite().all()) for g in found)
    torch.testing.assert_close(found[0][still], 2 * start.temperature[still].detach())
    assert all(float(g[still].abs().max()) == 0 for g in found[1:3])
    assert all(float(g[0]) == 0 and float(g[1].abs()) > 0 for g in found[3:])


def test_paused_scene_with_plastic_heating(device):
    """Where the law dissipates: heat divides its work by dt."""
    _, both, dt = paused_batch(device)
    F = (torch.eye(2, dtype=FLOAT, device=device) * 1.0).repeat(len(both), 1, 1)
    F[:, 0, 1] = 0.3
    F.requires_grad_()
    heat = mpm.Heat(grid_around(n=4, scenes=2), 1.0, 1.0, plastic_heating=0.9)
    step = mpm.Step(heat.grid, mpm.VonMises(E=1e3, nu=0.3, yield_stress=1.0), heat=heat)
    end = step(both.replace(F=F), dt)
    step.check()
    still = end.scene == 0
    assert torch.equal(end.temperature[still], both.temperature[still])
    heated = heat.heat_content(end) - heat.heat_content(both)
    work = 0.9 * 1.0 * end.extra["plastic_strain"] * both.volume  # the yield stress times the plastic strain
    assert float(work[~still].detach().min()) > 0
    torch.testing.assert_close(heated[~still].sum(), work[~still].sum(), rtol=1e-9, atol=0)
    by_F, by_dt = torch.autograd.grad(end.temperature.sum(), (F, dt))
    assert bool(by_F.isfinite().all() and by_dt.isfinite().all()) and float(by_F[still].abs().max()) == 0


@pytest.mark.parametrize("assigned", ["share", "law", "heat"])
def test_plastic_heating_assigned_later(assigned):
    """Equals that of a step made so."""
    _, both, _ = paused_batch("cpu")
    F = torch.eye(2, dtype=FLOAT).repeat(len(both), 1, 1)
    F[:, 0, 1] = 0.3
    state = both.replace(F=F, material=torch.zeros(len(both), dtype=torch.int32))
    grid = grid_around(n=4, scenes=2)

    def laws() -> mpm.Material:
        return mpm.Mixture([mpm.VonMises(E=1e3, nu=0.3, yield_stress=1.0), mpm.NeoHookean(E=1e3, nu=0.3)])

    def made(share: float, law: mpm.Material) -> mpm.Step:
        return mpm.Step(grid, law, heat=mpm.Heat(grid, 1.0, 1.0, plastic_heating=share))

    expected = made(0.9, laws())(state, 1e-3).temperature
    if assigned == "law":
        step = made(0.9, mpm.NeoHookean(E=1e3, nu=0.3))
        step.law = laws()
    else:
        step = made(0.0, laws())
    if assigned == "share":
        step.heat.plastic_heating = 0.9
    if assigned == "heat":
        step.heat = mpm.Heat(grid, 1.0, 1.0, plastic_heating=0.9)
    found = step(step.prepare(state), 1e-3).temperature
    assert float((found - both.temperature).abs().max()) > 0
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("method", ["cg", "multigrid"])
def test_solve_of_a_paused_scene_has_gradients(method):
    """`heat_cg` alone: the increment of a scene with dt = 0 is zero for any data."""
    _, both, dt = paused_batch()
    grid = grid_around(n=4, scenes=2)
    blocks = grid.activate(both.x, both.scene)
    capacity = mpm.ops.scatter(blocks, both.x, both.mass[:, None])[:, 0].requires_grad_()
    theta = random_like(capacity).requires_grad_()
    d = mpm.heat_cg(blocks, both.x, both.volume, capacity, theta, dt, method=method).increment
    paused = blocks.node_scene() == 0
    assert float(d[paused].detach().abs().max()) == 0
    gradients = torch.autograd.grad(d.square().sum(), (capacity, theta, dt))
    for gradient, rows in zip(gradients, (paused, paused, [0]), strict=True):
        assert bool(gradient.isfinite().all()) and float(gradient[rows].abs().max()) == 0


NUMBERS_OF_TIME = {
    "tensor": lambda t: 300.0 + 1e3 * t,
    "number": lambda t: 300.0 + 1e3 * float(t),
    "tensor of a number": lambda t: torch.tensor(300.0 + 1e3 * float(t), dtype=torch.float64),
}


@pytest.mark.parametrize("function", NUMBERS_OF_TIME)
@pytest.mark.parametrize("scenes", [1, 2, 3])
def test_temperatures_of_one_time_serve_scenes_with_times_of_their_own(scenes, function):
    points = mpm.seed.box((0.4, 0.4), (0.6, 0.6), 0.1, per_cell=4)
    state = mpm.State.at_rest(points, 1000.0, dtype=torch.float64)
    state = state.replace(temperature=torch.full_like(state.mass, 300.0))

    def end(temperature, B, dt):
        grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0), scenes=B)
        held = mpm.heat_boundaries.Fixed(mpm.Box((0.4, 0.5), (0.1, 0.5)), temperature)
        step = mpm.Step(grid, mpm.NeoHookean(1e4, 0.3), heat=mpm.Heat(grid, 1000.0, 1000.0, boundaries=[held]))
        return mpm.rollout(step, mpm.State.concatenate([state] * B, scene=True), 4, dt).temperature

    dt = 1e-2 * torch.arange(1, scenes + 1, dtype=torch.float64)
    expected = torch.cat([end(NUMBERS_OF_TIME["tensor"], 1, float(own)) for own in dt])
    assert float(expected.max()) > 310
    torch.testing.assert_close(end(NUMBERS_OF_TIME[function], scenes, dt), expected, rtol=1e-9, atol=0)
