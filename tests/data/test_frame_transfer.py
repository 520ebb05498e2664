"""Frames arrive in the arrays of their scenes, and packed, by any number of threads; errors are raised."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

pytest.importorskip("isal")

from cases.packed import unpacked

from torch_mpm.data import frame_transfer
from torch_mpm.data.frame_transfer import FrameTransfer
from torch_mpm.data.packing import Packing, array_digest
from torch_mpm.data.statistics import motion_sums

FRAMES, PARTICLES = 45, [300, 0, 1, 700]
SHAPES = {"position": (2,), "F": (2, 2), "J": ()}
ROW = 4 * sum(PARTICLES) * 7


@pytest.fixture(params=["alone", "executor", "packed"])
def threads(request):
    """Arguments of a transfer."""
    with ThreadPoolExecutor(3) as executor:
        packed = {"packed": [True, True, False, True]} if request.param == "packed" else {}
        yield {} if request.param == "alone" else {"executor": executor, **packed}


def frames_of(device):
    """Frames whose numbers are all different."""
    rng = np.random.default_rng(0)
    values = {name: rng.standard_normal((FRAMES, sum(PARTICLES), *s)).astype(np.float32) for name, s in SHAPES.items()}
    return values, [{name: torch.from_numpy(v[k]).to(device) for name, v in values.items()} for k in range(FRAMES)]


def assert_packed(stored, expected):
    """The numbers and their digest: the compressed form of equal numbers may differ."""
    np.testing.assert_array_equal(unpacked(stored), expected)
    assert stored.digest == array_digest(expected)


@pytest.mark.parametrize("slab", [1, 7, 1000])
def test_frames_arrive_in_the_arrays_of_their_scenes(monkeypatch, device, threads, slab):
    monkeypatch.setattr(frame_transfer, "SLAB_BYTES", slab * ROW)
    values, frames = frames_of(device)
    transfer = FrameTransfer(FRAMES, PARTICLES, SHAPES, torch.device(device), **threads)
    for frame in frames:
        transfer.put(frame)
    ends = np.cumsum(PARTICLES)[:-1]
    for k, scene in enumerate(transfer.finish()):
        wanted = "packed" in threads and threads["packed"][k] and PARTICLES[k] > 0
        assert sorted(scene.packed) == (sorted(SHAPES) if wanted else [])
        assert sorted(scene.arrays) == ([] if wanted else sorted(SHAPES))
        for name, given in values.items():
            expected = np.split(given, ends, axis=1)[k]
            if wanted:
                assert_packed(scene.packed[name], expected)
            else:
                np.testing.assert_array_equal(scene.arrays[name], expected)
        assert (scene.motion is not None) == ("packed" in threads)
        if scene.motion is None:
            continue
        x = np.split(values["position"], ends, axis=1)[k].astype(np.float64)
        for sums, order in ((scene.motion.velocity, 1), (scene.motion.acceleration, 2)):
            vectors = np.diff(x, n=order, axis=0).reshape(-1, 2)
            assert sums.count == len(vectors)
            np.testing.assert_allclose(sums.squares, (vectors**2).sum(0), rtol=1e-12)


@pytest.mark.parametrize("slab", [7, 1000])
def test_particles_behind_those_of_a_scene(monkeypatch, device, threads, slab):
    monkeypatch.setattr(frame_transfer, "SLAB_BYTES", slab * ROW)
    frames = frames_of(device)[1]
    rng, counts = np.random.default_rng(1), [20, 0, None, 5]
    behind = [
        {} if n is None else {k: rng.random((FRAMES, n, *s), np.float32) for k, s in SHAPES.items()} for n in counts
    ]
    transfer = FrameTransfer(FRAMES, PARTICLES, SHAPES, torch.device(device), **threads, behind=behind)
    without = FrameTransfer(FRAMES, PARTICLES, SHAPES, torch.device(device))
    for frame in frames:
        transfer.put(frame)
        without.put(frame)
    for with_others, alone, others in zip(transfer.finish(), without.finish(), behind, strict=True):
        assert with_others.motion == (motion_sums(alone.arrays["position"]) if "packed" in threads else None)
        for name, own in alone.arrays.items():
            expected = np.concatenate([own, others[name]], axis=1) if others else own
            if name in with_others.packed:
                assert_packed(with_others.packed[name], expected)
            else:
                np.testing.assert_array_equal(with_others.arrays[name], expected)


def test_what_goes_wrong_in_a_thread_is_raised_in_the_end(monkeypatch):
    monkeypatch.setattr(frame_transfer, "SLAB_BYTES", ROW)
    append, calls = Packing.append, []

    def broken(self, rows):
        calls.append(self)
        if len(calls) > 50:
            raise MemoryError("no room")
        append(self, rows)

    monkeypatch.setattr(Packing, "append", broken)
    _, frames = frames_of("cpu")
    with ThreadPoolExecutor(2) as executor:
        transfer = FrameTransfer(FRAMES, PARTICLES, SHAPES, torch.device("cpu"), executor, [True] * 4)
        for frame in frames:  # far more than the queue holds
            transfer.put(frame)
        with pytest.raises(MemoryError, match="no room"):
            transfer.finish()
        transfer.abandon()
    assert not names_of_threads()


def test_threads_that_are_gone_are_noticed():
    _, frames = frames_of("cpu")
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    transfer = FrameTransfer(FRAMES, PARTICLES, SHAPES, torch.device("cpu"), executor)
    for frame in frames:
        transfer.put(frame)
    with pytest.raises(RuntimeError, match="shutdown"):
        transfer.finish()


def test_a_transfer_that_is_abandoned_takes_nothing_more(monkeypatch, device):
    monkeypatch.setattr(frame_transfer, "SLAB_BYTES", ROW)
    _, frames = frames_of(device)
    first, go_on, taken = threading.Event(), threading.Event(), []

    def held(self, rows):
        taken.append(len(rows))
        first.set()
        go_on.wait()

    monkeypatch.setattr(Packing, "append", held)
    with ThreadPoolExecutor(1) as executor:
        transfer = FrameTransfer(FRAMES, PARTICLES, SHAPES, torch.device(device), executor, [True] * 4)
        for frame in frames[:3]:
            transfer.put(frame)
        first.wait()
        ending = threading.Thread(target=transfer.abandon)
        ending.start()
        while not transfer._abandoned:
            pass
        go_on.set()
        ending.join()
    assert set(taken) == {1} and not names_of_threads()  # the frame that was under way


def names_of_threads():
    return [t.name for t in threading.enumerate() if t.name == "torch_mpm frames"]
