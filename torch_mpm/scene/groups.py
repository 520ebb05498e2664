"""Groups of the particles of a run: those of one material in one scene of the batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..data.trajectory import Array, Trajectory
from ..data.whole_files import file_name
from ..errors import DamagedFileError
from ..surfaces.reconstruction import spacing_of
from . import schema
from .folder import REMEDY
from .scene import Scene


@dataclass(frozen=True)
class Group:
    """Particles of one material in one scene of the batch.

    ``name`` is a part of file names, ``scene`` and ``number`` of the material are indices of the trajectory, ``grains``
    is true for sand, and ``spacing`` is the distance between the particles at rest [m].
    """

    name: str
    scene: int
    number: int
    material: str
    grains: bool
    spacing: float

    def rows(self, frame: dict[str, Array]) -> Array:
        """Mask [P] of the particles in a frame, or in the quantities per particle of a trajectory."""
        return _rows(frame, self.scene, self.number)


def groups_of(scene: Scene, trajectory: Trajectory) -> list[Group]:
    """All groups of a run, by scene and material.

    Raises:
        DamagedFileError: for a trajectory with materials or scenes that the scene of the run lacks.
    """
    statics, entries, names = trajectory.statics, scene.entries(), trajectory.names("material")
    of_scene = statics.get("scene", np.zeros_like(statics["material"]))
    found = sorted(set(zip(of_scene.tolist(), statics["material"].tolist(), strict=True)))
    for k, m in found:
        if k >= len(entries) or names[m] not in entries[k].material:
            raise DamagedFileError(trajectory.path, f"has {names[m]!r} in scene {k}, which lacks it", REMEDY)
    labels = [f"{entries[k].name}_{names[m]}" if len(entries) > 1 else names[m] for k, m in found]
    return [
        Group(
            name,
            scene=k,
            number=m,
            material=names[m],
            grains=isinstance(entries[k].material[names[m]], schema.QuarticSand),
            spacing=spacing_of(statics["volume"][_rows(statics, k, m)]),
        )
        for name, (k, m) in zip(different_names(labels), found, strict=True)
    ]


def _rows(arrays: dict[str, Array], scene: int, material: int) -> Array:
    rows: Array = arrays["material"] == material
    return rows & (arrays["scene"] == scene) if "scene" in arrays else rows


def different_names(labels: Sequence[str]) -> list[str]:
    """Names for files, with a number where they would be equal."""
    names = [file_name(label) or "unnamed" for label in labels]
    while len(set(names)) < len(names):
        names = [f"{name}_{k}" if names.count(name) > 1 else name for k, name in enumerate(names)]
    return names
