"""Grids and bodies from which tests and benchmarks make their scenes; lengths in a box of about 1 m."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

import torch_mpm as mpm

F64 = torch.float64


def unit_box(dim: int = 3, dx: float = 0.0625, **options: Any) -> mpm.Grid:
    """The unit box."""
    return mpm.Grid(dx=dx, lower=(0.0,) * dim, upper=(1.0,) * dim, **options)


def block(
    lower: Sequence[float],
    upper: Sequence[float],
    dx: float | mpm.Grid,
    density: float = 1000.0,
    velocity: Any = None,
    dtype: torch.dtype = F64,
    device: str = "cpu",
    per_cell: float | None = None,
) -> mpm.State:
    """Undeformed matter between two corners; two particles along each axis of a cell by default."""
    points = mpm.seed.box(lower, upper, dx, per_cell or 2 ** len(lower))
    return mpm.State.at_rest(points, density, velocity, dtype, device)


def block_state(
    dim: int,
    device: str = "cpu",
    dtype: torch.dtype = F64,
    scene: torch.Tensor | None = None,
    low: float = 0.3,
    high: float = 0.6,
    spin: float = 0.5,
    dx: float = 0.1,
) -> mpm.State:
    """A jittered elastic block that moves and turns; well inside the unit box."""
    state = block((low,) * dim, (high,) * dim, dx, dtype=dtype, device=device)
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand(state.x.shape, generator=generator, dtype=torch.float64).to(state.x)
    x = state.x + 0.02 * (noise - 0.5)
    r = x - x.mean(0)
    turned = torch.cat([-r[:, 1:2], r[:, :1], 0 * r[:, 2:]], 1)
    return state.replace(x=x, v=0.2 + spin * turned, scene=scene)


def blob(device: str, dim: int = 3, count: int = 300, dtype: torch.dtype = F64, **fields: Any) -> mpm.State:
    """Light particles at random in the middle of the unit box, with velocities of 1 m/s."""
    g = torch.Generator().manual_seed(3)
    x = 0.3 + 0.4 * torch.rand(count, dim, generator=g, dtype=F64)
    v = torch.randn(count, dim, generator=g, dtype=F64)
    ones = torch.ones(count, dtype=F64)
    state = mpm.State(x=x, v=v, mass=1e-3 * ones, volume=1e-6 * ones, **fields)
    return state.to(device, dtype)


def touched(kind: str, dim: int) -> mpm.Walls:
    """Walls that the blob is in."""
    return mpm.Walls(kind, lower=(0.3125,) * dim, upper=(0.6875,) * dim)


def short_bar(
    dim: int,
    device: str = "cpu",
    dtype: torch.dtype = F64,
    lower: float = 0.5,
    density: float = 1000.0,
    dx: float = 0.125,
    per_cell: float | None = None,
    **options: Any,
) -> tuple[mpm.Grid, mpm.State]:
    """A bar of 0.5 x 0.25 (x 0.25) m along x at y = z = `lower`, in a box of 2 x 1.5 (x 1.5) m with `options`."""
    grid = mpm.Grid(dx, (0.0,) * dim, (2.0,) + (1.5,) * (dim - 1), **options)
    ends = (0.5,) + (lower,) * (dim - 1), (1.0,) + (lower + 0.25,) * (dim - 1)
    return grid, block(*ends, grid, density, None, dtype, device, per_cell)


def make_step(dim: int, scenes: int = 1, E: Any = 1e4, **options: Any) -> mpm.Step:
    """A step of the block in the unit box; `grid` are options of the grid."""
    grid = unit_box(dim, 0.1, scenes=scenes, **options.pop("grid", {}))
    return mpm.Step(grid, mpm.NeoHookean(E=E, nu=0.3), **options)
