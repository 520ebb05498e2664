"""Statistics of motions, by which learned simulators normalise: sums of scenes, which add up to those of a split."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

BOUNDARY = 3
"""Particle type of what moves as prescribed; its motion is not to be learned, and is in no statistics."""
PIECE = 2**15
"""Numbers summed up at once: they stay in the cache, and calls are few, since each waits for Python's lock."""


@dataclass(frozen=True)
class Sums:
    """Sums of vectors over frames and particles, in float64; those of several scenes are added."""

    count: int
    sum: tuple[float, ...]
    squares: tuple[float, ...]

    @classmethod
    def zero(cls, dim: int) -> Sums:
        return cls(0, (0.0,) * dim, (0.0,) * dim)

    @classmethod
    def of(cls, vectors: Array) -> Sums:
        """Of vectors [D, ...]."""
        axes = vectors.reshape(len(vectors), -1)
        squares = tuple(float(np.einsum("n,n->", axis, axis)) for axis in axes)
        return cls(axes.shape[1], tuple(axes.sum(1).tolist()), squares)

    def __add__(self, other: Sums) -> Sums:
        def added(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(x + y for x, y in zip(a, b, strict=True))

        return Sums(self.count + other.count, added(self.sum, other.sum), added(self.squares, other.squares))

    @property
    def mean(self) -> list[float]:
        return [s / max(self.count, 1) for s in self.sum]

    @property
    def std(self) -> list[float]:
        pairs = zip(self.squares, self.mean, strict=True)
        return [math.sqrt(max(q / max(self.count, 1) - m * m, 0.0)) for q, m in pairs]


@dataclass(frozen=True)
class Motion:
    """Statistics of a scene as learned simulators use them: first and second differences of positions per frame [m]."""

    velocity: Sums
    acceleration: Sums

    def __add__(self, other: Motion) -> Motion:
        return Motion(self.velocity + other.velocity, self.acceleration + other.acceleration)


def motion_sums(position: Array, particle_type: Array | None = None) -> Motion:
    """Sums over the particles of a scene that are not of type ``BOUNDARY``.

    Args:
        position: [T, N, D] m.
        particle_type: [N]; None counts all particles.

    Raises:
        ValueError: for positions that are not finite.
    """
    if position.size and not np.isfinite([position.min(), position.max()]).all():
        raise ValueError("position must be finite")
    frames, _, dim = position.shape
    free = slice(None) if particle_type is None or BOUNDARY not in particle_type else particle_type != BOUNDARY
    count = position[:1, free].shape[1]
    if frames < 2 or not count:
        return Motion(Sums.zero(dim), Sums.zero(dim))
    first, last = (np.diff(position[rows, free].astype(np.float64), axis=0)[0] for rows in (slice(2), slice(-2, None)))
    travel = position[-1, free].astype(np.float64) - position[0, free]  # sums of differences are differences of ends
    velocity, acceleration = _squares(position, free, first.reshape(-1))
    return Motion(
        Sums(count * (frames - 1), _totals(travel, dim), _totals(velocity, dim)),
        Sums(count * (frames - 2), _totals(last - first, dim), _totals(acceleration, dim)),
    )


def _totals(values: Array, dim: int) -> tuple[float, ...]:
    """Over all particles."""
    return tuple(values.reshape(-1, dim).sum(0).tolist())


def _squares(position: Array, free: Any, first: Array) -> Array:
    """Sums over frames of the squares of velocities and accelerations [2, N D] of the particles that are free.

    In pieces, and buffers that stay: large ones would be mapped and unmapped anew by each of many threads.
    """
    frames, width = len(position), len(first)
    rows = max(1, min(frames - 1, PIECE // width))
    velocity, acceleration, squares = np.empty((rows + 1, width)), np.empty((rows, width)), np.zeros((2, width))
    velocity[0] = first  # no acceleration at the start, and from then on the velocity of the piece before
    for start in range(0, frames - 1, rows):
        x = position[start : start + rows + 1, free].reshape(-1, width)
        steps = len(x) - 1
        v = np.subtract(x[1:], x[:-1], out=velocity[1 : steps + 1], dtype=np.float64)
        a = np.subtract(v, velocity[:steps], out=acceleration[:steps])
        for total, vectors in zip(squares, (v, a), strict=True):
            total += np.einsum("tk,tk->k", vectors, vectors)
        velocity[0] = v[-1]
    return squares
