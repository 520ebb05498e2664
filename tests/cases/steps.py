"""A block of matter and a step."""

import torch

import torch_mpm as mpm


def block_state(dim, device="cpu", dtype=torch.float64, scene=None, low=0.3, high=0.6, spin=0.5, dx=0.1):
    """A jittered elastic block that moves and turns; well inside [0, 1]^D."""
    points = mpm.seed.box((low,) * dim, (high,) * dim, dx, per_cell=2**dim)
    state = mpm.State.at_rest(points, density=1000.0, dtype=dtype, device=device)
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand(state.x.shape, generator=generator, dtype=torch.float64).to(state.x)
    x = state.x + 0.02 * (noise - 0.5)
    r = x - x.mean(0)
    turned = torch.cat([-r[:, 1:2], r[:, :1], 0 * r[:, 2:]], 1)
    return state.replace(x=x, v=0.2 + spin * turned, scene=scene)


def make_step(dim, scenes=1, E=1e4, **options):
    grid = mpm.Grid(0.1, (0,) * dim, (1,) * dim, scenes=scenes, **options.pop("grid", {}))
    return mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.3), **options)
