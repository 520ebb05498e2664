"""The example that learns to simulate, in short: it learns, from the disk and online alike, and beats the baseline."""

import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("h5py")
pytest.importorskip("pydantic")
sys.path.append(str(Path(__file__).parents[2] / "examples"))

import learn_simulator as example

from torch_mpm.data import DatasetFolder, OnlineStream, WindowDataset, WindowStream, simulator
from torch_mpm.data.configuration import Configuration
from torch_mpm.data.generate import generate

pytestmark = pytest.mark.usefixtures("one_thread")

WORDS = [
    "dataset.frames=15",
    "dataset.seed=1",
    "dataset.interval=0.01",
    "dataset.scenes_per_shard=8",
    "dataset.splits={train=8, test=4}",
    "grid.dx=0.08",
    "body[0].count=1",
    "material.sand.E=1e5",
]


@pytest.fixture(scope="module")
def configuration():
    return Configuration.preset("sand", WORDS)


@pytest.fixture(scope="module")
def data(configuration, tmp_path_factory):
    folder = tmp_path_factory.mktemp("learning") / "data"
    generate(configuration, folder, device="cpu")
    return DatasetFolder(folder)


def new_model(data):
    torch.manual_seed(0)
    return example.Simulator(example.Domain.of(data, data.motion("train"), torch.device("cpu")))


@pytest.mark.thorough
def test_it_learns_from_the_disk_and_online_alike(data, configuration, tmp_path, monkeypatch):
    """The same windows in another order: both end at about the same loss, and well ahead of the baseline."""
    monkeypatch.setattr(example, "WIDTH", 32)
    monkeypatch.setattr(example, "LAYERS", 2)
    windows = WindowDataset(data, "train", example.HISTORY + 1)
    streams = {
        "disk": WindowStream(windows, 4),
        "online": OnlineStream(simulator(configuration), 4, scenes=8, passes=9),
    }
    losses = {}
    for name, stream in streams.items():
        model = new_model(data)
        history = example.train(model, iter(stream), 150, report=lambda _: None)
        losses[name] = sum(history[-50:]) / 50
        assert losses[name] < 0.92 * sum(history[:5]) / 5
    assert losses["online"] == pytest.approx(losses["disk"], rel=0.1)
    pytest.importorskip("imageio_ffmpeg")  # for the video
    found = example.compare(model, data, tmp_path)
    assert found["network"][-1] < 0.9 * found["constant velocity"][-1]
    assert {p.name for p in tmp_path.iterdir()} == {"errors.png", "rollout.mp4"}


def test_the_baseline_and_its_error():
    frames = 9
    x = torch.arange(frames)[None, :, None] * torch.tensor([0.05, 0.0]) + 0.2
    domain = example.Domain(torch.zeros(2), torch.ones(2), 0.1, torch.ones(2), torch.zeros(2), torch.ones(2))
    straight = example.constant_velocity(x[:, : example.HISTORY], frames, domain)
    torch.testing.assert_close(straight, x)
    assert example.errors(straight + torch.tensor([0.3, 0.4]), x).tolist() == pytest.approx([0.5] * frames)


def test_neighbours_are_of_the_same_scene():
    x = torch.tensor([[0.0, 0.0], [0.05, 0.0], [0.2, 0.0], [0.05, 0.0]])
    sender, receiver = example.neighbours(x, torch.tensor([0, 0, 0, 1]), 0.1)
    assert sorted(zip(sender.tolist(), receiver.tolist(), strict=True)) == [(0, 1), (1, 0)]
