"""Particle seeding: shapes filled with points whose volumes add up to the volume of the shape.

Every function takes ``grid`` (a :class:`torch_mpm.Grid` or a node distance dx [m]) and ``per_cell``, the mean number of
particles in a grid cell, and returns :class:`Points`. ``method="lattice"`` places points on a regular lattice of
spacing ``dx / per_cell**(1/D)``, stretched to fit the bounding box of the shape; ``method="poisson"`` draws a
Poisson-disk sample of the same mean density, without a preferred direction; ``method="jittered"`` moves each point of
the lattice at random within its cell, which is faster. All depend on their arguments alone.

``origin`` is for bodies far from the zero of their coordinates, such as map coordinates: shapes and files are read in
these coordinates in float64, and points are stored relative to the origin, so that float32 resolves them.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..data import host_memory
from ..errors import check_count, check_device, check_dtype, check_number, check_vector, default_dtype, shape_of
from . import point_files, shapes
from .shapes import Shape
from .surface_mesh import Array

Vector = Sequence[float] | Tensor
Progress = Callable[[int, int], None] | None

# Measured for _poisson_disk: a sample of least distance r has (_POISSON_SPACING * r)^-D points per unit of volume,
# within 0.2 %.
_POISSON_SPACING = {2: 1.245, 3: 1.147}
_POISSON_TRIALS = 12
HOST = torch.device("cpu")
"""Shapes and points are created on the CPU, for any default device of torch, and moved when complete."""


def on_host() -> Any:
    """Context in which tensors are created on the CPU; no context where this is the default, as it would slow down each
    call.
    """
    return contextlib.nullcontext() if torch.get_default_device() == HOST else HOST


MOST = 2**31 - 1
"""Maximum number of particles."""
CELL_BYTES = 150
"""Memory per point of a lattice, or per cell of a Poisson-disk sample, while a shape is filled [bytes]."""
FEW_BYTES = 2**26
"""Memory that is assumed to be available without a query [bytes]."""
CHUNK = 2**18
"""Number of points that a shape is evaluated at together."""


@dataclass(frozen=True)
class Points:
    """Positions ``x`` [P, D] [m], rest volumes ``volume`` [P] [m^3] ([m^2] in 2-D), ``scene`` int32 [P] or None.

    ``exact`` are x and volume in float64 where `x` and `volume` are roundings of these, otherwise None. ``fields`` are
    other numbers of the points [P] by name, such as the colours of a .ply file. A `State` has no such fields: its
    particles have the ids 0, 1, ... in the order of the points, so that ``fields["red"][state.ids]`` are theirs in any
    order.
    """

    x: Tensor
    volume: Tensor
    scene: Tensor | None = None
    exact: tuple[Tensor, Tensor] | None = None
    fields: Mapping[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.x.shape[0]

    def values_for(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Positions and volumes to be cast to a dtype: for float64 those of `exact`, unless `x` has changed since."""
        if self.exact is None or dtype == self.x.dtype:
            return self.x, self.volume
        x, volume = self.exact
        return _unrounded(self.x, x), _unrounded(self.volume, volume)


def _unrounded(rounded: Tensor, exact: Tensor) -> Tensor:
    """Exact values of the entries that still equal their rounding, float64."""
    if exact.shape != rounded.shape:
        return rounded.double()
    exact = exact.to(rounded.device)
    return torch.where(exact.to(rounded.dtype) == rounded, exact, rounded.double())


def _points(
    x: Tensor, volume: Tensor, origin: Vector | None, dtype: torch.dtype | None, device: torch.device | str | None
) -> Points:
    """Points relative to an origin from those in float64 on the CPU, in a dtype and on a device."""
    dtype, device = dtype or default_dtype(), torch.get_default_device() if device is None else device
    if origin is not None:
        x = x - _vector("origin", origin, x.shape[1])
    rounded = x.to(device=device, dtype=dtype), volume.to(device=device, dtype=dtype)
    return Points(*rounded, exact=None if dtype == x.dtype else (x, volume))


class Region:
    """Shape at a position, to be filled.

    Args:
        shape: see `torch_mpm.shapes`; its volume and bounds must be known.
        position: position of its origin [m], D numbers.

    Attributes:
        lower, upper: corners [D] [m] of its bounding box, float64.
        volume: exact [m³] ([m²] in 2-D).
    """

    def __init__(self, shape: Shape, position: Vector) -> None:
        self.shape, self.position = shape, _vector("position", position)
        lower, upper = shape.bounds(len(self.position))
        self.lower, self.upper = self.position + lower, self.position + upper
        self.volume = shape.volume(len(self.position))

    def inside(self, x: Tensor) -> Tensor:
        """Whether points [P, D] are inside or on the surface, bool [P]."""
        return torch.cat([self.shape.contains(part - self.position) for part in x.split(CHUNK)])


class Box(Region):
    """Axis-aligned box (rectangle in 2-D) from ``lower`` to ``upper`` [m]."""

    def __init__(self, lower: Vector, upper: Vector):
        a = check_vector("lower", lower)
        b = check_vector("upper", upper, len(a))
        if not all(p < q for p, q in zip(a, b, strict=True)):
            raise ValueError(f"lower must be below upper on every axis, got {list(a)} and {list(b)}")
        self._size = [q - p for p, q in zip(a, b, strict=True)]
        middle = [0.5 * (p + q) for p, q in zip(a, b, strict=True)]
        corners = torch.tensor([a, b, middle], dtype=torch.float64, device="cpu")
        self.lower, self.upper, self.position = corners.unbind()  # As given, not rounded.
        self.volume = math.prod(self._size)

    @functools.cached_property
    def shape(self) -> Shape:  # type: ignore[override]
        """Created on first use: most boxes that are drawn for a scene are rejected before."""
        return shapes.Box(self._size)


class Sphere(Region):
    """Ball (disc in 2-D) around ``center`` with ``radius`` [m]."""

    def __init__(self, center: Vector, radius: float):
        middle = _vector("center", center)
        super().__init__(shapes.Sphere(_positive("radius", radius)), middle)


class Cylinder(Region):
    """Solid cylinder with flat ends between ``a`` and ``b`` [m]; 3-D only."""

    def __init__(self, a: Vector, b: Vector, radius: float):
        middle, half = _segment(a, b, radius)
        super().__init__(shapes.Cylinder(half.tolist(), radius), middle)


class Capsule(Region):
    """All points within ``radius`` of the segment from ``a`` to ``b`` [m]."""

    def __init__(self, a: Vector, b: Vector, radius: float):
        middle, half = _segment(a, b, radius)
        super().__init__(shapes.Capsule(half.tolist(), radius), middle)


class Mesh(Region):
    """The inside of a closed triangle mesh: a file that trimesh reads (.obj, .ply, .stl, ...) or a ``trimesh.Trimesh``.

    The mesh is scaled about its origin, then moved by ``offset`` [m]; see `torch_mpm.shapes.Mesh` for the definition of
    inside, repairs, and refused meshes.
    """

    def __init__(self, source: str | Path | Any, scale: float = 1.0, offset: Vector = (0.0, 0.0, 0.0)):
        super().__init__(shapes.Mesh(source, scale), _vector("offset", offset, 3))


def _vector(name: str, value: Vector, dim: int | None = None) -> Tensor:
    return torch.tensor(check_vector(name, value, dim), dtype=torch.float64, device="cpu")


def _positive(name: str, value: float) -> float:
    return float(check_number(name, value, "positive", lambda v: 0 < v < math.inf))


def _segment(a: Vector, b: Vector, radius: float) -> tuple[Tensor, Tensor]:
    """Middle of a segment, and half of its vector."""
    first = _vector("a", a)
    _positive("radius", radius)
    last = _vector("b", b, len(first))
    _positive("the distance from a to b", float((last - first).norm()))
    return 0.5 * (first + last), 0.5 * (last - first)


def fill(
    shape: Region,
    grid: Any,
    per_cell: float = 8,
    *,
    method: str = "lattice",
    seed: int = 0,
    count: int | None = None,
    progress: Progress = None,
    origin: Vector | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Points:
    """Points inside ``shape``, all of the volume ``shape.volume / P``.

    Args:
        shape: region to fill; any object with ``lower`` [D], ``upper`` [D], ``volume`` and ``inside(x)`` as `Region`.
        grid: a grid or its node spacing dx [m].
        per_cell: mean number of particles in a cell of volume dx^D.
        method: "lattice", "jittered" or "poisson".
        seed: seed of the random numbers.
        count: exact number of points, instead of per_cell: the spacing is the widest tried one with enough points, and
            a random choice of the excess is dropped.
        progress: called after every 2^18 points with the number of points compared with the shape so far, and the
            total.
        origin: coordinates [m], D numbers, that the points are relative to; None for the zero of those of the shape.
        dtype, device: of the result; by default torch's (float32 where that is a half). A state in float64 has the
            points without the rounding of float32, see `Points`.

    Raises:
        ValueError: for an unknown method, a shape too small to hold a point, or more points than fit in memory.
        TypeError: for a shape without a property of a `Region`, or a count that is not an integer.
    """
    if missing := [name for name in ("lower", "upper", "volume", "inside") if not hasattr(shape, name)]:
        raise TypeError(f"shape must be a shape of torch_mpm.seed, got {shape_of(shape)} without {missing[0]}")
    dim = getattr(grid, "dim", len(shape.lower))
    if len(shape.lower) != dim:
        raise ValueError(f"shape must have the dimension of the grid, {dim}, got one of {len(shape.lower)} dimensions")
    check_dtype(dtype)
    check_device(device)
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or not -(2**63) <= seed < 2**64:
        raise ValueError(f"seed must be a whole number of at most 64 bits, got {seed!r}")
    with on_host():
        if count is None:
            x = _points_in(shape, _spacing(grid, per_cell, len(shape.lower)), method, seed, progress)
        else:
            x = _exactly(check_count("count", count, 1), shape, method, seed, progress)
        volume = torch.full((len(x),), shape.volume / len(x), dtype=torch.float64)
    return _points(x, volume, origin, dtype, device)


def _spacing(grid: Any, per_cell: float, dim: int) -> float:
    """Distance of points [m]."""
    dx = _positive("the grid's dx", getattr(grid, "dx", grid))
    return float(dx / _positive("per_cell", per_cell) ** (1 / dim))


CLOSER, ATTEMPTS = 0.98, 100
"""Factor on the spacing until there are enough points, and the maximum number of attempts."""


def _exactly(count: int, shape: Region, method: str, seed: int, progress: Progress) -> Tensor:
    """Exactly `count` points [count, D], float64, on the CPU."""
    spacing = (shape.volume / count) ** (1 / len(shape.lower))
    x = torch.empty(0)
    for _ in range(ATTEMPTS):
        if method == "poisson" or math.prod(_cells(shape.lower, shape.upper, spacing)) >= count:
            with contextlib.suppress(_TooSmall):
                x = _points_in(shape, spacing, method, seed, progress)
        if len(x) >= count:
            break
        spacing *= CLOSER
    else:
        raise ValueError(f"the shape has space for fewer than {count} points at any distance; is its volume correct?")
    kept = torch.zeros(len(x), dtype=torch.bool)
    kept[torch.randperm(len(x), generator=torch.Generator().manual_seed(seed))[:count]] = True
    return x[kept]


class _TooSmall(ValueError):
    """Shape with more space between its points than it has."""


def _points_in(shape: Region, spacing: float, method: str, seed: int, progress: Progress) -> Tensor:
    """[P, D], float64, on the CPU."""
    _check_size(shape, spacing, method)
    if method == "lattice":
        x = _lattice(shape.lower, shape.upper, spacing)
    elif method == "jittered":
        x = _lattice(shape.lower, shape.upper, spacing, torch.Generator().manual_seed(seed))
    elif method == "poisson":
        x = _poisson_disk(shape.lower, shape.upper, spacing, seed)
    else:
        raise ValueError(f'method must be "lattice", "jittered" or "poisson", got {method!r}')
    kept: list[Tensor] = []
    for number, part in enumerate(x.split(CHUNK)):
        kept.append(part[shape.inside(part)])
        if progress is not None:
            progress(number * CHUNK + len(part), len(x))
    x = torch.cat(kept)
    if len(x) == 0:
        raise _TooSmall(
            f"the shape is too small for its particles: spacing {spacing:g} m; use a finer grid or a larger per_cell"
        )
    return x


def _check_size(shape: Region, spacing: float, method: str) -> None:
    """Raise ValueError before the points of a shape's bounding box exhaust the memory."""
    sides = ((shape.upper - shape.lower).double() / spacing).clamp(min=1).tolist()
    points = math.prod(sides)
    cells = points
    if method == "poisson":
        cells *= (_POISSON_SPACING[len(sides)] * math.sqrt(len(sides))) ** len(sides)
    if points > MOST:
        room = f"{MOST} can be numbered"
    elif cells * CELL_BYTES > FEW_BYTES and cells * CELL_BYTES > (free := host_memory.available()):
        room = f"filling it takes {host_memory.in_words(cells * CELL_BYTES)}, and {host_memory.in_words(free)} are free"
    else:
        return
    raise ValueError(
        f"the box around the shape holds about {points:.3g} points at a spacing of {spacing:.3g} m, but {room}; "
        "make the shape smaller, dx larger or per_cell smaller"
    )


def _lattice(lower: Tensor, upper: Tensor, spacing: float, jitter: torch.Generator | None = None) -> Tensor:
    """Centres of equal cells that tile the box, as close to ``spacing`` as an integer number per axis allows.

    With a generator, random points of the cells instead.
    """
    counts = _cells(lower, upper, spacing)
    sides = zip(lower.tolist(), upper.tolist(), counts, strict=True)
    axes = [lo + (torch.arange(int(n), dtype=torch.float64) + 0.5) * (hi - lo) / n for lo, hi, n in sides]
    x = torch.cartesian_prod(*axes)
    if jitter is not None:
        places = torch.rand(x.shape, generator=jitter, dtype=torch.float64) - 0.5
        x = x + places * (upper - lower) / torch.tensor(counts, dtype=torch.float64)
    return x


def _cells(lower: Tensor, upper: Tensor, spacing: float) -> list[float]:
    """Numbers of cells along the axes of a lattice in a box."""
    counts: list[float] = ((upper - lower) / spacing).round().clamp(min=1).tolist()
    return counts


def _poisson_disk(lower: Tensor, upper: Tensor, spacing: float, seed: int) -> Tensor:
    """Poisson-disk sample of a box by phased dart throwing on a grid with at most one point per cell (Wei 2008).

    Cells three apart cannot conflict, so all cells of one of the 3^D phases try a dart at once.
    """
    dim = len(lower)
    radius = spacing / _POISSON_SPACING[dim]
    cell = radius / math.sqrt(dim)
    shape = [int(n) + 4 for n in ((upper - lower) / cell).ceil()]  # two empty cells outside each side
    taken = torch.full((math.prod(shape), dim), math.inf, dtype=torch.float64)
    strides = torch.tensor([math.prod(shape[k + 1 :]) for k in range(dim)])
    offsets = torch.cartesian_prod(*[torch.arange(-2, 3)] * dim)
    offsets = offsets[offsets.square().sum(1).argsort(stable=True)]  # The nearest reject most darts.
    neighbours = (offsets @ strides).split(3**dim)
    index = torch.cartesian_prod(*[torch.arange(2, n - 2) for n in shape])
    phases = [index[(index % 3 == torch.tensor(phase)).all(1)] for phase in itertools.product(range(3), repeat=dim)]
    generator = torch.Generator().manual_seed(seed)
    for _ in range(_POISSON_TRIALS):
        for k, phase in enumerate(phases):
            phase = phases[k] = phase[torch.isinf(taken[phase @ strides, 0])]
            dart = lower + (phase - 2 + torch.rand(phase.shape, generator=generator, dtype=torch.float64)) * cell
            flat = phase @ strides
            free = (dart <= upper).all(1)
            for near in neighbours:
                flat, dart = flat[free], dart[free]
                free = (taken[flat[:, None] + near] - dart[:, None]).square().sum(2).amin(1) >= radius**2
            taken[flat[free]] = dart[free]
    return taken[torch.isfinite(taken[:, 0])]


def box(lower: Vector, upper: Vector, grid: Any, per_cell: float = 8, **options: Any) -> Points:
    """Points in the box from ``lower`` to ``upper`` [m]; ``options`` as in :func:`fill`."""
    return fill(Box(lower, upper), grid, per_cell, **options)


def sphere(center: Vector, radius: float, grid: Any, per_cell: float = 8, **options: Any) -> Points:
    """Points in a ball (a disc in 2-D); ``options`` as in :func:`fill`."""
    return fill(Sphere(center, radius), grid, per_cell, **options)


def cylinder(a: Vector, b: Vector, radius: float, grid: Any, per_cell: float = 8, **options: Any) -> Points:
    """Points in a cylinder between ``a`` and ``b`` [m] (3-D); ``options`` as in :func:`fill`."""
    return fill(Cylinder(a, b, radius), grid, per_cell, **options)


def capsule(a: Vector, b: Vector, radius: float, grid: Any, per_cell: float = 8, **options: Any) -> Points:
    """Points within ``radius`` of the segment from ``a`` to ``b`` [m]; ``options`` as in :func:`fill`."""
    return fill(Capsule(a, b, radius), grid, per_cell, **options)


def mesh(
    source: str | Path | Any,
    grid: Any,
    per_cell: float = 8,
    *,
    scale: float = 1.0,
    offset: Vector = (0.0, 0.0, 0.0),
    **options: Any,
) -> Points:
    """Points inside a closed triangle mesh (see :class:`Mesh`); ``options`` as in :func:`fill`."""
    return fill(Mesh(source, scale, offset), grid, per_cell, **options)


def file(
    path: str | Path,
    volume: float | None = None,
    *,
    dim: int | None = None,
    origin: Vector | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Points:
    """Points from a file: .npy, .npz, .csv, .tsv, .txt or .ply.

    `torch_mpm.geometry.point_files.read` describes the formats. Other properties of a .ply, such as colours and those
    of Gaussian splats, are in ``fields`` of the result: floating-point numbers in the type of the file, others as
    int64.

    ``volume`` is the total volume [m^3], shared evenly; needed where the file has no volumes. ``dim`` is the number of
    coordinates, by default those in the file. ``origin``, ``dtype`` and ``device`` as in :func:`fill`.

    Raises:
        OSError: when there is no such file, or it cannot be read.
        ValueError: for an unknown format, a wrong shape, numbers not finite, or volumes missing or not positive.
    """
    check_dtype(dtype)
    check_device(device)
    if dim not in (None, 2, 3):
        raise ValueError(f"dim must be 2, 3 or None, got {dim}")
    read = point_files.read(path, dim)
    x, volumes = torch.from_numpy(read.x), None if read.volume is None else torch.from_numpy(read.volume)
    if x.dim() != 2 or x.shape[1] not in ((2, 3) if dim is None else (dim,)) or len(x) == 0:
        expected = "[P, 2] or [P, 3]" if dim is None else f"[P, {dim}]"
        raise ValueError(f"points in {path} must have shape {expected} with P > 0, got {list(x.shape)}")
    if volume is not None:
        volumes = torch.full_like(x[:, 0], _positive("volume", volume) / len(x))
    if volumes is None:
        raise ValueError(f"{path} has no particle volumes; give the total volume of the points")
    if volumes.shape != x.shape[:1] or not bool((volumes > 0).all()):
        raise ValueError(f"volumes in {path} must be positive with shape [{len(x)}], got {list(volumes.shape)}")
    if not bool(torch.isfinite(x).all() and torch.isfinite(volumes).all()):
        raise ValueError(f"points in {path} must be finite")
    points = _points(x, volumes, origin, dtype, device)
    return replace(points, fields={name: _field(values).to(points.x.device) for name, values in read.fields.items()})


def _field(values: Array) -> Tensor:
    """Property of a file as a tensor."""
    return torch.from_numpy(values if values.dtype.kind == "f" else values.astype(np.int64))
