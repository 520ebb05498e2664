"""Stored states of steps with free bodies: gradients, poses and status are those without, and memory is less."""

import pytest
import torch
from test_free_bodies import F64, ball_of, material, rows_of

import torch_mpm as mpm
from benchmarks.speed import memory
from torch_mpm.bodies import FreeBodies

N, DT = 13, 2e-3
KEPT = {
    "every": 3,
    "states": mpm.Checkpoints(states=2),
    "parts": mpm.Checkpoints(every=2, states=2),
    "memory": mpm.Checkpoints(memory=4e5),
    "all": mpm.Checkpoints(memory=1e9),
    "offload": mpm.Checkpoints(every=4, offload=True),
}


def scene(dim, device):
    """A ball that lands on a block beside an obstacle that moves; its friction, the modulus, poses, velocities and
    wrenches have gradients."""
    step, state = material(dim, device)
    wanted = {
        "E": torch.tensor(1e4, dtype=F64, device=device),
        "friction": torch.tensor(0.2, dtype=F64, device=device),
        "rows": rows_of(dim, (1.03, 1.19, 1.0)[:dim], (0.3, -1.0, 0.0)[:dim], device=device),
        "v": state.v.clone(),
        "wrenches": torch.full((1, 1, 3 if dim == 2 else 6), 0.1, dtype=F64, device=device),
    }
    wanted = {name: value.requires_grad_() for name, value in wanted.items()}
    pusher = mpm.Sphere((0.2,) + (0.9,) * (dim - 1), 0.35, kind="sticky")
    own = mpm.Step(step.grid, mpm.NeoHookean(E=wanted["E"], nu=0.3), boundaries=[pusher])
    body = ball_of(dim)
    body.parts[0].obstacle.friction = wanted["friction"]
    return FreeBodies(own, [body]), state, wanted


def advanced(bodies, state, wanted, kept, calls=2):
    """A loss after some calls; the obstacle moves from the second one on. Also the state and the rows."""
    state, rows = state.replace(v=wanted["v"]), wanted["rows"]
    for _ in range(calls):
        state, rows = bodies.advance(state, rows, N, DT, wanted["wrenches"], checkpoint=kept)
        bodies.step.boundaries[0].position = (0.22,) + (0.9,) * (bodies.step.grid.dim - 1)
    return rows.square().sum() + (state.v.square() * state.mass[:, None]).sum() + state.x[:, 1].sum(), state, rows


def compare(dim, device, kept):
    found = []
    for checkpoint in (None, kept):
        bodies, state, wanted = scene(dim, device)
        loss, end, rows = advanced(bodies, state, wanted, checkpoint)
        position, counts = bodies.obstacles[0].position, bodies.step.status.clone()
        grads = torch.autograd.grad(loss, list(wanted.values()))
        # Recomputed steps leave no trace.
        assert bodies.obstacles[0].position is position and bodies.step.on_grid is None
        torch.testing.assert_close(position[0], rows[0, 0, :dim].detach().to(position), rtol=0, atol=0)
        assert torch.equal(bodies.step.status, counts) and bool(bodies.report.converged.all())
        found.append([end.x.detach(), end.v.detach(), rows.detach(), *grads])
        assert all(bool(value.any()) for value in found[-1])
    for without, of_checkpoints in zip(*found, strict=True):
        torch.testing.assert_close(of_checkpoints, without, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kept", KEPT)
def test_gradients_are_those_without_checkpoints(kept, device):
    compare(2, device, KEPT[kept])


@pytest.mark.thorough
@pytest.mark.parametrize("kept", ["every", "parts"])
def test_gradients_in_3d_are_those_without_checkpoints(kept, device):
    compare(3, device, KEPT[kept])


@pytest.mark.thorough
@pytest.mark.parametrize("kept", ["every", "states", "memory"])
def test_memory(kept):
    """Of all tensors, with those of the backward pass; the profiler that counts them takes seconds."""
    most = []
    for checkpoint in (None, KEPT[kept]):
        bodies, state, wanted = scene(2, "cpu")

        def run(made=(bodies, state, wanted), checkpoint=checkpoint):
            torch.autograd.grad(advanced(*made, checkpoint, calls=1)[0], list(made[2].values()))

        run()
        most.append(memory.of_host_allocator(run))
    assert most[1] < 0.5 * most[0]
    assert kept != "memory" or most[1] <= KEPT["memory"].memory


def test_a_budget_that_is_too_small():
    bodies, state, wanted = scene(2, "cpu")
    with pytest.raises(ValueError, match="memory must be at least"):
        bodies.advance(state, wanted["rows"], N, DT, checkpoint=mpm.Checkpoints(memory=1e3))
    assert bodies.step.on_grid is None


def test_wrenches_may_be_written_again(device):
    """A buffer that a control loop fills before each call: the backward pass recomputes with what each call had."""
    found = []
    for checkpoint in (None, 3):
        bodies, state, wanted = scene(2, device)
        state, rows, buffer = state.replace(v=wanted["v"]), wanted["rows"], torch.zeros_like(wanted["wrenches"])
        for force in (5.0, -30.0):
            buffer = buffer.fill_(force) if checkpoint else torch.full_like(buffer, force)
            state, rows = bodies.advance(state, rows, N, DT, buffer, checkpoint=checkpoint)
        found.append(torch.autograd.grad(rows.square().sum() + state.x[:, 1].sum(), [wanted["rows"], wanted["v"]]))
        buffer.zero_()
    for without, of_checkpoints in zip(*found, strict=True):
        torch.testing.assert_close(of_checkpoints, without, rtol=1e-12, atol=1e-12)


def test_without_gradients_nothing_is_stored(dim, device):
    bodies, state, wanted = scene(dim, device)
    with torch.no_grad():
        ends = [bodies.advance(state, wanted["rows"], N, DT, checkpoint=kept) for kept in (None, 3)]
    for found, expected in ((ends[1][1], ends[0][1]), (ends[1][0].x, ends[0][0].x)):
        torch.testing.assert_close(found, expected, rtol=0, atol=0 if device == "cpu" else 1e-12)


@pytest.mark.parametrize(("checkpoint", "error"), [(0, "checkpoint must be"), (1.5, "checkpoint must be")])
def test_wrong_checkpoints(checkpoint, error):
    bodies, state, wanted = scene(2, "cpu")
    with pytest.raises((TypeError, ValueError), match=error):
        bodies.advance(state, wanted["rows"], 2, DT, checkpoint=checkpoint)
