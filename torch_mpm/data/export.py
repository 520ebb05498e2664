"""Trajectories in the formats of other programs: VTK for ParaView, PLY point clouds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from .. import optional
from .stress import CAUCHY, explicit_name
from .trajectory import Array, Trajectory, find
from .whole_files import output_folder, output_path, replacing


def export_vtk(run: str | Path, out: str | Path | None = None) -> Path:
    """Write every frame as ``frame_00000.vtu`` with all its fields, and ``run.pvd`` with their times.

    Stresses have their measure in their name: ``cauchy_stress``, ``kirchhoff_stress``. Tensors are 3 x 3. In 2-D F_zz
    is one, and σ_zz is that of ``out_of_plane_stress``, NaN where the trajectory has none.

    Args:
        run: run folder or trajectory file.
        out: folder; ``vtk`` beside the trajectory by default.

    Returns:
        The .pvd file, which ParaView opens.

    Raises:
        FileNotFoundError: when there is no trajectory.
        DamagedFileError: for a trajectory that is damaged, or a link out of its folder in place of the output.
        ImportError: when meshio is missing (extra ``data``).
    """
    folder = _folder(run, out, "vtk")
    with Trajectory(run) as trajectory, output_folder(folder):
        return write_vtk(trajectory, folder, trajectory.measures)


def export_ply(run: str | Path, out: str | Path | None = None) -> Path:
    """Write every frame as a binary point cloud ``frame_00000.ply`` with velocity and speed; returns their folder.

    Arguments and errors as for :func:`export_vtk`.
    """
    folder = _folder(run, out, "ply")
    with Trajectory(run) as trajectory, output_folder(folder):
        return write_ply(trajectory, folder)


def write_vtk(frames: Iterable[dict[str, Array]], folder: Path, measures: Mapping[str, str]) -> Path:
    """Write frames in the form of :meth:`Trajectory.frame` into a folder; returns ``run.pvd``.

    Args:
        frames: arrays by name.
        folder: output folder.
        measures: measure of each stress, "Cauchy" or "Kirchhoff".
    """
    files = []
    for k, frame in enumerate(frames):
        name = f"frame_{k:05d}.vtu"
        count = len(frame["position"])
        fields = _per_particle(frame)
        data = {key: _three_dimensional(value) for key, value in fields.items() if key not in measures}
        data |= {explicit_name(key, measure): _stress(key, measure, fields) for key, measure in measures.items()}
        if "F" in fields:
            data["F"] = _three_dimensional(fields["F"], 1.0)
        cells = [("vertex", np.arange(count)[:, None])]
        _write(folder / name, _mesh(frame["position"], cells, {**data, "id": np.arange(count)}), {})
        files.append(CollectedFile(float(frame["time"]), name))
    index = folder / "run.pvd"
    write_collection(index, files)
    return index


class CollectedFile(NamedTuple):
    """File of a collection: its time [s], its name, and its number among those of the same time."""

    time: float
    name: str
    part: int = 0


def write_collection(path: Path, files: Iterable[CollectedFile]) -> None:
    """Write a .pvd file, the list of the VTK files of a run with their times, which ParaView opens."""
    collection = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    listing = ElementTree.SubElement(collection, "Collection")
    for file in files:
        words = {"timestep": f"{file.time:.9g}", "file": file.name}
        ElementTree.SubElement(listing, "DataSet", words | ({"part": str(file.part)} if file.part else {}))
    with replacing(path) as building:
        ElementTree.ElementTree(collection).write(building, xml_declaration=True)


def write_ply(frames: Iterable[dict[str, Array]], folder: Path) -> Path:
    """Write frames in the form of :meth:`Trajectory.frame` into a folder, which is returned."""
    for k, frame in enumerate(frames):
        velocity = _three_dimensional(frame["velocity"])
        data = {f"v{axis}": velocity[:, i] for i, axis in enumerate("xyz")}
        data["speed"] = np.linalg.norm(velocity, axis=1).astype(velocity.dtype)
        _write(folder / f"frame_{k:05d}.ply", _mesh(frame["position"], [], data), {"binary": True})
    return folder


def _folder(run: str | Path, out: str | Path | None, name: str) -> Path:
    return output_path(find(run).parent, name, out)


def meshio_module() -> Any:
    return optional.load("meshio", "VTK and PLY files", "data")


def _mesh(position: Array, cells: list[Any], data: dict[str, Array]) -> Any:
    return meshio_module().Mesh(_three_dimensional(position), cells, point_data=data)


def _write(path: Path, mesh: Any, options: dict[str, Any]) -> None:
    """Write a file that appears only when it is complete."""
    with replacing(path) as building:
        meshio_module().write(building, mesh, file_format=path.suffix[1:], **options)


def _per_particle(frame: dict[str, Array]) -> dict[str, Array]:
    count = len(frame["position"])
    fields = {name: value for name, value in frame.items() if np.ndim(value) and len(value) == count}
    return {name: value for name, value in fields.items() if name not in ("position", "momentum")}


def _three_dimensional(value: Array, last: Array | float = 0.0) -> Array:
    """[P, 2] and [P, 2, 2] padded with zeros, since both formats have three dimensions; tensors as rows of 9.

    Args:
        value: [P, ...].
        last: entry zz of tensors in 2-D, [P] or a number.
    """
    padding = [(0, 0)] + [(0, 3 - n) for n in value.shape[1:]]
    whole = np.pad(value, padding)
    if value.shape[1:] == (2, 2):
        whole[:, 2, 2] = last
    return whole.reshape(len(value), *([math.prod(whole.shape[1:])] if value.ndim > 1 else []))  # -1 needs particles.


def _stress(name: str, measure: str, fields: Mapping[str, Array]) -> Array:
    """A stress, with its out-of-plane component where known."""
    known = measure == CAUCHY and "out_of_plane_stress" in fields
    return _three_dimensional(fields[name], fields["out_of_plane_stress"] if known else np.nan)
