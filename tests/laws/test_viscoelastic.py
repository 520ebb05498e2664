"""The viscoelastic solid against plain torch, closed forms of relaxation, invariances and finite differences."""

import math

import pytest
import torch
from cases.matrices import rotations
from cases.plasticity import data, error, random_states, state_of, to
from helpers import TOLERANCE
from oracle.viscoelastic import viscoelastic_update

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block
from torch_mpm.ops import law_energy, law_update

MU, LAM, BRANCH, TIME = 2.0, 3.0, 5.0, 0.1


def inputs(count, dim):
    """F, parameters with dt of the size of the relaxation time, and a history of isochoric flow."""
    mu, lam = data("hencky", count)[0]
    positive = [0.2 + torch.rand(count, dtype=torch.float64) for _ in range(3)]
    flow = random_states(count, dim)
    flow = flow / torch.linalg.det(flow)[:, None, None] ** (1 / dim)
    return random_states(count, dim), [mu, lam, *positive], flow - torch.eye(dim, dtype=torch.float64)


def sheared(dim, amount, count=1):
    F = torch.eye(dim, dtype=torch.float64).repeat(count, 1, 1)
    F[:, 0, 1] = amount
    return F


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_update_is_the_reference(device, dim, dtype):
    F, p, q = inputs(1001, dim)
    expected = viscoelastic_update(F, *p, q)
    target = (device, dtype)
    result = law_update("viscoelastic", F.to(*target), to(p, *target), [q.to(*target)], details=True)
    tolerance = TOLERANCE["law"][dtype]
    assert error(result.stress, expected[0]) < tolerance
    assert error(result.history[0], expected[1]) < tolerance
    assert error(result.dissipated, expected[2]) < tolerance
    assert bool(result.converged.all())
    assert torch.equal(result.state, F.to(*target))


def test_stress_of_the_branch_relaxes(device, dim):
    """Held at a shear, the stress beyond equilibrium falls by 1 + Δt/T a step, and as e^(−t/T) for small steps."""
    F = sheared(dim, 0.3).to(device)
    law = mpm.Viscoelastic(mu=MU, lam=LAM, branch_modulus=BRANCH, relaxation_time=TIME)
    rest = mpm.NeoHookean(mu=MU, lam=LAM).stress(state_of(F))
    start = law.stress(state_of(F)) - rest
    for steps, tolerance in ((10, 0.06), (1000, 6e-4)):
        state = state_of(F)
        for _ in range(steps):
            fields, stress = law.update(mpm.parameters.Overlay(state, dt=TIME / steps))
            state = state.replace(extra=fields)
        assert torch.allclose(stress - rest, start * (1 + 1 / steps) ** -steps, rtol=1e-10, atol=1e-12)
        assert torch.allclose(stress - rest, start * math.exp(-1), rtol=tolerance, atol=1e-12)


def test_what_the_spring_loses_is_dissipated(device, dim):
    """At a held deformation: all energy that the state loses but the square of the change, which is of second order."""
    F, p, q = inputs(100, dim)
    F, p, q = F.to(device), to(p, device), q.to(device)
    result = law_update("viscoelastic", F, p, [q], details=True)
    lost = law_energy("viscoelastic", F, p, [q]) - law_energy("viscoelastic", F, p, result.history)
    assert torch.allclose(lost, result.dissipated + p[2] * result.multiplier**2, rtol=1e-9, atol=1e-12)
    assert float(result.dissipated.min()) >= 0


def test_flow_keeps_the_volume_and_knows_no_rotation(device, dim):
    F, p, q = inputs(200, dim)
    F, p, q = F.to(device), to(p, device), q.to(device)
    identity, Q = torch.eye(dim, dtype=torch.float64, device=device), rotations(200, dim).to(device)
    result, turned = (law_update("viscoelastic", A, p, [q]) for A in (F, Q @ F))
    assert torch.allclose(torch.linalg.det(identity + result.history[0]), torch.linalg.det(identity + q), rtol=1e-12)
    assert torch.allclose(turned.stress, Q @ result.stress @ Q.mT, rtol=1e-10, atol=1e-11)
    assert torch.allclose(turned.history[0], result.history[0], rtol=1e-10, atol=1e-11)


def test_gradients(device, dim):
    F, p, q = inputs(4, dim)
    leaves = [t.to(device).requires_grad_() for t in (F, *p, q)]

    def update(F, *rest):
        result = law_update("viscoelastic", F, rest[:5], [rest[5]], details=True)
        return result.stress, result.history[0], result.dissipated, result.multiplier

    assert torch.autograd.gradcheck(update, leaves, atol=1e-7, rtol=1e-5)
    assert torch.autograd.gradcheck(lambda F, *r: law_energy("viscoelastic", F, r[:5], [r[5]]), leaves, atol=1e-7)


def test_extremes(device):
    """No time step and no relaxation: elastic. A long step: the stress at rest. Deformations without volume: none."""
    F = sheared(3, 0.3, 4).to(device)
    zero = torch.zeros_like(F)

    def update(F, time, dt):
        p = [torch.tensor(v, dtype=torch.float64, device=device) for v in (MU, LAM, BRANCH, time, dt)]
        return law_update("viscoelastic", F, p, [zero], details=True)

    start = update(F, TIME, 0.0)
    assert torch.equal(start.history[0], zero)
    assert torch.allclose(update(F, 1e300, 1.0).stress, start.stress, rtol=1e-13)
    rest = mpm.NeoHookean(mu=MU, lam=LAM).stress(state_of(F))
    assert torch.allclose(update(F, TIME, 1e20).stress, rest, rtol=1e-12, atol=1e-13)
    bad = F.clone()
    bad[0, 0, 0], bad[1], bad[2, 0, 0] = math.nan, 0, -1
    result = update(bad, TIME, 1e-3)
    assert result.branch.tolist() == [3, 3, 3, 1] and start.branch.tolist() == [0] * 4
    assert not result.stress[:3].any() and not result.history[0][:3].any()


def test_rollout_against_differences(device):
    """A falling block in a mixture and a batch: gradients of positions by every parameter."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), scenes=2)
    one = block((0.3, 0.05), (0.6, 0.3), 0.1, device=device)
    state = mpm.State.concatenate([one, one], scene=True)
    state = state.replace(v=torch.randn(len(state), 2, dtype=torch.float64, device=device))
    state = state.replace(material=torch.arange(len(state), device=device, dtype=torch.int32) % 2)

    def end(E, branch, time):
        viscous = mpm.Viscoelastic(E=E, nu=0.3, branch_modulus=branch, relaxation_time=time)
        step = mpm.Step(grid, mpm.Mixture([mpm.NeoHookean(E=E, nu=0.3), viscous]), gravity=(0.0, -9.8), walls="slip")
        return mpm.rollout(step, state, 8, 1e-3).x

    values = [torch.tensor(v, dtype=torch.float64, device=device) for v in (1e4, 2e4, 5e-3)]
    leaves = [v.clone().requires_grad_() for v in values]
    weights = torch.randn(len(state), 2, dtype=torch.float64, device=device)
    grads = torch.autograd.grad((end(*leaves) * weights).sum(), leaves)
    for k, grad in enumerate(grads):
        step = 1e-4 * values[k]
        high, low = ((end(*(v + s * step * (i == k) for i, v in enumerate(values))) * weights).sum() for s in (1, -1))
        assert float(grad) == pytest.approx(float((high - low) / (2 * step)), rel=1e-6)


def test_scene_file(tmp_path):
    pytest.importorskip("pydantic")
    from helpers import disc

    words = {"law": "viscoelastic", "E": 1e4, "branch_modulus": 1e4, "relaxation_time": 0.01}
    scene = mpm.Scene(**disc(material={"jelly": words}, duration=0.04))
    scene.run(tmp_path / "out")
    assert (tmp_path / "out" / "trajectory.h5").exists()
    with pytest.raises(ValueError, match="relaxation_time"):
        mpm.Scene(**disc(material={"jelly": {**words, "relaxation_time": 0.0}}))
