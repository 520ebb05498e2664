"""Laws: energy, stress, wave speed, their gradients, and the modules around them."""

import math

import pytest
import torch
from helpers import OpNames, relative_error
from oracle import material as reference
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import ops

LAWS = sorted(reference.LAWS)
SCENES = 3


def deformations(count: int, dim: int, spread: float = 0.3, generator: torch.Generator | None = None) -> Tensor:
    """Random F of positive determinant, far from degenerate."""
    generator = generator or torch.Generator().manual_seed(3)
    F = torch.eye(dim, dtype=torch.float64) + spread * torch.randn(
        4 * count, dim, dim, generator=generator, dtype=torch.float64
    )
    return F[torch.linalg.det(F) > 0.2][:count]


def arguments(
    law: str, dim: int, count: int = 9, shape: str = "particle"
) -> tuple[Tensor, list[Tensor], Tensor | None, Tensor]:
    """State, parameters of the given kind, C (of a viscous law) and scene."""
    generator = torch.Generator().manual_seed(5)
    info = reference.LAWS[law]
    F = deformations(count, dim)
    size: tuple[int, ...] = {"scalar": (), "one": (1,), "scene": (SCENES,), "particle": (count,)}[shape]
    parameters = [0.5 + torch.rand(size, generator=generator, dtype=torch.float64) for _ in info.parameters]
    C = torch.randn(count, dim, dim, generator=generator, dtype=torch.float64) if info.viscous else None
    scene = torch.arange(count).remainder(SCENES).flip(0).int()
    return F if info.shear else torch.linalg.det(F), parameters, C, scene


def state_of(F: Tensor | None = None, J: Tensor | None = None, dim: int = 3, **fields: Tensor) -> mpm.State:
    like = F if F is not None else J
    assert like is not None
    P, D = like.shape[0], dim if F is None else F.shape[1]
    one = torch.ones(P, dtype=like.dtype, device=like.device)
    x = torch.zeros(P, D, dtype=like.dtype, device=like.device)
    return mpm.State(x=x, v=x, mass=1000 * one, volume=one, F=F, J=J, **fields)


# ---- formulas


@pytest.mark.parametrize("shape", ["scalar", "one", "scene", "particle"])
@pytest.mark.parametrize("law", LAWS)
def test_stress_and_energy_equal_the_reference(law: str, shape: str, dim: int, device: str) -> None:
    state, parameters, C, scene = arguments(law, dim, count=37, shape=shape)
    given = (law, state.to(device), [p.to(device) for p in parameters])
    others = {"scene": scene.to(device), "dim": dim}
    stress = ops.law_update(*given, C=None if C is None else C.to(device), **others).stress
    energy = ops.law_energy(*given, **others)
    assert relative_error(stress, reference.stress(law, state, parameters, C, scene, dim)) < 1e-13
    assert relative_error(energy, reference.energy(law, state, parameters, scene, dim)) < 1e-12


@pytest.mark.parametrize("law", ["neo_hookean", "weakly_compressible"])
def test_stress_is_the_derivative_of_the_energy(law: str, dim: int, device: str) -> None:
    """τ = ∂ψ/∂F Fᵀ, and τ = J ψ'(J) I for a fluid."""
    state, parameters, _, _ = arguments(law, dim, count=20)
    state, parameters = state.to(device).requires_grad_(), [p.to(device) for p in parameters]
    (gradient,) = torch.autograd.grad(ops.law_energy(law, state, parameters, dim=dim).sum(), state)
    stress = ops.law_update(law, state, parameters, dim=dim).stress
    if law == "neo_hookean":
        expected = gradient @ state.mT
    else:
        expected = (state * gradient)[:, None, None] * torch.eye(dim, dtype=state.dtype, device=device)
    assert relative_error(stress, expected) < 1e-13


@pytest.mark.parametrize("gamma", [1.0, 1.0 + 1e-9, 1.4, 7.0])
def test_fluid_energy_is_the_integral_of_the_pressure(gamma: float) -> None:
    """∫ p dV from rest, by Gauss-Legendre quadrature."""
    import numpy as np

    J = torch.tensor([0.2, 0.9, 1.0001, 1.5], dtype=torch.float64)
    K = 3.0
    nodes, weights = np.polynomial.legendre.leggauss(60)
    points = 1 + (J[:, None] - 1) * (torch.tensor(nodes) + 1) / 2
    integral = (K / gamma * (points**-gamma - 1) * torch.tensor(weights)).sum(1) * (J - 1) / 2
    energy = mpm.WeaklyCompressible(K, gamma).energy_density(state_of(J=J))
    assert torch.allclose(energy, -integral, rtol=1e-8, atol=1e-20)


def test_linear_fluid_and_speed_of_sound(device: str) -> None:
    J = torch.tensor([0.3, 0.99, 1.0, 1.2], dtype=torch.float64, device=device)
    law = mpm.WeaklyCompressible(bulk_modulus=400.0, gamma=1)
    expected = 400 * (J - 1)[:, None, None] * torch.eye(2, dtype=torch.float64, device=device)
    assert torch.allclose(law.stress(state_of(J=J, dim=2)), expected, rtol=1e-12)
    water = mpm.WeaklyCompressible(bulk_modulus=2.2e9)
    assert torch.allclose(water.wave_speed(state_of(J=torch.ones(2))), torch.tensor(math.sqrt(2.2e6)))


def test_viscous_stress_is_deviatoric_and_newtonian(dim: int, device: str) -> None:
    """Simple shear at rate g has the shear stress η g; a uniform expansion has none."""
    C = torch.zeros(2, dim, dim, dtype=torch.float64, device=device)
    C[0, 0, 1] = 3.0
    C[1] = torch.eye(dim, dtype=torch.float64, device=device)
    law = mpm.WeaklyCompressible(bulk_modulus=1e3, viscosity=0.2)
    stress = law.stress(state_of(J=torch.ones(2, dtype=torch.float64, device=device), dim=dim, C=C))
    expected = torch.zeros_like(stress)
    expected[0, 0, 1] = expected[0, 1, 0] = 0.6
    assert torch.allclose(stress, expected, atol=1e-14)
    assert law.stress(state_of(J=torch.ones(2, device=device), dim=dim)).abs().max() == 0  # no C: at rest


def test_objectivity_and_isotropy(dim: int, device: str) -> None:
    """τ(Q F) = Q τ(F) Qᵀ and τ(F Q) = τ(F) for rotations Q."""
    F = deformations(30, dim).to(device)
    skew = torch.randn(30, dim, dim, dtype=torch.float64, device=device)
    Q = torch.linalg.matrix_exp(skew - skew.mT)
    law = mpm.NeoHookean(E=3.0, nu=0.3)
    tau = law.stress(state_of(F))
    assert relative_error(law.stress(state_of(Q @ F)), Q @ tau @ Q.mT) < 1e-13
    assert relative_error(law.stress(state_of(F @ Q)), tau) < 1e-13
    assert torch.equal(tau, tau.mT)


def test_small_strain_is_linear_elasticity(dim: int, device: str) -> None:
    E, nu = 2.0, 0.3
    H = 1e-7 * torch.randn(20, dim, dim, dtype=torch.float64)
    F = torch.eye(dim, dtype=torch.float64) + H
    strain = (H + H.mT) / 2
    lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    trace = strain.diagonal(dim1=1, dim2=2).sum(1)
    expected = 2 * mu * strain + lam * trace[:, None, None] * torch.eye(dim, dtype=torch.float64)
    assert relative_error(mpm.NeoHookean(E=E, nu=nu).stress(state_of(F.to(device))), expected) < 1e-6


@pytest.mark.parametrize("strain", [1e-6, 1e-3, 0.3])
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_float32_precision(strain: float, nu: float, dim: int, device: str) -> None:
    """Forward and backward against float64 at the same rounded F, relative to each particle's own stress."""
    F = deformations(2000, dim, strain).float()
    grad = torch.randn(F.shape)
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = F.to(device, dtype).requires_grad_()
        stress = mpm.NeoHookean(E=1e6, nu=nu).stress(state_of(leaf))
        (back,) = torch.autograd.grad(stress, leaf, grad.to(device, dtype))
        results.append((stress.detach().double(), back.double()))
    for value, exact in zip(*results, strict=True):
        error = (value - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))
        assert error.max() < 5e-6


@pytest.mark.parametrize("stretch", [0.05, 0.5, 20.0])
def test_float32_precision_at_large_strain(stretch: float, dim: int, device: str) -> None:
    F = stretch * deformations(200, dim, 0.1).float()
    law = mpm.NeoHookean(E=1e6, nu=0.3)
    exact = law.stress(state_of(F.double().to(device)))
    error = (law.stress(state_of(F.to(device))) - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))
    assert error.max() < 5e-6


@pytest.mark.parametrize("volume", [1 - 1e-5, 1 + 3e-4, 0.05, 0.6, 20.0])
def test_fluid_float32_precision(volume: float, device: str) -> None:
    J = torch.full((40,), volume, device=device)
    law = mpm.WeaklyCompressible(2e6)
    exact = law.stress(state_of(J=J.double()))
    assert relative_error(law.stress(state_of(J=J)), exact) < 5e-6
    assert relative_error(law.energy_density(state_of(J=J)), law.energy_density(state_of(J=J.double()))) < 1e-6


# ---- waves and stiffness


def second_variation(F: Tensor, mu: float, lam: float) -> Tensor:
    """∂²ψ/∂F∂F : (G F)(G F) as a matrix over G, by automatic differentiation of the reference energy, [D², D²]."""
    values = [torch.tensor([v], dtype=torch.float64) for v in (mu, lam)]
    D = F.shape[0]

    def energy(G: Tensor) -> Tensor:
        deformed = (torch.eye(D, dtype=torch.float64) + G.reshape(D, D)) @ F
        return reference.LAWS["neo_hookean"].energy(deformed[None], None, *values, dim=D).sum()

    return torch.autograd.functional.hessian(energy, torch.zeros(D * D, dtype=torch.float64))


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49, -0.4])
def test_wave_speed_and_stiffness_against_the_hessian_of_the_energy(nu: float, dim: int, device: str) -> None:
    """The acoustic tensor n·A·n over many directions n, and A over all velocity gradients G."""
    lam, mu = nu / ((1 + nu) * (1 - 2 * nu)), 1 / (2 * (1 + nu))
    n = torch.nn.functional.normalize(torch.randn(2000, dim, dtype=torch.float64), dim=1)
    law = mpm.NeoHookean(mu=mu, lam=lam)
    F = torch.cat(
        [deformations(6, dim, 0.5), torch.diag_embed(torch.tensor([[0.05] * dim, [20.0] + [0.3] * (dim - 1)]).double())]
    )
    waves, stiffness = law.wave_modulus(state_of(F.to(device))).cpu(), law.stiffness(state_of(F.to(device))).cpu()
    for Fp, wave, bound in zip(F, waves, stiffness, strict=True):
        A = second_variation(Fp, mu, lam)
        acoustic = torch.einsum("ijkl,pj,pl->pik", A.reshape(dim, dim, dim, dim), n, n)
        fastest = torch.linalg.eigvalsh(acoustic).max()
        assert fastest * (1 - 1e-12) <= wave <= 4 / 3 * fastest + 1e-9
        if dim == 2:
            assert wave == pytest.approx(float(fastest), rel=1e-4)
        assert bound >= torch.linalg.eigvalsh(A).max() * (1 - 1e-12)
        assert bound >= wave * (1 - 1e-12)
    at_rest = law.stiffness(state_of(torch.eye(dim, dtype=torch.float64)[None]))
    assert float(at_rest) == pytest.approx(2 * mu + max(0, dim * lam), rel=1e-12)


def test_wave_speed_depends_on_strain(device: str) -> None:
    """At rest √((λ + 2μ)/ρ) of the notes; along a stretch s more: √((μ s² + μ + λ (1 − ln s))/ρ)."""
    F = torch.eye(3, dtype=torch.float64, device=device).repeat(2, 1, 1)
    F[1, 0, 0] = 2.0
    law = mpm.NeoHookean(mu=3e5, lam=4e5)
    speed = law.wave_speed(state_of(F))
    assert speed[0].item() == pytest.approx(math.sqrt(1e6 / 1000))
    assert speed[1].item() == pytest.approx(math.sqrt((3e5 * 4 + 3e5 + 4e5 * (1 - math.log(2))) / 1000))


# ---- gradients


@pytest.mark.parametrize(*in_pairs(shape=["scalar", "scene", "particle"], law=LAWS, dim=[2, 3]))
def test_first_and_second_derivatives(law: str, shape: str, dim: int, device: str) -> None:
    state, parameters, C, scene = arguments(law, dim, count=2, shape=shape)
    scene = scene.to(device)
    count = len(parameters)
    inputs = [state, *parameters, *([] if C is None else [C])]
    inputs = [t.to(device).requires_grad_() for t in inputs]

    def stress(state: Tensor, *rest: Tensor) -> Tensor:
        rate = rest[count] if C is not None else None
        return ops.law_update(law, state, rest[:count], C=rate, scene=scene, dim=dim).stress

    def energy(state: Tensor, *rest: Tensor) -> Tensor:
        return ops.law_energy(law, state, rest[:count], scene=scene, dim=dim)

    assert torch.autograd.gradcheck(stress, inputs)
    assert torch.autograd.gradgradcheck(stress, inputs)
    assert torch.autograd.gradcheck(energy, inputs[: count + 1])
    assert torch.autograd.gradgradcheck(energy, inputs[: count + 1])


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("law", LAWS)
def test_opcheck(law: str, dim: int, device: str) -> None:
    state, parameters, C, scene = arguments(law, dim, count=5, shape="scene")
    state, scene = state.to(device).requires_grad_(), scene.to(device)
    parameters = [p.to(device).requires_grad_() for p in parameters]
    C = None if C is None else C.to(device).requires_grad_()
    namespace = torch.ops.torch_mpm
    checks = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")
    update, energy = (state, C, parameters, [], scene, law, dim, 0, 7), (state, parameters, [], scene, law, dim)
    torch.library.opcheck(namespace.law_update.default, update, test_utils=checks)
    torch.library.opcheck(namespace.law_energy.default, energy, test_utils=checks)
    with torch.no_grad():
        state, values, C = state.detach(), [p.detach() for p in parameters], None if C is None else C.detach()
        grad = torch.randn(5, dim, dim, dtype=torch.float64, device=device)
        by_parameters = torch.randn(5, len(values), dtype=torch.float64, device=device)
        nothing, rest = (None, None, None), (scene, law, dim)
        for op, given in (
            (namespace.law_update_backward, (None, grad, *nothing, state, C, values, [], *rest, 0, 7)),
            (namespace.law_update_double_backward, (state, C, by_parameters, grad, state, C, values, *rest, 7)),
            (namespace.law_energy_backward, (grad[:, 0, 0], state, values, [], *rest, 5)),
            (namespace.law_energy_double_backward, (state, by_parameters, grad[:, 0, 0], state, values, *rest, 5)),
            (namespace.law_stiffness, (state, values, [], *rest)),
            (namespace.law_wave_modulus, (state, values, [], *rest)),
        ):
            torch.library.opcheck(op.default, given)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 100])
@pytest.mark.parametrize("law", LAWS)
def test_memory_layout_and_number_of_particles_do_not_matter(law: str, count: int, device: str) -> None:
    state, parameters, C, _ = arguments(law, 3, count=count)
    state, parameters, C = (
        state.float().to(device),
        [p.float().to(device) for p in parameters],
        None if C is None else C.float().to(device),
    )
    expected = ops.law_update(law, state, parameters, C=C, dim=3).stress
    assert expected.stride(0) == 1 and expected.stride(1) == 3 * expected.stride(2) >= 3 * count

    def spread(t: Tensor) -> Tensor:
        """The same values, structure of arrays and every second row of a larger tensor."""
        wide = t.new_full((*t.shape[1:], 2 * max(count, 1)), torch.nan)
        wide[..., 0 : 2 * count : 2] = t.permute(*range(1, t.dim()), 0)
        return wide[..., 0 : 2 * count : 2].permute(t.dim() - 1, *range(t.dim() - 1))

    result = ops.law_update(
        law, spread(state), [spread(p) for p in parameters], C=None if C is None else spread(C), dim=3
    )
    assert torch.equal(result.stress, expected)
    for p in range(0, count, 7):  # alone, not in the lanes of a pack
        rate = None if C is None else C[p : p + 1]
        alone = ops.law_update(law, state[p : p + 1], [q[p : p + 1] for q in parameters], C=rate, dim=3).stress
        assert torch.allclose(alone[0], expected[p], rtol=2e-6, atol=1e-6)


def test_wave_speed_refuses_gradients_and_vmap(device: str) -> None:
    F = deformations(3, 3).to(device).requires_grad_()
    law = mpm.NeoHookean(E=1.0, nu=0.3)
    with pytest.raises(NotImplementedError, match="not differentiable"):
        law.wave_speed(state_of(F)).sum().backward()
    mu = torch.ones(2, 3, dtype=torch.float64, device=device)
    with pytest.raises(NotImplementedError, match="pack the scenes"):
        torch.vmap(lambda m: ops.law_update("neo_hookean", F.detach(), (m, m)).stress)(mu)


def test_compiles_to_one_graph(device: str) -> None:
    law = mpm.NeoHookean(E=torch.nn.Parameter(torch.tensor(2.0, device=device)), nu=0.3)

    def loss(F: Tensor) -> Tensor:
        return law.stress(state_of(F)).square().sum()

    F = deformations(8, 3).float().to(device).requires_grad_()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for function in (compiled, loss):
        F.grad = law.E.grad = None
        value = function(F)
        value.backward()
        results = [value.detach(), F.grad, law.E.grad]
        if function is compiled:
            first = results
    for a, b in zip(first, results, strict=True):
        assert torch.allclose(a, b)


# ---- particles without meaning


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_inverted_and_not_finite_particles_have_no_stress(dtype: torch.dtype, dim: int, device: str) -> None:
    good = torch.eye(dim, dtype=dtype) * 1.1
    flipped = torch.diag(torch.tensor([-1.0] + [1.0] * (dim - 1), dtype=dtype))
    flat = torch.diag(torch.tensor([0.0] + [1.0] * (dim - 1), dtype=dtype))
    F = torch.stack(
        [good, flipped, good, flat, torch.full_like(good, torch.nan), torch.full_like(good, torch.inf), good]
    )
    F = F.repeat(5, 1, 1).to(device)
    valid = torch.tensor([True, False, True, False, False, False, True], device=device).repeat(5)
    leaf, E = F.clone().requires_grad_(), torch.tensor(2.0, dtype=dtype, device=device, requires_grad=True)
    law = mpm.NeoHookean(E=E, nu=0.3)
    stress = law.stress(state_of(leaf))
    assert bool((stress[~valid] == 0).all()) and bool((stress[valid] != 0).any(2).any(1).all())
    stress.sum().backward()
    assert bool((leaf.grad[~valid] == 0).all()) and bool(leaf.grad.isfinite().all()) and bool(E.grad.isfinite())
    assert torch.equal(law.invalid(state_of(F)), ~valid)
    assert bool((law.stiffness(state_of(F))[~valid] == 0).all())
    custom = mpm.CustomLaw(lambda F: F)
    assert torch.equal(custom.invalid(state_of(F)), ~valid)


def test_fluid_of_no_volume_has_no_stress(device: str) -> None:
    J = torch.tensor([1.1, 0.0, -0.1, torch.nan, torch.inf, 0.9], device=device)
    law = mpm.WeaklyCompressible(1e3, viscosity=0.1)
    C = torch.ones(6, 3, 3, device=device)
    valid = torch.tensor([True, False, False, False, False, True], device=device)
    stress = law.stress(state_of(J=J, C=C))
    assert bool((stress[~valid] == 0).all()) and bool((stress[valid] != 0).any())
    assert torch.equal(law.invalid(state_of(J=J)), ~valid)


@pytest.mark.parametrize("E", [1e-30, 1e30])
def test_extreme_stiffness(E: float, device: str) -> None:
    F = deformations(5, 3, 0.01).float().to(device)
    exact = E * mpm.NeoHookean(E=1.0, nu=0.3).stress(state_of(F.double()))
    assert relative_error(mpm.NeoHookean(E=E, nu=0.3).stress(state_of(F)), exact) < 1e-5


def test_stress_that_overflows_is_reported_and_does_no_harm(device: str) -> None:
    F = 1e6 * torch.eye(3, device=device)[None]
    law = mpm.NeoHookean(E=1e30, nu=0.3)
    assert law.stress(state_of(F)).abs().max() == 0
    assert bool(law.invalid(state_of(F)))


def test_solid_without_shear_stiffness_is_a_fluid(dim: int, device: str) -> None:
    F = deformations(5, dim).to(device)
    stress = mpm.NeoHookean(mu=0.0, lam=2.0).stress(state_of(F))
    expected = 2 * torch.linalg.det(F).log()[:, None, None] * torch.eye(dim, dtype=F.dtype, device=device)
    assert torch.allclose(stress, expected, rtol=1e-12, atol=1e-14)


# ---- modules


def test_parameters_of_every_shape(device: str) -> None:
    F = deformations(6, 3).to(device)
    scene = torch.tensor([2, 0, 1, 1, 0, 2], dtype=torch.int32, device=device)
    per_scene = torch.tensor([1.0, 2.0, 3.0], device=device)
    state = state_of(F, scene=scene)
    expected = torch.cat(
        [mpm.NeoHookean(E=float(per_scene[s]), nu=0.3).stress(state_of(F[i : i + 1])) for i, s in enumerate(scene)]
    )
    for E in (per_scene, per_scene[scene], per_scene.double()):
        assert torch.allclose(mpm.NeoHookean(E=E, nu=0.3).stress(state), expected, rtol=1e-6)


def test_gradients_reach_the_parameters_of_each_scene(device: str) -> None:
    """∂τ/∂E = τ/E, since τ is linear in E."""
    F = deformations(6, 3).to(device)
    scene = torch.tensor([2, 0, 1, 1, 0, 2], dtype=torch.int32, device=device)
    E = torch.nn.Parameter(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64, device=device))
    law = mpm.NeoHookean(E=E, nu=0.3)
    assert list(law.parameters()) == [E]
    stress = law.stress(state_of(F, scene=scene))
    stress.sum().backward()
    expected = torch.zeros(3, dtype=torch.float64, device=device).index_add_(0, scene, stress.detach().sum((1, 2)))
    assert torch.allclose(E.grad, expected / E.detach(), rtol=1e-12)


def test_parameters_per_particle_follow_a_reordering(device: str) -> None:
    F = deformations(6, 3).to(device)
    E = torch.linspace(1, 2, 6, dtype=torch.float64, device=device)
    law = mpm.NeoHookean(E=E, nu=0.3)
    order = torch.tensor([3, 1, 5, 0, 2, 4], device=device)
    stress = law.stress(state_of(F))
    assert torch.equal(law.stress(state_of(F[order], ids=order)), stress[order])
    assert torch.equal(law.stress(state_of(F)), stress)  # the kept parameters are those of this order again


def test_converted_parameters_are_kept_until_something_changes(device: str) -> None:
    E = torch.tensor([1.0, 2.0], device=device)
    law = mpm.NeoHookean(E=E, nu=0.3)
    state = state_of(
        torch.eye(3, device=device).repeat(4, 1, 1) * 1.1,
        scene=torch.tensor([0, 1, 0, 1], dtype=torch.int32, device=device),
    )
    with OpNames() as once:
        first = law.stress(state)
    with OpNames() as again:
        law.stress(state)
    assert len(again.seen) < len(once.seen)  # parameters are converted once
    E.mul_(2)
    assert torch.allclose(law.stress(state), 2 * first)
    law.nu = 0.4
    assert torch.allclose(law.stress(state), mpm.NeoHookean(E=E, nu=0.4).stress(state))
    assert law.stress(state.to(dtype=torch.float64)).dtype == torch.float64


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: mpm.NeoHookean(E=1.0), "E and nu, or mu and lam, got E"),
        (lambda: mpm.NeoHookean(), "got nothing"),
        (lambda: mpm.NeoHookean(E=1.0, nu=0.3, mu=1.0), "got E, nu, mu"),
        (lambda: mpm.NeoHookean(E=-1.0, nu=0.3), "E must be finite and not negative, got -1.0"),
        (lambda: mpm.NeoHookean(E=1.0, nu=0.5), "nu must be between -1 and 0.5, got 0.5"),
        (lambda: mpm.NeoHookean(E=1.0, nu=torch.tensor([0.1, 0.5])), "nu must be between -1 and 0.5"),
        (lambda: mpm.NeoHookean(E=float("nan"), nu=0.1), "E must be finite"),
        (
            lambda: mpm.NeoHookean(E=torch.ones(2, 2), nu=0.1),
            r"E must be a number or a floating tensor .* got \[2, 2\]",
        ),
        (
            lambda: mpm.NeoHookean(E=torch.ones(2), nu=torch.full((3,), 0.1)),
            r"one shape where both vary, got \[2\] and \[3\]",
        ),
        (lambda: mpm.WeaklyCompressible(1e5, gamma=0), "gamma must be positive, got 0"),
        (lambda: mpm.WeaklyCompressible(1e5, viscosity=-1), "viscosity must be finite and not negative"),
        (lambda: mpm.CustomLaw(lambda F: F, state_field="C"), "state_field must be 'F' or 'J', got 'C'"),
        (lambda: mpm.Mixture([]), "at least one law"),
    ],
)
def test_bad_parameters(build: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()  # type: ignore[operator]


def test_bad_arguments() -> None:
    stress = ops.law_update
    F, J, one = torch.eye(3).repeat(10, 1, 1), torch.ones(10), torch.ones(1)
    pair, four, scene = (one, one), torch.ones(4), torch.zeros(10, dtype=torch.int32)
    solid, fluid, viscous = "neo_hookean", "weakly_compressible", "viscous_fluid"
    without_F = state_of(J=J)
    for error, message, call in (
        (ValueError, "law must be one of", lambda: stress("rubber", F, pair)),
        (
            ValueError,
            r"F must have shape \[P, 3, 3\] or \[P, 2, 2\], got \[10, 3\]",
            lambda: stress(solid, F[:, 0], pair),
        ),
        (ValueError, r"J must have shape \[P\], got \[10, 3, 3\]", lambda: stress(fluid, F, pair, dim=3)),
        (ValueError, "dim must be 2 or 3, got None", lambda: stress(fluid, J, pair)),
        (TypeError, r"must be float32 or float64, got torch\.int64", lambda: stress(solid, F.long(), pair)),
        (ValueError, "has the parameters mu, lam, got 1", lambda: stress(solid, F, (one,))),
        (ValueError, r"lam must have shape .* without scene, got \[4\]", lambda: stress(solid, F, (one, four))),
        (TypeError, "mu must have the dtype", lambda: stress(solid, F, (one.double(), one))),
        (ValueError, r"scene must have shape \[10\], got \[9\]", lambda: stress(solid, F, pair, scene=scene[1:])),
        (TypeError, r"scene must be int32, got torch\.int64", lambda: stress(solid, F, pair, scene=scene.long())),
        (ValueError, "neo_hookean has no viscosity", lambda: stress(solid, F, pair, C=F)),
        (ValueError, r"C must have shape .* got \[9, 3, 3\]", lambda: stress(viscous, J, (one, *pair), C=F[1:], dim=3)),
        (ValueError, r"needs state\.F, which is None", lambda: mpm.NeoHookean(E=1.0, nu=0.3).stress(without_F)),
    ):
        with pytest.raises(error, match=message):
            call()


def test_scene_ids_out_of_range_do_not_read_outside(device: str) -> None:
    """An absent particle, of a negative scene, does no harm. A scene without a value is an error; where nothing waits
    for the device, its particles are invalid."""
    F = 1.1 * torch.eye(3, device=device).repeat(4, 1, 1)
    E, law = torch.tensor([1.0, 2.0], device=device), mpm.NeoHookean(E=torch.tensor([1.0, 2.0], device=device), nu=0.3)
    scene = torch.tensor([0, 1, -5, -(2**31)], dtype=torch.int32, device=device)
    stress = law.stress(state_of(F, scene=scene))
    assert torch.equal(stress[2], stress[0]) and torch.equal(stress[3], stress[0])
    beyond = scene.where(scene != 1, 2**30)
    with pytest.raises(ValueError, match=r"^E must have shape .*got \[2\]"):
        law.stress(state_of(F, scene=beyond))
    if device == "cpu":
        with pytest.raises(ValueError, match=r"^mu must have .* got \[2\] with B at least 1073741825$"):
            ops.law_energy("neo_hookean", F, [E, E], scene=beyond)
    else:
        assert ops.law_energy("neo_hookean", F, [E, E], scene=beyond).isfinite().tolist() == [True, False, True, True]


def test_a_module_in_place_of_a_law(device: str) -> None:
    """The same law in torch code has the same stress and gradients; a plastic one may change F."""
    law = mpm.NeoHookean(mu=2.0, lam=3.0)

    class Network(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.mu = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64, device=device))

        def forward(self, F: Tensor) -> Tensor:
            identity = torch.eye(3, dtype=F.dtype, device=F.device)
            return self.mu * (F @ F.mT - identity) + 3.0 * torch.linalg.det(F).log()[:, None, None] * identity

    custom = mpm.CustomLaw(Network(), stiffness=10.0)
    F = deformations(5, 3).to(device)
    fields, stress = custom.update(state_of(F))
    assert fields == {} and relative_error(stress, law.stress(state_of(F))) < 1e-13
    stress.sum().backward()
    assert custom.function.mu.grad is not None and len(list(custom.parameters())) == 1
    assert torch.equal(custom.stiffness(state_of(F)), torch.full((5,), 10.0, dtype=torch.float64, device=device))

    halved = mpm.CustomLaw(lambda F: (0.5 * F, F))
    fields, _ = halved.update(state_of(F))
    assert torch.equal(fields["F"], 0.5 * F)
    with pytest.raises(ValueError, match=r"must return stress of shape \[5, 3, 3\], got \[5\]"):
        mpm.CustomLaw(lambda F: F[:, 0, 0]).update(state_of(F))


def test_mixture_equals_its_laws(device: str) -> None:
    F = deformations(8, 3).to(device)
    J = torch.linspace(0.9, 1.2, 8, dtype=torch.float64, device=device)
    material = torch.tensor([0, 1, 2, 0, 2, 1, 0, 1], dtype=torch.int32, device=device)
    scene = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1], dtype=torch.int32, device=device)
    C = torch.randn(8, 3, 3, dtype=torch.float64, device=device)
    per_particle = torch.linspace(1, 2, 8, dtype=torch.float64, device=device)
    per_scene = torch.tensor([1.0, 2.0], dtype=torch.float64, device=device)
    laws = [
        mpm.NeoHookean(E=per_particle, nu=0.3),
        mpm.WeaklyCompressible(per_scene, viscosity=0.1),
        mpm.CustomLaw(lambda F: (0.5 * F, 3 * F), stiffness=2.0),
    ]
    mixture = mpm.Mixture(laws)
    assert mixture.state_fields == ("F", "J") and mixture.viscous
    state = state_of(F, J=J, scene=scene, C=C, material=material)
    fields, stress = mixture.update(state)
    for k, law in enumerate(laws):
        chosen = material == k
        whole_fields, whole = law.update(state)
        assert torch.allclose(stress[chosen], whole[chosen], rtol=1e-13)
        assert torch.allclose(mixture.stiffness(state)[chosen], law.stiffness(state)[chosen], rtol=1e-13)
        assert torch.equal(fields["F"][chosen], whole_fields.get("F", F)[chosen])
    assert "J" not in fields
    viscosity = mixture.viscosity(state)
    assert torch.allclose(viscosity, torch.where(material == 1, 0.1 * J, 0))
    assert not bool(mixture.invalid(state).any())

    order = torch.tensor([7, 3, 1, 0, 6, 2, 5, 4], device=device)
    assert torch.allclose(
        mixture.stress(state.replace(ids=torch.arange(8, device=device)).select(order)), stress[order]
    )
    leaf = F.clone().requires_grad_()
    (grad,) = torch.autograd.grad(mixture.stress(state.replace(F=leaf)).sum(), leaf)
    assert bool((grad[material == 1] == 0).all()) and bool((grad[material == 0] != 0).any())


def test_mixture_needs_materials_in_range() -> None:
    F = torch.eye(2).repeat(3, 1, 1)
    mixture = mpm.Mixture([mpm.NeoHookean(E=1.0, nu=0.3)])
    with pytest.raises(ValueError, match=r"needs state\.material"):
        mixture.stress(state_of(F))
    with pytest.raises(ValueError, match=r"state\.material must be in 0 \.\. 0, got \[0, 1\]"):
        mixture.stress(state_of(F, material=torch.tensor([0, 1, 0], dtype=torch.int32)))
