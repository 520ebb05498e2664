"""Arrays in the form of a shard, read by zlib."""

import zlib

import numpy as np

from torch_mpm.data.packing import CHUNK_BYTES


def unpacked(stored):
    """By zlib and transposition, as HDF5's filters do it."""
    rows = []
    for chunk in map(zlib.decompress, stored.chunks):
        elements = np.frombuffer(chunk, np.uint8).reshape(stored.dtype.itemsize, -1).T
        rows.append(np.ascontiguousarray(elements).view(stored.dtype).reshape(-1, *stored.shape[1:]))
        assert len(rows[-1]) == stored.chunk_frames and rows[-1].nbytes <= max(CHUNK_BYTES, rows[-1][:1].nbytes)
    joined = np.concatenate(rows)
    assert not joined[stored.shape[0] :].any()
    return joined[: stored.shape[0]]
