"""Networks as laws: functions of stretches at rest and at equal stretches, history of any shape, half precision."""

import pytest
import torch
from torch import nn

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step


class StretchNetwork(nn.Module):
    """Stress −∂ψ of an energy that is a symmetric network of the stretches."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(1, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 1))

    def energy(self, sigma):
        return self.layers(sigma[..., None]).sum((-1, -2)) + sigma.log().sum(-1).square()

    def forward(self, sigma):
        return sigma * torch.func.grad(lambda s: self.energy(s).sum())(sigma)


def cases(device):
    """I, two equal stretches, three equal ones, nearly equal ones and a turned, generic F."""
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    rows = [torch.eye(3), torch.diag(torch.tensor([1.2, 1.2, 0.8])), 1.1 * torch.eye(3)]
    rows.append(torch.diag(torch.tensor([1.1, 1.1 + 1e-9, 0.7])))
    rows += [turn @ torch.diag(torch.tensor([1.3, 1.3, 0.9])).double(), torch.eye(3) + 0.2 * torch.randn(3, 3)]
    return torch.stack([r.double() for r in rows]).to(device)


def test_a_network_of_stretches_against_its_energy(device):
    """U diag(τ) Uᵀ of τ = σ ∂ψ/∂σ is (∂ψ/∂F) Fᵀ with ψ of the singular values alone, whose gradient always exists; and
    its own gradient is that of central differences."""
    network = StretchNetwork().double().to(device)
    F = cases(device)
    leaf = F.clone().requires_grad_()
    (P,) = torch.autograd.grad(network.energy(mpm.svd3(leaf).sigma).sum(), leaf)
    stress = mpm.isotropic(leaf, network)
    torch.testing.assert_close(stress.detach(), P @ F.mT, rtol=1e-10, atol=1e-12)
    weights, along = torch.randn(2, *F.shape, dtype=torch.float64).to(device)
    grad, *by_weights = torch.autograd.grad((stress * weights).sum(), [leaf, *network.parameters()], allow_unused=True)
    with torch.no_grad():
        plus, minus = (mpm.isotropic(F + h * along, network) for h in (1e-5, -1e-5))
    difference = ((plus - minus) * weights).sum((1, 2)) / 2e-5
    torch.testing.assert_close((grad * along).sum((1, 2)), difference, rtol=1e-6, atol=1e-6)
    assert by_weights.pop() is None  # a constant of the energy has no stress
    assert all(bool(g.isfinite().all()) for g in by_weights)


def test_gradients_in_float32_are_those_of_float64(device):
    network = StretchNetwork().to(device)
    F = cases(device)
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaf = F.to(dtype).requires_grad_()
        grads.append(torch.autograd.grad(mpm.isotropic(leaf, network.to(dtype)).square().sum(), leaf)[0].double())
    scale = grads[1].abs().amax((1, 2))
    assert float(((grads[0] - grads[1]).abs().amax((1, 2)) / scale).max()) < 2e-3  # the slope of a difference


def test_what_a_function_of_stretches_may_return(device):
    F = cases(device)
    stress = mpm.isotropic(F, torch.log)
    half, same, label = mpm.isotropic(F, lambda s: (0.5 * s, s.log(), "kept"))
    torch.testing.assert_close(half, 0.5 * F, rtol=1e-12, atol=1e-12)
    assert torch.equal(same, stress) and label == "kept"
    assert mpm.isotropic(F, lambda s: (s, s.log()))[0] is F
    turned_inside_out = F * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64, device=device)
    sizes = mpm.isotropic(turned_inside_out, lambda s: (s, s.sign()))[1]
    torch.testing.assert_close(sizes.diagonal(dim1=1, dim2=2).sum(1), torch.ones_like(F[:, 0, 0]))
    nothing = F[:0].requires_grad_()
    assert mpm.isotropic(nothing, torch.log).shape == (0, 3, 3)
    lost = F.clone()
    lost[2] = torch.nan
    assert mpm.isotropic(lost, torch.log).isnan().any((1, 2)).tolist() == [k == 2 for k in range(len(F))]
    with pytest.raises(ValueError, match=r"must return stresses of shape \[6, 3\], got \[6\]"):
        mpm.isotropic(F, lambda s: s[:, 0])
    with pytest.raises(TypeError, match="function must be a function or module, got int"):
        mpm.isotropic(F, 3)
    with pytest.raises(TypeError, match=r"F must be float32 or float64, got torch.float16"):
        mpm.isotropic(F.half(), torch.log)


class Remembering(nn.Module):
    """A plastic correction with a memory of five numbers and a matrix for each particle."""

    def __init__(self):
        super().__init__()
        self.recurrent = nn.GRUCell(9, 5)
        self.head = nn.Linear(5, 9)

    def forward(self, F, memory, average):
        D = F.shape[1]
        strain = (F.mT @ F - torch.eye(D, dtype=F.dtype, device=F.device)).flatten(1)
        memory = self.recurrent(nn.functional.pad(strain, (0, 9 - D * D)), memory)
        F = F + 1e-3 * self.head(memory)[:, : D * D].unflatten(1, (D, D))
        return F, 1e4 * (F @ F.mT - torch.eye(D, dtype=F.dtype, device=F.device)), memory, (average + F) / 2


def test_history_of_any_shape(device, dim):
    """It goes along with its particles, in a loop that is written out, and brings gradients through time."""
    network = Remembering().double().to(device)
    start = torch.full((5,), 0.1, dtype=torch.float64)
    law = mpm.CustomLaw(network, history={"memory": start, "average": (dim, dim)})
    step, state = make_step(dim), block_state(dim, device)
    step.law = law
    assert law.extra_fields == ("memory", "average")
    end = mpm.rollout(step, state, 4, 1e-3, checkpoint=2)
    shuffled = step.prepare(state).select(torch.arange(len(state) - 1, -1, -1, device=device))
    other = mpm.rollout(step, shuffled.sorted(step.grid), 4, 1e-3)

    F = torch.eye(dim, dtype=torch.float64, device=device).repeat(len(state), 1, 1)
    memory, average = start.to(device).repeat(len(state), 1), 0 * F
    single = make_step(dim, on_particles=None)
    single.law = lambda F: given[0]
    seen = state
    for _ in range(4):
        F, stress, memory, average = network(seen.F if seen.F is not None else F, memory, average)
        given = [stress]
        seen = single(seen.replace(F=F), 1e-3)
    for name, expected in (("memory", memory), ("average", average)):
        torch.testing.assert_close(end.extra[name], expected, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(end.x, seen.x, rtol=0, atol=1e-14)
    assert other.extra["average"].shape == (len(state), dim, dim)
    grads = torch.autograd.grad(end.v.square().sum(), list(network.parameters()))
    assert all(float(g.abs().max()) > 0 for g in grads)


def test_history_of_a_wrong_kind_is_named(device):
    state = block_state(2, device)

    def refused(law, error, message):
        with pytest.raises(error, match=message):
            step = make_step(2)
            step.law = law()
            step(state, 1e-3)

    refused(
        lambda: mpm.CustomLaw(lambda F, h: F, history={"h": ()}), ValueError, "the law must return F, stress, h, got"
    )
    wrong = lambda F, h: (F, F, h[:, None])  # noqa: E731
    refused(lambda: mpm.CustomLaw(wrong, history={"h": ()}), ValueError, r"the law must return h of shape \[")
    refused(lambda: mpm.CustomLaw(wrong, history={"F": ()}), ValueError, "a name of its own, got 'F'")
    refused(lambda: mpm.CustomLaw(wrong, history=["h"]), TypeError, "history must be a dict of shapes or tensors")
    refused(lambda: mpm.CustomLaw(wrong, history={"h": "x"}), TypeError, r"history\['h'\] must be a shape or a tensor")


class Linear(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 4)

    def forward(self, F):
        return 1e3 * self.layer((F - torch.eye(2, device=F.device)).flatten(1)).unflatten(1, (2, 2))


def scaled_logarithms(network, sigma):
    """Principal stresses in bfloat16 where autocast acts."""
    scale = network.layer(torch.ones_like(sigma[:, :1]).repeat(1, 4))[:, :1]
    return 1e3 * scale * (sigma.log() @ torch.eye(2, device=sigma.device))


LAWS = {
    "tensor": lambda network: network,
    "pair": lambda network: mpm.CustomLaw(lambda F: (F + 1e-9 * network(F), network(F))),
    "stretches": lambda network: mpm.CustomPrincipalLaw(lambda s: scaled_logarithms(network, s)),
    "mixture": lambda network: mpm.Mixture([network, mpm.NeoHookean(E=1e3, nu=0.3)]),
}


@pytest.mark.parametrize("form", LAWS)
def test_autocast_acts_on_the_network_alone(form, device):
    """A bfloat16 stress is cast with gradients; the physics around it is in float32, as it is without autocast."""
    network = Linear().to(device)
    law = LAWS[form](network)
    state = block_state(2, device, dtype=torch.float32)
    if form == "mixture":
        state = state.replace(material=(torch.arange(len(state), device=device) % 2).int())
    on_grid = lambda blocks, v, mass, dt: v * torch.ones(2, 2, device=device).matmul(torch.eye(2, device=device))[0]  # noqa: E731
    step = make_step(2, on_grid=on_grid, boundaries=[mpm.Box((0.2, 0.2), (0.1, 0.1), rotation=0.3)])
    step.law = law
    with torch.autocast(device, dtype=torch.bfloat16), torch.autograd.set_detect_anomaly(True):
        end = mpm.rollout(step, state, 3, 1e-3)
        assert step.stable_dt(state).dtype == torch.float32
    assert {t.dtype for t in (end.x, end.v, end.F, end.C)} == {torch.float32}
    grads = torch.autograd.grad(end.v.square().sum(), list(network.parameters()), allow_unused=True)
    assert all(g is None or (g.dtype == torch.float32 and bool(g.isfinite().all())) for g in grads)
    full = mpm.rollout(step, state, 3, 1e-3)
    error = float((end.v - full.v).detach().norm() / (full.v - state.v).detach().norm())
    assert error < 0.05
    compiled = make_step(2, boundaries=[mpm.Box((0.2, 0.2), (0.1, 0.1), rotation=0.3)])
    with torch.autocast(device, dtype=torch.bfloat16):
        inside = mpm.rollout(compiled, state, 3, 1e-3)
    assert torch.equal(inside.x, mpm.rollout(compiled, state, 3, 1e-3).x) or device == "cuda"


def test_another_precision_is_still_refused(device):
    step = make_step(2)
    step.law = lambda F: F.double()
    with pytest.raises(TypeError, match=r"stress must have the dtype of x, torch.float32, got torch.float64"):
        step(block_state(2, device, dtype=torch.float32), 1e-3)


def test_a_stiffness_inside_of_a_checkpoint(device):
    """Its derivatives do not set off the checkpoint, which computes everything once more in the backward pass alone."""
    state, calls = block_state(2, device), []
    state = state.replace(F=torch.eye(2).to(state.x).repeat(len(state), 1, 1))

    def stress(F):
        calls.append(1)
        return F @ F.mT

    law = mpm.CustomLaw(stress)

    def value(v):
        moved = state.replace(F=state.F * v)
        return (law.stiffness(moved) * law.stress(moved)[:, 0, 0]).sum()

    v = torch.ones((), device=device, requires_grad=True)
    plain = torch.autograd.grad(value(v), v)[0]
    once = len(calls)
    kept = torch.autograd.grad(torch.utils.checkpoint.checkpoint(value, v, use_reentrant=False), v)[0]
    assert torch.allclose(kept, plain) and len(calls) == 3 * once
