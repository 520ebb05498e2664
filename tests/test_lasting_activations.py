"""Activations shared by several substeps of a rollout on the CPU, against single steps with one activation each."""

import pytest
import torch
from cases.rollouts import LAWS_HERE, assert_equal, one_by_one, tensors
from combinations import F64
from pairs import in_pairs

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box

N, DT = 24, 1e-4
MOST_BLOCKS, ACTIVATIONS, PROBLEM, BLOCKS_NOW = 0, 5, 6, 7  # columns of the status, see csrc/grid/status.h


def flow(dim, cells, count=2000, dtype=F64, **fields):
    """Unsorted particles with a common motion of about `cells` cells per step, and a fifth of it at random."""
    state = blob("cpu", dim, count, dtype=dtype, **fields)
    along = torch.tensor([1.0, -0.7, 0.4][:dim], dtype=dtype)
    return state.replace(v=(along + 0.2 * state.v) * (cells * unit_box(dim).dx / DT))


@torch.no_grad()
@pytest.mark.parametrize(*in_pairs(law=["neo_hookean", "fluid", "sand", "viscoelastic"], cells=[0.01, 0.2], dim=[2, 3]))
@pytest.mark.parametrize("options", [{"transfer": "pic"}, {"transfer": "apic"}, {"stress_form": "gradient"}], ids=str)
def test_laws_and_forms(law, options, cells, dim):
    step = mpm.Step(unit_box(dim), LAWS_HERE[law](), walls="separate", **options)
    state = step.prepare(flow(dim, cells))
    assert_equal(mpm.rollout(step, state, N, DT), one_by_one(step, state, N, DT))


@torch.no_grad()
@pytest.mark.parametrize("n", [8, 9, 10, 11, 40])
def test_calls_that_are_just_long_enough(n, dim):
    step = mpm.Step(unit_box(dim), LAWS_HERE["sand"](), walls="slip")
    state = step.prepare(flow(dim, 0.05))
    assert_equal(mpm.rollout(step, state, n, DT), one_by_one(step, state, n, DT))


@torch.no_grad()
def test_the_status_tells_of_the_last_substep(dim):
    """It has an activation of its own."""
    statuses = []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(unit_box(dim), LAWS_HERE["neo_hookean"](), walls="slip")
        roll(step, flow(dim, 0.1), N, DT)
        statuses.append(step.status)
    peaks = [int(s[0, MOST_BLOCKS]) for s in statuses]
    assert int(statuses[0][0, BLOCKS_NOW]) <= peaks[0] <= peaks[1]
    for status in statuses:
        status[0, MOST_BLOCKS] = 0
    assert torch.equal(*statuses)


@torch.no_grad()
@pytest.mark.parametrize("walls", [None, "sticky"])
def test_at_the_edge_of_the_lattice(walls, dim):
    """Particles come to it from all sides, and leave it where there are no walls."""
    ends = []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(unit_box(dim), LAWS_HERE["neo_hookean"](), walls=walls)
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
    step = mpm.Step(unit_box(dim, dx=1 / 32), LAWS_HERE["neo_hookean"]())
    state = flow(dim, 0.01)
    state.v[3] = cells * step.grid.dx / DT
    assert_equal(mpm.rollout(step, state, 12, DT), one_by_one(step, state, 12, DT))


@torch.no_grad()
def test_no_room_for_blocks_around(dim):
    """Distant particles have many more neighbouring blocks than touched ones, too many for the pool."""
    g = torch.Generator().manual_seed(4)
    grid = mpm.Grid(dx=1 / 128, lower=(0.0,) * dim, upper=(1.0,) * dim, max_blocks=120)
    x = 0.1 + 0.8 * torch.rand(100, dim, generator=g, dtype=F64)
    x = (x * 32).floor() / 32 + 1.6 / 128  # in the middle of a block, whose nodes alone they touch
    state = mpm.State(x=x, v=torch.zeros_like(x), mass=torch.ones(100, dtype=F64), volume=torch.ones(100, dtype=F64))
    step = mpm.Step(grid, LAWS_HERE["neo_hookean"](), gravity=(0.0, -9.8, 0.0)[:dim])
    end, expected = mpm.rollout(step, state, 12, DT), one_by_one(step, state, 12, DT)
    assert int(step.status[0, MOST_BLOCKS]) <= 100
    assert_equal(end, expected)


@torch.no_grad()
@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_a_velocity_that_is_not_of_this_world(poison, dim):
    """Particles near it are lost, distant ones are unchanged, and the status contains the step."""
    ends, statuses = [], []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(unit_box(dim, dx=1 / 32), LAWS_HERE["neo_hookean"]())
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
    """One scene has dt = 0."""
    step = mpm.Step(unit_box(dim, scenes=3), LAWS_HERE["neo_hookean"](), walls="separate")
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
        step = mpm.Step(unit_box(dim, scenes=2, deterministic=True), LAWS_HERE["neo_hookean"](), walls="separate")
        slow, fast = flow(dim, 0.05, scene=scene), flow(dim, cells, scene=scene)
        state = slow.replace(v=torch.where(scene[:, None] == 0, slow.v, fast.v))
        ends.append(mpm.rollout(step, state, N, DT).x[scene == 0])
    assert torch.equal(*ends)


@torch.no_grad()
def test_threads_change_nothing_where_particles_stray(dim):
    step = mpm.Step(unit_box(dim, dx=1 / 64), LAWS_HERE["neo_hookean"](), walls="separate")
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


@torch.no_grad()
@pytest.mark.parametrize(
    ("cells", "left"),
    [(0.0114, 0.064), (0.0201, 0.022), (0.0292, 0.061), (0.0158, 0.14), (0.0471, 0.195), (0.0115, 0.147)],
)
def test_the_end_of_a_lattice_far_from_the_origin(cells, left):
    """A particle moves by `cells` per step and starts `left` cells from the end. Its position in float32 is rounded to
    a hundredth of a cell there, so that it may leave earlier than its velocity implies."""
    dx, lower = 0.0137, 1000.0
    x = torch.tensor([[lower + (154 - 2.5 - left) * dx, lower + 0.2]])
    ends, statuses = [], []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(mpm.Grid(dx, (lower,) * 2, (lower + 2,) * 2), mpm.NeoHookean(E=1e-3, nu=0.3))
        v = torch.tensor([[cells * dx / DT, 0.0]])
        state = step.prepare(mpm.State(x=x, v=v, mass=torch.ones(1), volume=1e-9 * torch.ones(1)))
        ends.append(roll(step, state, N, DT).x)
        statuses.append(step.status)
    assert torch.equal(*statuses)
    assert int(statuses[0][0, PROBLEM]) >= 0
    assert torch.equal(*ends)


def test_gradients_with_as_many_blocks_as_the_pool_has():
    """A block is active in some substeps only; a pool too small for it is reported before the backward pass."""
    dx = 1 / 32
    x = torch.tensor([[10.1 * dx, 10.0 * dx]], dtype=F64)
    v = torch.tensor([[0.1 * dx / DT, 0.0]], dtype=F64).requires_grad_()
    ones = torch.ones(1, dtype=F64)
    state = mpm.State(x=x, v=v, mass=ones, volume=1e-6 * ones)
    with pytest.raises(mpm.GridOverflowError):
        mpm.rollout(mpm.Step(unit_box(2, dx, max_blocks=1), mpm.NeoHookean(E=1e-3, nu=0.3)), state, 46, DT)
    end = mpm.rollout(mpm.Step(unit_box(2, dx, max_blocks=2), mpm.NeoHookean(E=1e-3, nu=0.3)), state, 46, DT)
    (grad,) = torch.autograd.grad(end.x.sum(), v)
    assert torch.allclose(grad, torch.full_like(grad, 46 * DT))


@torch.no_grad()
@pytest.mark.parametrize("scenes", [1, 3])
def test_no_particles(scenes, dim):
    step = mpm.Step(unit_box(dim, scenes=scenes), LAWS_HERE["sand"](), walls="slip")
    none = torch.zeros(0, dtype=torch.int32) if scenes > 1 else None
    state = step.prepare(blob("cpu", dim).select(torch.arange(0)).replace(scene=none))
    assert len(mpm.rollout(step, state, N, DT)) == 0
    assert int(step.status[0, ACTIVATIONS]) == N


@torch.no_grad()
def test_the_pool_grows_while_activations_last(dim):
    """Particles fly apart from a few blocks."""
    ends = []
    for roll in (mpm.rollout, one_by_one):
        grid = unit_box(dim, 1 / 64)
        step = mpm.Step(grid, LAWS_HERE["neo_hookean"]())
        state = blob("cpu", dim, 1000)
        x = 0.5 + 0.1 * (state.x - 0.5)
        state = state.replace(x=x, v=(x - 0.5) * (12 * grid.dx / (40 * DT)) / 0.02)
        before = grid.max_blocks
        ends.append(roll(step, state, 40, DT))
        assert grid.max_blocks > (before or 0)
    assert_equal(*ends)


@torch.no_grad()
def test_many_chunks_in_a_block(dim):
    step = mpm.Step(unit_box(dim, 1 / 8), LAWS_HERE["fluid"](), walls="separate")
    state = step.prepare(flow(dim, 0.03, count=9000))
    assert_equal(mpm.rollout(step, state, N, DT), one_by_one(step, state, N, DT))


@torch.no_grad()
@pytest.mark.parametrize("walls", ["mirror", "separate"])
def test_walls_and_impulses_of_what_strays(walls, dim):
    ends = []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(unit_box(dim, 1 / 32), LAWS_HERE["neo_hookean"](), walls=walls, gravity=(0.0, -9.8, 0.0)[:dim])
        step.boundaries = [mpm.Box((0.62,) * dim, (0.1,) * dim, kind="slip", velocity=(-3.0, 1.0, 0.0)[:dim])]
        state = flow(dim, 0.1)
        state = state.replace(x=state.x - 0.28)
        ends.append(roll(step, step.with_impulses(step.prepare(state)), N, DT))
    assert float(ends[1].impulse.abs().max()) > 0
    assert_equal(*ends)


@torch.no_grad()
def test_an_obstacle_that_comes_into_motion_later(dim):
    """From a substep in which an activation lasts on it is faster than anything that particles could follow."""
    spin = 1e6 if dim == 2 else (1e6, 0.0, 0.0)
    obstacle = mpm.Sphere((0.5,) * dim, 0.1, kind="sticky", angular_velocity=spin, start=10.5 * DT)
    statuses = []
    for roll in (mpm.rollout, one_by_one):
        step = mpm.Step(unit_box(dim, 1 / 32), LAWS_HERE["neo_hookean"](), boundaries=[obstacle])
        roll(step, flow(dim, 0.02), N, DT)
        statuses.append(step.status)
    assert torch.equal(*(s[:, PROBLEM] for s in statuses))
    assert int(statuses[0][0, PROBLEM]) > 10


@torch.no_grad()
def test_a_paused_scene_that_is_fast(dim):
    step = mpm.Step(unit_box(dim, scenes=2), LAWS_HERE["neo_hookean"](), walls="separate")
    scene = torch.arange(2000).remainder(2).int()
    state = step.prepare(flow(dim, 0.1, scene=scene).to(dtype=torch.float32))
    state.v[scene == 1] *= 1e5
    dt = torch.tensor([DT, 0.0])
    end, expected = mpm.rollout(step, state, N, dt), one_by_one(step, state, N, dt)
    assert torch.equal(end.x[scene == 1], state.x[scene == 1])
    here = scene == 0
    assert torch.allclose(end.x[here], expected.x[here], rtol=0, atol=1e-6)
