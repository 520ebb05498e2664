"""Files of particles of taichi_elements: arrays of NumPy with quantised numbers, and PLY."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np

from ...data.whole_files import write_whole
from ...geometry.point_files import write_ply
from ...geometry.surface_mesh import Array

POSITION_BITS, VELOCITY_BITS = 24, 8
"""Bits of each number of a position, above those of a velocity, in 32 bits."""
NARROWEST = 1e-5
"""Smallest range of quantised numbers."""


def write_particles(path: str | os.PathLike[str], position: Array, velocity: Array, color: Array) -> None:
    """Write an .npz file with ranges [2, D, 2] (of positions and velocities, least and largest), x_and_v uint32 [P, D]
    and color uint8 [P, 3] (red, green, blue).

    A number a in a range l to h is the integer part of (a − l)/(h − l) (2^bits − 1) + 0.499.

    Args:
        path: the file; the suffix .npz is added where it is missing.
        position, velocity: [P, D] [m, m/s].
        color: 0xRRGGBB [P].

    Raises:
        OSError: when it cannot be written; nothing remains of it.
        ValueError: without particles.
    """
    if len(position) == 0:
        raise ValueError("write_particles needs particles: there are none, so that their numbers have no range")
    fields = ((position, POSITION_BITS), (velocity, VELOCITY_BITS))
    ranges = np.stack([_ranges(values) for values, _ in fields])
    x, v = (_quantised(values, r, bits) for (values, bits), r in zip(fields, ranges, strict=True))
    data = io.BytesIO()
    np.savez(data, ranges=ranges, x_and_v=(x << np.uint32(VELOCITY_BITS)) + v, color=_channels(color))
    file = Path(path)
    write_whole(file if file.suffix == ".npz" else file.with_name(file.name + ".npz"), data.getvalue())


def write_particles_ply(path: str | os.PathLike[str], position: Array, color: Array) -> None:
    """Write a binary PLY file with x, y, z (0 in 2-D), float, and red, green, blue, placeholder, uchar.

    Args:
        path: the file.
        position: [P, D] [m].
        color: 0xRRGGBB [P].

    Raises:
        OSError: when it cannot be written; nothing remains of it.
    """
    x = np.pad(position.astype(np.float32), ((0, 0), (0, 3 - position.shape[1])))
    columns = {axis: x[:, k] for k, axis in enumerate("xyz")}
    columns |= {name: _channels(color)[:, k] for k, name in enumerate(("red", "green", "blue"))}
    write_ply(path, columns | {"placeholder": np.zeros(len(x), np.uint8)})


def _ranges(values: Array) -> Array:
    """Least and largest number on each axis, float32 [D, 2]."""
    low, high = values.min(0).astype(np.float32), values.max(0).astype(np.float32)
    above = np.maximum(low + np.float32(NARROWEST), np.nextafter(low, np.float32(np.inf)))
    return np.stack([low, np.maximum(high, above)], 1)


def _quantised(values: Array, ranges: Array, bits: int) -> Array:
    """Whole numbers of some bits for values in ranges, uint32 [P, D]."""
    low, high = ranges.astype(np.float64).T
    return ((values - low) / (high - low) * (2**bits - 1) + 0.499).astype(np.uint32)


def _channels(color: Array) -> Array:
    """Red, green and blue of 0xRRGGBB, uint8 [P, 3]."""
    return np.stack([(color >> shift) & 255 for shift in (16, 8, 0)], 1).astype(np.uint8)
