"""Anomaly detection names the operation, the substep and the scene of the first NaN of a gradient."""

import re

import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step

DT = 1e-3
pytestmark = pytest.mark.filterwarnings("ignore:Anomaly Detection", "ignore:Error detected")


def make(device):
    step = make_step(2, scenes=3, gravity=(0.0, -9.8))
    states = [block_state(2, device), block_state(2, device, low=0.35), block_state(2, device, low=0.4)]
    return step, mpm.State.concatenate(states, scene=True)


def root_of(state, dt):
    """An operation whose gradient is NaN in scene 1 at the fourth step: zero times an infinite slope."""
    late = (state.scene == 1) & (2.5 * DT < state.time < 3.5 * DT)
    zero = torch.where(late[:, None], 0 * state.v, state.v.square() + 1)
    return state.replace(v=state.v + 0 * zero.sqrt())


def backward(step, state, checkpoint=None, n=6):
    v = state.v.clone().requires_grad_()
    mpm.rollout(step, state.replace(v=v), n, DT, checkpoint=checkpoint).x.square().sum().backward()
    return v.grad


@pytest.mark.parametrize("checkpoint", [None, 2, mpm.Checkpoints(states=2)])
def test_the_operation_the_substep_and_the_scene_are_named(checkpoint, device):
    step, state = make(device)
    step.on_particles = root_of
    assert bool(backward(step, state, checkpoint).isnan().any())  # no warning, and nothing is clipped
    expected = r"the gradient of (Sqrt|Mul)Backward0 is NaN \(of its input 0\) in substep 3 of the rollout, scene 1$"
    with torch.autograd.detect_anomaly(), pytest.raises(RuntimeError, match=expected):
        backward(step, state, checkpoint)


def test_nodes_have_scenes_too(device):
    """A field of force on the nodes, whose gradient is NaN where two scenes have nodes."""
    step, state = make(device)

    def field(blocks, velocity, mass, dt):
        there = (blocks.node_scene() != 1)[:, None] & (mass > 0)[:, None]
        return velocity + 0 * torch.where(there, 0 * velocity, velocity.square() + 1).sqrt()

    step.on_grid = field
    with torch.autograd.detect_anomaly(), pytest.raises(RuntimeError) as raised:
        backward(step, state)
    assert re.search("in substep 5 of the rollout, scenes 0, 2$", str(raised.value))


def test_the_ops_are_named(device):
    """An op of the library; NaN from the loss is reported as such."""
    step, state = make(device)
    assert "in one op" in step.explain(state, DT)
    v = state.v.clone().requires_grad_()
    with torch.autograd.detect_anomaly():
        assert "anomaly detection inspects every step" in step.explain(state, DT)
        end = mpm.rollout(step, state.replace(v=v), 3, DT)
        loss = torch.zeros_like(end.x)
        loss[-1] = torch.nan
        with pytest.raises(
            RuntimeError, match=r"torch_mpm_g2p_advanceBackward is NaN .* substep 2 of the rollout, .* NaN already"
        ):
            torch.autograd.grad(end.x, v, loss)
    with torch.autograd.detect_anomaly():
        assert bool(backward(step, state).isfinite().all())


def test_gradients_of_finite_states_are_finite(device):
    """At rest, where all stretches are equal, with walls, obstacles and friction."""
    laws = [mpm.NeoHookean(E=1e4, nu=0.3), mpm.FixedCorotated(E=1e4, nu=0.3), mpm.QuarticSand(E=1e6, nu=0.3)]
    laws += [mpm.CustomPrincipalLaw(lambda s: 1e4 * s.log()), mpm.VonMises(E=1e4, nu=0.3, yield_stress=10.0)]
    with torch.autograd.detect_anomaly():
        for law in laws:
            step = make_step(2, walls="sticky", boundaries=[mpm.Sphere((0.4, 0.3), 0.1, friction=0.4)])
            step.law = law
            state = block_state(2, device).replace(v=torch.zeros_like(block_state(2, device).v))
            assert bool(backward(step, state).isfinite().all())
