"""Gaussians of the frames of a run, and their files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ..data.host_memory import in_words
from ..data.trajectory import Array, Trajectory
from ..data.whole_files import output_folder, output_path
from ..errors import DamagedFileError
from ..splats import FrameWriter, Gaussians, concatenate, deformed
from ..splats.motion import deformation
from ..splats.ply import size_of
from . import schema, splat_bodies
from .explain import SceneError
from .folder import OutputError, output_errors
from .scene import Scene

FOLDER = "splats"
KEPT = "The files written so far are complete; free some space and add --resume to continue"

Progress = Callable[[int, int], None]


class SplatFrames:
    """Gaussians of the bodies of a run in its frames, relative to the origin of the scene.

    Args:
        scene: scene of the run.
        trajectory: its frames.
        device: where the Gaussians are computed; None for the CPU.

    Raises:
        SceneError: for a scene without splats, or a batch of scenes.
        DamagedFileError: for a trajectory that is not one of these Gaussians.
        OSError, ValueError: for a file of a body that cannot be read.
    """

    def __init__(self, scene: Scene, trajectory: Trajectory, device: torch.device | None = None) -> None:
        check_scene(scene)
        self._origin = scene.origin
        (entry,) = scene.entries()
        bodies = [body for body in entry.body if isinstance(body, schema.SplatsBody)]
        self.rest = concatenate([splat_bodies.loaded(scene, entry, body) for body in bodies]).to(device)
        number = trajectory["gaussian"] if "gaussian" in trajectory.file else np.empty(0)
        self.rows = np.flatnonzero(number >= 0)
        """Particles with a Gaussian, in its order."""
        if not np.array_equal(number[self.rows], np.arange(len(self.rest))):
            raise DamagedFileError(
                trajectory.path, f"has not the {len(self.rest)} Gaussians of this scene", "simulate again"
            )
        self.others = np.flatnonzero(number == splat_bodies.NONE)
        """Particles of other bodies."""
        names = trajectory.names("material")
        fluid = np.array([isinstance(scene.material[name], schema.WeaklyCompressible) for name in names])
        self._fluid = torch.from_numpy(fluid[trajectory["material"][self.rows]]).to(device)

    def of(self, frame: dict[str, Array]) -> Gaussians:
        """Deformed Gaussians of a frame of the trajectory."""
        x = torch.from_numpy(self.positions(frame, self.rows)).to(self.rest.x)
        moved = deformation(x, None, None)
        if "F" in frame:
            moved = torch.where(self._fluid[:, None, None], moved, self._values(frame, "F"))
        if "J" in frame:
            fluid = deformation(x, None, self._values(frame, "J"))
            moved = torch.where(self._fluid[:, None, None], fluid, moved)
        return deformed(self.rest, x, moved)

    def positions(self, frame: dict[str, Array], rows: Array) -> Array:
        """Positions of some particles [n, 3] [m], relative to the origin."""
        x: Array = frame["position"][rows]
        return x if self._origin is None else x - np.array(self._origin)

    def _values(self, frame: dict[str, Array], name: str) -> torch.Tensor:
        return torch.from_numpy(frame[name][self.rows]).to(self.rest.x)


def check_scene(scene: Scene) -> None:
    """Raise SceneError for a scene whose splats cannot be written and drawn."""
    if scene.scene:
        raise SceneError(["scene: splats are written for single scenes, got a batch"], scene.source)
    if not any(isinstance(body, schema.SplatsBody) for body in scene.body):
        raise SceneError(['body: there is none with shape = "splats"'], scene.source)


def write_frames(
    folder: str | Path, scene: Scene, device: torch.device | None = None, progress: Progress | None = None
) -> list[Path]:
    """Write the Gaussians of each frame of a run: splats/00000.ply, ... in its folder; returns the paths.

    Existing files are complete, and are not written again.

    Args:
        folder: folder of the run.
        scene: its scene.
        device: where the Gaussians are computed; None for the CPU.
        progress: called with (frame, frames) when a frame is computed; threads write the files.

    Raises:
        OutputError: for a full disk, before it is full if it is known.
        SceneError, DamagedFileError, OSError, ValueError: as `SplatFrames`.
    """
    target = output_path(Path(folder), FOLDER)
    with Trajectory(folder) as trajectory, output_errors(target, KEPT), output_folder(target):
        frames = SplatFrames(scene, trajectory, device)
        paths = [target / f"{k:05d}.ply" for k in range(len(trajectory))]
        missing = [(k, path) for k, path in enumerate(paths) if not path.exists()]
        _require_room(target, len(missing) * size_of(len(frames.rest), frames.rest.harmonics.shape[1]))
        with FrameWriter() as files:
            for k, path in missing:
                files.write(path, frames.of(trajectory.frame(k)))
                if progress is not None:
                    progress(k, len(paths))
    return paths


def _require_room(folder: Path, size: int) -> None:
    free = shutil.disk_usage(folder).free
    if size > free:
        raise OutputError(
            f"the splats need {in_words(size)} in {folder}, where {in_words(free)} are free; "
            "free some space, lower fps or make the duration shorter"
        )
