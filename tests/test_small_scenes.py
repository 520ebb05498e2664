"""Batches of small float32 scenes, which CUDA takes through a call one by one, against single steps in float64.

Deterministic grids of few particles per scene always go that way there, others where it is faster.
"""

import pytest
import torch
from cases.small_scenes import DT, F32, LAWS, N, assert_same, both, joined
from helpers import relative_error
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state
from torch_mpm.grid.topology import Status


def make(dim, scenes, law, dx=0.1, **options):
    grid = mpm.Grid(dx, (0,) * dim, (1,) * dim, scenes=scenes, **options.pop("grid", {}))
    return mpm.Step(grid, LAWS[law](), gravity=(0.0, -9.8) + (0.0,) * (dim - 2), walls="separate", **options)


@pytest.mark.parametrize(*in_pairs(deterministic=[False, True], law=LAWS, flip=[0.0, 0.95], dim=[2, 3]))
def test_scenes_of_several_sizes(law, flip, dim, deterministic, device):
    lows = (0.3, 0.5, None, 0.2, 0.59)
    blocks = [low and block_state(dim, low=low, high=low + 0.15 + 0.1 * (k % 2)) for k, low in enumerate(lows)]
    state = joined(blocks, device)
    grid = {"deterministic": deterministic}
    step, single = (make(dim, 5, law, flip=flip, grid=grid) for _ in range(2))
    end, expected = both(step, single, state)
    step.check(end)
    assert_same(end, expected, 2e-4 if law == "sand" else 2e-5)
    if deterministic:
        again, _ = both(step, single, state)
        assert all(torch.equal(getattr(end, name), getattr(again, name)) for name in ("x", "v", "C"))


def test_a_scene_with_more_particles_than_the_others_together(device):
    """On CUDA too many for shared memory."""
    large = block_state(2, low=0.1, high=0.9, dx=0.0125)
    state = joined([block_state(2), large] + [block_state(2, low=0.4)] * 6, device)
    assert len(large) > 8000
    assert len(state) < 8 * 4096
    step, single = (make(2, 8, "neo_hookean", dx=0.05, grid={"deterministic": True}) for _ in range(2))
    end, expected = both(step, single, state)
    assert_same(end, expected)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_scene_that_flies_apart(dim, device):
    """It comes to touch more blocks than there is room for on a multiprocessor, and leaves others behind."""
    dx, rate, blocks = (0.00625, 520, 600) if dim == 2 else (0.02, 300, 150)
    cloud = block_state(dim, low=0.45, high=0.55, dx=dx, spin=0.0)
    cloud = cloud.replace(v=rate * (cloud.x - 0.5) + torch.tensor([3.0] + [0.0] * (dim - 1)))
    state = joined([cloud, block_state(dim)], device)
    step, single = (make(dim, 2, "water", dx=dx, grid={"deterministic": True, "max_blocks": 3000}) for _ in range(2))
    end, expected = both(step, single, state, 40, 2.5e-4)
    step.check(end)
    assert int(single.status[0, Status.BLOCKS_WANTED]) > blocks  # wanted at most
    assert torch.equal(step.status[0, Status.BLOCKS_NOW], single.status[0, Status.BLOCKS_NOW])  # and by the last step
    assert_same(end, expected, 1e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_an_obstacle_that_moves(dim, device):
    def ball():
        centre = (0.5, 0.1) + (0.5,) * (dim - 2)
        return mpm.Sphere(centre, 0.25, friction=0.3, velocity=(0.0, 1.0) + (0.0,) * (dim - 2))

    blocks = [block_state(dim), None, block_state(dim, low=0.5, high=0.8)]
    step, single = (make(dim, 3, "neo_hookean", boundaries=[ball()], grid={"deterministic": True}) for _ in range(2))
    end, expected = both(step, single, joined(blocks, device))
    assert_same(end, expected)


@pytest.mark.parametrize("obstacle", [False, True])
def test_scenes_with_time_steps_of_their_own(obstacle, device):
    balls = [mpm.Sphere((0.5, 0.1), 0.25, velocity=(0.0, 1.0), kind="slip")] if obstacle else []
    state = joined([block_state(2), None, block_state(2, low=0.4)], device)
    step, single = (make(2, 3, "neo_hookean", boundaries=balls, grid={"deterministic": True}) for _ in range(2))
    dt = torch.tensor([1e-3, 2e-3, 4e-4], device=device)
    end, expected = both(step, single, state, N, dt)
    assert relative_error(end.x.double(), expected.x) < 2e-5
    assert relative_error(end.v.double(), expected.v) < 2e-5
    torch.testing.assert_close(torch.as_tensor(end.time).double(), torch.as_tensor(expected.time), rtol=1e-6, atol=0)


@pytest.mark.parametrize("deterministic", [False, True])
def test_particles_that_leave_on_the_way(deterministic, device):
    """The status contains the first step in which they did, for each scene, and their ids."""
    blocks = [block_state(2), block_state(2), block_state(2)]
    for k, speed in ((0, 150.0), (2, 70.0)):
        v = blocks[k].v.clone()
        v[5:8, 1] = speed
        blocks[k] = blocks[k].replace(v=v)
    state = joined(blocks, device)
    x = torch.where((state.ids == 4)[:, None], torch.full_like(state.x, torch.nan), state.x)
    state = state.replace(x=x)
    grid = {"deterministic": deterministic}
    step, single = make(2, 3, "neo_hookean", grid=grid), make(2, 3, "neo_hookean", grid=grid)
    end, expected = both(step, single, state)
    assert torch.equal(step.status[:, 1:], single.status[:, 1:])
    assert torch.equal(step.status[1:, Status.BLOCKS_WANTED], single.status[1:, Status.BLOCKS_WANTED])
    there = expected.x.isfinite().all(1)
    assert torch.equal(end.x.isfinite().all(1), there) and torch.equal(end.v.isfinite(), expected.v.isfinite())
    assert relative_error(end.x[there].double(), expected.x[there]) < 2e-5
    assert relative_error(end.v[there].double(), expected.v[there]) < 2e-5
    with pytest.raises(mpm.SimulationError):
        step.check()


def test_a_full_pool_is_reported(device):
    cloud = block_state(2, low=0.45, high=0.55, dx=0.025, spin=0.0)
    cloud = cloud.replace(v=60 * (cloud.x - 0.5))
    step = make(2, 2, "neo_hookean", dx=0.0125, grid={"max_blocks": 12})
    with torch.no_grad(), pytest.raises(mpm.GridOverflowError, match="max_blocks=12"):
        mpm.rollout(step, step.prepare(joined([cloud, cloud], device).to(dtype=F32)), 30, DT)
        step.check()
