"""Muscles: their stress against their energy, what they do to a body, and gradients of a controller."""

import pytest
import torch

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step

F64 = torch.float64


def passive():
    return mpm.NeoHookean(E=1e4, nu=0.3)


def stretched(dim, device):
    state = block_state(dim, device)
    eye = torch.eye(dim, dtype=F64, device=device)
    a = 1e3 * torch.randn(len(state), dtype=F64).to(device)
    return state.replace(F=eye + 0.2 * torch.randn(len(state), dim, dim, dtype=F64).to(device), extra={"activation": a})


def test_the_stress_is_that_of_the_energy(dim, device):
    """τ = (∂ψ/∂F) Fᵀ, with fibres of each particle."""
    state = stretched(dim, device)
    d = torch.nn.functional.normalize(torch.randn(len(state), dim, dtype=F64), dim=1).to(device)
    law = mpm.Active(passive(), d)
    F = state.F.clone().requires_grad_()
    (P,) = torch.autograd.grad(law.energy_density(state.replace(F=F)).sum(), F)
    torch.testing.assert_close(law.stress(state), P @ state.F.mT, rtol=1e-11, atol=1e-9)
    resting = state.replace(extra={})
    assert torch.equal(law.stress(resting), passive().stress(resting))
    shuffled = state.replace(ids=torch.arange(len(state), device=device)).select(
        torch.arange(len(state) - 1, -1, -1, device=device)
    )
    torch.testing.assert_close(law.stress(shuffled).flip(0), law.stress(state))


def test_the_stiffness_bounds_that_of_automatic_differentiation(dim, device):
    """The bound is at most 1.32 times the tangent."""
    state, law = stretched(dim, device), mpm.Active(passive(), (1.0,) + (0.0,) * (dim - 1))
    assert bool((1.4 * law.stiffness(state) >= mpm.Material.stiffness(law, state)).all())
    assert bool((law.wave_modulus(state) <= law.stiffness(state) + 1e-9).all())


def test_an_active_body_contracts_along_its_fibres(device):
    """Its momentum stays, and the other direction becomes longer."""
    step = make_step(2)
    step.law = mpm.Active(passive(), (1.0, 0.0))
    start = block_state(2, device, spin=0.0)
    start = start.replace(v=torch.zeros_like(start.v))
    end = mpm.rollout(step, start.replace(extra={"activation": torch.full_like(start.mass, 2e3)}), 40, 1e-3)
    before, after = (s.x.std(0) for s in (start, end))
    assert float(after[0] / before[0]) < 0.97 and float(after[1] / before[1]) > 1.005
    momentum = (end.mass[:, None] * end.v).sum(0).abs().max()
    assert float(momentum) < 1e-12 * float((end.mass[:, None] * end.v).abs().sum())
    active = start.replace(extra={"activation": torch.full_like(start.mass, 2e3)})
    assert float(step.stable_dt(active)) < float(step.stable_dt(start))


@pytest.mark.parametrize("checkpoint", [None, 4])
def test_a_controller_has_gradients(checkpoint, device):
    """A network of the time, and learned fibres, against differences."""
    controller = torch.nn.Sequential(torch.nn.Linear(1, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1)).double().to(device)
    fibre = torch.nn.Parameter(torch.tensor([0.8, 0.6], dtype=F64, device=device))
    step = make_step(2, gravity=(0.0, -9.8), walls="sticky")
    step.law = mpm.Active(passive(), fibre)
    assert {id(fibre)} <= {id(p) for p in step.parameters()}

    def act(state, dt):
        now = torch.full((1, 1), 100 * state.time, dtype=F64, device=device)
        return state.replace(extra={"activation": 1e3 * controller(now)[0].expand(len(state))})

    step.on_particles = act
    state = block_state(2, device)

    def reached():
        return mpm.rollout(step, state, 10, 1e-3, checkpoint=checkpoint).x[:, 0].square().mean()

    leaves = [fibre, *controller.parameters()]
    grads = torch.autograd.grad(reached(), leaves)
    along = [torch.randn_like(p) for p in leaves]
    values = []
    for share in (1e-5, -2e-5):
        with torch.no_grad():
            for p, d in zip(leaves, along, strict=True):
                p += share * d
            values.append(float(reached()))
    slope = sum(float((g * d).sum()) for g, d in zip(grads, along, strict=True))
    assert slope == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-5)


def test_wrong_muscles(device):
    with pytest.raises(ValueError, match="law must update F, which gives fibres their direction, got WeaklyCompress"):
        mpm.Active(mpm.WeaklyCompressible(1e4), (1.0, 0.0))
    with pytest.raises(ValueError, match=r"direction must be a floating tensor of shape \[D\] or \[P, D\], got \[4\]"):
        mpm.Active(passive(), torch.ones(4))
    with pytest.raises(ValueError, match="direction must have 2 or 3 numbers"):
        mpm.Active(passive(), (1.0,))
    state = block_state(2, device)
    state = state.replace(F=torch.eye(2, dtype=F64, device=device).repeat(len(state), 1, 1))
    law = mpm.Active(passive(), torch.tensor([1.0, 0.0], device=device))
    with pytest.raises(ValueError, match=r"state.extra\['activation'\] must be float64 \[P\]"):
        law.stress(state.replace(extra={"activation": torch.ones(len(state), 1, dtype=F64, device=device)}))
    with pytest.raises(ValueError, match=r"direction must have shape \[2\] or"):
        mpm.Active(passive(), torch.ones(3, device=device)).stress(state)


def test_a_direction_given_once(device):
    """[1, D] is [D], for any number of particles."""
    step, state = make_step(2), stretched(2, device)
    ends = []
    for direction in (torch.tensor([0.6, 0.8], dtype=F64), torch.tensor([[0.6, 0.8]], dtype=F64)):
        step.law = mpm.Active(passive(), direction.to(device))
        ends.append((step.law.stress(state), mpm.rollout(step, state, 3, 1e-4).v))
    for a, b in zip(*ends, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12 * float(b.abs().max()))  # CUDA adds in any order
