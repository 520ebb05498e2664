"""Statistics of motions, for the normalisation of learned simulators: sums of scenes, which add up to those of a
split.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..errors import is_finite

Array = npt.NDArray[Any]

BOUNDARY = 3
"""Type of particles with prescribed motion, which is not to be learned, and excluded from statistics."""


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
        """Sums of vectors [D, ...]."""
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
    """Statistics of a scene for learned simulators: first and second differences of positions per frame [m]."""

    velocity: Sums
    acceleration: Sums

    def __add__(self, other: Motion) -> Motion:
        return Motion(self.velocity + other.velocity, self.acceleration + other.acceleration)

    @property
    def finite(self) -> bool:
        """Whether all positions were finite."""
        return all(is_finite(v) for s in (self.velocity, self.acceleration) for v in (*s.sum, *s.squares))


class MotionSums:
    """Sums of the motions of all particles as frames arrive, on their device. Positions are rounded to float32, as
    stored; each particle has separate sums, so that they do not depend on other scenes of the batch.
    """

    def __init__(self) -> None:
        self._frames = 0

    def add(self, position: Tensor) -> None:
        """Add the next frame [P, D] [m]."""
        x = position.float()
        if self._frames == 0:
            self._first, self._last = x.double(), x.double()
            self._v, self._start, self._free, *self._squares = (torch.zeros_like(self._first) for _ in range(5))
        else:
            v = torch.sub(x, self._last, out=self._free)
            self._squares[0].addcmul_(v, v)
            if self._frames == 1:
                self._start.copy_(v)
            else:
                a = torch.sub(v, self._v, out=self._v)
                self._squares[1].addcmul_(a, a)
            self._v, self._free = v, self._v
            self._last.copy_(x)
        self._frames += 1

    def of_scenes(self, ends: Sequence[int]) -> list[Motion]:
        """Statistics of each scene, given as a range of particles. Waits for the device."""
        steps = self._frames - 1
        sums = [self._last - self._first, *self._squares[:1], self._v - self._start, *self._squares[1:]]
        rows = torch.stack(sums, 1).cpu().numpy()  # Sums of differences are differences of ends.
        motions = []
        for first, end in itertools.pairwise(ends):
            count = end - first
            velocity, squares, acceleration, others = map(tuple, rows[first:end].sum(0).tolist())
            motions.append(
                Motion(Sums(count * steps, velocity, squares), Sums(count * max(steps - 1, 0), acceleration, others))
            )
        return motions


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
    boundary = particle_type is not None and BOUNDARY in particle_type
    free: Any = particle_type != BOUNDARY if boundary else slice(None)
    if not len(position):
        return Motion(*[Sums.zero(position.shape[2])] * 2)
    sums = MotionSums()
    for frame in position:
        sums.add(torch.from_numpy(frame[free]))
    return sums.of_scenes([0, len(position[0, free])])[0]
