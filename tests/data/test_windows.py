"""Windows of frames and their batches: what they hold, whose they are, and an order that can be resumed."""

import itertools

import numpy as np
import pytest
import small_dataset as datasets
import torch
from torch.utils.data import DataLoader

pytest.importorskip("h5py")

from torch_mpm.data.windows import WindowDataset, WindowStream, pack, pad

FRAMES, WINDOW = datasets.FRAMES, 7
TRAIN = [0, 1, 2, 4]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return datasets.make_dataset(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture
def windows(path):
    return WindowDataset(path, fields=("position", "velocity"), constants=("particle_type", "mass"))


def place(item):
    return int(item["scene_id"]), int(item["first"])


def places(batch):
    return list(zip(batch["scene_id"].tolist(), batch["first"].tolist(), strict=True))


def test_items_are_the_windows_of_valid_scenes(windows):
    found = [place(windows[k]) for k in range(len(windows))]
    assert found == [(s, k) for s in TRAIN for k in range(FRAMES - WINDOW + 1)]
    item, given = windows[-1], datasets.arrays(4)
    np.testing.assert_array_equal(item["position"], given["position"][-WINDOW:].transpose(1, 0, 2))
    np.testing.assert_array_equal(item["velocity"], given["velocity"][-WINDOW:].transpose(1, 0, 2))
    np.testing.assert_array_equal(item["mass"], given["mass"])
    for index in (len(windows), -len(windows) - 1):
        with pytest.raises(IndexError, match="index must be within"):
            windows[index]


def test_only_the_frames_of_a_window_are_read(windows, monkeypatch):
    from torch_mpm.data.shard import StoredScene

    parts = []
    read = StoredScene._read
    monkeypatch.setattr(StoredScene, "_read", lambda self, name, part: parts.append(part) or read(self, name, part))
    windows[3]
    assert [p for p in parts if p is not ...] == [slice(3, 10)] * 2


def test_packed_and_padded_batches(windows):
    items = [windows[0], windows[8], windows[-1]]
    counts = [20, 23, 32]
    packed, padded = pack(items), pad(items)
    assert packed["position"].shape == (sum(counts), WINDOW, 2) and padded["position"].shape == (3, 32, WINDOW, 2)
    assert torch.bincount(packed["scene"]).tolist() == counts and padded["mask"].sum(1).tolist() == counts
    for name in ("position", "velocity", "particle_type", "mass"):
        torch.testing.assert_close(padded[name][padded["mask"]], packed[name])
        assert not padded[name][~padded["mask"]].any()
    for k, item in enumerate(items):
        torch.testing.assert_close(packed["position"][packed["scene"] == k], item["position"])
        assert places(packed)[k] == places(padded)[k] == place(item)


def test_an_empty_scene_in_a_batch(windows):
    empty = {name: value[:0] if value.dim() else value for name, value in windows[0].items()}
    packed, padded = pack([empty, windows[0]]), pad([empty, windows[0]])
    assert packed["scene"].tolist() == [1] * 20 and padded["mask"].sum(1).tolist() == [0, 20]


@pytest.mark.thorough(context="spawn")
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_yield_the_same_batches_in_the_same_order(path, windows, context):
    expected = list(itertools.islice(WindowStream(windows, 5, seed=3), 7))
    windows[0]  # files are open where the workers come from
    stream = WindowStream(windows, 5, seed=3)
    batches = stream.loader(num_workers=2, multiprocessing_context=context)
    for batch, wanted in zip(itertools.islice(batches, 7), expected, strict=True):
        assert batch.keys() == wanted.keys()
        for name, value in batch.items():
            torch.testing.assert_close(value, wanted[name], rtol=0, atol=0)
    assert stream.taken == 7


def test_a_map_dataset_serves_a_plain_loader(windows):
    loader = DataLoader(windows, batch_size=4, shuffle=True, collate_fn=pad, num_workers=1)
    assert sorted(p for batch in loader for p in places(batch)) == [place(windows[k]) for k in range(len(windows))]


def test_ranks_share_every_epoch(windows):
    world, size = 3, 2
    streams = [WindowStream(windows, size, seed=5, rank=r, world=world) for r in range(world)]
    per_epoch = streams[0].batches_per_epoch
    assert per_epoch == len(windows) // (world * size)
    epochs = []
    iterators = [iter(s) for s in streams]
    for _ in range(2):
        taken = [places(next(it)) for it in iterators for _ in range(per_epoch)]
        flat = [p for batch in taken for p in batch]
        assert len(flat) == len(set(flat)) == per_epoch * world * size
        epochs.append(flat)
    assert epochs[0] != epochs[1]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_resumed_stream_goes_on(windows, workers):
    whole = [places(b) for b in itertools.islice(WindowStream(windows, 3, seed=2), 15)]  # into the second epoch
    stream = WindowStream(windows, 3, seed=2)
    begin = [places(b) for b in itertools.islice(stream.loader(num_workers=workers), 6)]
    state = stream.state_dict()
    resumed = WindowStream(windows, 3, seed=2)
    resumed.load_state_dict(state)
    rest = [places(b) for b in itertools.islice(resumed.loader(), 9)]
    assert begin + rest == whole and resumed.state_dict()["taken"] == 15


def test_order_by_seed(windows):
    def order(seed):
        return [p for b in itertools.islice(WindowStream(windows, 4, seed=seed), 6) for p in places(b)]

    assert order(1) == order(1) != order(2)
    assert order(None) == [place(windows[k]) for k in range(24)]


def test_what_cannot_be(path, windows):
    with pytest.raises(ValueError, match="frames must be within 1 and 12"):
        WindowDataset(path, frames=13)
    with pytest.raises(KeyError, match="split must be one of"):
        WindowDataset(path, split="dev")
    with pytest.raises(ValueError, match="batch_size must be at most 12"):
        WindowStream(windows, 20, rank=0, world=2)
    with pytest.raises(ValueError, match="rank must be within 0 and 1"):
        WindowStream(windows, 2, rank=2, world=2)
    state = WindowStream(windows, 2, seed=1).state_dict()
    with pytest.raises(ValueError, match="another seed, batch_size"):
        WindowStream(windows, 3, seed=2).load_state_dict(state)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (
            {"fields": ["friction_angle"]},
            KeyError,
            "fields must be .*position, velocity, got 'friction_angle'; arrays .N",
        ),
        ({"fields": ["speed"]}, KeyError, "fields must be .*, got 'speed'"),
        ({"fields": "position"}, TypeError, "fields must be a list of names, got 'position'"),
        ({"constants": "mass"}, TypeError, "constants must be a list of names, got 'mass'"),
        ({"constants": [3]}, TypeError, "constants must be a list of names"),
        ({"constants": ["velocity"]}, KeyError, "constants must be arrays .N. .*friction_angle.*, got 'velocity'"),
        ({"constants": ["speed"]}, KeyError, "constants must be arrays .N. .*, got 'speed'"),
    ],
)
def test_names_of_arrays_that_are_not_there(path, arguments, kind, message):
    with pytest.raises(kind, match=message):
        WindowDataset(path, "train", 7, **arguments)[0]
