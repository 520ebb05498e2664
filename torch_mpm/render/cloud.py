"""External appearance of a cloud of particles: spacing, visible particles, surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .requires import require
from .shapes import Array


def rest_spacing(x: Array) -> float:
    """Distance between neighbours [m] of particles [P, D], from the volume of the cells of a grid they occupy.

    With cells of about one particle spacing the count of occupied cells depends on the layout; with cells of two
    spacings, 2^D particles each, it does not, so the cell size is refined until an occupied cell holds 2^D on average.
    """
    if len(x) < 2:
        return 0.0
    dim = x.shape[1]
    extent = np.ptp(x, axis=0)
    size = float(np.max(extent))
    if size == 0.0:
        return 0.0
    for _ in range(40):
        cells = np.floor((x - x.min(axis=0)) / size).astype(np.int64)
        per_cell = len(x) / len(np.unique(cells @ (1 << 20) ** np.arange(dim)))
        if per_cell <= 2**dim:
            break
        size *= max((2**dim / per_cell) ** (1 / dim), 0.5) * 0.98
    return float(size / per_cell ** (1 / dim))


def visible(x: Array, spacing: float) -> Array:
    """Mask [P] of the particles [P, 3] that are not enclosed by two layers of occupied cells.

    Cells are 1.5 spacings wide: each holds a particle in any undisturbed body. Enclosed particles are invisible, and
    rendering without them takes a fraction of the time.
    """
    cell = 1.5 * spacing
    lower = x.min(axis=0)
    shape = np.floor(np.ptp(x, axis=0) / cell).astype(np.int64) + 5
    if np.prod(shape.astype(np.float64)) > 5e7:  # A few stray particles far away do not justify a huge table.
        return np.ones(len(x), dtype=bool)
    index = np.ravel_multi_index(tuple((np.floor((x - lower) / cell).astype(np.int64) + 2).T), tuple(shape))
    inside = np.zeros(shape, dtype=bool)
    inside.ravel()[index] = True
    for _ in range(2):
        for axis in range(3):
            inside = inside & np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
    return ~inside.ravel()[index]


def box_blur(field: Array, width: int, axes: tuple[int, ...], passes: int = 3) -> Array:
    """Repeated running mean over an odd `width` along `axes`; three passes are close to a Gaussian. Zero outside."""
    half = width // 2
    for axis in axes:
        moved = np.moveaxis(field, axis, 0)
        for _ in range(passes):
            padded = np.pad(moved, [(half + 1, half)] + [(0, 0)] * (moved.ndim - 1))
            total = np.cumsum(padded, axis=0, dtype=np.float64)
            moved = ((total[width:] - total[:-width]) / width).astype(field.dtype)
        field = np.moveaxis(moved, 0, axis)
    return field


@dataclass(frozen=True)
class Skin:
    """Surface of a cloud: vertices [V, 3] m, triangles int [T, 3], outward normals [V, 3], colours uint8 [V, 3]."""

    vertices: Array
    faces: Array
    normals: Array
    colors: Array


def surface(x: Array, rgb: Array, spacing: float) -> tuple[Skin, Array]:
    """Smooth surface of particles x [P, 3] m with colours uint8 [P, 3], and the mask [P] of particles outside of it.

    Those are drops too small for a surface.

    Particle number density on a grid of one spacing, smoothed, cut at half its value in an undisturbed body
    (marching cubes; colours are the density-weighted mean of the particles').
    """
    pad = 4
    lower = x.min(axis=0) - pad * spacing
    shape = np.ceil(np.ptp(x, axis=0) / spacing).astype(np.int64) + 2 * pad + 1
    if np.prod(shape.astype(np.float64)) > 6e7:
        raise ValueError(
            f"the surface of these particles needs a grid of {'x'.join(map(str, shape))} cells; use style='particles'"
        )
    weights = np.concatenate([np.ones((len(x), 1), np.float32), rgb.astype(np.float32)], axis=1)
    field = _linear_splat((x - lower) / spacing, weights, shape)
    field = box_blur(field, 3, (0, 1, 2), passes=2)
    color = field[..., 1:] / np.maximum(field[..., :1], 1e-3)
    vertices, faces, normals, colors = contour(field[..., 0], 0.5, spacing, lower, color)
    nearest = tuple(np.round((x - lower) / spacing).astype(np.int64).T)
    return Skin(vertices, faces, normals, colors.clip(0, 255).astype(np.uint8)), field[nearest][:, 0] < 0.25


def contour(
    field: Array, level: float, spacing: float, lower: Array, attribute: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """Level set `level` of `field` [X, Y, Z]: vertices [V, 3], triangles int [T, 3], normals [V, 3], attributes [V, C].

    Normals point from larger to smaller values. Nodes are `spacing` apart from `lower` on; `attribute` [X, Y, Z, C]
    is interpolated to the vertices (C = 0 without). Flying edges (Schroeder et al. 2015).
    """
    support = require("vtkmodules.util.numpy_support")
    image = require("vtkmodules.vtkCommonDataModel").vtkImageData()
    image.SetDimensions(*field.shape[::-1])
    image.SetSpacing(spacing, spacing, spacing)
    image.GetPointData().SetScalars(support.numpy_to_vtk(np.ascontiguousarray(field).ravel(), deep=1))
    channels = 0 if attribute is None else attribute.shape[-1]
    if attribute is not None:
        extra = support.numpy_to_vtk(np.ascontiguousarray(attribute).reshape(-1, channels), deep=1)
        extra.SetName("attribute")
        image.GetPointData().AddArray(extra)
    flying = require("vtkmodules.vtkFiltersCore").vtkFlyingEdges3D()
    flying.SetInputData(image)
    flying.InterpolateAttributesOn()
    flying.ComputeNormalsOn()
    flying.SetValue(0, level)
    flying.Update()
    out = flying.GetOutput()
    if out.GetNumberOfPoints() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros((0, channels))
    points = out.GetPointData()
    # The image's first axis is the array's last: reversing the axes reverses the triangles too.
    return (
        support.vtk_to_numpy(out.GetPoints().GetData())[:, ::-1] + lower,
        support.vtk_to_numpy(out.GetPolys().GetConnectivityArray()).reshape(-1, 3)[:, ::-1],
        support.vtk_to_numpy(points.GetNormals())[:, ::-1],
        support.vtk_to_numpy(points.GetArray("attribute")) if channels else np.zeros((out.GetNumberOfPoints(), 0)),
    )


def _linear_splat(position: Array, weights: Array, shape: Array) -> Array:
    """Sum of weights [P, C] spread linearly to the eight nodes around each position [P, 3] (in cells): [X, Y, Z, C]."""
    base = np.floor(position).astype(np.int64)
    fraction = (position - base).astype(np.float32)
    size = int(np.prod(shape))
    out = np.zeros((weights.shape[1], size), dtype=np.float32)
    for corner in range(8):
        offset = np.array([corner & 1, corner >> 1 & 1, corner >> 2])
        w = np.prod(np.where(offset, fraction, 1 - fraction), axis=1)
        index = np.ravel_multi_index(tuple((base + offset).T), tuple(shape))
        for c in range(weights.shape[1]):
            out[c] += np.bincount(index, weights=w * weights[:, c], minlength=size).astype(np.float32)
    return np.moveaxis(out.reshape(-1, *shape), 0, -1)
