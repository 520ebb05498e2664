"""The line search of Newton's method, and the number of waits for the device."""

import pytest
import torch
from cases.implicit_gradients import inputs

import torch_mpm as mpm
from torch_mpm.implicit import Implicit, implicit, newton
from torch_mpm.implicit.line_search import Point, Search


class TwoScenes:
    """Two nodes, each a scene with the energy of a spring, v², and without limits of the stretch."""

    def of_nodes(self, value):
        return value[:, None]

    def node_sum(self, value):
        return value.double().reshape(2, -1).sum(1)

    def energy(self, v):
        energy = v.double().square().sum(1)
        return energy, energy, energy

    def gain(self, v, residual, trial, change):
        return change

    def trial(self, v):
        return v

    def squared_stretch(self, trial):
        return torch.inf

    def exceeds(self, v, most):
        return torch.zeros(2, dtype=torch.bool)


@pytest.mark.parametrize("wrong", [8.0, float("nan")])
def test_a_scene_that_no_step_helps_stays_where_it_was(wrong):
    """Beside one whose fourth halving is the first that helps."""
    system, v = TwoScenes(), torch.tensor([[1.0], [5.0]], dtype=torch.float64)
    end = v + torch.tensor([[-24.0], [wrong]], dtype=torch.float64)
    search = Search(system, None, None, 2 * v, Point(v, *system.energy(v)), end, torch.zeros(2, dtype=torch.bool))
    assert search.too_long()
    search.shorten()
    assert not search.too_long()
    assert search.moved().tolist() == [True, False]
    assert search.point.v.tolist() == [[1 - 24 / 16], [5.0]]
    assert search.point.energy.tolist() == [0.25, 25.0]


def test_the_host_looks_once_per_iteration(monkeypatch, device):
    grid, values = inputs(2, device)
    law = mpm.NeoHookean(mu=values["mu"], lam=values["lam"])
    step = mpm.Step(grid, law, walls="slip", integrator=Implicit(tolerance=1e-9))
    state = mpm.State(**{name: values[name] for name in ("x", "v", "F", "C", "mass", "volume")})
    looks = []

    def counted(method):
        return lambda *arguments: looks.append(method) or method(*arguments)

    def minimise(*arguments):
        with monkeypatch.context() as patch:
            for name in ("tolist", "item", "__bool__", "__float__", "__int__"):
                patch.setattr(torch.Tensor, name, counted(getattr(torch.Tensor, name)))
            return newton.minimise(*arguments)

    monkeypatch.setattr(implicit, "minimise", minimise)
    step(state, 5e-3)
    iterations = int(step.solve_report.iterations)
    assert iterations >= 3 and bool(step.solve_report.converged)
    assert len(looks) == iterations + 2  # the first iterate, and whether there is a finite energy to begin with
