"""A small data set in the layout of `torch-mpm generate`, from numbers instead of a simulation."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from torch_mpm.data.folder import DatasetRecord
from torch_mpm.data.packing import prepare_scene
from torch_mpm.data.shard import shard_path
from torch_mpm.data.shard_writer import ShardWriter
from torch_mpm.data.whole_files import CHECKSUM, write_record

SPLITS = {"train": (0, 5), "valid": (5, 2), "test": (7, 3)}
FRAMES, PER_SHARD, FAILED = 12, 4, 3
BOUNDARY, WATER, SAND = 3, 5, 6


def record(dim: int = 2, **changes: object) -> DatasetRecord:
    words = {
        "configuration": "0123456789abcdef",
        "seed": 7,
        "splits": SPLITS,
        "scenes_per_shard": PER_SHARD,
        "frames": FRAMES,
        "frame_interval": 0.0025,
        "lower": (0.0,) * dim,
        "upper": (1.0, 2.0, 1.5)[:dim],
        "dx": 0.05,
        "fields": ("position", "velocity"),
        "title": "numbers",
    }
    return DatasetRecord(**{**words, **changes})


def arrays(scene_id: int, dim: int = 2, frames: int = FRAMES) -> dict[str, np.ndarray]:
    """Particles that fly, each in a parabola, above some that stay; their number depends on the scene."""
    rng = np.random.default_rng(scene_id)
    count = 20 + 3 * scene_id
    kind = np.where(np.arange(count) < 6, BOUNDARY, rng.choice([WATER, SAND], count)).astype(np.int8)
    free = (kind != BOUNDARY)[:, None]
    start, velocity = rng.uniform(0.4, 0.6, (count, dim)), free * rng.normal(0.0, 0.5, (count, dim))
    gravity = free * np.eye(dim)[1] * -9.8
    time = 0.0025 * np.arange(frames)[:, None, None]
    volume = np.full(count, 0.05**dim / 4, np.float32)
    return {
        "position": (start + velocity * time + 0.5 * gravity * time**2).astype(np.float32),
        "velocity": (velocity + gravity * time).astype(np.float32),
        "particle_type": kind,
        "material": (kind == SAND).astype(np.int8),
        "mass": 1000 * volume,
        "volume": volume,
        "friction_angle": np.full(count, 0.5 + 0.01 * scene_id, np.float32),
    }


def scene_attributes(scene_id: int, valid: bool = True, dim: int = 2) -> dict[str, str | int | float]:
    scene = json.dumps({"gravity": [0.0, -9.8, 0.0][:dim]})
    words = {"valid": int(valid), "attempts": 1 if valid else 3, "failure": "" if valid else "it left the domain"}
    return {**words, "seed": 1, "scene": scene, "materials": '["water", "sand"]', "dt": 1e-4}


def write_shard(folder: Path, index: int, dim: int = 2, frames: int = FRAMES) -> None:
    ids = range(index * PER_SHARD, min((index + 1) * PER_SHARD, 10))
    with ShardWriter(shard_path(folder, index), {"shard": index}) as writer:
        for k in ids:
            scene = prepare_scene(arrays(k, dim, frames) if k != FAILED else {})
            writer.add(k, scene, scene_attributes(k, k != FAILED, dim))
        writer.finish()


def make_dataset(folder: Path, dim: int = 2, shards: int = 3, **changes: object) -> Path:
    """Ten scenes in three shards, or the first ``shards`` of them; number 3 failed."""
    (folder / "shards").mkdir(parents=True)
    made = record(dim, **changes)
    made.write(folder)
    for index in range(shards):
        write_shard(folder, index, dim, made.frames)
    return folder


def forge(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the words of a record, with a checksum that fits them."""
    words = json.loads(path.read_text())
    change(words)
    write_record(path, {name: value for name, value in words.items() if name != CHECKSUM})
