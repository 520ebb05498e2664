"""Common parts of exports: selection of scenes, checks of what loaders require, a folder that appears when complete."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..folder import DatasetError, DatasetFolder
from ..host_memory import in_words
from ..metadata import metadata, write_metadata
from ..shard import StoredScene
from ..statistics import BOUNDARY
from ..stress import explicit_name
from ..whole_files import building_path, named_errors, output_path, remove_leftovers

Array = npt.NDArray[Any]

RIGID = 0
PARTICLE_TYPES = 9
"""Upper bound of the codes of particle types in DeepMind's models and their descendants."""


@dataclass(frozen=True)
class ExportedScene:
    """Scene in the form of exports: position [T, N, D] (m), particle_type [N], and the scene for other arrays."""

    id: int
    position: Array
    particle_type: Array
    arrays: StoredScene

    @property
    def boundary(self) -> Array:
        """Whether particles have prescribed motion, bool [N]."""
        mask: Array = self.particle_type == BOUNDARY
        return mask


@dataclass(frozen=True)
class Export:
    """Export in progress in ``folder``, which becomes ``target``."""

    dataset: DatasetFolder
    folder: Path
    target: Path

    def scenes(self, split: str) -> Iterator[ExportedScene]:
        """The valid scenes of a split that have particles, by id.

        Raises:
            DatasetError: for a scene that loaders cannot read: without types or with unknown ones.
            DamagedFileError: for a scene that is damaged.
        """
        for number in exported_ids(self.dataset, split):
            stored = self.dataset.scene(number)
            position = as_float32(stored, "position")
            kind = required(stored, "particle_type")
            if kind.min() < 0 or kind.max() >= PARTICLE_TYPES:
                raise DatasetError(f"particle_type must be within 0 and {PARTICLE_TYPES - 1}, got {kind.max()}")
            yield ExportedScene(number, position, kind, stored)


def required(scene: StoredScene, name: str) -> Array:
    """Array of a scene; DatasetError where it is missing."""
    if name not in scene:
        raise DatasetError(f"{scene.path}: {scene.name} must have {name}")
    return scene[name]


def as_float32(scene: StoredScene, name: str) -> Array:
    """Array of a scene in float32; DatasetError where it is missing, or has numbers that float32 cannot hold."""
    values = required(scene, name)
    with np.errstate(over="ignore"):
        cast = np.ascontiguousarray(values, np.float32)
    if values.dtype != cast.dtype and not np.isfinite(cast).all():
        raise DatasetError(f"{scene.path}: {name} of {scene.name} has numbers that float32 cannot hold")
    return cast


def fields_of(scene: ExportedScene, names: Sequence[str], own: Sequence[str] = ()) -> dict[str, str]:
    """Further arrays of a scene, [T, N, ...] or [N], by their name in the export, which has the measure of a stress.

    Args:
        scene: the scene.
        names: names of its arrays.
        own: names that the format gives to its own arrays.

    Raises:
        DatasetError: for an array that is missing, or whose name in the export is that of another one.
    """
    measures, always = scene.arrays.measures, ("position", "particle_type")
    found: dict[str, str] = {}
    for name in dict.fromkeys(names):
        if name in always or name not in scene.arrays:
            known = ", ".join(n for n in scene.arrays.names if n not in always)
            problem = "every export has" if name in always else f"scene {scene.id} does not have"
            raise DatasetError(f"fields must be of {known}, got {name!r}, which {problem}")
        written = explicit_name(name, measures.get(name, ""))
        if written in (*own, *found):
            raise DatasetError(f"fields: {name!r} would be written as {written!r}, a name of another array")
        found[written] = name
    return found


def exported_ids(dataset: DatasetFolder, split: str) -> list[int]:
    return [scene.id for scene in dataset.scenes(split) if scene.particles]


@contextlib.contextmanager
def exporting(
    source: str | Path | DatasetFolder,
    out: str | Path | None,
    name: str,
    material: bool = False,
    more: Callable[[DatasetFolder], Mapping[str, Any]] = lambda dataset: {},
) -> Iterator[Export]:
    """Export into ``out``, by default the folder ``name`` of the data set, which appears at the end of the block.

    Every shard is compared with its checksum first. ``metadata.json`` is written at the end, with the words that
    ``more`` returns for the data set.

    Raises:
        FileExistsError: when ``out`` exists already.
        OSError: when the disk has no space for the uncompressed data.
        DatasetError: for a data set without a valid scene.
        DamagedFileError: for a data set that is damaged.
    """
    dataset = source if isinstance(source, DatasetFolder) else DatasetFolder(source)
    target = output_path(dataset.path, name, out)
    dataset.check()
    words = metadata(dataset, material=material)
    with new_folder(target) as folder:
        _require_room(dataset, folder)
        yield Export(dataset, folder, target)
        write_metadata(folder, {**words, **more(dataset)})


def _require_room(dataset: DatasetFolder, folder: Path) -> None:
    particles = sum(scene.particles for scene in dataset.scenes())
    wanted = 4 * particles * dataset.record.frames * dataset.record.dim
    free = shutil.disk_usage(folder).free
    if wanted > free:
        room = f"the positions need {in_words(wanted)}, and {in_words(free)} are free"
        raise OSError(errno.ENOSPC, room, str(folder.parent))


@contextlib.contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Folder beside ``target`` that is renamed to it when the block succeeds, and removed when it fails.

    Raises:
        FileExistsError: when the name exists already.
    """
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, "exists already; remove it, or choose another folder", str(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(target.parent)
    building = building_path(target)
    shutil.rmtree(building, ignore_errors=True)
    try:
        with named_errors(target, building):
            building.mkdir()
            yield building
            for path in [*building.rglob("*"), building]:
                _sync(path)
            building.rename(target)
            _sync(target.parent)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
