"""Functions that the backward pass calls again: values and gradients are those of the functions themselves."""

import subprocess
import sys

import pytest
import torch

from benchmarks.catalogue.scenes import block_state
from benchmarks.speed import memory
from torch_mpm import Checkpoints, rollout
from torch_mpm.rollouts.recompute import called_again

F64 = torch.float64
WEIGHT = torch.linspace(0.5, 1.5, 9, dtype=F64).reshape(3, 3).requires_grad_()
"""Tensor of a closure, not an argument."""


def layered(x, y):
    return torch.nn.functional.dropout((x @ WEIGHT).tanh() * y.exp(), 0.3), y.square()


def nested(x, y):
    a, b = called_again(layered, x, y)
    return called_again(layered, a.sin(), b)


def differentiates(x, y):
    (force,) = torch.autograd.grad((x.sin() * y).sum(), x, create_graph=True)
    return layered(force, y)


def differentiates_and_forgets(x, y):
    inner = x.detach().requires_grad_()
    (force,) = torch.autograd.grad(inner.sin().square().sum(), inner)
    return layered(force * x, y)


def inputs():
    g = torch.Generator().manual_seed(1)
    return [torch.rand(4, 3, dtype=F64, generator=g).requires_grad_() for _ in range(2)]


def gradients(call, function, order=1):
    x, y = inputs()
    torch.manual_seed(7)
    a, b = call(function, x, y)
    leaves, found = [x, y, WEIGHT], [(a.square() * b).sum()]
    for k in range(order):
        total = sum(t.sin().sum() for t in found)
        found = torch.autograd.grad(total, leaves, create_graph=k + 1 < order)
    return [a.detach(), b.detach(), *found]


def plainly(function, *tensors):
    return function(*tensors)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("function", [layered, nested, differentiates, differentiates_and_forgets])
def test_gradients_are_those_of_the_function(function, order):
    for value, expected in zip(
        gradients(called_again, function, order), gradients(plainly, function, order), strict=True
    ):
        assert torch.equal(value, expected) and expected.abs().max() > 0


def test_it_is_called_once_for_each_backward_pass():
    calls = []

    def counted(x, y):
        calls.append(x.requires_grad)
        return layered(x, y)

    x, y = inputs()
    a, b = called_again(counted, x, y)
    random = torch.get_rng_state()
    first = torch.autograd.grad(a.sum() + b.sum(), [x, y], retain_graph=True)
    assert torch.equal(random, torch.get_rng_state())
    again = torch.autograd.grad(a.sum() + b.sum(), [x, y])
    assert all(map(torch.equal, first, again)) and calls == [True] * 3
    with torch.no_grad():
        called_again(counted, x, y)
    assert len(calls) == 4


def test_only_the_arguments_are_kept():
    x, y = inputs()
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t) or t, lambda t: t):
        called_again(nested, x, y)
    assert len(kept) == 2 and all(any(t is given for given in (x, y)) for t in kept)


def test_autocast_and_default_device_are_those_of_the_first_time():
    seen = []

    def looking(x):
        seen.append((torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu"), torch.empty(1).device.type))
        return (x.float() @ x.float().mT).sin()

    x = inputs()[0]
    with torch.autocast("cpu", torch.bfloat16), torch.device("meta"):
        end = called_again(looking, x)
    assert end.dtype == torch.bfloat16
    torch.autograd.grad(end.sum(), x)
    assert seen == [(True, torch.bfloat16, "meta")] * 2


def test_what_does_something_else_is_refused():
    x = inputs()[0]
    shapes = iter([(4, 3), (3, 4)])
    end = called_again(lambda x: x.reshape(next(shapes)).sin().sum(), x)
    with pytest.raises(RuntimeError, match=r"save the same tensors .*: \[4, 3\] torch.float64 on cpu the first"):
        end.backward()
    functions = iter([torch.sin, torch.neg])
    end = called_again(lambda x: next(functions)(x).sum(), x)
    with pytest.raises(RuntimeError, match="1 tensors the first time, then 0"):
        end.backward()
    end = called_again(torch.sin, x)
    with torch.no_grad():
        x.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        end.sum().backward()


PROGRAM = """
import sys, torch, torch_mpm as mpm
grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1))
step = mpm.Step(grid, lambda F: 1e4 * (F @ F.mT - torch.eye(2, dtype=F.dtype)))
state = mpm.State.at_rest(mpm.seed.box((0.3, 0.3), (0.6, 0.6), grid, per_cell=4), dtype=torch.float64)
for kept in (2, mpm.Checkpoints(states=2)):
    v = state.v.clone().requires_grad_()
    mpm.rollout(step, state.replace(v=v), 5, 1e-3, checkpoint=kept).x.sum().backward()
    assert v.grad.abs().max() > 0
print([name for name in sys.modules if name.startswith("torch._dynamo")])
"""


@pytest.mark.thorough
def test_no_compiler_is_imported():
    """An import would delay the first rollout with checkpoints by seconds."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_placeholders_that_were_released_are_filled_again():
    """Of nested calls whose results are read in any order, by backward passes of parts of them."""
    x, y = inputs()
    torch.manual_seed(7)
    a, b = called_again(nested, x, y)
    c, d = called_again(nested, a, b)
    torch.manual_seed(7)
    expected = [*nested(x, y)]
    expected += nested(*expected)
    for value, other in zip([a, b, c, d], expected, strict=True):
        loss, plain = value.square().sum() + c.sum(), other.square().sum() + expected[2].sum()
        found = torch.autograd.grad(loss, [x, y, WEIGHT], retain_graph=True)
        assert all(map(torch.equal, found, torch.autograd.grad(plain, [x, y, WEIGHT], retain_graph=True)))


def test_gradients_within_a_function_leave_nothing():
    """Its energy is differentiated in it, as by laws of networks: the arguments alone remain."""
    x = torch.linspace(0, 1, 1000, dtype=F64).requires_grad_()

    def force(t):
        (found,) = torch.autograd.grad(t.sin().square().sum(), t, create_graph=True)
        return found * found.cos()

    with memory.LiveTensors() as live:
        result = called_again(force, x)
        assert live.now <= 2 * x.numel() * x.element_size()
    value = x.detach().requires_grad_()
    expected = force(value)
    assert torch.equal(torch.autograd.grad(result.sum(), x)[0], torch.autograd.grad(expected.sum(), value)[0])


@pytest.mark.parametrize("states", [None, 2])
def test_gradients_within_steps_recompute_few_steps(states):
    """Each step differentiates an energy. The forward pass computes each step once, and the first one again."""
    count, n = [], 24

    def step(state, dt):
        count.append(None)
        (force,) = torch.autograd.grad(state.x.sin().square().sum(), state.x, create_graph=True)
        return state.replace(x=state.x - dt * force)

    kept = Checkpoints(every=None if states else 6, states=states)
    state = block_state(2)
    x, plain = (state.x.clone().requires_grad_() for _ in range(2))
    end = rollout(step, state.replace(x=x), n, 1e-2, kept)
    assert len(count) <= n + 1
    (gradient,) = torch.autograd.grad(end.x.sum(), x)
    assert len(count) <= n + kept.repetitions(n) + 1
    expected = state.replace(x=plain)
    for _ in range(n):
        expected = step(expected, 1e-2)
    assert torch.equal(gradient, torch.autograd.grad(expected.x.sum(), plain)[0])
