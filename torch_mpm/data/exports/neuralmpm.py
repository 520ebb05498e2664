"""HDF5 files for NeuralMPM (Rochman Sharabi et al. 2025, https://github.com/OmerRochman/NeuralMPM), one per scene."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from ..folder import DatasetFolder
from ..hdf5 import new_file
from .common import exporting, fields_of

log = logging.getLogger(__name__)


def export_neuralmpm(
    dataset: str | Path | DatasetFolder, out: str | Path | None = None, fields: Sequence[str] = ()
) -> Path:
    """Write a data set for NeuralMPM.

    ``train/sim_0.h5`` and so on have ``particles`` [T, N, D], ``boundary`` [T, M, D] and ``types`` [N].

    Its parsers derive material, bounds, interval and length from the name of the folder, so give ``out`` the name of
    one of its data sets (``WaterRamps``, ``Sand``, ``Goop``, ...) and generate with the numbers of that set, or write a
    parser. Its models are two-dimensional: a warning states that they cannot read a data set in 3-D.

    Args, returns and errors as :func:`export_lagrangebench`.
    """
    with exporting(dataset, out, "neuralmpm") as export:
        if export.dataset.record.dim != 2:
            log.warning("NeuralMPM reads scenes in 2-D alone; those of this data set are in 3-D")
        for split in export.dataset.record.splits:
            folder = export.folder / split
            folder.mkdir()
            for k, scene in enumerate(export.scenes(split)):
                with new_file(folder / f"sim_{k}.h5") as (file, _):
                    free = ~scene.boundary
                    for name, rows in (("particles", free), ("boundary", scene.boundary)):
                        values = scene.position[:, rows]
                        options = {"compression": "gzip", "compression_opts": 1} if values.size else {}
                        file.create_dataset(name, data=values, **options)
                    file.create_dataset("types", data=scene.particle_type[free].astype("i8"))
                    for name, field in fields_of(scene, fields, ("particles", "boundary", "types")).items():
                        values = scene.arrays[field]
                        file.create_dataset(name, data=values[:, free] if values.ndim > 1 else values[free])
    return export.target
