"""Rollouts of unsorted particles, which are sorted for many steps and restored to their order."""

import heat_scenes
import pytest
import torch
from cases.rollout_gradients import assert_same, gradients, moving
from cases.rollouts import F64, LAWS_HERE, TRANSFERS, assert_equal, one_by_one
from helpers import OpNames, relative_error
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box
from torch_mpm.rollouts import fused_op, plan, until_time

DT = 1e-4


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """For few particles, on every device."""
    whole = plan.plan_call

    def planned(schedule: str | None, facts: plan.Facts) -> plan.CallPlan:
        unsorted = not facts.sorted and facts.particles >= 100 and facts.steps >= 4
        return whole(schedule, facts)._replace(order=int(unsorted))

    monkeypatch.setattr(plan, "plan_call", planned)
    monkeypatch.setattr(until_time, "plan_call", planned)
    plan._planned.cache_clear()  # Plans of the same facts by other tests, and for them.
    yield
    plan._planned.cache_clear()


@pytest.fixture
def sorts(monkeypatch) -> list[mpm.State]:
    """Arguments of all calls of `State.sorted`."""
    seen: list[mpm.State] = []
    whole = mpm.State.sorted
    monkeypatch.setattr(mpm.State, "sorted", lambda state, grid: seen.append(state) or whole(state, grid))
    return seen


def case(dim: int, device: str, dtype: torch.dtype = F64, **options) -> tuple[mpm.Step, mpm.State]:
    """A mixture, one of whose laws has a parameter and one a fibre of each particle, in scenes, with all that is kept
    of a particle."""
    count, scenes = 300, 2
    stiffness = torch.linspace(1e3, 1e4, count, dtype=F64)
    fibres = torch.nn.functional.normalize(torch.randn(count, dim, dtype=F64), dim=1)
    laws = [
        mpm.NeoHookean(mu=stiffness, lam=2e3),
        LAWS_HERE["cam_clay"](),
        LAWS_HERE["fluid"](),
        mpm.Active(LAWS_HERE["viscoelastic"](), fibres),
    ]
    step = mpm.Step(unit_box(dim, scenes=scenes), mpm.Mixture(laws), walls="separate", **options).to(device, dtype)
    number = torch.arange(count, device=device)
    state = blob(device, dim, count, dtype).replace(material=(number % 4).int(), scene=(number // 3 % scenes).int())
    state = step.prepare(state)
    return step, state.replace(extra={**state.extra, "activation": 1e3 * torch.randn_like(state.mass), "own": number})


@torch.no_grad()
@pytest.mark.parametrize("transfer", TRANSFERS)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_order_comes_back(transfer, dtype, dim, device, sorts):
    step, state = case(dim, device, dtype, **TRANSFERS[transfer])
    expected = one_by_one(step, state, 9, DT)
    assert not sorts
    end = mpm.rollout(step, state, 9, DT)
    assert sorts == [state] and end.ids is None
    assert_equal(end, expected)
    for name in ("mass", "volume", "material", "scene"):  # the same tensors, since caches refer to them
        assert getattr(end, name) is getattr(state, name)
    assert end.extra["own"] is state.extra["own"] and end.extra["activation"] is state.extra["activation"]


@torch.no_grad()
def test_particles_are_sorted_again(monkeypatch, dim, device, sorts):
    step, state = case(dim, device)
    monkeypatch.setattr(fused_op, "STEPS_IN_ORDER", 5)
    end = mpm.rollout(step, state, 12, DT)
    assert len(sorts) == 3 and end.ids is None and end.mass is state.mass and end.material is state.material
    assert_equal(end, one_by_one(step, state, 12, DT))
    with OpNames() as names:
        mpm.rollout(step, state, 12, DT)
    assert "aten.all.default" not in names.seen


@torch.no_grad()
@pytest.mark.parametrize("given", ["unsorted", "in an order of one's own"])
def test_particles_with_heat_are_sorted_again(monkeypatch, given, dim, device, sorts):
    """Also those that were given in an order, to which their ids and the parameters of each particle refer."""
    step, state = heat_scenes.scene(dim, melts=True, per_particle=True, device=device)
    if given != "unsorted":
        state = state.replace(ids=torch.randperm(len(state)).to(device))
    monkeypatch.setattr(fused_op, "STEPS_WITH_HEAT", 5)
    whole = plan.plan_call
    monkeypatch.setattr(plan, "plan_call", lambda *a: whole(*a)._replace(order=1))
    plan._planned.cache_clear()
    end = mpm.rollout(step, state, 12, DT)
    assert len(sorts) == 3 and end.ids is state.ids and end.mass is state.mass
    expected = one_by_one(step, state, 12, DT)
    assert_equal(end, expected)
    assert relative_error(end.temperature, expected.temperature) < 1e-9
    assert relative_error(end.extra["liquid"], expected.extra["liquid"]) < 1e-9


@torch.no_grad()
def test_materials_are_checked_once(device):
    """To check them is to wait for the device."""
    step, state = case(3, device)
    end = mpm.rollout(step, state, 9, DT)
    with OpNames() as names:
        mpm.rollout(step, state, 9, DT)
        mpm.rollout(step, end, 9, DT)
        step(state, DT)
    assert "aten.all.default" not in names.seen and "torch_mpm.substeps.default" in names.seen


@torch.no_grad()
def test_who_sorts_is_left_alone(device, sorts):
    """And so are few steps, and few particles."""
    step, state = case(3, device)
    mpm.rollout(step, state.replace(ids=torch.randperm(len(state)).to(device)), 9, DT)
    mpm.rollout(step, state, 3, DT)
    mpm.rollout(mpm.Step(unit_box(3), LAWS_HERE["snow"]()), blob(device, 3, 90), 9, DT)
    assert not sorts


def test_gradients(dim, device, sorts):
    step, state = case(dim, device)
    step.law.laws[0].mu.requires_grad_()
    state = moving(step, state)
    state = state.replace(extra={name: t for name, t in state.extra.items() if name != "own"})
    got = gradients(lambda step, state: mpm.rollout(step, state, 6, DT, checkpoint=2), step, state)
    assert len(sorts) == 1
    expected = gradients(lambda step, state: one_by_one(step, state, 6, DT), step, state)
    assert expected["law.laws.0.mu"] is not None
    assert_same(got, expected, "rollout")


@torch.no_grad()
def test_scenes_that_pause_and_clocks_of_scenes(device):
    step, state = case(3, device)
    state = state.replace(time=torch.tensor([0.0, 0.5], dtype=F64, device=device))
    dt = torch.tensor([DT, 0.0], dtype=F64, device=device)
    end, expected = mpm.rollout(step, state, 9, dt), one_by_one(step, state, 9, dt)
    assert torch.equal(end.time, expected.time)
    assert_equal(end.replace(time=0.0), expected.replace(time=0.0))


@torch.no_grad()
def test_a_time_is_reached(device, sorts, monkeypatch):
    step, state = case(3, device)
    arrival = mpm.rollout_to(step, state, 1e-3, every=3)
    assert sorts == [state] and arrival.state.ids is None and arrival.state.mass is state.mass
    monkeypatch.undo()
    expected = mpm.rollout_to(step, state, 1e-3, every=3)
    assert torch.equal(arrival.substeps, expected.substeps)
    assert_equal(arrival.state, expected.state)


@torch.no_grad()
def test_a_hook_sees_the_order_that_was_given(device, sorts):
    step, state = case(3, device)
    seen: list[Tensor] = []
    mpm.rollout(step, state, 12, DT, hook=lambda state, k: seen.append(state.x), every=6)
    assert len(sorts) == 2
    assert float((seen[1] - one_by_one(step, state, 6, DT).x).abs().max()) < 1e-12


@torch.no_grad()
@pytest.mark.cuda
def test_as_it_is(monkeypatch, sorts):
    monkeypatch.undo()
    state = blob("cuda", 3, 2**15, torch.float32)
    step = mpm.Step(unit_box(3, 1 / 40), mpm.NeoHookean(E=1e3, nu=0.3))
    end = mpm.rollout(step, state, 64, DT)
    assert end.ids is None
    assert_equal(end, one_by_one(step, state, 64, DT))
