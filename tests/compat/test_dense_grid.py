"""Attributes of MPM-PyTorch's solver: the dense grid for functions of a user, gravity, mass and volume; `MPMModel`."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from compat.restated import EYE, Weights, from_grid, to_grid
from torch.utils.checkpoint import checkpoint

from torch_mpm.compat.mpm_pytorch import MPMModel, MPMSolver, set_boundary_conditions
from torch_mpm.compat.mpm_pytorch.constitutive_models import warp_svd

N, DT = 20, 3e-4


def start(device="cpu"):
    axis = torch.linspace(0.4, 0.6, 4, dtype=torch.float64, device=device)
    x = torch.cartesian_prod(axis, axis, axis) + 0.003
    F = torch.eye(3, dtype=x.dtype, device=device).repeat(len(x), 1, 1) + 0.05 * torch.sin(9 * x)[:, :, None]
    return x, torch.sin(20 * x), torch.zeros_like(F), F


def stress_of(F):
    return 1e4 * (F @ F.mT - torch.eye(3, dtype=F.dtype, device=F.device))


def restated(tensors, steps, act, damping, gravity, mass, volume, before=None):
    """Steps in NumPy with a function of node velocities, and the nodes of the last one."""
    x, v, C, F = (t.detach().cpu().numpy() for t in tensors)
    for _ in range(steps):
        stress = 1e4 * (F @ F.transpose(0, 2, 1) - EYE)
        weights, moved = Weights(x, 1 / N, N), 0
        if before is not None:
            new = before(x, v)
            moved, v = new[0] - x, new[1]
        m, mv = to_grid(weights, N, mass, v, C, volume, stress, DT, False, 1 / N)
        grid = damping * (mv / np.where(m > 1e-15, m, 1)[:, None] + DT * gravity)
        grid = act(grid, m)
        v, C, grad = from_grid(weights, grid, 1 / N)
        x, F = x + moved + DT * v, (EYE + DT * grad) @ F
    return x, grid, m


def test_functions_of_the_grid_and_of_particles(device):
    """Between conditions of the library, in their order; masses and velocities of all nodes, and other attributes."""
    x, v, C, F = start(device)
    solver = MPMSolver(x, dt=DT, num_grids=N, size=(0.3,) * 3, damping=0.9)
    seen = []

    def half(solver, factor):
        seen.append(solver.grid_m.sum())
        low = solver.grid_x[:, 2] < 10
        solver.grid_mv[low & (solver.grid_m > 1e-6)] *= factor

    def mix(solver):
        solver.grid_mv = solver.grid_mv + 0.1

    def push(solver, x, v):
        v[:5] += 0.2
        x[0, 0] += 1e-4

    solver.post_grid_process.append(partial(half, factor=0.5))
    floor = {"type": "surface_collider", "point": [0, 0, 0.42], "normal": [0, 0, 1.0], "surface": "sticky"}
    set_boundary_conditions(solver, [{**floor, "friction": 0.0, "start_time": 0.0, "end_time": 1e3}])
    solver.post_grid_process.append(mix)
    solver.pre_particle_process.append(push)
    solver.gravity = [0.5, 0.0, -5.0]
    solver.p_mass = torch.linspace(0.1, 0.2, len(x), dtype=x.dtype, device=device)
    solver.vol = 2e-4
    tensors = x, v, C, F
    for _ in range(5):
        tensors = solver(*tensors, stress_of(tensors[3]))
    nodes = np.stack(np.meshgrid(*[np.arange(N)] * 3, indexing="ij"), -1).reshape(-1, 3)

    def act(grid, m):
        grid = np.where(((nodes[:, 2] < 10) & (m > 1e-6))[:, None], 0.5 * grid, grid)
        grid = np.where((nodes[:, 2] / N < 0.42)[:, None] & (m > 1e-15)[:, None], 0, grid)
        return grid + 0.1

    def before(x, v):
        x, v = x.copy(), v.copy()
        v[:5] += 0.2
        x[0, 0] += 1e-4
        return x, v

    mass, volume = solver.p_mass.cpu().numpy(), np.full(len(x), 2e-4)
    gravity = np.array([0.5, 0, -5.0])
    expected, grid, m = restated((x, v, C, F), 5, act, 0.9, gravity, mass, volume, before)
    np.testing.assert_allclose(tensors[0].cpu().numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(solver.grid_m.cpu().numpy(), m, atol=1e-15)
    found, holds = solver.grid_mv.cpu().numpy(), m > 1e-15
    np.testing.assert_allclose(found[holds], grid[holds], atol=1e-11)
    assert float(seen[0]) == pytest.approx(mass.sum()) and torch.equal(x, start(device)[0])


def test_nodes_are_known_without_functions(device):
    """`grid_m` and `grid_mv` of the last step are computed when they are read, which changes nothing."""
    x, v, C, F = start(device)
    solver = MPMSolver(x, dt=DT, num_grids=N, size=(0.3,) * 3)
    assert float(solver.grid_m.sum()) == 0 and solver.grid_mv.shape == (N**3, 3)
    tensors = x, v, C, F
    for k in range(3):
        tensors = solver(*tensors, stress_of(tensors[3]))
        if k == 1:
            assert float(solver.grid_m.sum()) == pytest.approx(27.0)
    mass = np.full(len(x), 27.0 / len(x))
    gravity = np.array([0, 0, -9.8])
    expected, grid, m = restated((x, v, C, F), 3, lambda g, m: g, 1.0, gravity, mass, mass / 1000)
    assert solver.time == pytest.approx(3 * DT)
    np.testing.assert_allclose(tensors[0].cpu().numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(solver.grid_m.cpu().numpy(), m, atol=1e-15)
    np.testing.assert_allclose(solver.grid_mv.cpu().numpy()[m > 1e-15], grid[m > 1e-15], atol=1e-11)
    with pytest.raises(ValueError, match=r"grid_mv must have shape \[n³, 3\]"):
        solver.grid_mv = torch.zeros(3, 3)
    solver.vol = torch.ones(3)
    with pytest.raises(ValueError, match="vol must be a number, or have shape"):
        solver(*tensors, stress_of(F))


@pytest.mark.parametrize("recomputed", [False, True])
def test_gradients_pass_through_functions(recomputed, device):
    """By gravity, masses, and a number that a function of the grid reads, against differences."""

    def loss(values):
        x, v, C, F = start(device)
        solver = MPMSolver(x, dt=DT, num_grids=N, size=(0.3,) * 3)
        solver.gravity = values[:3]
        solver.p_mass = 0.3 * values[3]

        def scaled(solver):
            solver.grid_mv = solver.grid_mv * values[4]

        solver.post_grid_process.append(scaled)

        def steps(x, v, C, F):
            for k in range(4):
                x, v, C, F = solver(x, v, C, F, stress_of(F), k * DT)
            return x, v, C, F

        result = checkpoint(steps, x, v, C, F, use_reentrant=False) if recomputed else steps(x, v, C, F)
        return result[0].square().sum() + 1e-3 * result[1].square().sum()

    values = torch.tensor([1.0, 2.0, -9.8, 1.2, 0.98], dtype=torch.float64, device=device, requires_grad=True)
    (grad,) = torch.autograd.grad(loss(values), values)
    direction = torch.tensor([1.0, -0.5, 2.0, 0.3, 0.02], dtype=values.dtype, device=device)
    with torch.no_grad():
        difference = (loss(values + 1e-3 * direction) - loss(values - 1e-3 * direction)) / 2e-3
    assert float(grad @ direction) == pytest.approx(float(difference), rel=1e-5) and bool((grad != 0).all())


@pytest.mark.parametrize("kind", [dict, SimpleNamespace])
def test_the_model_of_omniphysgs(kind):
    """Two configurations in place of arguments."""
    x, v, C, F = start()
    simulation = kind(num_grids=N, dt=DT, gravity=[0.0, 0.0, -4.0], damping=0.95, boundary_condition=[1])
    model = MPMModel(simulation, kind(size=[0.3] * 3, rho=800.0, center=[0.5] * 3), x, enable_train=True, device="cpu")
    solver = MPMSolver(x, 800.0, N, DT, [0.0, 0.0, -4.0], damping=0.95, size=[0.3] * 3)
    for a, b in zip(model(x, v, C, F, stress_of(F)), solver(x, v, C, F, stress_of(F)), strict=True):
        assert torch.equal(a, b)
    assert model.boundary_condition == [1] and model.p_mass == solver.p_mass
    with pytest.raises(ValueError, match="the configuration must have rho"):
        MPMModel(simulation, kind(size=[0.3] * 3), x)


def test_the_decomposition_under_its_name():
    F = start()[3]
    U, sigma, Vh = warp_svd.SVD()(F)
    torch.testing.assert_close(U @ torch.diag_embed(sigma) @ Vh, F)
