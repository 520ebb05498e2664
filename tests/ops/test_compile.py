"""Rollouts of a compiled step: compiled once, with the results and gradients of the step itself."""

import math

import pytest
import torch
from helpers import relative_error
from torch._dynamo.testing import CompileCounter

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block

STEPS, DT = 20, 1e-3


class LearnedLaw(torch.nn.Module):
    """A small network on the invariants of F beside a linear law."""

    def __init__(self):
        super().__init__()
        self.net = torch.nn.Sequential(torch.nn.Linear(1, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1))

    def forward(self, F):
        strain = 0.5 * (F.mT @ F - torch.eye(2, dtype=F.dtype, device=F.device))
        modulus = 1e3 * (2 + self.net(strain.square().sum((1, 2))[:, None]))
        return modulus[:, :, None] * strain


class LearnedStretches(torch.nn.Module):
    """Principal stresses with a small network in them."""

    def __init__(self):
        super().__init__()
        self.net = torch.nn.Sequential(torch.nn.Linear(2, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1))

    def forward(self, sigma):
        volume = sigma.prod(1, keepdim=True).expand_as(sigma)
        return 1e4 * (sigma - 1) + 1e3 * self.net(torch.stack([sigma, volume], -1))[..., 0]


def law_of(name, device):
    if name == "learned law":
        return mpm.CustomLaw(LearnedLaw().double().to(device))
    if name == "learned stretches":
        return mpm.CustomPrincipalLaw(LearnedStretches().double().to(device))
    return mpm.NeoHookean(E=1e4, nu=0.3)


@pytest.fixture(autouse=True)
def fresh_compiler():
    torch._dynamo.utils.counters.clear()


def make_step(name, device):
    """A step that was taken once, so that its grid has `max_blocks`, and the state after it."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), deterministic=True)
    torch.manual_seed(0)
    law = law_of(name, device)
    obstacles = {
        "moving obstacles": [
            mpm.Sphere((0.45, 0.15), 0.1, velocity=(0.2, 0.5), friction=0.3, start=0.004, end=0.016),
            mpm.Plane((0.0, 0.2), (0.1, 1.0), angular_velocity=0.4),
        ],
        "obstacles in torch operations": [
            mpm.Sphere(lambda t: torch.stack([0.6 - 0.5 * t, 0.7 - t]), 0.1),
            mpm.SDF(lambda x: x.norm(dim=1) - 0.1, (0.2, 0.5), velocity=(0.3, 0.0), start=0.004, end=0.016),
        ],
    }
    step = mpm.Step(grid, law, gravity=(0.0, -9.8), walls="separate", boundaries=obstacles.get(name, ()))
    state = block((0.3, 0.3), (0.6, 0.6), 0.1, velocity=(0.3, -0.5), device=device)
    dt = torch.tensor([DT], dtype=torch.float64, device=device) if name == "tensor dt" else DT
    state = step(state, dt).detach()
    # Compiled, a tensor dt leaves fields without the gaps between components that the ops leave on the CPU.
    return step, mpm.State.concatenate([state]) if name == "tensor dt" else state, dt


LONG = pytest.param("obstacles in torch operations", marks=pytest.mark.slow)  # which take half a minute to compile


@pytest.mark.parametrize("name", ["fixed dt", "tensor dt", "moving obstacles", LONG, "learned law"])
def test_a_rollout_compiles_once(name, device):
    """The time, a tensor dt and what moves with the time are no constants of the compiled step."""
    step, state, dt = make_step(name, device)
    with torch.no_grad():
        counter = CompileCounter()
        compiled = torch.compile(step, fullgraph=True, backend=counter)
        got = expected = state
        for i in range(STEPS):
            now = dt * (1 + 0.5 * math.sin(i)) if isinstance(dt, torch.Tensor) else dt
            got, expected = compiled(got, now), step(expected, now)
    assert counter.frame_count == 1
    assert type(got.time) is type(expected.time)
    torch.testing.assert_close(got.time, expected.time, rtol=1e-14, atol=0)
    for field in ("x", "v", "C", "F"):
        assert relative_error(getattr(got, field), getattr(expected, field)) < 1e-12
    step.check(got)


@pytest.mark.parametrize("name", ["tensor dt", "learned law", "learned stretches"])
def test_gradients_of_a_compiled_rollout(name, device):
    """Traced by AOTAutograd, in one compilation: of the state, and of the weights of a network."""
    step, state, dt = make_step(name, device)
    fields = ("x", "v", "C", "F")

    def gradient(run):
        leaves = {field: getattr(state, field).detach().requires_grad_() for field in fields}  # of the same strides
        now = state.replace(**leaves)
        for _ in range(5):
            now = run(now, dt)
        loss = (now.x**2).sum() + (now.F**3).sum()
        return torch.autograd.grad(loss, [*leaves.values(), *step.parameters()])

    got = gradient(torch.compile(step, fullgraph=True, backend="aot_eager"))
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1
    for a, b in zip(got, gradient(step), strict=True):
        assert relative_error(a, b) < 1e-11


def test_a_rollout_that_was_never_run_compiles_twice(device):
    """With `max_blocks` given: once without the affine field that the first step adds, once with it."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1), max_blocks=9)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), gravity=(0.0, -9.8))
    counter = CompileCounter()
    state = block((0.3, 0.3), (0.6, 0.6), 0.1, device=device)
    with torch.no_grad():
        end = mpm.rollout(torch.compile(step, fullgraph=True, backend=counter), state, STEPS, DT)
    assert counter.frame_count == 2
    assert end.time == pytest.approx(STEPS * DT)


@pytest.mark.slow
def test_inductor_compiles_a_step(device):
    step, state, dt = make_step("fixed dt", device)
    with torch.no_grad():
        got, expected = mpm.rollout(torch.compile(step, fullgraph=True), state, 3, dt), mpm.rollout(step, state, 3, dt)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1
    assert got.time == pytest.approx(expected.time)
    for field in ("x", "v", "C", "F"):
        assert relative_error(getattr(got, field), getattr(expected, field)) < 1e-12


def test_the_time_of_a_state_is_what_was_given(device):
    """Numbers stay numbers, tensors in float64 the same tensors, through copies, moves and steps."""
    step, state, _ = make_step("fixed dt", device)
    assert isinstance(state.time, float) and state.time == DT
    assert step(state, 2 * DT).time == DT + 2 * DT and state.replace(time=3).time == 3.0
    for time in (torch.zeros((), dtype=torch.float64), torch.ones(1, dtype=torch.float64, device=device)):
        given = state.replace(time=time)
        assert given.time is time and given.replace(x=state.x).time is time and given.detach().time.shape == time.shape
    assert state.to(dtype=torch.float32).time == DT


def test_second_derivatives_of_a_compiled_step_are_refused(device):
    """By torch, whose compiled code has first derivatives alone."""
    step, state, dt = make_step("fixed dt", device)
    v = state.v.clone().requires_grad_()
    end = torch.compile(step, backend="aot_eager")(state.replace(v=v), dt)
    with pytest.raises(RuntimeError):
        (gradient,) = torch.autograd.grad(end.x.pow(3).sum() + end.v.pow(3).sum(), v, create_graph=True)
        torch.autograd.grad(gradient.square().sum(), v)
