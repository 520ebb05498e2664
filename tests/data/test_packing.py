"""Packing: the same bytes whether the rows come at once or one after another."""

import hashlib
import zlib

import numpy as np
import pytest

pytest.importorskip("isal")

from torch_mpm.data import statistics
from torch_mpm.data.packing import CHUNK_BYTES, Packing, content_hash, prepare_scene
from torch_mpm.data.statistics import BOUNDARY, motion_sums

SHAPES = [(50, 700, 2), (7, 300, 3, 3), (3, 20_000, 3), (1, 5, 2), (40_000, 3), (9, 1, 1)]


def values_of(shape, dtype=np.float32, seed=0):
    return (1e3 * np.random.default_rng(seed).standard_normal(shape).cumsum(0)).astype(dtype)


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


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int8])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("step", [1, 5, 32, 10**6])
def test_rows_may_come_one_after_another(shape, dtype, step):
    values, step = values_of(shape, dtype), max(step, shape[0] // 100)
    coming = np.full_like(values, 7)
    packing = Packing(coming)
    for first in range(0, len(values), step):
        coming[first : first + step] = values[first : first + step]
        packing.advance(min(first + step, len(values)))
        packing.advance(first)  # nothing new
    stored, whole = packing.compressed(), Packing(values).compressed()
    np.testing.assert_array_equal(unpacked(stored), values)
    assert stored == whole
    assert packing.digest() == Packing(values).digest() == hashlib.sha256(values.tobytes()).digest()


def test_rows_that_are_not_there():
    packing = Packing(values_of((5, 4, 2)))
    for rows in (6, -1):
        with pytest.raises(ValueError, match=f"rows must be within 0 and 5, got {rows}"):
            packing.advance(rows)


def test_a_packing_is_gone_on_with_where_it_is_of_the_array():
    arrays = {"position": values_of((50, 700, 2)), "F": values_of((50, 700, 2, 2)), "mass": values_of(700)}
    expected = prepare_scene(arrays)
    begun = {name: Packing(arrays[name]) for name in ("position", "F")}
    begun["position"].advance(40)
    prepared = prepare_scene(arrays, begun)
    assert prepared.hash == expected.hash == content_hash(arrays) and prepared.motion == expected.motion
    assert all(prepared.arrays[name] == expected.arrays[name] for name in begun)
    assert prepared.arrays["position"].chunks is begun["position"].compressed().chunks
    other = Packing(values_of((50, 700, 2), seed=1))
    others = prepare_scene(arrays, {"position": other})
    assert others.hash == expected.hash and others.arrays["position"] == expected.arrays["position"]


@pytest.mark.parametrize("piece", [1, 100, 2**15])
@pytest.mark.parametrize("kinds", [None, [5, 6], [BOUNDARY, 6], [BOUNDARY]])
@pytest.mark.parametrize("shape", [(31, 7, 2), (30, 9, 3), (2, 5, 2), (1, 5, 2), (0, 5, 2), (4, 0, 2)], ids=str)
def test_sums_of_motions_are_those_of_differences(monkeypatch, shape, kinds, piece):
    monkeypatch.setattr(statistics, "PIECE", piece)
    x = values_of(shape)
    types = None if kinds is None else np.random.default_rng(1).choice(np.array(kinds, np.int8), shape[1])
    motion = motion_sums(x, types)
    free = (x if types is None else x[:, types != BOUNDARY]).astype(np.float64)
    for sums, order in ((motion.velocity, 1), (motion.acceleration, 2)):
        vectors = np.diff(free, n=order, axis=0).reshape(-1, shape[2])
        assert sums.count == len(vectors)
        scale = np.abs(vectors).sum(0) + 1e-300
        np.testing.assert_allclose(np.array(sums.sum) / scale, vectors.sum(0) / scale, rtol=0, atol=1e-12)
        np.testing.assert_allclose(sums.squares, (vectors**2).sum(0), rtol=1e-12)


def test_sums_of_what_is_not_finite(monkeypatch):
    for bad in (np.nan, np.inf, -np.inf):
        x = values_of((4, 3, 2))
        x[2, 1, 0] = bad
        with pytest.raises(ValueError, match="position must be finite"):
            motion_sums(x, np.full(3, BOUNDARY, np.int8))
