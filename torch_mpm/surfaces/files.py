"""Files of surfaces: PLY, OBJ and VTP, which appear when they are complete."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from .. import optional
from ..data.whole_files import replacing
from .reconstruction import Array, Surface, SurfaceError

PACKAGES = {"ply": ("meshio", "surface"), "obj": ("trimesh", "surface"), "vtp": ("vtkmodules", "render")}
"""Package that writes a format, and its extra."""


def write_surface(path: Path, surface: Surface, velocity: Array) -> None:
    """Write a surface in the format of the suffix: ``.ply``, ``.obj`` or ``.vtp``.

    Args:
        path: the file.
        surface: the mesh, which may be empty.
        velocity: at the vertices [V, 3] [m/s]; OBJ has no place for it.

    Raises:
        ImportError: for a missing package: meshio (PLY), trimesh (OBJ), vtk (VTP).
        OSError: when the file cannot be written; nothing remains of it.
    """
    with replacing(path) as building:
        WRITERS[path.suffix[1:]](building, surface, velocity)


def require_writer(name: str) -> None:
    """Raise ImportError for a missing package of a format, and SurfaceError for an unknown format."""
    if name not in PACKAGES:
        raise SurfaceError(f"the format must be one of {', '.join(PACKAGES)}, got {name!r}")
    package, extra = PACKAGES[name]
    optional.load(package, f"{name.upper()} files", extra)


def _write_ply(path: Path, surface: Surface, velocity: Array) -> None:
    """Binary PLY with the properties nx, ny, nz and vx, vy, vz of the vertices."""
    columns = {f"n{axis}": surface.normals[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"v{axis}": np.asarray(velocity[:, k], np.float32) for k, axis in enumerate("xyz")}
    meshio = optional.load("meshio", "PLY files", "surface")
    mesh = meshio.Mesh(surface.vertices, [("triangle", surface.faces)], point_data=columns)
    meshio.write(path, mesh, file_format="ply", binary=True)


def _write_obj(path: Path, surface: Surface, velocity: Array) -> None:
    """OBJ with normals, and 8 digits."""
    del velocity
    if not len(surface.faces):  # trimesh cannot export it.
        path.write_text("# no surface\n", encoding="ascii")
        return
    trimesh = optional.load("trimesh", "OBJ files", "surface")
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_normals=surface.normals, process=False)
    text = trimesh.exchange.obj.export_obj(mesh, include_normals=True, header=None)
    path.write_text(text if isinstance(text, str) else text[0], encoding="ascii")


def _write_vtp(path: Path, surface: Surface, velocity: Array) -> None:
    """VTK XML PolyData with the arrays Normals and velocity of the points."""
    support, data, core, io = (
        optional.load(f"vtkmodules.{name}", "VTP files", "render")
        for name in ("util.numpy_support", "vtkCommonDataModel", "vtkCommonCore", "vtkIOXML")
    )
    points, cells, body = core.vtkPoints(), data.vtkCellArray(), data.vtkPolyData()
    points.SetData(support.numpy_to_vtk(surface.vertices, deep=True))
    offsets = np.arange(0, surface.faces.size + 1, 3, dtype=np.int64)
    corners = surface.faces.astype(np.int64).ravel()
    cells.SetData(*(support.numpy_to_vtkIdTypeArray(a, deep=True) for a in (offsets, corners)))
    body.SetPoints(points)
    body.SetPolys(cells)
    for name, values in (("Normals", surface.normals), ("velocity", velocity)):
        array = support.numpy_to_vtk(np.ascontiguousarray(values, np.float32), deep=True)
        array.SetName(name)
        body.GetPointData().AddArray(array)
    body.GetPointData().SetActiveNormals("Normals")
    writer = io.vtkXMLPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(body)
    if not writer.Write() or writer.GetErrorCode():
        raise OSError(f"{path}: VTK cannot write it (error {writer.GetErrorCode()})")


WRITERS: dict[str, Callable[[Path, Surface, Array], None]] = {"ply": _write_ply, "obj": _write_obj, "vtp": _write_vtp}
"""Writers by format."""
