"""Arrays of scenes on their way into a shard: compressed, hashed and summed up, in whatever thread there is.

The rows of an array [T, ...] may come one after another; what a shard stores does not depend on how.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .statistics import Motion, motion_sums

Array = npt.NDArray[Any]

CHUNK_BYTES = 2**17
"""Of a chunk before compression, about: a window of some frames reads little more than itself."""
GZIP_LEVEL = 1


def isal_zlib_module() -> Any:
    """A zlib that is some ten times as fast, and compresses a tenth less."""
    try:
        from isal import isal_zlib
    except ImportError as error:
        raise ImportError("data sets need isal: pip install torch-mpm[data]") from error
    return isal_zlib


# ---- one array


@dataclass(frozen=True)
class Compressed:
    """An array as it lies in the file: chunks of ``chunk_frames`` rows, shuffled by bytes and compressed.

    The last chunk is filled up with zeros.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_frames: int
    chunks: list[bytes]


def chunk_frames(shape: tuple[int, ...], dtype: npt.DTypeLike) -> int:
    """Rows of the first axis that make a chunk."""
    row = math.prod(shape[1:]) * np.dtype(dtype).itemsize
    return max(1, min(shape[0], CHUNK_BYTES // max(row, 1)))


class Packing:
    """An array [T, ...] with at least one element that is compressed and hashed while its rows come.

    Other threads run meanwhile, and one at a time may call `advance`.

    Args:
        values: the array; its rows may still be empty.
    """

    def __init__(self, values: Array) -> None:
        self.values = values
        self._chunk_frames = chunk_frames(values.shape, values.dtype)
        self._chunks: list[bytes] = []
        self._digest = hashlib.sha256()
        self._done = 0

    def advance(self, rows: int) -> None:
        """Take in all whole chunks of the first ``rows`` rows, which stay as they are from now on.

        Raises:
            ValueError: for rows that the array does not have.
        """
        if not 0 <= rows <= len(self.values):
            raise ValueError(f"rows must be within 0 and {len(self.values)}, got {rows}")
        end = rows if rows == len(self.values) else rows - rows % self._chunk_frames
        if end <= self._done:
            return
        fresh = np.ascontiguousarray(self.values[self._done : end])
        self._digest.update(fresh.data)
        self._compress(fresh)
        self._done = end

    def _compress(self, fresh: Array) -> None:
        """Append chunks. A buffer of one chunk stays in the cache, and is not mapped and unmapped by each thread."""
        pack, size = isal_zlib_module().compress, fresh.itemsize
        elements = fresh.reshape(len(fresh), -1).view(np.uint8).reshape(len(fresh), -1, size)
        shuffled = np.empty((size, self._chunk_frames * elements.shape[1]), np.uint8)
        for first in range(0, len(fresh), self._chunk_frames):
            chunk = elements[first : first + self._chunk_frames].reshape(-1, size)
            shuffled[:, : len(chunk)] = chunk.T
            shuffled[:, len(chunk) :] = 0
            self._chunks.append(pack(shuffled, GZIP_LEVEL))

    def compressed(self) -> Compressed:
        """What a shard stores of the array, all of whose rows are there."""
        self.advance(len(self.values))
        return Compressed(self.values.shape, self.values.dtype, self._chunk_frames, self._chunks)

    def digest(self) -> bytes:
        """SHA-256 of the array, all of whose rows are there."""
        self.advance(len(self.values))
        return self._digest.digest()


# ---- one scene


def content_hash(arrays: Mapping[str, Array], packings: Mapping[str, Packing] | None = None) -> str:
    """SHA-256 of the arrays of a scene: of their names, types, shapes and numbers, however they are stored.

    Args:
        arrays: by name.
        packings: of some of the arrays, which know what these are hashed to.
    """
    digest, known = hashlib.sha256(), packings or {}
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {values.dtype.str} {values.shape} ".encode())
        digest.update(known[name].digest() if name in known else hashlib.sha256(values.data).digest())
    return digest.hexdigest()


@dataclass(frozen=True)
class PreparedScene:
    """A scene ready to be written: its arrays as they are stored, and what the record says about them."""

    arrays: Mapping[str, Array | Compressed]
    particles: int
    hash: str
    motion: Motion | None


def prepare_scene(arrays: Mapping[str, Array], begun: Mapping[str, Packing] | None = None) -> PreparedScene:
    """Compress, hash and sum up a scene; may run in any thread, and needs no h5py.

    Args:
        arrays: ``position`` [T, N, D] and the other arrays of the scene; none for a scene that failed.
        begun: packings to go on with, where they are of these arrays and not of others with their names.

    Raises:
        ValueError: for positions that are not finite, or arrays without ``position``.
    """
    if not arrays:
        return PreparedScene({}, 0, content_hash({}), None)
    if "position" not in arrays or arrays["position"].ndim != 3:
        raise ValueError(f"arrays must have position [T, N, D], got {', '.join(arrays)}")
    motion = motion_sums(arrays["position"], arrays.get("particle_type"))
    packings = {}
    for name, values in arrays.items():
        if values.ndim > 1 and values.size:
            packing = (begun or {}).get(name)
            packings[name] = packing if packing is not None and packing.values is values else Packing(values)
    stored = {name: packings[name].compressed() if name in packings else values for name, values in arrays.items()}
    return PreparedScene(stored, arrays["position"].shape[1], content_hash(arrays, packings), motion)
