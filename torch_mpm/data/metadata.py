"""``metadata.json`` of a data set or an export, for the loaders of learned simulators.

``sequence_length`` has two meanings. It is the number of frames minus one for DeepMind's reader and PhysicsNeMo, and
the number of frames for geoelements/gns; so the first is at the top level and the second in the blocks "train" and
"rollout", which only gns reads.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from .folder import DatasetError, DatasetFolder
from .whole_files import write_whole

METADATA = "metadata.json"
NEIGHBOURS = 20
"""Number of particles within the connectivity radius, where a data set does not define one."""
GNS_VELOCITIES, GNS_EMBEDDING = 5, 16
"""geoelements/gns: number of velocities of a node, and numbers per particle type."""


def metadata(dataset: DatasetFolder, split: str = "train", material: bool = False) -> dict[str, Any]:
    """Content of ``metadata.json`` for a data set.

    Args:
        dataset: a data set with at least one valid scene.
        split: split of the statistics for normalisation; all scenes where there is no such split.
        material: whether an export for geoelements/gns has a column of a material parameter.

    Raises:
        DatasetError: for a data set without a valid scene.
    """
    record, scenes = dataset.record, dataset.scenes()
    if not scenes:
        raise DatasetError(f"{dataset.path} has no valid scene yet")
    known = split if split in record.splits and dataset.scenes(split) else None
    motion = dataset.motion(known)
    words: dict[str, Any] = {
        "title": record.title,
        "dim": record.dim,
        "bounds": [list(pair) for pair in zip(record.lower, record.upper, strict=True)],
        "sequence_length": record.frames - 1,
        "dt": record.frame_interval,
        "dx": record.dx,
        "default_connectivity_radius": connectivity_radius(dataset),
        "num_particles_max": max(scene.particles for scene in scenes),
        "periodic_boundary_conditions": [False] * record.dim,
        "vel_mean": motion.velocity.mean,
        "vel_std": motion.velocity.std,
        "acc_mean": motion.acceleration.mean,
        "acc_std": motion.acceleration.std,
        "statistics_of": known or "all splits",
        "configuration": record.configuration,
    }
    block = {**words, "sequence_length": record.frames}
    if material:
        block |= {"nnode_in": gns_node_features(record.dim) + 1, "nedge_in": record.dim + 1}
    return {**words, "train": block, "rollout": block}


def gns_node_features(dim: int) -> int:
    """Numbers per node in geoelements/gns without a material column: velocities, distances to walls, particle type."""
    return GNS_VELOCITIES * dim + 2 * dim + GNS_EMBEDDING


def particle_spacing(dataset: DatasetFolder) -> float:
    """Distance of neighbours at rest [m]: the side of a cube of the mean rest volume of a particle."""
    for scene in dataset.scenes():
        stored = dataset.scene(scene.id)
        if scene.particles and "volume" in stored:
            return float(stored["volume"].mean(dtype="f8") ** (1 / dataset.record.dim))
    return dataset.record.dx / 2


def connectivity_radius(dataset: DatasetFolder) -> float:
    """Radius [m] of the data set, or the one within which ``NEIGHBOURS`` particles lie at rest."""
    dim = dataset.record.dim
    ball = math.pi if dim == 2 else 4 / 3 * math.pi
    return float(particle_spacing(dataset) * (NEIGHBOURS / ball) ** (1 / dim))


def write_metadata(folder: Path, words: dict[str, Any]) -> None:
    """Write ``metadata.json``; it appears when it is complete and on the disk."""
    write_whole(folder / METADATA, json.dumps(words, indent=1, allow_nan=False).encode())
