"""Surfaces of the fluids and bodies of a run, and their files."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..data.export import CollectedFile, write_collection
from ..data.trajectory import Array, Trajectory
from ..data.whole_files import output_folder, output_path
from ..errors import check_count
from ..surfaces.files import PACKAGES, require_writer, write_surface
from ..surfaces.interpolation import Interpolation
from ..surfaces.reconstruction import (
    Lengths,
    Surface,
    SurfaceError,
    SurfaceOptions,
    checked_options,
    reconstruct,
    require_packages,
)
from .folder import load_run
from .groups import Group, groups_of
from .scene import Scene

log = logging.getLogger(__name__)

FOLDER = "surface"
COLLECTION = "run.pvd"


@dataclass(frozen=True)
class GroupSurface:
    """Surface of a group in a frame: ``rows`` bool [P] of its particles, and the interpolation to its vertices, None
    without particles.
    """

    group: Group
    surface: Surface
    rows: Array
    interpolation: Interpolation | None

    def mean(self, values: Array) -> Array:
        """Weighted mean at the vertices of values of a frame [P, ...], as `Interpolation.mean`."""
        return self._at_vertices(values, Interpolation.mean)

    def nearest(self, values: Array) -> Array:
        """Values of a frame [P, ...] of the particle that is nearest to each vertex."""
        return self._at_vertices(values, Interpolation.nearest)

    def velocity(self, frame: dict[str, Array]) -> Array:
        """Velocity of the vertices [V, 3] [m/s]: exact for rigid motion and other linear fields."""
        return self._at_vertices(frame["velocity"], Interpolation.linear)

    def _at_vertices(self, values: Array, method: Callable[[Interpolation, Array], Array]) -> Array:
        if self.interpolation is None:
            return values[:0]
        return method(self.interpolation, values[self.rows])


class RunSurfaces:
    """Surfaces of the frames of a run: one for each material of each scene of the batch.

    Bodies of one material share a surface, whose parts are separate where they do not touch: they interact through the
    grid as one body. Sand has no surface, unless ``materials`` names it.

    Args:
        scene: the scene of the run.
        trajectory: its trajectory, open.
        options: parameters of the reconstruction.
        materials: names of the materials; by default all but sand.
        origin: point [3] [m] to which the surfaces and the coordinates of ``scene`` are relative; those of the
            trajectory are absolute.

    Raises:
        SurfaceError: for a 2-D run, unknown materials, a run of sand alone, or options that do not suit the particles.
        DamagedFileError: for a trajectory with materials or scenes that the scene of the run lacks.
        ImportError: when a package of the extra ``surface`` is missing.
    """

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        options: SurfaceOptions | None = None,
        materials: Sequence[str] = (),
        origin: Array | float = 0.0,
    ) -> None:
        require_packages()
        dim = trajectory.file["position"].shape[2]
        if dim != 3:
            raise SurfaceError(f"{trajectory.path}: a surface needs three dimensions; this run has {dim}")
        self.options = checked_options(options)
        self.dx, self.origin = scene.grid.dx, origin
        self.lower, self.upper = (np.array(corner) for corner in (scene.grid.lower, scene.grid.upper))
        names = trajectory.names("material")
        if unknown := [name for name in materials if name not in names]:
            raise SurfaceError(f"{trajectory.path}: materials are {', '.join(names)}, got {unknown[0]!r}")
        groups = groups_of(scene, trajectory)
        self.groups = [g for g in groups if (g.material in materials if materials else not g.grains)]
        if not self.groups:
            raise SurfaceError(
                f"{trajectory.path}: all materials are sand ({', '.join(names)}), which has a surface only where its "
                "material is named"
            )
        self.lengths = [self.options.lengths(group.spacing, self.dx) for group in self.groups]

    def of_frame(self, frame: dict[str, Array]) -> list[GroupSurface]:
        """Surfaces of the groups in a frame of the trajectory, in the order of ``groups``.

        Particles that are not finite or outside of the domain are skipped and logged.
        """
        x = frame["position"] - self.origin
        inside = ((x >= self.lower - self.dx) & (x <= self.upper + self.dx)).all(1)
        if not inside.all():
            log.warning("%d of %d particles are outside of the domain and have no surface", (~inside).sum(), len(x))
        pairs = zip(self.groups, self.lengths, strict=True)
        return [self._of_group(group, lengths, x, inside & group.rows(frame)) for group, lengths in pairs]

    def _of_group(self, group: Group, lengths: Lengths, x: Array, rows: Array) -> GroupSurface:
        own = x[rows]
        surface = reconstruct(own, group.spacing, self.dx, self.options)
        interpolation = Interpolation(own, surface.vertices, 2 * lengths.smoothing) if len(own) else None
        return GroupSurface(group, surface, rows, interpolation)


def check_names(**lists: Any) -> None:
    """Raise TypeError for a text in place of a list of names."""
    for name, value in lists.items():
        if isinstance(value, str):
            raise TypeError(f"{name} must be a list of names, got str {value!r}")


def export_surfaces(
    run: str | Path,
    out: str | Path | None = None,
    formats: Sequence[str] = ("ply",),
    *,
    options: SurfaceOptions | None = None,
    materials: Sequence[str] = (),
    every: int = 1,
    progress: Any = None,
) -> Path:
    """Write the surfaces of a run: ``water_00000.ply``, ..., and for VTP their times as ``run.pvd``.

    Args:
        run: run folder.
        out: folder; ``surface`` in that of the run by default.
        formats: of "ply", "obj" and "vtp".
        options, materials: as for `RunSurfaces`.
        every: write every n-th frame; files have the numbers of the frames.
        progress: called as ``progress(frame, frames)`` after each frame.

    Returns:
        The folder.

    Raises:
        FileNotFoundError: when the folder has no run, or no frame yet.
        DamagedFileError: for a run that is damaged, or a link out of its folder in place of the output.
        SurfaceError, ImportError: as `RunSurfaces`; also without a format, for an unknown one, and a missing package of
            a format.
        ValueError, TypeError: for ``every``, and for a text in place of a list of names.
    """
    check_count("every", every, 1)
    check_names(formats=formats, materials=materials)
    if not formats:
        raise SurfaceError(f"formats must have at least one of {', '.join(PACKAGES)}, got none")
    for name in formats:
        require_writer(name)
    scene = load_run(run)
    folder = output_path(Path(run), FOLDER, out)
    with Trajectory(run) as trajectory:
        if not len(trajectory):
            raise FileNotFoundError(f"{trajectory.path} has no frames yet")
        surfaces = RunSurfaces(scene, trajectory, options, materials)
        with output_folder(folder):
            _write_frames(surfaces, trajectory, folder, formats, every, progress)
    return folder


def _write_frames(
    surfaces: RunSurfaces, trajectory: Trajectory, folder: Path, formats: Sequence[str], every: int, progress: Any
) -> None:
    collected = []
    for k in range(0, len(trajectory), every):
        frame = trajectory.frame(k)
        for part, found in enumerate(surfaces.of_frame(frame)):
            velocity = found.velocity(frame)
            for name in formats:
                write_surface(folder / f"{found.group.name}_{k:05d}.{name}", found.surface, velocity)
            collected.append(CollectedFile(float(frame["time"]), f"{found.group.name}_{k:05d}.vtp", part))
        if progress is not None:
            progress(k, len(trajectory))
    if "vtp" in formats:
        write_collection(folder / COLLECTION, collected)
