"""Common work of all programs of the comparison: a dense cube of neo-Hookean particles, quadratic kernel, float32.

side³ particles, 8 per cell with jitter, in a domain of the unit cube with n³ cells, sorted by block of 4³ nodes and by
cell. A smooth velocity field moves them, gravity pulls them, walls are far away. With heat they also conduct, from
smooth temperatures. Needs numpy alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

DENSITY = 1000.0
MU, LAM = 4e4, 6e4
GRAVITY = 9.8
DT = 1e-4
MARGIN = 8
"""Empty cells between the cube and the walls."""
SPECIFIC_HEAT = 1000.0
"""[J/(kg K)]"""
DIFFUSION = 1e-4
"""κ dt / (ρ C dx²) of cubes with heat."""


@dataclasses.dataclass(frozen=True)
class Program:
    """One step of a peer; synchronisation; the fields of the particles by the names of `State`; further figures."""

    step: Callable[[], None]
    synchronize: Callable[[], None]
    fields: Callable[[], dict[str, np.ndarray]]
    figures: Callable[[], dict[str, float]] = dict


@dataclasses.dataclass(frozen=True)
class Work:
    """Positions x and velocities v [P, 3] [m, m/s], n cells along a unit cube, mass [kg] and volume [m³] of one
    particle, and the size of the domain in unit cubes along each axis.
    """

    n: int
    x: np.ndarray
    v: np.ndarray
    volume: float
    cubes: tuple[int, int, int] = (1, 1, 1)

    @property
    def mass(self) -> float:
        return self.volume * DENSITY

    @property
    def particles(self) -> int:
        return len(self.x)

    @property
    def cells(self) -> tuple[int, int, int]:
        a, b, c = self.cubes
        return self.n * a, self.n * b, self.n * c

    def in_domain(self, times: int) -> Work:
        """The work in a larger domain, by a factor along each axis."""
        return dataclasses.replace(self, cubes=(times, times, times))

    def side_by_side(self, scenes: int) -> Work:
        """A number of these cubes, a power of two, in one domain: the form of scenes in a program without batches."""
        cubes = [1, 1, 1]
        while np.prod(cubes) < scenes:
            cubes[int(np.argmin(cubes))] *= 2
        places = np.stack(np.meshgrid(*map(np.arange, cubes), indexing="ij"), -1).reshape(-1, 1, 3)
        x = (places.astype(np.float32) + self.x).reshape(-1, 3)
        v = np.tile(self.v, (len(places), 1))
        return dataclasses.replace(self, x=x, v=v, cubes=(cubes[0], cubes[1], cubes[2]))


def cells_of(side: int) -> int:
    """Number of cells along the unit cube."""
    return side // 2 + 2 * MARGIN


def make(side: int) -> Work:
    """The cube with side³ particles."""
    n = cells_of(side)
    lattice = np.stack(np.meshgrid(*[np.arange(side, dtype=np.float32)] * 3, indexing="ij"), -1).reshape(-1, 3)
    jitter = np.random.default_rng(0).random(lattice.shape, dtype=np.float32)
    x = ((MARGIN + 0.5 * (lattice + 0.1 + 0.8 * jitter)) / n).astype(np.float32)
    # Base node with the three padding nodes of torch_mpm, so that its blocks are the ones sorted by.
    base = np.floor(x * np.float32(n) + np.float32(2.5)).astype(np.int64)
    block, cell = base >> 2, base & 3
    key = ((block[:, 0] * n + block[:, 1]) * n + block[:, 2]) * 64 + cell @ np.array([16, 4, 1])
    x = x[np.argsort(key, kind="stable")]
    turned = 2 * np.pi * x[:, [1, 2, 0]]
    return Work(n, x, (0.1 * np.sin(turned)).astype(np.float32), (0.5 / n) ** 3)


def conductivity(dx: float, diffusion: float = DIFFUSION) -> float:
    """κ [W/(m K)] with this diffusion number in a step of DT."""
    return diffusion * DENSITY * SPECIFIC_HEAT * dx**2 / DT


def temperature(x: np.ndarray) -> np.ndarray:
    """Temperatures of 0 to 10 K at the beginning [P]."""
    return (5 + 5 * np.sin(40 * x[:, 0]) * np.cos(30 * x[:, 1])).astype(np.float32)


def temperature_gradient(x: np.ndarray) -> np.ndarray:
    """Gradient of these temperatures [P, 3] [K/m]."""
    along_x = 200 * np.cos(40 * x[:, 0]) * np.cos(30 * x[:, 1])
    along_y = -150 * np.sin(40 * x[:, 0]) * np.sin(30 * x[:, 1])
    return np.stack([along_x, along_y, np.zeros_like(along_x)], 1).astype(np.float32)
