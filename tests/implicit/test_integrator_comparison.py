"""Comparison of integrators by `Step.explain`: against measured times, and in simple cases."""

import json
import re

import pytest
import torch

import torch_mpm as mpm
from benchmarks import common
from torch_mpm.implicit import compare
from torch_mpm.implicit.comparison import EXPLICIT, IMPLICIT


def block(dim=2, E=1e8):
    grid = mpm.Grid(0.0125, (-0.2,) * dim, (0.2,) * dim)
    points = mpm.seed.box((-0.1,) * dim, (0.1,) * dim, grid, per_cell=2**dim)
    return mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.45)), mpm.State.at_rest(points, density=1000.0)


def test_costs_are_those_that_were_measured():
    """Within a factor of two, of steps of every size in the committed results."""
    rows = json.loads((common.RESULTS / "implicit_crossover_amd_epyc.json").read_text())["Steps of slow motion"]
    assert len(rows) == 10
    for row in rows:
        dim, P = row["dim"], row["particles"]
        assert 0.5 < EXPLICIT["cpu"][dim].of(P) / (1e-6 * row["explicit [us]"]) < 2
        assert 0.5 < IMPLICIT["cpu"][dim].of(P) / (1e-3 * row["implicit [ms]"]) < 2


def test_costs_on_a_gpu_are_those_that_were_measured():
    """Within a factor of two, of the committed steps in 3-D."""
    steps = json.loads((common.RESULTS / "implicit_cost_nvidia_h200.json").read_text())["Steps"]
    assert steps
    for row in steps:
        assert 0.5 < IMPLICIT["cuda"][3].of(row["particles"]) / row["step [s]"] < 2
    rollouts = json.loads((common.RESULTS / "rollouts_nvidia_h200.json").read_text())["rollouts"]
    explicit = [row for row in rollouts if row["name"] == "one scene"]
    assert len(explicit) == 7
    for row in explicit:
        assert 0.5 < EXPLICIT["cuda"][3].of(row["particles"]) / (1e-6 * row["us"]) < 2


def test_stiff_and_slow_is_for_implicit_steps(dim):
    step, state = block(dim)
    found = compare(step, state, 0.01)
    assert found.faster > 10
    assert found.limit == pytest.approx(float(step.stable_dt(state)[0])) and found.length == pytest.approx(0.0625)
    # Ten times the speed, and a hundredth of the stiffness, are a tenth of the gain each.
    assert compare(step, state, 0.1).faster == pytest.approx(found.faster / 10)
    assert compare(block(dim, 1e6)[0], state, 0.01).faster == pytest.approx(found.faster / 10, rel=1e-3)


def test_explain_says_which_and_by_how_much():
    step, state = block()
    assert step.explain(state).startswith("all steps in one op")
    slow, fast = step.explain(state, speed=0.01), step.explain(state, speed=5.0)
    assert slow.startswith("all steps in one op (executor fused, schedule sorted_cpu); implicit steps of 0.063 s")
    assert float(re.search(r"about (\S+) times as fast", slow)[1]) > 10
    assert float(re.search(r"about (\S+) times as slow", fast)[1]) > 5
    implicit = mpm.Step(step.grid, step.law, integrator="implicit")
    assert implicit.explain(state, speed=0.01).splitlines()[0].split("; ")[1] == slow.splitlines()[0].split("; ")[1]


def test_what_cannot_be_compared_says_so():
    step, state = block()
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="speed must be positive and finite"):
            step.explain(state, speed=wrong)
    with pytest.raises(NotImplementedError, match="no energy of a trial state"):
        mpm.Step(step.grid, mpm.CustomLaw(lambda F: 1e5 * (F - torch.eye(2)))).explain(state, speed=1.0)
    none = state.replace(**{n: getattr(state, n)[:0] for n in ("x", "v", "mass", "volume")})
    with pytest.raises(ValueError, match="state must have particles"):
        step.explain(none, speed=1.0)
    with pytest.raises(ValueError, match="state must have a stable time step"):
        step.explain(state.replace(mass=0 * state.mass), speed=1.0)
