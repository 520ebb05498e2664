"""The implicit heat step: its operator, the solve against a dense one, gradients, and bad input."""

import dataclasses
import math

import pytest
import torch
from cases.heat_cg import check_replay, dense_increment, dense_operator, heat, op_arguments
from helpers import TOLERANCE, relative_error
from oracle import heat as reference
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops import heat_operator, scatter

NONDETERMINISTIC = 1e-8
"""Atomic sums on CUDA have no order."""


@pytest.fixture(params=[False, True])
def far(request: pytest.FixtureRequest, device: str) -> bool:
    """Whether the scenes are too wide for the thread block that solves a small one on CUDA."""
    if request.param and device == "cpu":
        pytest.skip("the CPU has one way for all scenes")
    return request.param


# ---- the operator


@pytest.mark.parametrize("deterministic", [False, True])
def test_operator_is_the_reference(device, dim, kernel, deterministic):
    h = heat(dim, kernel, device, sizes=(700, 0, 130), deterministic=deterministic)
    u = torch.randn_like(h.theta)
    operator = reference.HeatOperator.at(h.blocks, h.x, h.conductance)
    assert relative_error(heat_operator(h.blocks, h.x, h.conductance, u), operator.apply(u)) < 1e-13
    assert relative_error(heat_operator(h.blocks, h.x, h.conductance, None), operator.diagonal(len(u))) < 1e-13


def test_crowded_cells(device, dim, kernel):
    """More particles in a cell than a work item or a chunk holds, beside others with one."""
    h = heat(dim, kernel, device, sizes=(900,), dx=0.5)
    x = h.x.clone()
    x[:800] = x[0] + 1e-3 * torch.rand_like(x[:800])
    blocks = h.blocks.grid.activate(x)
    u = torch.randn(blocks.node_count, dtype=x.dtype, device=device)
    operator = reference.HeatOperator.at(blocks, x, h.conductance)
    assert relative_error(heat_operator(blocks, x, h.conductance, u), operator.apply(u)) < 1e-13
    assert relative_error(heat_operator(blocks, x, h.conductance, None), operator.diagonal(len(u))) < 1e-13


def test_operator_is_symmetric_semidefinite_and_keeps_constants(device, dim, kernel):
    h = heat(dim, kernel, device, sizes=(50,), dx=0.4)
    H = dense_operator(h)
    scale = float(H.abs().max())
    assert float((H - H.T).abs().max()) < 1e-14 * scale
    assert float(torch.linalg.eigvalsh(H).min()) > -1e-13 * scale
    assert float(H.sum(1).abs().max()) < 1e-13 * scale
    torch.testing.assert_close(heat_operator(h.blocks, h.x, h.conductance, None), H.diagonal(), rtol=1e-12, atol=1e-15)


def test_largest_eigenvalue(device, dim, kernel):
    """λmax(M⁻¹ H) ≤ 4 κ/(ρ c dx²), 3 for the cubic kernel, however thin the edge (Cauchy-Schwarz)."""
    h = heat(dim, kernel, device, sizes=(60,), dx=0.4)
    diffusivity = 0.7
    mass = 0.1 + torch.rand(h.x.shape[0], dtype=h.x.dtype, device=device)
    h.conductance = diffusivity * mass
    heat_capacity = scatter(h.blocks, h.x, mass[:, None])[:, 0]
    some = heat_capacity > 0
    root = heat_capacity[some].sqrt()
    values = torch.linalg.eigvalsh(dense_operator(h)[some][:, some] / root / root[:, None])
    assert float(values.max()) <= diffusivity * h.blocks.grid.inverse_inertia * (1 + 1e-12)


def test_particles_elsewhere_than_activated_conduct_nothing_on_cuda(device, dim):
    if device == "cpu":
        pytest.skip("the CPU trusts the activation")
    h = heat(dim, device=device, sizes=(60,))
    moved = h.x.clone()
    moved[:7] = math.nan
    u = torch.randn_like(h.theta)
    conductance = h.conductance.clone()
    conductance[:7] = 0
    expected = heat_operator(h.blocks, h.x, conductance, u)
    torch.testing.assert_close(heat_operator(h.blocks, moved, h.conductance, u), expected, rtol=1e-12, atol=1e-14)


# ---- the solve


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("method", ["cg", "chebyshev", "multigrid"])
@pytest.mark.parametrize("boundaries", [False, True])
def test_solve_is_the_dense_one(device, dim, kernel, boundaries, method, far):
    if dim == 3 and (kernel == "cubic") == boundaries:
        pytest.skip("2-D has it")
    h = heat(dim, kernel, device, far=far)
    solve = h.solve(boundaries, tolerance=1e-12, method=method, max_iterations=1000)
    assert solve.converged.all() and (solve.residual <= 1e-12).all() and int(solve.iterations[1]) == 0
    assert relative_error(solve.increment, dense_increment(h, boundaries)) < 1e-10
    if boundaries:
        assert (solve.increment[h.fixed] == 0).all()
    assert (solve.increment[h.heat_capacity == 0] == 0).all()


@pytest.mark.parametrize("deterministic", [False, True])
def test_solve_is_the_reference_iteration_by_iteration(device, dim, kernel, deterministic, far):
    h = heat(dim, kernel, device, deterministic=deterministic, far=far)
    arguments = (h.blocks, h.x, h.conductance, h.heat_capacity, h.theta, h.dt, h.source, h.exchange, h.fixed)
    for most in (0, 1, 3):
        got = h.solve(max_iterations=most)
        expected = reference.heat_cg(*arguments, tolerance=0.0, max_iterations=most)
        assert relative_error(got.increment, expected[0]) < 1e-10
        assert torch.equal(got.iterations, expected[1]) and torch.equal(got.converged, expected[3])
        torch.testing.assert_close(got.residual, expected[2], rtol=1e-9, atol=1e-14)


@pytest.mark.thorough(dim=3)
def test_float32(device, dim, kernel, far):
    h = heat(dim, kernel, device, torch.float32, sizes=(300, 200), far=far)
    solve = h.solve(tolerance=1e-7)
    assert solve.converged.all() and solve.increment.dtype == torch.float32
    assert relative_error(solve.increment, dense_increment(h)) < 1e-5


@pytest.mark.thorough(dim=3)
@pytest.mark.parametrize("boundaries", [False, True])
def test_refinement(device, dim, boundaries):
    """float32 data, float64 accuracy; the gradient is that of the float64 solve."""
    if dim == 3 and not boundaries:
        pytest.skip("2-D has it")
    h = heat(dim, device=device, dtype=torch.float32, sizes=(60, 0, 40))
    plain = h.solve(boundaries, tolerance=1e-12)
    names = ("x", "conductance", "heat_capacity", "theta", "dt", "source")
    grads = []
    for dtype in (torch.float32, torch.float64):
        inputs = {name: getattr(h, name).detach().to(dtype).requires_grad_() for name in names}
        blocks = h.blocks.grid.activate(inputs["x"].detach(), h.blocks.scene)
        moved = dataclasses.replace(h, blocks=blocks, exchange=h.exchange.to(dtype), **inputs)
        solve = moved.solve(boundaries, tolerance=1e-11, refine=True)
        loss = solve.increment.double().pow(2).sum()
        grads.append(torch.autograd.grad(loss, list(inputs.values())))
        assert solve.converged.all() and solve.increment.dtype == torch.float64
        exact = dense_increment(moved, boundaries).to(device)
        assert relative_error(solve.increment, exact) < 1e-9 < relative_error(plain.increment, exact)
    for single, double in zip(*grads, strict=True):
        assert relative_error(single, double) < 2e-4


def test_tolerance_bounds_the_error(dim, kernel):
    """The mass-weighted RMS error is below the tolerance in kelvin: the spectrum of dt M⁻¹ A starts at one."""
    h = heat(dim, kernel)
    exact = dense_increment(h, False)
    for tolerance in (1e-2, 1e-4, 1e-7):
        solve = h.solve(False, tolerance=tolerance)
        error = (
            (h.scenes(h.heat_capacity * (solve.increment - exact) ** 2) / h.scenes(h.heat_capacity)).nan_to_num().sqrt()
        )
        assert solve.converged.all() and (error <= tolerance).all()


@pytest.mark.parametrize(
    *in_pairs(
        method=["cg", "chebyshev", "multigrid"],
        dtype=[torch.float64, torch.float32],
        dim=[2, 3],
        kernel=["quadratic", "cubic"],
    )
)
def test_energy_after_any_number_of_iterations(device, dim, kernel, dtype, method):
    h = heat(dim, kernel, device, dtype, sizes=(500, 0, 300))
    for most in (1, 2, 5, 200):
        d = h.solve(False, max_iterations=most, method=method).increment.double()
        gained, given = h.scenes(h.heat_capacity.double() * d), h.dt.double() * h.scenes(h.source.double())
        scale = h.scenes(h.heat_capacity.double() * d.abs()) + h.dt.double() * h.scenes(h.source.double().abs())
        assert ((gained - given).abs() <= TOLERANCE["conservation"][dtype] * scale).all()


def test_constant_temperature_stays(device, dim):
    h = heat(dim, device=device)
    solve = h.solve(False, theta=torch.full_like(h.theta, 3.0), source=None, tolerance=1e-12)
    assert (solve.iterations == 0).all() and solve.converged.all() and (solve.increment == 0).all()


def test_scenes_are_solved_apart(device, dim, far):
    """Each scene stops by its own time step, tolerance and limit, and gets what it gets alone."""
    h = heat(dim, device=device, sizes=(60, 50, 40), deterministic=True, far=far)
    tolerance = torch.tensor([1e-2, 1e-10, 1e-6], dtype=torch.float64, device=device)
    most = torch.tensor([50, 2, 50], device=device)
    together = h.solve(False, tolerance=tolerance, max_iterations=most)
    assert together.converged.tolist() == [True, False, True] and int(together.iterations[1]) == 2
    scene = h.blocks.node_scene()
    for i in range(3):
        alone = h.solve(False, dt=float(h.dt[i]), tolerance=float(tolerance[i]), max_iterations=int(most[i]))
        torch.testing.assert_close(alone.increment[scene == i], together.increment[scene == i], rtol=1e-10, atol=1e-13)
        assert int(alone.iterations[i]) == int(together.iterations[i])


@pytest.mark.parametrize("method", ["cg", "chebyshev", "multigrid"])
def test_runs_are_bit_identical(device, dim, method, far):
    h = heat(dim, device=device, dtype=torch.float32, sizes=(800, 500), deterministic=True, far=far)
    first, second = (h.solve(tolerance=1e-6, method=method) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_any_strides(device, dim, far):
    h = heat(dim, device=device, far=far)
    expected = h.solve(tolerance=1e-10).increment

    def apart(t: Tensor) -> Tensor:
        return t.repeat_interleave(3, 0)[::3]

    for name in ("x", "conductance", "heat_capacity", "theta", "source", "exchange", "fixed"):
        setattr(h, name, apart(getattr(h, name)))
    torch.testing.assert_close(h.solve(tolerance=1e-10).increment, expected, rtol=1e-9, atol=1e-12)


def test_any_address(device, dim, far):
    """Views of nodes that do not begin where four of them can be loaded at once."""
    h = heat(dim, device=device, dtype=torch.float32, far=far)
    solve = h.solve(tolerance=1e-6).increment
    product = heat_operator(h.blocks, h.x, h.conductance, h.theta)
    for name in ("heat_capacity", "theta", "source", "exchange"):
        nodes = getattr(h, name)
        setattr(h, name, torch.cat([nodes[:1], nodes])[1:])
    torch.testing.assert_close(h.solve(tolerance=1e-6).increment, solve, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(heat_operator(h.blocks, h.x, h.conductance, h.theta), product, rtol=1e-3, atol=1e-4)


def test_replay_of_a_cuda_graph(device, far):
    if device == "cpu":
        pytest.skip("graphs are of CUDA")
    h = heat(3, device=device, dtype=torch.float32, sizes=(500, 300), far=far)
    check_replay(h)


# ---- gradients


@pytest.mark.parametrize("method", ["cg", "chebyshev", "multigrid"])
def test_gradients(device, dim, kernel, method):
    h = heat(dim, kernel, device, sizes=(9, 0, 7), dx=0.4)
    some = h.heat_capacity > 0
    names = ("x", "conductance", "heat_capacity", "theta", "dt", "source", "exchange")

    def increment(*inputs: Tensor) -> Tensor:
        x, conductance, heat_capacity, theta, dt, source, exchange = inputs
        return mpm.heat_cg(
            h.blocks, x, conductance, torch.where(some, heat_capacity, 0), theta, dt, source, exchange, h.fixed,
            tolerance=1e-11, max_iterations=500, method=method, adjoint_tolerance=1e-11,
        ).increment  # fmt: skip

    # Away from zero heat capacity, where a node joins the system.
    h.heat_capacity = torch.where(some, h.heat_capacity + 0.05, 0)
    h.exchange = torch.where(some, h.exchange + 0.01, 0)
    inputs = [getattr(h, name).clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(
        increment, inputs, atol=1e-6, rtol=1e-4, fast_mode=True, nondet_tol=NONDETERMINISTIC
    )


def test_second_derivatives():
    h = heat(2, sizes=(8,), dx=0.5)
    h.heat_capacity = torch.where(h.heat_capacity > 0, h.heat_capacity + 0.1, 0)

    def loss(conductance: Tensor, theta: Tensor, x: Tensor) -> Tensor:
        return mpm.heat_cg(
            h.blocks, x, conductance, h.heat_capacity, theta, 0.5, tolerance=1e-14, adjoint_tolerance=1e-13
        ).increment.pow(2)

    inputs = [t.clone().requires_grad_() for t in (h.conductance, h.theta, h.x)]
    assert torch.autograd.gradgradcheck(loss, inputs, atol=1e-5, rtol=1e-3, fast_mode=True, nondet_tol=NONDETERMINISTIC)


def test_gradients_of_the_operator(device, dim, kernel):
    h = heat(dim, kernel, device, sizes=(9, 7), dx=0.4)
    inputs = [t.clone().requires_grad_() for t in (h.x, h.conductance, h.theta)]

    def product(x: Tensor, conductance: Tensor, nodes: Tensor) -> Tensor:
        return heat_operator(h.blocks, x, conductance, nodes)

    assert torch.autograd.gradcheck(product, inputs, fast_mode=True, nondet_tol=NONDETERMINISTIC)
    diagonal = heat_operator(h.blocks, inputs[0], inputs[1], None)
    with pytest.raises(NotImplementedError, match="diagonal"):
        diagonal.sum().backward()


# ---- hard and bad input


def test_no_conductance(device, dim):
    h = heat(dim, device=device)
    h.conductance = torch.zeros_like(h.conductance)
    for method in ("cg", "chebyshev"):
        solve = h.solve(False, tolerance=1e-12, method=method)
        expected = torch.where(
            h.heat_capacity > 0, h.dt[h.blocks.node_scene().clamp_min(0)] * h.source / h.heat_capacity, 0
        )
        assert solve.converged.all() and int(solve.iterations.max()) == 1
        torch.testing.assert_close(solve.increment, expected, rtol=1e-10, atol=1e-12)


def test_jump_of_conductance(device, kernel):
    h = heat(2, kernel, device, sizes=(900,), dx=0.1)
    h.conductance = torch.where(h.x[:, 0] < 0.3, 1e6, 1.0) * h.conductance
    solve = h.solve(False, tolerance=1e-9, max_iterations=3000)
    assert solve.converged.all()
    assert relative_error(solve.increment, dense_increment(h, False)) < 1e-6


def test_not_converged(device, dim, far):
    h = heat(dim, device=device, far=far)
    h.conductance *= 1e4
    solve = h.solve(tolerance=1e-10, max_iterations=2)
    assert solve.converged.tolist() == [False, True, False] and solve.iterations.tolist() == [2, 0, 2]
    assert float(solve.residual[0]) > 1e-10


@pytest.mark.parametrize("where", ["theta", "conductance", "heat_capacity", "source"])
@pytest.mark.parametrize("method", ["cg", "chebyshev", "multigrid"])
def test_nan_stays_in_its_scene(device, dim, where, method, far):
    h = heat(dim, device=device, sizes=(60, 50, 40), deterministic=True, far=far)
    scene = h.blocks.node_scene()
    expected = h.solve(False, tolerance=1e-9, method=method)
    broken = getattr(h, where).clone()
    if where == "conductance":
        broken[torch.nonzero(h.blocks.scene == 1)[5]] = math.nan
    else:
        broken[torch.nonzero((scene == 1) & (h.heat_capacity > 0))[5]] = math.nan
    setattr(h, where, broken)
    got = h.solve(False, tolerance=1e-9, method=method)
    assert got.converged.tolist() == [True, False, True] and int(got.iterations[1]) == 0
    assert bool(got.residual[1].isnan()) and (got.increment[scene == 1] == 0).all()
    assert torch.equal(got.increment[scene != 1], expected.increment[scene != 1])


def test_time_step_of_a_scene(device, dim, far):
    h = heat(dim, device=device, sizes=(60, 50, 40, 30), far=far)
    scene = h.blocks.node_scene()
    expected = h.solve(tolerance=1e-9)
    h.dt = torch.stack([h.dt[0], 0 * h.dt[1], -h.dt[2], math.nan * h.dt[3]])
    got = h.solve(tolerance=1e-9)
    assert got.converged.tolist() == [True, False, False, False] and got.residual[1:].isnan().all()
    assert (got.increment[scene > 0] == 0).all()
    torch.testing.assert_close(got.increment[scene == 0], expected.increment[scene == 0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("particles", [0, 1])
def test_hardly_anything_to_do(device, dim, particles):
    grid = mpm.Grid(dx=0.1, lower=(0,) * dim, upper=(1,) * dim, scenes=3)
    x = torch.full((particles, dim), 0.5, device=device)
    blocks = grid.activate(x, torch.full((particles,), 1, dtype=torch.int32, device=device))
    nodes = torch.zeros(blocks.node_count, device=device)
    solve = mpm.heat_cg(blocks, x, x.new_ones(particles), nodes, nodes, 0.1)
    assert solve.increment.shape == nodes.shape and (solve.increment == 0).all()
    assert solve.converged.all() and (solve.iterations == 0).all()


def test_messages():
    h = heat(2)
    N, P = h.blocks.node_count, h.x.shape[0]
    for options, error, message in [
        ({"theta": h.theta[1:]}, ValueError, rf"theta must have shape \[N\] = \[{N}\], got \[{N - 1}\]"),
        ({"source": h.source.float()}, TypeError, "source must have the dtype of x, torch.float64, got torch.float32"),
        ({"exchange": 1.0}, ValueError, rf"exchange must have shape \[N\] = \[{N}\], got float"),
        ({"fixed": h.exchange}, ValueError, rf"fixed must be a bool tensor of shape \[N\] = \[{N}\], got \[{N}\]"),
        ({"dt": 0.0}, ValueError, "dt must be a positive number of seconds, got 0.0"),
        ({"dt": h.dt[1:]}, ValueError, r"dt must be a number or have shape \[\], \[1\] or \[B\] = \[3\], got \[2\]"),
        ({"tolerance": -1.0}, ValueError, "tolerance must be a finite number >= 0, got -1.0"),
        ({"tolerance": h.dt[1:]}, ValueError, "tolerance must be a number or have shape"),
        ({"max_iterations": -1}, ValueError, "max_iterations must be a finite number >= 0, got -1"),
        ({"max_iterations": h.dt}, TypeError, "max_iterations must be an integer tensor, got torch.float64"),
        ({"method": "gmres"}, ValueError, r"method must be one of \['cg', 'chebyshev', 'multigrid'\], got 'gmres'"),
        ({"adjoint_tolerance": 0.0}, ValueError, "adjoint_tolerance must be between 0 and 1, got 0.0"),
    ]:
        with pytest.raises(error, match=message):
            h.solve(**options)
    with pytest.raises(ValueError, match=rf"conductance must have shape \[P\] = \[{P}\], got \[1\]"):
        mpm.heat_cg(h.blocks, h.x, h.conductance[:1], h.heat_capacity, h.theta, 0.1)
    with pytest.raises(ValueError, match=r"nodes must have shape \[N\]"):
        heat_operator(h.blocks, h.x, h.conductance, h.theta[1:])
    with pytest.raises(NotImplementedError, match="vmap"):
        torch.vmap(lambda t: mpm.heat_cg(h.blocks, h.x, h.conductance, h.heat_capacity, t, 0.1).increment)(
            h.theta[None]
        )


def test_opcheck(device, dim):
    h = heat(dim, device=device, sizes=(9, 7), dx=0.4, deterministic=True)
    for name in ("x", "conductance", "heat_capacity", "theta", "source", "exchange", "dt"):
        getattr(h, name).requires_grad_()
    torch.library.opcheck(torch.ops.torch_mpm.heat_cg, tuple(op_arguments(h)))
    torch.library.opcheck(
        torch.ops.torch_mpm.heat_operator, (h.x, h.conductance, h.theta.detach().requires_grad_(), *h.blocks.packed)
    )


@pytest.mark.parametrize("method", ["cg", "multigrid"])
def test_compile(method):
    h = heat(2)
    theta = h.theta.clone().requires_grad_()

    def increment(theta: Tensor) -> Tensor:
        return h.solve(theta=theta, tolerance=1e-10, method=method).increment

    got, expected = torch.compile(increment, fullgraph=True, backend="aot_eager")(theta), increment(theta)
    assert torch.equal(got, expected)
    assert torch.equal(*(torch.autograd.grad(d.square().sum(), theta)[0] for d in (got, expected)))


def test_the_op_checks_what_memory_safety_needs(dim):
    h = heat(dim)
    arguments = op_arguments(h)
    for position, value in [
        (0, h.x[:-1]), (0, h.x[:, 0]), (1, h.conductance[1:]), (1, h.conductance.float()), (2, h.heat_capacity[1:]),
        (2, h.heat_capacity[:, None]), (3, h.theta[1:]), (4, h.source.float()), (5, h.exchange[1:]), (6, h.fixed[1:]),
        (6, h.fixed.int()), (7, h.dt[1:]), (9, h.dt[1:]), (12, h.dt), (14, 2),
        (16, dataclasses.replace(h.blocks, block=h.blocks.block[1:]).packed[0]),
    ]:  # fmt: skip
        with pytest.raises(RuntimeError):
            torch.ops.torch_mpm.heat_cg(*arguments[:position], value, *arguments[position + 1 :])
