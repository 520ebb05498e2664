"""Surfaces that are held at a temperature: where they seem to lie, orders of convergence, gradients, bad input."""

import itertools
import math
import warnings

import pytest
import torch
from cases.heat import FLOAT, block, check_gradients, random_like
from helpers import relative_error
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.accuracy.heat_fronts import between_surfaces, lag
from torch_mpm.heat.boundaries import Fixed, FixedSurface, Flux, HeatNodes, Surface
from torch_mpm.heat.fronts import LAG, LEAST_LAG
from torch_mpm.ops import heat_operator, scatter


def bar(dx, shift=0.0, dim=2, length=1.0, width=2):
    """A bar along x from `shift`, regular particles; and the distance of each from its left end."""
    upper = (length,) + (width * dx,) * (dim - 1)
    state = mpm.State.at_rest(mpm.seed.box((0,) * dim, upper, dx, per_cell=2**dim), 1.0, dtype=FLOAT)
    distance = state.x[:, 0].clone()
    moved = state.x + torch.tensor([shift] + [0.0] * (dim - 1), dtype=FLOAT)
    return state.replace(x=moved, temperature=torch.zeros_like(distance)), distance


def wall(x, temperature, side=1.0, dim=2):
    """Held surface at x with matter on one side of it."""
    rest = (0.0,) * (dim - 1)
    return FixedSurface(mpm.Plane((x, *rest), (side, *rest)), temperature)


def stand_off(kernel, dx, shift, dim=2, gap=0.0):
    """Temperature of a bar with flux 1 at its far end, minus the distance from the wall, in dx."""
    state, distance = bar(dx, shift, dim)
    sides = torch.cartesian_prod(*[(torch.arange(4, dtype=FLOAT) + 0.5) * dx / 2] * (dim - 1)).reshape(-1, dim - 1)
    tip = torch.cat([torch.full((len(sides), 1), 1 + shift, dtype=FLOAT), sides], 1)
    terms = [wall(shift - gap, 0.0, dim=dim), Flux(Surface(tip, (dx / 2) ** (dim - 1)), 1.0)]
    grid = mpm.Grid(dx, (-0.5,) * dim, (1.5,) + (0.5,) * (dim - 1), kernel=kernel)
    heat = mpm.Heat(grid, 1.0, 1.0, terms, transfer="apic", tolerance=1e-10, method="multigrid")
    end = mpm.rollout(heat, state.replace(temperature=distance.clone()), 12, 10.0)
    heat.check()
    return (end.temperature - distance - gap) / dx, distance


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("dim,shift", [(2, 0.0), (2, 0.12), (2, 0.37), (2, 0.75), (3, 0.6)])
def test_stand_off_of_held_surface(kernel, dim, shift):
    """The temperature is the distance from the wall wherever it lies between the nodes, beside it as in the middle."""
    dx = 1 / 12
    seen, distance = stand_off(kernel, dx, shift * dx, dim)
    assert float(seen[(distance - 0.5).abs() < 0.2].mean().abs()) < 0.02
    assert float(seen[distance < 0.3].abs().max()) < (0.05 if dim == 2 else 0.1)


@pytest.mark.parametrize("gap,most", [(-0.3, 0.05), (0.25, 0.05), (0.5, 0.2)])
def test_gap_between_matter_and_held_surface(kernel, gap, most):
    """Matter that begins a little behind or before the wall has the temperature of matter that begins at it."""
    seen, distance = stand_off(kernel, 1 / 12, 0.2 / 12, gap=gap / 12)
    assert float(seen[(distance - 0.5).abs() < 0.2].mean().abs()) < most


def test_mode_between_held_surfaces_to_order_two(kernel):
    """RMS error of sin πx exp(−π² t), by implicit Euler in time, between two walls that lie on no node."""
    errors = []
    for n in (8, 16, 32):
        dx, time = 1 / n, 0.05
        state, distance = bar(dx, 0.37 * dx)
        theta = torch.sin(math.pi * distance)
        slope = torch.stack([math.pi * torch.cos(math.pi * distance), torch.zeros_like(distance)], 1)
        terms = [wall(0.37 * dx, 0.0), wall(1 + 0.37 * dx, 0.0, side=-1.0)]
        heat = mpm.Heat(mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5), kernel=kernel), 1.0, 1.0, terms)
        steps = round(2 * time * n**2)
        with torch.no_grad():
            state = state.replace(temperature=theta, extra={"temperature_gradient": slope})
            end = mpm.rollout(heat, state, steps, time / steps)
        heat.check()
        errors.append(relative_error(end.temperature, (1 + math.pi**2 * time / steps) ** -steps * theta))
    assert errors[-1] < 1.5e-3 and math.log2(errors[0] / errors[-1]) / 2 > 1.65


def ring_error(n, kernel, device, ball):
    inner, outer, centre = 0.25, 0.75, (0.013, 0.021)
    disc = mpm.State.at_rest(mpm.seed.sphere((0.0, 0.0), outer, 1 / n, per_cell=4), 1.0, dtype=FLOAT, device=device)
    ring = disc.select((disc.x.norm(dim=1) > inner).nonzero()[:, 0])
    exact = torch.log(outer / ring.x.norm(dim=1)) / math.log(outer / inner)
    moved = ring.x + torch.tensor(centre, dtype=FLOAT, device=device)
    terms = [
        FixedSurface(mpm.boundaries.Obstacle(ball(inner), centre), 1.0),
        FixedSurface(mpm.SDF(lambda x: outer - x.norm(dim=1), centre), lambda time: 0.0),
    ]
    heat = mpm.Heat(mpm.Grid(1 / n, (-1, -1), (1, 1), kernel=kernel), 2.0, 1.0, terms, transfer="apic")
    end = mpm.rollout(heat, ring.replace(x=moved, temperature=torch.zeros_like(ring.mass)), 6, 10.0)
    heat.check()
    return relative_error(end.temperature, exact)


BALLS = {
    "sphere": mpm.shapes.Sphere,
    "sampled": lambda radius: mpm.shapes.Sampled.of(mpm.shapes.Sphere(radius), (-0.5, -0.5), (0.5, 0.5), 0.01),
}


@pytest.mark.parametrize("ball", BALLS)
def test_ring_between_held_surfaces(device, kernel, ball):
    """Curved surfaces, a ball and a signed distance, cut out of regular particles: ln(R/r), steady."""
    errors = [ring_error(n, kernel, device, BALLS[ball]) for n in (8, 24)]
    assert errors[1] < 0.015 and math.log(errors[0] / errors[1], 3) > 1.6


@pytest.mark.parametrize("stefan,root", [(0.1, 0.2200163), (1.0, 0.6200626)])
def test_melting_front(kernel, stefan, root):
    """Stefan's problem: the front 2 λ √(α t) by the latent heat taken up, to order two."""
    errors = []
    for n in (16, 32):
        dx, place = 1 / n, 0.4
        state, _ = bar(dx, width=1)
        grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5), kernel=kernel)
        heat = mpm.Heat(grid, 1.0, 1.0, [wall(0.0, 1.0)], melting_point=0.0, latent_heat=1 / stefan)
        time = (place / (2 * root)) ** 2
        steps = round(time * n**2 / (0.5 if stefan == 1 else 2.0))
        with torch.no_grad():
            end = mpm.rollout(heat, state, steps, time / steps)
        errors.append(abs(float((end.extra["liquid"] * end.volume).sum()) / dx / place - 1))
    assert errors[1] < 0.006 and math.log2(errors[0] / errors[1]) > 1.5


def test_surfaces_with_a_thin_body_between(kernel):
    """Layers of two walls that overlap leave a linear temperature as it is, three cells from wall to wall."""
    dx = 1 / 8
    state, distance = bar(dx, 0.3 * dx, length=3 * dx)
    terms = [wall(0.3 * dx, 1.0), wall(3.3 * dx, 4.0, side=-1.0)]
    heat = mpm.Heat(mpm.Grid(dx, (-0.5, -0.5), (1, 0.5), kernel=kernel), 1.0, 1.0, terms, tolerance=1e-10)
    end = mpm.rollout(heat, state, 20, 10.0)
    heat.check()
    torch.testing.assert_close(end.temperature, 1 + distance / dx, rtol=0, atol=0.06)


def nodes_of(state, kernel="quadratic"):
    """The nodes of a step with conductivities that differ a thousandfold."""
    grid = mpm.Grid(1 / 6, (-0.5, -0.5), (1.5, 1.5), kernel=kernel)
    blocks = grid.activate(state.x)
    conductance = state.volume * 10 ** (3 * random_like(state.mass))
    heat_capacity = scatter(blocks, state.x, state.mass[:, None])[:, 0]
    return HeatNodes(blocks, state, state.volume, conductance, heat_capacity, torch.zeros_like(heat_capacity))


def test_operator_stays_positive(kernel):
    """H + X of scattered particles before and behind two walls, through the op, has no negative eigenvalue."""
    state = block(n=6, jitter=0.9)
    nodes = nodes_of(state, kernel)
    for region in (mpm.Plane((0.3, 0.0), (1.0, 0.4)), mpm.Sphere((0.9, 0.9), 0.3)):
        FixedSurface(region, 1.0).apply(nodes)
    conductance = nodes.left_conductance()
    assert float(conductance.min()) < 0 < float(conductance.max())
    used = (nodes.heat_capacity > 0).nonzero()[:, 0]
    unit = torch.eye(len(nodes.heat_capacity), dtype=FLOAT)[used]
    matrix = torch.stack([heat_operator(nodes.blocks, state.x, conductance, u)[used] for u in unit])
    values = torch.linalg.eigvalsh(matrix + torch.diag(nodes.exchange[used]))
    assert float(values[0]) > -1e-12 * float(values[-1])


def test_surface_of_one_scene_for_some_time(device):
    """Scenes with surfaces of their own temperature, and in one of them another surface from t = 50 to 100."""
    state, distance = bar(1 / 8)
    batch = mpm.State.concatenate([state.to(device)] * 3, scene=True)
    left = FixedSurface(mpm.Plane((0.0, 0.0), (1.0, 0.0)), torch.tensor([1.0, 2.0, 3.0], device=device))
    right = FixedSurface(mpm.Plane((1.0, 0.0), (-1.0, 0.0), scene=2, start=50.0, end=100.0), 7.0)
    grid = mpm.Grid(1 / 8, (-0.5, -0.5), (1.5, 0.5), scenes=3)
    heat = mpm.Heat(grid, 1.0, 1.0, [left, right], transfer="apic", tolerance=1e-9)
    for slope in (0.0, 4.0, 0.0):
        batch = mpm.rollout(heat, batch, 10, 5.0)
        heat.check()
        expected = torch.stack([0 * distance + 1, 0 * distance + 2, 3 + slope * distance]).to(device)
        torch.testing.assert_close(batch.temperature.reshape(3, -1), expected, rtol=0, atol=0.05)


def test_gradients_through_a_held_surface(device):
    """Steps of conduction against finite differences: temperatures, positions, κ, that of the surface, where it is."""
    start = block(2, device, n=4, low=0.2, high=0.7, density=10.0, jitter=0.2)

    def loss(theta, x, kappa, held, place, dt):
        terms = [FixedSurface(mpm.Plane(place, (0.3, 1.0)), held), FixedSurface(mpm.Sphere((0.8, 0.8), 0.2), 1.0)]
        heat = mpm.Heat(
            mpm.Grid(0.25, (-0.5, -0.5), (1.5, 1.5)), lambda t: kappa * (1 + 0.1 * t), 1.3, terms, tolerance=1e-12
        )
        end = mpm.rollout(heat, start.replace(x=x, temperature=theta), 3, dt)
        return (end.temperature**2).sum()

    values = (0.7, 3.0, [0.2, 0.3], 0.1)
    inputs = [2 * random_like(start.mass), start.x, *(torch.tensor(a, dtype=FLOAT) for a in values)]
    inputs = [t.detach().clone().to(device).requires_grad_() for t in inputs]
    check_gradients(loss, inputs)


def test_bad_input():
    plane = mpm.Plane((0.0, 0.0), (1.0, 0.0))
    with pytest.raises(ValueError, match=r"region must be an obstacle of torch_mpm\.boundaries, got function"):
        FixedSurface(lambda positions: positions[:, 0] < 0, 1.0)
    with pytest.raises(ValueError, match='method must be "cg" or "multigrid" where a boundary is a FixedSurface'):
        mpm.Heat(mpm.Grid(0.1, (0, 0), (1, 1)), 1.0, 1.0, [FixedSurface(plane, 1.0)], method="chebyshev")
    state, _ = bar(1 / 8)
    held = FixedSurface(plane, lambda time: math.nan)
    heat = mpm.Heat(mpm.Grid(1 / 8, (-0.5, -0.5), (1.5, 0.5)), 1.0, 1.0, [held])
    heat(state, 0.1)
    with pytest.raises(mpm.SimulationError, match="not finite"):
        heat.check()


@pytest.mark.thorough(place=0.0)
@pytest.mark.thorough(place=0.25)
@pytest.mark.thorough(place=0.5, transfer="flip")
@pytest.mark.parametrize("place", [0.0, 0.13, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("per_cell,transfer,least,most", [(4, "hybrid", 0.0, 0.042), (1, "hybrid", 0.05, 0.23),
                                                          (4, "flip", 0.5, 1.2)])  # fmt: skip
def test_linear_temperature_between_held_surfaces(place, per_cell, transfer, least, most):
    """The largest error is what the temperature changes over a share of dx, the same on every lattice: order one."""
    if (per_cell, transfer) != (4, "hybrid") and place in (0.25, 0.75):
        pytest.skip("another place has it")
    errors = [between_surfaces(n, place, per_cell=per_cell, transfer=transfer) for n in (10, 20)]
    assert all(least < error < most for error in errors) and abs(errors[0] / errors[1] - 1) < 0.6


@pytest.mark.parametrize("stefan,solid", [(0.2, -0.4), (1.7, -0.4), (5.0, -0.4), (1.7, -1.0)])
@pytest.mark.parametrize("number,n", [(0.5, 10), (4.0, 20), (25.0, 40)])
def test_lag_of_a_front_of_two_phases(stefan, solid, number, n):
    """Against Neumann's solution: no more than 0.1 dx + 0.45 √(κ dt/(ρ C)), and not ahead by more than 0.1 dx."""
    assert -0.1 < lag(stefan, solid, n, number) < LEAST_LAG + LAG * math.sqrt(number)


def test_steps_that_are_too_long_for_a_front_are_reported(device):
    """By name, with the scene and the diffusion number; heat that changes no phase may take any step."""
    dx = 1 / 8
    state, distance = bar(dx)
    batch = mpm.State.concatenate([state.to(device)] * 2, scene=True)
    theta = torch.cat([-1 - distance, torch.full_like(distance, -0.5)]).to(device)
    grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5), scenes=2)
    heat = mpm.Heat(grid, 1.0, 1.0, [wall(0.0, 0.0)], melting_point=-0.5, latent_heat=3.0)
    step = mpm.Step(grid, mpm.NeoHookean(E=1.0, nu=0.3), heat=heat, integrator="implicit")
    for number, warned in ((0.5, False), (9.0, True)):
        for checked in (heat, step):
            heat.reset()
            after = heat(batch.replace(temperature=theta), torch.tensor([1e-9, number * dx**2], device=device))
            melted = after.extra["liquid"].split(len(distance))
            assert not melted[0].any() and melted[1].any()
            assert heat.concerns().tolist() == [False, warned]
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                checked.check()
            found = [str(w.message) for w in caught if w.category is mpm.FrontWarning]
            assert bool(found) == warned
            if warned:
                assert "first in scene 1, lag behind by up to 1.5 dx" in found[0] and "of 9;" in found[0]
    heat.forget(torch.tensor([False, True], device=device))
    assert not heat.concerns().any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        heat.check()


@pytest.mark.parametrize(*in_pairs(kind=[FixedSurface, Fixed], lap=[0.0, 0.15], dim=[2, 3]))
def test_a_floor_of_several_boxes_is_held_as_one(kind, lap, dim):
    """Their inner faces, and the edges of their seams, are no surfaces, in any order of the boxes."""
    dx = 0.1
    rest = (0.0,) * (dim - 2)
    state = mpm.State.at_rest(mpm.seed.box((-0.5, 0.0, *rest), (0.5, 0.4, *[0.3] * (dim - 2)), dx), 1.0, dtype=FLOAT)
    state = state.replace(temperature=torch.zeros_like(state.mass))
    grid = mpm.Grid(dx, (-1.0, -0.5, *[-0.5] * (dim - 2)), (1.0,) * dim)

    def warmed(ends):
        parts = [
            mpm.Box(((a + b) / 2, -0.2, *[0.15] * (dim - 2)), (b - a + 2 * lap, 0.4, *[2.0] * (dim - 2)))
            for a, b in itertools.pairwise(ends)
        ]
        found = []
        for order in (parts, parts[::-1]):
            heat = mpm.Heat(grid, 1.0, 1.0, [kind(part, 1.0) for part in order], method="multigrid", tolerance=1e-10)
            found.append(mpm.rollout(heat, state, 2, 0.02).temperature)
        torch.testing.assert_close(found[0], found[1])
        return found[0]

    whole = warmed([-2.0, 2.0])
    assert 0.1 < float(whole.mean()) < 0.9
    torch.testing.assert_close(warmed([-2.0, -0.13, 0.21, 2.0]), whole)
