"""Many steps of one scene of many float32 particles, against single steps in float64. On CUDA a call owns them, sorts
them on the way, and takes them from grid to grid in one kernel while they stay near their blocks, which they leave by
several cells. On a CPU there are fewer."""

import pytest
import torch
from cases.many_particles import N, body, cell, dt_of
from cases.rollouts import LAWS_HERE, assert_equal, one_by_one
from cases.small_scenes import F64, LAWS, assert_same, both
from helpers import relative_error
from pairs import in_pairs

import torch_mpm as mpm

CLOSE = 5e-4
"""Affine fields divide rounding errors of velocities by a small cell. Where a bound is larger, single steps
in float32 differ as much from those in float64: of jets and fast bodies, whose velocities are larger; beside an
obstacle, which a node is in or not."""


def make(dim, device, law="neo_hookean", **options):
    grid = mpm.Grid(cell(dim, device), (0,) * dim, (1,) * dim)
    options = {"gravity": (0.0, -9.8, 0.0)[:dim], "walls": "separate", **options}
    return mpm.Step(grid, (LAWS | LAWS_HERE)[law](), **options)


@pytest.mark.parametrize("law", LAWS)
def test_laws(law, dim, device):
    end, expected = both(make(dim, device, law), make(dim, device, law), body(dim, device), N, dt_of(dim, device))
    cells = float((end.x.double() - body(dim, device).x).abs().amax()) / cell(dim, device)
    assert cells > 3
    assert_same(end, expected, 2e-3 if law == "sand" else CLOSE)


@pytest.mark.parametrize("law", LAWS_HERE)
def test_all_laws_in_float32(law, dim, device):
    """Histories and volume ratios too; one particle is outside the grid, where the law acts all the same."""
    state = body(dim, device).to(dtype=torch.float32)
    state.x[5] = -3.0
    with torch.no_grad():
        end = mpm.rollout(make(dim, device, law), state, 12, 1e-4)
        assert_equal(end, one_by_one(make(dim, device, law), state, 12, 1e-4))


@pytest.mark.parametrize("cells", [0.02, 0.6, 1.7])
def test_speeds(cells, dim, device):
    """The fastest ones may go farther in a step than the blocks around theirs reach."""
    state = body(dim, device, cells)
    end, expected = both(
        make(dim, device, walls="sticky"), make(dim, device, walls="sticky"), state, 12, dt_of(dim, device)
    )
    assert_same(end, expected, 2 * CLOSE)


def test_a_jet(dim, device):
    """A part of the particles leaves the others, and their blocks, behind."""
    state = body(dim, device)
    jet = (state.x[:, 0] > 0.4) & (state.x[:, 0] < 0.5)
    speed = 0.7 * cell(dim, device) / dt_of(dim, device)
    state = state.replace(v=state.v + jet[:, None] * torch.tensor([0.0, speed, 0.0][:dim], dtype=F64, device=device))
    end, expected = both(make(dim, device), make(dim, device), state, N, dt_of(dim, device))
    assert_same(end, expected, 1e-2)


@pytest.mark.parametrize(*in_pairs(n=[3, 4, 5, 6, 17, 18], flip=[0.0, 0.95], dim=[2, 3]))
def test_numbers_of_steps(n, flip, dim, device):
    step, single = make(dim, device, flip=flip), make(dim, device, flip=flip)
    end, expected = both(step, single, body(dim, device), n, dt_of(dim, device))
    assert_same(end, expected, CLOSE)


def test_an_obstacle_that_moves(dim, device):
    def options():
        centre = (0.6, 0.2, 0.5)[:dim]
        return {"boundaries": [mpm.Sphere(centre, 0.2, friction=0.3, velocity=(-2.0, 1.0, 0.0)[:dim])]}

    end, expected = both(
        make(dim, device, **options()), make(dim, device, **options()), body(dim, device), N, dt_of(dim, device)
    )
    assert_same(end, expected, 3e-2)


def test_a_time_step_on_the_device(dim, device):
    dt = torch.tensor([dt_of(dim, device)], device=device)
    end, expected = both(make(dim, device), make(dim, device), body(dim, device), N, dt)
    assert relative_error(end.x.double(), expected.x) < CLOSE
    assert relative_error(end.F.double(), expected.F) < CLOSE


def test_parameters_of_particles(dim, device):
    """Each particle gets its own parameter, wherever it is in memory."""
    state = body(dim, device)
    E = 1e4 * (1 + (state.x[:, 0] > 0.5).float())
    step = mpm.Step(mpm.Grid(cell(dim, device), (0,) * dim, (1,) * dim), mpm.NeoHookean(E=E, nu=0.3))
    single = mpm.Step(step.grid, mpm.NeoHookean(E=E.double(), nu=0.3))
    end, expected = both(step, single, state, N, dt_of(dim, device))
    assert_same(end, expected, CLOSE)


def test_particles_that_leave_on_the_way(dim, device):
    """The status contains step and id of the first one; particles that left rest, with their last deformation."""
    state = body(dim, device, cells=0.05)
    v, x = state.v.clone(), state.x.clone()
    v[5:8, 1] = 0.8 * cell(dim, device) / dt_of(dim, device)
    x[5:8, 1] = 1 - 6.5 * cell(dim, device)
    x[4] = torch.nan
    state = state.replace(x=x, v=v)
    step, single = make(dim, device, walls=None), make(dim, device, walls=None)
    end, expected = both(step, single, state, N, dt_of(dim, device))
    assert torch.equal(step.status[:, 1:7], single.status[:, 1:7])
    there = expected.x.isfinite().all(1)
    assert torch.equal(end.x.isfinite().all(1), there) and torch.equal(end.v.isfinite(), expected.v.isfinite())
    for name in ("x", "v", "F"):
        value, right = getattr(end, name)[there], getattr(expected, name)[there]
        assert relative_error(value.double(), right) < CLOSE, name
    with pytest.raises(mpm.SimulationError):
        step.check()


def test_a_number_that_is_not_finite_on_the_way(dim, device):
    """It spreads as in single steps, and is reported in the same step."""
    state = body(dim, device)
    v = state.v.clone()
    v[7] = torch.inf
    step, single = make(dim, device), make(dim, device)
    end, expected = both(step, single, state.replace(v=v), 6, dt_of(dim, device))
    assert torch.equal(step.status[:, 1:7], single.status[:, 1:7])
    assert torch.equal(end.x.isfinite(), expected.x.isfinite()) and not bool(end.x.isfinite().all())
