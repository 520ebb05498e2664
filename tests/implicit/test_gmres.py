"""Restarted GMRES of implicit steps against a dense solve."""

import pytest
import torch
from helpers import relative_error

import torch_mpm as mpm
from torch_mpm.implicit import gmres as module
from torch_mpm.implicit.gmres import gmres
from torch_mpm.implicit.system import ImplicitSystem


@pytest.mark.parametrize("kept", [40, 5])
def test_scenes_against_dense_solves(kept, device, monkeypatch):
    """A matrix of each scene that is not symmetric; one scene has nothing to solve."""
    monkeypatch.setattr(module, "DIRECTIONS", kept)
    grid = mpm.Grid(1.0, (0.0, 0.0), (1.0, 1.0), scenes=3)
    x = torch.full((3, 2), 0.4, dtype=torch.float64, device=device)
    scene = torch.arange(3, dtype=torch.int32, device=device)
    one = torch.ones_like(x[:, 0])
    state = mpm.State(x=x, v=0 * x, mass=one, volume=one, F=torch.eye(2).to(x).repeat(3, 1, 1), scene=scene)
    blocks = grid.activate(x, scene)
    nodes = mpm.p2g(blocks, x, one, 0 * x)
    system = ImplicitSystem(blocks, mpm.Hencky(E=1.0, nu=0.0), state, nodes[:, 0], nodes[:, 1:], 1.0, "mls")
    rows = [(blocks.node_scene() == b).nonzero()[:, 0] for b in range(3)]
    generator = torch.Generator().manual_seed(0)
    matrices = []
    for own in rows:
        random = torch.randn(2 * len(own), 2 * len(own), generator=generator, dtype=torch.float64).to(device)
        matrices.append(3 * torch.eye(2 * len(own)).to(random) + random / len(own) ** 0.5)
    right = torch.randn(blocks.node_count, 2, generator=generator, dtype=torch.float64).to(device)
    right[rows[1]] = 0
    right[blocks.node_scene() < 0] = 0

    def product(v):
        result = torch.zeros_like(v)
        for own, matrix in zip(rows, matrices, strict=True):
            result[own] = (matrix @ v[own].flatten()).unflatten(0, (-1, 2))
        return result

    inverse = torch.linspace(0.5, 2.0, len(right)).to(right)[:, None, None] * torch.eye(2).to(right)
    relative = torch.full((3,), 1e-9, dtype=torch.float64, device=device)
    solution, iterations, converged = gmres(system, product, inverse, right, relative, 400)
    assert bool(converged.all())
    assert iterations[1] == 0 and (solution[rows[1]] == 0).all()
    assert (iterations[0] > kept) == (kept == 5) and int(iterations.max()) < 400
    for b in (0, 2):
        exact = torch.linalg.solve(matrices[b], right[rows[b]].flatten())
        assert relative_error(solution[rows[b]].flatten(), exact) < 1e-7
