"""Calls of MPM-PyTorch's solver: the time that functions read, calls that fail, and numbers that are assigned."""

import pytest
import torch
from torch.utils.checkpoint import checkpoint

from torch_mpm.compat.mpm_pytorch import MPMSolver

N, DT, P = 20, 1e-3, 40
F64 = torch.float64


def particles():
    x = 0.4 + 0.2 * torch.rand(P, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    return x, torch.ones_like(x), torch.zeros(P, 3, 3, dtype=F64), torch.eye(3, dtype=F64).repeat(P, 1, 1)


def made(**options):
    return MPMSolver(particles()[0], num_grids=N, dt=DT, **options)


def called(solver, state):
    return solver(*state, torch.zeros_like(state[3]))


FUNCTIONS = {
    "pre_particle_process": lambda times: lambda solver, x, v: times.append(solver.time),
    "post_grid_process": lambda times: lambda solver: times.append(solver.time),
}


@pytest.mark.parametrize("process", FUNCTIONS)
def test_functions_read_the_time_at_the_start_of_a_step(process):
    """As the published step, which counts at its end; also where a checkpoint computes a step again."""
    times, solver, state = [], made(), particles()
    getattr(solver, process).append(FUNCTIONS[process](times))
    for _ in range(3):
        state = called(solver, state)
    assert times == [0.0, DT, DT + DT] and solver.time == DT + DT + DT
    times.clear()
    leaf = state[1].clone().requires_grad_()
    result = checkpoint(lambda v: called(solver, (state[0], v, *state[2:])), leaf, use_reentrant=False)
    result[1].sum().backward()
    assert times == [DT + DT + DT] * 2 and solver.time == sum([DT] * 4)


def fails(solver):
    raise KeyError("no particle")


WRONG_CALLS = {
    "a function": lambda solver, x, v, C, F: solver.post_grid_process.append(fails) or (x, v, C, F),
    "dtype of v": lambda solver, x, v, C, F: (x, v.float(), C, F),
    "shape of C": lambda solver, x, v, C, F: (x, v, C[:, :2], F),
}


@pytest.mark.parametrize("wrong", WRONG_CALLS)
def test_calls_that_fail_leave_the_time(wrong):
    solver, state = made(), particles()
    given = WRONG_CALLS[wrong](solver, *state)
    with pytest.raises((KeyError, TypeError, ValueError)):
        called(solver, given)
    assert solver.time == 0.0
    solver.post_grid_process.clear()
    for value, expected in zip(called(solver, state), called(made(), state), strict=True):
        assert torch.equal(value, expected)


NUMBERS = {
    "damping": (-0.1, 2.0),
    "clip_bound": (-0.1, 0.5),
    "dt": (0.0, -DT),
    "vol": (0.0, -1.0),
    "p_mass": (0.0, -1.0),
}
WRONG = [(name, value) for name, values in NUMBERS.items() for value in (*values, float("nan"))]


@pytest.mark.parametrize("form", [float, torch.tensor])
@pytest.mark.parametrize(("name", "value"), WRONG)
def test_numbers_are_checked_where_they_are_assigned(name, value, form):
    solver = made()
    with pytest.raises((TypeError, ValueError), match=f"{name} must be"):
        setattr(solver, name, form(value))
    for found, own in zip(called(solver, particles()), called(made(), particles()), strict=True):
        assert torch.equal(found, own)
