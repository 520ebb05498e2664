"""Stored states of rollouts: gradients equal those without checkpoints, and memory equals the estimate."""

import math

import heat_scenes
import pytest
import torch
from helpers import SingleSteps, relative_error
from torch import nn
from torch.utils.checkpoint import checkpoint as torch_checkpoint

import torch_mpm as mpm
from benchmarks.catalogue.laws import LAWS
from benchmarks.catalogue.scenes import block, block_state, make_step
from benchmarks.speed import checkpoints as study
from benchmarks.speed import memory
from torch_mpm.implicit import Implicit
from torch_mpm.rollouts import checkpoints

N, DT = 13, 1e-3


class Stress(nn.Module):
    """A linear law with a learned part, and dropout, which must fall on the same particles again."""

    def __init__(self):
        super().__init__()
        self.layer, self.dropout = nn.Linear(4, 4).double(), nn.Dropout(0.5)
        self.residual = nn.Linear(4, 4).double()  # a name that parts of the library have for something else

    def forward(self, F):
        strain = 0.5 * (F.mT @ F - torch.eye(2, dtype=F.dtype, device=F.device))
        return 1e4 * strain + 1e3 * self.dropout(
            (self.layer(strain.flatten(1)) + self.residual(strain.flatten(1))).unflatten(1, (2, 2))
        )


def make(kind, device):
    step = make_step(2, gravity=(0.0, -9.8), walls="separate", grid={"deterministic": True})
    if kind == "network":
        step.law = Stress().to(device)
    if kind == "heat":
        step.heat = mpm.Heat(step.grid, conductivity=50.0, specific_heat=100.0)
    if kind == "one op":
        step.law = mpm.NeoHookean(E=torch.tensor(1e4, dtype=torch.float64, device=device, requires_grad=True), nu=0.3)
    state = block_state(2, device)
    state = state.replace(temperature=state.x[:, 0].clone()) if kind == "heat" else state
    return step, step.with_impulses(state)


KEPT = {
    "every": 4,
    "every, offloaded": mpm.Checkpoints(every=4, offload=True),
    "two states": mpm.Checkpoints(states=2),
    "four states": mpm.Checkpoints(states=4),
    "two states of three steps": mpm.Checkpoints(every=3, states=2),
    "little memory": mpm.Checkpoints(memory=5.2e5),
    "much memory": mpm.Checkpoints(memory=1e9),
}


@pytest.mark.parametrize("kept", KEPT)
@pytest.mark.parametrize("kind", ["one op", "network", "heat"])
def test_gradients_are_those_without(kind, kept, device, monkeypatch, one_thread):
    monkeypatch.setattr("torch_mpm.rollouts.budget.KEPT_BYTES", {"cpu": 0, "cuda": 0})  # of a scene that is so small
    found = []
    for checkpoint in (None, KEPT[kept]):
        torch.manual_seed(1)
        step, state = make(kind, device)
        v = state.v.clone().requires_grad_()
        end = mpm.rollout(step, state.replace(v=v), N, DT, checkpoint=checkpoint)
        loss = end.x.square().sum() + 1e-2 * end.v[:, 1].sum() + 1e-3 * end.impulse.sum()
        found.append(
            torch.autograd.grad(loss, [v, *(t for t in (*step.parameters(), *step.buffers()) if t.requires_grad)])
        )
    for value, expected in zip(found[1], found[0], strict=True):
        assert float(expected.norm()) > 0 and relative_error(value, expected) < (1e-12 if device == "cpu" else 1e-9)


@pytest.mark.parametrize("function", [False, True])
def test_pools_that_grow_are_those_of_the_first_time(function):
    """A body that flies apart needs more blocks in each segment; recomputed steps use the original pool size, also
    where a user function computes them, on a grid unknown to the library. Not on CUDA, where a pool grows once the
    device has reported its need, and earlier steps may overflow."""
    found, sizes = [], []
    for checkpoint in (None, 5, mpm.Checkpoints(states=3)):
        grid = mpm.Grid(0.02, (0, 0), (1, 1), deterministic=True)
        step = mpm.Step(grid, lambda F: 1e2 * (F @ F.mT - torch.eye(2, dtype=F.dtype, device=F.device)))
        state = block_state(2, low=0.45, high=0.55, dx=0.02)
        v = (150 * (state.x - 0.5)).requires_grad_()
        taken = (lambda state, dt, step=step: step(step(state, dt / 2), dt / 2)) if function else step
        end = mpm.rollout(taken, state.replace(v=v), 40, 1e-3, checkpoint=checkpoint)
        size = grid.max_blocks
        found.append(torch.autograd.grad(end.x.square().sum(), v)[0])
        assert grid.max_blocks == size
        sizes.append(size)
    step.check(end)
    first = mpm.Grid(0.02, (0, 0), (1, 1))
    first.activate(state.x)
    assert sizes[0] > first.max_blocks
    assert relative_error(found[1], found[0]) < 1e-12
    assert relative_error(found[2], found[0]) < 1e-12


def test_checkpoints_of_torch_around_steps_of_a_grid_that_grows():
    """As scripts of other projects have them."""
    found = []
    for kept in (False, True):
        grid = mpm.Grid(0.02, (0, 0), (1, 1), deterministic=True)
        step = mpm.Step(grid, mpm.NeoHookean(E=1e2, nu=0.3))
        state = block_state(2, low=0.45, high=0.55, dx=0.02)
        v = (150 * (state.x - 0.5)).requires_grad_()
        state = state.replace(v=v)
        for _ in range(40):
            state = (
                torch_checkpoint(step, state, 1e-3, use_reentrant=False, context_fn=checkpoints.contexts)
                if kept
                else step(state, 1e-3)
            )
        loss = state.x.square().sum()
        found.append(torch.autograd.grad(loss, v, retain_graph=True)[0])
        assert torch.equal(torch.autograd.grad(loss, v)[0], found[-1])  # the steps are taken a third time
    assert relative_error(*found) < 1e-12


@pytest.mark.parametrize("checkpoint", [None, 4, mpm.Checkpoints(states=3)])
def test_steps_that_are_taken_again_do_not_count_again(checkpoint, device):
    """A heat solver that misses its tolerance warns once per step; so does a refused dt."""
    step, state = make("heat", device)
    step.__class__ = SingleSteps  # the op counts its adjoint solves too
    step.heat.max_iterations = 1
    dt = torch.tensor([-DT], dtype=torch.float64, device=device)
    v = state.v.clone().requires_grad_()
    end = mpm.rollout(step, state.replace(v=v), N, DT, checkpoint=checkpoint)
    end = mpm.rollout(step, end, 3, dt, checkpoint=checkpoint)
    before = {kind: int(problem.count.sum()) for kind, problem in step.failures().problems.items()}
    end.x.sum().backward()
    assert before["heat"] >= N and before["dt"] == 3
    assert {kind: int(problem.count.sum()) for kind, problem in step.failures().problems.items()} == before


@pytest.mark.parametrize("checkpoint", [4, mpm.Checkpoints(states=3)])
def test_implicit_steps_that_are_taken_again_do_not_count_again(checkpoint, device):
    grid = mpm.Grid(0.1, (0.0, 0.0), (1.0, 1.0))
    integrator = Implicit(tolerance=1e-12, max_iterations=1)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e6, nu=0.3), (0.0, -9.8), walls="sticky", integrator=integrator)
    state = block_state(2, device)

    def problem():
        with pytest.raises(mpm.SimulationError, match="implicit") as caught:
            step.check()
        return str(caught.value)

    v = state.v.clone().requires_grad_()
    end = mpm.rollout(step, state.replace(v=v), N, 1e-2, checkpoint=checkpoint)
    before = problem()
    end.x.sum().backward()
    assert problem() == before
    mpm.estimate_rollout(step, state, N, 1e-2)
    assert problem() == before


# ---- binomial


@pytest.mark.parametrize(("n", "states"), [(10, 3), (200, 4), (57, 2), (8, 8)])
def test_binomial_work_is_the_least(n, states):
    """The number of recomputed steps is minimal: r n − C(s + r, r − 1) (Griewank and Walther 2000)."""
    repetitions = next(r for r in range(n) if math.comb(states + r, states) >= n)
    least = repetitions * n - math.comb(states + repetitions, repetitions - 1)
    assert mpm.Checkpoints(states=states).repetitions(n) == least


def test_a_thousand_states_and_more():
    state = block_state(2)
    x = state.x.clone().requires_grad_()
    double = lambda now, dt: now.replace(x=1.001 * now.x)  # noqa: E731
    end = mpm.rollout(double, state.replace(x=x), 1200, 1.0, checkpoint=mpm.Checkpoints(states=1200))
    end.x.sum().backward()
    torch.testing.assert_close(x.grad, torch.full_like(x, 1.001**1200), rtol=1e-12, atol=0)
    assert mpm.Checkpoints(states=2000).repetitions(5000) == 2 * 5000 - math.comb(2002, 1)


class Held:
    """A tensor that autograd keeps, and how many there are of them, now and at most."""

    now, most = 0, 0

    def __init__(self, t):
        self.t = t
        Held.now += 1
        Held.most = max(Held.most, Held.now)

    def __del__(self):
        Held.now -= 1


@pytest.mark.parametrize(("n", "states"), [(24, 3), (24, 2), (60, 5)])
def test_steps_and_kept_states_are_as_many_as_was_said(n, states):
    """Counted in the step, and in what autograd keeps over the forward and the backward pass."""
    taken, state = [], block_state(2)

    def step(state, dt):
        taken.append(None)
        return state.replace(x=1.01 * state.x.sin())

    x = state.x.clone().requires_grad_()
    Held.now = Held.most = 0
    with torch.autograd.graph.saved_tensors_hooks(Held, lambda held: held.t):
        end = mpm.rollout(step, state.replace(x=x), n, 1.0, checkpoint=mpm.Checkpoints(states=states))
        end.x.sum().backward()
    assert len(taken) == n + mpm.Checkpoints(states=states).repetitions(n)
    fields = 5  # x, v, mass and volume of each kept state and one of torch's own in some versions, and x of a step
    assert 0 < Held.most <= states * fields + 1
    del end
    expected = x.detach().requires_grad_()
    now = expected
    for _ in range(n):
        now = 1.01 * now.sin()
    torch.testing.assert_close(x.grad, torch.autograd.grad(now.sum(), expected)[0], rtol=1e-13, atol=0)


# ---- memory


NEEDS = checkpoints.Needs(state=100, step=150, call=400, path=1, steps_of_a_call=8.0, in_op=True)
SINGLE = checkpoints.Needs(state=100, step=700)


@pytest.mark.parametrize("needs", [NEEDS, SINGLE])
@pytest.mark.parametrize("memory", [1_500, 3_000, 10_000, 50_000, 10_000_000])
def test_what_fits_into_memory(memory, needs):
    """Stored states and the recorded steps of a part do not exceed the given memory."""
    n = 1000
    kept = checkpoints.fitting(memory, n, needs)
    if kept is None:
        assert memory >= needs.bytes_of(1, n)
    else:
        assert needs.bytes_of(kept.kept(n, needs.in_op) - needs.in_op, kept.every) <= memory < needs.bytes_of(1, n)
    away = checkpoints.fitting(memory, n, needs, offload=True)
    assert away is None or needs._replace(path=0).bytes_of(0, away.every) <= memory


def time_of(kept, n, needs):
    """Time of the computed steps and their calls, for parts of nearly equal length."""
    computed = n + kept.repetitions(n, needs.in_op)
    return computed + needs.steps_of_a_call * math.ceil(computed / kept.every)


@pytest.mark.parametrize("needs", [NEEDS, SINGLE])
@pytest.mark.parametrize("memory", [1_500, 2_000, 3_000, 5_000])
def test_parts_take_the_least_time(memory, needs):
    """By a search over all numbers of parts, and all numbers of states."""
    n, times = 40, []
    for parts in range(1, n + 1):
        for states in range(2, n + 1):
            kept = mpm.Checkpoints(every=math.ceil(n / parts), states=states)
            if needs.bytes_of(kept.kept(n, needs.in_op) - needs.in_op, kept.every) <= memory:
                times.append(time_of(kept, n, needs))
    assert time_of(checkpoints.fitting(memory, n, needs), n, needs) <= min(times) + needs.steps_of_a_call


def test_a_small_budget_needs_few_more_forward_passes():
    """A tenth of the memory of all steps, and a fortieth, in calls of several steps."""
    needs, n = NEEDS._replace(call=0, path=0), 1000
    for share, repetitions, least in ((10, 1, 30), (40, 2, 8)):
        kept = checkpoints.fitting(n * needs.step / share, n, needs)
        assert kept.repetitions(n, in_op=True) <= repetitions * n and kept.every >= least


def test_too_little_memory_is_said():
    words = "memory must be at least 753 bytes, for 2 stored states and the backward pass of 1 recorded step, got 500"
    with pytest.raises(ValueError, match=words):
        checkpoints.fitting(500, 10, NEEDS)
    with pytest.raises(ValueError, match="memory must be at least 550 bytes, for the backward pass of 1 recorded step"):
        checkpoints.fitting(500, 10, NEEDS, offload=True)
    for kind in ("network", "one op"):
        with pytest.raises(ValueError, match="memory must be at least"):
            step, state = make(kind, "cpu")
            v = state.v.clone().requires_grad_()
            mpm.rollout(step, state.replace(v=v), 5, DT, checkpoint=mpm.Checkpoints(memory=10))


def test_wrong_checkpoints():
    for arguments, message in (
        ({}, "must have memory, or one or both of every and states, got none"),
        ({"every": 3, "memory": 4e6}, "got every and memory"),
        ({"every": 0}, "every must be at least 1"),
        ({"states": 1}, "states must be at least 2"),
        ({"memory": -1.0}, "memory must be a positive number of bytes"),
        ({"states": 3, "offload": True}, "offload must be False with states"),
    ):
        with pytest.raises(ValueError, match=message):
            mpm.Checkpoints(**arguments)
    with pytest.raises(TypeError, match="every must be a whole number"):
        mpm.Checkpoints(every=1.5)


# ---- estimates


def kept_bytes(run):
    """Bytes that autograd stores for a computation."""
    kept = {}

    def pack(t):
        kept[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
        return t

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
        result = run()
    return sum(kept.values()), result


def test_an_estimate_of_memory_is_what_autograd_keeps(device):
    step, state = make("network", device)
    state = state.replace(v=state.v.clone().requires_grad_())
    before = step.status
    random = torch.get_rng_state()
    estimate = mpm.estimate_rollout(step, state, 20, DT)
    assert step.status is before and torch.equal(torch.get_rng_state(), random)
    assert all(p.grad is None for p in (state.v, *step.parameters()))
    found, _ = kept_bytes(lambda: mpm.rollout(step, state, 20, DT))
    assert found <= estimate.memory < 1.5 * found
    assert estimate.steps == 20 and estimate.seconds > 0
    less = mpm.estimate_rollout(step, state, 20, DT, checkpoint=mpm.Checkpoints(states=3), prefix=4)
    assert less.memory < estimate.memory / 2 and less.kept_states == 3
    assert less.steps == 20 + mpm.Checkpoints(states=3).repetitions(16)


def test_an_estimate_of_a_rollout_in_one_op(device):
    step, state = make("one op", device)
    estimate = mpm.estimate_rollout(step, state, 20, DT, checkpoint=5)
    assert estimate.per_particle * len(state) == pytest.approx(estimate.memory)
    words = str(estimate)
    assert "4 stored states, 40 steps including recomputed ones" in words
    assert mpm.estimate_rollout(step, state, 20, DT, truncate=5).steps == 15 + 2 * 5
    assert mpm.estimate_rollout(step, state, 0, DT).steps == 0


@pytest.mark.parametrize("heated", ["", "heat", "heat, deterministic"])
@pytest.mark.parametrize("kept", [None, 8, mpm.Checkpoints(states=3), mpm.Checkpoints(memory=3e8)])
def test_an_estimate_of_a_rollout_in_one_op_is_what_the_allocator_gives(kept, heated, device):
    """From above, as for small scenes in `test_rollout_memory.py`."""
    if device == "cpu":
        pytest.skip("the allocator of large tensors on the CPU has no counters")
    step, state = study.setup("compiled", 24, device)
    if "deterministic" in heated:
        step.grid = mpm.Grid(step.grid.dx, step.grid.lower, step.grid.upper, deterministic=True)
    if heated:
        step.heat = mpm.Heat(step.grid, conductivity=50.0, specific_heat=100.0)
        state = step.prepare(state.replace(temperature=state.x[:, 0].clone()))
    estimate = mpm.estimate_rollout(step, state, 40, DT, kept)

    def run():
        v = state.v.clone().requires_grad_()
        torch.autograd.grad(mpm.rollout(step, state.replace(v=v), 40, DT, kept).x.sum(), v)

    run()
    assert 0.3 < memory.of_cuda(run) / estimate.memory <= 1


@pytest.mark.parametrize(
    ("kept", "law"),
    [
        (2, "neo_hookean"),
        pytest.param(mpm.Checkpoints(states=2), "von_mises", marks=pytest.mark.thorough),
        pytest.param(1, "von_mises", marks=pytest.mark.thorough),
    ],
)
def test_compiled_steps_that_were_never_called(kept, law, device):
    """Objects that a step creates and caches at its first call are no part of the recomputation."""
    grid = mpm.Grid(dx=0.1, lower=(0.0, 0.0), upper=(1.0, 1.0), max_blocks=25)
    state = block((0.3, 0.3), (0.5, 0.5), grid, velocity=(3.0, 1.0), device=device)

    def gradient(compiled: bool, kept):
        step = mpm.Step(grid, LAWS[law](), gravity=(0.0, -9.8))
        step = torch.compile(step, backend="aot_eager") if compiled else step
        v = state.v.clone().requires_grad_()
        end = mpm.rollout(step, state.replace(v=v), 5, 1e-3, kept)
        return torch.autograd.grad(end.x.sum() + end.v.square().sum(), v)[0]

    torch.testing.assert_close(gradient(True, kept), gradient(False, None), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["heat", "history"])
def test_memory_does_not_grow_with_the_steps(kind, device):
    """Of three states, for lists of tensors of the op of many steps too: those of heat, and the history of a law."""
    step, state = heat_scenes.scene(2, law="viscoelastic" if kind == "history" else "neo_hookean", device=device)
    if kind == "history":
        history = {name: t for name, t in state.extra.items() if name != "temperature_gradient"}
        step.heat, state = None, state.replace(temperature=None, extra=history)

    def most(n):
        def run():
            v = state.v.clone().requires_grad_()
            end = mpm.rollout(step, state.replace(v=v), n, heat_scenes.DT, checkpoint=mpm.Checkpoints(states=3))
            torch.autograd.grad(end.x.square().sum(), v)

        return memory.of_returned_tensors(run)

    assert most(40) < 1.2 * most(10)
