"""A law that sees its own result again changes nothing: deformation, history and stress stay, nothing dissipates."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from cases.matrices import rotations
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue import laws as catalogue

E, NU = 1e6, 0.3
KLAR = tuple(math.radians(v) for v in (35, 9)) + (0.2, math.radians(10))

LAWS = catalogue.LAWS | catalogue.named("perfectly_plastic", "plastic_fluid")
SAND_FORMS = [
    *((energy, "radial", "zero") for energy in ("full", "unilateral", "hencky", "mixed")),
    *((energy, "exact", "zero") for energy in ("full", "unilateral", "hencky", "mixed")),
    *(("unilateral", flow, "keep") for flow in ("radial", "exact")),
]
SAND_OPTIONS = list(itertools.product((False, True), repeat=3))


def strains(count: int, dim: int) -> Tensor:
    """Hencky strains [P, D] from 1e-4 to 1: compressed, torn, sheared, and the same on every axis."""
    size = 10 ** (-4 + 4 * torch.rand(count, 1, dtype=torch.float64))
    mean = torch.tensor([-1.0, -0.3, 0.0, 0.3, 1.0], dtype=torch.float64).repeat(count)[:count, None]
    spread = torch.randn(count, dim, dtype=torch.float64)
    spread[::7] = 0
    return size * (mean + 0.5 * spread)


def states(dim: int, dtype: torch.dtype, device: str, count: int = 420) -> mpm.State:
    """Random deformations with random histories: gaps that are open, hardening, melt and temperature."""
    h = strains(count, dim)
    F = rotations(count, dim) * h.exp()[:, None, :] @ rotations(count, dim).mT
    one, gap = torch.ones(count, dtype=torch.float64), 0.2 * torch.rand(count, dtype=torch.float64)
    gap[::2] = 0
    extra = {
        "volume_correction": gap,
        "hardening": 0.5 * torch.rand_like(one),
        "plastic_strain": 0.1 * torch.rand_like(one),
        "log_plastic_volume": 0.1 * torch.rand_like(one) - 0.05,
        "liquid": torch.rand_like(one),
        "activation": 1e4 * torch.randn_like(one),
        "inverse_viscous_deformation": torch.eye(dim, dtype=torch.float64).repeat(count, 1, 1),
    }
    x, C = torch.full((count, dim), 0.5, dtype=torch.float64), torch.randn(count, dim, dim, dtype=torch.float64)
    fields = {"J": torch.linalg.det(F), "temperature": 20 * one, "material": torch.arange(count).int() % 3}
    state = mpm.State(x, 0 * x, one, one, C=C, F=F, extra=extra, **fields)
    return state.to(device, dtype)


def assert_second_update_changes_nothing(law: mpm.Material, state: mpm.State, dt: float = 0.0) -> None:
    def updated(state: mpm.State) -> tuple[dict[str, Tensor], Tensor]:
        state.dt = dt
        return law.update(state)

    law.dissipation = True
    for part in law.modules():
        if isinstance(part, mpm.Material):
            part.dissipation = True
    first, stress = updated(state)
    moved = {name: value for name, value in first.items() if name in ("F", "J")}
    history = {name: first[name] for name in law.extra_fields if name in first}
    second, again = updated(state.replace(**moved, extra={**state.extra, **history}))

    rounding = 500 * torch.finfo(state.x.dtype).eps
    size = {name: value.abs().flatten(1).amax(1) if value.dim() > 1 else 1 for name, value in first.items()}
    for name in (*moved, *history):
        change = (second[name] - first[name]).abs()
        worst = float((change.flatten(1).amax(1) / size[name] if change.dim() > 1 else change).max())
        assert worst < rounding, f"{name} changes by {worst:.3g}"
    scale = E + stress.abs().amax((1, 2))
    worst = float(((again - stress).abs().amax((1, 2)) / scale).max())
    assert worst < rounding, f"stress changes by {worst:.3g} of its scale"
    if "dissipated" in second:
        worst = float((second["dissipated"].abs() / scale).max())
        assert worst < rounding, f"{float(second['dissipated'].abs().max()):.6g} J/m3 dissipate again"


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_second_update_changes_nothing(device, dim, dtype, name):
    """A fluid that flows at a rate does so in time alone: without a time step it rests."""
    law = LAWS[name](E, NU, 0.02, **({"direction": (0.6, 0.8, 0.0)[:dim]} if name == "active" else {})).to(device)
    assert_second_update_changes_nothing(law, states(dim, dtype, device), dt=1.0 if name == "plastic_fluid" else 0.0)


@pytest.mark.parametrize(
    *in_pairs(
        {("energy", "flow", "apex"): SAND_FORMS, ("correction", "cohesive", "hardens"): SAND_OPTIONS},
        dtype=[torch.float32, torch.float64],
        dim=[2, 3],
    )
)
def test_second_update_of_sand_changes_nothing(device, dim, dtype, energy, flow, apex, correction, cohesive, hardens):
    law = mpm.QuarticSand(
        E=E,
        nu=NU,
        energy=energy,
        flow=flow,
        apex=apex,
        cohesion=0.01 if cohesive else None,
        volume_correction=correction,
        hardening=KLAR if hardens else None,
    )
    assert_second_update_changes_nothing(law, states(dim, dtype, device))


def test_flow_at_a_rate_vanishes_with_the_time_step(device, dim):
    """The change by a second update is of the order of dt."""
    law, state = LAWS["herschel_bulkley"](E, NU, 0.02), states(dim, torch.float64, device)
    changes = []
    for dt in (1e-8, 1e-9):
        state.dt = dt
        first = law.update(state)[0]["F"]
        after = state.replace(F=first)
        after.dt = dt
        changes.append(float((law.update(after)[0]["F"] - first).abs().max()))
    assert 0 < changes[1] < 0.2 * changes[0]
