"""A small configuration of a data set, and helpers of tests for generated folders."""

import copy
import multiprocessing
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torch_mpm.data.configuration import Configuration
from torch_mpm.data.folder import DatasetFolder

WORDS: dict[str, Any] = {
    "gravity": [0.0, -9.8],
    "dataset": {"splits": {"train": 5, "test": 2}, "frames": 12, "interval": 0.005, "scenes_per_shard": 2},
    "grid": {"lower": [0.0, 0.0], "upper": [1.0, 1.0], "dx": 0.1, "walls": "separate"},
    "material": {"jelly": {"law": "neo_hookean", "E": {"log_uniform": [1e4, 1e5]}, "nu": 0.3}},
    "body": [
        {
            "count": {"integers": [1, 2]},
            "material": "jelly",
            "center": {"in_box": [[0.2, 0.2], [0.8, 0.8]]},
            "velocity": {"direction": {"uniform": [0.0, 1.0]}},
            "seeding": "jittered",
            "choice": [{"shape": "sphere", "radius": 0.15}, {"shape": "box", "size": [0.2, {"uniform": [0.2, 0.3]}]}],
        }
    ],
}


def words(**changes: Any) -> dict[str, Any]:
    """The words with some changed; a nested key as ``dataset__frames``."""
    made = copy.deepcopy(WORDS)
    for key, value in changes.items():
        *path, last = key.split("__")
        target: Any = made
        for step in path:
            target = target[int(step)] if isinstance(target, list) else target.setdefault(step, {})
        target[int(last) if isinstance(target, list) else last] = value
    return made


def configuration(**changes: Any) -> Configuration:
    return Configuration.from_words(words(**changes))


def decoded(folder: Path) -> dict[str, Any]:
    """All arrays and attributes of all scenes, by plain h5py."""
    found: dict[str, Any] = {}
    for path in sorted((folder / "shards").glob("*.h5")):
        with h5py.File(path) as file:
            for name, group in file.items():
                arrays = {key: data[()] for key, data in group.items()}
                found[name] = (arrays, {k: v for k, v in group.attrs.items()})
    return found


def assert_same(a: Path, b: Path) -> None:
    """Two data sets of the same scenes, to the last byte of every file of their shards."""
    one, other = decoded(a), decoded(b)
    assert one and one.keys() == other.keys()
    for name, (arrays, attributes) in one.items():
        assert arrays.keys() == other[name][0].keys() and attributes == other[name][1]
        for key, values in arrays.items():
            np.testing.assert_array_equal(values, other[name][0][key], err_msg=f"{name}/{key}")
    hashes = [{s.id: s.hash for s in DatasetFolder(folder).attempted()} for folder in (a, b)]
    assert hashes[0] == hashes[1]
    files = [{file.name: file.read_bytes() for file in (folder / "shards").iterdir()} for folder in (a, b)]
    assert files[0] == files[1]


PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["torch_mpm.data.generate"])


def start(folder: Path, rank: int = 0, size: int = 1, threads: int = 1, **changes: Any) -> Any:
    """A process that generates the data set of `configuration(**changes)` in a folder."""
    process = PROCESSES.Process(target=_generate, args=(folder, rank, size, threads, changes))
    process.start()
    return process


def _generate(folder: Path, rank: int, size: int, threads: int, changes: dict[str, Any]) -> None:
    import torch

    from torch_mpm.data.generate import generate

    os.environ.update(RANK=str(rank), WORLD_SIZE=str(size), LOCAL_RANK=str(rank))
    torch.set_num_threads(threads)
    generate(configuration(**changes), folder, device="cpu")
