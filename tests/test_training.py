"""Training with torch's machinery around steps: export, function transforms, seeds, batches, several processes."""

import io
import os

import pytest
import torch
import torch.multiprocessing as mp
from helpers import relative_error
from torch import nn
from torch.nn.parallel import DistributedDataParallel

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block_state, make_step

DT = 1e-3
F64 = torch.float64


class Stress(nn.Module):
    """An elastic law with a small network in it, which begins with a seed."""

    def __init__(self, seed=0):
        super().__init__()
        with torch.random.fork_rng([]):
            torch.manual_seed(seed)
            self.layers = nn.Sequential(nn.Linear(2, 8), nn.Tanh(), nn.Linear(8, 1)).double()

    def forward(self, sigma):
        volume = sigma.prod(1, keepdim=True).expand_as(sigma)
        return 1e4 * (sigma - 1) + 1e4 * self.layers(torch.stack([sigma, volume], -1))[..., 0]


def trained(device="cpu", scenes=1, **options):
    step = make_step(2, scenes=scenes, gravity=(0.0, -9.8), grid={"max_blocks": 16 * scenes, "deterministic": True})
    step.law = mpm.CustomPrincipalLaw(Stress().to(device))
    return step


def throws(count, device="cpu"):
    """Scenes of one block that is thrown in several directions."""
    state = block_state(2, device)
    return [state.replace(v=state.v + torch.tensor([0.3 * k, 0.1], dtype=F64, device=device)) for k in range(count)]


def distance(step, states, n=3, **options):
    """Mean over scenes of their states after some steps."""
    end = mpm.rollout(step, mpm.State.concatenate(states, scene=True), n, DT, **options)
    return sum(part.x.pow(2).sum() + part.v.sum() for part in end.split(len(states))) / len(states)


# ---- laws of networks at the first iteration


INVARIANTS = {
    "stretches": lambda net: mpm.CustomPrincipalLaw(net),
    "isotropic": lambda net: mpm.CustomLaw(lambda F: mpm.isotropic(F, net)),
    "plastic": lambda net: mpm.CustomPrincipalLaw(lambda s: (s**0.9, net(s**0.9))),
    "rotation": lambda net: mpm.CustomLaw(lambda F: _corotated(F, net)),
    "invariants": lambda net: mpm.CustomLaw(lambda F: _of_invariants(F, net)),
}


def _corotated(F, net):
    R, S = mpm.polar(F)
    return (
        (R * net(mpm.svd3(F).sigma).mean(1)[:, None, None]) @ (S - torch.eye(2, dtype=F.dtype, device=F.device)) @ R.mT
    )


def _of_invariants(F, net):
    J = torch.linalg.det(F)
    features = torch.stack([(F * F).sum((1, 2)) / 2, J], 1)
    return net(features)[:, :1, None] * (F @ F.mT - torch.eye(2, dtype=F.dtype, device=F.device))


@pytest.mark.parametrize("form", INVARIANTS)
def test_the_first_iteration_from_rest(form, device):
    """Every particle has F = I there: gradients of the weights and of F are finite and those of differences."""
    network = Stress().to(device)
    step = make_step(2, grid={"deterministic": True})
    step.law = INVARIANTS[form](network)
    state = step.prepare(block_state(2, device))
    along = torch.randn_like(state.F)
    weights = {name: torch.randn_like(p) for name, p in network.named_parameters()}
    start = {name: p.detach().clone() for name, p in network.named_parameters()}

    def value(share):
        for name, p in network.named_parameters():
            p.data = start[name] + share * weights[name]
        end = mpm.rollout(step, state.replace(F=state.F + share * along), 3, DT)
        return end.v.pow(3).sum() + end.x.sum()

    F = state.F.clone().requires_grad_()
    end = mpm.rollout(step, state.replace(F=F), 3, DT)
    loss = end.v.pow(3).sum() + end.x.sum()
    by_F, *by_weights = torch.autograd.grad(loss, [F, *network.parameters()])
    slope = (by_F * along).sum() + sum(
        (g * weights[name]).sum() for g, (name, _) in zip(by_weights, network.named_parameters(), strict=True)
    )
    with torch.no_grad():
        difference = (value(1e-5) - value(-1e-5)) / 2e-5
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)


# ---- export


@pytest.mark.parametrize("form", ["state", "tensors"])
def test_an_exported_step_is_the_step(form, device):
    """Also from a file; and the export leaves nothing behind."""
    step = trained(device)
    state = step(block_state(2, device), DT).detach()
    state = state.replace(time=torch.zeros(1, dtype=F64, device=device))
    status = step.status

    class OnTensors(nn.Module):
        def __init__(self):
            super().__init__()
            self.step = step

        def forward(self, x, v, C, F):
            end = self.step(state.replace(x=x, v=v, C=C, F=F), DT)
            return end.x, end.v, end.C, end.F

    class OnState(nn.Module):
        def __init__(self):
            super().__init__()
            self.step = step

        def forward(self, state):
            return self.step(state, DT)

    module, given = (OnState(), (state,)) if form == "state" else (OnTensors(), (state.x, state.v, state.C, state.F))
    exported = torch.export.export(module, given)
    assert step.status is status
    file = io.BytesIO()
    torch.export.save(exported, file)
    file.seek(0)
    expected = step(state, DT)
    for program in (exported, torch.export.load(file)):
        result = program.module()(*given)
        end = result if form == "state" else state.replace(x=result[0], v=result[1], C=result[2], F=result[3])
        for name in ("x", "v", "C", "F"):
            assert relative_error(getattr(end, name), getattr(expected, name)) < 1e-13
        if form == "state":
            again = program.module()(end)
            assert relative_error(again.x, step(expected, DT).x) < 1e-13 and float(again.time) == 2 * DT
    step.check(expected)


# ---- function transforms


def test_vmap_is_refused_with_what_serves_instead(device):
    state = block_state(2, device)

    def height(E):
        return mpm.rollout(make_step(2, E=E), state, 3, DT).x[:, 1].pow(2).sum()

    moduli = torch.tensor([1e4, 2e4], dtype=F64, device=device)
    with pytest.raises(NotImplementedError, match=r"vmap over E is not supported: pack the scenes into one call"):
        torch.vmap(height)(moduli)
    with pytest.raises(NotImplementedError, match=r"vmap over state.v is not supported"):
        torch.vmap(lambda v: mpm.rollout(make_step(2), state.replace(v=v), 3, DT).x)(torch.stack([state.v] * 2))
    F = torch.eye(2, dtype=F64, device=device).expand(3, 2, 2)
    with pytest.raises(NotImplementedError, match=r"vmap over an isotropic function"):
        torch.vmap(lambda E: mpm.isotropic(F, lambda s: E * s.log()))(moduli)
    # The message recommends parameters per scene; their gradients equal those of each scene alone.
    by_scene = moduli.clone().requires_grad_()
    step = make_step(2, scenes=2, E=by_scene)
    end = mpm.rollout(step, mpm.State.concatenate([state, state], scene=True), 3, DT)
    (grads,) = torch.autograd.grad(end.x[:, 1].pow(2).sum(), by_scene)
    alone = torch.stack([torch.func.grad(height)(E) for E in moduli])
    torch.testing.assert_close(grads, alone, rtol=1e-9, atol=0)


# ---- batches and seeds


@pytest.mark.parametrize("kind", ["network", "in one op"])
def test_the_size_of_a_batch_does_not_change_gradients(kind, device):
    """To the last bit on the CPU, where a scene's sums are its own."""
    found = []
    for count in (1, 3):
        step, states = trained(device, count), [throws(1, device)[0], *throws(4, device)[2:]][:count]
        if kind == "in one op":
            step.law = mpm.NeoHookean(E=1e4, nu=0.3)
        states[0] = states[0].replace(v=states[0].v.clone().requires_grad_())
        end = mpm.rollout(step, mpm.State.concatenate(states, scene=True), 6, DT)
        found.append(torch.autograd.grad(end.split(count)[0].x.pow(2).sum(), states[0].v)[0])
    assert torch.equal(*found) if device == "cpu" and kind == "in one op" else relative_error(*found) < 1e-12


def test_training_is_the_same_from_a_seed(device):
    """Equal bit by bit, with dropout in the network and recomputed states."""
    ends = []
    for _ in range(2):
        torch.manual_seed(3)
        step = trained(device)
        network = step.law.function
        network.layers.insert(2, nn.Dropout(0.3))
        optimizer = torch.optim.Adam(network.parameters(), 1e-2)
        for _ in range(3):
            optimizer.zero_grad()
            distance(step, throws(1, device), 5, checkpoint=2).backward()
            optimizer.step()
        ends.append(torch.cat([p.detach().flatten() for p in network.parameters()]))
    assert torch.equal(*ends)
    assert not torch.equal(ends[0], torch.cat([p.detach().flatten() for p in Stress().to(device).parameters()]))


# ---- several processes


class Loss(nn.Module):
    """Module for `DistributedDataParallel`: a step with its parameters, and a loss."""

    def __init__(self, scenes):
        super().__init__()
        self.step = trained(scenes=scenes)

    def forward(self, states):
        return distance(self.step, states, 4)


def _rank(rank, world, place, scenes):
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{place}/store", rank=rank, world_size=world)
    try:
        own = throws(scenes)[rank::world]
        model = DistributedDataParallel(Loss(len(own)))
        model(own).backward()
        if rank == 0:
            torch.save([p.grad for p in model.parameters()], f"{place}/gradients.pt")
        torch.distributed.barrier()  # no rank ends while another one needs it
    finally:
        torch.distributed.destroy_process_group()
    # After DistributedDataParallel, threads of gloo outlive their group, and abort some processes at the end of Python
    # (torch 2.13).
    os._exit(0)


@pytest.mark.thorough
@pytest.mark.skipif(not torch.distributed.is_available(), reason="torch without torch.distributed")
def test_two_processes_have_the_gradients_of_one(tmp_path):
    """Scenes are split over the ranks; their mean loss has the gradients of all scenes in one batch."""
    mp.spawn(_rank, (2, str(tmp_path), 4), nprocs=2)
    found = torch.load(tmp_path / "gradients.pt", weights_only=True)
    one = Loss(4)
    one(throws(4)).backward()
    expected = [p.grad for p in one.parameters()]
    assert len(found) == len(expected) == 4
    for got, grad in zip(found, expected, strict=True):
        assert float(grad.norm()) > 0 and relative_error(got, grad) < 1e-12
