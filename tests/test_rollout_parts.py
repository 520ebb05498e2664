"""Rollouts with a beginning without gradients, gradients that are cut, and hooks."""

import pytest
import torch
from helpers import relative_error

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step

N, DT = 12, 1e-3
GRAVITY = (0.0, -9.8)


def make(kind, device):
    """A step with a gradient of gravity, a state with one of velocity and of mass."""
    gravity = torch.tensor(GRAVITY, dtype=torch.float64, device=device, requires_grad=True)
    step = make_step(2, gravity=gravity, walls="separate", grid={"deterministic": True})
    if kind == "from Python":
        step.law = lambda F: 1e4 * (F @ F.mT - torch.eye(2, dtype=F.dtype, device=F.device))
    state = block_state(2, device)
    return step, state.replace(v=state.v.clone().requires_grad_(), mass=state.mass.clone().requires_grad_())


def loss_of(state):
    return state.x.square().sum() + 1e-2 * state.v.sum()


def gradients(loss, step, state):
    return torch.autograd.grad(loss, [step.gravity, state.mass, state.v], retain_graph=True, allow_unused=True)


def in_a_loop(step, state, cuts):
    """Single steps with the moving fields of the state detached before some of them; losses after every fourth."""
    losses = []
    for k in range(N):
        if k and k % 4 == 0:
            losses.append(loss_of(state))
        if k in cuts:
            state = state.replace(**{name: getattr(state, name).detach() for name in ("x", "v", "C", "F")})
        state = step(state, DT)
    return losses, state


@pytest.mark.parametrize("checkpoint", [None, 2])
@pytest.mark.parametrize("kind", ["in one op", "from Python"])
@pytest.mark.parametrize(("options", "cuts"), [({"prefix": 5}, [5]), ({"truncate": 5}, [7]), ({"truncate": 50}, [])])
def test_the_end_of_a_rollout_that_is_cut(kind, options, cuts, checkpoint, device):
    step, state = make(kind, device)
    end = mpm.rollout(step, state, N, DT, checkpoint, **options)
    _, expected = in_a_loop(step, state, cuts)
    torch.testing.assert_close(end.x, expected.x, rtol=0, atol=1e-14)
    for got, wanted in zip(
        gradients(loss_of(end), step, state), gradients(loss_of(expected), step, state), strict=True
    ):
        assert (got is None) == (wanted is None)
        assert got is None or relative_error(got, wanted) < 1e-11
    if cuts:  # gravity of the steps before the cut has no part in it
        (whole, *_) = gradients(loss_of(in_a_loop(step, state, [])[1]), step, state)
        cut, _, by_v = gradients(loss_of(end), step, state)
        assert relative_error(cut, whole) > 0.05 and by_v is None


@pytest.mark.parametrize("kind", ["in one op", "from Python"])
def test_losses_on_the_way_with_cuts(kind, device):
    """Each loss is seen by the steps back to the cut before it, also where it stands at a cut."""
    step, state = make(kind, device)
    losses = []
    end = mpm.rollout(
        step, state, N, DT, truncate=4, every=4, hook=lambda now, k: losses.append(loss_of(now)) if k else None
    )
    separate, expected = in_a_loop(step, state, [4, 8])
    total, wanted = sum(losses) + loss_of(end), sum(separate) + loss_of(expected)
    torch.testing.assert_close(total, wanted, rtol=1e-13, atol=0)
    for got, reference in zip(gradients(total, step, state), gradients(wanted, step, state), strict=True):
        assert relative_error(got, reference) < 1e-11


def test_hooks_act_and_are_called_in_the_prefix_too(device):
    step, state = make("in one op", device)
    seen = []

    def push(now, k):
        seen.append((k, now.v.requires_grad, torch.is_grad_enabled()))
        return now.replace(v=now.v + torch.tensor([0.1 * k, 0.0], dtype=now.v.dtype, device=now.v.device))

    end = mpm.rollout(step, state, N, DT, prefix=6, hook=push, every=3)
    assert seen == [(0, True, False), (3, False, False), (6, False, True), (9, True, True)]
    expected = state.detach()
    for k in range(0, N, 3):
        expected = mpm.rollout(step, push(expected, k), 3, DT)
    torch.testing.assert_close(end.x, expected.x, rtol=0, atol=1e-14)


def test_a_control_keeps_its_gradient_and_is_not_cut_with_the_state(device):
    """Fields from a hook pass the cuts if steps do not change them; a new state at a cut raises an error."""
    step, state = make("from Python", device)
    strength = torch.tensor(3.0, dtype=torch.float64, device=device, requires_grad=True)
    step.on_particles = lambda now, dt: now.replace(v=now.v + dt * now.extra["push"])

    def control(now, k):
        return now.replace(extra={"push": strength * torch.ones_like(now.v)}) if k == 0 else None

    end = mpm.rollout(step, state, N, DT, truncate=5, hook=control, every=3)
    (by_strength,) = torch.autograd.grad(end.v[:, 0].mean(), strength)
    torch.testing.assert_close(by_strength, torch.full_like(by_strength, 5 * DT), rtol=1e-9, atol=0)
    step.on_particles = None
    with pytest.raises(ValueError, match="hook must not return a state before step 9, where truncate=3"):
        mpm.rollout(step, state, N, DT, truncate=3, hook=lambda now, k: now.replace(v=now.v), every=9)


def test_frames_with_cuts(device):
    step, state = make("in one op", device)
    kept = mpm.frames(step, state, N, DT, every=4, fields=["x"], prefix=4)
    (by_gravity,) = torch.autograd.grad(kept.fields["x"][2].sum(), step.gravity, retain_graph=True)
    alone = mpm.rollout(step, state, 8, DT, prefix=4)
    torch.testing.assert_close(by_gravity, torch.autograd.grad(alone.x.sum(), step.gravity)[0])


def test_options_that_say_nothing_cost_nothing(device):
    """The whole rollout is one call then."""
    step, state = make("in one op", device)
    with torch.no_grad():
        end = mpm.rollout(step, state, N, DT, prefix=3, truncate=2)
        torch.testing.assert_close(end.x, mpm.rollout(step, state, N, DT).x, rtol=0, atol=1e-14)
    assert mpm.rollout(step, state, 0, DT, prefix=3).x is not None
    nothing = state.select(torch.arange(0, device=device))
    assert len(mpm.rollout(step, nothing, N, DT, truncate=3, norms=mpm.GradientNorms())) == 0


def test_wrong_options(device):
    step, state = make("in one op", device)
    for options, error, message in (
        ({"prefix": -1}, ValueError, "prefix must not be negative"),
        ({"truncate": 0}, ValueError, "truncate must be at least 1"),
        ({"truncate": 1.5}, TypeError, "truncate must be a whole number"),
        ({"every": 0}, ValueError, "every must be at least 1"),
        ({"hook": 3}, TypeError, r"hook must be a function \(state, k\)"),
        ({"norms": True}, TypeError, "norms must be GradientNorms or None, got bool"),
        ({"hook": lambda now, k: 3}, TypeError, "hook must return None or a State"),
    ):
        with pytest.raises(error, match=message):
            mpm.rollout(step, state, N, DT, **options)
