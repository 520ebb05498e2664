"""Chosen scenes of a data set for visualisation: VTK for ParaView, PLY point clouds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..export import Array, write_ply, write_vtk
from ..folder import DatasetError, DatasetFolder, velocity_of
from ..shard import StoredScene, scene_name
from ..whole_files import output_path
from .common import new_folder


def export_scenes_vtk(
    dataset: str | Path | DatasetFolder, out: str | Path | None = None, scenes: Sequence[int] | None = None
) -> Path:
    """Write scenes as ``scene_0000000/frame_00000.vtu``, ..., and ``run.pvd``, with all their fields as `export_vtk`.

    Args:
        dataset: folder of the data set.
        out: folder to create; ``vtk`` in that of the data set by default.
        scenes: ids; the first valid scene by default.

    Returns:
        The folder.

    Raises:
        FileExistsError: when ``out`` exists already.
        KeyError: for a scene that does not exist, failed, or is not finished.
        DatasetError: for no scene.
        DamagedFileError: for a shard of these scenes that is damaged: its checksum is verified first.
        ImportError: when meshio is missing (extra ``data``).
    """
    return _export(dataset, out, scenes, "vtk", lambda scene, frames, path: write_vtk(frames, path, scene.measures))


def export_scenes_ply(
    dataset: str | Path | DatasetFolder, out: str | Path | None = None, scenes: Sequence[int] | None = None
) -> Path:
    """Write scenes as point clouds ``scene_0000000/frame_00000.ply``; all else as :func:`export_scenes_vtk`."""
    return _export(dataset, out, scenes, "ply", lambda scene, frames, path: write_ply(frames, path))


def _export(
    source: str | Path | DatasetFolder,
    out: str | Path | None,
    scenes: Sequence[int] | None,
    name: str,
    write: Callable[[StoredScene, Iterable[dict[str, Array]], Path], Any],
) -> Path:
    dataset = source if isinstance(source, DatasetFolder) else DatasetFolder(source)
    target = output_path(dataset.path, name, out)
    chosen = [scene.id for scene in dataset.scenes()[:1]] if scenes is None else scenes
    if not chosen:
        raise DatasetError(f"{dataset.path} has no valid scene yet" if scenes is None else "scenes must not be empty")
    stored = {number: dataset.scene(number) for number in chosen}
    dataset.check(chosen)
    with new_folder(target) as folder:
        for number, scene in stored.items():
            (folder / scene_name(number)).mkdir()
            write(scene, scene_frames(scene, dataset.record.frame_interval), folder / scene_name(number))
    return target


def scene_frames(scene: StoredScene, interval: float) -> Iterator[dict[str, Array]]:
    """Frames of a scene in the form of a trajectory: fields, constants, and time."""
    arrays = {name: scene[name] for name in scene.names} | {"velocity": velocity_of(scene, interval)}
    moving = [name for name, a in arrays.items() if a.shape[:2] == (scene.frames, scene.particles)]
    fixed = {name: a for name, a in arrays.items() if a.shape == (scene.particles,)}
    for k in range(scene.frames):
        yield {**{name: arrays[name][k] for name in moving}, **fixed, "time": np.array(k * interval)}
