"""Heat in the particles: conduction, boundary terms, melting, and what a step does with them."""

import math

import pytest
import torch
from cases.heat import FLOAT, NAN, block, check_gradients, grid_around, random_like
from helpers import OpNames, relative_error

import torch_mpm as mpm
from benchmarks.catalogue import scenes
from torch_mpm.heat.boundaries import Convection, Fixed, FixedSurface, Flux, FreeSurface, Radiation, Source, Surface
from torch_mpm.laws.parameters import PerMaterial

# ---- conduction


def cosine_error(n, transfer, r, kernel="quadratic", time=0.05):
    """RMS error of cos πx cos πy in an insulated square against implicit Euler in time, exact in space."""
    state = block(n=n)
    x = state.x - 0.37 / n
    theta = torch.cos(math.pi * x).prod(1)
    slope = torch.stack([-math.pi * torch.sin(math.pi * x[:, a]) * torch.cos(math.pi * x[:, 1 - a]) for a in (0, 1)], 1)
    state = state.replace(temperature=theta, extra={"temperature_gradient": slope})
    steps = round(time * n * n / r)
    heat = mpm.Heat(grid_around(n=n, kernel=kernel), 2.0, 1.0, transfer=transfer)
    with torch.no_grad():
        end = mpm.rollout(heat, state, steps, time / steps)
    heat.check()
    expected = (1 + 2 * math.pi**2 * time / steps) ** -steps * theta
    return relative_error(end.temperature, expected)


@pytest.mark.parametrize("transfer,r", [("hybrid", 0.5), ("hybrid", 0.05), ("apic", 0.5), ("flip", 0.5)])
def test_order_two_with_regular_particles(kernel, transfer, r):
    coarse, fine = (cosine_error(n, transfer, r, kernel) for n in ((10, 20) if r > 0.1 else (8, 16)))
    assert math.log2(coarse / fine) > 1.8 and fine < (0.04 if transfer == "flip" else 0.012)


def test_pic_does_not_converge_and_the_hybrid_does_not_care_for_small_steps():
    assert cosine_error(8, "pic", 0.05) > 0.5
    assert cosine_error(8, "hybrid", 0.02) < 1.1 * cosine_error(8, "hybrid", 0.5)


@pytest.mark.parametrize("transfer", ["hybrid", "apic", "flip", "pic"])
def test_heat_is_conserved(device, dim, kernel, transfer):
    """Random particles, conductivities and temperatures: heat is conserved to rounding, for any weights."""
    for dtype, limit in ((torch.float64, 1e-13), (torch.float32, 1e-6)):
        state = block(dim, device, dtype, n=4, jitter=0.4)
        kappa = 10 ** (6 * random_like(state.mass) - 4)
        state = state.replace(temperature=random_like(state.mass, 6))
        if transfer in ("hybrid", "apic"):
            state.extra["temperature_gradient"] = random_like(state.x, 7)
        heat = mpm.Heat(grid_around(dim, 4, kernel=kernel), kappa, 1.5, transfer=transfer)
        end = mpm.rollout(heat, state, 5, 0.01)
        before, after = (heat.heat_content(s).double().sum() for s in (state, end))
        assert abs(float(after / before - 1)) < limit
        assert relative_error(end.temperature, state.temperature) > 0.01


def test_float32_keeps_small_changes():
    """200 steps with a diffusion number of 1e-5, temperatures within 1 K of the reference: as float64 within 5%."""
    n, ends = 32, []
    for dtype in (torch.float32, torch.float64):
        ball = mpm.State.at_rest(mpm.seed.sphere((0.5, 0.5), 0.4, 1 / n, per_cell=4), 1.0, dtype=dtype)
        x = ball.x.double()
        theta = torch.where(x[:, 0] < 0.45, 1.0, 0.0) + 0.2 * torch.sin(9 * x[:, 1])
        heat = mpm.Heat(mpm.Grid(1 / n, (0, 0), (1, 1)), 1.0, 1.0, reference=300.0)
        with torch.no_grad():
            end = mpm.rollout(heat, ball.replace(temperature=theta.to(dtype)), 200, 1e-5 / n**2)
        heat.check()
        ends.append(end.temperature.double() - theta)
    assert relative_error(ends[0], ends[1]) < 0.05


def test_conductivity_of_a_function_is_that_of_its_values(device):
    state = block(2, device).replace(temperature=30 * random_like(block().mass).to(device))
    table = mpm.Table([0.0, 20.0], [1.0, 3.0])
    values = 1 + 2 * (state.temperature / 20).clamp(0, 1)
    ends = [mpm.Heat(grid_around(), kappa, 1.0).to(device)(state, 1e-3).temperature for kappa in (table, values)]
    torch.testing.assert_close(*ends)


def test_order_of_particles_does_not_matter(device):
    """Sorted particles with per-particle parameters give what unsorted ones give."""
    state = block(2, device, jitter=0.4)
    state = state.replace(temperature=random_like(state.mass))
    grid = grid_around()
    heat = mpm.Heat(
        grid, 1 + random_like(state.mass, 8), 1.0, melting_point=0.5, latent_heat=random_like(state.mass) + 1
    )
    plain = mpm.rollout(heat, state, 3, 1e-3)
    order = state.sorted(grid)
    shuffled = mpm.rollout(heat, order.select(torch.arange(len(order) - 1, -1, -1, device=device)), 3, 1e-3).restored()
    torch.testing.assert_close(shuffled.temperature, plain.temperature, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(shuffled.extra["liquid"], plain.extra["liquid"], rtol=1e-9, atol=1e-9)


# ---- boundary terms


def surface_of_square(side=1.0, points=40, low=0.37 / 8):
    """Points on the four sides, with their lengths."""
    s = (torch.arange(points, dtype=FLOAT) + 0.5) / points * side + low
    sides = [torch.stack([s, torch.full_like(s, b)], 1) for b in (low, low + side)]
    return torch.cat([*sides, *(x.flip(1) for x in sides)]), side / points


def test_flux_and_source_bring_exactly_their_heat(device, kernel):
    state = block(2, device, jitter=0.3)
    state = state.replace(temperature=torch.zeros_like(state.mass))
    points, area = surface_of_square()
    surface = Surface(points.to(device), area)
    terms = [
        Flux(surface, lambda time: 3.0),
        Flux(surface, torch.linspace(0, 1, 160, dtype=FLOAT, device=device)),
        Source(5.0),
    ]
    heat = mpm.Heat(grid_around(kernel=kernel), 1.0, 1.0, terms)
    end = mpm.rollout(heat.to(device), state, 4, 0.01)
    expected = 0.04 * (3.0 * 4 + 0.5 * 4 + 5.0)
    assert float(heat.heat_content(end).sum()) == pytest.approx(expected, rel=1e-12)
    assert float(end.temperature.min()) > 0


def test_heated_bar():
    """A bar with flux 1 at one end: θ = t + (3x² − 1)/6 − (2/π²) Σ (−1)^k exp(−k²π²t) cos(kπx)/k², to order 2."""
    errors = []
    for n in (16, 32):
        dx, time = 1 / n, 0.1
        bar = scenes.block((0, 0), (1, 2 * dx), dx, density=1.0)
        x = bar.x[:, 0].clone()
        shift = torch.tensor([0.37 * dx, 0.0], dtype=FLOAT)
        bar = bar.replace(x=bar.x + shift, temperature=torch.zeros_like(x))
        heights = (torch.arange(8, dtype=FLOAT) + 0.5) / 4 * dx
        end_points = torch.stack([torch.ones_like(heights), heights], 1)[heights < 2 * dx] + shift
        flux = Flux(Surface(end_points, 2 * dx / len(end_points)), 1.0)
        heat = mpm.Heat(mpm.Grid(dx, (-1, -1), (2, 1)), 1.0, 1.0, [flux])
        steps = round(time / (0.25 * dx**2))
        with torch.no_grad():
            end = mpm.rollout(heat, bar, steps, time / steps)
        k = torch.arange(1, 60, dtype=FLOAT)
        series = ((-1) ** k * torch.exp(-((k * math.pi) ** 2) * time) * torch.cos(k * math.pi * x[:, None]) / k**2).sum(
            1
        )
        errors.append(relative_error(end.temperature, time + (3 * x**2 - 1) / 6 - 2 / math.pi**2 * series))
    assert errors[1] < 1e-3 and math.log2(errors[0] / errors[1]) > 1.9


def test_convection_cools_a_well_conducting_body_as_a_whole(device):
    """Small Biot number: θ_a + (θ_0 − θ_a) (1 + dt h A/(m C))^−n of implicit Euler, by points and free surface."""
    state = block(2, device)
    state = state.replace(temperature=torch.full_like(state.mass, 10.0))
    points, length = surface_of_square()
    step, coefficient, capacity = 0.05, 0.5, 2.0 * 1.5
    for surface, tolerance in ((Surface(points, length), 1e-3), (FreeSurface(), 0.06)):
        heat = mpm.Heat(grid_around(), 1e4, 1.5, [Convection(surface, coefficient, 4.0)])
        end = mpm.rollout(heat, state, 20, step)
        heat.check()
        left = float((end.temperature.mean() - 4) / 6)
        rate = -math.log(left) / 20
        assert rate == pytest.approx(math.log(1 + step * coefficient * 4 / capacity), rel=tolerance)


def test_radiation_is_implicit_to_first_order():
    """One step of a well conducting body against the linearised scalar equation; in balance nothing happens."""
    state = block()
    state = state.replace(temperature=torch.full_like(state.mass, 100.0))
    points, length = surface_of_square()
    radiation = Radiation(Surface(points, length), 0.8, ambient=-200.0)
    heat = mpm.Heat(grid_around(), 1e6, 10.0, [radiation], reference=1000.0)
    end = heat(state, 0.01)
    black, capacity = 5.670374419e-8 * 0.8 * 4, 20.0
    change = black * (800**4 - 1100**4) / (capacity / 0.01 + 4 * black * 1100**3)
    assert float(end.temperature.mean() - 100) == pytest.approx(change, rel=1e-4)
    still = mpm.Heat(grid_around(), 1.0, 10.0, [Radiation(FreeSurface(), 0.8, ambient=100.0)], reference=1000.0)
    assert float((still(state, 1.0).temperature - 100).abs().max()) < 1e-9


def test_fixed_ends_give_a_linear_profile(device):
    """Held by an obstacle at one end and by a function of positions at the other; time-dependent temperature."""
    dx = 1 / 8
    bar = scenes.block((-2 * dx, 0), (1 + 2 * dx, 0.25), dx, density=1.0, device=device)
    bar = bar.replace(temperature=torch.zeros_like(bar.mass))
    terms = [
        Fixed(mpm.Plane((0.0, 0.0), (1.0, 0.0)), lambda time: 2.0 + 0 * time),
        Fixed(lambda positions: positions[:, 0] >= 1.0, 5.0),
    ]
    heat = mpm.Heat(mpm.Grid(dx, (-1, -1), (2, 1)), 1.0, 1.0, terms)
    end = mpm.rollout(heat, bar, 60, 0.1)
    inside = (end.x[:, 0] > 2 * dx) & (end.x[:, 0] < 1 - 2 * dx)
    offset = (end.temperature - (2 + 3 * end.x[:, 0]))[inside].abs().max() / 3  # the held nodes seem to stand off by
    assert float(offset) < 0.1 * dx


@pytest.mark.parametrize("kernel,offset", [("quadratic", 0.174), ("cubic", 0.360)])
def test_stand_off_of_held_nodes(kernel, offset):
    """A bar that ends at a wall on nodes, with flux 1 at its other end: the wall seems to be `offset` dx behind."""
    dx = 1 / 16
    bar = scenes.block((0, 0), (1, 2 * dx), dx, density=1.0)
    bar = bar.replace(temperature=bar.x[:, 0].clone())
    heights = (torch.arange(4, dtype=FLOAT) + 0.5) * dx / 2
    flux = Flux(Surface(torch.stack([torch.ones_like(heights), heights], 1), dx / 2), 1.0)
    wall = Fixed(mpm.Plane((0.0, 0.0), (1.0, 0.0)), 0.0)
    grid = mpm.Grid(dx, (-1, -1), (2, 1), kernel=kernel)
    heat = mpm.Heat(grid, 1.0, 1.0, [wall, flux], transfer="apic", tolerance=1e-10, method="multigrid")
    end = mpm.rollout(heat, bar, 15, 10.0)
    heat.check()
    middle = (end.x[:, 0] - 0.5).abs() < 0.2
    seen = (end.temperature - end.x[:, 0])[middle] / dx
    assert float(seen.mean()) == pytest.approx(offset, abs=0.005) and float(seen.std()) < 0.005


def test_free_surface_has_the_length_of_the_body(device):
    """A square and a disc of evenly spread particles, in units of their perimeters."""

    class Measure:
        def apply(self, nodes):
            self.length = float(FreeSurface().integrate(nodes, 1.0).sum())

    square = block(2, device, n=16)
    disc = mpm.State.at_rest(mpm.seed.sphere((0.5, 0.5), 0.5, 1 / 16, per_cell=4), dtype=FLOAT, device=device)
    for state, perimeter in ((square, 4.0), (disc, math.pi)):
        measure = Measure()
        heat = mpm.Heat(grid_around(n=16), 1.0, 1.0, [measure])
        heat(state.replace(temperature=torch.zeros_like(state.mass)), 1.0)
        assert measure.length == pytest.approx(perimeter, rel=0.06)


# ---- latent heat


def test_latent_heat_is_taken_up_at_the_melting_point_and_given_back(device):
    """Heat content is kept; a block that is heated evenly melts at its melting point, and freezes there again."""
    state = block(2, device)
    state = state.replace(temperature=torch.full_like(state.mass, -1.0))
    options = {"melting_point": 2.0, "latent_heat": 6.0, "tolerance": 1e-13}
    heat = mpm.Heat(grid_around(), 1.0, 3.0, [Source(lambda theta: 0 * theta + 12.0)], **options)
    content = [float(heat.heat_content(heat.prepare(state)).sum())]
    seen = []
    for k in range(40):
        if k == 20:
            heat.boundaries = [Source(-12.0)]
        state = heat(state, 0.1)
        theta, liquid = state.temperature, state.extra["liquid"]
        content.append(float(heat.heat_content(state).sum()))
        seen.append((float(theta.mean()), float(liquid.mean())))
        mushy = (liquid > 0) & (liquid < 1)
        assert float((theta - 2.0).abs()[mushy].max() if bool(mushy.any()) else 0) < 1e-12
    steps = torch.tensor(content).diff()
    torch.testing.assert_close(steps[:20], torch.full((20,), 1.2))
    torch.testing.assert_close(steps[20:], torch.full((20,), -1.2))
    # 12 W/m³ heat 2 kg/m³ of 3 J/(kg K) by 0.2 K per step: melting begins after 15 steps and takes 10 of them.
    assert seen[14] == pytest.approx((2.0, 0.0), abs=1e-9) and seen[19] == pytest.approx((2.0, 0.5), abs=1e-9)
    assert seen[24] == pytest.approx((2.0, 0.0), abs=1e-9) and seen[39] == pytest.approx((-1.0, 0.0), abs=1e-9)


def stefan_front(n, stefan, transfer="hybrid", r=0.2):
    """Relative error of the front of one-phase melting, s = 2 λ √(α t), by the latent heat taken up."""
    wanted = {0.1: 0.2200163, 0.5: 0.4647859, 1.0: 0.6200626}[stefan]
    dx = 1 / n
    bar = scenes.block((0, 0), (1, dx), dx, density=1.0)
    bar = bar.replace(temperature=torch.zeros_like(bar.mass))
    hot = Fixed(mpm.Plane((0.0, 0.0), (1.0, 0.0)), 1.0)
    grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5))
    heat = mpm.Heat(grid, 1.0, 1.0, [hot], transfer=transfer, melting_point=0.0, latent_heat=1 / stefan)
    time = 0.6**2 / (4 * wanted**2)
    steps = round(time / (r * dx**2))
    with torch.no_grad():
        end = mpm.rollout(heat, bar, steps, time / steps)
    front = float((end.extra["liquid"] * end.volume).sum()) / dx
    return front / (2 * wanted * math.sqrt(time)) - 1


@pytest.mark.parametrize("stefan", [0.5, 1.0])
def test_stefan_front(stefan):
    assert abs(stefan_front(16, stefan)) < 0.015


# ---- as part of a step


def test_a_step_without_heat_does_nothing_for_it():
    """It runs no op of heat, and the same ops with a temperature that is not conducted."""

    state = block()
    step = mpm.Step(grid_around(), mpm.NeoHookean(E=1e3, nu=0.3), walls="slip")
    runs = []
    for start in (state, state.replace(temperature=torch.zeros_like(state.mass))):
        start = step(start, 1e-3)
        with OpNames() as names:
            end = step(start, 1e-3)
        runs.append(names.seen)
        assert end.extra == {}
    assert runs[0] == runs[1] and not any("heat" in name or "scatter" in name for name in runs[0])


def test_temperature_turns_with_a_body(device):
    """A spinning block that hardly conducts keeps the temperature of each particle, and the gradient turns."""
    state = block(2, device, low=0.3, high=0.7, density=1000.0)
    centre = state.x.mean(0)
    arm = state.x - centre
    turn = math.pi / 2
    state = state.replace(
        v=turn * torch.stack([-arm[:, 1], arm[:, 0]], 1),
        C=torch.tensor([[0.0, -turn], [turn, 0.0]], dtype=FLOAT, device=device).expand(len(state), 2, 2),
        temperature=arm[:, 0].clone(),
        extra={"temperature_gradient": torch.tensor([1.0, 0.0], dtype=FLOAT, device=device).expand_as(arm)},
    )
    heat = mpm.Heat(grid_around(), 1e-9, 1.0)
    step = mpm.Step(grid_around(), mpm.NeoHookean(E=1e6, nu=0.3), heat=heat)
    end = mpm.rollout(step, state, 500, 2e-3)
    step.check(end)
    torch.testing.assert_close(end.temperature, state.temperature, rtol=0, atol=0.01)
    mean = end.extra["temperature_gradient"].mean(0)
    torch.testing.assert_close(mean, torch.tensor([0.0, 1.0], dtype=FLOAT, device=device), rtol=0, atol=0.05)


class Dissipating(mpm.Material):
    """Law without stress that dissipates 7 J/m³ in every step where dissipation is stored."""

    def update(self, state):
        fields = {"dissipated": torch.full_like(state.mass, 7.0)} if self.dissipation else {}
        return fields, torch.zeros_like(state.F)


def test_plastic_work_heats(device):
    state = block(2, device, low=0.2, high=0.6)
    state = state.replace(temperature=torch.zeros_like(state.mass))
    for share in (0.0, 0.9):
        heat = mpm.Heat(grid_around(), 1.0, 2.0, plastic_heating=share)
        step = mpm.Step(grid_around(), mpm.Mixture([Dissipating()]), heat=heat)
        end = mpm.rollout(step, state.replace(material=torch.zeros_like(state.mass, dtype=torch.int32)), 3, 1e-3)
        gained = float(heat.heat_content(end).sum())
        assert gained == pytest.approx(3 * share * 7.0 * float(state.volume.sum()), rel=1e-12, abs=1e-12)


def test_metal_that_hits_a_wall_warms_by_its_plastic_work(device):
    """A von Mises disc: the heat is the plastic work, most of the mechanical energy that it loses and no more."""
    disc = mpm.State.at_rest(mpm.seed.sphere((0.5, 0.3), 0.2, 1 / 16, per_cell=4), 1000.0, (0.0, -3.0), dtype=FLOAT)
    state = disc.replace(temperature=torch.zeros_like(disc.mass)).to(device)
    law = mpm.VonMises(E=1e6, nu=0.3, yield_stress=1e4)
    heat = mpm.Heat(grid_around(n=16, low=0.0, high=1.0), 1.0, 1.0, plastic_heating=1.0)
    step = mpm.Step(heat.grid, law, walls="slip", heat=heat)

    def mechanical(s):
        return float((0.5 * s.mass * s.v.square().sum(1) + law.energy(step.prepare(s))).sum())

    with torch.no_grad():
        end = mpm.rollout(step, state, 300, 5e-4)
    step.check(end)
    lost = mechanical(state) - mechanical(end)
    assert lost > 0.5 * mechanical(state)
    assert 0.7 < float(heat.heat_content(end).sum()) / lost < 1.0


def test_block_melts_through_a_step_and_keeps_its_heat(device):
    """A block of wax in free fall that a source melts: fields of both phases, heat by the source, solid to liquid."""
    state = block(2, device, low=0.2, high=0.6, density=1000.0)
    state = state.replace(temperature=torch.full_like(state.mass, -1.0))
    heat = mpm.Heat(grid_around(), 1.0, 1.0, [Source(1e6)], melting_point=0.0, latent_heat=5.0)
    law = mpm.Melting(mpm.NeoHookean(E=1e4, nu=0.3), mpm.WeaklyCompressible(1e4))
    step = mpm.Step(grid_around(), law, heat=heat, gravity=(0, -1))
    start = step.prepare(state)
    end = mpm.rollout(step, state, 10, 1e-3)
    step.check(end)
    assert float(start.extra["liquid"].max()) == 0 and float(end.extra["liquid"].min()) == 1
    volume = float(end.volume.sum())
    gained = float((heat.heat_content(end) - heat.heat_content(start)).sum())
    assert gained == pytest.approx(10 * 1e-3 * 1e6 * volume, rel=1e-3)


# ---- batches and gradients


def batch(device="cpu"):
    """Two scenes of the same block with different temperatures."""
    one = block(2, device, low=0.2, high=0.7, density=10.0)
    one = one.replace(temperature=random_like(one.mass))
    two = one.replace(temperature=3 * random_like(one.mass, 9))
    return one, two, mpm.State.concatenate([one, two], scene=True)


def test_scenes_do_not_know_of_each_other(device):
    one, two, both = batch(device)
    dt, kappa = (
        torch.tensor([1e-2, 3e-2], dtype=FLOAT, device=device),
        torch.tensor([1.0, 5.0], dtype=FLOAT, device=device),
    )
    heat = mpm.Heat(grid_around(scenes=2), kappa, 1.0, melting_point=1.0, latent_heat=2.0)
    end = mpm.rollout(heat, both, 3, dt)
    for k, alone in enumerate((one, two)):
        single = mpm.Heat(grid_around(), float(kappa[k]), 1.0, melting_point=1.0, latent_heat=2.0)
        expected = mpm.rollout(single, alone, 3, float(dt[k]))
        mine = end.scene == k
        torch.testing.assert_close(end.temperature[mine], expected.temperature, rtol=1e-10, atol=1e-10)


def test_nan_stays_in_its_scene_and_is_reported(device):
    _, two, both = batch(device)
    both.temperature[3] = torch.nan
    heat = mpm.Heat(grid_around(scenes=2), 1.0, 1.0)
    end = mpm.rollout(heat, both, 2, 1e-2)
    expected = mpm.rollout(mpm.Heat(grid_around(), 1.0, 1.0), two, 2, 1e-2)
    torch.testing.assert_close(end.temperature[end.scene == 1], expected.temperature)
    with pytest.raises(mpm.SimulationError, match=r"2 heat solves had no result: 2 in scene 0: .*not finite"):
        heat.check()
    heat.reset()
    heat.check()


def test_what_does_not_converge_is_reported():
    state = block().replace(temperature=random_like(block().mass))
    heat = mpm.Heat(grid_around(), 1e3, 1.0, max_iterations=2)
    heat(state, 1.0)
    with pytest.raises(mpm.SimulationError, match=r"residual of .* K was left after 2 iterations"):
        heat.check()
    negative = mpm.Heat(grid_around(), lambda theta: theta - 0.5, 1.0)
    negative(state, 1.0)
    with pytest.raises(mpm.SimulationError, match="conductivity is negative"):
        negative.check()


@pytest.mark.parametrize("transfer", ["hybrid", "flip"])
def test_gradients_of_a_rollout(device, transfer):
    """Steps of motion, conduction, melting and boundaries against finite differences, for every kind of input."""
    start = block(2, device, n=4, low=0.2, high=0.7, density=10.0, jitter=0.2)
    points, length = surface_of_square(0.5, 5, 0.3)
    surface = Surface(points.to(device), length)
    theta = 2 * random_like(start.mass)

    def loss(theta, x, kappa, capacity, melting_point, latent_heat, flux, coefficient, ambient, held, dt):
        terms = [
            Flux(surface, flux),
            Convection(FreeSurface(), coefficient, ambient),
            Radiation(surface, 0.9, 0.0),
            Fixed(mpm.Plane((0.0, 0.3), (0.0, 1.0)), held),
            Source(lambda t: 1 + t),
        ]
        heat = mpm.Heat(
            grid_around(n=4), lambda t: kappa * (1 + 0.1 * t), capacity, terms, transfer=transfer, reference=300.0,
            melting_point=melting_point, latent_heat=latent_heat, tolerance=1e-12,
        )  # fmt: skip
        law = mpm.Melting(mpm.NeoHookean(E=1e2, nu=0.3), mpm.WeaklyCompressible(1e2))
        step = mpm.Step(grid_around(n=4), mpm.ThermalExpansion(law, 1e-3), heat=heat)
        end = mpm.rollout(step, start.replace(x=x, temperature=theta), 3, dt)
        return (end.temperature**2).sum() + end.extra["liquid"].sum() + 10 * (end.x**2).sum()

    values = [theta, start.x]
    numbers = (0.7, 1.3, 1.0, 2.0, 3.0, 0.8, 4.0, 1.5, 0.02)
    inputs = [t.detach().clone().requires_grad_() for t in values]
    inputs += [torch.tensor(a, dtype=FLOAT, device=device, requires_grad=True) for a in numbers]
    check_gradients(loss, inputs)


def test_gradient_through_checkpoints():
    state = block(n=4).replace(temperature=random_like(block(n=4).mass))
    kappa = torch.tensor(1.0, dtype=FLOAT, requires_grad=True)
    heat = mpm.Heat(grid_around(n=4), kappa, 1.0)
    step = mpm.Step(grid_around(n=4), mpm.NeoHookean(E=10.0, nu=0.3), heat=heat)
    gradients = [
        torch.autograd.grad(mpm.rollout(step, state, 6, 0.01, checkpoint).temperature.square().sum(), kappa)[0]
        for checkpoint in (None, 2)
    ]
    torch.testing.assert_close(*gradients)


# ---- bad input


def test_bad_arguments():
    grid = grid_around()
    for options, message in (
        ({"conductivity": -1.0}, "conductivity must be not negative, got -1"),
        ({"conductivity": float("nan")}, "conductivity"),
        ({"specific_heat": 0.0}, "specific_heat must be positive"),
        ({"transfer": "tpic"}, "transfer must be one of"),
        ({"melting_point": 1.0}, "given together"),
        ({"melting_point": 1.0, "latent_heat": 0.0}, "latent_heat must be positive"),
        ({"melting_point": NAN, "latent_heat": 1.0}, "melting_point must be a number, got nan"),
        ({"melting_point": torch.tensor([1.0, NAN]), "latent_heat": 1.0}, "melting_point must be a number"),
        (
            {"melting_point": PerMaterial([1.0, NAN]), "latent_heat": 1.0},
            "melting_point of material 1 must be a number",
        ),
        ({"melting_point": 1.0, "latent_heat": NAN}, "latent_heat must be positive"),
        ({"conductivity": PerMaterial([-1.0, 1.0])}, "conductivity of material 0 must be not negative"),
        ({"specific_heat": PerMaterial([1.0, NAN])}, "specific_heat of material 1 must be positive"),
        ({"reference": NAN}, "reference must be finite, got nan"),
        ({"reference": math.inf}, "reference must be finite, got inf"),
        ({"max_iterations": NAN}, "max_iterations must be at least 1, got nan"),
        ({"tolerance": NAN}, "tolerance must be between"),
        ({"plastic_heating": NAN}, "between 0 and 1"),
        ({"plastic_heating": 1.5}, "between 0 and 1"),
        ({"tolerance": 0.0}, "tolerance must be between"),
        ({"max_iterations": 0}, "at least 1"),
        ({"method": "gmres"}, "method must be one of"),
    ):
        with pytest.raises(ValueError, match=message):
            mpm.Heat(grid, **{"conductivity": 1.0, "specific_heat": 1.0, **options})
    never = PerMaterial([1.0, math.inf])
    assert mpm.Heat(grid, 1.0, 1.0, melting_point=never, latent_heat=1.0).melting_point is never
    heat = mpm.Heat(grid, 1.0, 1.0)
    with pytest.raises(ValueError, match="temperature is None"):
        heat(block(), 1.0)
    state = block().replace(temperature=torch.zeros_like(block().mass))
    with pytest.raises(ValueError, match="dt must be a positive number"):
        heat(state, 0.0)
    with pytest.raises(ValueError, match="temperature_gradient must have shape"):
        heat(state.replace(extra={"temperature_gradient": state.mass}), 1.0)
    with pytest.raises(ValueError, match="conductivity must have shape"):
        mpm.Heat(grid, torch.ones(3), 1.0)(state, 1.0)


def test_bad_boundaries():
    points, plane = torch.zeros(4, 2), mpm.Plane((0.0, 0.0), (1.0, 0.0))
    for make, message in (
        (lambda: Surface(points[:, :1], 1.0), "points must have shape"),
        (lambda: Surface(points, torch.ones(3)), "area must be a number or have shape"),
        (lambda: Surface(points, -1.0), "area must be not negative"),
        (lambda: Surface(points, 1.0, torch.zeros(3)), "scene must have shape"),
        (lambda: Convection(FreeSurface(), -1.0, 0.0), "coefficient must be not negative"),
        (lambda: Convection(FreeSurface(), torch.tensor([1.0, -1.0]), 0.0), "coefficient must be not negative"),
        (lambda: Convection(FreeSurface(), 1.0, NAN), "ambient must be finite, got nan"),
        (lambda: Radiation(FreeSurface(), 1.1, 0.0), "emissivity must be between 0 and 1"),
        (lambda: Radiation(FreeSurface(), torch.tensor(NAN), 0.0), "emissivity must be between 0 and 1"),
        (lambda: Radiation(FreeSurface(), 0.5, math.inf), "ambient must be finite, got inf"),
        (lambda: Flux(FreeSurface(), NAN), "flux must be finite, got nan"),
        (lambda: Flux(FreeSurface(), torch.tensor([0.0, NAN])), "flux must be finite"),
        (lambda: Fixed(plane, NAN), "temperature must be finite, got nan"),
        (lambda: FixedSurface(plane, torch.tensor(NAN)), "temperature must be finite"),
        (lambda: Source(NAN), "power must be finite, got nan"),
        (lambda: Surface(points + NAN, 1.0), "points must be finite"),
        (lambda: Surface(points, math.inf), "area must be not negative and finite, got inf"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_empty_state_and_far_surface(device):
    """No particles, and a surface without matter around it: nothing happens."""
    state = block(2, device).replace(temperature=torch.zeros_like(block().mass).to(device))
    far = Flux(Surface(torch.full((1, 2), 1.45, dtype=FLOAT), 1.0), 1.0)
    heat = mpm.Heat(grid_around(), 1.0, 1.0, [far])
    none = state.select(torch.zeros(0, dtype=torch.int64, device=device))
    assert len(heat(none, 1.0)) == 0
    assert float(heat(state, 1.0).temperature.abs().max()) == 0
    heat.check()


@pytest.mark.parametrize("reach", [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("boundary", ["flux", "convection"])
def test_heat_goes_into_no_node_that_has_next_to_no_matter(boundary, reach):
    """Particles that reach just into the support of a node: a bar with a flux at one end and a held one has the
    temperature that it has where they do not."""
    ends = []
    for place in (reach, -reach - 1e-3):
        dx = 1 / 12
        bar = mpm.State.at_rest(mpm.seed.box((0, 0), (1, 2 * dx), dx, per_cell=4, dtype=FLOAT), 1.0, dtype=FLOAT)
        shift = (0.75 + place) * dx
        bar = bar.replace(x=bar.x + torch.tensor([shift, 0.0], dtype=FLOAT), temperature=bar.x[:, 0].clone())
        heights = (torch.arange(4, dtype=FLOAT) + 0.5) * dx / 2
        tip = Surface(torch.stack([torch.full_like(heights, 1 + shift), heights], 1), dx / 2)
        heated = Flux(tip, 1.0) if boundary == "flux" else Convection(tip, 1e3, 1.0)
        grid = mpm.Grid(dx, (-0.5, -0.5), (1.5, 0.5))
        terms = [FixedSurface(mpm.Plane((shift, 0.0), (1.0, 0.0)), 0.0), heated]
        heat = mpm.Heat(grid, 1.0, 1.0, terms, transfer="apic", tolerance=1e-10)
        with torch.no_grad():
            ends.append(mpm.rollout(heat, bar, 6, 10.0).temperature)
        heat.check()
    torch.testing.assert_close(*ends, rtol=0, atol=0.01)
