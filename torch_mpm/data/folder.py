"""Folder of a data set: the content of ``dataset.json``, and its finished scenes."""

from __future__ import annotations

import functools
import itertools
import json
import os
import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DamagedFileError
from ..grid.grid import MOST_NODES
from .shard import REMEDY, Array, SceneRecord, Shard, ShardRecord, StoredScene, record_path, scene_name, shard_path
from .statistics import Motion, Sums
from .whole_files import check_inside, check_record, count, is_name, write_record

FORMAT = 2
FORMAT_WITHOUT_CHECKSUM = 1
"""Format of records that were written before records had checksums."""
DATASET = "dataset.json"
MOST_SHARDS = 10**6
"""Limits of a data set, and of the scenes of a shard."""
MOST_OPEN = 32
"""Number of shards, and of their scenes, that a reader keeps open."""
SMALLEST, LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
"""Numbers within which float32 has all its digits."""


LINKED = "copy what it links to into the folder, or link the folder as a whole"


class DatasetError(ValueError):
    """The data set lacks the requested item."""


class MissingError(KeyError):
    """Unknown split or scene."""

    def __str__(self) -> str:
        return str(self.args[0])  # KeyError would quote the message.


@dataclass(frozen=True)
class DatasetRecord:
    """Content of ``dataset.json``, written once, before the first scene.

    Attributes:
        configuration: hash of everything that determines the content.
        splits: first scene id and number of scenes of each split.
        added: name of a split, first scene id and number of added scenes, in the order of the ids.
        frames: T of every scene, including the first frame; ``frame_interval`` [s] apart.
        lower, upper: bounds of the domain [D] (m).
        dx: node distance of the grid [m].
        fields: arrays [T, N, ...] of every scene, including ``position``.
        device: "cpu" or "cuda", whose results differ by rounding.
    """

    configuration: str
    seed: int
    splits: dict[str, tuple[int, int]]
    scenes_per_shard: int
    frames: int
    frame_interval: float
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    dx: float
    fields: tuple[str, ...]
    title: str = ""
    device: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    added: tuple[tuple[str, int, int], ...] = ()

    @property
    def dim(self) -> int:
        return len(self.lower)

    @property
    def scenes(self) -> int:
        """Number of scenes of all splits."""
        return sum(count for _, _, count in self.ranges)

    @property
    def ranges(self) -> list[tuple[str, int, int]]:
        """Name of the split, first id and number of all ranges of scenes, by id."""
        return [*((name, first, count) for name, (first, count) in self.splits.items()), *self.added]

    @property
    def shards(self) -> int:
        end = max((first + count for _, first, count in self.ranges), default=0)
        return -(-end // self.scenes_per_shard)

    def ids(self, shard: int) -> list[int]:
        """Ids of the scenes of a shard."""
        begin, end = shard * self.scenes_per_shard, (shard + 1) * self.scenes_per_shard
        return [k for _, first, count in self.ranges for k in range(max(first, begin), min(first + count, end))]

    def problem(self) -> str:
        """Problem of its domain, of the number of nodes along an axis or of the times of frames; "" for none.

        Lengths and times must be finite in float32, and their reciprocals too.
        """
        if not 2 <= len(self.lower) == len(self.upper) <= 3:
            return f"lower and upper must have 2 or 3 numbers, got {self.lower} and {self.upper}"
        sides = [b - a for a, b in zip(self.lower, self.upper, strict=True)]
        if not all(abs(x) <= LARGEST for x in (*self.lower, *self.upper)) or not min(sides) > 0:
            return f"upper must be above lower, and finite in float32, got {self.lower} and {self.upper}"
        ranges = {
            "dx": (max(SMALLEST, max(sides) / MOST_NODES), LARGEST),
            "frame_interval": (SMALLEST, LARGEST / self.frames),
        }
        for name, (least, most) in ranges.items():
            if not least <= (value := getattr(self, name)) <= most:
                return f"{name} must be within {least:.3g} and {most:.3g}, got {value:g}"
        return ""

    def missing(self, finished: Sequence[int]) -> str:
        """Missing shards in words; "" for none."""
        there = {index for index in finished if index < self.shards}
        number = self.shards - len(there)
        first = itertools.islice((f"shard_{k:05d}" for k in range(self.shards) if k not in there), 10)
        named = ", ".join(first) + (", ..." if number > 10 else "")
        return f"{number} of {self.shards} shards ({named})" if number else ""

    def count(self, split: str) -> int:
        """Number of scenes of a split."""
        return sum(count for name, _, count in self.ranges if name == split)

    def extended(self, totals: Mapping[str, int]) -> DatasetRecord:
        """Record extended by more scenes, which are in separate shards.

        Args:
            totals: total number of scenes by the name of a split, not less than at present.

        Raises:
            MissingError: for an unknown split.
            DatasetError: for fewer scenes than there are, or more shards than `MOST_SHARDS`.
        """
        record = self
        for split, total in totals.items():
            if split not in self.splits:
                raise MissingError(f"split must be one of {', '.join(self.splits)}, got {split!r}")
            if total < (there := record.count(split)):
                raise DatasetError(f"the split {split!r} has {there} scenes, got a total of {total}")
            if total > there:
                new = (split, record.shards * self.scenes_per_shard, total - there)
                record = replace(record, added=(*record.added, new))
        if record.shards > MOST_SHARDS:
            raise DatasetError(f"{record.shards} shards would be made, and at most {MOST_SHARDS} are allowed")
        return record

    def split_of(self, scene_id: int) -> str:
        """
        Raises:
            MissingError: for a scene of no split.
        """
        for name, first, of in self.ranges:
            if first <= scene_id < first + of:
                return name
        raise MissingError(f"the data set has no scene {scene_id}")

    def write(self, folder: Path) -> None:
        """Write the record; it appears when it is complete and on the disk."""
        write_record(folder / DATASET, {"format": FORMAT, **asdict(self)})

    @classmethod
    def read(cls, folder: Path) -> DatasetRecord:
        """
        Raises:
            FileNotFoundError: for a folder without a data set.
            DamagedFileError: for a file that was changed.
        """
        path, remedy = folder / DATASET, "restore it, or generate the data set again"
        if not path.is_file():
            raise FileNotFoundError(f"there is no data set in {folder}: it has no {DATASET}")
        check_inside(folder, path, LINKED)
        try:
            words = json.loads(path.read_bytes())
            if words["format"] not in (FORMAT, FORMAT_WITHOUT_CHECKSUM):
                raise DamagedFileError(path, "is not of this version of torch_mpm", remedy)
            if words["format"] == FORMAT:
                check_record(words, path, remedy)
            words.pop("format")
            words.pop("connectivity_radius", None)  # Present in some folders; it was never set.
            words["seed"] = int(words["seed"])
            for name in ("scenes_per_shard", "frames"):
                words[name] = count(words[name], 1)
            for name in ("frame_interval", "dx"):
                words[name] = float(words[name])
            for name in ("lower", "upper"):
                words[name] = tuple(map(float, words[name]))
            words["fields"] = tuple(map(str, words["fields"]))
            words["title"] = str(words.get("title", ""))
            words["title"].encode()  # no lone surrogates, which no file can hold
            words["versions"] = {str(name): str(version) for name, version in words.get("versions", {}).items()}
            for name in ("configuration", "device"):
                words[name] = str(words.get(name, ""))
            words["splits"] = {str(n): (count(first), count(of)) for n, (first, of) in words["splits"].items()}
            words["added"] = tuple((str(n), count(first), count(of)) for n, first, of in words.get("added", ()))
            record = cls(**words)
            if max(record.shards, record.scenes_per_shard) > MOST_SHARDS:
                raise ValueError("its numbers make no sense")
            if problem := record.problem():
                raise ValueError(problem)
            if wrong := [n for n in (*record.splits, *record.fields) if not is_name(n)]:
                raise ValueError(f"{wrong[0]!r:.100} is no name of a split or a field")
            ends = [0, *(first + count for _, first, count in record.ranges)]
            if any(n not in record.splits or f < e or c < 0 for (n, f, c), e in zip(record.ranges, ends, strict=False)):
                raise ValueError("its splits overlap, or have a negative number of scenes")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
            if isinstance(error, DamagedFileError):
                raise
            raise DamagedFileError(path, f"is no record of a data set ({error})", remedy) from None
        return record


def finished_shards(folder: Path) -> list[int]:
    """Numbers of the shards of a folder that have a record, including those that the data set does not have."""
    names = (path.name for path in (folder / "shards").glob("shard_*.json"))
    return sorted(int(match[1]) for name in names if (match := re.fullmatch(r"shard_(\d{5}|[1-9]\d{5,8})\.json", name)))


class DatasetFolder:
    """A data set on disk, finished or still growing: ``DatasetFolder("out/sand")``.

    Failed scenes, unfinished shards and shards beyond those of ``dataset.json`` are invisible. Files are opened when
    they are read, separately in each process, so that the object can be copied to the workers of a data loader.

    Raises:
        FileNotFoundError: for a folder without a data set.
        DamagedFileError: for damaged records; later, where damaged scenes are read.
        MissingError: a KeyError, in methods, for an unknown split or scene.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.record = DatasetRecord.read(self.path)
        self.finished = [k for k in finished_shards(self.path) if k < self.record.shards]
        self._scenes = {s.id: (k, s) for k in self.finished for s in self._record(k).scenes}
        self._cache = _OpenFiles()

    def _record(self, shard: int) -> ShardRecord:
        path = record_path(self._shard_path(shard))
        record = ShardRecord.read(path)
        if any(len(s.motion.velocity.sum) != self.record.dim for s in record.scenes if s.motion):
            raise DamagedFileError(path, f"has sums of another number of dimensions than {self.record.dim}", REMEDY)
        if difference := record.difference(self.record.configuration, self.record.ids(shard)):
            raise DamagedFileError(path, difference, REMEDY)
        return record

    def _shard_path(self, shard: int) -> Path:
        """File of a shard, which like its record must be in this folder."""
        path = shard_path(self.path, shard)
        for own in (path, record_path(path)):
            check_inside(self.path, own, LINKED)
        return path

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cache": _OpenFiles()}

    def scenes(self, split: str | None = None) -> list[SceneRecord]:
        """The valid scenes of a split, or of all, by id."""
        return [s for s in self.attempted(split) if s.valid]

    def attempted(self, split: str | None = None) -> list[SceneRecord]:
        """All scenes of a split, or of all splits, including failed ones."""
        if split is None:
            return [self._scenes[k][1] for k in sorted(self._scenes)]
        if split not in self.record.splits:
            raise MissingError(f"split must be one of {', '.join(self.record.splits)}, got {split!r}")
        own = [range(first, first + count) for name, first, count in self.record.ranges if name == split]
        return [self._scenes[k][1] for k in sorted(self._scenes) if any(k in ids for ids in own)]

    def scene(self, scene_id: int) -> StoredScene:
        """A valid scene, open for reading."""
        if scene_id not in self._scenes or not self._scenes[scene_id][1].valid:
            raise MissingError(f"{self.path} has no finished and valid scene {scene_id}")
        return self._cache.scene(self._shard_path(self._scenes[scene_id][0]), scene_id, self.record)

    def motion(self, split: str | None = None) -> Motion:
        """Sums of the valid scenes of a split, or of all."""
        zero = Motion(Sums.zero(self.record.dim), Sums.zero(self.record.dim))
        return functools.reduce(lambda a, b: a + b, (s.motion for s in self.scenes(split) if s.motion), zero)

    def check(self, scenes: Sequence[int] | None = None) -> None:
        """Compare the finished shards with their checksums, all of them or those of finished scenes.

        Raises:
            DamagedFileError: for a shard that was changed.
        """
        for index in self.finished if scenes is None else sorted({self._scenes[k][0] for k in scenes}):
            Shard(self._shard_path(index), check=True).close()

    def close(self) -> None:
        """Close the files; they are opened again when read."""
        self._cache.close()


def velocity_of(scene: StoredScene, interval: float) -> Array:
    """Velocities [T, N, D] (m/s) as stored, or differences of the positions of frames ``interval`` [s] apart."""
    if "velocity" in scene:
        return scene["velocity"]
    position = scene["position"]
    return np.gradient(position, interval, axis=0) if scene.frames > 1 else np.zeros_like(position)


class _OpenFiles:
    """Most recently read shards and scenes of this process. A forked process starts with none."""

    def __init__(self) -> None:
        self._process = os.getpid()
        self._shards: OrderedDict[Path, Shard] = OrderedDict()
        self._scenes: OrderedDict[int, StoredScene] = OrderedDict()

    def scene(self, path: Path, scene_id: int, record: DatasetRecord) -> StoredScene:
        if self._process != os.getpid():  # Files of the parent remain open there.
            self.__init__()  # type: ignore[misc]
        shard = self._shard(path)
        if scene_id not in self._scenes:
            self._scenes[scene_id] = scene = shard.scene(scene_id)
            if missing := [name for name in record.fields if name not in scene.names]:
                raise DamagedFileError(path, f"{scene_name(scene_id)} lacks {', '.join(missing)}", REMEDY)
            if (scene.frames, scene.dim) != (record.frames, record.dim):
                found = f"{scene.frames} frames in {scene.dim}-D, not {record.frames} in {record.dim}-D"
                raise DamagedFileError(path, f"{scene_name(scene_id)} has {found}", REMEDY)
        self._scenes.move_to_end(scene_id)
        while len(self._scenes) > MOST_OPEN:
            self._scenes.popitem(last=False)
        return self._scenes[scene_id]

    def _shard(self, path: Path) -> Shard:
        if path not in self._shards:
            self._shards[path] = Shard(path)
        self._shards.move_to_end(path)
        while len(self._shards) > MOST_OPEN:
            # Not closed here: HDF5 closes the file after the last of its scenes in use.
            for scene_id in self._shards.popitem(last=False)[1].ids:
                self._scenes.pop(scene_id, None)
        return self._shards[path]

    def close(self) -> None:
        for shard in self._shards.values():
            shard.close()
        self._shards.clear()
        self._scenes.clear()
