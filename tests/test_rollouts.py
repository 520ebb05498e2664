"""Rollouts in one op against the same steps one after another, which other tests hold against oracles."""

import pytest
import torch
from cases.rollouts import (
    LAWS_HERE,
    SEEDS,
    SOME_TRANSFERS,
    TRANSFERS,
    WALLS,
    assert_equal,
    each_scene,
    flying,
    in_one_op,
    mixture,
    one_by_one,
    tensors,
)
from combinations import DT, F64, draw, make
from helpers import TOLERANCE, OpNames
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, touched, unit_box
from torch_mpm.grid.topology import Status


@pytest.mark.parametrize("seed", SEEDS)
def test_random_simulations(seed, device):
    c = draw(seed)
    case, again = make(c, device), make(c, device)
    case.step.heat = again.step.heat = None  # which goes step by step
    with torch.no_grad():
        reason = case.step.explain(case.state, DT)
        end, expected = mpm.rollout(case.step, case.state, 12, DT), one_by_one(again.step, again.state, 12)
        assert_equal(end, expected, f"{c} {reason}")


def test_random_simulations_are_taken_in_one_op(device):
    """Not all of them go the other way, or the test above would compare nothing."""
    with torch.no_grad():
        cases = [make(draw(seed), device) for seed in SEEDS]
        for case in cases:
            case.step.heat = None
        assert sum(in_one_op(case.step, case.state) for case in cases) > len(cases) / 3


@pytest.mark.parametrize(
    *in_pairs(law=LAWS_HERE, n=[1, 2, 5, 15], transfer=SOME_TRANSFERS, dtype=[torch.float32, F64], dim=[2, 3])
)
def test_laws(law, n, transfer, dim, dtype, device):
    """On CUDA the law of a step in float32 is part of P2G, and from 14 steps on some are replayed."""
    options = {"gravity": (0.0, -9.8, 0.0)[:dim], "walls": "separate", **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(dim), LAWS_HERE[law](), **options)
    state = blob(device, dim, dtype=dtype)
    state.x[5] = -3.0  # and outside the grid the law acts, too
    assert in_one_op(step, state)
    with torch.no_grad():
        end, expected = mpm.rollout(step, state, n, 1e-4), one_by_one(step, state, n, 1e-4)
    assert_equal(end, expected)
    for name, value in tensors(end).items():  # code outside has no sums over particles
        if value.is_floating_point():
            rounding = 100 * torch.finfo(dtype).eps * value[5].abs().max().clamp_min(1)
            assert float((value[5] - tensors(expected)[name][5]).abs().max()) <= float(rounding), name


@pytest.mark.parametrize(
    *in_pairs(
        transfer=TRANSFERS,
        form=["mls", "gradient"],
        kernel=["quadratic", "cubic"],
        walls=WALLS,
        dtype=[torch.float32, F64],
    )
)
def test_transfers(transfer, form, kernel, walls, dtype, device):
    options = {"stress_form": form, "walls": touched(walls, 3), **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(kernel=kernel), mpm.NeoHookean(E=1e4, nu=0.3), (0.0, -9.8, 0.0), **options)
    state = blob(device, dtype=dtype)
    assert in_one_op(step, state)
    with torch.no_grad():
        assert_equal(mpm.rollout(step, state, 4, 1e-4), one_by_one(step, state, 4, 1e-4))


@pytest.mark.parametrize(
    *in_pairs(
        cells=[0.003, 0.06, 1.6],
        kernel=["quadratic", "cubic"],
        shuffled=[False, True],
        transfer=SOME_TRANSFERS,
        dtype=[torch.float32, F64],
        dim=[2, 3],
    )
)
def test_particles_leave_the_blocks_they_were_found_in(dim, device, cells, kernel, shuffled, transfer, dtype):
    """`cells` per step at which a cloud moves and parts: some stay in the blocks of the first step, some go to others
    that are active, or to others yet. On CUDA blocks are not found anew in every step."""
    n, dt = 24 if cells < 1 else 6, 1e-4
    step = mpm.Step(unit_box(dim, dx=1 / 64, kernel=kernel), LAWS_HERE["sand"](), walls="slip", **TRANSFERS[transfer])
    state = blob(device, dim, 3000 if device == "cuda" else 1000, dtype=dtype)
    v = state.v * 0.2 + torch.tensor([1.0, -0.6, 0.3][:dim], dtype=dtype, device=device)
    state = step.prepare(state.replace(v=v * (cells * step.grid.dx / dt)))
    state = state if shuffled else state.sorted(step.grid)
    with torch.no_grad():
        end, expected = mpm.rollout(step, state, n, dt), one_by_one(step, state, n, dt)
    moved = (expected.x - state.x).norm(dim=1).median() / step.grid.dx
    assert moved > 0.6 * n * cells
    assert_equal(end, expected)


def streams(dim: int, device: str, transfer: str = "apic") -> tuple[mpm.Step, mpm.State]:
    """Two scenes of a mixture in no order, flowing through many blocks and in part out of the domain; with parameters
    per particle, and a moving obstacle."""
    g = torch.Generator().manual_seed(8)
    count, dt = 3000, 1e-4
    stiffness = 1e3 * (1 + torch.rand(count, generator=g, dtype=F64)).to(device)
    others = [LAWS_HERE[name]() for name in ("fluid", "sand", "viscoelastic")]
    laws = mpm.Mixture([mpm.NeoHookean(E=stiffness, nu=0.3), *others])
    ball = mpm.Sphere((0.5,) * dim, 0.1, velocity=(0.0, 4.0, 0.0)[:dim])
    grid = unit_box(dim, dx=1 / 32, scenes=2, max_blocks=2 * 10**dim)  # on CUDA no pool grows within a call
    step = mpm.Step(grid, laws, boundaries=[ball], **TRANSFERS[transfer])
    state, scene = blob(device, dim, count), torch.randint(0, 2, (count,), generator=g).int().to(device)
    there = torch.tensor([1.0, -0.6, 0.3][:dim], dtype=F64, device=device) * (1 - 2 * scene)[:, None]
    state.x[7] = -3.0
    return step, step.prepare(
        state.replace(
            v=(0.2 * state.v + there) * (0.3 * step.grid.dx / dt),
            scene=scene,
            material=torch.randint(0, 4, (count,), generator=g).int().to(device),
            ids=torch.randperm(count, generator=g).to(device),
        )
    )


@torch.no_grad()
@pytest.mark.parametrize("transfer", TRANSFERS)
def test_particles_that_flow_through_many_blocks(transfer, dim, device):
    """On the CPU the op sorts them in memory, without a visible effect."""
    step, state = streams(dim, device, transfer)
    assert in_one_op(step, state)
    again, _ = streams(dim, device, transfer)
    end, expected = mpm.rollout(step, state, 40, 1e-4), one_by_one(again, state, 40, 1e-4)
    assert float((expected.x - state.x).norm(dim=1).median()) > 8 * step.grid.dx
    assert_equal(end, expected)
    assert str(step.failures(end)) == str(again.failures(expected))


@torch.no_grad()
@pytest.mark.parametrize(*in_pairs(law=["neo_hookean", "sand", "mixture"], transfer=SOME_TRANSFERS, dim=[2, 3]))
def test_threads_change_nothing(dim, law, transfer):
    if law == "mixture":
        step, state = streams(dim, "cpu", transfer)
    else:
        step = mpm.Step(unit_box(dim, dx=1 / 32), LAWS_HERE[law](), walls="slip", **TRANSFERS[transfer])
        state = step.prepare(blob("cpu", dim, 3000, dtype=torch.float32))
        state = state.replace(v=200 * state.v)
    ends = []
    threads = torch.get_num_threads()
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        try:
            ends.append(tensors(mpm.rollout(step, state, 20, 1e-4)))
        finally:
            torch.set_num_threads(threads)
    for other in ends[1:]:
        for name, value in ends[0].items():
            assert torch.equal(value.nan_to_num(), other[name].nan_to_num()), name


@pytest.mark.parametrize("walls", ["mirror", None])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_scenes_whose_particles_leave_the_domain(dim, device, walls, transfer):
    """A batch in which one scene is empty and particles of others leave the domain at different steps, or are lost,
    around an obstacle that moves."""
    ball = mpm.Sphere((0.5,) * dim, 0.15, velocity=(0.0, 4.0, 0.0)[:dim], end=0.01)
    options = {"walls": walls, "boundaries": [ball], **TRANSFERS[transfer]}
    blocks = {2: 100, 3: 400}[dim]  # on CUDA a pool that grows does so between calls
    step = mpm.Step(unit_box(dim, scenes=3, max_blocks=blocks), mpm.NeoHookean(E=1e3, nu=0.3), **options)
    scene = torch.randint(0, 2, (400,), generator=torch.Generator().manual_seed(2)).int() * 2
    state = blob(device, dim, 400, scene=scene)
    v = 30 * state.v
    v[7] = float("nan")  # of the scene 0 or 2, which is lost
    state = state.replace(v=v, scene=state.scene.to(device))
    with torch.no_grad():
        end, statuses = mpm.rollout(step, state, 70, 2e-4), []
        statuses.append(step.failures(end))
        again = mpm.Step(unit_box(dim, scenes=3, max_blocks=blocks), step.law, **options)
        expected = one_by_one(again, state, 70, 2e-4)
        statuses.append(again.failures(expected))
    assert str(statuses[0]) == str(statuses[1])
    whole = state.scene == 2 - int(state.scene[7])
    assert bool(expected.x[whole].isfinite().all()) and bool(expected.x[~whole].isnan().any())
    assert float((end.x[whole] - expected.x[whole]).abs().max()) < 1e-9


def test_a_full_pool_is_reported_by_the_call_that_fills_it(device):
    """Also where the particles are still in blocks that are active for others."""
    step = mpm.Step(unit_box(2, max_blocks=4), mpm.NeoHookean(E=1e3, nu=0.3))
    state = blob(device, 2, 200)
    state = state.replace(x=0.45 + 0.1 * state.x, v=300 * (state.x - 0.5))
    with torch.no_grad(), pytest.raises(mpm.GridOverflowError, match="max_blocks=4"):
        step.check(mpm.rollout(step, state, 60, 2e-4))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_pool_that_was_too_small_for_some_steps_is_reported_when_it_has_grown(device, dtype):
    """On CUDA the pool grows between calls; on the CPU within them, so that there is nothing to report."""
    step = mpm.Step(unit_box(2, dx=0.005), mpm.NeoHookean(E=1e3, nu=0.3), transfer="pic")
    state = blob(device, 2, 200, dtype=dtype)
    state = state.replace(x=0.45 + 0.1 * state.x, v=1000 * (state.x - 0.5))
    with torch.no_grad():
        state = mpm.rollout(step, state, 60, 2e-5)  # by 0.24 m at most
        for _ in range(3):
            step.grid.wait()
            state = step(state.replace(v=torch.zeros_like(state.v)), 2e-5)
    if device == "cpu":
        return step.check(state)
    assert step.grid.max_blocks > int(step.status[0, Status.BLOCKS_NOW])
    with pytest.raises(mpm.GridOverflowError, match="more than the pool of the grid had room for in some steps"):
        step.check(state)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_mixtures(transfer, dim, device):
    laws = mixture()
    state = blob(device, dim, 400, material=torch.randint(0, 7, (400,), dtype=torch.int32))
    state = state.replace(material=state.material.int(), ids=torch.randperm(400).to(device))
    step = mpm.Step(unit_box(dim), laws, gravity=(0.0, -9.8, 0.0)[:dim], walls="sticky", **TRANSFERS[transfer])
    assert in_one_op(step, state)
    with torch.no_grad():
        for start in (state, step.prepare(state).sorted(step.grid)):
            assert_equal(mpm.rollout(step, start, 5, 1e-4), one_by_one(step, start, 5, 1e-4))


def test_a_material_without_a_law_is_refused(device):
    state = blob(device, material=torch.full((300,), 7, dtype=torch.int32))
    state = state.replace(material=state.material.int())
    with torch.no_grad(), pytest.raises(ValueError, match=r"material must be in 0 \.\. 6"):
        mpm.rollout(mpm.Step(unit_box(), mixture()), state, 2, 1e-4)


@torch.no_grad()
def test_materials_that_a_step_has_checked_stay_checked_when_it_sorts(device):
    """To check them is to wait for the device."""
    step, number = mpm.Step(unit_box(), mixture()), torch.arange(300, dtype=torch.int32, device=device)
    state = mpm.rollout(step, blob(device).replace(material=number % 7), 2, 1e-4)
    for start, checked in ((step.sorted(state), False), (state.sorted(step.grid), True)):
        with OpNames() as names:
            step.stability_report(start)
            mpm.rollout(step, start, 2, 1e-4)
        assert ("aten.all.default" in names.seen) == checked and "torch_mpm.substeps.default" in names.seen


@torch.no_grad()
def test_materials_that_no_step_has_checked_are_checked_after_a_sort(device):
    step, number = mpm.Step(unit_box(), mixture()), torch.arange(300, dtype=torch.int32, device=device)
    state = step.sorted(step.prepare(blob(device).replace(material=number % 8)))
    with pytest.raises(ValueError, match=r"material must be in 0 \.\. 6"):
        mpm.rollout(step, state, 2, 1e-4)


@pytest.mark.parametrize("n", [6, 40])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_batches_with_obstacles_and_parameters_of_scenes_and_particles(n, transfer, dim, device):
    """Some nodes are in several obstacles, which act one after another."""
    scenes = 3
    state = blob(device, dim, scene=torch.arange(300, dtype=torch.int32) % scenes)
    state = state.replace(scene=state.scene.int())
    mu, lam = torch.linspace(1e3, 1e4, scenes, dtype=F64), torch.linspace(1e3, 2e3, 300, dtype=F64)
    law = mpm.NeoHookean(mu=mu, lam=lam)
    spin = {} if dim == 2 else {"angular_velocity": (0.0, 3.0, 0.0)}
    obstacles = [
        mpm.Sphere((0.5,) * dim, 0.15, velocity=(1.0,) + (0.0,) * (dim - 1), kind="slip", friction=0.3),
        mpm.Box((0.3,) * dim, (0.1,) * dim, kind="sticky", start=2e-4, **spin),
        mpm.Plane((0.0, 0.35, 0.0)[:dim], (0.0, 1.0, 0.0)[:dim], kind="separate", end=3e-4),
    ]
    gravity = torch.randn(scenes, dim, dtype=F64, device=device)
    options = {"boundaries": obstacles, "walls": "slip", **TRANSFERS[transfer]}
    step = mpm.Step(unit_box(dim, scenes=scenes), law.to(device), gravity, **options)
    assert in_one_op(step, state)
    with torch.no_grad():
        assert_equal(mpm.rollout(step, state, n, 1e-4), one_by_one(step, state, n, 1e-4))


def test_obstacles_come_and_go_in_the_substeps_of_single_steps(device):
    """0.1 added eight times is less than 0.8, by rounding: the time is added up in the op too."""
    state, dt = blob(device), 0.1
    state = state.replace(v=1e-3 * state.v)
    time = 0.0
    for _ in range(8):
        time += dt
    assert time < 0.8
    wall = {"kind": "sticky", "start": 0.8, "end": 1.5}
    step = mpm.Step(unit_box(), mpm.NeoHookean(E=1e-9, nu=0.3), boundaries=[mpm.Sphere((0.5,) * 3, 0.3, **wall)])
    assert in_one_op(step, state)
    with torch.no_grad():
        for n in (8, 9, 10, 14, 15, 16, 17, 20):
            assert_equal(mpm.rollout(step, state, n, dt), one_by_one(step, state, n, dt), f"{n} steps")


# ---- the pool of blocks


@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_the_pool_grows_inside_the_op(transfer):
    state, dt = flying("cpu")
    grid, other = unit_box(dx=1 / 64), unit_box(dx=1 / 64)
    law, options = mpm.NeoHookean(E=1.0, nu=0.3), TRANSFERS[transfer]
    with torch.no_grad():
        end = mpm.rollout(mpm.Step(grid, law, **options), state, 8, dt)
        assert_equal(end, one_by_one(mpm.Step(other, law, **options), state, 8, dt))
    assert grid.max_blocks >= grid.activate(end.x).wanted > 2 * grid.activate(state.x).wanted


def test_a_full_pool_is_an_error_and_nothing_is_lost():
    state, dt = flying("cpu")
    step = mpm.Step(unit_box(dx=1 / 64, max_blocks=40), mpm.NeoHookean(E=1.0, nu=0.3))
    before = state.x.clone()
    with torch.no_grad(), pytest.raises(mpm.GridOverflowError, match="max_blocks=40"):
        mpm.rollout(step, state, 8, dt)
    assert torch.equal(state.x, before)


def test_a_domain_of_many_blocks_changes_nothing(device):
    """Activation processes its table in parts; blocks become active and inactive, and a particle is lost."""
    state, dt = flying(device)
    x = state.x.clone()
    x[7] = float("nan")
    state, ends, counts = state.replace(x=x), [], []
    for width in (1.0, 6.5):  # [m]; the table then has 54^3 blocks
        grid = mpm.Grid(dx=1 / 32, lower=(0.0,) * 3, upper=(width,) * 3, max_blocks=1000)
        step = mpm.Step(grid, mpm.NeoHookean(E=1.0, nu=0.3))
        with torch.no_grad():
            moved = mpm.rollout(step, state, 16, dt / 2)
            ends.append(moved.replace(x=moved.x.nan_to_num(7.0), v=moved.v.nan_to_num(7.0), C=moved.C.nan_to_num(7.0)))
        counts.append((grid.activate(moved.x).wanted, grid.activate(state.x).wanted, step.status[1:].tolist()))
    assert counts[0] == counts[1]
    assert counts[0][0] > counts[0][1]
    assert_equal(*ends)


def test_problems_are_those_of_single_steps(device):
    """A particle outside the grid and one that is not finite are counted in the same steps."""
    state = blob(device)
    x = state.x.clone()
    x[5], x[7] = float("nan"), 3.0
    failures = []
    for move in (mpm.rollout, one_by_one):
        step = mpm.Step(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3))
        with torch.no_grad():
            end = move(step, state.replace(x=x), 4, 1e-3)
            failures.append((step.status.cpu(), end.x.isfinite().all(1).cpu()))
            with pytest.raises(mpm.SimulationError, match=r"outside|NaN"):
                step.check()
    assert all(torch.equal(a, b) for a, b in zip(*failures, strict=True))


@pytest.mark.parametrize("obstacles", [[], [mpm.Sphere((0.5,) * 3, 0.3, velocity=(1.0, 0.0, 0.0), end=2e-3)]])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_no_particles(obstacles, transfer, device):
    law = mpm.VonMises(E=1e4, nu=0.3, yield_stress=1.0)
    step = mpm.Step(unit_box(), law, gravity=(0.0, -1.0, 0.0), boundaries=obstacles, **TRANSFERS[transfer])
    with torch.no_grad():
        end = mpm.rollout(step, blob(device, count=0), 3, 1e-3)
        step.check(end)
    assert len(end) == 0 and end.time == 1e-3 + 1e-3 + 1e-3


# ---- which way a rollout goes


def test_reasons_to_step_from_python(device):
    state, law = blob(device), mpm.NeoHookean(E=1e4, nu=0.3)
    bouncing = mpm.Step(unit_box(), law, walls="mirror", flip=0.5)
    reasons = {
        "a tensor": (mpm.Step(unit_box(), law), state, torch.tensor(1e-4, device=device)),
        "FLIP keeps a share of the impulses on mirrors": (bouncing, bouncing.with_impulses(state), 1e-4),
        "on_grid": (mpm.Step(unit_box(), law, on_grid=lambda b, v, m, dt: v), state, 1e-4),
        "CustomLaw": (mpm.Step(unit_box(), lambda F: F), state, 1e-4),
        "ThermalExpansion": (mpm.Step(unit_box(), mpm.ThermalExpansion(law, 1e-3)), state, 1e-4),
        "the time of the state requires a gradient": (
            mpm.Step(unit_box(), law, boundaries=[mpm.Sphere((0.5,) * 3, 0.1, end=1.0)]),
            state.replace(time=torch.zeros(1, dtype=F64, device=device, requires_grad=True)),
            1e-4,
        ),
        "boundary": (mpm.Step(unit_box(), law, boundaries=[Still()]), state, 1e-4),
    }
    for reason, (step, start, dt) in reasons.items():
        assert reason in step.explain(start, dt)


def test_nothing_that_may_have_a_gradient_is_lost(device):
    """Tensors of a user function are not detected; under no_grad there are no gradients."""
    stiffness = torch.tensor(1e4, dtype=F64, device=device, requires_grad=True)
    law = mpm.NeoHookean(mu=lambda temperature: stiffness + temperature, lam=1e3)
    step, state = mpm.Step(unit_box(), law), blob(device)
    state = state.replace(temperature=torch.zeros_like(state.mass))
    assert "function" in step.explain(state, 1e-4)
    end = mpm.rollout(step, state, 2, 1e-4)
    assert float(torch.autograd.grad(end.v.square().sum(), stiffness)[0]) != 0
    with torch.no_grad():
        assert in_one_op(step, state)
        assert_equal(mpm.rollout(step, state, 2, 1e-4), end)


def test_a_step_of_the_users_own_is_called(device):
    class Slower(mpm.Step):
        def forward(self, state, dt):
            state = super().forward(state, dt)
            return state.replace(v=0.5 * state.v)

    step, state = Slower(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3)), blob(device)
    assert "Slower" in step.explain(state, 1e-4)
    with torch.no_grad():
        assert_equal(mpm.rollout(step, state, 2, 1e-4), one_by_one(step, state, 2, 1e-4))


class Still:
    def apply(self, velocity, positions, scene, time, dt):
        return velocity


def test_hooks_are_called_for_every_step(device):
    step, called = mpm.Step(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3)), []
    handle = step.law.register_forward_hook(lambda *arguments: called.append(1))
    with torch.no_grad():
        mpm.rollout(step, blob(device), 3, 1e-4)
        assert len(called) == 3
        handle.remove()
        mpm.rollout(step, blob(device), 3, 1e-4)
    assert len(called) == 3


@pytest.mark.parametrize("transfer", TRANSFERS)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_scenes_with_time_steps_and_clocks_of_their_own(device, dtype, transfer):
    """One is paused, and one has a dt that is refused."""
    for values in ([1.0, 0.5, 0.7], [1.0, 0.0, 0.5], [1.0, -1.0, 0.5]):
        dt = DT * torch.tensor(values, dtype=dtype, device=device)
        (step, state), (again, _) = each_scene(device, dtype, transfer), each_scene(device, dtype, transfer)
        assert step.explain(state, dt).startswith("all steps in one op")
        with torch.no_grad():
            end, expected = mpm.rollout(step, state, 9, dt), one_by_one(again, state, 9, dt)
        if device == "cpu":
            assert torch.equal(end.time, expected.time)
        torch.testing.assert_close(end.time, expected.time)
        assert_equal(end.replace(time=0.0), expected.replace(time=0.0))
        assert torch.equal(step.failures().problems["dt"].count, again.failures().problems["dt"].count)


def test_clocks_take_no_gradients(device):
    """So that the next call of a training loop goes in one op, too."""
    step, state = each_scene(device, F64)
    dt = DT * torch.tensor([1.0, 0.5, 0.7], dtype=F64, device=device)
    end = mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), 3, dt)
    assert end.v.requires_grad and not end.time.requires_grad
    assert step.explain(end, dt).startswith("all steps")


def test_a_clock_of_each_scene_with_one_time_step(device):
    step, state = each_scene(device)
    state = state.replace(time=torch.tensor([0.0, 2 * DT, -DT], dtype=F64, device=device))
    assert in_one_op(step, state)
    with torch.no_grad():
        end, expected = mpm.rollout(step, state, 9, DT), one_by_one(step, state, 9, DT)
    torch.testing.assert_close(end.time, expected.time)
    assert_equal(end.replace(time=0.0), expected.replace(time=0.0))
    for dt, reason in (
        (torch.full((3,), DT, dtype=torch.float32, device=device), "dt is a tensor, but not in float64"),
        (torch.full((3,), DT, dtype=F64, device=device, requires_grad=True), "dt requires a gradient"),
    ):
        assert reason in step.explain(state, dt)


@pytest.mark.parametrize("shape", [(), (1,)], ids=str)
@pytest.mark.parametrize("paused", [False, True])
def test_one_tensor_for_all_scenes(device, shape, paused):
    dt = torch.full(shape, 0.0 if paused else DT, dtype=F64, device=device)
    (step, state), (again, _) = each_scene(device), each_scene(device)
    for _ in range(2):  # the second from a time that is such a tensor
        assert in_one_op(step, state) and step.explain(state, dt).startswith("all steps in one op")
        with torch.no_grad():
            end, expected = mpm.rollout(step, state, 5, dt), one_by_one(again, state, 5, dt)
        assert end.time.shape == expected.time.shape == shape
        torch.testing.assert_close(end.time, expected.time)
        assert_equal(end.replace(time=0.0), expected.replace(time=0.0))
        state = end
    again.law, again.grid = mpm.NeoHookean(E=1e4, nu=0.3), unit_box()  # of one scene
    alone = blob(device).replace(time=torch.zeros(shape, dtype=F64, device=device))
    assert again.explain(alone, dt).startswith("all steps in one op")


@pytest.mark.parametrize("gradient", [False, True])
def test_a_call_of_the_op_by_training_code(device, gradient):
    """With the arguments that `rollout` would give, some of them exchanged."""
    step = mpm.Step(unit_box(), mpm.NeoHookean(E=1e4, nu=0.3), gravity=(0.0, -9.8, 0.0), walls="separate")
    state = blob(device)
    faster = (2 * state.v).requires_grad_(gradient)
    with torch.set_grad_enabled(gradient):
        arguments = mpm.substeps_arguments(step, state.replace(v=faster), 7, DT)
        x, v, *rest = torch.ops.torch_mpm.substeps(**arguments)
        expected = mpm.rollout(step, state.replace(v=faster), 7, DT)
        pairs = [(x, expected.x), (v, expected.v), (rest[1], expected.F)]
        if gradient:
            pairs += [tuple(torch.autograd.grad(t.square().sum(), faster)[0] for t in (x, expected.x))]
    for found, other in pairs:
        assert float((found - other).detach().abs().max() / other.detach().abs().max()) < TOLERANCE["rollout"][F64]
    names = [a.name for a in torch.ops.torch_mpm.substeps.default._schema.arguments]
    assert list(arguments) == names
    with pytest.raises(ValueError, match="substeps` supports, got a step that it does not: it calls on_grid"):
        mpm.substeps_arguments(mpm.Step(unit_box(), step.law, on_grid=lambda b, v, m, dt: v), state, 7, DT)


def test_a_law_with_its_own_update_is_not_replaced(device):
    class Doubled(mpm.NeoHookean):
        def update(self, state):
            fields, stress = super().update(state)
            return fields, 2 * stress

    step = mpm.Step(unit_box(), Doubled(E=1e4, nu=0.3))
    assert "Doubled is more than a compiled law" in step.explain(blob(device))


def test_the_raw_op(device):
    state = blob(device, count=40)
    x, scalar = state.x, torch.tensor(2e3, dtype=F64, device=device)
    eye = torch.eye(3, dtype=F64, device=device).repeat(40, 1, 1)
    grid = unit_box(max_blocks=64)
    particles = (x, state.v, state.mass, state.volume, None, eye, None, 1e-9 * x, [state.mass * 0], *[None] * 4)
    law = ("von_mises", [0], [scalar, scalar, 0.01 * scalar, scalar], [1])
    rest = (
        None,
        [],
        [],
        [],
        None,
        None,
        [],
        [],
        [],
        [],
        [],
        [],
        0.0,
        1,
        64,
        False,
        True,
        False,
        None,
        None,
        None,
        *([], [], [], [], [], [], [], []),  # no heat
        *grid.packed,
    )
    call = (*particles, *law, 2, 1e-4, True, [0.0, 1.0], True, 0, *rest)
    checks = ("test_schema", "test_faketensor", "test_aot_dispatch_dynamic")
    for apic, shares, wants_C in (
        (True, [0.0, 1.0], True),
        (True, [0.9, 0.5], True),
        (False, [1.0, 1.0], True),
        (False, [0.0, 0.0], False),
    ):
        given = (*call[:19], apic, shares, wants_C, *call[22:])
        torch.library.opcheck(torch.ops.torch_mpm.substeps.default, given, test_utils=checks)
    for wrong, place, message in (
        ("sand", 13, "law must be one of"),
        ([0, 0], 14, "options must have an entry per law"),
        ([scalar], 15, "parameters and history must have those of all laws"),
        (0, 17, "n must be 1 to 65536"),
        (-1.0, 18, "dt must be positive"),
        ([1.5, 1.0], 20, "velocity_shares must be between 0 and 1, got 1.5"),
        ([0.0], 20, "velocity_shares must have 2 entries"),
        (x[:3], 7, r"residual must have shape \[40, 3\]"),
    ):
        with pytest.raises(RuntimeError, match=message):
            torch.ops.torch_mpm.substeps(*call[:place], wrong, *call[place + 1 :])


@pytest.mark.parametrize(("law", "scenes"), [("neo_hookean", 1), ("sand", 8), ("fluid", 8)])
@pytest.mark.parametrize("transfer", SOME_TRANSFERS)
def test_ten_deterministic_runs_are_the_same_to_the_last_bit(law, scenes, transfer, device):
    """Ends without gradients and with, and the gradients; scenes of a batch stay on a multiprocessor where they can."""
    one = blob(device, count=150, dtype=torch.float32)
    scene = torch.arange(scenes, dtype=torch.int32, device=device)
    state = mpm.State.concatenate([one.replace(scene=scene[k].expand(len(one))) for k in range(scenes)])
    grid = unit_box(deterministic=True, scenes=scenes)
    options = {"gravity": (0, -9.8, 0), "walls": "slip", **TRANSFERS[transfer]}

    def run(with_gradient: bool) -> list[Tensor]:
        start = state.replace(v=state.v.clone().requires_grad_(with_gradient))
        with torch.set_grad_enabled(with_gradient):
            end = mpm.rollout(mpm.Step(grid, LAWS_HERE[law](), **options), start, 10, DT)
        results = [*tensors(end).values()]
        if with_gradient:
            results += torch.autograd.grad(end.x.square().sum() + end.v.sum(), [start.v])
        return [t.detach() for t in results]

    for with_gradient in (False, True):
        first = run(with_gradient)
        assert all(bool(t.isfinite().all()) for t in first)
        for _ in range(9):
            assert all(torch.equal(a, b) for a, b in zip(run(with_gradient), first, strict=True))
