"""Restarted GMRES of implicit steps against a dense solve."""

import dataclasses

import pytest
import torch
from helpers import relative_error

import torch_mpm as mpm
from torch_mpm.implicit import gmres as module
from torch_mpm.implicit.gmres import gmres
from torch_mpm.implicit.system import ImplicitSystem


@dataclasses.dataclass
class Problem:
    """Matrices of scenes that are not symmetric. The right-hand side of scene 1 is zero, that of scene 3 not finite."""

    system: ImplicitSystem
    rows: list[torch.Tensor]
    matrices: list[torch.Tensor]
    right: torch.Tensor
    inverse: torch.Tensor

    def product(self, v):
        result = torch.zeros_like(v)
        for own, matrix in zip(self.rows, self.matrices, strict=True):
            result[own] = (matrix @ v[own].flatten()).unflatten(0, (-1, 2))
        return result

    def solve(self, relative, most, precondition=None):
        relative = self.right.new_full((4,), relative)
        return gmres(self.system, self.product, self.inverse, self.right, relative, most, precondition)

    def error(self, solution, scene):
        exact = torch.linalg.solve(self.matrices[scene], self.right[self.rows[scene]].flatten())
        return relative_error(solution[self.rows[scene]].flatten(), exact)


def problem(device):
    grid = mpm.Grid(1.0, (0.0, 0.0), (1.0, 1.0), scenes=4)
    x = torch.full((4, 2), 0.4, dtype=torch.float64, device=device)
    scene = torch.arange(4, dtype=torch.int32, device=device)
    one = torch.ones_like(x[:, 0])
    state = mpm.State(x=x, v=0 * x, mass=one, volume=one, F=torch.eye(2).to(x).repeat(4, 1, 1), scene=scene)
    blocks = grid.activate(x, scene)
    nodes = mpm.p2g(blocks, x, one, 0 * x)
    system = ImplicitSystem(blocks, mpm.Hencky(E=1.0, nu=0.0), state, nodes[:, 0], nodes[:, 1:], 1.0, "mls")
    rows = [(blocks.node_scene() == b).nonzero()[:, 0] for b in range(4)]
    generator = torch.Generator().manual_seed(0)
    matrices = []
    for own in rows:
        random = torch.randn(2 * len(own), 2 * len(own), generator=generator, dtype=torch.float64).to(device)
        matrices.append(3 * torch.eye(2 * len(own)).to(random) + random / len(own) ** 0.5)
    right = torch.randn(blocks.node_count, 2, generator=generator, dtype=torch.float64).to(device)
    right[rows[1]] = 0
    right[rows[3][0]] = torch.nan
    right[blocks.node_scene() < 0] = 0
    inverse = torch.linspace(0.5, 2.0, len(right)).to(right)[:, None, None] * torch.eye(2).to(right)
    return Problem(system, rows, matrices, right, inverse)


@pytest.mark.parametrize("kept", [40, 5])
def test_scenes_against_dense_solves(kept, device, monkeypatch):
    monkeypatch.setattr(module, "DIRECTIONS", kept)
    given = problem(device)
    solution, iterations, converged = given.solve(1e-9, 400)
    assert converged.tolist() == [True, True, True, False]
    assert iterations[1] == iterations[3] == 0 and (solution[given.rows[1]] == 0).all()
    assert (iterations[0] > kept) == (kept == 5) and int(iterations.max()) < 400
    assert max(given.error(solution, b) for b in (0, 2)) < 1e-7


def test_a_good_preconditioner_saves_iterations(device):
    """The inverse of a matrix that is wrong by 1%."""
    given = problem(device)

    def precondition(residual):
        result = torch.zeros_like(residual)
        for own, matrix in zip(given.rows, given.matrices, strict=True):
            near = 1.01 * matrix - 0.03 * torch.eye(len(matrix)).to(matrix)
            result[own] = torch.linalg.solve(near, residual[own].flatten()).unflatten(0, (-1, 2))
        return result

    plain, better = given.solve(1e-9, 400), given.solve(1e-9, 400, precondition)
    assert int(better.iterations.max()) < 0.5 * int(plain.iterations.max())
    assert max(given.error(better.solution, b) for b in (0, 2)) < 1e-7


def test_what_does_not_converge_is_reported(device, monkeypatch):
    """Too few iterations; and a matrix that shifts a unit vector, whose residual restarts would never lessen."""
    monkeypatch.setattr(module, "DIRECTIONS", 5)
    given = problem(device)
    assert given.solve(1e-9, 3).converged.tolist() == [False, True, False, False]
    given.matrices[0] = torch.eye(len(given.matrices[0])).roll(1, 0).to(given.right)
    given.right[given.rows[0]] = 0
    given.right[given.rows[0][0], 0] = 1
    given.inverse = torch.eye(2).to(given.right).expand(len(given.right), 2, 2)
    solve = given.solve(1e-9, 400)
    assert solve.converged.tolist() == [False, True, True, False]
    assert int(solve.iterations[0]) == 5
