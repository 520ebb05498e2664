"""HDF5 files for LagrangeBench (Toshev et al. 2023, https://github.com/tumaer/lagrangebench): ``train.h5``, ..."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..folder import DatasetError, DatasetFolder
from ..hdf5 import new_file
from ..metadata import particle_spacing
from ..statistics import BOUNDARY
from .common import PARTICLE_TYPES, RIGID, Array, Export, ExportedScene, exporting, fields_of

FLUID, SOLID_WALL, MOVING_WALL, RIGID_BODY = 0, 1, 2, 3


def export_lagrangebench(
    dataset: str | Path | DatasetFolder, out: str | Path | None = None, fields: Sequence[str] = ()
) -> Path:
    """Write a data set for LagrangeBench.

    Each split is one file with groups ``00000``, ``00001``, ... of ``position`` float32 [T, N, D] (gzip) and
    ``particle_type`` int64 [N] in its codes: walls 1, moving walls 2, rigid bodies 3, fluids 0 and, with several
    materials, 4 to 8. ``metadata.json`` lists the codes by particle type.

    Args:
        dataset: folder of the data set.
        out: folder to create; ``lagrangebench`` in that of the data set by default.
        fields: further arrays of the scenes to write beside the positions, such as "stress", which is written as
            ``cauchy_stress``; its loader skips them.

    Returns and errors as :func:`export_gns`; DatasetError also for a field that is missing or written twice.
    """
    codes: dict[int, int] = {}
    with exporting(dataset, out, "lagrangebench", more=lambda dataset: _words(dataset, codes)) as export:
        codes |= _codes(export.dataset)
        for split in export.dataset.record.splits:
            _write(export, split, codes, fields)
    return export.target


def _words(dataset: DatasetFolder, codes: dict[int, int]) -> dict[str, Any]:
    """Additional entries of its metadata."""
    types = {str(kind): code for kind, code in codes.items()}
    words = {"write_every": 1, "dx": particle_spacing(dataset), "solver": "MPM", "case": dataset.record.title}
    return {**words, "particle_types": types}


def _codes(dataset: DatasetFolder) -> dict[int, int]:
    """Codes of the particle types that are neither walls nor rigid bodies."""
    stored = (dataset.scene(scene.id) for scene in dataset.scenes() if scene.particles)
    kinds = set().union(*(np.unique(scene["particle_type"]).tolist() for scene in stored)) - {RIGID, BOUNDARY}
    codes = [FLUID, *range(RIGID_BODY + 1, PARTICLE_TYPES)]
    if len(kinds) > len(codes):
        raise DatasetError(f"LagrangeBench has {len(codes)} codes for fluids, got {len(kinds)} particle types")
    return dict(zip(sorted(kinds), codes, strict=False))


def _write(export: Export, split: str, codes: dict[int, int], fields: Sequence[str]) -> None:
    path = export.folder / f"{split}.h5"
    with new_file(path) as (file, disk):
        for k, scene in enumerate(export.scenes(split)):
            group = file.create_group(f"{k:05d}")
            group.create_dataset("position", data=scene.position, compression="gzip", compression_opts=1, shuffle=True)
            group.create_dataset("particle_type", data=_types(scene, codes))
            for name, field in fields_of(scene, fields).items():
                values = scene.arrays[field]
                group.create_dataset(name, data=values, compression="gzip", compression_opts=1, shuffle=True)
            disk.check()
        empty = not len(file)
    if empty:
        path.unlink()


def _types(scene: ExportedScene, codes: dict[int, int]) -> Array:
    types = np.full(len(scene.particle_type), FLUID, np.int64)
    for kind, code in codes.items():
        types[scene.particle_type == kind] = code
    types[scene.particle_type == RIGID] = RIGID_BODY
    moves = (scene.position != scene.position[0]).any(axis=(0, 2))
    types[scene.boundary] = np.where(moves[scene.boundary], MOVING_WALL, SOLID_WALL)
    return types
