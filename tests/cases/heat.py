"""Blocks of matter that conduct heat, and checks of gradients of heat."""

import pytest
import torch

import torch_mpm as mpm

FLOAT, NAN = torch.float64, float("nan")


def block(dim=2, device="cpu", dtype=FLOAT, n=8, jitter=0.0, low=0.0, high=1.0, density=2.0, dx=None):
    """A block of unit size on a lattice that it does not fit, and a grid around it with room to move."""
    dx = dx or 1 / n
    points = mpm.seed.box((low,) * dim, (high,) * dim, dx, per_cell=2**dim)
    state = mpm.State.at_rest(points, density=density, dtype=FLOAT)
    noise = torch.rand(state.x.shape, generator=torch.Generator().manual_seed(2), dtype=FLOAT) - 0.5
    return state.replace(x=state.x + 0.37 * dx + jitter * dx * noise).to(device, dtype)


def grid_around(dim=2, n=8, low=-0.5, high=1.5, **options):
    return mpm.Grid(1 / n, (low,) * dim, (high,) * dim, **options)


def random_like(t, seed=5):
    return torch.rand(t.shape, generator=torch.Generator().manual_seed(seed), dtype=FLOAT).to(t)


def check_gradients(loss, inputs):
    """The gradient by each input along a random direction, against differences of the loss."""
    gradients = torch.autograd.grad(loss(*inputs), inputs)
    for k, gradient in enumerate(gradients):
        direction = random_like(inputs[k], 20 + k) + 0.5
        with torch.no_grad():
            sides = [loss(*(t + s * 1e-6 * direction if j == k else t for j, t in enumerate(inputs))) for s in (1, -1)]
        slope = float((sides[0] - sides[1]) / 2e-6)
        assert float((gradient * direction).sum()) == pytest.approx(slope, rel=2e-5, abs=1e-5), k
