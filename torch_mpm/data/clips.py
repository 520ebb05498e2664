"""Clips of the viewer: the scenes of a run or of a data set, each read completely."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..render.colors import scalar_of
from .folder import DATASET, DatasetError, DatasetFolder
from .pictures import drawn_in, field_values
from .stress import TENSORS, drawn_stress
from .trajectory import Array, Trajectory

COLORLESS = ("F", "C", "momentum", "position", "velocity", "von_mises_stress", *TENSORS)
"""Arrays of particles that are not colours, or that have a separate name as colours."""


@dataclass(frozen=True)
class Clip:
    """Complete scene.

    Attributes:
        position: [T, N, D] (m), NaN for particles that are not present yet; relative to the origin of the run, so that
            float32 resolves it.
        fields: colours of particles by name: [T, N, ...] or [N].
        interval: time between two frames [s].
    """

    position: Array
    fields: dict[str, Array]
    interval: float

    def values(self, name: str, frame: int) -> Array:
        """Numbers [N] of a frame."""
        values = self.fields[name]
        row = values[frame] if values.shape[:2] == self.position.shape[:2] else values
        return scalar_of(name, row, len(row))


class Source:
    """Source of a run or a data set: ``scenes`` are its names, ``clip(name)`` one of them.

    Raises:
        FileNotFoundError: for a folder with neither.
        DatasetError: for a data set without a valid scene.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if (self.path / DATASET).is_file():
            self.dataset = DatasetFolder(self.path)
            self.bounds = (self.dataset.record.lower, self.dataset.record.upper)
            self.scenes = {f"{self._split(s.id)} {s.id}": s.id for s in self.dataset.scenes()}
            self.title = self.dataset.record.title
        else:
            self.trajectory = Trajectory(self.path)
            named = "scene" in self.trajectory.file
            names = self.trajectory.names("scene") if named else ["run"]
            self.scenes = {name or f"scene {k}": k for k, name in enumerate(names)}
            self.title = str(self.trajectory.attributes.get("title", ""))
            position = self._positions()
            self.bounds = (np.nanmin(position, (0, 1)), np.nanmax(position, (0, 1)))
        if not self.scenes:
            raise DatasetError(f"{self.path} has no valid scene yet")

    def _positions(self) -> Array:
        """Positions of a run, relative to its origin."""
        return self.trajectory["position"] - self.trajectory.attributes.get("origin", 0)

    def _split(self, scene_id: int) -> str:
        return self.dataset.record.split_of(scene_id)

    def clip(self, name: str) -> Clip:
        """Read a scene completely."""
        return self._of_dataset(self.scenes[name]) if hasattr(self, "dataset") else self._of_run(self.scenes[name])

    def _of_dataset(self, scene_id: int) -> Clip:
        scene, interval = self.dataset.scene(scene_id), self.dataset.record.frame_interval
        names = ["speed", *(name for name in scene.names if name not in COLORLESS)]
        fields = {name: field_values(scene, name, interval) for name in names}
        if (stress := drawn_in(scene)) is not None:
            fields[stress.label] = stress.values(scene)
        return Clip(scene["position"], fields, interval)

    def _of_run(self, number: int) -> Clip:
        data = self.trajectory
        rows = data["scene"] == number if "scene" in data.file else slice(None)
        position = self._positions()
        names = [name for name in (*data.fields, "material", "mass") if name not in COLORLESS]
        moving = {"speed": np.linalg.norm(data["velocity"], axis=2)}
        if (stress := drawn_stress(data.fields, data.measures, position.shape[2])) is not None:
            moving[stress.label] = stress.values(data)
        fields = moving | {name: data[name] for name in names}
        picked = {name: v[:, rows] if name in moving or name in data.fields else v[rows] for name, v in fields.items()}
        times = data["time"]
        interval = float(np.diff(times).mean()) if len(times) > 1 else 1.0
        return Clip(position[:, rows], picked, interval)
