"""Laws in principal strains against plain torch, closed forms, conservation, invariances and finite differences."""

import math
from collections.abc import Callable

import pytest
import torch
from cases.matrices import deformation, rotations
from cases.plasticity import data, error, random_states, state_of, to
from helpers import TOLERANCE
from oracle import principal as reference
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue import scenes
from benchmarks.catalogue.laws import named
from torch_mpm import ops
from torch_mpm.ops import law_energy, law_stiffness, law_update, law_wave_modulus
from torch_mpm.ops.law import ELASTIC, INVALID, PLASTIC

LAWS = sorted(reference.LAWS)
PLASTIC_LAWS = [name for name in LAWS if reference.LAWS[name].flow is not None]
DTYPES = [torch.float32, torch.float64]


# ---- values


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_update_is_the_reference(device, dim, law, dtype):
    F, (p, q) = random_states(2001, dim), data(law, 2001)
    expected = reference.principal_update(law, F, p, q)
    target = (device, dtype)
    result = law_update(law, F.to(*target), to(p, *target), to(q, *target), details=True)
    assert bool(result.converged.all())
    settled = result.branch.cpu() == expected[4]  # rounding decides on a boundary
    assert float(settled.double().mean()) > (0.998 if dtype == torch.float32 else 1 - 1e-9)
    if law in PLASTIC_LAWS:
        assert {ELASTIC, PLASTIC} == set(expected[4].tolist())
    tolerance = TOLERANCE["law"][dtype]
    assert error(result.state, expected[0]) < tolerance
    assert error(result.stress, expected[1]) < tolerance
    if law in PLASTIC_LAWS:  # rounding of the stress, times strains about one
        assert error(result.dissipated, expected[3]) < 2 * tolerance
    else:
        assert not result.dissipated.any()
    for value, wanted in zip(result.history, expected[2], strict=True):
        assert error(value, wanted) < tolerance
    assert float(result.dissipated.min()) >= 0
    assert torch.equal(result.state[result.branch == ELASTIC], F.to(*target)[result.branch == ELASTIC])


@pytest.mark.parametrize("law", LAWS)
def test_energy_is_the_reference_and_stress_its_derivative(device, dim, law):
    F, (p, q) = random_states(200, dim), data(law, 200)
    expected = reference.principal_energy(law, F, p, q)
    assert error(law_energy(law, F.to(device), to(p, device), to(q, device)), expected) < 1e-13
    result = law_update(law, F.to(device), to(p, device), to(q, device))
    mapped = result.state.cpu().requires_grad_()
    h = torch.linalg.svdvals(mapped).log()
    energy = reference.LAWS[law].energy(h, p, to(list(result.history), "cpu"))
    (slope,) = torch.autograd.grad(energy.sum(), mapped)
    assert error(result.stress, slope @ mapped.detach().mT) < 1e-11


@pytest.mark.parametrize("law", LAWS)
def test_rotations_change_nothing(device, dim, law):
    F, (p, q) = random_states(300, dim).to(device), data(law, 300)
    p, q, Q = to(p, device), to(q, device), rotations(300, dim).to(device)
    result = law_update(law, F, p, q, details=True)
    for turned, axes in ((Q @ F, Q), (F @ Q, torch.eye(dim, dtype=torch.float64, device=device))):
        other = law_update(law, turned, p, q, details=True)
        assert error(other.stress, (axes @ result.stress @ axes.mT).cpu()) < 1e-11
        expected = axes @ result.state @ torch.linalg.inv(F) @ axes.mT
        assert error(other.state @ torch.linalg.inv(turned), expected.cpu()) < 1e-11
        assert torch.allclose(other.dissipated, result.dissipated, rtol=1e-9, atol=1e-13)


def test_fixed_corotated_closed_form(device, dim):
    """τ = 2μ (F − R) Fᵀ + λ (J − 1) J I, with the rotation of another decomposition."""
    F, (p, _) = random_states(100, dim), data("fixed_corotated", 100)
    U, _, Vh = torch.linalg.svd(F)
    J = torch.linalg.det(F)
    expected = 2 * p[0][:, None, None] * (F - U @ Vh) @ F.mT
    expected = expected + (p[1] * (J - 1) * J)[:, None, None] * torch.eye(dim, dtype=torch.float64)
    result = law_update("fixed_corotated", F.to(device), to(p, device))
    assert error(result.stress, expected) < 1e-13


# ---- analytic answers


def principal(
    law: str, h: Tensor, p: list[float], q: list[float] = (), device: str = "cpu"
) -> tuple[Tensor, Tensor, Tensor]:
    """Principal strains and stresses, in the order given, and the history of diagonal deformations."""
    given = [torch.tensor(v, dtype=torch.float64, device=device) for v in p]
    history = [torch.full(h.shape[:1], v, dtype=torch.float64, device=device) for v in q]
    result = law_update(law, torch.diag_embed(h.exp()).to(device), given, history, details=True)
    assert bool(result.converged.all())
    moved = result.history[0].cpu() if q else torch.zeros(len(h), dtype=torch.float64)
    return *(t.diagonal(dim1=1, dim2=2).cpu() for t in (result.state.log(), result.stress)), moved


def test_uniaxial_tension_of_a_metal(device):
    """Stress is σ_y + H ε_p on the total strain σ/E + ε_p: a plateau without, a slope E H/(E + H) with hardening."""
    E, nu, strength = 200.0, 0.3, 1.0
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    total = torch.linspace(0.001, 0.2, 40, dtype=torch.float64)
    for modulus in (0.0, 20.0):
        plastic = ((total - strength / E) * E / (E + modulus)).clamp(min=0)
        stress = torch.where(plastic > 0, strength + modulus * plastic, E * total)
        lateral = -nu * stress / E - plastic / 2
        _, tau, history = principal(
            "von_mises", torch.stack([total, lateral, lateral], 1), [mu, lam, strength, modulus], [0.0], device
        )
        assert torch.allclose(tau[:, 0], stress, rtol=1e-12)
        assert float(tau[:, 1:].abs().max()) < 1e-11
        assert torch.allclose(history, plastic, rtol=1e-12, atol=1e-14)


def sheared(law: mpm.Material, dim: int, rate: Tensor, dt: Tensor, steps: int, device: str) -> mpm.State:
    """Simple shear at rates [P] from rest: the state before its last map, with the dt of each particle."""
    P = len(rate)
    F = torch.eye(dim, dtype=torch.float64, device=device).repeat(P, 1, 1)
    L = torch.zeros_like(F)
    L[:, 0, 1] = (rate * dt).to(device)
    state = state_of(F, scene=torch.arange(P, dtype=torch.int32, device=device))
    state.dt = dt.to(device)
    for _ in range(steps):
        fields, _ = law.update(state)
        history = {name: fields[name] for name in law.extra_fields}
        state = state.replace(F=(F + L) @ fields["F"], extra=history)
        state.dt = dt.to(device)
    return state


def equivalent(stress: Tensor) -> Tensor:
    """|dev τ|/√2 [P]."""
    dim = stress.shape[1]
    mean = stress.diagonal(dim1=1, dim2=2).mean(1)
    return (stress - mean[:, None, None] * torch.eye(dim, dtype=stress.dtype, device=stress.device)).norm(
        dim=(1, 2)
    ) / math.sqrt(2)


def test_simple_shear_of_a_metal(device, dim):
    law = mpm.VonMises(mu=1e4, lam=1e4, yield_stress=math.sqrt(3.0))
    one = torch.ones(1, dtype=torch.float64)
    state = sheared(law, dim, one, 1e-4 * one, 100, device)
    stress = law.stress(state)
    assert float(equivalent(stress)) == pytest.approx(1.0, rel=1e-12)
    assert float(stress[0, 0, 1]) == pytest.approx(1.0, rel=1e-3)
    # Plastic strain: what of the shear is not elastic, over √3.
    assert float(law.update(state)[0]["plastic_strain"]) == pytest.approx((101e-4 - 1e-4) / math.sqrt(3), rel=2e-2)


def test_steady_shear_of_a_viscoplastic_fluid(device, dim):
    """τ_y + η gⁿ for shear thinning, Bingham's and shear thickening fluids."""
    exponent = torch.tensor([0.3, 0.5, 1.0, 1.0, 2.0], dtype=torch.float64)
    rate = torch.tensor([2.0, 0.5, 1.0, 0.1, 0.7], dtype=torch.float64)
    strength, consistency = torch.tensor([[0.5, 0.0, 1.0, 2.0, 0.3], [1.0, 2.0, 0.5, 3.0, 1.0]], dtype=torch.float64)
    law = mpm.HerschelBulkley(
        mu=1e5,
        lam=1e5,
        yield_stress=strength.to(device),
        consistency=consistency.to(device),
        exponent=exponent.to(device),
    )
    state = sheared(law, dim, rate, 1e-5 / rate, 60, device)
    expected = strength + consistency * rate**exponent
    stress = law.stress(state).cpu()
    assert torch.allclose(equivalent(stress), expected, rtol=1e-4)
    assert torch.allclose(stress[:, 0, 1], expected, rtol=1e-3)


def test_stress_of_a_held_bingham_fluid_relaxes_to_the_yield_stress(device):
    """The excess over it falls by 1 + μ Δt/η in each step: the implicit form of exp(−μ t/η)."""
    mu, strength, eta, dt = 10.0, 0.2, 3.0, 0.1
    h = torch.tensor([[0.05, -0.05, 0.0]], dtype=torch.float64)
    excess = 2 * mu * 0.05 - strength
    for step in range(1, 60):
        h, tau, _ = principal("herschel_bulkley", h, [mu, 5.0, strength, eta, 1.0, dt], device=device)
        assert float((tau[0, 0] - tau[0, 1]) / 2) == pytest.approx(
            strength + excess * (1 + mu * dt / eta) ** -step, rel=1e-12
        )
    assert float((tau[0, 0] - tau[0, 1]) / 2) == pytest.approx(strength, rel=1e-6)


def test_limits_of_a_viscoplastic_fluid(device, dim):
    """Perfect plasticity without viscosity, elasticity without a time step."""
    F = random_states(200, dim).to(device)
    p, _ = data("herschel_bulkley", 200)
    p, zero = to(p, device), torch.zeros((), dtype=torch.float64, device=device)
    plastic = law_update("herschel_bulkley", F, [*p[:3], zero, p[4], p[5]])
    metal = law_update("von_mises", F, [*p[:2], math.sqrt(3) * p[2], zero], [torch.zeros_like(p[0])])
    assert error(plastic.stress, metal.stress.cpu()) < 1e-12
    elastic = law_update("herschel_bulkley", F, [*p[:5], zero])
    assert torch.equal(elastic.state, F)
    assert error(elastic.stress, law_update("hencky", F, p[:2]).stress.cpu()) < 1e-14


def clay(dim: int) -> tuple[list[float], float]:
    mu, lam = 50.0, 80.0
    return [mu, lam, 1.2, 1.0, 8.0, 0.0], lam + 2 * mu / dim


def test_isotropic_compression_of_clay(device, dim):
    """Along the compression line e = p/K + ln (p/p₀)/Θ; below p₀ elastic; unloading is elastic."""
    p, bulk = clay(dim)
    pressure = torch.linspace(1.05, 8, 30, dtype=torch.float64)
    compaction = pressure.log() / p[4]
    compression = pressure / bulk + compaction
    h = -(compression / dim)[:, None].expand(-1, dim)
    _, tau, history = principal("cam_clay", h, p, [0.0], device)
    assert torch.allclose(tau, -pressure[:, None].expand(-1, dim), rtol=1e-12)
    assert torch.allclose(history, -compaction, rtol=1e-12)
    h = torch.full((1, dim), -0.9 / bulk / dim, dtype=torch.float64)
    _, tau, _ = principal("cam_clay", h, p, [0.0], device)
    assert torch.allclose(tau, torch.full_like(tau, -0.9), rtol=1e-12)


@pytest.mark.parametrize("cohesion", [0.0, 0.5])
@pytest.mark.parametrize("start", [0.9, 0.1])
def test_critical_state_of_clay(device, dim, start, cohesion):
    """Sheared at constant volume from either side, q/p tends to M (q to M a, p to c) and the plastic volume rests."""
    p, bulk = clay(dim)
    p[5] = cohesion
    h = torch.full((1, dim), -start / bulk / dim, dtype=torch.float64)
    shear = torch.zeros(1, dim, dtype=torch.float64)
    shear[0, 0], shear[0, 1] = -2e-4, 2e-4
    history = [torch.zeros(1, dtype=torch.float64, device=device)]
    given = [torch.tensor(v, dtype=torch.float64, device=device) for v in p]
    for _ in range(1500):
        F = torch.diag_embed((h + shear).exp()).to(device)
        result = law_update("cam_clay", F, given, history)
        before, history = history, result.history
        h = result.state.diagonal(dim1=1, dim2=2).log().cpu()
    tau = result.stress.diagonal(dim1=1, dim2=2).cpu()
    pressure = -tau.mean(1)
    q = math.sqrt((6 - dim) / 2) * (tau + pressure[:, None]).norm(dim=1)
    consolidation = p[3] * (-p[4] * history[0].cpu()).exp()
    assert float(q) == pytest.approx(1.2 * float(consolidation) * (1 + cohesion) / 2, rel=1e-3)
    assert float(pressure) == pytest.approx(float(consolidation) * (1 - cohesion) / 2, rel=3e-2)
    if cohesion == 0:
        assert float(q / pressure) == pytest.approx(1.2, rel=3e-2)
    assert float((history[0] - before[0]).abs()) < 1e-3 * 4e-4


def test_flow_of_clay_is_normal_to_its_yield_surface(device, dim):
    F, (p, q) = random_states(1000, dim), data("cam_clay", 1000)
    result = law_update("cam_clay", F.to(device), to(p, device), to(q, device), details=True)
    softened = p[4] * result.history[0].cpu() > 8  # next to the limit of softening
    flows = (result.branch.cpu() == PLASTIC) & ~softened
    trial, mapped = (torch.linalg.svdvals(t.cpu())[flows].log() for t in (F, result.state))
    moved, (mu, lam, M, initial, theta, beta) = result.history[0].cpu()[flows], [v[flows] for v in p]
    tau = (2 * mu[:, None] * mapped + (lam * mapped.sum(1))[:, None]).requires_grad_()
    pressure = -tau.mean(1)
    q_squared = (6 - dim) / 2 * (tau + pressure[:, None]).square().sum(1)
    pc = initial * (-theta * moved).exp()
    value = q_squared + M**2 * (pressure - pc) * (pressure + beta * pc)
    scale = (M * pc) ** 2
    assert float((value.detach() / scale).abs().max()) < 1e-9
    (normal,) = torch.autograd.grad(value.sum(), tau)
    increment = trial - mapped
    cosine = (normal * increment).sum(1) / (normal.norm(dim=1) * increment.norm(dim=1))
    assert float(cosine[increment.norm(dim=1) > 1e-6].min()) > 1 - 1e-9


def test_snow_is_clamped_and_keeps_its_volume(device, dim):
    F, (p, q) = random_states(1000, dim), data("snow", 1000)
    result = law_update("snow", F.to(device), to(p, device), to(q, device))
    sigma = torch.linalg.svdvals(result.state.cpu())
    assert bool((sigma >= (1 - p[2] - 1e-12)[:, None]).all())
    assert bool((sigma <= (1 + p[3] + 1e-12)[:, None]).all())
    volume = torch.linalg.det(result.state.cpu()) * result.history[0].cpu().exp()
    assert torch.allclose(volume, torch.linalg.det(F) * q[0].exp(), rtol=1e-12)
    factor = (p[4] * (1 - result.history[0].cpu().exp())).exp()
    elastic = law_update("fixed_corotated", result.state.cpu(), p[:2])
    assert error(result.stress, factor[:, None, None] * elastic.stress) < 1e-12


def test_states_after_the_map_are_inside_the_yield_surface(device, dim):
    F = random_states(2000, dim)
    p, q = data("von_mises", 2000)
    result = law_update("von_mises", F.to(device), to(p, device), to(q, device))
    strength = (p[2] + p[3] * result.history[0].cpu()) / math.sqrt(3)
    assert float((equivalent(result.stress.cpu()) / strength).max()) < 1 + 1e-12
    p, q = data("cam_clay", 2000)
    result = law_update("cam_clay", F.to(device), to(p, device), to(q, device))
    again = law_update("cam_clay", result.state, to(p, device), list(result.history))
    assert error(again.state, result.state.cpu()) < 1e-10


# ---- moduli


@pytest.mark.parametrize("law", LAWS)
def test_wave_modulus_bounds_the_acoustic_tensor(device, dim, law):
    """δ²ψ along a nᵀ F by differences of the elastic stress: Q(n)_ij = second variation; exact at rest."""
    count, step = 60, 1e-6
    F, (p, q) = 0.7 * random_states(count, dim) + 0.3 * torch.eye(dim, dtype=torch.float64), data(law, count)
    if law == "herschel_bulkley":
        p[5] = torch.zeros_like(p[5])
    result = law_update(law, F, p, q)
    bound = law_wave_modulus(law, *(to(v, device) if isinstance(v, list) else v.to(device) for v in (F, p, q))).cpu()
    F, q = result.state, list(result.history)

    def elastic(F: Tensor) -> Tensor:
        h = reference.svd3(F)
        tau = reference.LAWS[law].stress(h[1].log(), p, q)
        return (h[0] * tau[:, None, :]) @ h[0].mT

    stress, largest = elastic(F), torch.zeros(count, dtype=torch.float64)
    for n in torch.cat([torch.randn(25, count, dim, dtype=torch.float64), rotations(count, dim).permute(1, 0, 2)]):
        n = n / n.norm(dim=1, keepdim=True)
        Q = torch.zeros(count, dim, dim, dtype=torch.float64)
        for k in range(dim):
            G = torch.zeros(count, dim, dim, dtype=torch.float64)
            G[:, k] = n
            change = (elastic(F + step * G @ F) - elastic(F - step * G @ F)) / (2 * step)
            # a : (dτ[G] − τ Gᵀ) n over a, with the geometric part of a nᵀ.
            Q[:, :, k] = (change @ n[:, :, None])[:, :, 0] - n[:, k, None] * (stress @ n[:, :, None])[:, :, 0]
        largest = torch.maximum(largest, torch.linalg.eigvalsh((Q + Q.mT) / 2).amax(1))
    assert bool((largest <= bound * (1 + 1e-6)).all())
    assert float((bound / largest).median()) < 1.6
    eye = torch.eye(dim, dtype=torch.float64, device=device)[None]
    rest = [v[:1].to(device) for v in p], [torch.zeros(1, dtype=torch.float64, device=device) for _ in q]
    assert float(law_wave_modulus(law, eye, *rest)) == pytest.approx(float(p[1][0] + 2 * p[0][0]), rel=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_stiffness_bounds_the_tangent(device, dim, law):
    count = 100
    F, (p, q) = random_states(count, dim), data(law, count)
    if law == "herschel_bulkley":
        p[5] = torch.zeros_like(p[5])
    F, p, q = F.to(device), to(p, device), to(q, device)
    bound = law_stiffness(law, F, p, q)
    result = law_update(law, F, p, q)
    F, q, stress = result.state, list(result.history), result.stress

    def change(G: Tensor) -> Tensor:
        forward, backward = (law_update(law, F + s * 1e-6 * G @ F, p, q).stress for s in (1, -1))
        return (forward - backward) / 2e-6

    tightest = torch.zeros_like(bound)
    for _ in range(30):
        G = torch.randn(count, dim, dim, dtype=torch.float64, device=device)
        G = G / G.norm(dim=(1, 2), keepdim=True)
        tangent = change(G)
        second = (G * tangent).sum((1, 2)) - (G * (stress @ G.mT)).sum((1, 2))
        tightest = torch.maximum(tightest, torch.maximum(tangent.norm(dim=(1, 2)), second.abs()))
    assert bool((tightest <= bound * (1 + 1e-6)).all())
    assert float(bound.min()) > 0


# ---- gradients


def gradient_states(law: str, dim: int) -> Tensor:
    """Strains of every branch, with equal and nearly equal values."""
    h = torch.tensor(
        [
            [0.0, 0.0, 0.0],
            [0.002, 0.002, -0.001],
            [-0.1, -0.1, -0.1],
            [-0.1, -0.1, -0.12],
            [-0.3, -0.1, -0.05],
            [-0.25, -0.25, 0.1],
            [-0.1, 0.15, 0.15],
            [0.2, 0.2, 0.1],
            [0.2, 0.2 + 1e-7, -0.1],
            [0.3, -0.15, -0.16],
        ],
        dtype=torch.float64,
    )
    h = h if dim == 3 else h[:, 1:]
    return h * 0.3 if law == "cam_clay" else h


@pytest.mark.parametrize("law", LAWS)
def test_gradients(device, dim, law):
    """Every result by every input, on all branches, at equal strains and at the identity."""
    h = gradient_states(law, dim)
    F, (p, q) = deformation(h), data(law, len(h))
    F[0] = torch.eye(dim)
    leaves = [v.to(device).requires_grad_() for v in (F, *p, *q)]

    def results(F: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        result = law_update(law, F, values[: len(p)], values[len(p) :], details=True)
        moved = (result.state, *result.history, result.dissipated) if law in PLASTIC_LAWS else ()
        return result.stress, *moved

    branches = law_update(law, leaves[0], leaves[1 : 1 + len(p)], leaves[1 + len(p) :], details=True).branch
    assert branches.unique().tolist() == ([ELASTIC, PLASTIC] if law in PLASTIC_LAWS else [ELASTIC])
    assert torch.autograd.gradcheck(results, leaves, eps=1e-7, atol=3e-6, rtol=1e-5)


@pytest.mark.parametrize("law", LAWS)
def test_gradients_of_the_energy(device, dim, law):
    h = gradient_states(law, dim)
    p, q = data(law, len(h))
    leaves = [v.to(device).requires_grad_() for v in (deformation(h), *p, *q)]
    assert torch.autograd.gradcheck(
        lambda F, *v: law_energy(law, F, v[: len(p)], v[len(p) :]), leaves, atol=1e-6, rtol=1e-5
    )


@pytest.mark.parametrize("law", PLASTIC_LAWS)
@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6, 0.0])
def test_gradients_in_float32_at_nearly_equal_stretches(device, law, gap):
    count = 200
    h = torch.tensor([[-0.1, -0.1 - gap, 0.04]], dtype=torch.float64).repeat(count, 1)
    F, (p, q) = deformation(h).float(), data(law, count)
    weights, grads = torch.randn(2, count, 3, 3), []
    for dtype in DTYPES:
        leaf = F.to(device, dtype).requires_grad_()
        result = law_update(law, leaf, to(to(p, torch.float32), device, dtype), to(to(q, torch.float32), device, dtype))
        pairs = zip((result.state, result.stress), weights, strict=True)
        loss = sum((value * weight.to(device, dtype)).sum() for value, weight in pairs)
        grads.append(torch.autograd.grad(loss, leaf)[0].double())
    errors = (grads[0] - grads[1]).norm(dim=(1, 2)) / grads[1].norm(dim=(1, 2))
    assert float(errors.median()) < 3e-6
    assert float(errors.max()) < 2e-4


@pytest.mark.parametrize("law", LAWS)
def test_gradient_at_the_identity(device, dim, law):
    """The tangent of linear elasticity, also in float32, where peers return NaN or lose what is off the diagonal."""
    F = torch.eye(dim, device=device)[None].requires_grad_()
    p, q = data(law, 1)
    p, q = to(p, device, torch.float32), [torch.zeros(1, device=device) for _ in q]
    p = [v.clone() for v in p]
    if law == "herschel_bulkley":
        p[2].fill_(0.1)
    G = torch.randn(dim, dim, device=device)
    (grad,) = torch.autograd.grad((law_update(law, F, p, q).stress * G).sum(), F)
    expected = p[0] * (G + G.T) + p[1] * G.trace() * torch.eye(dim, device=device)
    assert torch.allclose(grad[0], expected, rtol=1e-5, atol=1e-6)


def test_gradients_of_shared_parameters(device):
    F, (p, q) = random_states(12, 3).to(device), data("von_mises", 12)
    scene = torch.tensor([0, 1, 2] * 4, dtype=torch.int32, device=device)
    p, q = to(p, device), to(q, device)

    def grad(strength: Tensor) -> Tensor:
        leaf = strength.clone().requires_grad_()
        result = law_update("von_mises", F, [*p[:2], leaf, p[3]], q, scene=scene)
        return torch.autograd.grad(result.stress.sum() + result.history[0].sum(), leaf)[0]

    values = torch.tensor([0.05, 0.1, 0.15], dtype=torch.float64, device=device)
    single = grad(values[scene.long()])
    assert torch.allclose(grad(values), torch.stack([single[scene == b].sum() for b in range(3)]), rtol=1e-12)
    one = values[:1]
    assert torch.allclose(grad(one), grad(one.expand(12)).sum(), rtol=1e-12)
    assert grad(one[0]).shape == ()


def test_what_is_not_differentiable_says_so(device):
    F = 1.1 * torch.eye(3, device=device)[None].requires_grad_()
    p = [torch.ones((), device=device)] * 2
    (grad,) = torch.autograd.grad(law_update("hencky", F, p).stress.sum(), F, create_graph=True)
    with pytest.raises(NotImplementedError, match="no second derivatives"):
        grad.sum().backward()
    with pytest.raises(NotImplementedError, match="not differentiable"):
        law_stiffness("hencky", F, p).sum().backward()
    with pytest.raises(NotImplementedError, match="vmap"):
        torch.vmap(lambda F: law_update("hencky", F, p).stress)(F.detach()[None])


# ---- second derivatives of the energies

TWICE = [n for n, law in ops.LAWS.items() if law.twice_differentiable_energy and not law.twice_differentiable]


def energy_of(law: str, count: int, device: str) -> tuple[list[Tensor], Callable[..., Tensor]]:
    """Lamé parameters per particle, and the energy as a function of F and them; yield surfaces do not matter."""
    rest = [torch.zeros(count, dtype=torch.float64, device=device) for _ in ops.LAWS[law].parameters[2:]]

    def energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
        return law_energy(law, F, [mu, lam, *(r.to(F.dtype) for r in rest)])

    return [p.to(device) for p in data("hencky", count)[0]], energy


@pytest.mark.parametrize("law", TWICE)
def test_energies_have_second_derivatives(law, dim, device):
    """At separate, equal and nearly equal stretches; compressed, where the unilateral energies are smooth."""
    if dim == 2 and not ops.LAWS[law].in_2d:
        pytest.skip("3-D alone")
    h = torch.tensor([[-0.3, -0.1, -0.2], [-0.2, -0.2, -0.2], [-0.1, -0.1, -0.4], [-0.2, -0.2 + 1e-7, -0.1]])
    F = deformation(h[:, :dim].double()).to(device).requires_grad_()
    parameters, energy = energy_of(law, len(F), device)
    inputs = (F, *(p.requires_grad_() for p in parameters))
    assert torch.autograd.gradcheck(energy, inputs)
    assert torch.autograd.gradgradcheck(energy, inputs)


def product(energy: Callable[..., Tensor], F: Tensor, along: Tensor, parameters: list[Tensor]) -> Tensor:
    F = F.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(F, *parameters).sum(), F, create_graph=True)
    return torch.autograd.grad(gradient, F, along)[0]


@pytest.mark.parametrize("law", TWICE)
def test_second_derivatives_in_float32(law, device):
    """Strains of 1e-4 to 1 of both signs, stretches apart by as little as rounding: float32 against float64."""
    count = 200
    h = 10 ** (-4 * torch.rand(count, 1, dtype=torch.float64)) * torch.randn(count, 3, dtype=torch.float64).clamp(-2, 2)
    h[::3, 1] = h[::3, 0]
    h[1::3, 1] = h[1::3, 0] * (1 + 1e-6)
    F = deformation(h).float().to(device)
    along = torch.randn_like(F)
    parameters, energy = energy_of(law, count, device)
    exact = product(energy, F.double(), along.double(), parameters)
    scale = 2 * parameters[0] + 3 * parameters[1]
    found = product(energy, F, along, [p.float() for p in parameters])
    size = exact.abs().amax((1, 2)) + scale * 1e-3 * torch.linalg.matrix_norm(F.double(), 2)
    assert float(((found - exact).abs().amax((1, 2)) / size).max()) < 1e-3


@pytest.mark.parametrize("law", TWICE)
def test_states_without_an_energy_have_no_second_derivatives(law, device):
    F = torch.eye(3, dtype=torch.float64, device=device).repeat(4, 1, 1)
    F[1, 0, 0], F[2, 0, 0], F[3, 0, 0] = -1.0, torch.nan, 0.0
    parameters, energy = energy_of(law, 4, device)
    result = product(energy, F, torch.ones_like(F), parameters)
    assert not result[1:].any() and result[0].isfinite().all()


# ---- bad input


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_deformations_without_meaning(device, dim, law, dtype):
    eye = torch.eye(dim, dtype=dtype)
    turned, singular, nan, infinite = eye.clone(), eye.clone(), eye.clone(), eye.clone()
    turned[0, 0], singular[0, 0], nan[0, 1], infinite[1, 0] = -1, 0, torch.nan, torch.inf
    F = torch.stack([turned, singular, nan, infinite, 0 * eye]).to(device).requires_grad_()
    p, q = data(law, 5)
    p, q = ([t.requires_grad_() for t in to(v, device, dtype)] for v in (p, q))
    result = law_update(law, F, p, q, details=True)
    assert bool((result.branch == INVALID).all())
    assert torch.equal(result.state.detach().nan_to_num(7), F.detach().nan_to_num(7))
    assert float(result.stress.detach().abs().max()) == 0
    assert float(result.dissipated.detach().abs().max()) == 0
    for new, old in zip(result.history, q, strict=True):
        assert torch.equal(new.detach(), old.detach())
    total = result.stress.sum() + sum(h.sum() for h in result.history)
    grads = torch.autograd.grad(total, [F, *p, *q])
    assert all(bool((g == 0).all()) for g in grads[: 1 + len(p)])
    assert all(bool((g == 1).all()) for g in grads[1 + len(p) :])
    energy = law_energy(law, F, p, q)
    assert bool((energy == torch.inf).all())
    assert all(bool((g == 0).all()) for g in torch.autograd.grad(energy.sum(), [F, *p, *q]))
    assert float(law_stiffness(law, F.detach(), p, q).abs().max()) == 0


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_extreme_states_give_no_nan(device, dim, law, dtype):
    """Any F of positive determinant: finite results, or zero stress where it overflows; and convergence."""
    count = 5000
    F = torch.randn(count, dim, dim, dtype=torch.float64) * 10 ** (4 * torch.randn(count, 1, 1, dtype=torch.float64))
    F[: count // 2] = deformation(3 * torch.randn(count // 2, dim, dtype=torch.float64))
    eye = torch.eye(dim, dtype=torch.float64)
    F = torch.cat([F, eye[None] * torch.tensor([1, 1 - 1e-12, 1e-30, 1e30, 1e-12, 1e12])[:, None, None]])
    p, q = data(law, len(F))
    target = (device, dtype)
    for scale in (1.0, 1e5):  # of the elastic moduli
        given = [scale * p[0], scale * p[1], *p[2:]]
        leaves = [t.requires_grad_() for t in to([F, *given, *q], *target)]
        result = law_update(law, leaves[0], leaves[1 : 1 + len(p)], leaves[1 + len(p) :], details=True)
        values = (result.state, result.stress, result.dissipated, *result.history)
        assert all(bool(v.isfinite().all()) for v in values)
        assert bool(result.converged[result.branch != INVALID].all())
        assert bool((result.stress[result.branch == INVALID] == 0).all())
        moderate = (F.abs().amax((1, 2)) < 1e2) & (torch.linalg.det(F) > 1e-2)
        loss = sum(v[moderate.to(device)].sum() for v in values)
        for grad in torch.autograd.grad(loss, leaves):
            assert bool(grad[moderate.to(device)].isfinite().all())


@pytest.mark.parametrize("law", ["von_mises", "herschel_bulkley", "cam_clay"])
def test_moduli_and_strengths_of_zero(device, dim, law):
    F = random_states(50, dim).to(device)
    p, q = data(law, 50)
    for k in range(len(p)):
        zeroed = to([v if i != k else torch.zeros_like(v) for i, v in enumerate(p)], device)
        if (law, k) in (("cam_clay", 2), ("cam_clay", 3), ("herschel_bulkley", 4)):
            continue  # must be positive
        result = law_update(law, F, zeroed, to(q, device), details=True)
        assert bool(result.stress.isfinite().all())
        assert bool(result.converged.all())


# Parameters that are stresses, behind μ and λ.
STRESSES = {"von_mises": (2, 3), "herschel_bulkley": (2, 3), "cam_clay": (3,)}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("exponent", [-90, 90])
def test_the_unit_of_stress_does_not_matter(device, dim, law, dtype, exponent):
    """All moduli and strengths times 2^±90, 1e±27 Pa: the same strains, history and branches, stress in proportion."""
    F, (p, q) = random_states(300, dim), data(law, 300)
    scaled = [v * 2.0**exponent if k < 2 or k in STRESSES.get(law, ()) else v for k, v in enumerate(p)]
    F, p, scaled, q = F.to(device, dtype), to(p, device, dtype), to(scaled, device, dtype), to(q, device, dtype)
    one, other = (law_update(law, F, values, q, details=True) for values in (p, scaled))
    limit = 1e-10 if dtype == torch.float64 else 1e-3
    assert torch.equal(one.branch, other.branch) and int(one.branch.max()) < INVALID
    assert torch.allclose(other.state, one.state, rtol=limit, atol=limit)
    assert error(other.stress * 2.0**-exponent, one.stress.cpu().double()) < limit
    for a, b in zip(other.history, one.history, strict=True):
        assert torch.allclose(a, b, rtol=limit, atol=limit)
    stiffness = [law_stiffness(law, F, values, q) for values in (p, scaled)]
    assert torch.allclose(stiffness[1] * 2.0**-exponent, stiffness[0], rtol=limit)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-12])
def test_nearly_incompressible(device, dim, law, dtype, distance):
    """ν = 1/2 − distance: finite results and gradients, convergence, a positive time step; pressure from the volume."""
    F, (p, q) = random_states(300, dim), data(law, 300)
    nu = 0.5 - distance
    p[1] = p[0] * 2 * nu / (1 - 2 * nu)
    leaves = [v.requires_grad_() for v in to([F, *p, *q], device, dtype)]
    result = law_update(law, leaves[0], leaves[1 : 1 + len(p)], leaves[1 + len(p) :], details=True)
    assert bool(result.converged.all()) and int(result.branch.max()) < INVALID
    values = (result.state, result.stress, result.dissipated, *result.history)
    assert all(bool(v.isfinite().all()) for v in values)
    total = result.state.sum() + result.stress.sum() * distance
    assert all(bool(g.isfinite().all()) for g in torch.autograd.grad(total, leaves, allow_unused=True) if g is not None)
    stiffness = law_stiffness(law, leaves[0].detach(), *(to(v, device, dtype) for v in (p, q)))
    assert bool(stiffness.isfinite().all()) and float(stiffness.min().detach()) > 0
    if law == "hencky" and dtype == torch.float64:
        mean = result.stress.detach().diagonal(dim1=1, dim2=2).mean(1).cpu()
        bulk = p[1] + 2 * p[0] / dim
        assert torch.allclose(mean, bulk * torch.linalg.det(F).log(), rtol=1e-6, atol=1e-9 / distance)


def test_errors(device):
    F, one = torch.eye(3, device=device).repeat(4, 1, 1), torch.ones((), device=device)
    with pytest.raises(ValueError, match=r"law must be one of \['cam_clay', .*, got 'steel'"):
        law_update("steel", F, [one, one])
    with pytest.raises(ValueError, match=r"F must have shape \[P, 3, 3\] or \[P, 2, 2\], got \[4, 3\]"):
        law_update("hencky", F[:, 0], [one, one])
    with pytest.raises(TypeError, match="float32 or float64"):
        law_update("hencky", F.half(), [one, one])
    with pytest.raises(ValueError, match="hencky has the parameters mu, lam, got 1 tensors"):
        law_update("hencky", F, [one])
    with pytest.raises(ValueError, match="von_mises has the history variables plastic_strain, got 0 tensors"):
        law_update("von_mises", F, [one] * 4)
    with pytest.raises(ValueError, match=r"plastic_strain must have shape \[P\] = \[4\], got \[3\]"):
        law_update("von_mises", F, [one] * 4, [torch.zeros(3, device=device)])
    with pytest.raises(ValueError, match=r"lam must have shape \[\], \[1\] or \[P\] = \[4\] without scene, got \[3\]"):
        law_update("hencky", F, [one, torch.ones(3, device=device)])
    with pytest.raises(TypeError, match="scene must be int32"):
        law_update("hencky", F, [one, one], scene=torch.zeros(4, device=device))
    for build, message in (
        (lambda: mpm.VonMises(E=1.0, nu=0.3, yield_stress=-1.0), "yield_stress must be finite and not negative"),
        (lambda: mpm.Snow(E=1.0, nu=0.3, critical_compression=1.0), r"critical_compression must be in \[0, 1\)"),
        (
            lambda: mpm.HerschelBulkley(E=1.0, nu=0.3, yield_stress=0.0, consistency=1.0, exponent=0.0),
            "exponent must be",
        ),
        (
            lambda: mpm.CamClay(E=1.0, nu=0.3, critical_slope=1.0, consolidation=0.0, hardening=1.0),
            "consolidation must be positive",
        ),
        (lambda: mpm.Hencky(E=1.0), "Hencky needs E and nu, or mu and lam"),
    ):
        with pytest.raises(ValueError, match=message):
            build()


@pytest.mark.parametrize("law", ["hencky", "cam_clay"])
def test_opcheck(device, law):
    F, (p, q) = random_states(5, 2), data(law, 5)
    F, p, q = F.to(device).requires_grad_(), to(p, device), to(q, device)
    ops = torch.ops.torch_mpm
    torch.library.opcheck(ops.law_update.default, (F, None, p, q, None, law, 2, 0, 7))
    torch.library.opcheck(ops.law_energy.default, (F, p, q, None, law, 2))
    once = ("test_schema", "test_autograd_registration", "test_faketensor")
    moved = torch.ones(5, len(q), dtype=torch.float64, device=device)
    grads = (F.detach(), F.detach(), moved, p[0], p[0])
    for op, arguments in (
        (ops.law_update_backward, (*grads, F, None, p, q, None, law, 2, 0, 13)),
        (ops.law_energy_backward, (p[0], F, p, q, None, law, 2, 13)),
        (ops.law_stiffness, (F, p, q, None, law, 2)),
        (ops.law_wave_modulus, (F, p, q, None, law, 2)),
    ):
        torch.library.opcheck(op.default, arguments, test_utils=once)


@pytest.mark.parametrize("law", LAWS)
def test_strides_and_remainders(device, law):
    """The same results from rows of larger tensors, and for particles alone instead of in packs."""
    count = 37
    F, (p, q) = random_states(count, 3).float().to(device), data(law, count)
    p, q = to(p, device, torch.float32), to(q, device, torch.float32)
    expected = law_update(law, F, p, q)
    wide = torch.full((3, 3, 2 * count), torch.nan, device=device)
    wide[..., ::2] = F.permute(1, 2, 0)
    spread = law_update(law, wide[..., ::2].permute(2, 0, 1), p, q)
    assert torch.equal(spread.stress, expected.stress)
    for k in (0, 20, 36):
        alone = law_update(law, F[k : k + 1], [v[k : k + 1] for v in p], [v[k : k + 1] for v in q])
        assert torch.allclose(alone.stress[0], expected.stress[k], rtol=1e-5, atol=1e-6)


# ---- laws in a step


def laws() -> dict[str, mpm.Material]:
    return {name: law(1e5, 0.3, 0.02) for name, law in named(*LAWS).items()}


def block(dim: int) -> tuple[mpm.Grid, mpm.State]:
    ends, velocity = ((0.3, 0.0, 0.3)[:dim], (0.6, 0.4, 0.6)[:dim]), (0.0, -3.0, 0.0)[:dim]
    return scenes.unit_box(dim, 0.1), scenes.block(*ends, 0.1, 400.0, velocity, torch.float32)


@pytest.mark.parametrize("name", LAWS)
def test_law_in_a_step(device, dim, name):
    """A block hits the ground: history is kept, the stable step exists, gradients reach parameters."""
    law = laws()[name].to(device)
    law.E = torch.nn.Parameter(torch.tensor(1e5, device=device))
    grid, state = block(dim)
    step = mpm.Step(grid, law, gravity=(0.0, -9.8, 0.0)[:dim], walls="separate")
    state = state.to(device)
    dt = float(step.stable_dt(state, 0.4))
    state = mpm.rollout(step, state, n=30, dt=dt, checkpoint=10)
    step.check(state)
    assert set(state.extra) == set(law.extra_fields)
    assert all(bool(value.isfinite().all()) for value in state.extra.values())
    if name in ("von_mises", "snow", "cam_clay"):
        assert all(float(value.abs().max()) > 0 for value in state.extra.values())
    (grad,) = torch.autograd.grad(state.x.square().sum(), law.E)
    assert bool(grad.isfinite()) and float(grad) != 0
    order = torch.randperm(len(state), device=device)
    shuffled = state.detach().replace(ids=torch.arange(len(state), device=device)).select(order)
    assert torch.allclose(law.stress(shuffled), law.stress(state)[order], rtol=1e-4, atol=1e-2)
    assert float(law.energy(state).sum().detach()) > 0
    assert float(law.wave_speed(state).max()) > 0


def test_rate_dependence_sees_the_time_step(device):
    """In a step, in a mixture, and with a time step per scene, a fluid flows; without a time step it does not."""
    h = torch.tensor([[0.05, -0.05]] * 4, dtype=torch.float64)
    fluid = mpm.HerschelBulkley(mu=100.0, lam=100.0, yield_stress=1.0, consistency=2.0)
    F = torch.diag_embed(h.exp()).to(device)
    scene = torch.tensor([0, 0, 1, 1], dtype=torch.int32, device=device)
    x = torch.tensor([[0.3, 0.3], [0.7, 0.7]] * 2, dtype=torch.float64, device=device)
    one = torch.ones(4, dtype=torch.float64, device=device)
    state = mpm.State(x, torch.zeros_like(x), one, 1e-6 * one, F=F, scene=scene)
    assert torch.equal(fluid.update(state)[0]["F"], F)
    grid = mpm.Grid(dx=0.1, lower=(0, 0), upper=(1, 1), scenes=2)
    mixture = mpm.Mixture([mpm.Hencky(mu=1.0, lam=1.0), fluid])
    material = torch.tensor([0, 1, 0, 1], dtype=torch.int32, device=device)
    for law, flows in ((fluid, [0, 1, 2, 3]), (mixture, [1, 3])):
        dt = torch.tensor([1e-3, 2e-3], dtype=torch.float64, device=device)
        moved = mpm.Step(grid, law)(state.replace(material=material), dt)
        shear = (moved.F.diagonal(dim1=1, dim2=2).log()[:, 0]).cpu()
        rate = (2 * 100 * 0.05 - 1) / (2.0 / dt[scene.long()].cpu() + 100) / dt[scene.long()].cpu()
        expected = 0.05 - rate * dt[scene.long()].cpu() / 2
        for k in range(4):
            assert float(shear[k]) == pytest.approx(float(expected[k]) if k in flows else 0.05, rel=1e-3)


def test_dissipated_energy_on_request(device, dim):
    F = random_states(50, dim).to(device)
    state = state_of(F)
    for name, law in laws().items():
        assert "dissipated" not in law.update(state)[0]
        law.dissipation = True
        fields, _ = law.update(state)
        assert ("dissipated" in fields) == (name in PLASTIC_LAWS)
    metal = laws()["von_mises"]
    metal.dissipation = True
    fields, _ = metal.update(state)
    assert torch.allclose(2e3 * fields["plastic_strain"], fields["dissipated"], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("law", PLASTIC_LAWS)
def test_work_is_stored_or_dissipated(device, dim, law):
    """Work along a path of strains, by the trapezoidal rule in 40 steps and 80, less what is stored in the end, elastic
    or by hardening, is heat to the order of the step.
    """
    p = {
        "von_mises": [1.0, 1.5, 0.02, 0.3],
        "herschel_bulkley": [1.0, 1.5, 0.005, 0.05, 0.8, 0.0],
        "snow": [1.0, 1.5, 0.02, 0.02, 8.0],
        "cam_clay": [1.0, 1.5, 1.2, 0.03, 5.0, 0.2],
    }[law]
    path = torch.tensor([[-0.1, 0.05, -0.02], [-0.08, -0.06, -0.03], [0.06, -0.1, 0.03]], dtype=torch.float64)[:, :dim]
    errors = []
    for steps in (40, 80):
        given = [torch.tensor(v, dtype=torch.float64, device=device) for v in p]
        if law == "herschel_bulkley":
            given[-1] = given[-1] + 1 / steps
        history = [torch.zeros(len(path), dtype=torch.float64, device=device) for _ in reference.LAWS[law].history]
        stretch = torch.diag_embed((path / steps).exp()).to(device)
        F = torch.eye(dim, dtype=torch.float64, device=device).expand(len(path), dim, dim)
        tau, work, heat = torch.zeros_like(F), 0.0, 0.0
        for _ in range(steps):
            result = law_update(law, stretch @ F, given, history, details=True)
            work = work + ((tau + result.stress) / 2).diagonal(dim1=1, dim2=2).cpu().mul(path / steps).sum(1)
            heat = heat + result.dissipated.cpu()
            F, tau, history = result.state, result.stress, list(result.history)
        stored = law_energy(law, F, given, history).cpu()
        if law == "von_mises":
            stored = stored + 0.3 / 2 * history[0].cpu() ** 2
        errors.append(float(((work - stored - heat) / heat).abs().max()))
    assert errors[1] < 0.03
    assert errors[1] < 0.6 * errors[0]


def test_laws_in_a_mixture(device):
    """Each law sees its own particles and history; those of others keep theirs."""
    parts = list(laws().values())
    F = (0.2 * random_states(24, 3) + 0.8 * torch.eye(3, dtype=torch.float64)).to(device)
    names = ("plastic_strain", "log_plastic_volume")
    extra = {name: 0.01 * torch.rand(24, dtype=torch.float64, device=device) for name in names}
    material = (torch.arange(24, device=device) % 6).int()
    state = state_of(F, material=material, extra=extra)
    mixture = mpm.Mixture(parts)
    assert set(mixture.extra_fields) == set(names)
    fields, stress = mixture.update(state)
    for k, law in enumerate(parts):
        whole_fields, whole = law.update(state)
        mine = material == k
        assert torch.allclose(stress[mine], whole[mine], rtol=1e-12)
        for name in names:
            assert torch.allclose(fields[name][mine], whole_fields.get(name, extra[name])[mine], rtol=1e-12)


def test_parameters_of_every_shape(device):
    F = random_states(6, 3).to(device)
    scene = torch.tensor([0, 1, 0, 1, 0, 1], dtype=torch.int32, device=device)
    strength = torch.tensor([100.0, 2000.0], dtype=torch.float64, device=device)
    state = state_of(F, scene=scene)
    expected = torch.cat(
        [
            mpm.VonMises(E=1e5, nu=0.3, yield_stress=float(strength[s])).stress(state_of(F[i : i + 1]))
            for i, s in enumerate(scene)
        ]
    )
    for value in (strength, strength[scene.long()]):
        assert torch.allclose(mpm.VonMises(E=1e5, nu=0.3, yield_stress=value).stress(state), expected, rtol=1e-12)


# ---- a user's own law of the principal stretches


class StretchNetwork(torch.nn.Module):
    """St. Venant-Kirchhoff in logarithmic strain with a parameter to learn."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.mu = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64, device=device))

    def forward(self, sigma: Tensor) -> Tensor:
        h = sigma.log()
        return 2 * self.mu * h + 3.0 * h.sum(1, keepdim=True)


def test_custom_law_of_stretches_is_the_compiled_one(device, dim):
    custom = mpm.CustomPrincipalLaw(StretchNetwork(device), stiffness=20.0)
    law = mpm.Hencky(mu=2.0, lam=3.0)
    h = gradient_states("hencky", dim)
    F = deformation(h).to(device)
    F[0] = torch.eye(dim)
    grads = []
    weights = torch.randn(len(h), dim, dim, dtype=torch.float64, device=device)
    for part in (custom, law):
        leaf = F.clone().requires_grad_()
        fields, stress = part.update(state_of(leaf))
        assert fields == {}
        grads.append((stress.detach(), *torch.autograd.grad((stress * weights).sum(), leaf)))
    assert error(grads[0][0], grads[1][0].cpu()) < 1e-13
    assert error(grads[0][1], grads[1][1].cpu()) < 1e-8
    assert torch.equal(custom.stiffness(state_of(F)), torch.full((len(h),), 20.0, dtype=torch.float64, device=device))


def test_custom_plastic_law_of_stretches(device, dim):
    """A clamp with the stress of the clamped strain: its gradients are those of the compiled snow."""
    snow = mpm.Snow(mu=2.0, lam=3.0, critical_compression=0.05, critical_stretch=0.05, hardening=0.0)

    def clamp(sigma: Tensor) -> tuple[Tensor, Tensor]:
        sigma = sigma.clamp(0.95, 1.05)
        J = sigma.prod(1, keepdim=True)
        return sigma, 4.0 * sigma * (sigma - 1) + 3.0 * J * (J - 1)

    F = deformation(0.2 * gradient_states("hencky", dim)).to(device)
    results = []
    for law in (mpm.CustomPrincipalLaw(clamp), snow):
        leaf = F.clone().requires_grad_()
        fields, stress = law.update(state_of(leaf))
        (grad,) = torch.autograd.grad((fields["F"].sum() + stress.square().sum()), leaf)
        results.append((fields["F"].detach(), stress.detach(), grad))
    for value, expected in zip(*results, strict=True):
        assert error(value, expected.cpu()) < 1e-7


def test_custom_law_of_stretches_has_parameters_and_bad_input(device):
    network = StretchNetwork(device)
    law = mpm.CustomPrincipalLaw(network)
    eye = torch.eye(3, dtype=torch.float64)
    F = torch.stack([1.1 * eye, -eye, torch.nan * eye]).to(device)
    leaf = F.requires_grad_()
    stress = law.stress(state_of(leaf))
    assert float(stress[1:].detach().abs().max()) == 0
    grad, grad_mu = torch.autograd.grad(stress.sum(), (leaf, network.mu))
    assert bool(grad.isfinite().all()) and float(grad_mu) == pytest.approx(6 * math.log(1.1), rel=1e-12)
    assert law.invalid(state_of(F)).tolist() == [False, True, True]
    with pytest.raises(ValueError, match=r"must return stresses of shape \[3, 3\], got \[3\]"):
        mpm.CustomPrincipalLaw(lambda sigma: sigma[:, 0]).stress(state_of(F))
