"""Shards: HDF5 files with the finished scenes of a data set, each with a record of its content.

A shard appears under its name only when it is complete and on the disk, followed by its record: a shard without a
record does not count.

Layout: one group ``scene_0000000`` per scene, by its id in the data set. ``position`` [T, N, D] and other fields of
every frame are compressed in chunks of some frames, so that a window of frames is read without the rest. Arrays of one
dimension, such as ``particle_type`` [N], are stored as they are. Stresses have an attribute ``measure``, "Cauchy" or
"Kirchhoff" (without it, ``stress`` is the Kirchhoff stress). A scene that failed has attributes and no arrays.

A seal (:mod:`torch_mpm.data.hdf5`) protects all but the numbers of arrays, and is checked before HDF5 reads the file.
Chunks have the Adler-32 of zlib, arrays of one dimension a digest in the record.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import DamagedFileError
from ..files import check_file
from .hdf5 import READ_ERRORS, check_seal, h5py_module, storage_problem, unreadable
from .packing import array_digest
from .scene_words import read_words
from .statistics import Motion, Sums
from .stress import MEASURES, TENSORS, measure_of
from .whole_files import check_record, count, file_hash, write_record

Array = npt.NDArray[Any]

FORMAT = 3
FORMAT_WITHOUT_CHECKSUM = 2
"""Format of records that were written before records had checksums."""
REMEDY = "remove it and its .json, and generate again"
MOST_CHECKED = 2**16
"""Number of files whose check a process remembers."""


def shard_path(folder: str | Path, index: int) -> Path:
    """Path of shard ``index`` of the data set ``folder``."""
    return Path(folder) / "shards" / f"shard_{index:05d}.h5"


def record_path(shard: Path) -> Path:
    """Path of the record of a shard."""
    return shard.with_suffix(".json")


def scene_name(scene_id: int) -> str:
    return f"scene_{scene_id:07d}"


# ---- records


@dataclass(frozen=True)
class SceneRecord:
    """Record of a scene; ``motion`` is None for a failed one.

    ``digests`` are those of the uncompressed arrays, by name: HDF5 has none for them.
    """

    id: int
    valid: bool
    particles: int
    hash: str
    attempts: int
    failure: str
    motion: Motion | None
    digests: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, words: dict[str, Any]) -> SceneRecord:
        """Read from the words of a record; missing ones are a KeyError."""
        return cls(
            id=count(words["id"]),
            valid=bool(count(words["valid"] + 0)),
            particles=count(words["particles"]),
            hash=str(words["hash"]),
            attempts=count(words["attempts"]),
            failure=str(words["failure"]),
            motion=_motion(words["motion"]),
            digests={str(name): str(digest) for name, digest in words.get("digests", {}).items()},
        )


@dataclass(frozen=True)
class ShardRecord:
    """Record of a shard: the size [bytes] and the `file_hash` of its file, its scenes, the SHA-256 of its seal, and the
    hash of the configuration of its data set.

    ``seal`` and ``configuration`` are "" for shards that were written before shards had them.
    """

    bytes: int
    sha256: str
    scenes: list[SceneRecord]
    seal: str = ""
    configuration: str = ""

    def difference(self, configuration: str, ids: list[int]) -> str:
        """Difference from the shard of a data set with these scenes; "" for none."""
        if self.configuration not in ("", configuration):
            return f"is of another data set ({self.configuration[:12]}, this is {configuration[:12]})"
        return "" if [scene.id for scene in self.scenes] == ids else "has other scenes than those of its number"

    def write(self, path: Path) -> None:
        """Write the record to a file, which appears when it is complete and on the disk."""
        write_record(path, {"format": FORMAT, **asdict(self)})

    @classmethod
    def read(cls, path: Path) -> ShardRecord:
        """
        Raises:
            FileNotFoundError: for an unfinished shard.
            DamagedFileError: for a file that is not a record.
        """
        check_file(path, "shard", may_be_empty=True)
        data = path.read_bytes()
        try:
            words = json.loads(data)
            if words["format"] not in (FORMAT, FORMAT_WITHOUT_CHECKSUM):
                raise DamagedFileError(path, "is not of this version of torch_mpm", REMEDY)
            if words["format"] == FORMAT:
                check_record(words, path, REMEDY)
            scenes = [SceneRecord.of(s) for s in words["scenes"]]
            later = {name: str(words.get(name, "")) for name in ("seal", "configuration")}
            record = cls(count(words["bytes"]), str(words["sha256"]), scenes, **later)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
            if isinstance(error, DamagedFileError):
                raise
            raise DamagedFileError(path, f"is no record of a shard ({error})", REMEDY) from None
        return record


def _motion(words: dict[str, Any] | None) -> Motion | None:
    if words is None:
        return None
    sums = {n: Sums(count(s["count"]), _numbers(s["sum"]), _numbers(s["squares"])) for n, s in words.items()}
    motion = Motion(**sums)
    if len(lengths := {len(v) for s in sums.values() for v in (s.sum, s.squares)}) != 1:
        raise ValueError(f"sums must have one number of dimensions, got {sorted(lengths)}")
    return motion


def _numbers(values: Any) -> tuple[float, ...]:
    """Finite numbers, two or three."""
    numbers = tuple(map(float, values))
    if not 2 <= len(numbers) <= 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"sums must be 2 or 3 numbers, got {values!r}")
    return numbers


# ---- reading


class StoredScene:
    """Scene of an open shard. ``scene["position"]`` reads an array, ``scene.window("position", k, 7)`` some frames.

    Attributes:
        path, name: the shard, and the name of the group there.
        attributes: texts and numbers about the scene.
        frames, particles, dim: T, N and D; 0 for a failed scene.
    """

    def __init__(self, path: Path, group: Any, recorded: SceneRecord, intact: Callable[[], bool]) -> None:
        self.path, self._group, self.name, self._digests = path, group, group.name[1:], recorded.digests
        self._intact = intact
        try:
            problem, self.attributes = _scene_problem(group, path.stat().st_size)
        except READ_ERRORS as error:
            raise unreadable(path, f"{self.name} cannot be read", error, REMEDY, intact) from None
        shape: tuple[int, ...] = (0, 0, 0)
        if not problem and "position" in group:
            shape = group["position"].shape
        self.frames, self.particles, self.dim = shape
        if problem := problem or self._difference(recorded):
            raise DamagedFileError(path, f"{group.name[1:]} {problem}", REMEDY)

    def _difference(self, recorded: SceneRecord) -> str:
        """Difference from the record of the scene; "" for none."""
        if not bool(len(self._group)) == bool(self.attributes.get("valid", recorded.valid)) == recorded.valid:
            return "is valid in its record or in its file, but not in both"
        if self.particles != recorded.particles:
            return f"has {self.particles} particles, not {recorded.particles} as its record says"
        return ""

    @functools.cached_property
    def words(self) -> dict[str, Any]:
        """Scene file of the scene; empty where its attributes lack it.

        Raises:
            DamagedFileError: for words that are no scene file, with the key.
        """
        try:
            return read_words(str(self.attributes.get("scene", "{}")), self.dim)
        except ValueError as error:
            raise DamagedFileError(self.path, f"{self.name} has a wrong scene file: {error}", REMEDY) from None

    @property
    def names(self) -> list[str]:
        """Names of its arrays."""
        return list(self._group)

    @property
    def measures(self) -> dict[str, str]:
        """Measure of each stress, "Cauchy" or "Kirchhoff"; the latter for "stress" without the attribute `measure`."""
        stored = {name: self._measure(name) for name in self.names if name in MEASURES}
        try:
            return {name: measure_of(name, measure) for name, measure in stored.items()}
        except ValueError as error:
            raise DamagedFileError(self.path, f"{self.name}/{error}", REMEDY) from None

    def _measure(self, name: str) -> Any:
        try:
            return self._group[name].attrs.get("measure")
        except READ_ERRORS as error:
            raise unreadable(self.path, f"{self.name}/{name} cannot be read", error, REMEDY, self._intact) from None

    def shape(self, name: str) -> tuple[int, ...]:
        shape: tuple[int, ...] = self._group[name].shape
        return shape

    def __contains__(self, name: str) -> bool:
        return name in self._group

    def __getitem__(self, name: str) -> Array:
        """Complete array. Raises KeyError for a missing one, DamagedFileError for damaged bytes."""
        return self._read(name, ...)

    def window(self, name: str, first: int, frames: int) -> Array:
        """Frames ``first`` to ``first + frames - 1`` of an array [T, ...], without reading the rest of it.

        Raises:
            IndexError: for frames that the scene does not have.
            DamagedFileError: for damaged bytes.
        """
        if not 0 <= first <= first + frames <= self.frames:
            raise IndexError(f"frames must be within 0 and {self.frames}, got {first} to {first + frames}")
        return self._read(name, slice(first, first + frames))

    def _read(self, name: str, part: Any) -> Array:
        try:
            if name in self._group:
                values: Array = self._group[name][part]
                if part is not ... or name not in self._digests or array_digest(values).hex() == self._digests[name]:
                    return values
                raise DamagedFileError(self.path, f"{self.name}/{name}: its checksum is wrong", REMEDY)
        except READ_ERRORS as error:
            raise unreadable(self.path, f"{self.name}/{name} cannot be read", error, REMEDY, self._intact) from None
        raise KeyError(f"{self.name} of {self.path} has no {name!r}")


class Shard:
    """A finished shard, open for reading; works as a context manager.

    Args:
        path: the .h5 file.
        check: compare the whole file with its record first, which reads all of it; in any case its size and all but
            the numbers of its arrays are compared, once per process, and damage to the numbers is detected when they
            are read. Shards without a seal, of older versions, are compared as a whole, once per process.

    Raises:
        FileNotFoundError: for a missing or unfinished shard.
        OSError: for a file that cannot be read, or is a pipe, a device or a folder.
        DamagedFileError: for a file that is not a shard or is damaged; later, where damaged scenes are read.
        ImportError: when h5py is missing (extra ``data``).
    """

    def __init__(self, path: str | Path, check: bool = False) -> None:
        h5py = h5py_module()
        self.path = Path(path)
        self.record = ShardRecord.read(record_path(self.path))
        check_file(self.path, "shard", largest=None, may_be_empty=True)
        status = self.path.stat()
        if status.st_size != self.record.bytes:
            raise DamagedFileError(self.path, "is not as long as its record says", REMEDY)
        if check:
            _check_whole(self.path, self.record.sha256)
        if self.record.seal or not check:
            state = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
            _check_once(self.path, self.record.sha256, self.record.seal, state)
        try:
            self._file = h5py.File(self.path, "r")
        except READ_ERRORS as error:
            raise unreadable(self.path, "is not an HDF5 file", error, REMEDY, self._intact) from None

    def __enter__(self) -> Shard:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    def _intact(self) -> bool:
        """Whether the checksum of the file is correct, for which all of it is read."""
        return file_hash(self.path) == self.record.sha256

    @property
    def ids(self) -> list[int]:
        """Ids of its scenes, including failed ones."""
        return [scene.id for scene in self.record.scenes]

    def scene(self, scene_id: int) -> StoredScene:
        """
        Raises:
            KeyError: for a scene outside this shard.
            DamagedFileError: for a scene with anything but plain internal arrays.
        """
        h5py, name = h5py_module(), scene_name(scene_id)
        if scene_id not in self.ids:
            raise KeyError(f"{self.path} has no scene {scene_id}")
        try:
            hard = isinstance(self._file.get(name, getlink=True), h5py.HardLink)
            group = self._file[name] if hard else None
        except READ_ERRORS as error:
            raise unreadable(self.path, f"{name} cannot be read", error, REMEDY, self._intact) from None
        if not isinstance(group, h5py.Group):
            raise DamagedFileError(self.path, f"lacks {name}", REMEDY)
        recorded = next(recorded for recorded in self.record.scenes if recorded.id == scene_id)
        return StoredScene(self.path, group, recorded, self._intact)

    def __iter__(self) -> Iterator[StoredScene]:
        return (self.scene(scene_id) for scene_id in self.ids)


@functools.lru_cache(MOST_CHECKED)
def _check_once(path: Path, sha256: str, sealed: str, state: tuple[int, ...]) -> None:
    """Compare a file with its record before HDF5 reads it, which may hang on damaged bytes.

    The cache stores the files that were as recorded; a changed ``state`` of a file is another entry.

    Raises:
        DamagedFileError: for a file that was changed.
    """
    if not sealed:
        _check_whole(path, sha256)
    elif check_seal(path, REMEDY) != sealed:
        raise DamagedFileError(path, "is another shard than that of its record", REMEDY)


def _check_whole(path: Path, sha256: str) -> None:
    if file_hash(path) != sha256:
        raise DamagedFileError(path, "is damaged: its checksum is wrong", REMEDY)


STORED = ("<f4", "<f8", "|i1", "|u1", "<i2", "<i4", "<i8")
"""Types of the numbers of arrays."""


def _is_positions(data: Any) -> bool:
    return data.ndim == 3 and data.dtype.kind == "f" and data.shape[2] in (2, 3)


def _scene_problem(group: Any, size: int) -> tuple[str, dict[str, Any]]:
    """Reason why a group is not a scene, "" for none, and its attributes; the errors of h5py."""
    h5py = h5py_module()
    for name in group:
        hard = isinstance(group.get(name, getlink=True), h5py.HardLink)
        data = group[name] if hard else None
        if not isinstance(data, h5py.Dataset) or data.dtype.kind not in "fiu":
            return f"has {name!r}, which is no array of numbers", {}
        if problem := storage_problem(h5py, data, size):
            return f"has {name!r}, {problem}", {}
    attributes = dict(group.attrs)
    if not all(isinstance(v, (str, np.integer, np.floating)) for v in attributes.values()):
        return "has attributes that are neither text nor numbers", {}
    if len(group) and ("position" not in group or not _is_positions(group["position"])):
        return "has no positions [T, N, 2 or 3]", {}
    for name in group:
        frames, particles, dim = group["position"].shape
        shape, kind = group[name].shape, group[name].dtype
        if shape[:2] != (frames, particles) and shape != (particles,):
            return f"has {name!r} of shape {list(shape)}, which is neither [T, N, ...] nor [N]", {}
        known = {**dict.fromkeys(("F", *TENSORS), (frames, particles, dim, dim)), "velocity": (frames, particles, dim)}
        known |= dict.fromkeys(("mass", "volume"), (particles,))
        if shape != known.get(name, shape):
            return f"has {name!r} of shape {list(shape)}, not {list(known[name])}", {}
        if kind.str not in STORED or (name == "particle_type" and (kind.kind != "i" or len(shape) != 1)):
            return f"has {name!r} of type {kind} and shape {list(shape)}", {}
    return "", {name: v if isinstance(v, str) else v.item() for name, v in attributes.items()}
