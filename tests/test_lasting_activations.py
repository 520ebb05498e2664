"""Activations that serve several substeps of a rollout on the CPU, against single steps, each of which has its own."""

import pytest
import torch
from combinations import F64
from test_rollouts import LAWS_HERE, assert_equal, blob, box, one_by_one, tensors

import torch_mpm as mpm

N, DT = 24, 1e-4


def flow(dim, cells, count=2000, dtype=F64, **fields):
    """Particles in no order that go about so many cells a step together, and a fifth of that by themselves."""
    state = blob("cpu", dim, count, dtype=dtype, **fields)
    along = torch.tensor([1.0, -0.7, 0.4][:dim], dtype=dtype)
    return state.replace(v=(along + 0.2 * state.v) * (cells * box(dim).dx / DT))


@torch.no_grad()
@pytest.mark.parametrize("law", ["neo_hookean", "fluid", "sand", "viscoelastic"])
@pytest.mark.parametrize("options", [{"transfer": "pic"}, {"transfer": "apic"}, {"stress_form": "gradient"}], ids=str)
@pytest.mark.parametrize("cells", [0.01, 0.2])
def test_laws_and_forms(law, options, cells, dim):
    step = mpm.Step(box(dim), LAWS_HERE[law](), walls="separate", **options)
    state = step.prepare(flow(dim, cells))
    assert_equal(mpm.rollout(step, state, N, DT), one_by_one(step, state, N, DT))


@torch.no_grad()
@pytest.mark.parametrize("n", [8, 9, 10, 11, 40])
def test_calls_that_are_just_long_enough(n, dim):
    step = mpm.Step(box(dim), LAWS_HERE["sand"](), walls="slip")
    state = step.prepare(flow(dim, 0.05))
    assert_equal(mpm.rollout(step, state, n, DT), one_by_one(step, state, n, DT))


@torch.no_grad()
def test_the_status_is_that_of_single_steps(dim):
    """The last substep of a call has an activation of its own."""
    statuses = []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(box(dim), LAWS_HERE["neo_hookean"](), walls="slip")
        roll(step, flow(dim, 0.1), N, DT)
        statuses.append(step.status)
    assert torch.equal(*statuses)


@torch.no_grad()
@pytest.mark.parametrize("walls", [None, "sticky"])
def test_at_the_edge_of_the_lattice(walls, dim):
    """Particles come to it from all sides, and leave it where there are no walls."""
    ends = []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(box(dim), LAWS_HERE["neo_hookean"](), walls=walls)
        state = blob("cpu", dim, 1500)
        state = state.replace(v=(state.x - 0.5) * (14 * step.grid.dx / (N * DT)) / 0.2)
        end = roll(step, state, N, DT)
        ends.append(end)
        assert (float((end.x - 0.5).abs().max()) > 0.6) == (walls is None)
    assert_equal(*ends)


@torch.no_grad()
@pytest.mark.parametrize("cells", [0.9, 3.0, 20.0])
def test_a_particle_that_is_much_faster_than_the_others(cells, dim):
    """It is not missed, however far it goes in a step."""
    step = mpm.Step(box(dim, dx=1 / 32), LAWS_HERE["neo_hookean"]())
    state = flow(dim, 0.01)
    state.v[3] = cells * step.grid.dx / DT
    assert_equal(mpm.rollout(step, state, 12, DT), one_by_one(step, state, 12, DT))


@torch.no_grad()
def test_no_room_for_blocks_around(dim):
    """Of particles far apart the blocks around are many times those that they touch: there is no room for them all."""
    g = torch.Generator().manual_seed(4)
    grid = mpm.Grid(dx=1 / 128, lower=(0.0,) * dim, upper=(1.0,) * dim, max_blocks=120)
    x = 0.1 + 0.8 * torch.rand(100, dim, generator=g, dtype=F64)
    x = (x * 32).floor() / 32 + 1.6 / 128  # in the middle of a block, whose nodes alone they touch
    state = mpm.State(x=x, v=torch.zeros_like(x), mass=torch.ones(100, dtype=F64), volume=torch.ones(100, dtype=F64))
    step = mpm.Step(grid, LAWS_HERE["neo_hookean"](), gravity=(0.0, -9.8, 0.0)[:dim])
    end, expected = mpm.rollout(step, state, 12, DT), one_by_one(step, state, 12, DT)
    assert int(step.status[0, 0]) <= 100
    assert_equal(end, expected)


@torch.no_grad()
@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_a_velocity_that_is_not_of_this_world(poison, dim):
    """What is near it is lost, what is far from it is as it was, and the status tells when it was."""
    ends, statuses = [], []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(box(dim, dx=1 / 32), LAWS_HERE["neo_hookean"]())
        state = flow(dim, 0.05)
        state.v[11] = poison
        ends.append(roll(step, state, 12, DT))
        statuses.append(step.status)
    assert torch.equal(*statuses)
    a, b = ends
    for name, value in tensors(a).items():
        other = tensors(b)[name]
        assert torch.equal(value.isnan(), other.isnan()), name
        near = (value.double().abs() < 1e3) & ~value.isnan()
        assert float(near.double().mean()) > 0.5
        assert torch.allclose(value[near].double(), other[near].double(), rtol=1e-6, atol=1e-6), name


@torch.no_grad()
def test_scenes_with_time_steps_of_their_own(dim):
    """One of which stands still."""
    step = mpm.Step(box(dim, scenes=3), LAWS_HERE["neo_hookean"](), walls="separate")
    scene = torch.arange(2000).remainder(3).int()
    state = step.prepare(flow(dim, 0.1, scene=scene).to(dtype=torch.float32))
    dt = torch.tensor([DT, 0.5 * DT, 0.0])
    end, expected = mpm.rollout(step, state, N, dt), one_by_one(step, state, N, dt)
    assert torch.equal(end.x[scene == 2], state.x[scene == 2])
    assert torch.equal(end.time, expected.time)
    assert_equal(end.replace(time=0.0), expected.replace(time=0.0))


@torch.no_grad()
def test_scenes_of_a_deterministic_grid_do_not_depend_on_each_other(dim):
    scene = torch.arange(2000).remainder(2).int()
    ends = []
    for cells in (0.01, 0.4):
        step = mpm.Step(box(dim, scenes=2, deterministic=True), LAWS_HERE["neo_hookean"](), walls="separate")
        slow, fast = flow(dim, 0.05, scene=scene), flow(dim, cells, scene=scene)
        state = slow.replace(v=torch.where(scene[:, None] == 0, slow.v, fast.v))
        ends.append(mpm.rollout(step, state, N, DT).x[scene == 0])
    assert torch.equal(*ends)


@torch.no_grad()
def test_threads_change_nothing_where_particles_stray(dim):
    step = mpm.Step(box(dim, dx=1 / 64), LAWS_HERE["neo_hookean"](), walls="separate")
    state = flow(dim, 0.15, count=20000, dtype=torch.float32)
    ends, threads = [], torch.get_num_threads()
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        try:
            ends.append(tensors(mpm.rollout(step, state, N, DT)))
        finally:
            torch.set_num_threads(threads)
    for other in ends[1:]:
        assert all(torch.equal(value, other[name]) for name, value in ends[0].items())
