"""Windows of scenes that are simulated as they are needed: whose, in which order, resumed, and what goes wrong."""

import itertools
import threading
import time

import pytest
import small_dataset as datasets
import torch
from torch.utils.data import DataLoader

from torch_mpm.data.online import OnlineStream
from torch_mpm.errors import SimulationError


def numbers(ids):
    """Scenes as `tests/small_dataset.py` makes them; every tenth fails."""
    made = [None if k % 10 == 3 else datasets.arrays(k) for k in ids]
    return [None if m is None else {name: torch.from_numpy(a) for name, a in m.items()} for m in made]


def places(batch):
    return list(zip(batch["scene_id"].tolist(), batch["first"].tolist(), strict=True))


def stream(**options):
    given = {"simulate": numbers, "batch_size": 4, "scenes": 3, "seed": 1, **options}
    return OnlineStream(given.pop("simulate"), given.pop("batch_size"), **given)


def test_batches_hold_the_windows_of_the_scenes(device):
    def simulate(ids):
        return [s and {name: value.to(device) for name, value in s.items()} for s in numbers(ids)]

    for batch in itertools.islice(stream(simulate=simulate, device=device), 10):
        for k, (scene, first) in enumerate(places(batch)):
            rows = batch["scene"] == k
            given = datasets.arrays(scene)
            window = torch.from_numpy(given["position"][first : first + 7]).transpose(0, 1)
            torch.testing.assert_close(batch["position"][rows].cpu(), window, rtol=0, atol=0)
            torch.testing.assert_close(batch["mass"][rows].cpu(), torch.from_numpy(given["mass"]), rtol=0, atol=0)
            assert batch["position"].device.type == device


def test_every_round_has_new_scenes_and_all_windows_of_the_good_ones():
    made = stream(passes=2, first=20)
    per_round = [3 * 6 * 2 // 4, 2 * 6 * 2 // 4]  # scene 23 fails
    batches = iter(made)
    for begin, count in ((20, per_round[0]), (23, per_round[1])):
        found = [p for _ in range(count) for p in places(next(batches))]
        good = [k for k in range(begin, begin + 3) if k != 23]
        assert sorted(found) == sorted([(k, first) for k in good for first in range(6)] * 2)


def test_a_round_with_too_few_good_scenes_for_a_batch_is_left_out():
    def simulate(ids):
        return [None if k in (0, 2) else scene for k, scene in zip(ids, numbers(ids), strict=True)]

    found = {k for batch in itertools.islice(stream(simulate=simulate, batch_size=9), 2) for k, _ in places(batch)}
    assert found <= set(range(4, 9)) and 1 not in found


def test_ranks_have_scenes_of_their_own():
    ids = [stream(rank=r, world=2).scene_ids(n) for n in range(2) for r in range(2)]
    assert [k for part in ids for k in part] == list(range(12))


@pytest.mark.parametrize("ahead", [0, 1, 3])
def test_order_and_resumption(ahead):
    whole = [places(b) for b in itertools.islice(stream(), 14)]
    assert whole == [places(b) for b in itertools.islice(stream(ahead=ahead), 14)]
    begun = stream(ahead=ahead)
    begin = [places(b) for b in itertools.islice(begun, 6)]  # into the second round
    resumed = stream(ahead=ahead)
    resumed.load_state_dict(begun.state_dict())
    assert begin + [places(b) for b in itertools.islice(resumed, 8)] == whole
    with pytest.raises(ValueError, match="state is of a stream with world 1, got 2"):
        stream(rank=0, world=2).load_state_dict(begun.state_dict())


def test_the_next_round_is_simulated_while_this_one_is_trained_on():
    second = threading.Event()

    def simulate(ids):
        if ids[0] == 3:
            second.set()
        return numbers(ids)

    batches = iter(stream(simulate=simulate))
    next(batches)
    assert second.wait(20)  # though the first round is not done with
    batches.close()


def test_who_leaves_does_not_wait_for_the_next_round():
    second, ended = threading.Event(), []

    def simulate(ids):
        if ids[0] == 3:
            second.set()
            end = time.monotonic() + 20
            while time.monotonic() < end:
                pass
            ended.append(ids)
        return numbers(ids)

    batches = iter(stream(simulate=simulate))
    next(batches)
    second.wait()
    batches.close()
    assert not ended


def test_what_goes_wrong_in_the_simulation_is_raised():
    def broken(ids):
        raise SimulationError(f"scene {ids[0]} went wrong")

    with pytest.raises(SimulationError, match="scene 0 went wrong"):
        next(iter(stream(simulate=broken)))
    with pytest.raises(SimulationError, match="too many scenes have failed in 3 rounds for a batch of each, up to 8"):
        next(iter(stream(simulate=lambda ids: [None] * len(ids))))


def test_what_cannot_be():
    with pytest.raises(ValueError, match="rank must be within 0 and 0"):
        stream(rank=1, world=1)
    with pytest.raises(ValueError, match="batch_size must be at most 6"):
        next(iter(OnlineStream(numbers, 7, scenes=1)))
    with pytest.raises(ValueError, match="frames must be at most 12, those of a scene, got 13"):
        next(iter(OnlineStream(numbers, 1, scenes=1, frames=13)))
    with pytest.raises(RuntimeError, match="without workers"):
        next(iter(DataLoader(stream(), batch_size=None, num_workers=1)))


@pytest.mark.thorough
def test_windows_of_a_configuration_are_those_of_its_data_set(tmp_path, device):
    """From memory and from the disk: the same scenes, bit for bit, where a round is a shard."""
    pytest.importorskip("h5py")
    pytest.importorskip("pydantic")
    from torch_mpm.data import WindowDataset, simulator
    from torch_mpm.data.configuration import Configuration
    from torch_mpm.data.generate import generate

    words = ["dataset.frames=9", "dataset.splits={train=4}", "dataset.scenes_per_shard=4", "grid.dx=0.05"]
    configuration = Configuration.preset("sand", words)
    generate(configuration, tmp_path / "set", device=device)
    windows = WindowDataset(tmp_path / "set", fields=("position",), constants=("particle_type", "mass"))
    disk = {(int(w["scene_id"]), int(w["first"])): w for w in windows}
    stream = OnlineStream(simulator(configuration, device), 1, scenes=4, device=device, ahead=0)
    for batch in itertools.islice(stream, len(disk)):
        (place,) = places(batch)
        wanted = disk.pop(place)
        for name in ("position", "particle_type", "mass"):
            torch.testing.assert_close(batch[name].cpu(), wanted[name], rtol=0, atol=0)
    assert not disk
    assert places(next(iter(OnlineStream(simulator(configuration, device), 1, first=4, scenes=1))))[0][0] == 4
