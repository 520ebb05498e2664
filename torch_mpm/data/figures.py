"""Figures of the content of a data set: sizes, motions, energies, failures, and drawn values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .folder import DatasetError, DatasetFolder, velocity_of
from .shard import Array, StoredScene
from .statistics import BOUNDARY
from .whole_files import output_folder, output_path

SAMPLED = 32
"""Maximum number of scenes that are read for motions and energies."""
RESOLUTION = (1500, 1100)
MOST_PARAMETERS = 3


def summary(dataset: str | Path | DatasetFolder) -> dict[str, Any]:
    """Summary of a data set, from its records only: scenes, failures and particles of each split, statistics."""
    data = dataset if isinstance(dataset, DatasetFolder) else DatasetFolder(dataset)
    words: dict[str, Any] = {}
    for split in data.record.splits:
        attempted, valid = data.attempted(split), data.scenes(split)
        particles = [scene.particles for scene in valid]
        words[split] = {
            "scenes": data.record.count(split),
            "finished": len(attempted),
            "failed": len(attempted) - len(valid),
            "tried again": sum(scene.attempts > 1 for scene in attempted),
            "particles": [min(particles, default=0), max(particles, default=0)],
        }
    motion = data.motion()
    words["velocity"] = {"mean": motion.velocity.mean, "std": motion.velocity.std}
    words["acceleration"] = {"mean": motion.acceleration.mean, "std": motion.acceleration.std}
    return words


def draw_statistics(dataset: str | Path | DatasetFolder, out: str | Path | None = None) -> Path:
    """Draw ``statistics.png``: particles, speeds, accelerations, energies over time, outcomes, and drawn parameters.

    Args:
        dataset: folder of the data set.
        out: the picture, whose folder is created; ``statistics.png`` in the folder of the data set by default.

    Raises:
        DatasetError: for a data set without a valid scene, or a picture that is not a PNG file.
        DamagedFileError: for a scene that is damaged.
        ImportError: when matplotlib is missing (extra ``render``).
    """
    from ..render.annotate import figure
    from ..render.images import write_png

    data = dataset if isinstance(dataset, DatasetFolder) else DatasetFolder(dataset)
    valid = data.scenes()
    if not valid:
        raise DatasetError(f"{data.path} has no valid scene yet")
    target = output_path(data.path, "statistics.png", out)
    if target.suffix.lower() != ".png":
        raise DatasetError(f"out must be the name of a PNG file, NAME.png, got {str(target)!r}")
    chosen = np.unique(np.linspace(0, len(valid) - 1, SAMPLED).round().astype(int))
    scenes = [data.scene(valid[k].id) for k in chosen if valid[k].particles]
    picture = figure(RESOLUTION)
    axes = picture.subplots(3, 3).ravel()
    _draw_counts(axes[0], data)
    _draw_outcomes(axes[1], data)
    interval = data.record.frame_interval
    velocities = [_free(scene, velocity_of(scene, interval)) for scene in scenes]
    _histogram(axes[2], np.concatenate([_sample(np.linalg.norm(v, axis=2)) for v in velocities]), "speed [m/s]")
    changes = [np.linalg.norm(np.diff(v, axis=0), axis=2) / interval for v in velocities if len(v) > 1]
    _histogram(axes[3], np.concatenate([_sample(a) for a in changes] or [np.zeros(0)]), "acceleration [m/s²]", log=True)
    _draw_energies(axes[4:6], scenes, velocities, interval)
    _draw_parameters(axes[6:], scenes)
    picture.suptitle(f"{data.record.title or data.path.name}: {len(valid)} scenes, {len(scenes)} of them read")
    picture.tight_layout()
    picture.canvas.draw()
    with output_folder(target.parent):
        write_png(target, np.ascontiguousarray(np.asarray(picture.canvas.buffer_rgba())[..., :3]))
    return target


def _free(scene: StoredScene, values: Array) -> Array:
    """Values of the particles without prescribed motion."""
    return values[:, scene["particle_type"] != BOUNDARY] if "particle_type" in scene else values


def _sample(values: Array, most: int = 20_000) -> Array:
    return values.ravel()[:: max(1, values.size // most)]


def _histogram(axes: Any, values: Array, label: str, log: bool = False) -> None:
    top = float(np.percentile(values, 99.5)) if values.size else 1.0
    axes.hist(values[values <= top], bins=_edges(np.array([0.0, top]), 50), color="#0072B2", log=log)
    axes.set(xlabel=label, ylabel="particles and frames", title=f"99.5% are below {top:.3g}")


def _edges(values: Array, bins: int) -> Array:
    """Edges of bins from the smallest value to the largest, wider than rounding where these are nearly equal."""
    lower, upper = float(values.min()), float(values.max())
    margin = max(0.0, 1e-6 * max(abs(lower), abs(upper), 1e-30) - (upper - lower))
    return np.linspace(lower - margin, upper + margin, bins + 1)


def _draw_counts(axes: Any, data: DatasetFolder) -> None:
    counts = {split: [s.particles for s in data.scenes(split)] for split in data.record.splits}
    shown = {split: values for split, values in counts.items() if values}
    axes.hist(list(shown.values()), bins=20, stacked=True, label=list(shown))
    axes.set(xlabel="particles of a scene", ylabel="scenes")
    axes.legend()


def _draw_outcomes(axes: Any, data: DatasetFolder) -> None:
    """Number of scenes of each split by outcome."""
    splits, bottom = list(data.record.splits), np.zeros(len(data.record.splits))
    kinds = {
        "valid": lambda s: s.valid and s.attempts == 1,
        "valid, tried again": lambda s: s.valid and s.attempts > 1,
        "failed": lambda s: not s.valid,
    }
    for (name, belongs), color in zip(kinds.items(), ("#009E73", "#E69F00", "#D55E00"), strict=True):
        heights = np.array([sum(map(belongs, data.attempted(split))) for split in splits])
        axes.bar(splits, heights, bottom=bottom, label=f"{name}: {heights.sum()}", color=color)
        bottom += heights
    missing = np.array([data.record.count(split) for split in splits]) - bottom
    axes.bar(splits, missing, bottom=bottom, label=f"not finished: {missing.sum():.0f}", color="#dddddd")
    axes.set(ylabel="scenes")
    axes.legend()


def _draw_energies(axes: Sequence[Any], scenes: list[StoredScene], velocities: list[Array], interval: float) -> None:
    """Kinetic energy and height of the centre of mass against gravity, one line for each scene."""
    for scene, velocity in zip(scenes, velocities, strict=True):
        mass = _free(scene, scene["mass"][None])[0].astype("f8") if "mass" in scene else np.ones(velocity.shape[1])
        time = interval * np.arange(len(velocity))
        axes[0].plot(time, 0.5 * np.einsum("n,tnd,tnd->t", mass, velocity, velocity, dtype="f8"), lw=0.7)
        gravity = scene.words.get("gravity")
        if isinstance(gravity, list) and len(gravity) == scene.dim:
            potential = -np.einsum("n,tnd,d->t", mass, _free(scene, scene["position"]), np.array(gravity, float))
            axes[1].plot(time, potential - potential[-1], lw=0.7)
    axes[0].set(xlabel="time [s]", ylabel="kinetic energy [J]")
    axes[1].set(xlabel="time [s]", ylabel="potential energy above the last frame [J]")


def _draw_parameters(axes: Sequence[Any], scenes: list[StoredScene]) -> None:
    """Numeric parameters of materials and gravity that differ most often between the scenes."""
    found: dict[str, list[float]] = {}
    for scene in scenes:
        for name, value in _parameters(scene):
            found.setdefault(name, []).append(value)
    varied = {name: values for name, values in found.items() if len(set(values)) > 1}
    names = sorted(varied, key=lambda name: -len(set(varied[name])))[:MOST_PARAMETERS]
    for place, name in zip(axes, names, strict=False):
        place.hist(varied[name], bins=_edges(np.array(varied[name]), 20), color="#CC79A7")
        place.set(xlabel=name, ylabel="scenes")
    for place in axes[len(names) :]:
        place.set_axis_off()


def _parameters(scene: StoredScene) -> Iterator[tuple[str, float]]:
    words = scene.words
    for material, given in (words.get("material") or {}).items():
        for name, value in given.items() if isinstance(given, dict) else ():
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                yield f"{material}.{name}", float(value)
    gravity = words.get("gravity")
    if isinstance(gravity, list):
        yield "gravity [m/s²]", float(np.linalg.norm(gravity))
