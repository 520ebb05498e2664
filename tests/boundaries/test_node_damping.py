"""Damping of all nodes: exact decay, its place in the list of boundaries, and where it is computed."""

import math

import pytest
import torch
from cases.rollouts import TRANSFERS, one_by_one
from combinations import F64

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box
from torch_mpm.boundaries import Damping

N, DT = 30, 2e-4


def free(device, boundaries, dim=2, dtype=F64, **options):
    """A step without forces, and a body with one velocity."""
    step = mpm.Step(unit_box(dim), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=boundaries, **options)
    state = blob(device, dim, dtype=dtype)
    return step, state.replace(v=torch.ones_like(state.v), C=None, F=None)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_a_body_without_forces_decays_by_the_share(transfer, dim, device):
    """v = v0 s^n, and x = x0 + v0 dt (s + ... + s^n). With FLIP particles have the velocity of their nodes, too."""
    share = 0.93
    step, state = free(device, [Damping(share)], dim, **TRANSFERS[transfer])
    end = mpm.rollout(step, state, N, DT)
    kept = math.prod([share] * N)
    way = DT * sum(share**k for k in range(1, N + 1))
    torch.testing.assert_close(end.v, torch.full_like(end.v, kept), rtol=1e-9, atol=0)
    torch.testing.assert_close(end.x, state.x + way, rtol=0, atol=1e-12)


def test_gravity_is_damped_too(device):
    """The speed of a fall tends to g dt s / (1 - s)."""
    share, g = 0.8, 9.8
    step, state = free(device, [Damping(share)], gravity=(0.0, -g))
    end = mpm.rollout(step, state.replace(v=0 * state.v), 200, DT)
    torch.testing.assert_close(
        end.v[:, 1], torch.full_like(end.v[:, 1], -g * DT * share / (1 - share)), rtol=1e-9, atol=0
    )


def ball(**motion):
    return mpm.Sphere((0.5, 0.5), 0.2, kind="sticky", **motion)


def hooked():
    damping = Damping(0.9)
    damping.register_forward_hook(lambda *a: None)
    return damping


CASES = {
    "first": (lambda: [Damping(0.9)], None),
    "twice": (lambda: [Damping(0.95), Damping(0.9), ball(velocity=(1.0, 0.0))], None),
    "all": (lambda: [Damping(0.0)], None),
    "after a moving obstacle": (lambda: [ball(velocity=(1.0, 0.0)), Damping(0.9)], "torch operations, Damping"),
    "a tensor": (lambda: [Damping(torch.tensor(0.9, dtype=F64))], "torch operations, Damping"),
    "with a hook": (lambda: [hooked()], "hooks|torch operations, Damping"),
}


@pytest.mark.parametrize("name", CASES)
def test_rollouts_equal_single_steps(name):
    make, reason = CASES[name]
    step, state = free("cpu", make(), gravity=(0.0, -9.8), walls="separate")
    plan = mpm.plan_rollout(step, state, N, DT)
    assert (plan.executor == "fused") == (reason is None)
    if reason:
        assert any(words in plan.reasons["fused"] for words in reason.split("|"))
    expected = one_by_one(step, step.prepare(state), N, DT)
    end = mpm.rollout(step, state, N, DT)
    for field in ("x", "v", "C", "F"):
        torch.testing.assert_close(getattr(end, field), getattr(expected, field), rtol=1e-9, atol=1e-12)


def test_impulses_on_damping_need_single_steps():
    """The momentum that damping takes is counted: m v0 (1 - s^n), on the entry of the list."""
    step, state = free("cpu", [Damping(0.9), ball(start=1.0)])
    state = step.with_impulses(step.prepare(state))
    whole = mpm.Step(step.grid, step.law, boundaries=[Damping(1.0)])
    assert (
        float(
            whole.impulses(mpm.rollout(whole, whole.with_impulses(state.replace(impulse=None)), 3, DT))
            .values.abs()
            .max()
        )
        == 0
    )
    assert "impulses" in mpm.plan_rollout(step, state, N, DT).reasons["fused"]
    end = mpm.rollout(step, state, N, DT)
    taken = step.impulses(end).values[0, 0, :2]
    torch.testing.assert_close(taken, float(state.mass.sum()) * (1 - 0.9**N) * torch.ones(2, dtype=F64))


def test_the_gradient_by_a_tensor():
    share = torch.tensor(0.9, dtype=F64, requires_grad=True)

    def speed(share):
        step, state = free("cpu", [Damping(share)])
        return mpm.rollout(step, state, 4, DT).v[0]

    assert torch.autograd.gradcheck(speed, (share,))
    torch.testing.assert_close(speed(torch.tensor(1.5, dtype=F64)), torch.ones(2, dtype=F64))


@pytest.mark.parametrize(
    ("share", "error", "words"),
    [
        (1.1, ValueError, "share must be between 0 and 1, got 1.1"),
        (-0.1, ValueError, "share must be between 0 and 1, got -0.1"),
        (math.nan, ValueError, "share must be between 0 and 1, got nan"),
        ("0.5", TypeError, "share must be a number"),
        (torch.ones(2), ValueError, r"share must be a number or a floating-point tensor \[\], got"),
        (torch.tensor(1), ValueError, r"share must be a number or a floating-point tensor \[\], got"),
    ],
)
def test_other_shares_are_errors(share, error, words):
    with pytest.raises(error, match=words):
        Damping(share)
    damping = Damping(0.5)
    with pytest.raises(error, match=words):
        damping.share = share
    assert damping.share == 0.5


def test_a_share_that_is_assigned_acts():
    step, state = free("cpu", [Damping(0.5)])
    step.boundaries[0].share = 1
    torch.testing.assert_close(mpm.rollout(step, state, 3, DT).v, state.v)
    step.boundaries[0].share = torch.tensor(-1.0, dtype=F64)
    assert float(mpm.rollout(step, state, 3, DT).v.abs().max()) == 0


@pytest.mark.parametrize(
    ("shares", "words"),
    [([0.0], "velocity_shares must have 2 entries"), ([0.0, 1.5], "velocity_shares must be between 0 and 1, got 1.5"),
     ([-0.1, 1.0], "velocity_shares must be between 0 and 1, got -0.1")],
)  # fmt: skip
def test_the_op_checks_its_shares(shares, words):
    step, state = free("cpu", [])
    arguments = mpm.substeps_arguments(step, step.prepare(state), 2, DT)
    with pytest.raises(RuntimeError, match=words):
        torch.ops.torch_mpm.substeps(*(arguments | {"velocity_shares": shares}).values())
