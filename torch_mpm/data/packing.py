"""Compression, hashing and statistics of arrays of scenes for a shard, in any thread.

The rows of an array [T, ...] may arrive one after another and need not be in memory together; the content of a shard
does not depend on their order of arrival.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import optional
from .statistics import Motion, motion_sums

Array = npt.NDArray[Any]

CHUNK_BYTES = 2**17
"""Approximate size of a chunk before compression: a window of some frames reads little more than itself."""
GZIP_LEVEL = 1
PIECE_BYTES = 2**20
"""Approximate size of data processed at once: it fits in the cache, and few calls wait for Python's lock.
"""


def isal_zlib_module() -> Any:
    """A zlib implementation that is about ten times as fast, and compresses a tenth less."""
    return optional.load("isal.isal_zlib", "data sets", "data")


# ---- one array


@dataclass(frozen=True)
class Compressed:
    """Array in the form of the file: chunks of ``chunk_frames`` rows, shuffled by bytes and compressed.

    The last chunk is padded with zeros. ``digest`` is the SHA-256 of the numbers.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_frames: int
    chunks: list[bytes]
    digest: bytes


def chunk_frames(shape: tuple[int, ...], dtype: npt.DTypeLike) -> int:
    """Number of rows of the first axis per chunk."""
    row = math.prod(shape[1:]) * np.dtype(dtype).itemsize
    return max(1, min(shape[0], CHUNK_BYTES // max(row, 1)))


class _Scratch(threading.local):
    """Reused memory of a thread: new memory for each piece would be mapped page by page."""

    def __init__(self) -> None:
        self._bytes = np.empty(0, np.uint8)

    def two(self, size: int) -> tuple[Array, Array]:
        """Arrays of a given size, with undefined contents."""
        second = -(-size // 64) * 64
        if len(self._bytes) < second + size:
            self._bytes = np.empty(second + size, np.uint8)
        return self._bytes[:size], self._bytes[second : second + size]


_scratch = _Scratch()


class Packing:
    """Array [T, ...] with at least one element that is compressed and hashed while its rows arrive.

    Other threads may run at the same time; one at a time may call `append`.

    Args:
        shape, dtype: shape and dtype of the array.
    """

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)
        self._chunk_frames = chunk_frames(shape, dtype)
        self._chunks: list[bytes] = []
        self._digest = hashlib.sha256()
        self._row = math.prod(shape[1:]) * self.dtype.itemsize
        self._rest = np.empty((0, *shape[1:]), self.dtype)
        self._done = 0

    def append(self, rows: Array) -> None:
        """Process the next rows [k, ...], with any strides.

        Raises:
            ValueError: for rows of another shape or type, or too many.
        """
        left = self.shape[0] - self._done - len(self._rest)
        if rows.shape[1:] != self.shape[1:] or rows.dtype != self.dtype or len(rows) > left:
            expected = f"at most {left} of shape {list(self.shape[1:])} and type {self.dtype}"
            raise ValueError(f"rows must be {expected}, got {list(rows.shape)} of type {rows.dtype}")
        at_once = self._chunk_frames * max(1, PIECE_BYTES // (self._chunk_frames * self._row))
        while len(rows):
            count = at_once - len(self._rest)
            self._take(rows[:count])
            rows = rows[count:]

    def _take(self, rows: Array) -> None:
        """Hash and compress the complete chunks of remaining and new rows; with the last rows, all."""
        before, every = len(self._rest), self._chunk_frames
        count = before + len(rows)
        last = self._done + count == self.shape[0]
        chunks = -(-count // every) if last else count // every
        whole = min(count, chunks * every)
        size = max(count, chunks * every) * self._row
        fresh, planes = _scratch.two(size)
        values = fresh.view(self.dtype).reshape(-1, *self.shape[1:])
        values[:before], values[before:count], values[count:] = self._rest, rows, 0
        self._rest, self._done = values[whole:count].copy(), self._done + whole
        self._digest.update(values[:whole].data)
        if chunks:
            self._compress(values[: chunks * every], planes[: values[: chunks * every].nbytes], chunks)

    def _compress(self, values: Array, planes: Array, chunks: int) -> None:
        """Append chunks, shuffled by bytes; the values are overwritten."""
        size, pack = self.dtype.itemsize, isal_zlib_module().compress
        words = values.reshape(-1).view(f"<u{size}").reshape(chunks, -1)
        planes = planes.reshape(chunks, size, -1)
        for k in range(size):  # Faster than a transposition.
            np.copyto(planes[:, k], words, casting="unsafe")
            np.right_shift(words, 8, out=words)
        self._chunks += [pack(chunk, GZIP_LEVEL) for chunk in planes]

    def finish(self) -> Compressed:
        """Complete array.

        Raises:
            ValueError: where rows are missing.
        """
        if self._done < self.shape[0]:
            raise ValueError(f"{self.shape[0]} rows must have come, got {self._done + len(self._rest)}")
        return Compressed(self.shape, self.dtype, self._chunk_frames, self._chunks, self._digest.digest())


def packed(values: Array) -> Compressed:
    """Pack an existing array [T, ...]."""
    packing = Packing(values.shape, values.dtype)
    packing.append(values)
    return packing.finish()


# ---- one scene


def array_digest(values: Array) -> bytes:
    """SHA-256 of the numbers of an array."""
    return hashlib.sha256(np.ascontiguousarray(values).data).digest()


def content_hash(arrays: Mapping[str, Array | Compressed]) -> str:
    """SHA-256 of the arrays of a scene: of their names, types, shapes and numbers, for any storage."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = arrays[name]
        digest.update(f"{name} {values.dtype.str} {values.shape} ".encode())
        digest.update(values.digest if isinstance(values, Compressed) else array_digest(values))
    return digest.hexdigest()


@dataclass(frozen=True)
class PreparedScene:
    """Scene ready to be written: its arrays as stored, and its entries of the record."""

    arrays: Mapping[str, Array | Compressed]
    particles: int
    hash: str
    motion: Motion | None

    @property
    def digests(self) -> dict[str, str]:
        """Digests of the uncompressed arrays, whose bytes have no other protection."""
        plain = {name: values for name, values in self.arrays.items() if not isinstance(values, Compressed)}
        return {name: array_digest(values).hex() for name, values in plain.items()}


def prepare_scene(
    arrays: Mapping[str, Array], before: Mapping[str, Compressed] | None = None, motion: Motion | None = None
) -> PreparedScene:
    """Compress, hash and sum up a scene; may run in any thread, and needs no h5py.

    Args:
        arrays: ``position`` [T, N, D] and the other arrays of the scene; none for a failed scene.
        before: arrays that have been packed before.
        motion: sums of its positions; needed where these have been packed.

    Raises:
        ValueError: for positions that are not finite, or arrays without ``position``.
    """
    stored: dict[str, Array | Compressed] = {**arrays, **(before or {})}
    if not stored:
        return PreparedScene({}, 0, content_hash({}), None)
    if "position" not in stored or len(stored["position"].shape) != 3:
        raise ValueError(f"arrays must have position [T, N, D], got {', '.join(stored)}")
    if motion is None:
        motion = motion_sums(arrays["position"], arrays.get("particle_type"))
    elif not motion.finite:
        raise ValueError("position must be finite")
    stored |= {name: packed(values) for name, values in arrays.items() if values.ndim > 1 and values.size}
    return PreparedScene(stored, stored["position"].shape[1], content_hash(stored), motion)
