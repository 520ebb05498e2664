"""The estimated stable time step against simulations: it is the limit where that is sharp, and never above it."""

import math

import pytest
import torch
from pairs import each_once

import torch_mpm as mpm
from benchmarks.catalogue.laws import having
from benchmarks.stability import adversarial

DENSITY = 1000.0


def simulate(step: mpm.Step, state: mpm.State, dt: torch.Tensor, steps: int) -> torch.Tensor:
    """The largest |v| + dx |C| that a particle of each scene has in these steps."""
    scenes = step.grid.scenes
    largest = torch.zeros(scenes, dtype=state.x.dtype)
    with torch.no_grad():
        for _ in range(steps):
            state = step(state, dt)
            size = state.v.norm(dim=1) + state.C.norm(dim=(1, 2)) * step.grid.dx
            largest = largest.scatter_reduce(0, state.scene.long(), size.nan_to_num(torch.inf), "amax")
    return largest


@pytest.mark.parametrize(
    "law",
    [
        mpm.NeoHookean(E=1e6, nu=0.0),
        mpm.NeoHookean(E=1e6, nu=0.49),
        mpm.WeaklyCompressible(1e6),
        mpm.WeaklyCompressible(10.0, viscosity=3e3),
    ],
    ids=["nu 0", "nu 0.49", "fluid", "viscous"],
)
def test_estimate_is_the_limit_of_an_isolated_particle(law: mpm.Material, kernel: str, dim: int) -> None:
    """One particle feels every velocity gradient, so nothing is lost in the bound: stable at 0.98, unstable at 1.03."""
    grid = mpm.Grid(dx=0.1, lower=(0,) * dim, upper=(1,) * dim, scenes=2, kernel=kernel)
    step = mpm.Step(grid, law)
    x = 0.4 + 0.2 * torch.rand(1, dim, dtype=torch.float64).repeat(2, 1)
    C = 1e-8 * torch.randn(1, dim, dim, dtype=torch.float64).repeat(2, 1, 1)
    mass = torch.ones(2, dtype=torch.float64)
    state = mpm.State(x=x, v=torch.zeros_like(x), mass=mass, volume=mass / DENSITY, C=C, scene=torch.arange(2).int())
    dt = step.stable_dt(state, cfl=1.0) * torch.tensor([0.98, 1.03], dtype=torch.float64)
    growth = simulate(step, state, dt, 200) / (C.norm(dim=(1, 2)) * grid.dx)
    assert growth[0] < 100
    assert growth[1] > 1e4


@pytest.mark.parametrize("transfer", ["apic", "pic", "flip"])
def test_estimate_is_the_limit_of_one_particle_per_cell(transfer: str) -> None:
    """At cell centres the stiffest grid mode is exactly that of the bound; PIC and FLIP lose its velocity."""
    factors = torch.tensor([0.98, 1.15], dtype=torch.float64)
    grid = mpm.Grid(dx=0.125, lower=(0, 0), upper=(1, 1), scenes=2)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e6, nu=0.0), walls="slip", transfer=transfer)
    axis = (torch.arange(-1, 9, dtype=torch.float64) + 0.5) * grid.dx
    x = torch.cartesian_prod(axis, axis)
    volume = torch.full((2 * len(x),), grid.dx**2, dtype=torch.float64)
    v = 1e-8 * torch.randn(len(x), 2, dtype=torch.float64).repeat(2, 1)
    scene = torch.arange(2).repeat_interleave(len(x)).int()
    state = mpm.State(x=x.repeat(2, 1), v=v, mass=DENSITY * volume, volume=volume, scene=scene)
    dt = step.stable_dt(state.replace(v=torch.zeros_like(v)), cfl=1.0) * factors
    wave = math.sqrt(1e6 / DENSITY)
    assert float(dt[0] / factors[0]) == pytest.approx(grid.dx / wave * (1 if transfer == "apic" else math.sqrt(0.5)))
    largest = torch.zeros(2, dtype=torch.float64)
    with torch.no_grad():
        for _ in range(300):
            state = step(state, dt)
            largest = largest.scatter_reduce(0, scene.long(), state.v.norm(dim=1).nan_to_num(torch.inf), "amax")
    assert largest[0] < 1e-6
    assert largest[1] > 1e-4


def at_rest(grid: mpm.Grid, device: str, dtype: torch.dtype = torch.float64, per_scene: int = 4) -> mpm.State:
    x = 0.3 + 0.4 * torch.rand(per_scene * grid.scenes, grid.dim, dtype=dtype, device=device)
    volume = torch.full(x.shape[:1], 1e-3, dtype=dtype, device=device)
    F = torch.eye(grid.dim, dtype=dtype, device=device).repeat(len(x), 1, 1)
    scene = torch.arange(len(x), device=device).remainder(max(grid.scenes, 1)).int()
    return mpm.State(x=x, v=torch.zeros_like(x), mass=DENSITY * volume, volume=volume, F=F, scene=scene)


@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_formula_at_rest_and_in_motion(nu: float, kernel: str, dim: int, device: str) -> None:
    """dx/c with ρ c² = D λ + 2 μ; a speed v adds v/dx to 1/dt."""
    grid = mpm.Grid(dx=0.1, lower=(0,) * dim, upper=(1,) * dim, kernel=kernel)
    law, state = mpm.NeoHookean(E=1e5, nu=nu), at_rest(grid, device)
    lam, mu = 1e5 * nu / ((1 + nu) * (1 - 2 * nu)), 1e5 / (2 * (1 + nu))
    limit = grid.dx * math.sqrt(DENSITY / (dim * lam + 2 * mu)) * (1 if kernel == "quadratic" else math.sqrt(4 / 3))
    assert mpm.stable_dt(grid, law, state).tolist() == pytest.approx([limit])
    assert mpm.stable_dt(grid, law, state, cfl=0.25).tolist() == pytest.approx([0.25 * limit])
    state.v[1, 0] = 2.0
    assert mpm.stable_dt(grid, law, state).tolist() == pytest.approx([1 / (1 / limit + 20)])


def test_viscous_limit(device: str) -> None:
    """Without pressure, dt = dx²/(4 ν)."""
    grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1))
    state = at_rest(grid, device).replace(F=None)
    state = state.replace(J=torch.ones_like(state.mass))
    dt = mpm.stable_dt(grid, mpm.WeaklyCompressible(0.0, viscosity=5.0), state)
    assert dt.tolist() == pytest.approx([grid.dx**2 / (4 * 5.0 / DENSITY)])


def lone(dim: int, speed: float = 0.0, **fields: torch.Tensor) -> mpm.State:
    """One particle in the middle of the domain [0, 1]^D."""
    x = torch.full((1, dim), 0.5, dtype=torch.float64)
    mass = torch.full((1,), 1e-3 * DENSITY, dtype=torch.float64)
    v = torch.zeros_like(x)
    v[0, 0] = speed
    return mpm.State(x=x, v=v, mass=mass, volume=mass / DENSITY, **fields)


@pytest.mark.parametrize("gamma", [1.0, 7.0])
def test_torn_fluid_keeps_half_of_its_volume(gamma: float, kernel: str, dim: int) -> None:
    """A particle of water torn to J = 20 pulls itself together: J falls to a half in a step, and never to zero."""
    grid = mpm.Grid(dx=0.1, lower=(0,) * dim, upper=(1,) * dim, kernel=kernel)
    step = mpm.Step(grid, mpm.WeaklyCompressible(1e5, gamma))
    state = lone(dim, J=torch.full((1,), 20.0, dtype=torch.float64))
    after = step(state, step.stable_dt(state, cfl=1.0))
    assert float(after.J / state.J) == pytest.approx(0.5)


def test_converging_particle_keeps_half_of_its_stretch(kernel: str, dim: int) -> None:
    """A velocity gradient far above c/dx turns a soft solid inside out at the linear limit."""
    grid = mpm.Grid(dx=0.1, lower=(0,) * dim, upper=(1,) * dim, kernel=kernel)
    step = mpm.Step(grid, mpm.NeoHookean(E=1.0, nu=0.0))
    C = torch.zeros(1, dim, dim, dtype=torch.float64)
    C[0, 0, 0] = -1e4
    state = lone(dim, C=C)
    after = step(state, step.stable_dt(state, cfl=1.0))
    assert float(after.F[0, 0, 0]) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.parametrize("position", ["number", "tensor", "function"])
def test_speed_of_a_near_obstacle_counts(position: str, dim: int) -> None:
    """A plate at speed w as a particle at speed w, where it touches nodes of a particle; one far away as none."""
    grid = mpm.Grid(dx=0.1, lower=(0,) * dim, upper=(1,) * dim)
    law = mpm.NeoHookean(E=1e3, nu=0.0)

    def plate(x: float) -> mpm.Plane:
        place, velocity = torch.full((dim,), 0.5), torch.zeros(dim)
        place[0], velocity[0] = x, 3.0
        normal = velocity.tolist()
        if position == "function":
            return mpm.Plane(lambda time: place + velocity * time, normal)
        if position == "tensor":
            return mpm.Plane(place, normal, velocity=velocity)
        return mpm.Plane(place.tolist(), normal, velocity=velocity.tolist())

    def limit(speed: float, *boundaries: mpm.Plane) -> float:
        return float(mpm.Step(grid, law, boundaries=boundaries).stable_dt(lone(dim, speed), 1.0))

    assert limit(0.0, plate(0.45)) == pytest.approx(limit(3.0))
    assert limit(0.0, plate(0.1)) == limit(0.0) > 1.5 * limit(3.0)


@pytest.mark.parametrize("number", [162, 219, 369, 419, 430, 522])
def test_adversarial_rollouts_turn_no_particle_inside_out(number: int) -> None:
    """Impacts, torn water, plates and balls at up to three times the speed of sound, dt at the limit."""
    row = adversarial.run(adversarial.Case.make(number), cfl=1.0, steps=80)
    assert (row["inverted"], row["not finite"]) == (0, 0)


def test_scenes_have_their_own_step(device: str) -> None:
    grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1), scenes=3)
    E = torch.tensor([1e4, 4e4, 9e4], dtype=torch.float64, device=device)
    dt = mpm.stable_dt(grid, mpm.NeoHookean(E=E, nu=0.3), at_rest(grid, device))
    assert torch.allclose(dt[0] / dt, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64, device=device))


def test_degenerate_particles(device: str) -> None:
    """Empty scenes have no limit, particles without meaning do not count, one without mass allows no step."""
    grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1), scenes=3)
    law, state = mpm.NeoHookean(E=1e5, nu=0.3), at_rest(grid, device)
    limit = float(mpm.stable_dt(grid, law, state)[0])
    state = state.replace(scene=state.scene.clamp(max=1))
    state.v[0] = torch.nan
    state.F[3] = torch.nan
    state.F[6] *= torch.tensor([[-1.0], [1.0]], dtype=torch.float64, device=device)
    assert mpm.stable_dt(grid, law, state).tolist() == pytest.approx([limit, limit, math.inf])
    state.mass[0] = 0.0
    state.v[0] = 0.0
    assert mpm.stable_dt(grid, law, state)[0] == 0
    empty = state.select(torch.empty(0, dtype=torch.int64, device=device))
    assert mpm.stable_dt(grid, law, empty).tolist() == [math.inf] * 3
    single = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1))
    assert mpm.stable_dt(single, law, empty.replace(scene=None)).tolist() == [math.inf]


def test_needs_no_synchronisation(device: str) -> None:
    if device == "cpu":
        pytest.skip("only a GPU can be synchronised with")
    grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1), scenes=3)
    law, state = mpm.NeoHookean(E=1e5, nu=0.3), at_rest(grid, device)
    plate = mpm.Plane((0.5, 0.4), (0.0, 1.0), velocity=(0.0, 1.0), angular_velocity=1.0)
    step = mpm.Step(grid, law, boundaries=[plate])
    step.stable_dt(state)
    torch.cuda.set_sync_debug_mode("error")
    try:
        step.stable_dt(state)
        law.update(state)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_bad_arguments() -> None:
    grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1))
    law, state = mpm.NeoHookean(E=1e5, nu=0.3), at_rest(grid, "cpu")
    for cfl in (0, -0.5, math.nan, math.inf):
        with pytest.raises(ValueError, match=f"cfl must be positive and finite, got {cfl}"):
            mpm.stable_dt(grid, law, state, cfl=cfl)
    with pytest.raises(ValueError, match="stress_form must be 'gradient' or 'mls', got 'fem'"):
        mpm.stable_dt(grid, law, state, stress_form="fem")


def test_moving_obstacles_and_particles_without_a_scene(device):
    """A particle whose scene is none of the grid raises nothing."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=2)
    sphere = mpm.Sphere((0.5, 0.5), 0.1, velocity=torch.ones(2, 2, dtype=torch.float64, device=device))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e3, nu=0.3), boundaries=[sphere])
    points = mpm.seed.box((0.4, 0.4), (0.6, 0.6), 0.1, dtype=torch.float64, device=device)
    state = mpm.State.at_rest(points, dtype=torch.float64)
    scene = torch.full((len(state),), 5, dtype=torch.int32, device=device)
    assert bool((step.stable_dt(state.replace(scene=scene)) > 0).all())


def strained(law: mpm.Material, device: str) -> tuple[mpm.Step, mpm.State]:
    """A free particle with a strain of some ten percent, which nothing damps."""
    grid = mpm.Grid(dx=0.1, lower=(0.0, 0.0), upper=(1.0, 1.0))
    F = torch.tensor([[[1.15, -0.03], [-0.22, 1.06]]], dtype=torch.float64)
    ones = torch.ones(1, dtype=torch.float64)
    state = mpm.State(x=torch.full((1, 2), 0.53, dtype=torch.float64), v=torch.zeros(1, 2, dtype=torch.float64),
                      mass=1e-3 * ones, volume=1e-6 * ones, F=F)  # fmt: skip
    step = mpm.Step(grid, law)
    return step, step.prepare(state.to(device))


def energy(step: mpm.Step, state: mpm.State) -> float:
    affine = 0.0 if state.C is None else state.C.square().sum((1, 2)) / step.grid.inverse_inertia
    kinetic = 0.5 * (state.mass * (state.v.square().sum(1) + affine)).sum()
    return float(kinetic + step.law.energy(state).sum())


ELASTIC = having("compiled", without=("fluid", "plastic", "history"))


@pytest.mark.parametrize(*each_once(law=ELASTIC, every=[1, 2, 4, 16]))
def test_a_dt_that_stays_feeds_no_energy_into_oscillations(law, every, device):
    """A dt that followed the limit would raise it to 2 to 15 times its value."""
    step, state = strained(ELASTIC[law](), device)
    first, means, dt = energy(step, state), [], None
    with torch.no_grad():
        for _ in range(4):
            energies = []
            for _ in range(150):
                dt = step.stable_dt(state, previous=dt)
                state = mpm.rollout(step, state, every, dt)
                energies.append(energy(step, state) / first)
            means.append(sum(energies) / len(energies))
    assert means == pytest.approx([means[0]] * 4, rel=0.03)


@pytest.mark.parametrize("law", ELASTIC)
@pytest.mark.parametrize("every", [1, 16])
def test_rollout_to_feeds_no_energy_into_oscillations(law, every, device):
    step, state = strained(ELASTIC[law](), device)
    dt = float(step.stable_dt(state))
    with torch.no_grad():
        end = mpm.rollout_to(step, state, (400 if every == 1 else 3000) * dt, every=every)
    assert 0.5 < energy(step, end.state) / energy(step, state) < 2
    assert float(end.largest_cfl) < 0.8


def test_calls_of_rollout_to_feed_no_energy_into_oscillations(device):
    step, state = strained(mpm.NeoHookean(E=1e4, nu=0.3), device)
    first, interval, previous, energies = energy(step, state), 16 * float(step.stable_dt(state)), None, []
    with torch.no_grad():
        for k in range(1, 81):
            end = mpm.rollout_to(step, state, k * interval, every=1, previous=previous)
            state, previous = end.state, end.dt
            energies.append(energy(step, state) / first)
    assert sum(energies[40:]) == pytest.approx(sum(energies[:40]), rel=0.1)


def test_a_previous_dt_stays_between_half_of_the_limit_and_the_limit(device):
    """Each scene by itself; numbers and tensors."""
    step = mpm.Step(mpm.Grid(dx=0.1, lower=(0.0,) * 2, upper=(1.0,) * 2, scenes=4), mpm.NeoHookean(E=1e4, nu=0.3))
    state = mpm.State.concatenate([strained(step.law, device)[1]] * 4, scene=True)
    limit = step.stable_dt(state)
    shares = torch.tensor([0.49, 0.51, 0.99, 1.01], dtype=torch.float64, device=device)
    for stable_dt in (step.stable_dt, lambda state, **given: mpm.stable_dt(step.grid, step.law, state, 0.5, **given)):
        assert torch.equal(
            stable_dt(state, previous=shares * limit), torch.where(shares.gt(0.5) & shares.lt(1), shares, 1) * limit
        )
        for previous in (0.6 * float(limit[0]), 0.6 * limit[0], 0.6 * limit[:1]):
            assert stable_dt(state, previous=previous).tolist() == [0.6 * float(limit[0])] * 4
        for previous in (0.0, -1.0, math.nan, math.inf):
            assert torch.equal(stable_dt(state, previous=previous), limit)
        with pytest.raises(ValueError, match=r"previous must be a number or have shape .* \[B\] = \[4\], got \[3\]"):
            stable_dt(state, previous=limit[:3])
        with pytest.raises(TypeError, match="previous must be a number or a tensor"):
            stable_dt(state, previous="long")
