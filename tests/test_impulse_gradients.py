"""Gradients of impulses on walls and obstacles."""

import pytest
import torch
from cases.impulses import DT, F64, GRAVITY, LAWS, WALLS, cloud, obstacles, one_by_one
from helpers import TOLERANCE, relative_error
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import unit_box


def leaves(state: mpm.State, names: tuple[str, ...] = ("x", "v", "mass", "volume", "C", "F")) -> dict[str, Tensor]:
    return {name: getattr(state, name).detach().clone().requires_grad_() for name in names}


@pytest.mark.parametrize("walls", ["friction", "mirror", "sticky"])
def test_gradients_of_a_rollout(device, dim, walls):
    """In one op and in single steps, against central differences."""
    gravity = torch.tensor(GRAVITY[:dim], dtype=F64, device=device, requires_grad=True)
    E = torch.tensor(1e4, dtype=F64, device=device, requires_grad=True)
    step = mpm.Step(
        unit_box(dim, 0.1, deterministic=True), mpm.NeoHookean(E, 0.3), gravity, WALLS[walls], obstacles(dim)
    )
    start = step.prepare(cloud(dim, device, count=40))
    given = leaves(start) | {"impulse": torch.randn_like(step.with_impulses(start).impulse).requires_grad_()}
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(given["impulse"].shape, generator=generator, dtype=F64).to(device)

    def loss(run, **fields: Tensor) -> Tensor:
        end = run(start.replace(**fields))
        return (weights * end.impulse).sum() + 0.1 * (end.x * weights[0, 0, 0]).sum()

    def in_op(state: mpm.State) -> mpm.State:
        return mpm.rollout(step, state, 4, DT, checkpoint=3)

    wanted = [*given.values(), E, gravity]
    assert "one op" in step.explain(start.replace(**given))
    fast = torch.autograd.grad(loss(in_op, **given), wanted)
    slow = torch.autograd.grad(loss(lambda s: one_by_one(step, s, 4), **given), wanted)
    for name, a, b in zip([*given, "E", "gravity"], fast, slow, strict=True):
        assert relative_error(a, b) < TOLERANCE["rollout gradient"][F64], name
    along = {name: torch.randn_like(t) for name, t in given.items()}
    h = 1e-8
    with torch.no_grad():
        ahead, behind = (
            loss(in_op, **{name: t + s * h * along[name] for name, t in given.items()}) for s in (1.0, -1.0)
        )
    expected = sum(float((a * g).sum()) for a, g in zip(along.values(), fast, strict=False))
    assert float(ahead - behind) / (2 * h) == pytest.approx(expected, rel=1e-5)


def test_gradients_of_an_obstacle(device):
    """By its pose, motion and friction, in single steps, against central differences."""
    names = ("position", "velocity", "rotation", "angular_velocity", "friction")
    values = ([0.513, 0.387], [0.3, 0.5], 0.2, 1.5, 0.3)
    start = cloud(2, device, count=60)
    weights = torch.randn(1, 5, 3, dtype=F64).to(device)

    def force(*parameters: Tensor) -> Tensor:
        motion = dict(zip(names[1:], parameters[1:], strict=True))
        box = mpm.Box(parameters[0], (0.37, 0.31), **motion)
        step = mpm.Step(unit_box(2, 0.1, deterministic=True), LAWS["neo_hookean"](), boundaries=[box])
        return (weights * mpm.rollout(step, step.with_impulses(start), 3, DT).impulse).sum()

    parameters = [torch.tensor(v, dtype=F64, device=device, requires_grad=True) for v in values]
    grads = torch.autograd.grad(force(*parameters), parameters)
    for k, grad in enumerate(grads):
        along, h = torch.randn_like(grad), 1e-7
        ends = [
            force(*(p.detach() + s * h * along if i == k else p.detach() for i, p in enumerate(parameters)))
            for s in (1, -1)
        ]
        expected = float((grad * along).sum())
        assert float(ends[0] - ends[1]) / (2 * h) == pytest.approx(expected, rel=1e-4, abs=1e-9), names[k]


@pytest.mark.parametrize("op", ["wall_impulses", "contact_impulses"])
def test_opcheck(device, op):
    from benchmarks.fuzz import operators

    calls = dict(operators.calls(2))
    for name in (op, f"{op}_backward"):
        given = [
            t.to(device) if isinstance(t, Tensor) else [a.to(device) for a in t] if argument == "topology" else t
            for argument, t in calls[name].items()
        ]
        torch.library.opcheck(getattr(torch.ops.torch_mpm, name).default, tuple(given))
