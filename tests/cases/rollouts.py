"""Scenes, laws and transfers of rollouts, and rollouts one step at a time."""

import dataclasses

import torch
from combinations import DT, F64
from helpers import TOLERANCE
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.laws import having, named
from benchmarks.catalogue.scenes import blob, unit_box

SEEDS = range(40)


def one_by_one(step: mpm.Step, state: mpm.State, n: int, dt: float = DT) -> mpm.State:
    for _ in range(n):
        state = step(state, dt)
    return state


def in_one_op(step: mpm.Step, state: mpm.State) -> bool:
    return step.explain(state, DT).startswith("all steps in one op")


def tensors(state: mpm.State) -> dict[str, Tensor]:
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state) if f.name not in ("extra", "time")}
    return {name: t for name, t in {**fields, **state.extra}.items() if isinstance(t, Tensor)}


def assert_equal(a: mpm.State, b: mpm.State, text: str = "") -> None:
    """To rounding: the op sums up particles in an order of its own."""
    assert a.time == b.time
    left, right = tensors(a), tensors(b)
    assert left.keys() == right.keys()
    for name, value in left.items():
        if value.dtype == torch.float32:
            assert_close(value, right[name], f"{name} {text}", share=0.99 if name in a.extra else 1.0)
        elif value.is_floating_point():
            scale = right[name].abs().max().clamp_min(1e-9)
            assert float((value - right[name]).abs().max() / scale) < TOLERANCE["rollout"][a.x.dtype], name
        else:
            assert torch.equal(value, right[name]), f"{name} {text}"


def assert_close(value: Tensor, expected: Tensor, name: str, share: float) -> None:
    """Strains are small differences of numbers near one: rounding may take a few particles to another branch. Histories
    add up what came of it, so of these a share of the particles is looked at."""
    error = ((value - expected).abs().flatten(1) if value.dim() > 1 else (value - expected).abs()[:, None]).amax(1)
    scale = float(expected.abs().max().clamp_min(1e-2))
    assert float(error.quantile(0.95)) < 1e-3 * scale, f"{name}: most particles"
    assert float(error.quantile(share)) < 3e-2 * scale, f"{name}: {share:.0%} of the particles"


LAWS_HERE = having("compiled") | named("sand_keep")
"""Laws that the op of rollouts computes."""
TRANSFERS = {
    "apic": {},
    "pic": {"transfer": "pic"},
    "flip": {"transfer": "flip"},
    "apic, 0.95 flip": {"flip": 0.95},
    "pic, 0.5 flip": {"transfer": "pic", "flip": 0.5},
}
SOME_TRANSFERS = ("apic", "apic, 0.95 flip")
WALLS = ("slip", "sticky", "separate", "mirror")


def mixture() -> mpm.Mixture:
    """Histories of one name in two laws, and of laws with two; fields F and J."""
    names = ("von_mises", "fluid", "cam_clay", "von_mises", "sand", "neo_hookean", "viscoelastic")
    return mpm.Mixture([LAWS_HERE[name]() for name in names])


def flying(device: str) -> tuple[mpm.State, float]:
    """Particles that leave each other, so that more blocks become active in every step."""
    state = blob(device, count=200)
    return state.replace(x=0.5 + 0.1 * (state.x - 0.5), v=60 * (state.x - 0.5)), 2e-3


def each_scene(device: str, dtype: torch.dtype = F64, transfer: str = "apic") -> tuple[mpm.Step, mpm.State]:
    """Three scenes, with an obstacle that moves and one that comes."""
    ball = mpm.Sphere((0.5, 0.2), 0.2, velocity=(0.0, 2.0), friction=0.2)
    late = mpm.Box((0.3, 0.5), (0.2, 0.2), start=2.5 * DT, kind="sticky")
    step = mpm.Step(
        unit_box(2, scenes=3),
        LAWS_HERE["herschel_bulkley"](),
        (0.5, -9.8),
        "separate",
        [ball, late],
        **TRANSFERS[transfer],
    )
    scene = (torch.arange(300) % 3).int().to(device)
    state = blob(device, 2, dtype=dtype).replace(scene=scene)
    return step, step.with_impulses(step.prepare(state))
