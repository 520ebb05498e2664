"""The multigrid solve of the heat step: its parts against what they stand for, few iterations, and bad input."""

import itertools

import pytest
import torch
from cases.heat_cg import Heat, dense_increment, dense_operator, heat, op_arguments
from helpers import relative_error
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops import gather, heat_multigrid, scatter
from torch_mpm.ops.heat_patches import Patches

FLOAT = torch.float64


def square(
    n: int, r: float, dim: int = 2, kernel: str = "quadratic", device: str = "cpu", dtype: torch.dtype = FLOAT,
    contrast: float = 1.0, thin: bool = False,
) -> Heat:  # fmt: skip
    """A block of n^D cells of 2^D jittered particles, random temperatures, diffusion number r; its left half conducts
    better by the contrast. `thin` leaves of it every third row of cells."""
    generator, dx = torch.Generator().manual_seed(3), 1 / n
    axis = (torch.arange(2 * n, dtype=FLOAT) + 0.5) * dx / 2
    x = torch.stack(torch.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)
    x = x + 0.2 * dx * (torch.rand(x.shape, generator=generator, dtype=FLOAT) - 0.5)
    if thin:
        x = x[(x[:, 1] * n).long() % 3 == 0]
    x = x.to(device, dtype)
    grid = mpm.Grid(dx, (0,) * dim, (1,) * dim, kernel=kernel, deterministic=True)
    blocks = grid.activate(x)
    volume = torch.full_like(x[:, 0], (dx / 2) ** dim)
    heat_capacity = scatter(blocks, x, volume[:, None])[:, 0]
    theta = torch.rand(blocks.node_count, generator=generator, dtype=FLOAT).to(x)
    zero = torch.zeros_like(theta)
    conductance = torch.where(x[:, 0] < 0.5, volume, volume / contrast)
    dt = torch.full((1,), r * dx**2, dtype=dtype, device=device)
    return Heat(blocks, x, conductance, heat_capacity, theta, zero, zero, blocks.node_positions(FLOAT)[:, 0] < 0.05, dt)


def levels_of(h: Heat) -> list[heat_multigrid.Level]:
    free, weight = (h.heat_capacity > 0).to(h.x), h.heat_capacity / h.dt
    diagonal = torch.ops.torch_mpm.heat_operator(h.x, h.conductance, None, *h.blocks.packed)
    return heat_multigrid._levels(h.blocks, h.x, h.conductance, weight, free, h.fixed & False, diagonal)


def weighted_error(h: Heat, increment: Tensor, exact: Tensor) -> float:
    """Mass-weighted RMS, relative."""
    weight = h.heat_capacity.cpu().double()
    squares = [float((weight * d.cpu().double() ** 2).sum()) for d in (increment.cpu() - exact, exact)]
    return (squares[0] / squares[1]) ** 0.5


# ---- parts


@pytest.mark.thorough(dim=3, kernel="quadratic")
def test_stencil_has_the_entries_of_the_operator(device, dim, kernel):
    h = heat(dim, kernel, device, sizes=(40, 0, 30), dx=0.4)
    stencil = torch.ops.torch_mpm.heat_stencil(h.x, h.conductance, *h.blocks.packed)
    H, index, scene = dense_operator(h), h.blocks.node_indices(), h.blocks.node_scene()
    offsets = [e for e in itertools.product((-1, 0, 1), repeat=dim) if e >= (0,) * dim]
    assert stencil.shape == (len(offsets), len(H))
    for row, e in zip(stencil, offsets, strict=True):
        there = (index[None] - index[:, None] == torch.tensor(e, device=device)).all(-1)
        there &= (scene[None] == scene[:, None]) & (scene >= 0)
        expected = torch.where(there, H, 0).sum(1)
        torch.testing.assert_close(row, expected, rtol=1e-12, atol=1e-14 * float(H.abs().max()))


def test_patches_are_the_sum_of_inverses(device, dim):
    h = heat(dim, device=device, sizes=(40,), dx=0.4)
    free, weight = (h.heat_capacity > 0) & ~h.fixed, h.heat_capacity / 10
    patches = Patches(h.blocks, h.x, h.conductance, weight, free)
    A, index = dense_operator(h) + weight.diag(), h.blocks.node_indices()
    used = torch.nonzero(h.blocks.active_nodes())[:, 0]
    expected, members = torch.zeros_like(A), []
    for o in used:
        at = index[used] - index[o]
        some = used[((at >= 0) & (at <= 1)).all(1)]
        members.append(some[free[some]])
    count = torch.zeros_like(weight)
    for some in members:
        count[some] += 1
    for some in members:
        share = count[some] ** -0.5
        expected[some[:, None], some] += share[:, None] * torch.linalg.inv(A[some[:, None], some]) * share
    got = torch.stack([patches(e) for e in torch.eye(len(A), dtype=FLOAT, device=device)], 1)
    assert relative_error(got, expected) < 1e-8


def test_prolonged_values_are_the_same_function(device, dim, kernel):
    """Coarse values at any point, by coarse splines and by the fine ones; restriction is the transpose."""
    h = square(10 if dim == 2 else 9, 1.0, dim, kernel, device)
    fine, coarse = levels_of(h)[:2]
    generator = torch.Generator().manual_seed(4)
    values = torch.randn(coarse.blocks.node_count, generator=generator, dtype=FLOAT).to(device)
    values = values * coarse.blocks.active_nodes()
    x = h.x.T.contiguous().T
    at = coarse.blocks.grid._activate(x, None, None, coarse.blocks.grid.block_count)
    moved = at.from_dense(coarse.blocks.to_dense(values[:, None]))
    expected = gather(at, x, moved)[0]
    got = gather(fine.blocks, x, fine.transfer.prolong(values)[:, None])[0]
    assert relative_error(got, expected) < 1e-13
    other = torch.randn(fine.blocks.node_count, generator=generator, dtype=FLOAT).to(device)
    other = other * fine.blocks.active_nodes()
    left, right = (other * fine.transfer.prolong(values)).sum(), (fine.transfer.restrict(other) * values).sum()
    torch.testing.assert_close(left, right, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("thin", [False, True])
def test_cycle_is_symmetric_and_near_the_inverse(kernel, thin, monkeypatch):
    """With an exact coarsest solve: B = Bᵀ > 0, and the spectrum of B A between 0.1 and 1.3 (thin: 0.01)."""
    monkeypatch.setattr(heat_multigrid, "COARSE_REDUCTION", 1e-10)
    monkeypatch.setattr(heat_multigrid, "COARSE_ITERATIONS", 300)
    h = square(12, 1e3, kernel=kernel, thin=thin)
    levels = levels_of(h)
    some = torch.nonzero(h.heat_capacity > 0)[:, 0]
    unit = torch.eye(len(h.heat_capacity), dtype=FLOAT)
    assert len(levels) == 3
    B = torch.stack([heat_multigrid._cycle(levels, 0, unit[i]) for i in some], 1)[some]
    A = torch.stack([levels[0].apply(unit[i]) for i in some], 1)[some]
    assert float((B - B.T).abs().max()) < 1e-7 * float(B.abs().max())
    root = torch.linalg.cholesky(A)
    values = torch.linalg.eigvalsh(root.T @ B @ root)
    assert 0 < values[0] and (0.01 if thin else 0.1) < float(values[0]) and float(values[-1]) < 1.3


# ---- solves


@pytest.mark.parametrize("r", [1e2, 1e4, 1e6])
def test_few_iterations_whatever_the_diffusion_number(device, kernel, r):
    for dim, n, most in ((2, 16, 12), (2, 32, 12), (3, 8, 30 if kernel == "quadratic" else 50)):
        if dim == 3 and r == 1e4:
            continue  # the others have it
        h = square(n, r, dim, kernel, device)
        solve = h.solve(False, relative_tolerance=1e-10, method="multigrid")
        assert solve.converged.all() and int(solve.iterations) <= most
        if n == 16:
            # r times the rounding and the tolerance
            assert weighted_error(h, solve.increment, dense_increment(h, False)) < 1e-9


@pytest.mark.parametrize("case,most", [("contrast", 15), ("held", 15), ("thin", 60)])
def test_hard_layouts(device, case, most):
    h = square(16, 1e5, device=device, contrast=1e6 if case == "contrast" else 1.0, thin=case == "thin")
    solve = h.solve(case == "held", relative_tolerance=1e-10, method="multigrid")
    assert solve.converged.all() and int(solve.iterations) <= most
    assert weighted_error(h, solve.increment, dense_increment(h, case == "held")) < 1e-6


def test_coarse_lattices_that_do_not_fit_the_pool(device, dim):
    """Lonely particles touch more blocks of the coarse lattices than the pool has: slower, but right."""
    x = torch.rand(20, dim, generator=torch.Generator().manual_seed(5), dtype=FLOAT).to(device)
    lattice = {"dx": 1 / 64, "lower": (0,) * dim, "upper": (1,) * dim}
    tight = int((mpm.Grid(**lattice).activate(x).block >= 0).sum())
    heats = []
    for max_blocks in (tight, 2 * tight):
        blocks = mpm.Grid(**lattice, max_blocks=max_blocks).activate(x)
        mass = scatter(blocks, x, torch.ones_like(x[:, :1]))[:, 0]
        theta = torch.sin(7 * blocks.node_positions(FLOAT)).sum(1) * blocks.active_nodes()
        options = {"tolerance": 0.0, "relative_tolerance": 1e-9, "method": "multigrid"}
        solve = mpm.heat_cg(blocks, x, torch.ones_like(x[:, 0]), mass, theta, 0.02, **options)
        assert solve.converged.all()
        heats.append(float((mass * solve.increment**2).sum()))
    assert heats[0] == pytest.approx(heats[1], rel=1e-6)


def test_float32_with_refinement(device):
    h = square(16, 1e4, device=device, dtype=torch.float32, contrast=1e3)
    exact = dense_increment(h, False)
    rough = h.solve(False, relative_tolerance=1e-7, method="multigrid")
    fine = h.solve(False, tolerance=1e-6, method="multigrid", refine=True)
    assert weighted_error(h, rough.increment, exact) < 1e-3 and fine.converged.all()
    assert weighted_error(h, fine.increment, exact) < 1e-8


def test_too_few_iterations_are_reported(device):
    """Also of Chebyshev iteration, which is for small diffusion numbers."""
    h = square(16, 1e6, device=device)
    for method, most in (("multigrid", 2), ("chebyshev", 500)):
        solve = h.solve(False, relative_tolerance=1e-10, method=method, max_iterations=most)
        assert not solve.converged.any() and int(solve.iterations) == most
        assert float(solve.residual) > 0 and solve.increment.isfinite().all()


def test_captured_in_a_cuda_graph(device):
    if device == "cpu":
        pytest.skip("graphs are of CUDA")
    h = square(16, 1e4, device=device, dtype=torch.float32)
    options = {"tolerance": 1e-4, "method": "multigrid", "max_iterations": 12}
    h.solve(False, **options)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        solve = h.solve(False, **options)
    h.theta.mul_(0.5)
    graph.replay()
    expected = h.solve(False, **options)
    assert torch.equal(solve.iterations, expected.iterations) and solve.converged.all()
    torch.testing.assert_close(solve.increment, expected.increment, rtol=1e-4, atol=1e-6)


# ---- ops


def test_opcheck(device, dim):
    h = heat(dim, device=device, sizes=(9, 7), dx=0.4, deterministic=True)
    patches = Patches(h.blocks, h.x, h.conductance, h.heat_capacity, h.heat_capacity > 0)
    for name, arguments in (
        ("heat_stencil", (h.x, h.conductance, *h.blocks.packed)),
        ("heat_patches", (patches.inverse, patches.rows, patches.patches, h.theta)),
    ):
        torch.library.opcheck(getattr(torch.ops.torch_mpm, name), arguments)
    for name in ("x", "conductance", "heat_capacity", "theta", "source", "exchange", "dt"):
        getattr(h, name).requires_grad_()
    torch.library.opcheck(torch.ops.torch_mpm.heat_multigrid, tuple(op_arguments(h)))
    with pytest.raises(NotImplementedError, match="not differentiable"):
        torch.ops.torch_mpm.heat_stencil(h.x, h.conductance, *h.blocks.packed).sum().backward()


def test_ops_check_what_memory_safety_needs(dim):
    h = heat(dim, sizes=(30,))
    for x, conductance in ((h.x[:-1], h.conductance), (h.x, h.conductance.float()), (h.x[:, 0], h.conductance)):
        with pytest.raises(RuntimeError):
            torch.ops.torch_mpm.heat_stencil(x, conductance, *h.blocks.packed)
    p = Patches(h.blocks, h.x, h.conductance, h.heat_capacity, h.heat_capacity > 0)
    good = [p.inverse, p.rows, p.patches, h.theta]
    for position, value in (
        (0, p.inverse[1:]), (0, p.inverse.float()), (0, p.inverse[..., 0]), (1, p.rows[1:]), (1, p.rows.long()),
        (1, p.rows[:, :3].contiguous()), (2, p.patches.mT), (3, h.theta[1:]), (3, h.theta[:, None]),
    ):  # fmt: skip
        with pytest.raises(RuntimeError):
            torch.ops.torch_mpm.heat_patches(*good[:position], value, *good[position + 1 :])
    for far in (-5, 2**30):  # rows that do not exist count as absent
        wrong = torch.full_like(p.rows, far)
        assert (torch.ops.torch_mpm.heat_patches(p.inverse, wrong, p.patches, h.theta) == 0).all()
        assert (torch.ops.torch_mpm.heat_patches(p.inverse, p.rows, wrong, h.theta) == 0).all()
