"""HDF5 files for LagrangeBench (Toshev et al. 2023, https://github.com/tumaer/lagrangebench): ``train.h5``, ..."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..folder import DatasetFolder
from ..hdf5 import h5py_module
from ..metadata import particle_spacing
from .common import RIGID, Array, Export, ExportedScene, exporting

FLUID, SOLID_WALL, MOVING_WALL, RIGID_BODY = 0, 1, 2, 3


def export_lagrangebench(dataset: str | Path | DatasetFolder, out: str | Path | None = None) -> Path:
    """Write a data set for LagrangeBench.

    Each split is one file with groups ``00000``, ``00001``, ... of ``position`` float32 [T, N, D] (gzip) and
    ``particle_type`` int64 [N] in its codes: what flows 0, walls 1, walls that move 2, rigid bodies 3.

    Args, returns and errors as :func:`export_gns`, without ``material``.
    """
    source = dataset if isinstance(dataset, DatasetFolder) else DatasetFolder(dataset)
    words = {"write_every": 1, "dx": particle_spacing(source), "solver": "MPM", "case": source.record.title}
    with exporting(source, out, "lagrangebench", more=words) as export:
        for split in source.record.splits:
            _write(export, split)
    return export.target


def _write(export: Export, split: str) -> None:
    path = export.folder / f"{split}.h5"
    with h5py_module().File(path, "w") as file:
        for k, scene in enumerate(export.scenes(split)):
            group = file.create_group(f"{k:05d}")
            group.create_dataset("position", data=scene.position, compression="gzip", compression_opts=1, shuffle=True)
            group.create_dataset("particle_type", data=_types(scene))
        empty = not len(file)
    if empty:
        path.unlink()


def _types(scene: ExportedScene) -> Array:
    types = np.full(len(scene.particle_type), FLUID, np.int64)
    types[scene.particle_type == RIGID] = RIGID_BODY
    moves = (scene.position != scene.position[0]).any(axis=(0, 2))
    types[scene.boundary] = np.where(moves[scene.boundary], MOVING_WALL, SOLID_WALL)
    return types
