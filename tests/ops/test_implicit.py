"""The tangents of laws, and the Hessian of an implicit step: against automatic differentiation in float64."""

import itertools

import pytest
import torch
from helpers import random_particles, relative_error
from oracle import implicit as oracle
from oracle import material
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import ops
from torch_mpm.implicit.mirrors import Mirrors
from torch_mpm.ops.implicit import CONVERGED, NEGATIVE_CURVATURE, from_upper, tangent_entries, to_upper

PARAMETERS = {
    "neo_hookean": (2.0, 3.0),
    "hencky": (2.0, 3.0),
    "fixed_corotated": (2.0, 3.0),
    "weakly_compressible": (5.0, 7.0),
    "snow": (2.0, 3.0, 0.02, 0.01, 5.0),
    "von_mises": (2.0, 3.0, 0.1, 0.5),
    "sand_full": (2.0, 3.0, 0.3, 0.0, 1e-3, 0.0, 0.0, 0.0),
    "sand_unilateral": (2.0, 3.0, 0.3, 0.0, 1e-3, 0.0, 0.0, 0.0),
    "sand_hencky": (2.0, 3.0, 0.3, 0.0, 1e-3, 0.0, 0.0, 0.0),
}
ERROR = {torch.float32: 3e-6, torch.float64: 1e-13}


def product(tangent: Tensor, L: Tensor) -> Tensor:
    """The tangents of csrc/laws/tangent.h along L [P, D, D], in plain torch."""
    P, D, _ = L.shape
    U, B, rest = tangent.split([D * D, D * D, tangent.shape[1] - 2 * D * D], 1)
    U, B = U.reshape(P, D, D), B.reshape(P, D, D)
    diagonal, even, odd = rest.split([D * (D + 1) // 2, D * (D - 1) // 2, D * (D - 1) // 2], 1)
    M = U.mT @ L @ B
    result = torch.diag_embed((from_upper(diagonal, D) @ M.diagonal(dim1=1, dim2=2)[:, :, None])[:, :, 0])
    for k, (i, j) in enumerate(itertools.combinations(range(D), 2)):
        symmetric, skew = even[:, k] * (M[:, i, j] + M[:, j, i]) / 2, odd[:, k] * (M[:, i, j] - M[:, j, i]) / 2
        result[:, i, j], result[:, j, i] = symmetric + skew, symmetric - skew
    return U @ result @ B.mT


def matrix(tangent: Tensor, dim: int) -> Tensor:
    """The same as matrices [P, D², D²]."""
    basis = torch.eye(dim * dim, dtype=tangent.dtype, device=tangent.device).reshape(-1, dim, dim)
    return torch.stack([product(tangent, L.expand(len(tangent), dim, dim)).flatten(1) for L in basis], 2)


class Trial:
    """Trial deformations of a law: at rest, with two and with all stretches alike, turned, compressed, at random."""

    def __init__(self, law: str, dim: int, device: str, dtype: torch.dtype = torch.float64) -> None:
        self.law, self.dim = law, dim
        eye = torch.eye(dim, dtype=torch.float64)
        F = (eye + 0.2 * torch.randn(7, dim, dim)).double()
        F[0], F[1], F[2] = eye, 0.8 * eye, torch.diag(torch.tensor([1.1, 0.7, 0.7][:dim]))
        move = 0.1 * torch.randn(7, dim, dim).double()
        move[:3] = 0
        if ops.LAWS[law].field == "J":
            F, move = torch.linalg.det(F), move.diagonal(dim1=1, dim2=2).sum(1)
            self.state, self.before = F + move * F, F
        else:
            self.state, self.before = F + move @ F, F
        self.weight = 0.5 + torch.rand(7).double()
        self.parameters = [torch.tensor(p, dtype=torch.float64) for p in PARAMETERS[law]]
        self.history = [torch.full((7,), 0.05, dtype=torch.float64) for _ in ops.LAWS[law].history_with(())]
        for name in ("state", "before", "weight"):
            setattr(self, name, getattr(self, name).to(device, dtype))
        for name in ("parameters", "history"):
            setattr(self, name, [t.to(device, dtype) for t in getattr(self, name)])

    def tangent(self, projected: bool) -> Tensor:
        return ops.law_tangent(
            *(self.law, self.state, self.before, self.weight, self.parameters, self.history, None, self.dim, projected)
        )

    def stress(self, L: Tensor) -> Tensor:
        """dP F₀ᵀ where the trial state has moved by L."""
        moved = self.state + (
            self.before * L.diagonal(dim1=1, dim2=2).sum(1) if self.state.dim() == 1 else L @ self.before
        )
        gradient = ops.law_energy_gradient(self.law, moved, self.parameters, self.history, None, self.dim)
        if gradient.dim() == 3:
            return gradient @ self.before.mT
        return (gradient * self.before)[:, None, None] * torch.eye(self.dim).to(gradient)


@pytest.mark.parametrize("law", PARAMETERS)
def test_tangent_is_the_derivative_of_the_stress(law, dim, device):
    """Central differences of ∂ψ/∂F, which the tests of laws check against the energy."""
    trial = Trial(law, dim, device)
    L, h = torch.randn(7, dim, dim).double().to(device), 1e-6
    difference = trial.weight[:, None, None] * (trial.stress(h * L) - trial.stress(-h * L)) / (2 * h)
    scale = matrix(trial.tangent(False), dim).norm(dim=(1, 2)).clamp_min(1)  # moduli are of order one
    error = (product(trial.tangent(False), L) - difference).norm(dim=(1, 2)) / (scale * L.norm(dim=(1, 2)))
    assert error.max() < 1e-8


@pytest.mark.parametrize("law", PARAMETERS)
def test_projection_takes_negative_eigenvalues_alone(law, dim, device):
    trial = Trial(law, dim, device)
    exact, projected = matrix(trial.tangent(False), dim), matrix(trial.tangent(True), dim)
    scale = exact.norm(dim=(1, 2)).clamp_min(1e-6)
    assert ((exact - exact.mT).norm(dim=(1, 2)) / scale).max() < 1e-13
    assert (torch.linalg.eigvalsh(projected)[:, 0] / scale).min() > -1e-13
    definite = torch.linalg.eigvalsh(exact)[:, 0] >= -1e-14 * scale
    assert definite.any()
    assert ((exact - projected).norm(dim=(1, 2)) / scale)[definite].max() < 1e-13
    # The largest eigenvalue stays, and what is added is positive semi-definite.
    assert (torch.linalg.eigvalsh(projected - exact)[:, 0] / scale).min() > -1e-13


@pytest.mark.parametrize("law", ["neo_hookean", "fixed_corotated", "weakly_compressible"])
def test_tangent_in_float32(law, dim, device):
    torch.manual_seed(1)
    double = Trial(law, dim, device)
    torch.manual_seed(1)
    single = Trial(law, dim, device, torch.float32)
    for projected in (False, True):
        assert relative_error(matrix(single.tangent(projected), dim), matrix(double.tangent(projected), dim)) < 3e-6


def test_a_state_without_meaning_has_no_tangent(dim, device):
    F = torch.eye(dim, dtype=torch.float64, device=device).repeat(4, 1, 1)
    F[0, 0, 0], F[1, 0, 0], F[2, 0, 0] = -1.0, torch.nan, 0.0
    one = F.new_tensor(1.0)
    tangent = ops.law_tangent("neo_hookean", F, F, F.new_ones(4), [one, one])
    assert (tangent[:3] == 0).all() and tangent[3].abs().sum() > 0


def test_a_law_without_a_tangent_says_so(device):
    F = torch.eye(2, device=device).repeat(1, 1, 1)
    one = F.new_tensor(1.0)
    with pytest.raises(NotImplementedError, match="viscoelastic has no tangent"):
        ops.law_tangent("viscoelastic", F, F, F.new_ones(1), [one] * 5, [torch.zeros_like(F)])


# ---- the Hessian


class Case:
    """Random particles with neo-Hookean tangents, and the masses of their nodes."""

    def __init__(self, dim, kernel, device, dtype=torch.float64, projected=True, **options):
        self.particles = p = random_particles(dim, kernel, (40,), device, dtype, dx=0.25, **options)
        self.blocks, self.dim = p.blocks(), dim
        generator = torch.Generator().manual_seed(3)
        eye = torch.eye(dim, dtype=torch.float64)
        F = eye + 0.15 * torch.randn(40, dim, dim, generator=generator, dtype=torch.float64)
        self.F = F.to(device, dtype)
        self.parameters = [torch.tensor(v, dtype=dtype, device=device) for v in (2.0, 3.0)]
        self.dt = 0.3
        self.tangent = ops.law_tangent(
            "neo_hookean", self.F, self.F, self.dt**2 * p.volume, self.parameters, projected=projected
        )
        self.mass = mpm.p2g(self.blocks, p.x, p.mass, p.v)[:, 0]

    def nodes(self, seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        value = torch.randn(self.blocks.node_count, self.dim, generator=generator, dtype=torch.float64)
        return value.to(self.mass)

    def inverse(self) -> Tensor:
        """Inverse node blocks, zero without mass."""
        blocks = self.mass[:, None, None] * torch.eye(self.dim).to(self.mass)
        blocks = blocks + ops.implicit_node_blocks(self.blocks, self.particles.x, self.tangent, "mls")
        there = (self.mass > 0)[:, None, None]
        return torch.where(there, torch.linalg.inv(torch.where(there, blocks, torch.eye(self.dim).to(blocks))), 0)


@pytest.mark.parametrize("stress_form", ["mls", "gradient"])
def test_hessian_is_that_of_the_energy(dim, kernel, stress_form, device):
    """By torch.func of the energy in plain torch, at v = 0 where the trial deformation is F."""
    case = Case(dim, kernel, device, projected=False)
    p = case.particles
    v, along = torch.zeros_like(case.nodes(0)), case.nodes(1)

    def energy(v: Tensor) -> Tensor:
        def density(F: Tensor) -> Tensor:
            return material.energy("neo_hookean", F, case.parameters)

        return oracle.energy(
            case.blocks, p.x, v, torch.zeros_like(along), case.mass, case.F, p.volume, case.dt, density, stress_form
        )

    (reference,) = oracle.hessian(energy, v, [along])
    result = ops.implicit_apply(case.blocks, p.x, along, case.tangent, case.mass, stress_form)
    assert relative_error(result, reference) < 1e-12


@pytest.mark.parametrize("stress_form", ["mls", "gradient"])
def test_hessian_in_float32_and_its_symmetry(dim, stress_form, device):
    double, single = (Case(dim, "quadratic", device, dtype) for dtype in (torch.float64, torch.float32))
    results = [
        ops.implicit_apply(c.blocks, c.particles.x, c.nodes(1), c.tangent, c.mass, stress_form)
        for c in (double, single)
    ]
    assert relative_error(results[1], results[0]) < ERROR[torch.float32]
    other = ops.implicit_apply(
        double.blocks, double.particles.x, double.nodes(2), double.tangent, double.mass, stress_form
    )
    left, right = (double.nodes(2) * results[0]).sum(), (double.nodes(1) * other).sum()
    assert abs(left - right) < 1e-12 * double.nodes(2).norm() * results[0].norm()


@pytest.mark.parametrize("stress_form", ["mls", "gradient"])
@pytest.mark.parametrize("deterministic", [False, True])
def test_node_blocks_are_the_diagonal_of_the_hessian(dim, kernel, stress_form, deterministic, device):
    case = Case(dim, kernel, device, deterministic=deterministic)
    blocks = ops.implicit_node_blocks(case.blocks, case.particles.x, case.tangent, stress_form)
    assert torch.equal(from_upper(to_upper(blocks), dim), blocks)
    heavy = case.mass.argsort(descending=True)[:5].tolist()
    for node in [*heavy, int((case.mass > 0).nonzero()[0])]:
        columns = []
        for axis in range(dim):
            unit = torch.zeros_like(case.nodes(0))
            unit[node, axis] = 1
            columns.append(
                ops.implicit_apply(case.blocks, case.particles.x, unit, case.tangent, None, stress_form)[node]
            )
        assert relative_error(blocks[node], torch.stack(columns, 1)) < 1e-12
    assert (blocks[case.mass == 0] == 0).all()


def test_conjugate_gradients_solve_the_system(dim, kernel, device):
    for dtype, least in ((torch.float64, 1e-11), (torch.float32, 1e-5)):
        case = Case(dim, kernel, device, dtype)
        p, rhs = case.particles, case.nodes(4) * case.mass[:, None]
        relative = torch.full((1,), least, dtype=dtype, device=device)
        solve = ops.implicit_cg(case.blocks, p.x, rhs, case.mass, case.inverse(), case.tangent, relative, 1000)
        assert solve.state.tolist() == [CONVERGED] and 0 < solve.iterations[0] < 1000
        left = ops.implicit_apply(case.blocks, p.x, solve.solution, case.tangent, case.mass)
        assert relative_error(left, rhs) < 10 * least


@pytest.mark.parametrize("most", [0, 1, 3, 9])
def test_iterations_end_at_their_limit(most, device):
    """Against the textbook's conjugate gradients in torch; a right side of zero takes none."""
    case = Case(2, "quadratic", device)
    p, rhs, inverse = case.particles, case.nodes(4) * case.mass[:, None], case.inverse()
    relative = torch.zeros(1, dtype=torch.float64, device=device)

    def solved(right):
        return ops.implicit_cg(case.blocks, p.x, right, case.mass, inverse, case.tangent, relative, most)

    x, r = torch.zeros_like(rhs), rhs
    direction = z = (inverse @ r[:, :, None])[:, :, 0]
    for _ in range(most):
        along = ops.implicit_apply(case.blocks, p.x, direction, case.tangent, case.mass)
        square = (r * z).sum()
        step = square / (direction * along).sum()
        x, r = x + step * direction, r - step * along
        z = (inverse @ r[:, :, None])[:, :, 0]
        direction = z + (r * z).sum() / square * direction
    solve = solved(rhs)
    assert solve.iterations.tolist() == [most] and solve.state.tolist() == [0]
    assert float((solve.solution - x).norm()) <= 1e-9 * float(x.norm())
    nothing = solved(0 * rhs)
    assert nothing.iterations.tolist() == [0] and nothing.state.tolist() == [CONVERGED]
    assert bool((nothing.solution == 0).all())


def test_the_solution_stays_in_the_range_of_the_preconditioner(dim, device):
    """Nodes that are held, and others that may slide along one axis: the residual of the free components vanishes."""
    case = Case(dim, "quadratic", device)
    p, rhs = case.particles, case.nodes(4) * case.mass[:, None]
    free = torch.ones_like(rhs)
    free[::3], free[1::3, 0] = 0, 0
    both = free[:, :, None] * free[:, None, :]
    inverse = case.inverse()
    diagonal = torch.linalg.inv(torch.where(inverse.abs().sum((1, 2), True) > 0, inverse, torch.eye(dim).to(inverse)))
    inverse = both * torch.linalg.inv(both * diagonal + torch.diag_embed(1 - free)) * (case.mass > 0)[:, None, None]
    relative = torch.full((1,), 1e-11, dtype=torch.float64, device=device)
    solve = ops.implicit_cg(case.blocks, p.x, rhs, case.mass, inverse, case.tangent, relative, 1000)
    assert solve.state.tolist() == [CONVERGED]
    assert (solve.solution[free == 0] == 0).all()
    left = ops.implicit_apply(case.blocks, p.x, solve.solution, case.tangent, case.mass)
    assert relative_error(free * left, free * rhs) < 1e-10


def test_nodes_are_held_along_any_direction(dim, device):
    """Against a dense solve of the free components; constraints do not limit the tolerance."""
    for dtype, least in ((torch.float64, 1e-12), (torch.float32, 3e-6)):
        case = Case(dim, "quadratic", device, dtype)
        normal = (
            torch.nn.functional.normalize(case.nodes(5), dim=1)
            * (torch.arange(len(case.mass)) % 2).to(case.mass)[:, None]
        )
        off = torch.eye(dim).to(normal) - normal[:, :, None] * normal[:, None, :]
        rhs = (off @ (case.nodes(4) * case.mass[:, None])[:, :, None])[:, :, 0]
        massive = (case.mass > 0)[:, None, None]
        inner = torch.where(massive, torch.linalg.pinv(off @ torch.linalg.pinv(case.inverse()) @ off, rtol=1e-4), 0)
        inverse = (inner + inner.mT) / 2
        relative = torch.full((1,), least, dtype=dtype, device=device)
        arguments = (case.blocks, case.particles.x, rhs, case.mass, inverse, case.tangent, relative, 1000)
        solve = ops.implicit_cg(*arguments, held=normal)
        assert solve.state.tolist() == [CONVERGED]
        assert float((solve.solution * normal).sum(1).abs().max() / solve.solution.abs().max()) < 100 * least
        left = ops.implicit_apply(case.blocks, case.particles.x, solve.solution, case.tangent, case.mass)
        assert relative_error((off @ left[:, :, None])[:, :, 0], rhs) < 10 * least
        with pytest.raises(ValueError, match=r"held must have shape \[N, D\]"):
            ops.implicit_cg(*arguments, held=normal[:-1])


def test_scenes_are_solved_apart(device):
    """Each as alone, with iterations of its own; one without particles, one of negative curvature, one with a NaN."""
    p = random_particles(2, sizes=(30, 0, 12, 20, 25), device=device, dx=0.25)
    blocks = p.blocks()
    F = torch.eye(2, dtype=torch.float64, device=device).expand(len(p.x), 2, 2)
    one = F.new_tensor(1.0)
    scale = torch.tensor([0.1, 1.0, 10.0, -100.0, 1.0], dtype=torch.float64, device=device)
    tangent = ops.law_tangent("neo_hookean", F, F, scale[p.scene.long()].abs(), [one, one])
    tangent = torch.cat([tangent[:, :8], tangent[:, 8:] * scale.sign()[p.scene.long(), None]], 1)
    mass = mpm.p2g(blocks, p.x, p.mass, p.v)[:, 0]
    generator = torch.Generator().manual_seed(2)
    rhs = torch.randn(len(mass), 2, generator=generator, dtype=torch.float64).to(device) * mass[:, None]
    rhs = torch.where((blocks.node_scene() == 4)[:, None], torch.nan, rhs)
    inverse = torch.diag_embed(torch.where(mass > 0, 1 / mass, 0)[:, None].expand(-1, 2)).contiguous()
    relative = torch.full((5,), 1e-10, dtype=torch.float64, device=device)
    solve = ops.implicit_cg(blocks, p.x, rhs, mass, inverse, tangent, relative, 500)
    assert solve.state.tolist() == [CONVERGED, CONVERGED, CONVERGED, NEGATIVE_CURVATURE, 3]
    assert solve.iterations[1] == 0 and solve.iterations[0] < solve.iterations[2]
    left = ops.implicit_apply(blocks, p.x, solve.solution, tangent, mass)
    for scene in (0, 2):
        own = blocks.node_scene() == scene
        assert relative_error(left[own], rhs[own]) < 1e-9
    assert solve.solution.isfinite().all()


def test_a_part_of_each_node_belongs_to_the_hessian(dim, device):
    """Symmetric matrices of the nodes, such as friction adds."""
    case = Case(dim, "quadratic", device)
    root = torch.stack([case.nodes(k) for k in range(dim)], 2)
    local = case.mass[:, None, None] * root @ root.mT
    rhs = case.nodes(9) * case.mass[:, None]
    relative = torch.full((1,), 1e-11, dtype=torch.float64, device=device)
    arguments = (case.blocks, case.particles.x, rhs, case.mass, case.inverse(), case.tangent, relative, 1000)
    solve = ops.implicit_cg(*arguments, local=local)
    assert solve.state.tolist() == [CONVERGED]
    left = ops.implicit_apply(case.blocks, case.particles.x, solve.solution, case.tangent, case.mass)
    assert relative_error(left + (local @ solve.solution[:, :, None])[:, :, 0], rhs) < 1e-8
    with pytest.raises(ValueError, match="local must have shape"):
        ops.implicit_cg(*arguments, local=local[:-1])


def test_images_are_one(dim, device):
    """The solution is symmetric, and what the solve leaves has no symmetric part."""
    case = Case(dim, "quadratic", device)
    heavy = case.mass.nonzero()[:, 0]
    groups = torch.full((2, 1 << dim), -1, dtype=torch.int32, device=device)
    groups[0, 0], groups[0, 1] = heavy[0], heavy[5]  # images along x
    groups[1, 0] = groups[1, 2] = heavy[7]  # a node on a mirror along y
    mirrors = Mirrors(groups)
    rhs, inverse = (mirrors.symmetric(t) for t in (case.nodes(3) * case.mass[:, None], case.inverse()))
    relative = torch.full((1,), 1e-11, dtype=torch.float64, device=device)
    arguments = (case.blocks, case.particles.x, rhs, case.mass, inverse, case.tangent, relative, 1000)
    solve = ops.implicit_cg(*arguments, images=groups)
    assert solve.state.tolist() == [CONVERGED]
    first, second, alone = (solve.solution[heavy[k]] for k in (0, 5, 7))
    assert first[0] == -second[0] and (first[1:] == second[1:]).all() and alone[1] == 0 and alone[0] != 0
    left = ops.implicit_apply(case.blocks, case.particles.x, solve.solution, case.tangent, case.mass) - rhs
    assert relative_error(mirrors.symmetric(left) + rhs, rhs) < 1e-9
    assert left[heavy[7], 1].abs() > 1e-6 * rhs.abs().max()  # the force of the mirror
    normal = torch.zeros_like(rhs)
    normal[heavy[0]], normal[heavy[5]] = (torch.tensor([s * 0.6, 0.8, 0.0][:dim]).to(rhs) for s in (1, -1))
    off = torch.eye(dim).to(rhs) - normal[:, :, None] * normal[:, None, :]
    rhs, inverse = (off @ rhs[:, :, None])[:, :, 0], off @ inverse @ off
    arguments = (case.blocks, case.particles.x, rhs, case.mass, inverse, case.tangent, relative, 1000)
    solve = ops.implicit_cg(*arguments, images=groups, held=normal)
    assert solve.state.tolist() == [CONVERGED]
    left = ops.implicit_apply(case.blocks, case.particles.x, solve.solution, case.tangent, case.mass) - rhs
    assert relative_error((off @ mirrors.symmetric(left)[:, :, None])[:, :, 0] + rhs, rhs) < 1e-9
    with pytest.raises(ValueError, match=r"images must have shape \[G, 2\^D\]"):
        ops.implicit_cg(*arguments, images=groups[:, :1])
    with pytest.raises(TypeError, match="images must be int32"):
        ops.implicit_cg(*arguments, images=groups.long())


@pytest.mark.parametrize("sign", [-1.0, 0.0])
def test_an_indefinite_preconditioner_is_no_convergence(sign, device):
    """As rounding leaves one of stiff blocks: r · B⁻¹ r is negative, at the start or later."""
    case = Case(2, "quadratic", device)
    rhs = case.nodes(4) * case.mass[:, None]
    inverse = case.inverse()
    inverse[..., 1, 1] *= sign
    if sign:
        inverse[..., 0, 0] *= sign
    else:  # of both signs
        inverse[..., 1, 1] = -2 * inverse[..., 0, 0]
    relative = torch.full((1,), 1e-10, dtype=torch.float64, device=device)
    solve = ops.implicit_cg(case.blocks, case.particles.x, rhs, case.mass, inverse, case.tangent, relative, 1000)
    assert solve.state.tolist() == [NEGATIVE_CURVATURE]


def test_wrong_arguments_are_named():
    case = Case(2, "quadratic", "cpu")
    x, along = case.particles.x, case.nodes(0)
    with pytest.raises(ValueError, match=r"tangent must have shape \[P, n\] = \[40, 13\], got \[40, 12\]"):
        ops.implicit_apply(case.blocks, x, along, case.tangent[:, :12])
    with pytest.raises(ValueError, match="direction must have shape"):
        ops.implicit_apply(case.blocks, x, along[:-1], case.tangent)
    with pytest.raises(ValueError, match="stress_form must be one of"):
        ops.implicit_node_blocks(case.blocks, x, case.tangent, "fem")
    with pytest.raises(TypeError, match="tangent must be a tensor"):
        ops.implicit_node_blocks(case.blocks, x, None)
    assert [tangent_entries(d) for d in (2, 3)] == [13, 30]


def test_the_ops_refuse_gradients():
    case = Case(2, "quadratic", "cpu")
    along = case.nodes(0).requires_grad_()
    with pytest.raises(NotImplementedError, match="no derivatives"):
        ops.implicit_apply(case.blocks, case.particles.x, along, case.tangent).sum().backward()


def test_opcheck(dim, device):
    case = Case(dim, "quadratic", device)
    x, packed, namespace = case.particles.x, case.blocks.packed, torch.ops.torch_mpm
    upper = to_upper(case.inverse())
    relative = torch.full((1,), 1e-3, dtype=torch.float64, device=device)
    checks = ("test_schema", "test_faketensor")
    state = (case.F, case.F, case.particles.volume, case.parameters, [], None, "neo_hookean", dim, True)
    torch.library.opcheck(namespace.law_tangent.default, state, test_utils=checks)
    torch.library.opcheck(
        namespace.implicit_apply.default, (x, case.nodes(1), case.tangent, 0, *packed), test_utils=checks
    )
    torch.library.opcheck(namespace.implicit_node_blocks.default, (x, case.tangent, 0, *packed), test_utils=checks)
    torch.library.opcheck(
        namespace.implicit_cg.default,
        (
            x,
            case.nodes(1),
            case.mass.contiguous(),
            upper,
            upper,
            case.nodes(2),
            None,
            case.tangent,
            relative,
            5,
            0,
            *packed,
        ),
        test_utils=("test_schema",),
    )
