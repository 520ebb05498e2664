"""Pictures and video of a run, from its trajectory."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..data.stress import DrawnStress, drawn_stress
from ..data.trajectory import Array, Trajectory
from ..data.whole_files import output_folder, output_path, remove_leftovers
from . import check, schema
from .explain import SceneError
from .fields import RANKS
from .places import obstacle
from .scene import Scene
from .surfaces import GroupSurface, RunSurfaces

FOLDER, VIDEO = "frames", "video.mp4"
SAMPLES = 8
"""Number of frames that determine the colour scale of a run."""


def draw(folder: str | Path, scene: Scene, progress: Any = None) -> list[Path]:
    """Draw the trajectory in ``folder`` with the settings ``scene.render``: frames/00000.png, ..., and video.mp4.

    Existing pictures of the same settings are reused. Returns the written files; calls ``progress(frame, frames)``
    after each picture.

    Raises:
        FileNotFoundError: when there is no trajectory, or it has no frame yet.
        DamagedFileError: for a trajectory that is damaged, or links out of the folder.
        SceneError: when `scene.render` does not fit the trajectory.
        ImportError: when a package of the extra ``render`` is missing.
    """

    def artist(trajectory: Trajectory) -> _Artist:
        words = scene.render or schema.Render()
        if problems := list(_problems(scene, words, trajectory)):
            raise SceneError(problems, scene.source)
        return _Artist(scene, words, trajectory)

    return draw_by(artist, folder, scene, progress)


class Artist(Protocol):
    """Pictures of the frames of a run."""

    way: str
    """Hash of everything that affects the picture of a frame."""

    def picture(self, frame: dict[str, Array]) -> Array:
        """Picture of a frame, uint8 [H, W, 3]."""

    def close(self) -> None:
        """Release resources."""


def draw_by(make: Callable[[Trajectory], Artist], folder: str | Path, scene: Scene, progress: Any = None) -> list[Path]:
    """Draw the trajectory in ``folder`` by the artist that ``make`` returns for it; the rest as `draw`."""
    from ..render import assemble_video, write_png
    from ..render.images import note_of

    words = scene.render or schema.Render()
    target, video = (output_path(Path(folder), name) for name in (FOLDER, VIDEO))
    remove_leftovers(Path(folder))
    with Trajectory(folder) as trajectory, output_folder(target):
        if not len(trajectory):
            raise FileNotFoundError(f"{trajectory.path} has no frames yet")
        artist = make(trajectory)
        numbers = range(0, len(trajectory), words.every)
        paths = [target / f"{k:05d}.png" for k in numbers]
        for k, path in zip(numbers, paths, strict=True):
            if note_of(path) != artist.way:
                write_png(path, artist.picture(trajectory.frame(k)), note=artist.way)
            if progress is not None:
                progress(k, len(trajectory))
        artist.close()
    if not words.video:
        return paths
    assemble_video(paths, video, scene.frames / scene.duration / words.every)
    return [*paths, video]


def _problems(scene: Scene, words: schema.Render, trajectory: Trajectory) -> Iterator[str]:
    """Overrides of a scene that contradict its trajectory."""
    yield from check.render_problems(scene)
    dim = trajectory.file["position"].shape[2]
    if scene.dim != dim:
        yield f"grid.lower: the trajectory has {dim} dimensions, got {scene.grid.lower}"
    if words.color_by == "stress" and drawn_stress(trajectory.fields, trajectory.measures, dim) is None:
        yield "render.color_by: the trajectory has no 'stress'; simulate with 'von_mises_stress' in output.fields"
    elif words.color_by in RANKS and words.color_by not in (*trajectory.fields, "stress"):
        yield f"render.color_by: the trajectory has no {words.color_by!r}; simulate with it in output.fields"


class _Artist:
    """One renderer per scene of the batch, with one colour scale."""

    def __init__(self, scene: Scene, words: schema.Render, trajectory: Trajectory) -> None:
        from ..render import Renderer
        from ..render.colors import QUANTITIES

        origin, scene = scene.origin, scene.relative()
        self.zero = np.zeros(scene.dim) if origin is None else np.array(origin)
        words = scene.render or words
        self.scene, self.words = scene, words
        self.entries = scene.entries()
        self.columns = math.ceil(math.sqrt(len(self.entries)))
        self.names = trajectory.names("material")
        self.layers = _layers(trajectory, scene, words.layers) if words.color_by == "layer" else None
        self.stress: DrawnStress | None = None
        if words.color_by == "stress":
            self.stress = drawn_stress(trajectory.fields, trajectory.measures, scene.dim)
        width, height = words.resolution
        limits = words.range or self._limits(trajectory)
        self.renderers = [
            Renderer(
                (scene.grid.lower, scene.grid.upper),
                (width // self.columns, height // self.columns),
                self.stress.label if self.stress else words.color_by,
                limits,
                QUANTITIES["stress"].cmap if self.stress else None,
                unit="Pa" if self.stress else None,
                gravity=entry.gravity if scene.dim == 3 else None,
                style=words.style,
                materials=self.names,
                azimuth=words.azimuth,
                elevation=words.elevation,
                view=words.view,
                exaggeration=words.exaggeration,
                origin=origin,
            )
            for entry in self.entries
        ]
        self.surfaces = RunSurfaces(self.scene, trajectory, origin=self.zero) if words.surface else None
        self._fit_radii(trajectory)
        drawn = scene.model_dump_json(), limits, [renderer.radius for renderer in self.renderers]
        self.way = hashlib.sha256(repr(drawn).encode()).hexdigest()
        """Hash of everything that affects the picture of a frame."""

    def _fit_radii(self, trajectory: Trajectory) -> None:
        """Set the radii from the first frame with particles, for any order of pictures."""
        missing = dict(enumerate(self.renderers))
        for frame in trajectory:
            for k, renderer in list(missing.items()):
                x = self._positions(k, frame)
                renderer.fit_radius(x)
                if len(x):
                    del missing[k]
            if not missing:
                return

    def _positions(self, k: int, frame: dict[str, Array]) -> Array:
        x: Array = frame["position"][_rows(k, frame)] - self.zero
        return x

    def picture(self, frame: dict[str, Array]) -> Array:
        """One frame, all scenes of the batch side by side."""
        from ..render import contact_sheet

        time = float(frame["time"])
        surfaces = [] if self.surfaces is None else self.surfaces.of_frame(frame)
        pictures = [
            self._one(k, frame, time, [found for found in surfaces if found.group.scene == k])
            for k in range(len(self.entries))
        ]
        return pictures[0] if len(pictures) == 1 else contact_sheet(pictures, self.columns, self.words.resolution[0])

    def _one(self, k: int, frame: dict[str, Array], time: float, surfaces: Sequence[GroupSurface]) -> Array:
        from ..render import obstacle_shapes

        entry = self.entries[k]
        bounds = (self.scene.grid.lower, self.scene.grid.upper)
        shapes = [
            replace(shape, opacity=words.opacity)
            for words in entry.obstacle
            for shape in obstacle_shapes(obstacle(words, None), time, bounds)
        ]
        overlays = list(_ritter(self.scene, self.words.ritter, time)) if self.words.ritter else []
        values, rows = self._values(frame), _rows(k, frame)
        for found in surfaces:
            rows &= ~found.rows
        return self.renderers[k].frame(
            frame["position"][rows] - self.zero,
            values[rows],
            obstacles=shapes,
            overlays=overlays,
            time=time,
            title=entry.name or self.scene.title,
            surfaces=[(found.surface, self._at_vertices(found, values)) for found in surfaces],
        )

    def _at_vertices(self, found: GroupSurface, values: Array) -> Array:
        """Values of particles at the vertices of a surface; categories are not interpolated."""
        from ..render.colors import PALETTES

        return found.nearest(values) if self.words.color_by in PALETTES else found.mean(values)

    def _values(self, frame: dict[str, Array]) -> Array:
        if self.layers is not None:
            return self.layers[: len(frame["position"])]
        if self.stress is not None:
            return self.stress.values(frame)
        return frame["velocity" if self.words.color_by == "speed" else self.words.color_by]

    def _limits(self, trajectory: Trajectory) -> tuple[float, float] | None:
        """Range of the colours over some frames of the run."""
        from ..render.colors import PALETTES, QUANTITIES, scalar_of, value_range

        if self.words.color_by in PALETTES:
            return None
        numbers = np.linspace(0, len(trajectory) - 1, SAMPLES).round().astype(int)
        frames = [self._values(trajectory.frame(int(k))) for k in numbers]
        values = np.concatenate([scalar_of(self.words.color_by, f, len(f)) for f in frames])
        return value_range(values, QUANTITIES[self.words.color_by].from_zero)

    def close(self) -> None:
        for renderer in self.renderers:
            renderer.close()


def _rows(k: int, frame: dict[str, Array]) -> Array:
    """Particles of a scene of the batch, bool [P]."""
    return frame["scene"] == k if "scene" in frame else np.ones(len(frame["position"]), bool)


def _layers(trajectory: Trajectory, scene: Scene, count: int) -> Array:
    """Number of the layer of each particle [N]: by height at the start, or by time for emitted particles."""
    start = trajectory.frame(0)["position"]
    total = len(trajectory["mass"])
    up = -np.asarray(scene.gravity or np.eye(scene.dim)[1] * -1.0)
    height = start @ up
    numbers = np.arange(total) - len(start)
    share = numbers / max(1, total - len(start))
    if len(start):
        share[: len(start)] = (height - height.min()) / max(np.ptp(height), 1e-30)
    return np.clip((share * count).astype(np.int64), 0, count - 1)


def ritter_front(scene: Scene, words: schema.Ritter, time: float) -> float:
    """Front of a dam break on a dry bed, x0 + 2 sqrt(g h0) t (Ritter 1892) [m]."""
    return words.dam + 2 * math.sqrt(_gravity(scene) * words.depth) * time


def _gravity(scene: Scene) -> float:
    return float(np.linalg.norm(scene.gravity or (0.0,)))


def _ritter(scene: Scene, words: schema.Ritter, time: float) -> Iterator[tuple[Array, str, str]]:
    """Depth h = (2 c - (x - x0) / t)^2 / (9 g) between x0 - c t and the front, with c = sqrt(g h0)."""
    floor, (low, high) = scene.grid.lower[1], (scene.grid.lower[0], scene.grid.upper[0])
    c = math.sqrt(_gravity(scene) * words.depth)
    x = np.linspace(words.dam - c * time, ritter_front(scene, words, time), 128)
    depth = (2 * c - (x - words.dam) / time) ** 2 / (9 * _gravity(scene)) if time > 0 else np.full(128, words.depth)
    x, depth = np.append(np.insert(x, 0, low), x[-1]), np.append(np.insert(depth, 0, words.depth), 0.0)
    seen = (x >= low) & (x <= high)
    yield np.stack([x, floor + depth], 1)[seen], "#d62728", "Ritter 1892"
