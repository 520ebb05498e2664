"""Particles as fields on a uniform grid: density and velocity of cells, by P2G."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..grid.grid import Grid
from ..grid.topology import PADDING
from ..ops import p2g

CELLS_AT_ONCE = 2**22


def cell_centres(lower: Sequence[float], upper: Sequence[float], dx: float) -> list[Tensor]:
    """Coordinates [m] of the centres of the cells along each axis, from the lower corner on; float64."""
    counts = [math.ceil((b - a) / dx - 1e-6) for a, b in zip(lower, upper, strict=True)]
    return [a + dx * (torch.arange(n, dtype=torch.float64) + 0.5) for a, n in zip(lower, counts, strict=True)]


def rasterise(
    position: Tensor, velocity: Tensor, mass: Tensor, lower: Sequence[float], upper: Sequence[float], dx: float
) -> tuple[Tensor, Tensor]:
    """Density and velocity of the cells of a grid.

    Quadratic B-splines about the centres of the cells; contributions beyond the outermost cells are added to these, so
    that the densities times the volume of a cell add up to the mass of the particles.

    Args:
        position, velocity: [T, N, D] (m, m/s).
        mass: [N] kg.
        lower, upper: corners of the domain [D] (m).
        dx: size of a cell [m].

    Returns:
        density [T, X, Y(, Z)] (kg/m^D) and velocity [T, X, Y(, Z), D] (m/s), zero where there is no mass.
    """
    centres = cell_centres(lower, upper, dx)
    cells = [len(c) for c in centres]
    at_once = max(1, CELLS_AT_ONCE // math.prod(n + 2 * PADDING for n in cells))
    parts = [
        _fields(position[k : k + at_once], velocity[k : k + at_once], mass, [float(c[0]) for c in centres], cells, dx)
        for k in range(0, len(position), at_once)
    ]
    density, mean = zip(*parts, strict=True)
    return torch.cat(density), torch.cat(mean)


def _fields(
    position: Tensor, velocity: Tensor, mass: Tensor, first: list[float], cells: list[int], dx: float
) -> tuple[Tensor, Tensor]:
    frames, count, dim = position.shape
    grid = Grid(dx, first, [a + dx * max(n - 1, 0.5) for a, n in zip(first, cells, strict=True)], scenes=frames)
    scene = torch.arange(frames, dtype=torch.int32, device=position.device).repeat_interleave(count)
    x, v = position.reshape(-1, dim).contiguous(), velocity.reshape(-1, dim).contiguous()
    blocks = grid.activate(x, scene)
    dense = blocks.to_dense(p2g(blocks, x, mass.repeat(frames), v))
    for axis, n in enumerate(cells, start=1):
        dense = _folded(dense, axis, n)
    nodal_mass, momentum = dense[..., 0], dense[..., 1:]
    return nodal_mass / dx**dim, torch.where(nodal_mass[..., None] > 0, momentum / nodal_mass[..., None], 0.0)


def _folded(dense: Tensor, axis: int, cells: int) -> Tensor:
    """Only the cells of the domain along an axis, the outermost including the contributions beyond them."""
    inside = dense.narrow(axis, PADDING, cells).clone()
    inside.narrow(axis, 0, 1).add_(dense.narrow(axis, 0, PADDING).sum(axis, keepdim=True))
    beyond = PADDING + cells
    rest = dense.narrow(axis, beyond, dense.shape[axis] - beyond)
    inside.narrow(axis, cells - 1, 1).add_(rest.sum(axis, keepdim=True))
    return inside
