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
FRAMES = 64
"""That are summed up at once: few calls, each of which waits for Python's lock, and what nearly fits into caches."""


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
    if not np.isfinite(position).all():
        raise ValueError("position must be finite")
    free = position if particle_type is None else position[:, particle_type != BOUNDARY]
    dim = position.shape[2]
    motion = Motion(Sums.zero(dim), Sums.zero(dim))
    last = np.zeros((dim, 0, free.shape[1]))  # velocity [D, 1, N] of the frame before
    for first in range(0, len(free) - 1, FRAMES):
        axes = free[first : first + FRAMES + 1].transpose(2, 0, 1).astype(np.float64, order="C")
        velocity = np.diff(axes, axis=1)
        acceleration = np.diff(np.concatenate([last, velocity], 1), axis=1)
        motion += Motion(Sums.of(velocity), Sums.of(acceleration))
        last = velocity[:, -1:]
    return motion
