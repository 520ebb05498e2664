"""Plastic flow inside implicit steps: against differences, explicit steps, analytic stresses, and steps of the same
motion that are shorter."""

import math

import pytest
import torch
from helpers import relative_error
from pairs import each_once

import torch_mpm as mpm
from benchmarks.catalogue.laws import having, named
from benchmarks.catalogue.scenes import block, short_bar
from torch_mpm.implicit import Implicit
from torch_mpm.implicit.system import ImplicitSystem
from torch_mpm.laws.flowing import flowing_stress, flowing_tangent
from torch_mpm.laws.parameters import Overlay
from torch_mpm.ops import implicit_apply

KINDS = having("plastic") | named("sand_full", "sand_hencky", "sand_mixed")
LAWS = {name: law(1e6, 0.3, 0.02) for name, law in KINDS.items()}
ASSOCIATED = ("von_mises", "herschel_bulkley")


def body(dim, device="cpu", dtype=torch.float64, per_cell=None):
    return short_bar(dim, device, dtype, density=1600.0, per_cell=per_cell)


def pulled(state, rate):
    """With a velocity field that stretches along x."""
    dim = state.x.shape[1]
    C = torch.zeros(len(state), dim, dim).to(state.x)
    C[:, 0, 0] = rate
    return state.replace(v=(C @ (state.x - state.x.mean(0))[:, :, None])[:, :, 0], C=C)


def sheared(state):
    """State with deformations of a few percent, compressed on average; some particles flow."""
    generator = torch.Generator().manual_seed(0)
    P, dim = state.x.shape
    F = torch.eye(dim) * 0.97 + 0.03 * torch.randn(P, dim, dim, generator=generator)
    return state.replace(F=F.to(state.x))


@pytest.mark.parametrize("name", LAWS)
def test_tangent_of_a_flow(name, dim, device):
    """Against differences of the stress, as a bilinear form: all of it where the flow is associated, otherwise the
    symmetric part. Particles beside a corner of the yield surface, where differences mix branches, are excluded."""
    grid, state = body(dim, device, per_cell=16 if dim == 2 else 8)
    law = LAWS[name]
    state = mpm.Step(grid, law).prepare(sheared(state))
    state = Overlay(state, dt=1e-2)
    torch.manual_seed(1)
    P = len(state.x)
    L, a, b = (torch.randn(P, dim, dim, dtype=torch.float64).to(device) for _ in range(3))

    def stress(velocity_gradient):
        eye = torch.eye(dim, dtype=torch.float64, device=device)
        return flowing_stress(law, Overlay(state, F=(eye + velocity_gradient) @ state.F), state)

    trial = Overlay(state, F=state.F + 0.01 * L @ state.F)
    tangent = flowing_tangent(law, trial, state, torch.ones_like(state.mass), False)

    def difference(along, h):
        return (stress(0.01 * L + h * along) - stress(0.01 * L - h * along)) / (2 * h)

    smooth = (difference(a, 1e-6) - difference(a, 4e-6)).norm(dim=(1, 2)) < 1e-4 * difference(a, 1e-6).norm(dim=(1, 2))
    smooth &= (difference(b, 1e-6) - difference(b, 4e-6)).norm(dim=(1, 2)) < 1e-4 * difference(b, 1e-6).norm(dim=(1, 2))
    flows = law.return_map(trial, details=True).branch > 0
    assert int((smooth & flows).sum()) >= 3
    applied_a, applied_b = (apply_tangent(tangent, along) for along in (a, b))
    if name in ASSOCIATED:
        assert relative_error(applied_a[smooth], difference(a, 1e-6)[smooth]) < 1e-6
    form = 0.5 * ((b * difference(a, 1e-6)).sum((1, 2)) + (a * difference(b, 1e-6)).sum((1, 2)))
    assert relative_error((b * applied_a).sum((1, 2))[smooth], form[smooth]) < 1e-6
    assert relative_error((a * applied_b).sum((1, 2)), (b * applied_a).sum((1, 2))) < 1e-10


def apply_tangent(tangent, L):
    """The product of tangents and velocity gradients by the op, for one particle in each of many scenes."""
    P, dim = L.shape[:2]
    grid = mpm.Grid(1.0, (0,) * dim, (1.0,) * dim, scenes=P)
    x = torch.full((P, dim), 0.4, dtype=L.dtype, device=L.device)
    blocks = grid.activate(x, torch.arange(P, dtype=torch.int32, device=L.device))
    v = torch.zeros(blocks.node_count, dim, dtype=L.dtype, device=L.device)
    nodes, scene = blocks.node_positions(L.dtype), blocks.node_scene().long().clamp_min(0)
    v = (L[scene] @ (nodes - 0.4)[:, :, None])[:, :, 0]
    product = implicit_apply(blocks, x, v, tangent)
    # Σ_i (H v)_i (x_i − x_p)ᵀ is the impulse that the scatter spread over the nodes.
    spread = product[:, :, None] * (nodes - 0.4)[:, None, :]
    active = blocks.node_scene() >= 0
    return torch.zeros_like(L).index_add_(0, scene[active], spread[active])


@pytest.mark.parametrize("name", LAWS)
def test_a_short_step_is_an_explicit_one(name, device):
    """The difference of one step is of second order in dt, with flow in every particle that yields."""
    grid, state = body(2, device)
    law, differences = LAWS[name], []
    state = sheared(pulled(state, -3.0))
    for dt in (1e-5, 5e-6):
        ends = [
            mpm.Step(grid, law, integrator=integrator)(state, dt).v
            for integrator in ("explicit", Implicit(1e-10, plasticity="inside"))
        ]
        differences.append(float((ends[0] - ends[1]).norm()))
        assert differences[-1] < 0.1 * float((ends[0] - state.v).norm())
    # Herschel and Bulkley's fluid flows by dt, so that its stress is not continuous as dt → 0.
    assert name == "herschel_bulkley" or 3.0 < differences[0] / differences[1] < 5.0


@pytest.mark.parametrize("energy", ["full", "hencky", "unilateral"])
def test_sand_that_is_pulled_apart_bears_no_tension(energy, dim, device):
    """With any energy: the flow after the solve leaves 1.4% to 22% of the rate of full energies."""
    grid, state = body(dim, device)
    law = mpm.QuarticSand(E=1e7, nu=0.3, friction_angle=0.6, energy=energy)
    step = mpm.Step(grid, law, integrator=Implicit(1e-8, plasticity="inside"))
    after = step(pulled(state, 2.0), 0.05)
    assert bool(step.solve_report.converged.all())
    assert abs(float(after.C[:, 0, 0].mean()) / 2 - 1) < 1e-4


def tension(dim, steps, device, plasticity="inside", dtype=torch.float64):
    """A bar of von Mises' material between two clamps, pulled by 3% in a second: stress in its middle."""
    grid = mpm.Grid(0.125, (-0.5,) * dim, (3.0,) + (1.5,) * (dim - 1))
    state = block((0.0, 0.5, 0.5)[:dim], (1.5, 0.75, 0.75)[:dim], grid, dtype=dtype, device=device)
    law = mpm.VonMises(E=1e6, nu=0.3, yield_stress=1e4, hardening=1e4)
    along, back = (1.0, 0.0, 0.0)[:dim], (-1.0, 0.0, 0.0)[:dim]
    clamps = [
        mpm.Plane((0.2, 0.0, 0.0)[:dim], along, "sticky"),
        mpm.Plane((1.3, 0.0, 0.0)[:dim], back, "sticky", velocity=(0.035, 0.0, 0.0)[:dim]),
    ]
    integrator = Implicit(1e-8 if dtype == torch.float64 else 1e-4, plasticity=plasticity)
    step = mpm.Step(grid, law, boundaries=clamps, integrator=integrator)
    for _ in range(steps):
        state = step(state, 1.0 / steps)
        assert bool(step.solve_report.converged.all())
    fields, stress = law.update(state)
    middle = (state.x[:, 0] - 0.75).abs() < 0.15
    return stress[middle].mean(0), float(fields["plastic_strain"][middle].mean())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_bar_yields_at_its_yield_stress_in_one_long_step(dim, dtype, device):
    """σ_y + H ε̄ in tension, 2/√3 of it in plane strain, and nothing across; flow after the solve leaves nearly the
    elastic stress along and across."""
    stress, strain = tension(dim, 1, device, dtype=dtype)
    expected = (1e4 + 1e4 * strain) * (1 if dim == 3 else 2 / math.sqrt(3))
    assert abs(float(stress[0, 0]) / expected - 1) < 0.005
    assert float(stress[1, 1].abs()) < 0.005 * expected
    after, _ = tension(dim, 1, device, "after", dtype)
    assert float(after[0, 0]) > 1.4 * expected


def test_many_steps_yield_as_one(device):
    one, many = (tension(2, steps, device) for steps in (1, 4))
    assert relative_error(many[0][0, 0], one[0][0, 0]) < 0.01 and abs(many[1] / one[1] - 1) < 0.15


@pytest.mark.parametrize(*each_once(name=LAWS, dtype=[torch.float32, torch.float64]))
def test_every_plastic_law_converges(name, dtype, device):
    """A block falls on the floor, with friction there, at five times the explicit limit of elastic waves."""
    grid, state = body(2, device, dtype)
    state = state.replace(x=state.x - state.x.new_tensor([0.0, 0.5]), v=state.v + state.v.new_tensor([0.0, -2.0]))
    tolerance = 1e-3 if dtype == torch.float32 else 1e-6
    walls = mpm.Walls(("open", ("separate", "open")), friction=(0.0, (0.4, 0.0)))
    step = mpm.Step(grid, LAWS[name], (0.0, -9.8), walls, integrator=Implicit(tolerance, plasticity="inside"))
    flowed = False
    for _ in range(3):
        state = step(state, 2e-2)
        assert bool(step.solve_report.converged.all()), step.solve_report
        flowed = flowed or bool((step.law.return_map(Overlay(state, dt=2e-2), details=True).branch > 0).any())
    step.check(state)
    assert flowed


def test_laws_that_do_not_flow_are_solved_as_before(device):
    """A mixture of an elastic solid, a fluid and a metal that does not yield."""
    grid, state = body(2, device)
    generator = torch.Generator().manual_seed(0)
    material = torch.randint(3, (len(state),), generator=generator).int().to(device)
    state = pulled(state.replace(material=material, J=torch.ones_like(state.mass)), 1.0)
    laws = [mpm.NeoHookean(E=1e5, nu=0.3), mpm.WeaklyCompressible(1e5), mpm.VonMises(E=1e5, nu=0.3, yield_stress=1e9)]
    ends = [
        mpm.Step(grid, mpm.Mixture(laws), integrator=Implicit(1e-10, plasticity=p))(state, 1e-2).v
        for p in ("after", "inside")
    ]
    assert relative_error(ends[1], ends[0]) < 1e-7


def test_scenes_are_solved_as_alone(device):
    _, one = body(2, device)
    pair = mpm.Grid(0.125, (0, 0), (2.0, 1.5), scenes=2)
    states = [pulled(one, -2.0), sheared(pulled(one, 1.0))]
    states[0] = states[0].replace(F=torch.eye(2).to(one.x).repeat(len(one), 1, 1))
    together = mpm.State.concatenate(
        [s.replace(scene=torch.full((len(s),), b, dtype=torch.int32, device=device)) for b, s in enumerate(states)]
    )
    integrator = Implicit(1e-10, plasticity="inside")
    law = LAWS["von_mises"]
    after = mpm.Step(pair, law, walls="slip", integrator=integrator)(together, 5e-3)
    for b, state in enumerate(states):
        alone = mpm.Grid(0.125, (0, 0), (2.0, 1.5))
        own = mpm.Step(alone, law, walls="slip", integrator=Implicit(1e-10, plasticity="inside"))
        assert relative_error(after.v[together.scene == b], own(state, 5e-3).v) < 1e-7


@pytest.mark.parametrize("flows", [False, True])
def test_residual_in_float32(flows, dim, device):
    """Against float64: some units in the last place of the summands: momenta, stresses of strains of one."""
    law, dt, residuals = LAWS["von_mises"], 1e-3, []
    for dtype in (torch.float64, torch.float32):
        grid, state = body(dim, device, torch.float64)
        state = mpm.Step(grid, law).prepare(sheared(pulled(state, 3.0)))
        extra = {n: value.to(dtype) for n, value in state.extra.items()}
        fields = {n: getattr(state, n).to(dtype) for n in ("x", "v", "F", "C", "mass", "volume")}
        state = state.replace(**fields, extra=extra)
        blocks = grid.activate(state.x)
        nodes = mpm.p2g(blocks, state.x, state.mass, state.v, state.C)
        start = mpm.grid_update(blocks, nodes)
        system = ImplicitSystem(blocks, law, Overlay(state, dt=dt), nodes[:, 0], start, dt, "mls", flows)
        v = start + 0.1 * torch.sin(30 * blocks.node_positions(dtype)) * (nodes[:, :1] > 0)
        residuals.append(system.residual(v).double())
        scale = (nodes[:, :1] * v).norm() + dt / grid.dx * (state.volume * law.stiffness(state)).norm()
    assert float((residuals[1] - residuals[0]).norm()) < 30 * torch.finfo(torch.float32).eps * float(scale)
    assert float(residuals[0].norm()) > 1e-3 * float(scale)


@pytest.mark.parametrize("count", [0, 1])
def test_no_particle_and_one(count, dim, device):
    grid, state = body(dim, device)
    state = state.replace(**{n: getattr(state, n)[:count] for n in ("x", "v", "mass", "volume")})
    step = mpm.Step(grid, LAWS["snow"], (0, -9.8, 0)[:dim], integrator=Implicit(plasticity="inside"))
    after = step(state, 0.1)
    assert len(after) == count and bool(step.solve_report.converged.all())


def test_inverted_particles_have_no_stress(device):
    grid, state = body(2, device)
    F = torch.eye(2, dtype=torch.float64, device=device).repeat(len(state), 1, 1)
    F[3, 0, 0], F[4, 0, 0], F[5] = -1.0, 0.0, torch.nan
    step = mpm.Step(grid, LAWS["von_mises"], integrator=Implicit(plasticity="inside"))
    after = step(pulled(state.replace(F=F), 5.0), 0.01)
    assert bool(step.solve_report.converged.all())
    assert bool(after.x.isfinite().all()) and bool(after.v.isfinite().all())


def test_a_plasticity_that_is_not_there():
    with pytest.raises(ValueError, match=r"plasticity must be one of \['after', 'inside'\], got 'before'"):
        Implicit(plasticity="before")
