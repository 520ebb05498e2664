"""Contact sheets and videos of scenes of a data set."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .folder import DatasetError, DatasetFolder, velocity_of
from .shard import Array, StoredScene
from .stress import DrawnStress, drawn_stress
from .whole_files import output_folder, output_path

SHEET, VIDEO = "sheet.png", "scenes.mp4"
SHOWN = 6
"""Number of scenes that are drawn by default."""
MOST_FPS = 60
SAMPLES = 8
"""Number of frames of each scene that determine the colour scale."""


def draw_scenes(
    dataset: str | Path | DatasetFolder,
    out: str | Path | None = None,
    scenes: Sequence[int] | None = None,
    color_by: str = "speed",
    frames: int = 5,
    width: int = 1600,
    video: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Draw scenes: ``sheet.png``, a row of frames for each scene, and ``scenes.mp4``, the scenes side by side.

    Args:
        dataset: folder of the data set.
        out: folder, created where it does not exist; ``pictures`` in that of the data set by default.
        scenes: ids; the first six valid scenes by default.
        color_by: "speed", "particle_type", "material", "stress" (von Mises), or a field of the scenes such as
            "pressure" or "temperature".
        frames: pictures of a scene on the sheet, from its first frame to its last.
        width: of sheet and video in pixels.
        video: whether to make the video, in real time and at 60 frames per second at most.
        progress: called with the number of the frame and the number of frames of the video.

    Returns:
        The files made.

    Raises:
        KeyError: for a scene that does not exist, failed, or is not finished.
        DatasetError: for a data set without a valid scene, or a field that scenes lack.
        DamagedFileError: for a scene that is damaged.
        ImportError: when a package of the extra ``render`` is missing.
    """
    from ..render import VideoWriter, contact_sheet, write_png

    data = dataset if isinstance(dataset, DatasetFolder) else DatasetFolder(dataset)
    chosen = [scene.id for scene in data.scenes()[:SHOWN]] if scenes is None else list(scenes)
    if not chosen:
        raise DatasetError(f"{data.path} has no valid scene yet")
    target = output_path(data.path, "pictures", out)
    length, interval = data.record.frames, data.record.frame_interval
    with contextlib.ExitStack() as stack:
        columns = max(1, frames)
        artist = stack.enter_context(_Artist(data, chosen, color_by, max(160, width // columns)))
        times = np.linspace(0, length - 1, columns).round().astype(int)
        pictures = [artist.picture(scene, int(k)) for scene in range(len(chosen)) for k in times]
        with output_folder(target):
            write_png(target / SHEET, contact_sheet(pictures, columns, width))
    if not video:
        return [target / SHEET]
    every = max(1, math.ceil(1 / (interval * MOST_FPS)))
    columns = math.ceil(math.sqrt(len(chosen)))
    numbers = range(0, length, every)
    with (
        _Artist(data, chosen, color_by, width // columns) as artist,
        VideoWriter(target / VIDEO, 1 / (interval * every)) as writer,
    ):
        for k in numbers:
            pictures = [artist.picture(scene, k) for scene in range(len(chosen))]
            writer.append(contact_sheet(pictures, columns, width))
            if progress is not None:
                progress(k // every, len(numbers))
    return [target / SHEET, target / VIDEO]


class _Artist:
    """One renderer per scene, with one colour scale."""

    def __init__(self, data: DatasetFolder, ids: Sequence[int], color_by: str, width: int) -> None:
        from ..render import Renderer
        from ..render.colors import QUANTITIES

        record = data.record
        self.interval, self.ids = record.frame_interval, list(ids)
        self.stored = [data.scene(number) for number in ids]
        self.values = [field_values(scene, color_by, self.interval) for scene in self.stored]
        stress = drawn_in(self.stored[0]) if color_by == "stress" else None
        self.words = [scene.words for scene in self.stored]
        self.bounds = (record.lower, record.upper)
        palette = color_by in ("material", "particle_type")
        sides = np.subtract(record.upper, record.lower)
        height = round(width * 0.75 * (float(np.clip(sides[1] / sides[0], 0.5, 2)) if record.dim == 2 else 1))
        self.renderers = [
            Renderer(
                self.bounds,
                (width, height),
                "material" if palette else stress.label if stress else color_by,
                None if palette else self._limits(color_by),
                QUANTITIES["stress"].cmap if stress else None,
                unit="Pa" if stress else None,
                gravity=_gravity(words, record.dim),
                materials=_material_names(scene) if color_by == "material" else (),
            )
            for scene, words in zip(self.stored, self.words, strict=True)
        ]

    def __enter__(self) -> _Artist:
        return self

    def __exit__(self, *_: object) -> None:
        for renderer in self.renderers:
            renderer.close()

    def picture(self, place: int, frame: int) -> Array:
        """A frame of one of the scenes."""
        time = frame * self.interval
        position = self.stored[place].window("position", frame, 1)[0]
        values = self.values[place]
        return self.renderers[place].frame(
            position,
            values if values.ndim == 1 else values[frame],
            obstacles=_obstacles(self.words[place], time, self.bounds),
            title=f"scene {self.ids[place]}, {time:.3f} s",
        )

    def _limits(self, color_by: str) -> tuple[float, float]:
        from ..render.colors import QUANTITIES, Quantity, scalar_of, value_range

        sampled = []
        for values in self.values:
            numbers = np.linspace(0, len(values) - 1, SAMPLES).round().astype(int)
            rows = [values] if values.ndim == 1 else [values[k] for k in numbers]
            sampled += [scalar_of(color_by, row, len(row)) for row in rows]
        return value_range(np.concatenate(sampled), QUANTITIES.get(color_by, Quantity("", "", "")).from_zero)


def field_values(scene: StoredScene, name: str, interval: float) -> Array:
    """Colours of particles by the name of a field: [T, N, ...], or [N] for "particle_type" and other constants.

    Raises:
        DatasetError: for a field that the scene lacks.
    """
    if name == "speed":
        return np.linalg.norm(velocity_of(scene, interval), axis=2)
    if name == "stress" and (stress := drawn_in(scene)) is not None:
        return stress.values(scene)
    if name not in scene:
        raise DatasetError(f"color_by must be speed or one of {', '.join(sorted(scene.names))}, got {name!r}")
    trailing = len(scene.shape(name)) - (2 if scene.shape(name)[:2] == (scene.frames, scene.particles) else 1)
    if trailing:
        raise DatasetError(f"color_by must be one number per particle, or stress, got {name!r}")
    return scene[name]


def drawn_in(scene: StoredScene) -> DrawnStress | None:
    """Von Mises stress in pictures of a scene."""
    return drawn_stress(scene.names, scene.measures, scene.dim)


def _material_names(scene: StoredScene) -> list[str]:
    try:
        return [str(m["name"] if isinstance(m, dict) else m) for m in json.loads(scene.attributes.get("materials", ""))]
    except (ValueError, TypeError, KeyError, RecursionError):
        return []


def _gravity(words: dict[str, Any], dim: int) -> Any:
    gravity = words.get("gravity")
    return gravity if dim == 3 and isinstance(gravity, list) and len(gravity) == 3 else None


def _obstacles(words: dict[str, Any], time: float, bounds: Any) -> list[Any]:
    """Shapes of the obstacles of a scene; none without the extra ``scene``."""
    if not words.get("obstacle"):
        return []
    try:
        from .obstacle_fields import obstacles_of
    except ImportError:
        return []
    from ..render import obstacle_shapes

    return [shape for obstacle in obstacles_of(words) for shape in obstacle_shapes(obstacle, time, bounds)]
