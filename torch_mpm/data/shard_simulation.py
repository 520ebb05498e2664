"""Scenes of a shard: drawn, seeded and simulated together, and simulated again with smaller time steps where they
failed.

All of it depends on the configuration and the ids of the scenes only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ..errors import SimulationError
from ..scene import SceneError
from ..scene.build import Built
from . import batch, obstacle_particles
from .configuration import Configuration
from .distribution import Words, is_number
from .frame_transfer import Array, StoredFrames
from .packing import Compressed
from .sampling import NoRoom, content
from .statistics import Motion

AGAIN = 0.8
"""Share of the smallest limit of failed scenes that the time step of their next attempt has: between two checks
(`batch.LOOK`) the limit may be smaller than at these."""
OnFrame = Callable[[int, int], None]
"""Function that is called with the number of simulated scenes and the number of the queued frame."""


@dataclass
class Outcome:
    """Outcome of a scene.

    Attributes:
        id: id of the scene.
        words: its content; None where nothing could be drawn.
        failure: reason of its failure; "" for a valid scene.
        attempts: number of simulations.
        dt, substeps: time step [s] and number of substeps per frame of the last attempt.
        behind: arrays of the particles of its obstacles, where the data set includes these.
        arrays: arrays of a valid scene in the form of a shard, except packed ones.
        packed: arrays that were packed during the simulation.
        motion: sums of its motion.
        materials: words of its materials, in the order of their numbers.
    """

    id: int
    words: Words | None = None
    failure: str = ""
    attempts: int = 0
    dt: float = 0.0
    substeps: int = 0
    behind: dict[str, Array] = field(default_factory=dict)
    arrays: dict[str, Array] = field(default_factory=dict)
    packed: dict[str, Compressed] = field(default_factory=dict)
    motion: Motion | None = None
    materials: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Drawn:
    """Scenes that are ready to be simulated: the outcomes of all, and the batch of those that have not failed yet."""

    outcomes: list[Outcome]
    built: Built | None

    @property
    def alive(self) -> list[Outcome]:
        return [o for o in self.outcomes if not o.failure]


def draw(configuration: Configuration, ids: Iterable[int], device: torch.device) -> Drawn:
    """Draw scenes and seed their particles. A scene without space for a body, or that is invalid, has failed."""
    outcomes = [Outcome(k) for k in ids]
    for outcome in outcomes:
        try:
            outcome.words = content(configuration, outcome.id)
        except NoRoom as error:
            outcome.failure = str(error)
    drawn = Drawn(outcomes, _built(configuration, outcomes, device))
    if drawn.built is not None and any(_wants_obstacles(configuration, outcome) for outcome in drawn.alive):
        volumes = np.split(drawn.built.statics()["volume"].numpy(), np.cumsum(batch.particles_of(drawn.built))[:-1])
        for outcome, volume in zip(drawn.alive, volumes, strict=True):
            _add_obstacles(configuration, outcome, volume)
    return drawn


def _add_obstacles(configuration: Configuration, outcome: Outcome, volume: Array) -> None:
    """Arrays of the particles of obstacles, at the mean distance of those of the scene, with the given volumes."""
    if outcome.words is None or not _wants_obstacles(configuration, outcome):
        return
    dataset, dim = configuration.dataset, configuration.dim
    shapes = batch.shapes_of(("position", *dataset.fields), dim)
    statics = {name: np.float32 for name in ("mass", "volume", *configuration.drawn_parameters)}
    nothing: dict[str, Array] = {
        **{name: np.empty((dataset.frames, 0, *shape), np.float32) for name, shape in shapes.items()},
        **{
            name: np.empty(0, kind) for name, kind in {**statics, "particle_type": np.int8, "material": np.int8}.items()
        },
    }
    times = np.arange(dataset.frames) * dataset.interval
    spacing = float(volume.astype(np.float32).mean()) ** (1 / dim)
    outcome.behind = obstacle_particles.add(nothing, configuration.scene(outcome.words), times, spacing)


def _built(configuration: Configuration, outcomes: list[Outcome], device: torch.device) -> Built | None:
    """Batch of all scenes that have not failed; scenes that cannot be built fail now."""
    alive = [o for o in outcomes if not o.failure]
    if not alive:
        return None
    try:
        return _batch(configuration, alive, device)
    except SceneError:
        for outcome in alive:
            try:
                _batch(configuration, [outcome], torch.device("cpu"))
            except SceneError as error:
                outcome.failure = "; ".join(error.problems)
        if not any(o.failure for o in alive):
            raise  # Each is valid, but not all together.
        return _built(configuration, outcomes, device)


def _batch(configuration: Configuration, outcomes: list[Outcome], device: torch.device) -> Built:
    return configuration.scene(*(o.words for o in outcomes if o.words is not None)).build(device)


def simulate(
    configuration: Configuration,
    drawn: Drawn,
    device: torch.device,
    on_frame: OnFrame | None = None,
    packers: Executor | None = None,
) -> None:
    """Simulate the drawn scenes; the results are in their outcomes.

    Args:
        configuration: configuration of the data set.
        drawn: the scenes.
        device: device of the simulation.
        on_frame: called after each frame has been queued.
        packers: executor that packs the scenes during the simulation.

    Raises:
        SimulationError: where the device memory is insufficient for the scenes.
    """
    dataset, built = configuration.dataset, drawn.built
    if built is None:
        return
    first, built = _substeps(configuration, drawn, built, device)
    rest, count = drawn.alive, first
    for attempt in range(dataset.attempts):
        if built is None or not rest:
            return
        shares = _attempt(configuration, rest, built, count, on_frame, packers)
        share = max(shares)
        rest = [o for o in rest if o.failure]
        if rest and attempt + 1 < dataset.attempts:
            for outcome in rest:
                outcome.failure = ""
            built = _built(configuration, rest, device)
            count = _of_next(count, first * 2 ** (attempt + 1), share, attempt + 2 == dataset.attempts)


def _of_next(count: int, most: int, share: float, is_last: bool) -> int:
    """Substeps per frame of the next attempt: those that the limit of the failed scenes needs, or `most`, if these
    are fewer or it is the last attempt.

    Args:
        count: substeps per frame of the previous attempt, at most half of `most`.
        share: largest share of the limit that its time step had.
    """
    return most if is_last or not share < math.inf else min(max(math.ceil(count * share / AGAIN), count + 1), most)


def _substeps(
    configuration: Configuration, drawn: Drawn, built: Built, device: torch.device
) -> tuple[int, Built | None]:
    """Substeps per frame of the first attempt, and the batch without scenes that need too many."""
    words = configuration.words
    needed = batch.substeps(built, configuration.dataset.interval, float(words.get("cfl", 0.5)), words.get("dt"))
    most = batch.MOST_SUBSTEPS
    for outcome, count in zip(drawn.alive, needed, strict=True):
        if not count <= most:
            outcome.failure = f"a frame needs {count:.3g} substeps, more than {most}"
    possible = [count for count in needed if count <= most]
    if len(possible) < len(needed):
        return int(max(possible, default=1)), _built(configuration, drawn.outcomes, device)
    return int(max(possible)), built


def _attempt(
    configuration: Configuration, outcomes: list[Outcome], built: Built, count: int, on_frame: OnFrame | None,
    packers: Executor | None,
) -> list[float]:  # fmt: skip
    """Simulate scenes and store the arrays of valid ones; returns the shares of `batch.Simulated`."""
    dataset, statics = configuration.dataset, built.statics()
    names = ("position", *dataset.fields)

    def report_frame(frame: int) -> None:
        if on_frame is not None:
            on_frame(len(outcomes), frame)

    packed, behind = [packers is not None] * len(outcomes), [o.behind for o in outcomes]
    try:
        stored, failures, shares = batch.simulate(
            built, names, dataset.frames, dataset.interval, count, report_frame, packers, packed, behind
        )
    except torch.OutOfMemoryError as error:
        raise SimulationError(
            f"the device has no memory for {len(outcomes)} scenes at once; make dataset.scenes_per_shard smaller"
        ) from error
    ends = np.cumsum([0, *batch.particles_of(built)])
    for index, (outcome, failure) in enumerate(zip(outcomes, failures, strict=True)):
        outcome.attempts, outcome.failure = outcome.attempts + 1, failure
        outcome.dt, outcome.substeps = dataset.interval / count, count
        if not failure:
            rows = slice(ends[index], ends[index + 1])
            own = {name: statics[name][rows].numpy() for name in ("mass", "volume", "material")}
            _complete(configuration, outcome, stored[index], own, built, index)
    return shares


def _parameters(
    configuration: Configuration, materials: list[dict[str, Any]], number: npt.NDArray[Any]
) -> dict[str, Array]:
    """Parameters [N] that differ between scenes, zero for particles of materials without a parameter of that name."""
    arrays = {}
    for name in configuration.drawn_parameters:
        values = [m.get(name) for m in materials]
        if all(value is None or is_number(value) for value in values):
            arrays[name] = np.array([value or 0 for value in values], np.float32)[number]
    return arrays


def _complete(
    configuration: Configuration, outcome: Outcome, stored: StoredFrames, own: dict[str, Array], built: Built,
    index: int,
) -> None:  # fmt: skip
    """Store the arrays of a valid scene: fields, types, materials and masses of its particles."""
    first = [k for k, m in enumerate(built.materials) if m.scene == index]
    materials = [built.materials[k] for k in first]
    types = [configuration.particle_type(m) for m in materials]
    number = own["material"] - (first[0] if first else 0)
    outcome.materials = [
        {"name": m.name, "particle_type": code, **m.words.model_dump(mode="json", exclude_none=True)}
        for m, code in zip(materials, types, strict=True)
    ]
    outcome.packed, outcome.motion = stored.packed, stored.motion
    constant = {
        "particle_type": np.array(types, np.int8)[number],
        "material": number.astype(np.int8),
        "mass": own["mass"].astype(np.float32),
        "volume": own["volume"].astype(np.float32),
        **_parameters(configuration, outcome.materials, number),
    }
    if outcome.behind:
        constant = {name: np.concatenate([values, outcome.behind[name]]) for name, values in constant.items()}
    outcome.arrays = {**stored.arrays, **constant}


def _wants_obstacles(configuration: Configuration, outcome: Outcome) -> bool:
    """Whether the arrays of a scene include particles of obstacles."""
    return configuration.dataset.obstacles and outcome.words is not None and bool(outcome.words.get("obstacle"))
