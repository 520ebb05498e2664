"""Triangle mesh around particles, by pysplashsurf.

The surface is the level set of the smoothed indicator function of the particles, sum_p V_p W(x - x_p), with the volume
V_p of a particle from its SPH density and the cubic spline W. Marching cubes extract it, and weighted Laplacian
smoothing (Loeschner et al. 2023), which keeps drops, removes the bumps of single particles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .. import optional
from ..errors import check_count, check_number

Array = npt.NDArray[Any]

SMOOTHING_LENGTHS = (0.5, 4.0)
"""Range of the smoothing length [particle spacings]: one particle to some thousand neighbours in a kernel."""
CUBE_SIZES = (1 / 16, 2.0)
"""Range of the cube size [smoothing lengths]: beyond it the lattice is larger than the kernel, or needlessly fine."""
DEFAULT_SMOOTHING, LEAST_SMOOTHING, MOST_SMOOTHING = 0.75, 1.5, 3.0
"""Default of the smoothing length [node distances], and its least and most [particle spacings]."""
DEFAULT_CUBE = 0.5
"""Default of the cube size [smoothing lengths]."""
ISO_THRESHOLDS = (0.05, 0.95)
"""Range of the threshold: beyond it the surface is that of the kernels, or of rounding errors."""
MOST_STEPS = 100
"""Maximum number of steps of the smoothing of a mesh."""


MOST_CUBES = 2**30
"""Maximum number of cubes along an axis, which pysplashsurf counts in 32 bits."""


class SurfaceError(ValueError):
    """Particles or options without a surface."""


class Surface(NamedTuple):
    """Closed triangle mesh: vertices [V, 3] [m], faces int32 [T, 3] that turn counterclockwise seen from outside, and
    outward unit normals float32 [V, 3].
    """

    vertices: Array
    faces: Array
    normals: Array


@dataclass(frozen=True)
class SurfaceOptions:
    """Parameters of a reconstruction.

    Args:
        smoothing_length: of the SPH kernel [m], half its radius; by default 0.75 node distances, and at least 1.5 and
            at most 3 particle spacings.
        cube_size: edge of the cubes of marching cubes [m]; half of the smoothing length by default.
        iso_threshold: value of the indicator function on the surface, within 0.05 and 0.95; smaller values give
            larger bodies. With the defaults a ball of 10 particle spacings has its volume to 2%.
        smoothing: number of steps of the smoothing of the mesh, which shrinks drops; the normals are smoothed as often.

    Raises:
        ValueError, TypeError: for a value out of its range, and for anything but a number.
    """

    smoothing_length: float | None = None
    cube_size: float | None = None
    iso_threshold: float = 0.6
    smoothing: int = 3

    def __post_init__(self) -> None:
        for name in ("smoothing_length", "cube_size"):
            if (value := getattr(self, name)) is not None:
                check_number(name, value, "positive and finite", lambda number: 0 < number < np.inf)
        low, high = ISO_THRESHOLDS
        check_number("iso_threshold", self.iso_threshold, f"within {low} and {high}", lambda n: low <= n <= high)
        if check_count("smoothing", self.smoothing) > MOST_STEPS:
            raise ValueError(f"smoothing must be at most {MOST_STEPS}, got {self.smoothing}")

    def lengths(self, spacing: float, dx: float) -> Lengths:
        """Lengths for particles of a spacing [m] on a lattice of node distance ``dx`` [m].

        Raises:
            SurfaceError: where an option does not suit the spacing.
        """
        default = min(max(DEFAULT_SMOOTHING * dx, LEAST_SMOOTHING * spacing), MOST_SMOOTHING * spacing)
        smoothing = default if self.smoothing_length is None else self.smoothing_length
        cube = DEFAULT_CUBE * smoothing if self.cube_size is None else self.cube_size
        _require_within("smoothing_length", smoothing, SMOOTHING_LENGTHS, spacing, "particle spacing")
        _require_within("cube_size", cube, CUBE_SIZES, smoothing, "smoothing length")
        return Lengths(spacing, smoothing, cube)


class Lengths(NamedTuple):
    """Particle spacing, smoothing length and cube size [m]."""

    spacing: float
    smoothing: float
    cube: float


def checked_options(options: SurfaceOptions | None) -> SurfaceOptions:
    """The given options, or the defaults; TypeError for anything else."""
    if options is not None and not isinstance(options, SurfaceOptions):
        raise TypeError(f"options must be SurfaceOptions or None, got {type(options).__name__}")
    return options or SurfaceOptions()


def _require_within(name: str, value: float, ends: tuple[float, float], unit: float, of: str) -> None:
    low, high = (end * unit for end in ends)
    if not low <= value <= high:
        raise SurfaceError(
            f"{name} must be within {low:.4g} m and {high:.4g} m for a {of} of {unit:.4g} m, got {value:.4g} m"
        )


def require_packages() -> None:
    """Raise ImportError for a missing package of the extra ``surface``."""
    splashsurf_module()
    optional.load("scipy.spatial", "surfaces", "surface")


def splashsurf_module() -> Any:
    return optional.load("pysplashsurf", "surfaces", "surface")


def spacing_of(volume: Array) -> float:
    """Distance between particles [m] from their rest volumes [P] [m^3]: the cube root of the mean."""
    return float(volume.mean(dtype=np.float64) ** (1 / 3))


def reconstruct(x: Array, spacing: float, dx: float, options: SurfaceOptions | None = None) -> Surface:
    """Surface of particles.

    Args:
        x: positions [P, 3] [m], finite; float32 or float64, which is the dtype of the vertices.
        spacing: distance between particles at rest [m], such as `spacing_of` their volumes.
        dx: node distance [m].
        options: parameters.

    Returns:
        The mesh, empty without particles. Computed in float32, relative to the lower corner of the particles.

    Raises:
        SurfaceError: for positions of another shape, that are not finite or too far apart, or options that do not suit
            the spacing.
        TypeError, ValueError: for another type or dtype, or lengths that are not positive.
        ImportError: when pysplashsurf is missing (extra ``surface``).
    """
    if not isinstance(x, np.ndarray) or x.dtype not in (np.float32, np.float64):
        raise TypeError(f"x must be an array of float32 or float64, got {getattr(x, 'dtype', type(x).__name__)}")
    for name, value in (("spacing", spacing), ("dx", dx)):
        check_number(name, value, "positive and finite", lambda number: 0 < number < np.inf)
    options = checked_options(options)
    lengths = options.lengths(spacing, dx)
    if x.ndim != 2 or x.shape[1] != 3:
        raise SurfaceError(f"x must have shape [P, 3], got {list(x.shape)}; a surface needs three dimensions")
    if not np.isfinite(x).all():
        raise SurfaceError(f"x must be finite, got {int((~np.isfinite(x)).any(1).sum())} particles that are not")
    if not len(x):
        return Surface(np.zeros((0, 3), x.dtype), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    lower = x.min(0)
    if (cubes := float((x.max(0) - lower).max() / lengths.cube)) > MOST_CUBES:
        raise SurfaceError(f"the particles are spread over {cubes:.3g} cubes of {lengths.cube:.4g} m along an axis")
    mesh = _pipeline(np.ascontiguousarray(x - lower, np.float32), lengths, options)
    return Surface(
        lower + np.asarray(mesh.mesh.vertices).astype(x.dtype),
        np.asarray(mesh.mesh.triangles).astype(np.int32),
        np.array(mesh.point_attributes["normals"]),
    )


def _pipeline(x: Array, lengths: Lengths, options: SurfaceOptions) -> Any:
    """Mesh of pysplashsurf, whose lengths are in particle radii."""
    radius = 0.5 * lengths.spacing
    try:
        mesh, _ = splashsurf_module().reconstruction_pipeline(
            x,
            particle_radius=radius,
            smoothing_length=lengths.smoothing / radius,
            cube_size=lengths.cube / radius,
            iso_surface_threshold=options.iso_threshold,
            mesh_cleanup=True,
            mesh_smoothing_iters=options.smoothing,
            compute_normals=True,
            normals_smoothing_iters=options.smoothing,
        )
    except RuntimeError as error:
        reason = " ".join(str(error).partition("Stack backtrace")[0].split())
        raise SurfaceError(f"pysplashsurf finds no surface of {len(x)} particles: {reason}") from error
    return mesh
