"""The stiffness that laws without one get by automatic differentiation."""

import pytest
import torch
from torch import Tensor

import torch_mpm as mpm

MU, LAM = 4e3, 9e3


def neo_hookean(F: Tensor) -> Tensor:
    """τ = μ (F Fᵀ − I) + λ ln J I."""
    eye = torch.eye(F.shape[1], dtype=F.dtype, device=F.device)
    return MU * (F @ F.mT - eye) + LAM * torch.linalg.det(F).log()[:, None, None] * eye


def neo_hookean_stretches(sigma: Tensor) -> Tensor:
    return MU * (sigma.square() - 1) + LAM * sigma.log().sum(1, keepdim=True)


def pressure(J: Tensor) -> Tensor:
    return 1e4 * (J - 1)[:, None, None] * torch.eye(2, dtype=J.dtype, device=J.device)


def state_of(F: Tensor) -> mpm.State:
    P, D = F.shape[:2]
    ones = F.new_ones(P)
    return mpm.State(x=F.new_full((P, D), 0.5), v=F.new_zeros(P, D), mass=ones, volume=1e-3 * ones, F=F)


def deformations(dim: int, device: str) -> Tensor:
    """At rest, compressed and stretched to a third and three times, sheared, turned, at random."""
    eye = torch.eye(dim, dtype=torch.float64)
    stretched, sheared, random = eye.repeat(4, 1, 1), eye.repeat(2, 1, 1), eye + 0.2 * torch.randn(20, dim, dim)
    stretched[:, 0, 0] = torch.tensor([0.33, 0.8, 1.3, 3.0])
    sheared[:, 0, 1] = torch.tensor([0.5, 2.0])
    uniform = torch.tensor([1 / 3, 1.0, 3.0])[:, None, None] * eye
    F = torch.cat([uniform, stretched, sheared, random[torch.linalg.det(random) > 0.1].double()])
    return F.to(device)


def exact(F: Tensor) -> Tensor:
    """Largest |dτ : G F| and second variation over unit G [P], from the closed form of the tangent."""
    values = []
    for f in F.cpu():
        D = len(f)
        eye, B, log_J = torch.eye(D, dtype=f.dtype), f @ f.mT, float(torch.linalg.det(f).log())
        basis = torch.eye(D * D, dtype=f.dtype).reshape(-1, D, D)
        tangent = torch.stack([MU * (G @ B + B @ G.mT) + LAM * torch.trace(G) * eye for G in basis])
        stress = MU * (B - eye) + LAM * log_J * eye
        second = torch.stack([t - stress @ G.mT for t, G in zip(tangent, basis, strict=True)]).flatten(1)
        second = (second + second.mT) / 2
        largest = (torch.linalg.matrix_norm(tangent.flatten(1), 2), torch.linalg.eigvalsh(second)[-1])
        values.append(float(max(largest)))
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("form", ["tensor", "principal"])
def test_stiffness_of_a_law_in_torch(device, dim, form):
    """Never below the largest tangent and at most 10% above it, as the bound of the compiled law is not."""
    law = mpm.CustomLaw(neo_hookean) if form == "tensor" else mpm.CustomPrincipalLaw(neo_hookean_stretches)
    F = deformations(dim, device)
    state = state_of(F)
    with torch.no_grad():
        bound = law.stiffness(state).cpu()
    least = exact(F)
    assert bool((bound >= (1 - 1e-5) * least).all())
    assert float((bound / least).max()) < 1.1
    compiled = mpm.NeoHookean(mu=MU, lam=LAM).stiffness(state).cpu()
    assert bool((bound < 1.05 * compiled).all() and (bound > 0.7 * compiled).all())
    with torch.inference_mode():
        assert torch.equal(law.stiffness(state_of(F.clone())).cpu(), bound)
    assert not law.stiffness(state.replace(F=F.clone().requires_grad_())).requires_grad


def test_stable_dt_of_a_network(device):
    """As the compiled law's, within the looseness of the bounds; through a mixture too."""
    grid = mpm.Grid(0.1, (0, 0), (1, 1))
    state = state_of(deformations(2, device))
    steps = [mpm.Step(grid, law) for law in (neo_hookean, mpm.NeoHookean(mu=MU, lam=LAM))]
    learned, compiled = (float(step.stable_dt(state)) for step in steps)
    assert learned == pytest.approx(compiled, rel=0.1)
    material = (torch.arange(len(state), device=device) % 2).int()
    mixed = mpm.Step(grid, mpm.Mixture([steps[0].law, steps[1].law]))
    assert float(mixed.stable_dt(state.replace(material=material))) == pytest.approx(compiled, rel=0.1)


def test_stiffness_of_a_fluid_and_of_a_plastic_law(device):
    """A pressure K (J − 1) I has dτ = K J tr G I; a law that returns F is differentiated where it leaves F."""
    J = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64, device=device)
    state = state_of(torch.eye(2, dtype=torch.float64, device=device).repeat(3, 1, 1)).replace(J=J)
    bound = mpm.CustomLaw(pressure, "J").stiffness(state)
    # τ = p I: |dτ| = √2 K J |tr G|, and G : dτ − p tr G² = K J (tr G)² − p tr G², largest for G = I/√2.
    least = torch.maximum(2e4 * J, 2e4 * J - 1e4 * (J - 1))
    assert bool((bound >= least * (1 - 1e-12)).all() and (bound <= 1.1 * least).all())
    F = deformations(2, device)
    half = mpm.CustomLaw(lambda F: (0.5 * F, neo_hookean(0.5 * F)))  # flows again from half: it is never elastic
    torch.testing.assert_close(half.stiffness(state_of(F)), mpm.CustomLaw(neo_hookean).stiffness(state_of(0.25 * F)))


def test_deformations_without_meaning_have_no_stiffness(device, dim):
    eye = torch.eye(dim, dtype=torch.float64, device=device)
    F = eye.repeat(5, 1, 1)
    F[1, 0, 0], F[2, 0, 0], F[3, 0, 1] = -1, 0, torch.nan
    for law in (mpm.CustomLaw(neo_hookean), mpm.CustomPrincipalLaw(neo_hookean_stretches)):
        bound = law.stiffness(state_of(F))
        assert bool((bound[1:4] == 0).all()) and float(bound[0]) == float(bound[4]) > 0
    constant = mpm.CustomLaw(lambda F: torch.zeros_like(F))
    assert float(constant.stiffness(state_of(F)).abs().max()) == 0
