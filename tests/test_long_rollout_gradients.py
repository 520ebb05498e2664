"""Gradients of rollouts of 200 steps with contact, sand and heat, by many causes at once."""

import pytest
import torch

from benchmarks.accuracy import rollout_gradients
from benchmarks.accuracy.rollout_gradients import PROBLEMS

pytestmark = pytest.mark.usefixtures("one_thread")
STEPS = 200


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_directional_derivative_of_many_steps(name, device):
    """Against central differences, float64; and every cause has a part in it."""
    problem = PROBLEMS[name](3).to(device)
    gradient = problem.gradient(STEPS)
    assert rollout_gradients.directional_error(problem, STEPS, gradient) < 1e-6
    parts = gradient.split([value.numel() for value in problem.causes.values()])
    sizes = [float(part.norm() / gradient.norm()) for part in parts]
    assert all(size > 1e-4 for size in sizes), dict(zip(problem.causes, sizes, strict=True))


@pytest.mark.parametrize("name", PROBLEMS)
def test_what_is_meant_to_happen_happens(name, device):
    """The ball and the walls are touched, sand flows, and heat is lost."""
    step, start, dt = (problem := PROBLEMS[name](3).to(device)).make(problem.causes)
    with torch.no_grad():
        start = step.with_impulses(step.prepare(start))
        end = rollout_gradients.mpm.rollout(step, start, STEPS, dt)
        if name == "contact":
            (ball,) = step.boundaries
            assert float(step.impulses(end)[ball].linear.norm()) > 0.1 * float(end.mass.sum())
        if name == "sand":
            assert float((step.law.return_map(end, details=True).branch != 0).double().mean()) > 0.2
        if name == "heat":
            assert float(end.temperature.mean()) < float(start.temperature.mean()) - 5
    step.check(end)
