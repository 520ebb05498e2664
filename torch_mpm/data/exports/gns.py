"""NumPy files for geoelements/gns (https://github.com/geoelements/gns): ``train.npz``, ``valid.npz``, ``test.npz``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..folder import DatasetError, DatasetFolder
from ..whole_files import named_errors
from .common import Export, ExportedScene, as_float32, exporting

ANGLES = ("friction_angle",)
"""Parameters that data sets hold in degrees."""


def export_gns(dataset: str | Path | DatasetFolder, out: str | Path | None = None, material: str | None = None) -> Path:
    """Write a data set for geoelements/gns.

    Each split is one file with ``gns_data``, a one-dimensional array of (position float32 [T, N, D], particle type
    int64 [N][, material float32 [N]]). The file is pickled, as its loader requires; a complete split must fit in
    memory, in the loader too.

    Args:
        dataset: folder of the data set.
        out: folder to create; ``gns`` in that of the data set by default.
        material: name of an array [N] of every scene, such as "friction_angle", that becomes the material column;
            ``metadata.json`` then includes it in the number of node features. Angles become their tangent, the
            documented column of gns.

    Returns:
        The folder.

    Raises:
        FileExistsError, OSError, DatasetError, DamagedFileError: as :func:`torch_mpm.data.exports.common.exporting`;
            DatasetError also for a scene without the material.
    """
    with exporting(dataset, out, "gns", material=material is not None) as export:
        for split in export.dataset.record.splits:
            _write(export, split, material)
    return export.target


def _write(export: Export, split: str, material: str | None) -> None:
    scenes = [_entry(scene, material) for scene in export.scenes(split)]
    # An array of tuples must be filled one by one: NumPy 2 refuses to make it of ragged ones, and would make a table of
    # equal ones.
    data = np.empty(len(scenes), dtype=object)
    for k, scene in enumerate(scenes):
        data[k] = scene
    if scenes:
        path = export.folder / f"{split}.npz"
        with named_errors(path):
            np.savez(path, gns_data=data)


def _entry(scene: ExportedScene, material: str | None) -> tuple[np.ndarray, ...]:
    kind = scene.particle_type.astype(np.int64)
    if material is None:
        return scene.position, kind
    if material not in scene.arrays or scene.arrays.shape(material) != kind.shape:
        raise DatasetError(f"material must be the name of an array [N] of every scene, got {material!r}")
    values = as_float32(scene.arrays, material)
    return scene.position, kind, np.tan(np.radians(values)) if material in ANGLES else values
