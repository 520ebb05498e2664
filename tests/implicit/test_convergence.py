"""When a solve counts as converged: only where the body is as far as the forces on it take it."""

import pytest
import torch
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block
from torch_mpm.implicit import Implicit, equilibrium

DX, DENSITY, G = 0.02, 1000.0, 9.81


def strip(layers, dtype, device="cpu", length=0.5, reach=0.0):
    """A grid, and a strip of particles in some rows, from inside a clamp at x = 0 to `length`, or as far into another
    clamp there."""
    thickness = layers * DX / 2
    grid = mpm.Grid(DX, (-0.2, -0.6), (length + 0.1, 0.3))
    points = mpm.seed.box((-0.1, -thickness / 2), (length + reach, thickness / 2), grid, per_cell=4, dtype=dtype)
    return grid, mpm.State.at_rest(points, density=DENSITY, dtype=dtype, device=device)


def clamp(x, side):
    return mpm.Plane((x, 0.0), (side, 0.0), kind="sticky")


def cantilever_sag(E, layers, length=0.5, nu=0.3):
    """Sag by Euler-Bernoulli theory, with the second moment of area of rows of particles."""
    rows = (torch.arange(layers, dtype=torch.float64) - (layers - 1) / 2) * DX / 2
    weight = DENSITY * G * layers * DX / 2
    return weight * length**4 * (1 - nu**2) / (8 * E * float(rows.square().sum()) * DX / 2)


@pytest.mark.parametrize(
    *in_pairs(stress_form=["mls", "gradient"], E=[1e6, 1e8, 1e9, 1e10], dtype=[torch.float32, torch.float64])
)
def test_a_strip_without_bending_stiffness_is_not_solved(E, dtype, stress_form, device):
    """One row of particles bends without energy: it falls until it hangs. What a solve leaves of that is reported."""
    grid, start = strip(1, dtype, device)
    law = mpm.NeoHookean(E=E, nu=0.3)
    integrator = Implicit(1e-6, max_iterations=8)
    step = mpm.Step(grid, law, (0, -G), boundaries=[clamp(0.0, 1.0)], stress_form=stress_form, integrator=integrator)
    end = equilibrium(step, start, 1e3)
    assert not bool(step.solve_report.converged)
    with pytest.raises(mpm.SimulationError, match="implicit steps missed their tolerance"):
        step.check(end)


@pytest.mark.parametrize(*in_pairs(dt=[1e2, 1e3, 1e6], E=[1e9, 1e11], dtype=[torch.float32, torch.float64]))
def test_a_strip_of_two_rows_sags(E, dtype, dt, device):
    """For any stiffness and length of the step, in either precision."""
    grid, start = strip(2, dtype, device)
    law = mpm.NeoHookean(E=E, nu=0.3)
    step = mpm.Step(grid, law, (0, -G), boundaries=[clamp(0.0, 1.0)], integrator=Implicit(1e-6))
    end = equilibrium(step, start, dt)
    step.check(end)
    assert bool(step.solve_report.converged)
    sag = float((start.x - end.x)[:, 1].max())
    assert abs(sag / cantilever_sag(E, 2) - 1) < 0.08


@pytest.mark.parametrize(
    *in_pairs(dt=[1.0, 1e2, 1e3], E=[1e7, 1e8, 1e9], law=[mpm.Hencky, mpm.NeoHookean, mpm.FixedCorotated])
)
def test_a_beam_stays_at_its_clamp(law, E, dt, device):
    """Torn off and falling, a body of logarithmic strain has less energy than at rest, if the step is long."""
    grid, start = strip(4, torch.float64, device, length=0.2)
    step = mpm.Step(grid, law(E=E, nu=0.3), (0, -G), boundaries=[clamp(0.0, 1.0)], integrator=Implicit(1e-6))
    end = equilibrium(step, start, dt)
    step.check(end)
    sag = float((start.x - end.x)[:, 1].max())
    assert abs(sag / cantilever_sag(E, 4, length=0.2) - 1) < 0.1


@pytest.mark.parametrize("dt", [1e2, 1e3])
def test_a_beam_in_3d_stays_at_its_clamp(dt, device):
    """The sag is that of another law, if the solve converges or not."""
    grid = mpm.Grid(DX, (-0.1, -0.2, -0.1), (0.2, 0.2, 0.1))
    start = block((-0.06, -0.02, -0.02), (0.1, 0.02, 0.02), grid, density=DENSITY, dtype=torch.float64, device=device)
    sags = []
    for law in (mpm.Hencky, mpm.NeoHookean):
        held = mpm.Plane((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), kind="sticky")
        integrator = Implicit(1e-6, max_iterations=8)
        step = mpm.Step(grid, law(E=1e7, nu=0.3), (0, -G, 0), boundaries=[held], integrator=integrator)
        sags.append(float((start.x - equilibrium(step, start, dt).x)[:, 1].max()))
    assert abs(sags[0] / sags[1] - 1) < 0.01 and sags[1] < 2e-4


def test_a_body_that_its_load_tears_off_is_reported(device):
    """Its weight exceeds the largest force of logarithmic strain, E/e."""
    grid, start = strip(4, torch.float64, device, length=0.2)
    law = mpm.Hencky(E=100.0, nu=0.3)
    step = mpm.Step(grid, law, (0, -G), boundaries=[clamp(0.0, 1.0)], integrator=Implicit(1e-6))
    end = equilibrium(step, start, 1e3)
    with pytest.raises(mpm.SimulationError, match="particles left the grid"):
        step.check(end)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_strip_across_a_span_hangs_as_a_membrane(dtype, device):
    """One row of particles, held at both ends, is no stiffer than a fall until it sags: f³ = 3 ρ g L⁴/(64 E)."""
    length, E = 0.8, 1e6
    grid, start = strip(1, dtype, device, length, reach=0.04)
    step = mpm.Step(
        grid,
        mpm.NeoHookean(E=E, nu=0.0),
        (0, -G),
        boundaries=[clamp(0.0, 1.0), clamp(length, -1.0)],
        integrator=Implicit(1e-6),
    )
    end = equilibrium(step, start, 1e3)
    step.check(end)
    sag = float((start.x - end.x)[:, 1].max())
    assert abs(sag / (3 * DENSITY * G * length**4 / (64 * E)) ** (1 / 3) - 1) < 0.03


@pytest.mark.parametrize("most", [300, 4000])
def test_a_linear_solve_that_ends_early_is_no_convergence(most, device):
    """A slender beam in float32, whose load is below the rounding of its stresses: the sag is right, or reported."""
    h, length, E, dx = 0.1, 4.0, 1e7, 0.05
    sag = 0.01 * length
    gravity = sag * 8 * E * h**2 / 12 / (DENSITY * length**4)
    grid = mpm.Grid(dx, (-0.2, -0.4), (length + 0.1, 0.4))
    start = block((-2 * dx, -h / 2), (length, h / 2), grid, density=DENSITY, dtype=torch.float32, device=device)
    integrator = Implicit(1e-4, max_iterations=4, max_cg_iterations=most)
    step = mpm.Step(
        grid, mpm.NeoHookean(E=E, nu=0.0), (0, -gravity), boundaries=[clamp(0.0, 1.0)], integrator=integrator
    )
    end = equilibrium(step, start, 1e3)
    right = abs(float((start.x - end.x)[:, 1].max()) / sag - 1) < 0.07
    assert bool(step.solve_report.converged) == right == (most == 4000)
