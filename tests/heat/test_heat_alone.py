"""Rollouts of `Heat` alone in the fused op, against its single steps."""

import pytest
import torch
from heat_scenes import TRANSFERS, bodies, scene, surface_and_nodes, terms
from pairs import in_pairs

import torch_mpm as mpm
from torch_mpm import heat_boundaries
from torch_mpm.grid.topology import Status
from torch_mpm.rollouts import plan_rollout

F64 = torch.float64
DT = 2e-2
"""Bodies at rest have no limit of the time step."""
FIELDS = ("x", "v", "C", "F", "J", "temperature")


def alone(*given, **options):
    """The heat of a scene of moving, deformed particles."""
    step, state = scene(*given, **options)
    if state.F is not None:
        g = torch.Generator().manual_seed(8)
        noise = torch.rand(state.F.shape, generator=g, dtype=F64).to(state.F)
        state = state.replace(F=state.F + 0.1 * noise)
    return step.heat, state


def one_by_one(heat, state, n, dt):
    for _ in range(n):
        state = heat(state, dt)
    return state


def compare(heat, state, n=6, dt=DT, tolerance=1e-10):
    """All fields of the end are those of single steps; returns it."""
    assert plan_rollout(heat, state, n, dt).executor == "fused"
    end, expected = mpm.rollout(heat, state, n, dt), one_by_one(heat, state, n, dt)
    for name in FIELDS:
        a, b = getattr(end, name), getattr(expected, name)
        assert (a is None) == (b is None), name
        assert a is None or torch.allclose(a, b, rtol=tolerance, atol=tolerance * float(b.abs().max())), name
    assert end.extra.keys() == expected.extra.keys()
    for name, value in expected.extra.items():
        scale = float(value.abs().max())
        assert float((end.extra[name] - value).abs().max()) <= 10 * tolerance * max(scale, 1e-12), name
    assert torch.equal(torch.as_tensor(end.time), torch.as_tensor(expected.time))
    heat.check()
    return end


@pytest.mark.parametrize(
    *in_pairs(
        dim=[2, 3], transfer=TRANSFERS, melts=[False, True], scenes=[1, 2], law=["neo_hookean", "fluid"],
        kernel=["quadratic", "cubic"], deterministic=[False, True], per_particle=[False, True],
    )
)  # fmt: skip
def test_steps(dim, transfer, melts, scenes, law, kernel, deterministic, per_particle, device):
    options = {"transfer": transfer, "melts": melts, "kernel": kernel, "deterministic": deterministic}
    heat, state = alone(dim, F64, scenes, law, device, per_particle=per_particle, **options)
    heat.tolerance = 1e-12
    compare(heat, state)


@pytest.mark.parametrize("kind", ["terms", "surface", "nodes", "both"])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_boundaries(kind, dtype, dim, device):
    heat, state = alone(dim, dtype, device=device)
    made = [entry for each in terms().values() for entry in each] if kind in ("terms", "both") else []
    if kind != "terms":
        plane, ball = bodies(dim)["plane"], mpm.Sphere((0.45, 0.25, 0.45)[:dim], 0.12)
        held = {"surface": heat_boundaries.FixedSurface(ball, 40.0), "nodes": heat_boundaries.Fixed(plane, -5.0)}
        made += [each for name, each in held.items() if kind in (name, "both")]
    heat.boundaries = made
    heat.to(device)
    heat.tolerance = 1e-12 if dtype == F64 else 1e-6
    compare(heat, state, dt=DT / 10, tolerance=1e-9 if dtype == F64 else 1e-4)


def test_obstacles_that_act_for_a_time(dim, device):
    heat, state = alone(dim, device=device)
    ball = mpm.Sphere((0.45, 0.25, 0.45)[:dim], 0.12, start=1.5 * DT, end=4.5 * DT)
    heat.boundaries = [heat_boundaries.FixedSurface(ball, 40.0)]
    heat.tolerance = 1e-12
    end = compare(heat, state, 8, tolerance=1e-9)
    assert not torch.allclose(end.temperature, state.temperature)


def test_a_full_pool(device):
    heat, state = alone(2, device=device, max_blocks=1, transfer="flip")
    before = state.temperature.clone()
    with pytest.raises(mpm.GridOverflowError):
        mpm.rollout(heat, state, 9, DT)
        heat.check()
    assert torch.equal(before, state.temperature)


@pytest.mark.parametrize("n", [1, 7, 8, 40])
def test_calls_of_any_length(n, device):
    """On a CPU particles are sorted from 8 steps on."""
    heat, state = alone(2, melts=True, device=device)
    heat.tolerance = 1e-12
    compare(heat, state, n)
    assert int(heat.status[0, Status.ACTIVATIONS]) == 2 * n  # Those of the op and the single steps.


def test_time_steps_of_scenes(device):
    """One scene is paused, and particles are outside."""
    heat, state = alone(3, F64, 3, device=device)
    heat.tolerance = 1e-12
    dt = torch.tensor([1.0, 0.0, 0.3], dtype=F64, device=device) * DT
    compare(heat, state, dt=dt)


def test_particles_outside_are_reported(device):
    heat, state = alone(2, device=device)
    x = state.x.clone()
    x[3] = 7.0
    end = mpm.rollout(heat, state.replace(x=x), 4, DT)
    assert end.temperature[3] == state.temperature[3]
    with pytest.raises(mpm.SimulationError, match="3"):
        heat.check()


def test_solves_that_miss_their_tolerance_are_reported(device):
    heat, state = alone(2, device=device)
    heat.conductivity, heat.max_iterations = 1e9, 1
    mpm.rollout(heat, state, 4, DT)
    with pytest.raises(mpm.SimulationError, match="toleran"):
        heat.check()


@pytest.mark.parametrize("melts", [False, True])
@pytest.mark.parametrize("checkpoint", [2, mpm.Checkpoints(memory=1e9), None])
def test_gradients(checkpoint, melts, dim, device):
    heat, state = alone(dim, melts=melts, device=device)
    heat.tolerance = 1e-12
    heat.conductivity = torch.tensor(3000.0, dtype=F64, device=device, requires_grad=True)
    names = ("x", "v", "F", "mass", "volume", "temperature")
    leaves = {name: getattr(state, name).clone().requires_grad_() for name in names}
    given = state.replace(**leaves)
    leaves["conductivity"] = heat.conductivity
    found, expected = (
        torch.autograd.grad(
            end.temperature.sin().sum(), list(leaves.values()), allow_unused=True, materialize_grads=True
        )
        for end in (mpm.rollout(heat, given, 5, DT, checkpoint), one_by_one(heat, given, 5, DT))
    )
    for name, a, b in zip(leaves, found, expected, strict=True):
        scale = float(b.abs().max())
        assert float((a - b).abs().max()) <= 1e-7 * max(scale, 1e-9), name


def test_other_steps_come_one_by_one(device):
    """With the reason."""
    heat, state = alone(2, device=device)

    def reason():
        plan = plan_rollout(heat, state, 6, DT)
        assert plan.executor == "loop"
        return plan.reasons["fused"]

    heat.plastic_heating = 0.9
    assert "plastic" in reason()
    heat.plastic_heating = 0.0
    heat.boundaries = [kind(region, value) for kind, region, value in surface_and_nodes(2)]
    assert "moves" in reason()
    heat.boundaries = []
    heat.method = "multigrid"
    assert "multigrid" in reason()
    heat.method = "cg"
    handle = heat.register_forward_hook(lambda module, given, end: None)
    assert "hooks" in reason()
    handle.remove()
    assert plan_rollout(heat, state, 6, DT).executor == "fused"


def test_hooks_of_rollouts_and_estimates(device):
    heat, state = alone(2, device=device)
    seen = []
    end = mpm.rollout(heat, state, 6, DT, hook=lambda now, k: seen.append((k, now.F)), every=2)
    assert [k for k, _ in seen] == [0, 2, 4] and all(F is state.F for _, F in seen)
    assert torch.allclose(end.temperature, one_by_one(heat, state, 6, DT).temperature, rtol=1e-7)
    assert mpm.estimate_rollout(heat, state, 6, DT).memory > 0
