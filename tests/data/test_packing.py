"""Packing: the same bytes whether the rows come at once or one after another."""

import hashlib
import itertools

import numpy as np
import pytest
import torch

pytest.importorskip("isal")

from cases.packed import unpacked

from torch_mpm.data.packing import PIECE_BYTES, Packing, content_hash, packed, prepare_scene
from torch_mpm.data.statistics import BOUNDARY, MotionSums, motion_sums

SHAPES = [(50, 700, 2), (7, 300, 3, 3), (3, 20_000, 3), (1, 5, 2), (40_000, 3), (9, 1, 1)]


def values_of(shape, dtype=np.float32, seed=0):
    return (1e3 * np.random.default_rng(seed).standard_normal(shape).cumsum(0)).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int8])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("step", [1, 5, 32, 10**6])
def test_rows_may_come_one_after_another(shape, dtype, step):
    values, step = values_of(shape, dtype), max(step, shape[0] // 100)
    packing = Packing(shape, dtype)
    for first in range(0, len(values), step):
        rows = np.full((min(step, len(values) - first), 2 * shape[1], *shape[2:]), 7, dtype)
        rows[:, ::2] = values[first : first + step]
        packing.append(rows[:, ::2])  # from among others
        packing.append(rows[:0, ::2])  # nothing new
        rows[:] = 3  # which are used again
    stored = packing.finish()
    np.testing.assert_array_equal(unpacked(stored), values)
    assert stored == packed(values) and stored.digest == hashlib.sha256(values.tobytes()).digest()


def test_pieces_of_several_chunks():
    values = values_of((4 * PIECE_BYTES // 4000, 500, 2))
    stored = packed(values)
    assert len(stored.chunks) > 8
    np.testing.assert_array_equal(unpacked(stored), values)


def test_rows_that_do_not_fit():
    packing = Packing((5, 4, 2), np.float32)
    packing.append(values_of((2, 4, 2)))
    for shape, dtype in (((4, 4, 2), np.float32), ((1, 3, 2), np.float32), ((1, 4, 2), np.float64)):
        with pytest.raises(ValueError, match=r"rows must be at most 3 of shape \[4, 2\] and type float32, got"):
            packing.append(values_of(shape, dtype))
    with pytest.raises(ValueError, match="5 rows must have come, got 2"):
        packing.finish()
    packing.append(values_of((3, 4, 2)))
    assert packing.finish().shape == (5, 4, 2)


def test_what_was_packed_before_is_taken_as_it_is():
    arrays = {"position": values_of((50, 700, 2)), "F": values_of((50, 700, 2, 2)), "mass": values_of(700)}
    expected = prepare_scene(arrays)
    before = {name: packed(arrays[name]) for name in ("position", "F")}
    prepared = prepare_scene({"mass": arrays["mass"]}, before, motion_sums(arrays["position"]))
    assert prepared.hash == expected.hash == content_hash(arrays) and prepared.motion == expected.motion
    assert all(prepared.arrays[name] is before[name] and before[name] == expected.arrays[name] for name in before)
    assert prepared.particles == 700
    broken = np.where(np.arange(50)[:, None, None] == 20, np.nan, arrays["position"])
    sums = MotionSums()
    for frame in torch.from_numpy(broken):
        sums.add(frame)
    with pytest.raises(ValueError, match="position must be finite"):
        prepare_scene({}, before, sums.of_scenes([0, 700])[0])


@pytest.mark.parametrize("kinds", [None, [5, 6], [BOUNDARY, 6], [BOUNDARY]])
@pytest.mark.parametrize("shape", [(31, 7, 2), (30, 9, 3), (2, 5, 2), (1, 5, 2), (0, 5, 2), (4, 0, 2)], ids=str)
def test_sums_of_motions_are_those_of_differences(shape, kinds):
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


def test_motions_of_scenes_of_a_batch_are_those_of_each_alone(device):
    ends, x = [0, 20, 20, 21, 50], values_of((9, 50, 2))
    sums = MotionSums()
    for frame in torch.from_numpy(x).to(device):
        sums.add(frame)
    for found, (first, end) in zip(sums.of_scenes(ends), itertools.pairwise(ends), strict=True):
        alone = motion_sums(x[:, first:end])
        for a, b in ((found.velocity, alone.velocity), (found.acceleration, alone.acceleration)):
            assert a.count == b.count and (device == "cuda" or a == b)
            np.testing.assert_allclose([a.sum, a.squares], [b.sum, b.squares], rtol=1e-12)


def test_sums_of_what_is_not_finite():
    for bad in (np.nan, np.inf, -np.inf):
        x = values_of((4, 3, 2))
        x[2, 1, 0] = bad
        with pytest.raises(ValueError, match="position must be finite"):
            motion_sums(x, np.full(3, BOUNDARY, np.int8))
