"""Norms of gradients inside rollouts: those of autograd at each state, and of truncated gradients."""

import math

import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step

N, DT = 8, 1e-3


def batch(device):
    """Three scenes: a block, a block at another place, and none."""
    states = [block_state(2, device), block_state(2, device, low=0.35, high=0.6)]
    return mpm.State.concatenate(states, scene=True)


def make(kind):
    step = make_step(2, scenes=3, gravity=(0.0, -9.8), walls="separate")
    if kind == "from Python":
        step.law = lambda F: 1e4 * (F @ F.mT - torch.eye(2, dtype=F.dtype, device=F.device))
    return step


@pytest.mark.parametrize("checkpoint", [None, 1])
@pytest.mark.parametrize("kind", ["in one op", "from Python"])
def test_norms_are_those_of_the_states_on_the_way(kind, checkpoint, device):
    step, state = make(kind), batch(device)
    norms = mpm.GradientNorms(every=3)
    v = state.v.clone().requires_grad_()
    end = mpm.rollout(step, state.replace(v=v), N, DT, checkpoint, norms=norms)
    assert norms.steps == [0, 3, 6, 8] and float(norms.total()[1:].abs().max()) == 0
    end.x.pow(3).sum().backward()

    step = make(kind)
    now, before = step.prepare(state.replace(v=v.detach().requires_grad_())), []
    for k in range(N):
        if k in norms.steps:
            before.append(now)
        now = step(now, DT)
    for name in ("x", "v", "F", "C"):
        states = [s for s in (*before, now) if getattr(s, name) is not None and getattr(s, name).requires_grad]
        grads = torch.autograd.grad(
            now.x.pow(3).sum(), [getattr(s, name) for s in states], retain_graph=True, allow_unused=True
        )
        rows = len(norms.steps) - len(grads)
        for row, grad in enumerate(grads, rows):
            found = norms.fields[name][row]
            if grad is None:
                assert float(found.abs().max()) == 0
                continue
            expected = torch.stack([grad[state.scene == b].norm() for b in range(3)])
            torch.testing.assert_close(found, expected, rtol=1e-9, atol=0)
    total = norms.total()
    assert total.shape == (4, 3) and float(total[1:, 2].max()) == 0  # of the empty scene
    assert bool(total[0].isnan().all()) and bool(norms.fields["F"][0].isnan().all())  # where F needs no gradient
    assert float(total[-1, 0]) == pytest.approx(0.1 * float(norms.fields["x"][-1, 0]))
    assert v.grad is not None and len(v._backward_hooks or ()) == 0  # nothing stays with the user


def test_no_particles_and_no_time(device):
    step, state = make("in one op"), batch(device)
    none = state.select(torch.zeros(0, dtype=torch.int64, device=device))
    norms, v = mpm.GradientNorms(), none.v.clone().requires_grad_()
    mpm.rollout(step, none.replace(v=v), 3, 1e-3, norms=norms).x.sum().backward()
    assert float(norms.fields["v"].nan_to_num().abs().max()) == 0
    with pytest.raises(ValueError, match="dt"):
        mpm.rollout(step, state, 3, 0.0, norms=mpm.GradientNorms())


def test_a_start_that_is_used_elsewhere_counts_as_a_start(device):
    step, state = make("in one op"), batch(device)
    norms, scale = mpm.GradientNorms(), torch.ones((), dtype=torch.float64, device=device, requires_grad=True)
    v = scale * torch.ones_like(state.v)
    found = []
    for other in (0.0, 1e6):
        end = mpm.rollout(step, state.replace(v=v), 3, 1e-3, norms=norms)
        (end.x.sum() + other * v.sum()).backward(retain_graph=True)
        found.append(norms.fields["v"].clone())
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=0)


def spring(rate, device, n=60, scenes=2):
    """Rollouts of x ← rate x of each scene, whose gradients are powers of the rate."""
    rates = torch.tensor(rate, dtype=torch.float64, device=device)
    state = block_state(2, device)
    state = state.replace(scene=(torch.arange(len(state), device=device) % scenes).int())
    norms = mpm.GradientNorms()

    class Scaled(mpm.Step):
        def forward(self, state, dt):
            return state.replace(x=rates[state.scene.long()][:, None] * state.x)

    step = Scaled(mpm.Grid(0.1, (0, 0), (1, 1), scenes=scenes), mpm.NeoHookean(E=1.0, nu=0.3))
    end = mpm.rollout(step, state.replace(x=state.x.clone().requires_grad_()), n, DT, norms=norms)
    end.x.sum().backward()
    return norms


def test_a_truncation_for_gradients_that_grow_or_vanish(device):
    norms = spring([1.5, 1.0], device)
    growing = math.floor(math.log(100) / math.log(1.5)) + 1
    assert norms.truncation() == growing
    assert norms.truncation(growth=10) == math.floor(math.log(10) / math.log(1.5)) + 1
    assert spring([1.0, 0.7], device).truncation() == math.floor(math.log(100) / -math.log(0.7)) + 1
    assert spring([1.0, 0.999], device).truncation() is None
    assert spring([1e200, 1.0], device).truncation() == 1  # of a gradient that is infinite


def test_norms_begin_anew_and_need_a_backward_pass(device):
    step, state, norms = make("in one op"), batch(device), mpm.GradientNorms()
    with pytest.raises(ValueError, match=r"GradientNorms\.truncation needs a backward pass"):
        norms.truncation()
    for n in (3, 5):
        v = state.v.clone().requires_grad_()
        mpm.rollout(step, state.replace(v=v), n, DT, norms=norms).x.sum().backward()
        assert norms.steps == list(range(n + 1))
    with torch.no_grad():
        mpm.rollout(step, state, 2, DT, norms=norms)
    assert norms.fields == {}
    for wrong in (0, 1.5):
        with pytest.raises((TypeError, ValueError), match="every must be"):
            mpm.GradientNorms(every=wrong)
    with pytest.raises(ValueError, match="growth must be a number above 1"):
        norms.truncation(growth=1.0)


def test_norms_of_scenes_with_time_steps_of_their_own(device):
    """The gradient of a paused scene passes unchanged."""
    step, state, norms = make("in one op"), batch(device), mpm.GradientNorms(every=4)
    dt = torch.tensor([1e-3, 0.0, 1e-3], dtype=torch.float64, device=device)
    v = state.v.clone().requires_grad_()
    mpm.rollout(step, state.replace(v=v), N, dt, norms=norms).v.sum().backward()
    assert bool(norms.total()[1:].isfinite().all())
    torch.testing.assert_close(norms.fields["v"][0, 1], norms.fields["v"][-1, 1])
