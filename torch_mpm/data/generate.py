"""Generation of data sets: shards are drawn, simulated and written concurrently.

The content of a shard depends on the configuration and the number of the shard only: its scenes are always simulated
together, with one time step, in any process and order. (On GPUs this is exact where ``grid.deterministic`` is set.)
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..scene import SceneError, check
from ..scene.run import versions
from .claim import Claim, output_errors
from .configuration import Configuration
from .content_checks import LISTS
from .distribution import narrowed
from .folder import DatasetRecord
from .packing import PreparedScene, prepare_scene
from .sampling import NoRoom, content
from .shard import shard_path
from .shard_simulation import Drawn, Outcome, draw, simulate
from .shard_writer import Attributes, ShardWriter
from .stoppable import StoppableExecutor
from .workers import take_device, worker

MOST_PACKERS = 6
"""Threads that compress: enough for one GPU, and more take Python's lock from the one that simulates."""
WRITING_SECONDS = 0.7
"""Time limit for writing a shard when generation ends early [s]; a shard that takes longer is simulated again later."""
Progress = Callable[[dict[str, Any]], None]


def generate(
    configuration: Configuration,
    out: str | Path,
    *,
    device: str = "auto",
    check: bool = False,
    progress: Progress | None = None,
    extend: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Generate the missing parts of a data set, together with other processes.

    Args:
        configuration: the configuration.
        out: folder, created where it does not exist.
        device: "auto", "cpu", "cuda" or "cuda:1"; see `torch_mpm.data.workers.take_device`.
        check: compare existing shards with their checksums, and regenerate damaged ones.
        progress: called with a dictionary of numbers while frames are computed: scenes and failed scenes so far, frames
            of all scenes so far, and frames that were missing at the start.
        extend: total number of scenes by the name of a split, to extend the folder. New scenes have separate ids and
            shards; existing scenes are unchanged.

    Returns:
        A summary: scenes, failed scenes and seconds of this process; and whether the data set is complete.

    Raises:
        WorkerError: for a process without a device or a valid rank.
        SceneError: for a configuration without possible scenes.
        MissingError, DatasetError: for `extend` with an unknown split, or with fewer scenes than there are.
        OutputError: for a folder with other content, or a full disk.
        SimulationError: where the device memory is insufficient for the scenes of a shard.
    """
    begin, one = time.perf_counter(), worker()
    chosen = take_device(device, one)
    check_samples(configuration)
    folder = Path(out)
    record = record_of(configuration, chosen)
    with Claim(folder, record, configuration.text, one, extend) as claim:
        line = _Line(configuration, claim, chosen, progress)
        with output_errors(folder):
            line.run(check)
        complete = len(claim.finished()) == claim.record.shards
    return {**line.totals, "seconds": time.perf_counter() - begin, "complete": complete}


def check_samples(configuration: Configuration, count: int = 3) -> None:
    """Draw one scene for each entry of each choice, and the first scenes.

    Raises:
        SceneError: for entries of choices without possible scenes, and where all of the first scenes are invalid or
            have no space for their bodies; otherwise only the affected scenes fail.
    """
    once = {key: [{**item, "count": 1} for item in configuration.words.get(key, [])] for key in LISTS}
    entries = narrowed({**configuration.words, **once})  # With bodies that few scenes have.
    found = {key: _problems(replace(configuration, words=words), 0, room=False) for key, words in entries}
    if any(found.values()):
        raise SceneError(_lines_of(found), configuration.source)
    found = {f"scene {k}": _problems(configuration, k) for k in range(min(count, configuration.scenes))}
    if all(found.values()):
        raise SceneError(_lines_of(found), configuration.source)


def _problems(configuration: Configuration, scene_id: int, room: bool = True) -> list[str]:
    """Problem of a scene; with `room` also a lack of space."""
    try:
        scene = configuration.scene(content(configuration, scene_id))
        return check.problems(scene, scene.entries())
    except NoRoom as error:
        return [str(error).removeprefix(f"scene {scene_id}: ")] if room else []
    except SceneError as error:
        return error.problems


def _lines_of(found: Mapping[str, Sequence[str]]) -> list[str]:
    """Lines for the problems of several scenes: one line for a common problem, otherwise one per scene."""
    lines: dict[str, None] = {}
    for place, problems in found.items():
        for problem in problems:
            everywhere = len(found) > 1 and all(problem in others for others in found.values())
            lines[problem if everywhere else f"{place}: {problem}"] = None
    return list(lines)


def record_of(configuration: Configuration, device: torch.device) -> DatasetRecord:
    """Record of a data set for dataset.json.

    Raises:
        SceneError: for numbers that no reader accepts.
    """
    dataset, grid = configuration.dataset, configuration.words["grid"]
    record = DatasetRecord(
        configuration=configuration.hash,
        seed=dataset.seed,
        splits=configuration.splits,
        scenes_per_shard=dataset.scenes_per_shard,
        frames=dataset.frames,
        frame_interval=dataset.interval,
        lower=tuple(map(float, grid["lower"])),
        upper=tuple(map(float, grid["upper"])),
        dx=float(grid["dx"]),
        fields=("position", *dataset.fields),
        title=configuration.words.get("title", ""),
        device=device.type,
        versions={**versions(), "numpy": np.__version__},
    )
    if problem := record.problem():
        raise SceneError([f"dataset: {problem}"], configuration.source)
    return record


class _Line:
    """Pipeline in which one shard is drawn, one simulated and one written at a time, each by a separate thread."""

    def __init__(
        self, configuration: Configuration, claim: Claim, device: torch.device, progress: Progress | None
    ) -> None:
        self.configuration, self.claim, self.device, self.progress = configuration, claim, device, progress
        self.totals: dict[str, Any] = {"scenes": 0, "failed": 0, "simulating": 0.0, "waiting": 0.0}
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._written: Future[None] | None = None
        self._missing = claim.record.scenes - claim.finished_scenes()

    def run(self, check: bool) -> None:
        """All shards that no other process generates."""
        with ExitStack() as stack:
            self._drawer, self._writer = (
                stack.enter_context(StoppableExecutor()),
                stack.enter_context(ThreadPoolExecutor(1)),
            )
            self._packers = stack.enter_context(ThreadPoolExecutor(min(len(os.sched_getaffinity(0)), MOST_PACKERS)))
            stack.callback(self._stop)
            beside = None if self.device.type == "cpu" else self._packers  # a CPU simulates with all its cores
            shards = self.claim.unfinished(check)
            coming: tuple[int, Future[Drawn]] | None = self._next(shards)
            while coming is not None:
                shard, drawn = coming[0], self._wait(coming[1])
                coming = self._next(shards)
                begin = time.perf_counter()
                simulate(self.configuration, drawn, self.device, self._tell, beside)
                self.totals["simulating"] += time.perf_counter() - begin
                if self._written is not None:
                    self._wait(self._written)
                self.totals["scenes"] += len(drawn.outcomes)
                self.totals["failed"] += sum(bool(o.failure) for o in drawn.outcomes)
                self._written = self._writer.submit(self._write, shard, drawn.outcomes)
                del drawn
            if self._written is not None:
                self._wait(self._written)

    def _stop(self) -> None:
        """Stop drawing and packing after an error or a signal. A shard that is written in time is kept."""
        self._drawer.stop()
        if self._written is not None:
            wait([self._written], WRITING_SECONDS)
        self._packers.shutdown(wait=False, cancel_futures=True)

    def _wait(self, future: Future[Any]) -> Any:
        begin = time.perf_counter()
        result = future.result()
        self.totals["waiting"] += time.perf_counter() - begin
        return result

    def _next(self, shards: Iterator[int]) -> tuple[int, Future[Drawn]] | None:
        shard = next(shards, None)
        return None if shard is None else (shard, self._drawer.submit(self._draw, shard))

    def _draw(self, shard: int) -> Drawn:
        """Concurrent with the work of the device, on a separate stream."""
        ids = self.claim.record.ids(shard)
        if self.device.type == "cpu":
            return draw(self.configuration, ids, self.device)
        torch.cuda.set_device(self.device)
        assert self._stream is not None
        with torch.cuda.stream(self._stream):
            drawn = draw(self.configuration, ids, self.device)
        self._stream.synchronize()
        return drawn

    def _tell(self, scenes: int, frame: int) -> None:
        if self.progress is not None:
            every = self.configuration.dataset.frames
            done = self.totals["scenes"] * every + scenes * (frame + 1)
            self.progress({**self.totals, "frames": done, "missing": self._missing * every})

    # -- writing

    def _write(self, shard: int, outcomes: list[Outcome]) -> None:
        """Compress the scenes of a shard and write it, concurrently with the work of the device."""
        path = shard_path(self.claim.folder, shard)
        whole: Attributes = {"shard": shard, "device": _device_name(self.device), **versions()}
        with output_errors(self.claim.folder), ShardWriter(path, whole, self.configuration.hash) as writer:
            for outcome, scene in zip(outcomes, self._packers.map(_prepared, outcomes), strict=True):
                writer.add(outcome.id, scene, self._attributes(outcome))
                outcome.arrays, outcome.packed, outcome.behind = {}, {}, {}
            writer.finish()
        self.claim.release(shard)

    def _attributes(self, outcome: Outcome) -> dict[str, str | int | float]:
        words = {} if outcome.words is None else self.configuration.scene_words(outcome.words)
        return {
            "seed": int(words.get("seed", -1)),
            "scene": json.dumps(words),
            "materials": json.dumps(outcome.materials),
            "dt": outcome.dt,
            "substeps_per_frame": outcome.substeps,
            "attempts": outcome.attempts,
            "valid": int(not outcome.failure),
            "failure": outcome.failure,
        }


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


def _prepared(outcome: Outcome) -> PreparedScene:
    return prepare_scene(outcome.arrays, outcome.packed, outcome.motion)
