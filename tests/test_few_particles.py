"""Many steps of few float32 particles, which one CUDA kernel takes where the pool of blocks is small or holds all of
the domain, against single steps in float64. The particles cross several cells, so that activations are made anew."""

import pytest
import torch
from cases.few_particles import body, crowd
from cases.rollouts import LAWS_HERE, TRANSFERS, assert_equal, one_by_one
from cases.small_scenes import F64, LAWS, assert_same, both, joined
from helpers import relative_error

import torch_mpm as mpm

N, DT = 50, 1e-3


def make(dim, law="neo_hookean", scenes=1, max_blocks=220, **options):
    grid = mpm.Grid(0.05 if dim == 3 else 0.02, (0,) * dim, (1,) * dim, scenes=scenes, max_blocks=max_blocks)
    options = {"gravity": (0.0, -9.8, 0.0)[:dim], "walls": "separate", **options}
    return mpm.Step(grid, (LAWS | LAWS_HERE)[law](), **options)


@pytest.mark.parametrize("law", LAWS)
def test_laws(law, dim, device):
    end, expected = both(make(dim, law), make(dim, law), body(dim, device), N, DT)
    cells = float((end.x.double() - body(dim, device).x).abs().amax()) / (0.05 if dim == 3 else 0.02)
    assert cells > 2
    assert_same(end, expected, 2e-3 if law == "sand" else 1e-4)


@pytest.mark.parametrize("law", LAWS_HERE)
def test_all_laws_in_float32(law, dim, device):
    """Histories and volume ratios too; one particle is outside the grid, where the law acts all the same."""
    state = body(dim, device).to(dtype=torch.float32)
    state.x[5] = -3.0
    with torch.no_grad():
        end = mpm.rollout(make(dim, law), state, 20, 2e-4)
        assert_equal(end, one_by_one(make(dim, law), state, 20, 2e-4))


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_more_particles_than_a_cluster_takes(transfer, dim, device):
    """And a jet in them, so that many particles of an item stray at once."""
    state = body(dim, device, low=0.2, high=0.75 if dim == 3 else 0.78)
    assert 3000 < len(state) < 2**14
    jet = (state.x[:, 0] > 0.4) & (state.x[:, 0] < 0.5)
    state = state.replace(v=state.v + jet[:, None] * torch.tensor([0.0, 25.0, 0.0][:dim], dtype=F64, device=device))
    options = {"walls": "sticky", **TRANSFERS[transfer]}
    end, expected = both(make(dim, **options), make(dim, **options), state, 30, 5e-4)
    assert_same(end, expected, 1e-3)


@pytest.mark.parametrize("high", [0.6, 0.65])
def test_crowded_blocks(high, dim, device):
    """Items have more particles than in steps of single kernels, once a call has the small number of blocks."""
    state = crowd(dim, device, high)
    step, single = make(dim, max_blocks=None), make(dim)
    with torch.no_grad():
        half, _ = both(step, single, state, 20, 5e-4)
        plan = mpm.plan_rollout(step, half, 30, 5e-4)
        assert device == "cpu" or (plan.schedule, plan.max_blocks) == ("persistent", step.grid.block_count)
        end = mpm.rollout(step, half, 30, 5e-4)
    _, expected = both(make(dim), single, state, 50, 5e-4)
    step.check(end)
    assert_same(end, expected, 1e-3)


def test_impulses_on_walls(dim, device):
    state = body(dim, device, speed=8.0)
    step, single = make(dim), make(dim)
    end, expected = both(step, single, step.with_impulses(state), N, DT)
    assert float(expected.impulse.abs().max()) > 0
    assert relative_error(end.impulse, expected.impulse) < 1e-3


def test_a_domain_whose_blocks_all_have_room(dim, device):
    """The second call has the number of active blocks."""
    step, single, state = make(dim, max_blocks=None), make(dim), body(dim, device)
    with torch.no_grad():
        half, _ = both(step, single, state, N, DT)
        end = mpm.rollout(step, half, N, DT)
    _, expected = both(step, single, state, 2 * N, DT)
    step.check(end)
    assert_same(end, expected, 2e-4)


@pytest.mark.parametrize("n", [1, 2, 9, 10, 11, 12])
@pytest.mark.parametrize("flip", [0.0, 0.95])
def test_numbers_of_steps(n, flip, dim, device):
    end, expected = both(make(dim, flip=flip), make(dim, flip=flip), body(dim, device), n, DT)
    assert_same(end, expected, 1e-4)


def test_an_obstacle_that_moves(dim, device):
    def options():
        centre = (0.6, 0.2, 0.5)[:dim]
        return {"boundaries": [mpm.Sphere(centre, 0.2, friction=0.3, velocity=(-2.0, 1.0, 0.0)[:dim])]}

    end, expected = both(make(dim, **options()), make(dim, **options()), body(dim, device), N, DT)
    assert_same(end, expected, 1e-4)


@pytest.mark.parametrize("obstacle", [False, True])
def test_scenes_with_time_steps_of_their_own(obstacle, dim, device):
    def options():
        balls = [mpm.Sphere((0.5, 0.1, 0.5)[:dim], 0.25, velocity=(0.0, 1.0, 0.0)[:dim], kind="slip")]
        return {"boundaries": balls} if obstacle else {}

    state = joined([body(dim), None, body(dim, low=0.4)], device)
    step, single = make(dim, scenes=3, **options()), make(dim, scenes=3, **options())
    dt = torch.tensor([1e-3, 2e-3, 4e-4], device=device)
    end, expected = both(step, single, state, N, dt)
    assert relative_error(end.x.double(), expected.x) < 1e-4
    assert relative_error(end.F.double(), expected.F) < 1e-4
    torch.testing.assert_close(torch.as_tensor(end.time).double(), torch.as_tensor(expected.time), rtol=1e-5, atol=0)


def test_particles_that_leave_on_the_way(dim, device):
    """The status contains the step of the first one; particles that left rest, with their last deformation."""
    state = body(dim, device, speed=1.0)
    v, x = state.v.clone(), state.x.clone()
    v[5:8, 1] = 40.0
    x[4] = torch.nan
    state = state.replace(x=x, v=v)
    step, single = make(dim), make(dim)
    end, expected = both(step, single, state, N, DT)
    assert torch.equal(step.status[:, 1:7], single.status[:, 1:7])
    there = expected.x.isfinite().all(1)
    assert torch.equal(end.x.isfinite().all(1), there) and torch.equal(end.v.isfinite(), expected.v.isfinite())
    for name in ("x", "v", "F"):
        value, right = getattr(end, name)[there], getattr(expected, name)[there]
        assert relative_error(value.double(), right) < 1e-4, name
    with pytest.raises(mpm.SimulationError):
        step.check()


def test_a_full_pool_is_reported(dim, device):
    state = body(dim, device)
    state = state.replace(v=60 * (state.x - 0.45))
    step = make(dim, max_blocks=40 if dim == 2 else 45)
    with torch.no_grad(), pytest.raises(mpm.GridOverflowError, match="max_blocks=4"):
        mpm.rollout(step, step.prepare(state.to(dtype=torch.float32)), 30, DT)
        step.check()
