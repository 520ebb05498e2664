"""USD file of a run: its particles or surfaces, its obstacles with their motion, and its camera."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..data.trajectory import Array, Trajectory
from ..data.whole_files import output_path, remove_leftovers
from ..errors import check_count, check_flag
from ..geometry.surface_mesh import frame_of
from ..render.boundaries import obstacle_shapes
from ..render.camera import framing, up_axis
from ..render.colors import palette_colors
from ..surfaces.reconstruction import SurfaceOptions, checked_options
from ..usd.prims import Grains, Mesh, Points, RigidPiece, linear, write_camera, write_group, write_rigid
from ..usd.stage import SUFFIXES, Stage, UsdError, child_path, new_stage, pxr
from . import schema
from .folder import load_run
from .groups import Group, groups_of
from .places import obstacle
from .scene import Scene
from .surfaces import RunSurfaces, check_names

log = logging.getLogger(__name__)

FILE = "run.usdc"
ROOT = "/run"
FILL = (0.92, 0.86)
"""Shares of the width and the height of a picture that the domain fills."""
GAP = 1.25
"""Distance between the scenes of a batch [widths of the domain]."""


def export_usd(
    run: str | Path,
    out: str | Path | None = None,
    *,
    grains: bool = False,
    surface: bool = False,
    options: SurfaceOptions | None = None,
    materials: Sequence[str] = (),
    every: int = 1,
    progress: Any = None,
) -> Path:
    """Write a run in 3-D as one USD file, in metres and with one time code per frame.

    Args:
        run: run folder.
        out: file that ends with .usdc, .usda or .usd; ``run.usdc`` in the folder of the run by default.
        grains: particles are instances of a sphere (PointInstancer) in place of points.
        surface: materials with a surface, all but sand, are meshes in place of particles.
        options, materials: as for `RunSurfaces`.
        every: write every n-th frame; time codes are the numbers of the frames.
        progress: called as ``progress(frame, frames)`` after each frame.

    Returns:
        The file.

    Raises:
        FileNotFoundError: when the folder has no run, or no frame yet.
        DamagedFileError: for a run that is damaged, or a link out of its folder in place of the output.
        UsdError: for a 2-D run, or another suffix.
        SurfaceError: as `RunSurfaces`.
        ImportError: when usd-core is missing (extra ``usd``), or with ``surface`` a package of its extra.
        OSError: when the file cannot be written; nothing remains of it.
        ValueError, TypeError: for ``every``, options or materials without ``surface``, and flags that are none.
    """
    check_count("every", every, 1)
    check_flag("grains", grains)
    check_names(materials=materials)
    given = checked_options(options) != SurfaceOptions() or len(materials) > 0
    if not check_flag("surface", surface) and given:
        raise ValueError("surface must be True where options or materials are given, got False")
    pxr("Usd")
    scene = load_run(run)
    path = output_path(Path(run), FILE, out)
    if path.suffix not in SUFFIXES:
        raise UsdError(f"the USD file must end with {', '.join(SUFFIXES)}, got {path}")
    with Trajectory(run) as trajectory:
        if not len(trajectory):
            raise FileNotFoundError(f"{trajectory.path} has no frames yet")
        if (dim := trajectory.file["position"].shape[2]) != 3:
            raise UsdError(f"{trajectory.path}: a USD file needs three dimensions; this run has {dim}")
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent)
        up, turn = _upright(scene.relative().entries()[0].gravity)
        words = {"rate": scene.frames / scene.duration, "last": len(trajectory) - 1, "up": up, "title": scene.title}
        with new_stage(path, **words) as stage:
            writer = _Writer(stage, scene, trajectory, turn, grains)
            if surface:
                writer.add_surfaces(RunSurfaces(scene.relative(), trajectory, options, materials, writer.origin))
            writer.add_particles()
            for k in range(0, len(trajectory), every):
                writer.write(k, trajectory.frame(k))
                if progress is not None:
                    progress(k, len(trajectory))
            writer.close()
            del writer
    return path


def _upright(gravity: Sequence[float] | None) -> tuple[str, Array]:
    """Upward axis of the file, "Y" or "Z", and the rotation [3, 3] that turns the upward direction of a scene to it."""
    up = up_axis(gravity)
    for name, axis in (("Y", np.eye(3)[1]), ("Z", np.eye(3)[2])):
        if np.allclose(up, axis, rtol=0, atol=1e-9):
            return name, np.eye(3)
    return "Y", frame_of(up).T


class _Writer:
    """Prims of a run. Coordinates are relative to ``origin``, which the transform of the root adds."""

    def __init__(self, stage: Stage, scene: Scene, trajectory: Trajectory, turn: Array, grains: bool) -> None:
        self.stage, self.grains = stage, grains
        self.origin = np.zeros(3) if scene.origin is None else np.array(scene.origin)
        self.scene = scene.relative()
        self.groups = groups_of(scene, trajectory)
        self.points: list[tuple[Group, Points]] = []
        self.surfaces: RunSurfaces | None = None
        self.meshes: dict[Group, Mesh] = {}
        root = write_group(stage, ROOT, self.origin @ turn.T, turn)
        stage.stage.SetDefaultPrim(root)
        self.paths = list(self._add_scenes(len(trajectory)))
        self._add_camera()

    def _add_scenes(self, frames: int) -> Iterator[str]:
        """Write the transforms of the scenes of a batch, side by side, and their obstacles; yields their paths."""
        entries = self.scene.entries()
        for k, entry in enumerate(entries):
            path = ROOT
            if len(entries) > 1:
                path = child_path(ROOT, f"scene_{k}")
                side = _side(up_axis(entry.gravity))
                lower, upper = np.array(self.scene.grid.lower), np.array(self.scene.grid.upper)
                write_group(self.stage, path, GAP * k * side * (upper - lower))
            if entry.obstacle:
                parent = child_path(path, "obstacles")
                write_group(self.stage, parent)
                for n, words in enumerate(entry.obstacle):
                    for piece in _pieces(self.scene, words, n, frames):
                        write_rigid(self.stage, parent, piece)
            yield path

    def _add_camera(self) -> None:
        words, grid = self.scene.render or schema.Render(), self.scene.grid
        lower, upper = (np.array(corner) for corner in words.view or (grid.lower, grid.upper))
        up = up_axis(self.scene.entries()[0].gravity)
        camera = framing(lower, upper, up, words.resolution, words.azimuth, words.elevation, fill=FILL)
        far = float(np.linalg.norm(camera.position - 0.5 * (lower + upper)) + np.linalg.norm(upper - lower))
        write_camera(self.stage, child_path(ROOT, "camera"), camera, (1e-3 * far, 10 * far))

    def _path(self, group: Group) -> str:
        return child_path(self.paths[group.scene], f"material_{group.number}_{group.material}")

    def _color(self, group: Group) -> Array:
        return linear(palette_colors(np.array([group.number]))[0] / 255)

    def add_surfaces(self, surfaces: RunSurfaces) -> None:
        """Write the groups with a surface as meshes."""
        self.surfaces = surfaces
        self.meshes = {group: Mesh(self.stage, self._path(group), self._color(group)) for group in surfaces.groups}

    def add_particles(self) -> None:
        """Write the other groups as particles."""
        kind = Grains if self.grains else Points
        for group in self.groups:
            if group not in self.meshes:
                prim = kind(self.stage, self._path(group), group.spacing, self._color(group))
                self.points.append((group, prim))

    def write(self, k: int, frame: dict[str, Array]) -> None:
        """Write a frame. Particles whose position is not finite are skipped and logged."""
        for found in self.surfaces.of_frame(frame) if self.surfaces else []:
            self.meshes[found.group].write(k, found.surface, found.velocity(frame))
        finite = np.asarray(np.isfinite(frame["position"]).all(1))
        if not finite.all():
            log.warning("%d of %d particles have no finite position", (~finite).sum(), len(finite))
        for group, prim in self.points:
            ids = np.flatnonzero(group.rows(frame) & finite)
            prim.write(k, frame["position"][ids] - self.origin, frame["velocity"][ids], ids)

    def close(self) -> None:
        """Release the prims, before the file is renamed."""
        self.points.clear()
        self.meshes.clear()


def _side(up: Array) -> Array:
    """The axis along which the scenes of a batch stand."""
    return np.eye(3)[2 if abs(up[0]) > 0.5 else 0]


def _pieces(scene: Scene, words: Any, number: int, frames: int) -> Iterator[RigidPiece]:
    """Pieces of an obstacle at the times of the frames."""
    bounds, built = (scene.grid.lower, scene.grid.upper), obstacle(words, None)
    shapes = [obstacle_shapes(built, scene.time_of(k), bounds) for k in range(frames)]
    name = f"obstacle_{number}_{words.name or words.shape}"
    for piece in range(max((len(found) for found in shapes), default=0)):
        yield RigidPiece(f"{name}_{piece}" if piece else name, [found[piece] if found else None for found in shapes])
