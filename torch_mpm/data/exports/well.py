"""Uniform grids in the format of The Well (Ohana et al. 2024, https://github.com/PolymathicAI/the_well)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import host_memory
from ..folder import DatasetError, DatasetFolder, DatasetRecord, velocity_of
from ..hdf5 import h5py_module, new_file
from ..obstacle_fields import obstacle_mask, obstacles_of
from ..rasterise import cell_centres, rasterise
from ..statistics import Sums
from ..whole_files import file_name, write_whole
from .common import Array, Export, ExportedScene, as_float32, exported_ids, exporting

AXES = ("x", "y", "z")


def export_well(dataset: str | Path | DatasetFolder, out: str | Path | None = None, dx: float | None = None) -> Path:
    """Write density and velocity on a uniform grid, for models on grids: ``data/train/NAME.hdf5``, ``stats.yaml``.

    A data set with obstacles has a field ``obstacle`` too, 1 in cells whose centre is inside one. Gravity and the
    numbers of materials that every scene has are scalars, such as ``gravity_y`` and ``sand_friction_angle``.

    Args:
        dataset: folder of the data set.
        out: folder to create; ``well`` in that of the data set by default.
        dx: size of a cell [m]; twice that of the simulation by default, about 16 particles a cell in 2-D.

    Returns and errors as :func:`export_gns`; DatasetError also for a dx that is not positive.
    """
    if dx is not None and not 0 < dx < math.inf:
        raise DatasetError(f"dx must be positive and finite, got {dx}")
    with exporting(dataset, out, "well") as export:
        record = export.dataset.record
        side = min(b - a for a, b in zip(record.lower, record.upper, strict=True))
        if dx is not None and dx > side:
            raise DatasetError(f"dx must be at most {side:g}, the shortest side of the domain, got {dx:g}")
        _require_memory(record, dx or 2 * record.dx)
        name = file_name(record.title) or "torch_mpm"
        scalars = {scene.id: _scalars(export, scene.id) for scene in export.dataset.scenes()}
        shared = set.intersection(*map(set, scalars.values()))
        kept = {number: {n: v for n, v in values.items() if n in shared} for number, values in scalars.items()}
        solid = any(export.dataset.scene(number).words.get("obstacle") for number in scalars)
        orders = {"density": 0, "velocity": 1} | ({"obstacle": 0} if solid else {})
        statistics: dict[str, _Statistics] = {}
        for split in record.splits:
            if exported_ids(export.dataset, split):
                statistics[split] = _write(export, split, name, dx or 2 * record.dx, orders, kept)
        chosen = statistics.get("train") or next(iter(statistics.values()))
        write_whole(export.folder / "stats.yaml", json.dumps(chosen.words(), indent=1).encode())  # JSON is valid YAML.
    return export.target


def _require_memory(record: DatasetRecord, dx: float) -> None:
    """Raise MemoryError where the fields of a scene do not fit into the memory."""
    cells = math.prod((b - a) / dx for a, b in zip(record.lower, record.upper, strict=True))
    host_memory.require(4 * cells * record.frames * (1 + record.dim), f"a scene in {cells:.3g} cells of {dx:g} m")


class _Statistics:
    """Statistics of the fields and of their changes between frames, over all cells."""

    def __init__(self, orders: dict[str, int], dim: int) -> None:
        self.sums = {name: [Sums.zero(dim**order) for _ in range(2)] for name, order in orders.items()}

    def add(self, fields: dict[str, Array]) -> None:
        for name, values in fields.items():
            vectors = values.astype(np.float64).reshape(len(values), -1, len(self.sums[name][0].sum))
            for k, part in enumerate((vectors, np.diff(vectors, axis=0))):
                self.sums[name][k] += Sums.of(np.moveaxis(part, -1, 0))

    def words(self) -> dict[str, dict[str, float | list[float]]]:
        def plain(values: list[float]) -> float | list[float]:
            return values[0] if len(values) == 1 else values

        return {
            f"{statistic}{suffix}": {name: plain(getattr(sums[k], statistic)) for name, sums in self.sums.items()}
            for k, suffix in enumerate(("", "_delta"))
            for statistic in ("mean", "std")
        }


def _write(
    export: Export, split: str, name: str, dx: float, orders: dict[str, int], scalars: dict[int, dict[str, float]]
) -> _Statistics:
    """The file of a split, with fields of these orders and these scalars of its scenes."""
    record, count = export.dataset.record, len(exported_ids(export.dataset, split))
    statistics = _Statistics(orders, record.dim)
    folder = export.folder / "data" / split
    folder.mkdir(parents=True)
    with new_file(folder / f"{name}.hdf5") as (file, disk):
        file.attrs.update(
            {"dataset_name": name, "grid_type": "cartesian", "n_spatial_dims": record.dim, "n_trajectories": count}
        )
        file.attrs["simulation_parameters"] = _names([])
        fields = _layout(file, export, orders, dx, count)
        _write_scalars(file, [scalars[number] for number in exported_ids(export.dataset, split)])
        for k, scene in enumerate(export.scenes(split)):
            values = _fields(scene, export, dx)
            if "obstacle" in orders:
                times = record.frame_interval * np.arange(record.frames)
                centres = cell_centres(record.lower, record.upper, dx)
                values["obstacle"] = obstacle_mask(obstacles_of(scene.arrays.words), centres, times)
            statistics.add(values)
            for field, data in values.items():
                fields[field][k] = data
            disk.check()
    return statistics


def _names(names: list[str]) -> Array:
    return np.array(names, dtype=h5py_module().string_dtype())


def _write_scalars(file: Any, scenes: list[dict[str, float]]) -> None:
    group, names = file.create_group("scalars"), list(scenes[0])
    group.attrs["field_names"] = _names(names)
    for name in names:
        data = group.create_dataset(name, data=np.array([scene[name] for scene in scenes], np.float32))
        data.attrs.update({"sample_varying": True, "time_varying": False})


def _scalars(export: Export, number: int) -> dict[str, float]:
    """Gravity and the numeric parameters of the materials of a scene."""
    words = export.dataset.scene(number).words
    gravity = words.get("gravity") or [0.0] * export.dataset.record.dim
    found = {f"gravity_{axis}": float(value) for axis, value in zip(AXES, gravity, strict=False)}
    for material, values in words.get("material", {}).items():
        for key, value in values.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                name = f"{material}_{key}".replace("/", "_")  # HDF5 separates groups by slashes.
                if name in found:
                    raise DatasetError(f"scene {number} has two numbers that would be the scalar {name!r}")
                found[name] = float(value)
    return found


def _layout(file: Any, export: Export, orders: dict[str, int], dx: float, count: int) -> dict[str, Any]:
    """All of a file except the numbers of its fields; returns the arrays that these are written to."""
    record = export.dataset.record
    axes, centres = list(AXES[: record.dim]), cell_centres(record.lower, record.upper, dx)
    varying = {"sample_varying": False, "time_varying": False}
    dimensions, walls = file.create_group("dimensions"), file.create_group("boundary_conditions")
    dimensions.attrs["spatial_dims"] = _names(axes)
    time = dimensions.create_dataset("time", data=record.frame_interval * np.arange(record.frames, dtype=np.float32))
    time.attrs.update({"sample_varying": False})
    for axis, coordinates in zip(axes, centres, strict=True):
        dimensions.create_dataset(axis, data=coordinates.numpy().astype(np.float32)).attrs.update(varying)
        wall = walls.create_group(f"{axis}_wall")
        wall.attrs.update({"bc_type": "WALL", **varying})
        wall.attrs["associated_dims"], wall.attrs["associated_fields"] = _names([axis]), _names([])
        ends = np.zeros(len(coordinates), bool)
        ends[[0, -1]] = True
        wall.create_dataset("mask", data=ends)
    shape = (count, record.frames, *(len(c) for c in centres))
    arrays = {}
    for order in range(3):
        group = file.create_group(f"t{order}_fields")
        names = [name for name, own in orders.items() if own == order]
        group.attrs["field_names"] = _names(names)
        for name in names:
            full = shape + (record.dim,) * order
            chunk = (1, 1, *full[2:])
            data = group.create_dataset(name, full, "f4", chunks=chunk, compression="gzip", compression_opts=1)
            data.attrs.update({"dim_varying": [True] * record.dim, "sample_varying": True, "time_varying": True})
            arrays[name] = data
    return arrays


def _fields(scene: ExportedScene, export: Export, dx: float) -> dict[str, Array]:
    """Values of all particles that are not a boundary."""
    record, free, stored = export.dataset.record, ~scene.boundary, scene.arrays
    known = "velocity" in stored
    velocity = as_float32(stored, "velocity") if known else velocity_of(stored, record.frame_interval)
    values = (scene.position[:, free], velocity[:, free], as_float32(stored, "mass")[free])
    x, v, m = (torch.from_numpy(a.astype(np.float32)) for a in values)
    density, mean = rasterise(x, v, m, record.lower, record.upper, dx)
    return {"density": density.numpy(), "velocity": mean.numpy()}
