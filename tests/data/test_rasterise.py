"""Particles as fields of cells: where their mass and momentum go."""

import pytest
import torch

from torch_mpm.data.rasterise import cell_centres, rasterise


def test_rasterised_fields(device):
    """One particle at the centre of a cell; at a corner of the domain all its mass is kept; nothing in empty cells."""
    x = torch.tensor([[[0.35, 0.45]], [[0.0, 0.8]]], device=device)
    v = torch.tensor([[[1.0, -2.0]], [[3.0, 4.0]]], device=device)
    density, velocity = rasterise(x, v, torch.tensor([2.0], device=device), (0.0, 0.0), (1.0, 0.8), 0.1)
    assert density.shape == (2, 10, 8) and velocity.shape == (2, 10, 8, 2)
    row = torch.tensor([0.125, 0.75, 0.125], device=device)
    torch.testing.assert_close(density[0, 2:5, 3:6], 200 * row[:, None] * row, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(velocity[0, 3, 4], v[0, 0])
    assert float(density[1, 0, 7]) == pytest.approx(200)
    torch.testing.assert_close(density.sum((1, 2)), torch.full((2,), 200.0, device=device))
    assert (velocity[1, 5:] == 0).all() and cell_centres((0.0,), (0.8,), 0.1)[0][[0, -1]].tolist() == pytest.approx(
        [0.05, 0.75]
    )


def test_no_particles_have_no_density():
    density, velocity = rasterise(
        torch.zeros(3, 0, 2), torch.zeros(3, 0, 2), torch.zeros(0), (0.0, 0.0), (1.0, 1.0), 0.25
    )
    assert density.shape == (3, 4, 4) and not density.any() and not velocity.any()
