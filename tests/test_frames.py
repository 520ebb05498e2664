"""`frames` against `rollout` and single steps: what it keeps, what a hook does, and gradients of both."""

import pytest
import torch
from cases.rollouts import F64
from helpers import TOLERANCE

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box

DT = 1e-4


def fall(dim: int = 3, **options: object) -> mpm.Step:
    return mpm.Step(
        unit_box(dim), mpm.VonMises(E=1e4, nu=0.3, yield_stress=50.0), (0.0, -9.8, 0.0)[:dim], "slip", **options
    )


@pytest.mark.parametrize("n,every", [(6, 1), (6, 2), (7, 3), (2, 5), (0, 1)])
def test_frames_are_states_of_the_rollout(n, every, dim, device):
    step, state = fall(dim), blob(device, dim)
    with torch.no_grad():
        found = mpm.frames(step, state, n, DT, every, ["x", "v", "F", "plastic_strain"])
        at = [k for k in range(0, n + 1) if k % every == 0]
        expected = [step.prepare(mpm.rollout(step, state, k, DT)) for k in at]
        end = mpm.rollout(step, state, n, DT)
    assert len(found.time) == n // every + 1
    torch.testing.assert_close(found.time, DT * torch.tensor(at, dtype=F64), rtol=1e-12, atol=0)
    tolerance = {"rtol": 0, "atol": 0} if device == "cpu" else {"rtol": 1e-9, "atol": 1e-9}
    for name in ("x", "v", "F"):
        torch.testing.assert_close(found.fields[name], torch.stack([getattr(s, name) for s in expected]), **tolerance)
    strains = torch.stack([s.extra["plastic_strain"] for s in expected])
    torch.testing.assert_close(found.fields["plastic_strain"], strains, **tolerance)
    torch.testing.assert_close(found.end.x, end.x, **tolerance)


def test_a_hook_acts_before_its_step(device):
    """A push at step 4 alone is that push between two rollouts; frames show the state before it."""
    step, state = fall(), blob(device)
    push = torch.tensor([1.0, 0.0, 0.0], dtype=F64, device=device)
    seen = []

    def hook(state: mpm.State, k: int) -> mpm.State | None:
        seen.append(k)
        return state.replace(v=state.v + push) if k == 4 else None

    with torch.no_grad():
        found = mpm.frames(step, state, 8, DT, 2, hook=hook)
        middle = mpm.rollout(step, state, 4, DT)
        end = mpm.rollout(step, middle.replace(v=middle.v + push), 4, DT)
    assert seen == [0, 2, 4, 6]
    tolerance = TOLERANCE["rollout"][F64]
    torch.testing.assert_close(found.fields["v"][2], middle.v, rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(found.end.x, end.x, rtol=tolerance, atol=tolerance)


def test_a_hook_may_write_into_the_state(device):
    step, state = fall(), blob(device)
    before = state.v.clone()

    def hook(state: mpm.State, k: int) -> None:
        state.v.add_(1.0)

    with torch.no_grad():
        found = mpm.frames(step, state.replace(v=state.v.clone()), 2, DT, hook=hook)
    assert torch.equal(found.fields["v"][0], before)


@pytest.mark.parametrize("checkpoint", [None, 2])
def test_gradients_pass_through_frames_and_controls(checkpoint, device):
    """A loss on every frame, by controls over time: as single steps give it."""

    def loss(of_frames: bool) -> tuple[torch.Tensor, ...]:
        step, state = mpm.Step(unit_box(2), mpm.NeoHookean(E=1e4, nu=0.3)), blob(device, 2)
        control = torch.linspace(0.1, 1, 6, dtype=F64).reshape(3, 2).to(device).requires_grad_()

        def hook(state: mpm.State, k: int) -> mpm.State:
            return state.replace(v=state.v + control[k // 2])

        if of_frames:
            x = mpm.frames(step, state, 6, DT, 2, ["x"], hook, checkpoint).fields["x"]
        else:
            kept = [state.x]
            for k in range(6):
                state = step(hook(state, k) if k % 2 == 0 else state, DT)
                kept += [state.x] if k % 2 else []
            x = torch.stack(kept)
        weights = torch.sin(torch.arange(x.numel(), dtype=F64, device=device)).reshape(x.shape)
        return torch.autograd.grad((weights * x.square()).sum(), [control])

    (found,), (expected,) = loss(True), loss(False)
    assert float((found - expected).norm() / expected.norm()) < TOLERANCE["rollout"][F64]


def test_any_function_is_a_step_and_dt_may_be_of_scenes(device):
    state = blob(device, scene=(torch.arange(300) % 2).int())
    step = mpm.Step(unit_box(scenes=2), mpm.NeoHookean(E=1e4, nu=0.3))
    dt = torch.tensor([1e-4, 2e-4], dtype=F64, device=device)
    found = mpm.frames(lambda s, dt: step(s, dt), state.replace(time=torch.zeros_like(dt)), 3, dt)
    torch.testing.assert_close(found.time, torch.arange(4, device=device)[:, None] * dt)
    torch.testing.assert_close(found.fields["x"][0], state.x)


def test_wrong_arguments():
    step, state = fall(), blob("cpu")
    with pytest.raises(ValueError, match=r"fields must be names of fields that the state has, x, v, mass.*got 'y'"):
        mpm.frames(step, state, 2, DT, fields=["x", "y"])
    with pytest.raises(TypeError, match="fields must be a list of names"):
        mpm.frames(step, state, 2, DT, fields="x")
    with pytest.raises(ValueError, match="every"):
        mpm.frames(step, state, 2, DT, every=0)
    with pytest.raises(TypeError, match="hook must be a function"):
        mpm.frames(step, state, 2, DT, hook=1)
    with pytest.raises(TypeError, match="hook must return None or a State of 300 particles"):
        mpm.frames(step, state, 2, DT, hook=lambda state, k: state.x)


@pytest.mark.parametrize("dt", [1e-3, torch.tensor(1e-3), torch.tensor([1e-3]), torch.tensor([1e-3, 2e-3])])
@pytest.mark.parametrize("time", [0.5, torch.tensor([0.5]), torch.tensor([0.5, 0.25])])
@pytest.mark.parametrize("n", [0, 4])
def test_times_of_frames(dt, time, n, device):
    """Including the time of the start, which may be a number where dt is a tensor."""
    dt, time = (t.to(device) if isinstance(t, torch.Tensor) else t for t in (dt, time))
    step = mpm.Step(unit_box(2, scenes=2), mpm.NeoHookean(E=1e4, nu=0.3))
    state = mpm.State.concatenate([blob(device, 2, 20)] * 2, scene=True).replace(time=time)
    with torch.no_grad():
        found = mpm.frames(step, state, n, dt, every=2)
    start, length = (torch.as_tensor(t, dtype=F64, device=device) for t in (time, dt))
    expected = [start + k * length for k in range(0, n + 1, 2)] if n else [start]
    shape = torch.broadcast_shapes(start.shape, length.shape) if n else start.shape
    assert found.time.dtype == F64 and found.time.shape == (len(expected), *shape)
    torch.testing.assert_close(found.time, torch.stack([t.expand(shape) for t in expected]).to(found.time.device))
    assert torch.equal(found.time[-1].cpu(), torch.as_tensor(found.end.time, dtype=F64).cpu())
