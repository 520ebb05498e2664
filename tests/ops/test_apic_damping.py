"""The share of a shear wave that APIC loses per step, which docs/recipes.md names."""

import math

import pytest
import torch

import torch_mpm as mpm

SHARE = {"quadratic": 0.024, "cubic": 0.047}


@pytest.mark.parametrize("per_axis", [2, 3])
def test_a_shear_wave_loses_a_share_of_the_fourth_power_of_its_wave_number(kernel, per_axis):
    cells, steps = 32, 5
    grid = mpm.Grid(1.0, (0, 0), (12, 3 * cells), kernel=kernel)
    axes = ((torch.arange(n * per_axis, dtype=torch.float64) + 0.5) / per_axis for n in (12, 3 * cells))
    x = torch.cartesian_prod(*axes)
    k = 2 * math.pi / cells
    v = torch.stack([torch.cos(k * x[:, 1]), torch.zeros_like(x[:, 1])], 1)
    C = torch.zeros(len(x), 2, 2, dtype=torch.float64)
    C[:, 0, 1] = -k * torch.sin(k * x[:, 1])
    mass, blocks = torch.ones_like(x[:, 0]), grid.activate(x)
    inside = ((x - torch.tensor([6.0, 1.5 * cells])).abs() <= torch.tensor([0.5, 0.5 * cells])).all(1)

    def amplitude() -> float:
        wave = torch.cos(k * x[inside, 1])
        return float((v[inside, 0] * wave).sum() / wave.square().sum())

    for n in range(2 * steps):
        if n == steps:  # the affine field is that of the transfers by now
            before = amplitude()
        nodes = mpm.p2g(blocks, x, mass, v, C)
        v, C = mpm.g2p(blocks, x, nodes[:, 1:] / nodes[:, :1].clamp_min(1e-300))[:2]
    lost = 1 - (amplitude() / before) ** (1 / steps)
    assert lost == pytest.approx(SHARE[kernel] * k**4, rel=0.03)
