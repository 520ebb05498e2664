"""Mirrors in implicit steps beside friction, obstacles and flow; tests/boundaries/test_mirror.py has mirrors alone."""

import math

import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block
from torch_mpm.implicit import Implicit, equilibrium

DX, MIDDLE = 0.125, 1.0


def sand():
    return mpm.QuarticSand(E=1e6, nu=0.3, friction_angle=0.5)


CASES = {
    "friction of the floor": (lambda: mpm.NeoHookean(E=1e5, nu=0.3), {}, []),
    "flow inside": (sand, {"plasticity": "inside"}, []),
    "an obstacle across": (
        lambda: mpm.NeoHookean(E=1e5, nu=0.3),
        {},
        [mpm.Sphere((MIDDLE, 0.5), 0.26, "separate", velocity=(0.0, -1.0), friction=0.3)],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_half_of_a_symmetric_scene(case, device):
    """A block on a rough floor whose halves part, and the right half beside a mirror, in two scenes of one batch."""
    law, options, obstacles = CASES[case]
    grid = mpm.Grid(DX, (0.0, 0.0), (2.0, 1.0), scenes=2)
    whole = block((0.75, 0.0), (1.25, 0.25), grid, device=device)
    whole = whole.replace(v=torch.stack([0.5 * (whole.x[:, 0] - MIDDLE), 0 * whole.x[:, 0]], 1))
    right = (whole.x[:, 0] > MIDDLE).nonzero()[:, 0]
    floor = ("separate", "open"), (0.0, (0.2, 0.0))

    def after(rows, across):
        walls = mpm.Walls((across, floor[0]), (MIDDLE if across != "open" else 0.0, 0.0), friction=floor[1])
        step = mpm.Step(grid, law(), (0.0, -9.8), walls, obstacles, integrator=Implicit(1e-10, **options))
        state = mpm.State.concatenate([whole.select(rows)] * 2)
        scene = torch.arange(2, dtype=torch.int32, device=device).repeat_interleave(len(rows))
        state = step.prepare(state.replace(scene=scene))
        for _ in range(3):
            state = step(state, torch.tensor([2e-3, 4e-3], dtype=torch.float64, device=device))
            assert bool(step.solve_report.converged.all()), step.solve_report
        return state.x.unflatten(0, (2, -1))

    half, all_of_it = after(right, ("mirror", "open")), after(torch.arange(len(whole), device=device), "open")
    assert float((half[:, :, 0] - whole.x[right, 0]).abs().max()) > 5e-4
    torch.testing.assert_close(half, all_of_it[:, right], rtol=0, atol=1e-8)


@pytest.mark.parametrize("stress_form", ["mls", "gradient"])
def test_a_column_on_a_mirror_is_of_second_order(stress_form, kernel, device):
    """Its sag under its weight, of linear elasticity with ν = 0: u = −ρ g/E (H y − y²/2)."""

    def error(cells):
        dx = 1.0 / cells
        grid = mpm.Grid(dx, (0.0, 0.0), (8 * dx, 1.0 + 8 * dx), kernel=kernel)
        state = block((3 * dx, 0.0), (5 * dx, 1.0), grid, device=device)
        walls = mpm.Walls(("open", ("mirror", "open")))
        step = mpm.Step(
            grid, mpm.Hencky(E=1e9, nu=0.0), (0.0, -1.0), walls, integrator=Implicit(1e-9), stress_form=stress_form
        )
        sag = (equilibrium(step, state, 100.0).x - state.x)[:, 1]
        exact = -1e-6 * (state.x[:, 1] - state.x[:, 1].square() / 2)
        return float((sag - exact).norm() / exact.norm())

    coarse, fine = error(8), error(16)
    assert fine < 4e-4 and 1.95 < math.log2(coarse / fine) < 2.4
