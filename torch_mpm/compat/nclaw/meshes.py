"""Particles in the meshes of NCLaw's environments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ...errors import check_count
from ...files import check_file
from ...geometry import shapes
from ...geometry.point_files import arrays_of
from ...geometry.surface_mesh import Array

MOST_POINTS = 1000
"""Largest number of points on an edge of the lattice around a mesh."""
MODES = ("uniform", "sampling", "texture")


def points_in_mesh(folder: Path, name: str, resolution: int, mode: str) -> tuple[Array, float]:
    """Points [P, 3] in a mesh whose longest edge is 1, about the origin, and the volume of each.

    They are those of NCLaw's file NAME_RESOLUTION_MODE.npz where there is one; otherwise, for mode "uniform", the
    points of a lattice with `resolution` points on each edge of the bounding box of NAME.obj that are in the mesh, with
    the share of the volume of the bounding box as volume, as in NCLaw. Points on the surface are inside or outside by
    rounding.

    Args:
        folder: the folder of meshes, "nclaw/assets".
        name: name of the mesh.
        resolution: points along an edge.
        mode: "uniform", "sampling" or "texture".

    Raises:
        ImportError: without trimesh.
        OSError: for a file that is missing or cannot be read.
        ValueError: for an unknown mode, points of NCLaw's sampling program that are not there, a file with other
            contents, or a mesh that is not closed or has no point.
    """
    if check_count("resolution", resolution, 2) > MOST_POINTS:
        raise ValueError(f"resolution must be at most {MOST_POINTS}, got {resolution}")
    if mode not in MODES:
        raise ValueError(f"mode of a mesh must be one of {', '.join(MODES)}, got {mode!r}")
    stored = folder / f"{name}_{resolution}_{mode}.npz"
    if stored.is_file():
        return _stored(stored)
    if mode != "uniform":
        raise ValueError(
            f"mode must be 'uniform', got {mode!r} without the file {stored}: the sampling program of NCLaw writes it "
            "when its MPMInitData.get is called there"
        )
    return _on_lattice(folder / f"{name}.obj", resolution)


def _stored(path: Path) -> tuple[Array, float]:
    """Points and volume of a file of NCLaw."""
    check_file(path, "points")
    try:
        arrays = arrays_of(path, "p_x", "vol")
    except Exception as error:  # Damaged archives raise many kinds of errors.
        raise ValueError(f"points file {path} cannot be read: {error}") from error
    if set(arrays) != {"p_x", "vol"} or arrays["vol"].size != 1 or arrays["p_x"].size % 3 or arrays["p_x"].size == 0:
        found = {name: list(values.shape) for name, values in arrays.items()}
        raise ValueError(f"points file {path} must hold p_x [P, 3] and vol [], got {found}")
    if not (np.isfinite(arrays["p_x"]).all() and 0 < arrays["vol"].item() < np.inf):
        raise ValueError(f"points file {path} must have finite positions and a positive volume")
    return arrays["p_x"].reshape(-1, 3), float(arrays["vol"].item())


def _on_lattice(path: Path, resolution: int) -> tuple[Array, float]:
    """Points of a lattice in a mesh, and the volume of each."""
    mesh = shapes.Mesh(path)
    lower, upper = (corner.numpy() for corner in mesh.bounds(3))
    edges = upper - lower
    axes = [np.linspace(low, high, resolution) for low, high in zip(lower, upper, strict=True)]
    slices = (np.stack(np.meshgrid([at], *axes[1:], indexing="ij"), -1).reshape(-1, 3) for at in axes[0])
    inside = np.concatenate([points[mesh.contains(torch.from_numpy(points)).numpy()] for points in slices])
    if len(inside) == 0:
        raise ValueError(f"mesh {path} holds no point at resolution {resolution}")
    share = mesh.volume(3) / float(np.prod(edges))
    return (inside - (lower + upper) / 2) / edges.max(), share / len(inside)
