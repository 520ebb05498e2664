"""Gradients by the time step of rollouts in one op: against single steps, and against finite differences."""

import pytest
import torch
from cases.rollout_gradients import assert_same, loss, moving
from cases.rollouts import F64, LAWS_HERE, one_by_one
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import blob, unit_box

DT, STEPS = 1e-4, 6
LAWS = ["neo_hookean", "fluid", "von_mises", "herschel_bulkley", "viscoelastic", "sand"]
"""Laws of F and of J, plastic and viscoplastic ones."""


def case(law: str, dim: int, device: str, scenes: int = 1, **options) -> tuple[mpm.Step, mpm.State]:
    """Case with an obstacle at rest, a wall, and gravity that requires grad."""
    gravity = torch.randn(scenes, dim, dtype=F64, device=device).requires_grad_()
    floor = mpm.Plane((0.0, 0.35, 0.0)[:dim], (0.1, 1.0, 0.0)[:dim], "separate", friction=0.2)
    step = mpm.Step(
        unit_box(dim, scenes=scenes), LAWS_HERE[law](), gravity, walls="separate", boundaries=[floor], **options
    ).to(device)
    scene = {} if scenes == 1 else {"scene": (torch.arange(300, device=device) % scenes).int()}
    return step, moving(step, blob(device, dim).replace(**scene))


def by_dt(step: mpm.Step, end: mpm.State, dt: Tensor) -> dict[str, Tensor | None]:
    """Gradients of a loss of the end state and its time."""
    total = loss(end.replace(time=0.0)) + (1e3 * end.time).square().sum()
    return dict(zip(("dt", "gravity"), torch.autograd.grad(total, [dt, step.gravity]), strict=True))


@pytest.mark.parametrize(*in_pairs(law=LAWS, form=["mls", "gradient"], transfer=["apic", "pic"], dim=[2, 3]))
@pytest.mark.parametrize("every", [1, 4, mpm.Checkpoints(memory=1e9)], ids=str)
def test_laws(law, every, form, transfer, dim, device):
    step, state = case(law, dim, device, stress_form=form, transfer=transfer)
    dt = torch.tensor(DT, dtype=F64, device=device, requires_grad=True)
    assert step.explain(state, dt).startswith("all steps between two stored states in one op")
    got = by_dt(step, mpm.rollout(step, state, STEPS, dt, every), dt)
    expected = by_dt(step, one_by_one(step, state, STEPS, dt), dt)
    assert float(expected["dt"].norm()) > 0
    assert_same(got, expected, "rollout")


@pytest.mark.parametrize("shape", ["one", "each"])
@pytest.mark.parametrize("paused", [False, True])
def test_scenes(shape, paused, device):
    scenes = 3
    step, state = case("von_mises", 2, device, scenes)
    values = [DT, 0.0 if paused else 2 * DT, 0.5 * DT] if shape == "each" else [DT]
    dt = torch.tensor(values, dtype=F64, device=device, requires_grad=True)
    found = []
    for run in (mpm.rollout, one_by_one):
        end = run(step, state, STEPS, dt)
        assert end.time.shape == dt.shape
        end = run(step, end, 2, dt)  # whose first state has a time with a gradient
        found.append(by_dt(step, end, dt) | {"time": end.time.detach()})
    assert_same(*found, "rollout")


def test_finite_differences(device):
    step, state = case("neo_hookean", 2, device)
    dt = torch.tensor(DT, dtype=F64, device=device, requires_grad=True)
    (gradient,) = torch.autograd.grad(mpm.rollout(step, state, 20, dt).v.square().sum(), dt)
    with torch.no_grad():
        ends = [mpm.rollout(step, state, 20, dt * (1 + s)).v.square().sum() for s in (1e-6, -1e-6)]
    assert float(gradient) == pytest.approx(float(ends[0] - ends[1]) / (2e-6 * DT), rel=1e-5)


def test_reasons_for_single_steps(device):
    dt = torch.tensor(DT, dtype=F64, device=device, requires_grad=True)
    step, state = case("neo_hookean", 2, device, flip=0.5)
    assert "dt requires a gradient, with FLIP" in step.explain(state, dt)
    step, state = case("neo_hookean", 2, device)
    step.boundaries.append(mpm.Sphere((0.5, 0.5), 0.1, velocity=(1.0, 0.0)))
    assert "boundaries that may read the time" in step.explain(state, dt)
    found = [by_dt(step, run(step, state, 4, dt), dt) for run in (mpm.rollout, one_by_one)]
    assert_same(*found)
