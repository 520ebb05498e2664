"""The sand model against plain torch, 50-digit roots, closed forms, invariances and finite differences."""

import itertools
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import mpmath
import numpy as np
import pytest
import torch
from cases.matrices import deformation, rotations
from oracle import sand as reference
from pairs import each_once, in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block
from torch_mpm.info import info
from torch_mpm.ops import quartic_energy, quartic_return_map, quartic_stiffness, quartic_stress
from torch_mpm.ops.sand import APEX, CONE, ELASTIC, INVALID

ENERGIES = ["full", "unilateral", "hencky", "mixed"]
FORMS = [
    *((energy, "zero", "radial") for energy in ENERGIES),
    *((energy, "zero", "exact") for energy in ("full", "unilateral", "mixed")),
    ("unilateral", "keep", "radial"),
]
COEFFICIENT = 6.254421582537118
KLAR = (*(math.radians(v) for v in (35, 9)), 0.2, math.radians(10))


def hencky(F: Tensor) -> Tensor:
    return torch.linalg.svdvals(F.double().cpu()).log()


def random_states(count: int, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """F, μ, λ and friction angles of elastic, shearing and separating states."""
    F = deformation(0.15 * torch.randn(count, dim, dtype=torch.float64) - 0.05)
    mu = 10 ** (2 + 4 * torch.rand(count, dtype=torch.float64))
    nu = 0.02 + 0.43 * torch.rand(count, dtype=torch.float64)
    return F, mu, mu * 2 * nu / (1 - 2 * nu), 0.02 + 0.6 * torch.rand(count, dtype=torch.float64)


def yield_ratio(stress: Tensor, alpha: Tensor | float) -> Tensor:
    """|dev τ| + α tr τ relative to |τ|: not positive inside the cone."""
    dim = stress.shape[1]
    trace = stress.diagonal(dim1=1, dim2=2).sum(1)
    deviator = stress - trace[:, None, None] / dim * torch.eye(dim, dtype=stress.dtype, device=stress.device)
    return (deviator.norm(dim=(1, 2)) + alpha * trace) / stress.norm(dim=(1, 2)).clamp_min(1e-30)


def error(value: Tensor, expected: Tensor) -> float:
    return float((value.cpu().double() - expected).abs().max() / expected.abs().max().clamp_min(1e-300))


# ---- values


@pytest.mark.parametrize(
    *in_pairs(
        {("energy", "apex", "flow"): FORMS}, dtype=[torch.float32, torch.float64], shifted=[False, True], dim=[2, 3]
    )
)
def test_return_map_is_the_reference(device, dim, energy, apex, flow, dtype, shifted):
    """`shifted`: with cohesion and the correction of lost volume."""
    F, mu, lam, angle = random_states(501 if flow == "exact" else 1001, dim)
    alpha, options = reference.friction_alpha(angle, dim), {"energy": energy, "apex": apex, "flow": flow}
    history = {"cohesion": 0.02 + 0.03 * torch.rand_like(mu), "volume_correction": 0.1 * torch.rand_like(mu)}
    history["volume_correction"][::3] = 0
    if not shifted:
        history = {}
    expected = reference.quartic_return_map(F, mu, lam, alpha, **options, **history)
    arguments = (t.to(device, dtype) for t in (F, mu, lam, angle))
    history = {name: t.to(device, dtype) for name, t in history.items()}
    result = quartic_return_map(*arguments, **options, **history, details=True)
    assert torch.equal(result.branch.cpu(), expected[2])
    assert result.branch.unique().numel() == 3
    assert bool(result.converged.all())
    # Elementary functions and LAPACK differ by some ulps: the largest error is 67 eps on a GPU, 83 eps on a CPU.
    tolerance = 128 * torch.finfo(dtype).eps
    found = (result.F, result.stress, result.multiplier, result.dissipated)
    for value, wanted in zip(found, (*expected[:2], *expected[3:5]), strict=True):
        assert error(value, wanted) < tolerance
    if shifted:
        assert float((result.volume_correction.cpu() - expected[5]).abs().max()) < tolerance
    assert float(result.multiplier.min()) >= 0
    assert float(result.dissipated.min()) >= 0


def strain_at(p: Tensor, ratio: Tensor, lode: Tensor) -> Tensor:
    """h [P, 3] with mean −p, deviator of norm ratio p and the given Lode angle."""
    turns = torch.tensor([0.0, -2 * math.pi / 3, 2 * math.pi / 3], dtype=torch.float64)
    return p[:, None] * (-1 + ratio[:, None] * math.sqrt(2 / 3) * torch.cos(lode[:, None] + turns))


def exact_map(stretches: list[float], alpha: float, ratio: float, unilateral: bool) -> list[float]:
    """Hencky strains after the map of principal stretches with a negative mean strain, to 50 digits."""
    h = [mpmath.log(mpmath.mpf(x)) for x in stretches]
    p = sum(h) / 3
    alpha, ratio = mpmath.mpf(alpha), mpmath.mpf(ratio)

    def value(kappa: mpmath.mpf) -> mpmath.mpf:
        scaled = [(p + kappa * (x - p)) / abs(p) for x in h]
        t = [(min(x, 0) if unilateral else x) ** 3 + ratio / 2 * sum(scaled) ** 3 for x in scaled]
        mean = sum(t) / 3
        return mpmath.sqrt(sum((x - mean) ** 2 for x in t)) + alpha * 3 * mean

    low, high = mpmath.mpf(0), mpmath.mpf(1)
    if p >= 0 or value(high) <= 0:
        return [float(x) for x in h]
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if value(middle) > 0 else (middle, high)
    kappa = mpmath.findroot(value, (low, high), solver="anderson", tol=1e-60, verify=False)
    return [float(p + kappa * (x - p)) for x in h]


@pytest.mark.parametrize("energy", ["full", "unilateral"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_map_to_50_digits(device, energy, dtype, tolerance):
    """Mean strains 1e-8 to 0.5, deviators 0.1 to 1e4 times that, all Lode angles, φ 1° to 60°, ν 0 to 0.49."""
    count = 200
    angle = torch.deg2rad(1 + 59 * torch.rand(count, dtype=torch.float64))
    nu = 0.49 * torch.rand(count, dtype=torch.float64)
    radius = 10 ** (-1 + 5 * torch.rand(count, dtype=torch.float64))
    mean = torch.minimum(0.5 * 10 ** (-7.7 * torch.rand(count, dtype=torch.float64)), 30 / radius)
    h = strain_at(mean, radius, math.pi / 3 * torch.rand(count, dtype=torch.float64))
    F = torch.diag_embed(h.exp()).to(device, dtype)
    alpha, ratio = (x.to(device, dtype) for x in (reference.friction_alpha(angle, 3), 2 * nu / (1 - 2 * nu)))
    result = quartic_return_map(F, torch.ones_like(alpha), ratio, alpha=alpha, energy=energy)
    assert bool(result.converged.all())
    stretches, mapped = (x.double().cpu().diagonal(dim1=1, dim2=2) for x in (F, result.F))
    with mpmath.workdps(50):
        cases = zip(stretches.tolist(), alpha.tolist(), ratio.tolist(), strict=True)
        expected = torch.tensor([exact_map(*case, energy == "unilateral") for case in cases], dtype=torch.float64)
    # The mapped stretches are rounded as well, and so are the logarithms that the mean strain is the sum of.
    trial = stretches.log()
    largest, amplified = (x.abs().amax(1, keepdim=True) for x in (expected, expected / trial.mean(1, keepdim=True)))
    rounding = 1 + trial.abs().amax(1, keepdim=True) * amplified
    limit = tolerance * largest + 5 * torch.finfo(dtype).eps * rounding
    checked = trial.sum(1) < 0  # rounding may have turned small strains into extension
    assert int(checked.sum()) > count // 2
    assert bool(((mapped.log() - expected).abs() <= limit)[checked].all())


@pytest.mark.parametrize("flow", ["radial", "exact"])
@pytest.mark.parametrize("energy", ["full", "unilateral"])
def test_steep_cones(device, energy, flow):
    """Friction angles of 37° to 89°: y falls before it rises, and its leading term may nearly vanish."""
    count = 4000 if flow == "radial" else 1000
    alpha = reference.friction_alpha(torch.deg2rad(37 + 52 * torch.rand(count, dtype=torch.float64)), 3)
    mu, lam = torch.ones_like(alpha), 3 * torch.rand(count, dtype=torch.float64)
    radius, lode = 300 * torch.rand(2, count, dtype=torch.float64)
    h = strain_at(torch.full_like(alpha, 0.01), radius, lode / 300 * math.pi / 3)
    expected, branch = reference.return_map_strain(h, mu, lam, alpha, energy, flow=flow)
    arguments = (t.to(device) for t in (torch.diag_embed(h.exp()), mu, lam))
    result = quartic_return_map(*arguments, alpha=alpha.to(device), energy=energy, flow=flow)
    assert bool(result.converged.all())
    assert torch.equal(result.branch.cpu(), branch)
    assert {ELASTIC, CONE} == set(branch.tolist())
    mapped = result.F.cpu().diagonal(dim1=1, dim2=2).log()
    assert float((mapped - expected).abs().max()) < 1e-9


@pytest.mark.parametrize("energy", ENERGIES)
def test_elastic_states_are_returned_bitwise(device, dim, energy):
    F = (deformation(-0.1 + 1e-3 * torch.randn(500, dim, dtype=torch.float64))).float().to(device)
    result = quartic_return_map(F, 1e5, 1e5, 0.6, energy=energy, details=True)
    assert bool((result.branch == ELASTIC).all())
    assert torch.equal(result.F, F)
    assert float(result.multiplier.abs().max()) == 0
    identity = torch.eye(dim, device=device).repeat(3, 1, 1)
    result = quartic_return_map(identity, 1e5, 1e5, 0.6, energy=energy)
    assert torch.equal(result.F, identity)
    assert float(result.stress.abs().max()) == 0


@pytest.mark.parametrize("energy", ENERGIES)
def test_mapped_states_lie_on_the_cone(device, dim, energy):
    F, mu, lam, angle = (t.to(device) for t in random_states(2000, dim))
    result = quartic_return_map(F, mu, lam, angle, energy=energy)
    alpha = reference.friction_alpha(angle, dim)
    ratio = yield_ratio(result.stress, alpha)
    if energy != "mixed":  # whose stress belongs to another energy than its map
        assert float(ratio[result.branch == ELASTIC].max()) <= 1e-12
        assert float(ratio[result.branch == CONE].abs().max()) < 1e-12
    assert float(result.stress[result.branch == APEX].abs().max()) < 1e-12 * float(result.stress.abs().max())
    again = quartic_return_map(result.F, mu, lam, angle, energy=energy)
    assert error(again.F, result.F.cpu()) < 1e-13


def test_apex_that_keeps_the_volume(device):
    h = torch.tensor([[0.1, 0.1, 1e-6], [0.1, 0.1, -1e-6], [0.3, -0.1, -0.1], [0.2, 0.1, -0.2]], dtype=torch.float64)
    F = torch.diag_embed(h.exp()).to(device)
    kept = quartic_return_map(F, 1e5, 1e5, 0.5, energy="unilateral", apex="keep")
    assert kept.branch.tolist() == [ELASTIC, APEX, APEX, APEX]
    assert torch.allclose(torch.linalg.det(kept.F), torch.linalg.det(F), rtol=1e-14)
    expected = torch.tensor(
        [[0.1, 0.1, 1e-6], [0.1 - 5e-7, 0.1 - 5e-7, 0], [0.1, 0, 0], [0.1, 0, 0]], dtype=torch.float64
    )
    assert torch.allclose(kept.F.cpu().diagonal(dim1=1, dim2=2).log(), expected, atol=1e-15)
    assert float(kept.stress.abs().max()) == 0
    lost = quartic_return_map(F, 1e5, 1e5, 0.5, energy="unilateral")
    assert torch.allclose(lost.F[1:].cpu(), torch.eye(3, dtype=torch.float64), atol=1e-15)


# ---- exact checks


def mohr_coulomb_angle(stress: Tensor) -> float:
    values = -torch.linalg.eigvalsh(stress.cpu())
    return math.degrees(math.asin(float((values.max() - values.min()) / (values.max() + values.min()))))


@pytest.mark.parametrize(
    ("energy", "flow", "plane_strain"),
    [
        ("full", "radial", 32.2),
        ("unilateral", "radial", 30.6),
        ("hencky", "radial", 43.85),
        ("mixed", "radial", 29.0),
        ("full", "exact", 43.85),
        ("unilateral", "exact", 43.85),
    ],
)
def test_mobilised_friction(device, energy, flow, plane_strain):
    """Steady plane-strain shear (Lode angle 30°), triaxial compression and extension; φ = 30°, ν = 0.3."""
    shear = torch.tensor([math.pi / 6, math.pi / 3, 0.0], dtype=torch.float64)
    direction = strain_at(torch.ones(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64), shear) + 1
    h = torch.full((3, 3), -0.01, dtype=torch.float64)
    for _ in range(100):
        F = torch.diag_embed((h + 0.1 * direction).exp()).to(device)
        result = quartic_return_map(F, 1.0, 1.5, math.pi / 6, energy=energy, flow=flow)
        h = result.F.diagonal(dim1=1, dim2=2).log().cpu()
    angles = [mohr_coulomb_angle(t) for t in result.stress]
    assert angles[0] == pytest.approx(plane_strain, abs=0.1)
    if energy != "mixed":
        assert angles[1] == pytest.approx(30, abs=1e-6)
        assert angles[2] == pytest.approx(48.59, abs=0.01)


def test_exact_flow_is_along_the_stress(device):
    """h_trial − h is a positive multiple of dev τ, and the radial map differs as in the notes of the model."""
    F, mu, lam, angle = (t.to(device) for t in random_states(2000, 3))
    for energy in ("full", "unilateral"):
        result = quartic_return_map(F, mu, lam, angle, energy=energy, flow="exact")
        cone = (result.branch == CONE).cpu()
        increment = 0.5 * (_log(F @ F.mT) - _log(result.F @ result.F.mT))[cone]
        stress = result.stress.cpu()[cone]
        deviator = stress - stress.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(3, dtype=stress.dtype)
        cosine = (increment * deviator).sum((1, 2)) / (increment.norm(dim=(1, 2)) * deviator.norm(dim=(1, 2)))
        assert float((1 - cosine)[increment.norm(dim=(1, 2)) > 1e-3].max()) < 1e-10
        radial = quartic_return_map(F, mu, lam, angle, energy=energy)
        difference = (_log(result.F @ result.F.mT) - _log(radial.F @ radial.F.mT)).norm(dim=(1, 2))[cone]
        assert 0.02 < float((difference / (2 * increment.norm(dim=(1, 2)))).median()) < 0.5


def _log(C: Tensor) -> Tensor:
    values, axes = torch.linalg.eigh(C.cpu())
    return (axes * values.log()[:, None, :]) @ axes.mT


@pytest.mark.parametrize("flow", ["radial", "exact"])
def test_flow_is_the_same_in_two_dimensions_and_for_the_quadratic_energy(device, flow):
    for dim, energy in ((2, "full"), (2, "unilateral"), (3, "hencky")):
        states = [t.to(device) for t in random_states(300, dim)]
        one, other = (quartic_return_map(*states, energy=energy, flow=f) for f in ("radial", flow))
        assert torch.equal(one.F, other.F)


@pytest.mark.parametrize("flow", ["radial", "exact"])
@pytest.mark.parametrize("energy", ENERGIES)
def test_cohesion_moves_the_apex(device, dim, energy, flow):
    """The map commutes with the shift of all strains by c; at the apex F has the strain c on every axis."""
    F, mu, lam, angle = random_states(500, dim)
    shift = 0.03
    moved = math.exp(shift) * F
    options = {"energy": energy, "flow": flow}
    states = [t.to(device) for t in (mu, lam, angle)]
    without = quartic_return_map(F.to(device), *states, **options)
    cohesive = quartic_return_map(moved.to(device), *states, **options, cohesion=shift, details=True)
    assert torch.equal(without.branch, cohesive.branch)
    assert error(cohesive.F, (math.exp(shift) * without.F).cpu()) < 1e-12
    apex = quartic_return_map(F.to(device), *states, **options, cohesion=shift)
    singular = torch.linalg.svdvals(apex.F[apex.branch == APEX].cpu())
    assert float((singular.log() - shift).abs().max()) < 1e-12
    tension = apex.stress[apex.branch == APEX].diagonal(dim1=1, dim2=2).cpu() / mu[apex.branch.cpu() == APEX][:, None]
    ratio = (lam / mu)[apex.branch.cpu() == APEX][:, None]
    strength = {
        "full": 4 * COEFFICIENT * shift**3 + 2 * COEFFICIENT * ratio * (dim * shift) ** 3,
        "hencky": 2 * shift + ratio * dim * shift,
    }.get(energy, 0 * ratio)
    assert float((tension - strength).abs().max()) < 1e-12
    assert float(cohesive.dissipated.min()) >= -1e-12 * float(cohesive.dissipated.max())
    flow = (F.svd().S.log() - shift).sum(1)[apex.branch.cpu() == APEX]
    heat = quartic_return_map(F.to(device), *states, **options, cohesion=shift, details=True).dissipated.cpu()
    if energy in ("full", "hencky"):  # the tension does the work of the volume, the deviator none
        assert error(heat[apex.branch.cpu() == APEX], (mu[apex.branch.cpu() == APEX] * tension[:, 0]) * flow) < 1e-11


@pytest.mark.parametrize("energy", ["full", "hencky", "mixed"])
def test_volume_that_is_lost_comes_back(device, energy):
    """Opened by 20% and closed again, sand has no stress until its volume is what it was.

    With the unilateral energy pure extension is elastic, and no volume is lost.
    """
    eye = torch.eye(3, dtype=torch.float64, device=device)[None]
    volume = torch.zeros(1, dtype=torch.float64, device=device)
    opened = quartic_return_map(1.2 * eye, 1e5, 1e5, 0.5, energy=energy, volume_correction=volume)
    assert float((opened.F - eye).abs().max()) < 1e-15
    assert float(opened.volume_correction) == pytest.approx(3 * math.log(1.2), rel=1e-14)
    half = quartic_return_map(opened.F / 1.1, 1e5, 1e5, 0.5, energy=energy, volume_correction=opened.volume_correction)
    assert float(half.stress.abs().max()) < 1e-9
    assert float(half.volume_correction) == pytest.approx(3 * math.log(1.2 / 1.1), rel=1e-13)
    closed = quartic_return_map(half.F / 1.2, 1e5, 1e5, 0.5, energy=energy, volume_correction=half.volume_correction)
    assert float(closed.volume_correction) == 0
    assert int(closed.branch) == ELASTIC
    assert torch.allclose(torch.linalg.det(closed.F), torch.full_like(volume, 1.1**-3), rtol=1e-13)


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("cohesion", [0.0, 0.0101])
def test_gap_opens_and_closes_without_stress(device, dim, energy, cohesion):
    """Sand tears beyond its cohesion, opens by 20%, shears and closes to -10%, 1% at a time.

    Strain and gap always add up to the volume; tearing alone turns energy into heat: what the cohesion stores, and its
    tension times the opening. In the end the sand is compressed as if nothing had been. With the unilateral energy,
    to which all extension is elastic, the gap is there from the beginning.
    """
    start = 0.05 if energy == "unilateral" else 0.0
    moduli = [torch.tensor([v], dtype=torch.float64) for v in (2.0, 3.0)]
    volume, total, turn = torch.tensor([start], dtype=torch.float64, device=device), start, rotations(1, dim)
    F, heat = torch.eye(dim, dtype=torch.float64, device=device)[None], []
    for step in [0.01] * 20 + [-0.01] * 30:
        strain = torch.full((1, dim), step / dim, dtype=torch.float64)
        if float(volume) > 0.02:
            strain[0, :2] += torch.tensor([0.001, -0.001])
        opening = (turn * strain.exp()[:, None, :] @ turn.mT).to(device)
        result = quartic_return_map(
            opening @ F, 2.0, 3.0, 0.5, energy=energy, cohesion=cohesion, volume_correction=volume, details=True
        )
        assert result.volume_correction is not None and result.dissipated is not None
        F, volume, total = result.F, result.volume_correction, total + step
        assert float(torch.linalg.det(F).log() + volume) == pytest.approx(total, abs=1e-12)
        heat.append(float(result.dissipated))
        if float(volume) > 0:
            assert int(result.branch) == APEX
            assert float(result.stress.abs().max()) < 1e-12
    expected = 0.0
    if cohesion and energy != "unilateral":
        edge = torch.full((1, dim), cohesion, dtype=torch.float64)
        torn = math.ceil(100 * dim * cohesion) / 100  # volume at which the step tears
        tension = reference.principal_stress(edge, *moduli, energy)[0, 0]
        expected = float(reference.energy_density(edge, *moduli, energy) + tension * (torn - dim * cohesion))
    # Strains of a turned F are known to a few ε; the stress of that does work along the whole opening of 0.2.
    rounding = 4 * torch.finfo(torch.float64).eps * (2 * 2.0 + dim * 3.0) * 0.2
    assert sum(heat) == pytest.approx(expected, rel=1e-9, abs=rounding)
    assert float(volume) == 0
    compressed = torch.full((1, dim), total / dim, dtype=torch.float64)
    assert torch.allclose(torch.linalg.svdvals(F).log().cpu(), compressed, atol=1e-12)


@pytest.mark.parametrize("energy", ENERGIES)
def test_closing_gap_gives_no_energy(device, dim, energy):
    """A torn, cohesive body in free flight, closing everywhere: nothing pulls it together."""
    grid = mpm.Grid(dx=0.1, lower=(0.0,) * dim, upper=(1.0,) * dim)
    state = block((0.3,) * dim, (0.7,) * dim, 0.1, density=1600.0, device=device)
    state = state.replace(v=-(state.x - 0.5), extra={"volume_correction": torch.full_like(state.mass, 0.2)})
    law = mpm.QuarticSand(E=1e6, nu=0.3, energy=energy, cohesion=0.02, volume_correction=True)
    step = mpm.Step(grid, law, gravity=(0.0,) * dim)
    begin = float((state.mass[:, None] * state.v**2).sum())
    for _ in range(20):
        state = step(state, 5e-4)
        assert float((state.mass[:, None] * state.v**2).sum()) <= begin * (1 + 1e-12)
    assert 0 < float(state.extra["volume_correction"].min()) < 0.2


COLUMNS = {
    "dry": {},
    "torn": {"volume_correction": True},
    "tearing": {"volume_correction": True, "cohesion": 2e-4},
    "steep": {"volume_correction": True, "friction_angle": 0.8},
    "cohesive": {"cohesion": 1e-3, "hardening": KLAR},
}


@pytest.mark.parametrize(*each_once(energy=ENERGIES, options=COLUMNS))
def test_heat_of_a_collapsing_column_is_the_energy_that_it_loses(device, energy, options):
    """The power of the stresses is stored or becomes heat, particle by particle, to the order of the time step.

    Kinetic and potential energy lose more: the transfer to and from the grid dissipates as well.
    """
    errors = []
    for dt in (4e-4, 2e-4):
        column = collapsing_column(mpm.QuarticSand(E=1e6, nu=0.3, energy=energy, **COLUMNS[options]), dt, device)
        errors.append((column.heat + column.elastic - column.work) / column.heat)
        assert column.heat + column.elastic < column.lost * 1.001
    assert abs(errors[1]) < 0.03
    assert abs(errors[1]) < 0.7 * abs(errors[0])


class Energies(NamedTuple):
    """Energies of a motion [J]: heat and work of stresses, final elastic energy, lost kinetic and potential energy."""

    heat: float
    work: float
    elastic: float
    lost: float


def collapsing_column(law: mpm.QuarticSand, dt: float, device: str) -> Energies:
    """A column twice as high as wide for 0.08 s."""
    dx, eye = 0.05, torch.eye(2, dtype=torch.float64, device=device)
    state = block((0.4, 0.0), (0.6, 0.4), dx, density=1600.0, velocity=(0.0, -1.0), device=device)
    state = state.replace(F=eye.repeat(len(state), 1, 1), C=0 * eye.repeat(len(state), 1, 1))
    grid = mpm.Grid(dx=dx, lower=(0.0, 0.0), upper=(1.0, 1.0))
    step = mpm.Step(grid, law, gravity=(0.0, -9.8), walls="sticky")
    law.dissipation = True

    def outer(state: mpm.State) -> float:
        kinetic = (state.mass * state.v.square().sum(1)).sum() / 2
        affine = (state.mass * state.C.square().sum((1, 2))).sum() * dx**2 / 8  # of APIC with quadratic B-splines
        return float(kinetic + affine + 9.8 * (state.mass * state.x[:, 1]).sum())

    begin = outer(state)
    fields, stress = law.update(state)
    heat = work = 0.0
    for _ in range(round(0.08 / dt)):
        state = step(state, dt)
        strain = state.F @ torch.linalg.inv(fields["F"]) - eye  # dt ∇v
        work += float((state.volume * (stress * strain).sum((1, 2))).sum())
        fields, stress = law.update(state)
        heat += float((state.volume * fields["dissipated"]).sum())
    elastic = float(law.energy(state).sum())
    return Energies(heat, work, elastic, begin - outer(state))


@pytest.mark.parametrize("energy", ["full", "unilateral", "hencky"])
def test_elastic_column_at_rest(device, energy):
    """ε(z) = (ρ g z/(2a (2μ + λ)))^⅓ under the weight above, for the quadratic energy ρ g z/(2μ + λ)."""
    mu, lam, density = 1e5, 1.5e5, 1600.0
    load = density * 9.8 * torch.linspace(0.1, 2.0, 5, dtype=torch.float64)
    strain = load / (2 * mu + lam)
    if energy != "hencky":
        strain = (strain / (2 * COEFFICIENT)) ** (1 / 3)
    F = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    F[:, 2, 2] = (-strain).exp()
    result = quartic_return_map(F.to(device), mu, lam, math.radians(40), energy=energy)
    assert bool((result.branch == ELASTIC).all())
    assert torch.allclose(result.stress[:, 2, 2].cpu(), -load, rtol=1e-13)


def test_mohr_coulomb_in_two_dimensions(device):
    h = torch.tensor([[-0.06, 0.04]], dtype=torch.float64)
    for energy in ("full", "unilateral", "hencky"):
        for degrees in (5.0, 30.0, 45.0):
            stress = quartic_return_map(
                deformation(h).to(device), 1.0, 1.5, math.radians(degrees), energy=energy
            ).stress
            assert mohr_coulomb_angle(stress[0]) == pytest.approx(degrees, abs=1e-6)


def test_closed_roots_in_two_dimensions(device):
    """With h = p ± |p| t: a cubic for the full energy, and a cube root for the unilateral one where t > 1."""
    alpha, ratio, p = 0.4, 1.5, -0.02
    F = torch.diag_embed(torch.tensor([[p - 0.5, p + 0.5]], dtype=torch.float64).exp()).to(device)

    def stretch(energy: str) -> float:
        h = quartic_return_map(F, 1.0, ratio, alpha=alpha, energy=energy).F[0].diagonal().log()
        return float((h[1] - h[0]) / (2 * abs(p)))

    t = stretch("full")
    value = t**3 - 3 * math.sqrt(2) * alpha * t**2 + 3 * t - math.sqrt(2) * alpha * (1 + 4 * ratio)
    assert abs(value) < 1e-12 * t**3
    assert stretch("unilateral") == pytest.approx(
        2 * (ratio * alpha / (math.sqrt(0.5) - alpha)) ** (1 / 3) - 1, rel=1e-12
    )


@pytest.mark.parametrize("energy", ENERGIES)
def test_uniaxial_compression_at_rest(device, energy):
    """The lateral stress is ν/(1 − ν) of the vertical one, which is 2a (2μ + λ) ε³ (quartic) or (2μ + λ) ε."""
    mu, nu, strain = 1e5, 0.3, 0.2
    lam = mu * 2 * nu / (1 - 2 * nu)
    F = torch.diag_embed(torch.tensor([[0.0, 0.0, -strain]], dtype=torch.float64).exp()).to(device)
    result = quartic_return_map(F, mu, lam, math.radians(35), energy=energy)
    assert int(result.branch) == ELASTIC
    stress = result.stress[0].diagonal()
    stiffness = (2 * mu + lam) * (strain if energy == "hencky" else 2 * COEFFICIENT * strain**3)
    assert float(stress[2]) == pytest.approx(-stiffness, rel=1e-13)
    assert float(stress[0] / stress[2]) == pytest.approx(nu / (1 - nu), rel=1e-13)


@pytest.mark.parametrize(("energy", "flow"), [(energy, flow) for energy, apex, flow in FORMS if apex == "zero"])
def test_invariances(device, dim, energy, flow):
    F, mu, lam, angle = (t.to(device) for t in random_states(500, dim))
    options = {"energy": energy, "flow": flow}
    result = quartic_return_map(F, mu, lam, angle, **options)
    Q = rotations(500, dim).to(device)
    turned = quartic_return_map(Q @ F, mu, lam, angle, **options)
    assert error(turned.F, (Q @ result.F).cpu()) < 1e-13
    assert error(turned.stress, (Q @ result.stress @ Q.mT).cpu()) < 1e-13
    turned = quartic_return_map(F @ Q, mu, lam, angle, **options)
    assert error(turned.F, (result.F @ Q).cpu()) < 1e-13
    assert error(turned.stress, result.stress.cpu()) < 1e-13
    stiffer = quartic_return_map(F, 2.0**40 * mu, 2.0**40 * lam, angle, **options)
    assert torch.equal(stiffer.F, result.F)
    assert torch.equal(stiffer.stress, 2.0**40 * result.stress)
    diagonal = hencky(F)
    big, small = (
        quartic_return_map(torch.diag_embed((s * diagonal).exp()).to(device), mu, lam, angle, **options)
        for s in (1.0, 2.0**-10)
    )
    mapped = [r.F.diagonal(dim1=1, dim2=2).log().cpu() for r in (big, small)]
    assert error(mapped[1] * 2.0**10, mapped[0]) < 1e-11


# ---- stress, energy, stiffness


@pytest.mark.parametrize("energy", ENERGIES)
def test_stress_and_energy(device, dim, energy):
    F, mu, lam, _ = random_states(500, dim)
    h = reference.svd3(F)[1].log()
    expected = reference.energy_density(h, mu, lam, energy)
    assert error(quartic_energy(F.to(device), mu.to(device), lam.to(device), energy=energy), expected) < 1e-13
    F, mu, lam = (t[:6].to(device).requires_grad_() for t in (F, mu, lam))
    (grad,) = torch.autograd.grad(quartic_energy(F, mu, lam, energy=energy).sum(), F)
    assert error(grad @ F.detach().mT, quartic_stress(F, mu, lam, energy=energy).detach().cpu()) < 1e-12


@pytest.mark.parametrize("energy", ENERGIES)
def test_stiffness_bounds_the_tangent(device, dim, energy):
    F, mu, lam, _ = (t.to(device) for t in random_states(200, dim))
    bound = quartic_stiffness(F, mu, lam, energy=energy)
    tightest = torch.zeros_like(bound)
    for _ in range(50):
        G = torch.randn(200, dim, dim, dtype=torch.float64, device=device)
        G = G / G.norm(dim=(1, 2), keepdim=True)
        forward, backward = (quartic_stress(F + s * 1e-6 * G @ F, mu, lam, energy=energy) for s in (1, -1))
        change = (forward - backward) / 2e-6
        stress = quartic_stress(F, mu, lam, energy=energy)
        second = (G * change).sum((1, 2)) - (G * (stress @ G.mT)).sum((1, 2))
        tightest = torch.maximum(tightest, torch.maximum(change.norm(dim=(1, 2)), second.abs()))
    assert bool((tightest <= bound * (1 + 1e-6)).all())
    stressed = tightest > 0
    assert torch.equal(stressed, bound > 0)
    assert float((bound / tightest)[stressed].median()) < 2
    rest = torch.eye(dim, dtype=torch.float64, device=device)[None]
    assert float(quartic_stiffness(rest, 1.0, 1.0, energy=energy, smallest_strain=0.1)) > 0


# ---- gradients


def gradient_states(dim: int) -> Tensor:
    """Strains on every branch, with equal and nearly equal values."""
    h = torch.tensor(
        [
            [-0.1, -0.1, -0.1],
            [-0.1, -0.1, -0.12],
            [-0.3, -0.1, -0.05],
            [-0.25, -0.25, 0.1],
            [-0.3, 0.05, 0.05],
            [0.2, 0.2, 0.1],
            [0.2, 0.2, -0.1],
            [0.3, 0.15, -0.2],
            [0.3, -0.1, -0.1],
            [0.1, -1.4, -0.2],
        ],
        dtype=torch.float64,
    )
    return h if dim == 3 else h[:, 1:]


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize(("energy", "apex", "flow"), FORMS)
def test_gradients(device, dim, energy, apex, flow):
    """Derivatives of every result by every argument."""
    h = gradient_states(dim)
    F = deformation(h).to(device)
    mu, lam, angle, cohesion, volume = (
        (low + width * torch.rand(len(h), dtype=torch.float64)).to(device)
        for low, width in ((1.0, 1.0), (0.5, 1.0), (0.07, 0.5), (0.001, 0.003), (0.001, 0.003))
    )
    names = ("mu", "lam", "friction_angle", "cohesion", "volume_correction")

    def mapped(F: Tensor, *arguments: Tensor) -> tuple[Tensor, ...]:
        options = {**dict(zip(names, arguments, strict=False)), "energy": energy, "apex": apex, "flow": flow}
        result = quartic_return_map(F, **options, details=True)
        scalars = (result.multiplier, result.dissipated, result.volume_correction)
        return result.F, result.stress, *(t for t in scalars if t is not None)

    for inputs in ((F, mu, lam, angle), (F, mu, lam, angle, cohesion), (F, mu, lam, angle, cohesion, volume)):
        branches = quartic_return_map(
            F, energy=energy, apex=apex, flow=flow, **dict(zip(names, inputs[1:], strict=False))
        ).branch.unique()
        assert branches.tolist() == [ELASTIC, CONE, APEX]
        leaves = tuple(t.clone().requires_grad_() for t in inputs)
        assert torch.autograd.gradcheck(mapped, leaves, eps=1e-7, atol=2e-6, rtol=1e-5)
    whole = torch.zeros_like(volume)  # sand that tears in this call: the volume is no leaf, at 0 it has a kink
    leaves = tuple(t.clone().requires_grad_() for t in inputs[:-1])
    assert torch.autograd.gradcheck(lambda *v: mapped(*v, whole), leaves, eps=1e-7, atol=2e-6, rtol=1e-5)
    wide = tuple(t.clone().requires_grad_() for t in (*inputs[:-1], 100 * volume))  # gaps that stay open or close
    assert torch.autograd.gradcheck(mapped, wide, eps=1e-7, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("energy", ENERGIES)
def test_gradients_of_energy_and_stress(device, dim, energy):
    F = deformation(gradient_states(dim)).to(device).requires_grad_()
    mu, lam = (
        torch.tensor(1.5, dtype=torch.float64, device=device),
        torch.tensor([0.7], dtype=torch.float64, device=device),
    )
    inputs = (F, mu.requires_grad_(), lam.requires_grad_())
    assert torch.autograd.gradcheck(lambda *a: quartic_energy(*a, energy=energy), inputs, atol=1e-6)
    assert torch.autograd.gradcheck(lambda *a: quartic_stress(*a, energy=energy), inputs, atol=1e-6)


@pytest.mark.parametrize("energy", ["full", "hencky"])
def test_gradients_of_shared_parameters(device, energy):
    F, mu, lam, angle = random_states(12, 3)
    scene = torch.tensor([0, 1, 2] * 4, dtype=torch.int32)
    for values in (torch.tensor(0.3), torch.tensor([0.3]), torch.tensor([0.3, 0.4, 0.5]), angle):
        values = values.double().to(device)
        per_particle = (
            values.expand(12) if values.numel() == 1 else values[scene.long()] if len(values) == 3 else values
        )
        wanted = []
        for angles in (values, per_particle):
            leaf = angles.clone().requires_grad_()
            result = quartic_return_map(
                F.to(device), mu.to(device), lam.to(device), leaf, scene=scene.to(device), energy=energy
            )
            (grad,) = torch.autograd.grad(result.F.sum() + result.stress.sum(), leaf)
            wanted.append(grad)
        shared, single = wanted
        if values.numel() == 1:
            single = single.sum()
        elif len(values) == 3:
            single = torch.stack([single[scene.to(device) == b].sum() for b in range(3)])
        assert torch.allclose(shared.reshape(-1), single.reshape(-1), rtol=1e-10)


def test_gradient_at_the_identity(device, dim):
    """At F = I the map is the identity, and the tangent that of linear elasticity (Hencky) or zero (quartic)."""
    F = torch.eye(dim, dtype=torch.float32, device=device)[None].requires_grad_()
    G, mu, lam = torch.randn(dim, dim, device=device), 2.0, 3.0
    for energy in ENERGIES:
        result = quartic_return_map(F, mu, lam, 0.5, energy=energy)
        (through_F,) = torch.autograd.grad((result.F * G).sum(), F, retain_graph=True)
        assert torch.allclose(through_F[0], G, rtol=1e-6)
        (through_stress,) = torch.autograd.grad((result.stress * G).sum(), F)
        linear = mu * (G + G.T) + lam * G.trace() * torch.eye(dim, device=device)
        assert torch.allclose(through_stress[0], linear if energy == "hencky" else 0 * linear, rtol=1e-6)


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6, 0.0])
@pytest.mark.parametrize("mean", [-0.07, -1e-3])
@pytest.mark.parametrize(
    ("energy", "flow"),
    [("full", "radial"), ("unilateral", "radial"), ("hencky", "radial"), ("full", "exact"), ("unilateral", "exact")],
)
def test_gradients_in_float32_at_nearly_equal_stretches(device, energy, flow, mean, gap):
    """On the cone, with two stretches that differ by `gap`: below 1e-6, the change by a rounding of F."""
    count = 500
    h = mean * torch.tensor([[3.0, 3.0, -3.0]], dtype=torch.float64).repeat(count, 1)
    h[:, 1] -= gap
    F = deformation(h).float()
    weights = torch.randn(2, count, 3, 3)

    def gradient(F: Tensor) -> Tensor:
        leaf = F.to(device).requires_grad_()
        result = quartic_return_map(leaf, 1.0, 1.5, 0.2, energy=energy, flow=flow)
        assert bool((result.branch == CONE).all())
        loss = (result.F * weights[0].to(leaf)).sum() + (result.stress * weights[1].to(leaf)).sum()
        (grad,) = torch.autograd.grad(loss, leaf)
        return grad.double().cpu()

    exact = gradient(F.double())
    found = (gradient(F) - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))
    assert float(found.median()) < 2e-7
    assert float(found.max()) < 1e-6


@pytest.mark.parametrize("energy", ["full", "unilateral"])
def test_gradients_in_float32_of_a_loss_that_misses_the_stiff_axis(device, energy):
    """Weights between two soft axes, 1e-3 times as stiff as the third: what they have of it is their rounding alone."""
    count = 500
    strains = torch.tensor([[-0.5, -0.012, -0.01]], dtype=torch.float64).repeat(count, 1)
    U, V = rotations(count, 3), rotations(count, 3)
    F = (U @ torch.diag_embed(strains.exp()) @ V).float()
    weights = (U[:, :, 1, None] * U[:, None, :, 2]).float()

    def gradient(F: Tensor) -> Tensor:
        leaf = F.to(device).requires_grad_()
        stress = quartic_return_map(leaf, 1.0, 0.0, alpha=1.0, energy=energy).stress
        (grad,) = torch.autograd.grad((stress * weights.to(leaf)).sum(), leaf)
        return grad.double().cpu()

    exact = gradient(F.double())
    assert float(((gradient(F) - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))).max()) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_parameters_and_scalar_results_in_float32(device, dtype):
    """Gradients of every result by every input, at states of every branch, against float64; none underflows."""
    count = 2000
    F = deformation(0.05 * torch.randn(count, 3, dtype=torch.float64) - 0.02)
    inputs = [F, *(torch.full((count,), v) for v in (1.3, 1.9, 0.3, 1e-3)), 1e-3 * torch.rand(count)]
    inputs[-1][::2] = 0
    inputs = [v.float().double() for v in inputs]
    weights = torch.randn(count, dtype=torch.float64)

    def gradients(target: torch.dtype) -> tuple[list[Tensor], Tensor]:
        leaves = [v.to(device, target).requires_grad_() for v in inputs]
        F, mu, lam, alpha, cohesion, volume = leaves
        r = quartic_return_map(
            F, mu, lam, alpha=alpha, cohesion=cohesion, volume_correction=volume, energy="full", details=True
        )
        assert r.multiplier is not None and r.dissipated is not None and r.volume_correction is not None
        loss = (weights.to(device, target) * (r.multiplier + 1e3 * r.dissipated + r.volume_correction)).sum()
        return [g.double().cpu() for g in torch.autograd.grad(loss, leaves)], r.branch.cpu()

    (found, branch), (exact, expected) = gradients(dtype), gradients(torch.float64)
    same = branch == expected
    assert float(same.double().mean()) > 0.99
    assert all(int((branch == k).sum()) > 100 for k in (ELASTIC, CONE, APEX))
    for g, e in zip(found, exact, strict=True):
        assert float((g - e)[same].abs().max()) < 2e-6 * float(e[same].abs().max())


def test_every_root_of_a_steep_cone_is_found_in_float32():
    """φ > 37° with the unilateral energy: directions without a root, and roots a million mean strains away beside."""
    module = pytest.importorskip("torch_mpm._math")
    from benchmarks.accuracy.sand import random_states as random_strains

    h, alpha, ratio = (torch.from_numpy(a) for a in random_strains(40_000, True, np.random.default_rng(0)))
    steep = alpha > 1 / math.sqrt(6)
    h, alpha, ratio = h[steep], alpha[steep], ratio[steep]
    arrays = [v.float().numpy() for v in (h, alpha, ratio)]
    branch = module.sand_return_map(*arrays, "unilateral", "exact")[1]
    assert int((branch > INVALID).sum()) == 0
    assert float((h[branch == CONE].abs().amax(1) / h[branch == CONE].mean(1).abs()).max()) > 5e4


def test_what_is_not_differentiable_says_so(device):
    F = torch.eye(3, device=device)[None].repeat(2, 1, 1).requires_grad_()
    result = quartic_return_map(F, 1.0, 1.0, 0.5)
    (grad,) = torch.autograd.grad(result.F.sum(), F, create_graph=True)
    with pytest.raises(NotImplementedError, match="no second derivatives"):
        grad.sum().backward()
    with pytest.raises(NotImplementedError, match="stiffness"):
        quartic_stiffness(F, 1.0, 1.0).sum().backward()


# ---- bad input


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_deformations_without_meaning(device, dim, energy, dtype):
    eye = torch.eye(dim, dtype=dtype)
    turned, singular, nan, infinite = eye.clone(), eye.clone(), eye.clone(), eye.clone()
    turned[0, 0], singular[0, 0], nan[0, 1], infinite[1, 0] = -1, 0, torch.nan, torch.inf
    F = torch.stack([turned, singular, nan, infinite, 0 * eye]).to(device)
    result = quartic_return_map(F, 1e5, 1e5, 0.5, energy=energy, details=True)
    assert bool((result.branch == INVALID).all())
    assert torch.equal(result.F.nan_to_num(7), F.nan_to_num(7))
    assert float(result.stress.abs().max()) == 0
    assert bool((quartic_energy(F, 1e5, 1e5, energy=energy) == torch.inf).all())
    assert float(quartic_stiffness(F, 1e5, 1e5, energy=energy).abs().max()) == 0


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_states_are_finite(device, dim, energy, dtype):
    """Any F of positive determinant with any parameters: finite results and gradients, and convergence."""
    eye = torch.eye(dim, dtype=torch.float64)
    shear, stretch = eye.clone(), eye.clone()
    shear[0, 1], stretch[0, 0], stretch[1, 1] = 1e3, 1e4, 1e-4
    tiny = torch.diag_embed(torch.tensor([1e-12, -1e-12, 1e-12][:dim], dtype=torch.float64))
    balanced = torch.diag_embed(torch.tensor([-0.1, 0.1, 0.0][:dim], dtype=torch.float64).exp())  # p = 0
    cases = [
        eye,
        0.9 * eye,
        1.1 * eye,
        (1 - 1e-12) * eye,
        eye + tiny,
        balanced,
        shear,
        stretch,
        1e-30 * eye,
        1e30 * eye,
    ]
    cases += [*deformation(0.3 * torch.randn(100, dim, dtype=torch.float64))]
    F = torch.stack(cases).to(device, dtype)
    flows = ("radial", "exact")
    moduli = [(1e5, 1e5), (1e5, 0.0), (1e5, -3e4), (0.0, 1e5), (-1e5, 1e5), (1e5, 1e12)]
    for mu, lam in moduli:
        for degrees, flow in itertools.product((0, 1e-3, 30, 45, 89), flows):
            leaf = F.clone().requires_grad_()
            result = quartic_return_map(leaf, mu, lam, math.radians(degrees), energy=energy, flow=flow)
            for value in (result.F, result.stress):
                assert bool(value.isfinite().all())
            assert bool(result.converged.all())
            assert int(result.branch.max()) < INVALID
            (grad,) = torch.autograd.grad(result.F.sum() + result.stress.sum() / 1e5, leaf)
            moderate = [i for i in range(len(F)) if i not in (8, 9)]
            assert bool(grad[moderate].isfinite().all())


@pytest.mark.thorough
@pytest.mark.parametrize("level", ["baseline", "avx2"])
def test_extreme_states_are_finite_with_every_instruction_set(level):
    """Rounding differs, and with it the branch of states on the boundary (a mean strain of some 1e-16)."""
    if level not in info()["build"]["cpu"]["isa"]:
        pytest.skip("not built for this level (TORCH_MPM_ISA_LEVELS)")
    selection = ["-m", "not cuda", "-k", "extreme_states_are_finite and not instruction", __file__]
    command = [sys.executable, "-m", "pytest", "-q", *selection]
    environment = os.environ | {"TORCH_MPM_ISA_LEVEL": level}
    here = Path(__file__).parent  # not the root, whose package may be another build than the one under test
    done = subprocess.run(command, env=environment, cwd=here, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]


def test_errors(device):
    F = torch.eye(3, device=device).repeat(4, 1, 1)
    with pytest.raises(ValueError, match=r"F must have shape \[P, 3, 3\] or \[P, 2, 2\], got \[4, 3\]"):
        quartic_return_map(F[:, 0], 1.0, 1.0, 0.5)
    with pytest.raises(TypeError, match="float32 or float64"):
        quartic_return_map(F.half(), 1.0, 1.0, 0.5)
    with pytest.raises(ValueError, match="either friction_angle or alpha"):
        quartic_return_map(F, 1.0, 1.0)
    with pytest.raises(ValueError, match="energy must be one of"):
        quartic_return_map(F, 1.0, 1.0, 0.5, energy="cubic")
    with pytest.raises(ValueError, match="apex='keep' needs energy='unilateral'"):
        quartic_return_map(F, 1.0, 1.0, 0.5, energy="full", apex="keep")
    with pytest.raises(ValueError, match="flow must be 'radial' or 'exact', got 'associated'"):
        quartic_return_map(F, 1.0, 1.0, 0.5, flow="associated")
    with pytest.raises(ValueError, match=r"volume_correction must have shape \[P\] = \[4\], got \[3\]"):
        quartic_return_map(F, 1.0, 1.0, 0.5, volume_correction=torch.zeros(3, device=device))
    with pytest.raises(ValueError, match="cohesion must have shape"):
        quartic_return_map(F, 1.0, 1.0, 0.5, cohesion=torch.zeros(3, device=device))
    for angle in (math.nan, -0.1, 30.0, math.inf):
        with pytest.raises(ValueError, match=rf"friction_angle must be in radians, in \[0, π/2\).*got {angle}"):
            quartic_return_map(F, 1.0, 1.0, angle)
    for wrong in (math.nan, -1.5, math.inf):
        with pytest.raises(ValueError, match=f"cohesion must be finite and not negative, got {wrong}"):
            quartic_return_map(F, 1.0, 1.0, 0.5, cohesion=wrong)
        with pytest.raises(ValueError, match=f"alpha must be finite and not negative, got {wrong}"):
            quartic_return_map(F, 1.0, 1.0, alpha=wrong)
    with pytest.raises(ValueError, match=r"mu must have shape \[\], \[1\] or \[P\] = \[4\] without scene, got \[3\]"):
        quartic_return_map(F, torch.ones(3, device=device), 1.0, 0.5)
    with pytest.raises(TypeError, match="lam must have the dtype"):
        quartic_return_map(F, 1.0, torch.ones((), dtype=torch.float64, device=device), 0.5)
    with pytest.raises(NotImplementedError, match="vmap"):
        torch.vmap(lambda F: quartic_return_map(F, 1.0, 1.0, 0.5).F)(F[None])


def test_opcheck(device):
    F, mu, lam, angle = (t.to(device).requires_grad_() for t in random_states(5, 2))
    volume = (0 * mu).detach().requires_grad_()
    ops, rule = torch.ops.torch_mpm, ("full", "radial", "zero")
    torch.library.opcheck(ops.quartic_return_map.default, (F, mu, lam, angle, None, None, None, *rule, False))
    once = ("test_schema", "test_autograd_registration", "test_faketensor")
    grads, p = (F.detach(), None, None, None, None), [mu, lam, angle, angle, angle, *[0 * mu] * 3]
    for op, arguments in (
        (ops.quartic_return_map, (F, mu, lam, angle, angle, volume, None, *rule, True)),
        (ops.law_update, (F, None, p, [volume], None, "sand_full", 2, 1, 7)),
        (ops.law_update, (F, None, p, [volume], None, "sand_full", 2, 4, 7)),
        (ops.law_update, (F, None, p, [volume, volume], None, "sand_full", 2, 4, 0)),
        (ops.law_update_backward, (*grads, F, None, p, [], None, "sand_full", 2, 0, 13)),
        (ops.law_update_backward, (*grads, F, None, p, [volume], None, "sand_full", 2, 0, 13)),
        (ops.law_energy, (F, p, [], None, "sand_full", 2)),
        (ops.law_stiffness, (F, p, [], None, "sand_full", 2)),
    ):
        torch.library.opcheck(op.default, arguments, test_utils=once)


# ---- the law


def test_law_in_a_step(device, dim):
    """A column of sand that falls apart stays inside the yield surface and passes gradients to its parameters."""
    grid = mpm.Grid(dx=0.1, lower=(0.0,) * dim, upper=(1.0,) * dim)
    state = block((0.3, 0.0, 0.3)[:dim], (0.5, 0.5, 0.5)[:dim], 0.1, density=1600.0, dtype=torch.float32, device=device)
    angle = torch.nn.Parameter(torch.tensor(0.5))
    law = mpm.QuarticSand(E=1e6, nu=0.3, friction_angle=angle).to(device)
    step = mpm.Step(grid, law, gravity=(0.0, -9.8, 0.0)[:dim], walls="sticky")
    assert 0 < float(step.stable_dt(state)) < 0.1
    state = mpm.rollout(step, state, n=60, dt=2e-3)
    step.check(state)
    result = law.return_map(state, details=True)
    assert bool(result.converged.all())
    ratio = yield_ratio(result.stress.detach(), float(reference.friction_alpha(angle.detach(), dim)))
    assert float(ratio.max()) < 1e-5
    assert float(law.energy(state).sum().detach()) > 0
    (grad,) = torch.autograd.grad(state.x.square().sum(), angle)
    assert grad.isfinite()
    assert float(grad) != 0


def test_law_follows_its_parameters(device):
    """Gradients in two iterations, a change in place, angles per scene, and the law as part of a mixture."""
    F, _, _, _ = random_states(6, 3)
    x, one = torch.full((6, 3), 0.5, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
    state = mpm.State(x, torch.zeros_like(x), mass=one, volume=one, F=F).to(device)
    law = mpm.QuarticSand(
        mu=1.0, lam=1.0, friction_angle=torch.nn.Parameter(torch.tensor(0.3, dtype=torch.float64))
    ).to(device)
    for _ in range(2):
        (grad,) = torch.autograd.grad(law.stress(state).sum(), law.friction_angle)
        assert float(grad) != 0
    with torch.no_grad():
        before = law.stress(state)
        law.friction_angle.fill_(0.6)
        assert not torch.equal(law.stress(state), before)
        assert torch.equal(law.stress(state), mpm.QuarticSand(mu=1.0, lam=1.0, friction_angle=0.6).stress(state))
        angles = torch.tensor([0.3, 0.6], dtype=torch.float64, device=device)
        scenes = state.replace(scene=torch.tensor([0, 0, 0, 1, 1, 1], dtype=torch.int32, device=device))
        mixed = mpm.QuarticSand(mu=1.0, lam=1.0, friction_angle=angles).stress(scenes)
        assert torch.equal(mixed[:3], before[:3])
        assert torch.equal(mixed[3:], law.stress(state)[3:])
        material = torch.tensor([0, 1] * 3, dtype=torch.int32, device=device)
        fields, stress = mpm.Mixture([mpm.NeoHookean(mu=1.0, lam=1.0), law]).update(state.replace(material=material))
        assert torch.equal(stress[1::2], law.stress(state)[1::2])
        assert torch.equal(fields["F"][0::2], state.F[0::2])
        assert torch.equal(fields["F"][1::2], law.return_map(state).state[1::2])


@pytest.mark.parametrize("flow", ["radial", "exact"])
def test_law_with_history(device, flow):
    """A column that flies apart: hardening and lost volume are kept in the state, and gradients pass through them."""
    grid = mpm.Grid(dx=0.1, lower=(0.0,) * 3, upper=(1.0,) * 3)
    state = block((0.3, 0.0, 0.3), (0.5, 0.4, 0.5), 0.1, density=1600.0, device=device)
    state = state.replace(v=state.x - state.x.mean(0))
    h0 = torch.nn.Parameter(torch.tensor(math.radians(35), dtype=torch.float64))
    law = mpm.QuarticSand(
        E=1e6,
        nu=0.3,
        energy="full",
        flow=flow,
        cohesion=1e-3,
        volume_correction=True,
        hardening=(h0, math.radians(9), 0.2, math.radians(10)),
    ).to(device)
    law.dissipation = True
    laws = {"alone": law, "mixed": mpm.Mixture([mpm.NeoHookean(E=1e6, nu=0.3), law])}
    material = torch.ones(len(state), dtype=torch.int32, device=device)
    ends = {}
    for name, each in laws.items():
        step = mpm.Step(grid, each, gravity=(0.0, -9.8, 0.0), walls="sticky")
        begin = state.replace(material=material if name == "mixed" else None)
        ends[name] = mpm.rollout(step, begin, n=40, dt=2e-3)
        step.check(ends[name])
    end = ends["alone"]
    q, lost = end.extra["hardening"].detach(), end.extra["volume_correction"].detach()
    assert float(q.min()) >= 0
    assert float(q.max()) > 0.01
    assert float(lost.min()) >= 0
    assert float(lost.max()) > 1e-3
    for name, value in end.extra.items():
        assert torch.allclose(value, ends["mixed"].extra[name], rtol=1e-6, atol=1e-9)
    fields, _ = law.update(end)
    again = law.return_map(end, details=True)
    assert torch.equal(fields["hardening"], end.extra["hardening"] + again.multiplier)
    assert torch.equal(fields["dissipated"], again.dissipated)
    (grad,) = torch.autograd.grad(end.x.square().sum(), h0)
    assert grad.isfinite()
    assert float(grad) != 0


@pytest.mark.parametrize("energy", ["unilateral", "full", "hencky", "mixed"])
@pytest.mark.parametrize("tears", [False, True])
def test_hardened_sand_has_the_friction_of_its_angle(device, dim, energy, tears):
    """As sand of the friction angle that each particle has after hardening (Klár et al. 2016, equation 29)."""
    F, mu, lam, _ = (t.to(device) for t in random_states(200, dim))
    q = 3 * torch.rand(len(F), dtype=torch.float64).to(device)
    volume = (0.01 * torch.randn_like(q)).clamp(min=0)
    h0, h1, h2, h3 = KLAR
    angle = h0 + (h1 * q - h3) * (-h2 * q).exp()
    assert float(angle.amax() - angle.amin()) > 0.1
    law = mpm.QuarticSand(mu=mu, lam=lam, energy=energy, cohesion=0.01, volume_correction=tears, hardening=KLAR)
    x = torch.zeros(len(F), dim, dtype=torch.float64, device=device)
    extra = {"hardening": q, **({"volume_correction": volume} if tears else {})}
    state = mpm.State(x, x, torch.ones_like(q), torch.ones_like(q), F=F, extra=extra)
    fields, stress = law.update(state)
    expected = quartic_return_map(
        F, mu, lam, angle, energy=energy, details=True, cohesion=0.01, volume_correction=volume if tears else None
    )
    torch.testing.assert_close(stress, expected.stress)
    torch.testing.assert_close(fields["F"], expected.F)
    torch.testing.assert_close(fields["hardening"], q + expected.multiplier)
    assert float(expected.multiplier.amax()) > 0.01
    if tears:
        torch.testing.assert_close(fields["volume_correction"], expected.volume_correction)
    assert set(fields) == {"F", *extra}


@pytest.mark.parametrize("energy", ["unilateral", "full", "hencky", "mixed"])
@pytest.mark.parametrize("tears", [False, True])
def test_gradients_of_hardening(device, dim, energy, tears):
    """Of every result, with respect to F, μ, λ, the slope, cohesion, h1 to h3 and history."""
    F, mu, lam, angle = (t.to(device) for t in random_states(12, dim))
    q = 2 * torch.rand(len(F), dtype=torch.float64).to(device)
    slope = reference.friction_alpha(0.3 + 0.4 * angle, dim)
    hardening = [torch.full_like(q, h) for h in KLAR[1:]]
    history = [q, 1e-3 + 0.05 * torch.rand_like(q)] if tears else [q]  # A gap of zero is a kink.
    leaves = [t.detach().clone().requires_grad_() for t in (F, mu, lam, slope, 0 * q + 0.01, *hardening, *history)]

    def results(F, mu, lam, slope, cohesion, h1, h2, h3, *history):
        parameters = [mu, lam, slope, cohesion, torch.zeros_like(mu), h1, h2, h3]
        r = mpm.ops.law_update(f"sand_{energy}", F, parameters, history, options=["hardens"], details=True)
        return r.state, r.stress, r.multiplier, r.dissipated, *r.history

    torch.autograd.gradcheck(results, leaves, fast_mode=True)


def test_hardening_needs_its_option(device):
    F, mu, lam, angle = (t.to(device) for t in random_states(5, 2))
    parameters, history = [mu, lam, angle, angle, *[0 * mu] * 4], [0 * mu] * 2
    with pytest.raises(ValueError, match="sand_full has the history variables volume_correction, got 2 tensors"):
        mpm.ops.law_update("sand_full", F, parameters, history)
    with pytest.raises(RuntimeError, match="history must be at most 1 tensors for the law sand_full"):
        torch.ops.torch_mpm.law_update(F, None, parameters, history, None, "sand_full", 2, 0, 0)


def test_law_arguments():
    with pytest.raises(ValueError, match="QuarticSand needs E and nu, or mu and lam"):
        mpm.QuarticSand(E=1e6)
    for angle in (30.0, math.nan, torch.tensor([0.5, math.nan]), torch.tensor(30.0)):
        with pytest.raises(
            ValueError, match=r"friction_angle must be in radians, in \[0, π/2\), such as 0.5236 for 30°"
        ):
            mpm.QuarticSand(E=1e6, nu=0.3, friction_angle=angle)
    for wrong in (math.nan, -1.5, torch.tensor([0.1, -0.1]), torch.tensor(math.nan)):
        with pytest.raises(ValueError, match="cohesion must be finite and not negative"):
            mpm.QuarticSand(E=1e6, nu=0.3, cohesion=wrong)
    with pytest.raises(ValueError, match="h0 must be in radians"):
        mpm.QuarticSand(E=1e6, nu=0.3, hardening=(35.0, 9.0, 0.2, 10.0))
    with pytest.raises(ValueError, match="flow must be"):
        mpm.QuarticSand(E=1e6, nu=0.3, flow="associated")
    with pytest.raises(ValueError, match="cohesion must be finite and not negative"):
        mpm.QuarticSand(E=1e6, nu=0.3, cohesion=-0.1)
    with pytest.raises(ValueError, match="hardening must be h0, h1, h2 and h3"):
        mpm.QuarticSand(E=1e6, nu=0.3, hardening=(0.5, 0.1))
    with pytest.raises(ValueError, match="h3 must not be above h0"):
        mpm.QuarticSand(E=1e6, nu=0.3, hardening=(0.5, 0.1, 0.2, 0.6))
    with pytest.raises(ValueError, match="energy must be one of"):
        mpm.QuarticSand(E=1e6, nu=0.3, energy="cubic")
    with pytest.raises(ValueError, match="apex must be"):
        mpm.QuarticSand(E=1e6, nu=0.3, energy="full", apex="keep")
