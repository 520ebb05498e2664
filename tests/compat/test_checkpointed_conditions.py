"""Timed conditions of MPM-PyTorch's solver in calls that `torch.utils.checkpoint` recomputes."""

import functools

import pytest
import torch
from torch.utils.checkpoint import checkpoint

import torch_mpm as mpm
from torch_mpm.compat.mpm_pytorch import MPMSolver, get_constitutive, set_boundary_conditions

DT, STEPS = 3e-4, 12
LATER, END = 3.5 * DT, 7.5 * DT
BOX = {"point": [0.5, 0.5, 0.5], "size": [0.07, 0.07, 0.07], "start_time": LATER}

CONDITIONS = {
    "translation": {"type": "enforce_particle_translation", "velocity": [0.0, 0.1, 0.0], "end_time": END, **BOX},
    "rotation": {
        **{"type": "enforce_particle_velocity_rotation", "point": [0.5, 0.5, 0.5], "normal": [0.0, 0.0, 1.0]},
        **{"half_height_and_radius": [0.06, 0.06], "rotation_scale": 3.0, "translation_scale": 0.1},
        **{"start_time": LATER, "end_time": END},
    },
    "impulse": {"type": "particle_impulse", "force": [0.0, 0.5, 0.0], "num_dt": 4, **BOX},
    "cuboid": {"type": "cuboid", "velocity": [0.0, 0.1, 0.0], "end_time": END, **BOX},
    "cuboid with reset": {
        **{"type": "cuboid", "velocity": [0.0, 0.1, 0.0], "start_time": LATER, "end_time": LATER, "reset": True},
        **{"point": [0.44, 0.5, 0.5], "size": [0.03, 0.1, 0.1]},
    },
    "surface": {
        **{"type": "surface_collider", "point": [0.5, 0.5, 0.45], "normal": [0.0, 0.0, 1.0]},
        **{"start_time": LATER, "end_time": END},
    },
    "sdf": {"type": "sdf_collider", "bound": 0.45, "dim": 0, "start_time": LATER, "end_time": END},
}
CHECKPOINTS = {
    "reentrant": lambda f, *tensors: checkpoint(f, *tensors, use_reentrant=True),
    "not reentrant": lambda f, *tensors: checkpoint(f, *tensors, use_reentrant=False),
    "with pools": lambda f, *tensors: checkpoint(
        f, *tensors, use_reentrant=False, context_fn=mpm.rollouts.checkpoints.contexts
    ),
}


def start(device):
    axis = torch.linspace(0.4, 0.6, 4, dtype=torch.float64, device=device)
    x = torch.cartesian_prod(axis, axis, axis)
    v = torch.sin(20 * x).requires_grad_()
    F = torch.eye(3, dtype=x.dtype, device=device).repeat(len(x), 1, 1)
    return x, v, torch.zeros_like(F), F


def gradients(solver, keep, calls, device):
    """Gradients of a loss by the initial velocities and log E, with `calls` steps in each call of `keep`."""
    elastic, plastic = get_constitutive("CorotatedElasticity", device), get_constitutive("IdentityPlasticity", device)
    x, v0, C, F = start(device)
    log_E = torch.full_like(x[:, 0], 12.0, requires_grad=True)

    def steps(x, v, C, F):
        for _ in range(calls):
            x, v, C, F = solver(x, v, C, F, elastic(F, log_E))
            F = plastic(F)
        return x, v, C, F

    v = v0
    for _ in range(STEPS // calls):
        x, v, C, F = keep(steps, x, v, C, F)
    (x * torch.linspace(-1, 1, x.numel(), dtype=x.dtype, device=device).reshape(x.shape)).sum().backward()
    return v0.grad, log_E.grad


def made(condition, device):
    solver = MPMSolver(start(device)[0], dt=DT, num_grids=20, size=(0.2, 0.2, 0.2))
    set_boundary_conditions(solver, [] if condition is None else [condition])
    return solver


@functools.cache
def usual(name, device):
    """Gradients without checkpoints, and the time at the end."""
    solver = made(CONDITIONS.get(name), device)
    return gradients(solver, plain, 1, device), solver.time


@pytest.mark.parametrize(
    ("kept", "calls"),
    [("reentrant", 1), ("reentrant", 4), ("not reentrant", 1), ("not reentrant", 4), ("with pools", 1)],
)
@pytest.mark.parametrize("name", CONDITIONS)
def test_gradients_are_those_without_checkpoints(name, kept, calls, device):
    (expected, time), (without, _) = usual(name, device), usual(None, device)
    assert not all(torch.equal(a, b) for a, b in zip(expected, without, strict=True)), "the condition must act"
    again = made(CONDITIONS[name], device)
    found = gradients(again, CHECKPOINTS[kept], calls, device)
    assert again.time == time
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


def plain(f, *tensors):
    return f(*tensors)


def test_a_time_that_is_given(device):
    """A call with a time equals that of a solver at this time."""
    x, v, C, F = (t.detach() for t in start(device))
    solver, other = made(CONDITIONS["translation"], device), made(CONDITIONS["translation"], device)
    other.time = 4 * DT
    expected = other(x, v, C, F, torch.zeros_like(F))
    found = solver(x, v, C, F, torch.zeros_like(F), 4 * DT)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-15)
    assert not torch.equal(found[1], solver(x, v, C, F, torch.zeros_like(F), 0.0)[1])
    assert solver.time == DT and other.time == 5 * DT


@pytest.mark.parametrize("ends", [0.5, 999.0])
def test_times_that_cannot_be_distinguished(ends):
    """Two passes from the same tensors without `reset`: an error where a condition ends between them, and only then."""
    solver = made({**CONDITIONS["translation"], "start_time": 0.0, "end_time": ends}, "cpu")
    x, v, C, F = start("cpu")
    stress = torch.zeros_like(F, requires_grad=True)

    def run():
        return checkpoint(solver, x, v, C, F, stress, use_reentrant=False)[0].sum()

    run().backward()
    solver.time = 1.0
    if ends == 0.5:
        with pytest.raises(RuntimeError, match=r"found \[0.0, 1.0\] s.*give time=, or call reset\(\)"):
            run().backward()
    else:
        run().backward()
    solver.reset()
    assert solver.time == 0.0
    made_anew = made({**CONDITIONS["translation"], "start_time": 0.0, "end_time": 0.5}, "cpu")
    checkpoint(made_anew, x, v, C, F, stress, 0.2, use_reentrant=True)[0].sum().backward()
    assert made_anew.time == pytest.approx(0.2 + DT)


@pytest.mark.parametrize("reentrant", [True, False])
def test_conditions_stay_until_the_backward_pass(reentrant):
    solver = made(CONDITIONS["translation"], "cpu")
    x, v, C, F = start("cpu")
    loss = checkpoint(solver, x, v, C, F, torch.zeros_like(F), use_reentrant=reentrant)[0].sum()
    set_boundary_conditions(solver, [CONDITIONS["surface"]])
    with pytest.raises(RuntimeError, match="conditions of the solver must not change before the backward pass"):
        loss.backward()


def test_memory_of_times_does_not_grow():
    solver = made(CONDITIONS["translation"], "cpu")
    x, v, C, F = (t.detach() for t in start("cpu"))
    for _ in range(400):
        x, v, C, F = solver(x, v, C, F, torch.zeros_like(F))
    assert len(solver._times._entries) <= 260
