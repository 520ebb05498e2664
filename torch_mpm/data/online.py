"""Training windows of scenes that are simulated on demand, and never written to a disk."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from ..errors import SimulationError, check_count
from .stoppable import StoppableExecutor
from .windows import Collate, Item, pack, rank_and_world

Simulated = dict[str, Tensor]
"""Scene: ``position`` and other fields [T, N, ...], and constants [N]."""
Simulate = Callable[[Sequence[int]], Sequence["Simulated | None"]]
"""Function that simulates the scenes of some ids together, on any device; None for a failed scene."""
MOST_FAILED_ROUNDS = 3
ARGUMENTS = ("batch_size", "scenes", "frames", "passes", "first", "seed", "world")
"""Attributes that determine the following state."""


class OnlineStream(IterableDataset[Item]):
    """Endless batches of windows, of new scenes in every round.

    A round is a set of scenes that are simulated together; while the model trains on its windows, in random order, the
    next round is simulated, on CUDA on a separate stream. The batches are those of a `WindowStream`, on the device of
    the simulation. Everything depends on the seed and the scene ids only:

        stream = OnlineStream(simulator(configuration, "cuda"), batch_size=8, scenes=64)
        for batch in stream:
            ...

    Args:
        simulate: function that simulates the scenes of some ids: :func:`torch_mpm.data.simulator`, or a user function.
        batch_size: windows of a batch; an incomplete batch of a round is dropped.
        scenes: scenes of a round.
        frames: T of a window.
        device: device of the simulation; its thread works there, on CUDA on a separate stream.
        passes: number of passes through the windows of a round.
        first: id of the first scene, beyond those of the test data.
        seed: seed of the order.
        ahead: rounds that are simulated ahead; 0 simulates on demand.
        collate: `pack`, `pad`, or a user function of a list of items.
        rank, world: rank and number of the training processes; those of torch.distributed by default.

    Raises:
        SimulationError: where three consecutive rounds had no batch because of failed scenes.
        ValueError: for a round without a batch, or an invalid rank.

    It uses a separate thread instead of workers; in a worker of a data loader it raises RuntimeError.
    """

    def __init__(
        self,
        simulate: Simulate,
        batch_size: int,
        *,
        scenes: int = 16,
        frames: int = 7,
        device: torch.device | str = "cpu",
        passes: int = 1,
        first: int = 0,
        seed: int = 0,
        ahead: int = 1,
        collate: Collate = pack,
        rank: int | None = None,
        world: int | None = None,
    ) -> None:
        here, of = rank_and_world()
        self.simulate, self.collate, self.seed, self.device = simulate, collate, seed, torch.device(device)
        self.batch_size, self.scenes = check_count("batch_size", batch_size, 1), check_count("scenes", scenes, 1)
        self.frames, self.passes = check_count("frames", frames, 1), check_count("passes", passes, 1)
        self.first, self.ahead = check_count("first", first), check_count("ahead", ahead)
        self.rank, self.world = here if rank is None else rank, of if world is None else world
        if not 0 <= self.rank < self.world:
            raise ValueError(f"rank must be within 0 and {self.world - 1}, got {self.rank}")
        self.round, self.taken = 0, 0

    def scene_ids(self, number: int) -> range:
        """Ids of the scenes of round ``number`` of this rank."""
        begin = self.first + (number * self.world + self.rank) * self.scenes
        return range(begin, begin + self.scenes)

    def __iter__(self) -> Iterator[Item]:
        if get_worker_info() is not None:
            raise RuntimeError("OnlineStream must be used without workers of a data loader; it has a thread of its own")
        failed = 0
        stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        with StoppableExecutor("torch_mpm online") as executor:
            rounds: deque[Future[_Round]] = deque()
            try:
                while True:
                    while len(rounds) <= self.ahead:
                        rounds.append(executor.submit(self._simulated, self.round + len(rounds), stream))
                    made = rounds.popleft().result()
                    places = self._places(made.scenes)
                    failed = 0 if places else failed + 1
                    if failed == MOST_FAILED_ROUNDS:
                        raise SimulationError(
                            f"too many scenes have failed in {failed} rounds for a batch of each, up to {made.ids[-1]}"
                        )
                    if places:
                        yield from self._batches(made.arrived(), places)
                    self.round, self.taken = self.round + 1, 0
            finally:
                executor.stop()

    def state_dict(self) -> dict[str, int]:
        """Position of this stream; the round is simulated again after `load_state_dict`."""
        return {"round": self.round, "taken": self.taken, **{name: getattr(self, name) for name in ARGUMENTS}}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continue at the position of another stream with the same arguments.

        Raises:
            ValueError: for a stream with other arguments.
        """
        for name in ARGUMENTS:
            if state[name] != getattr(self, name):
                raise ValueError(f"state is of a stream with {name} {state[name]}, got {getattr(self, name)}")
        self.round, self.taken = check_count("round", state["round"]), check_count("taken", state["taken"])

    def _simulated(self, number: int, stream: torch.cuda.Stream | None) -> _Round:
        """Simulate a round, in the thread of the simulation."""
        ids = self.scene_ids(number)
        if stream is None:
            return _Round(ids, _good(ids, self.simulate(ids)), None)
        with torch.cuda.device(self.device), torch.cuda.stream(stream):
            scenes = _good(ids, self.simulate(ids))
            ready = torch.cuda.Event()
            ready.record()
        return _Round(ids, scenes, ready)

    def _places(self, scenes: dict[int, Simulated]) -> list[tuple[int, int]]:
        """Scene and first frame of all windows of a round; none where failed scenes leave too few for a batch.

        Raises:
            ValueError: where no scene has failed, and there are too few all the same.
        """
        places = []
        for number, scene in scenes.items():
            length = len(scene["position"])
            if length < self.frames:
                raise ValueError(f"frames must be at most {length}, those of a scene, got {self.frames}")
            places += [(number, first) for first in range(length - self.frames + 1)]
        windows = self.passes * len(places)
        if windows < self.batch_size and len(scenes) == self.scenes:
            raise ValueError(f"batch_size must be at most {windows}, the windows of a round, got {self.batch_size}")
        return places if windows >= self.batch_size else []

    def _batches(self, scenes: dict[int, Simulated], places: list[tuple[int, int]]) -> Iterator[Item]:
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([self.seed, self.rank, self.round])))
        order = np.concatenate([rng.permutation(len(places)) for _ in range(self.passes)])
        count = len(order) // self.batch_size
        for number in range(self.taken, count):
            chosen = order[number * self.batch_size : (number + 1) * self.batch_size]
            batch = self.collate([self._item(scenes, *places[k]) for k in chosen])
            self.taken = number + 1
            yield batch

    def _item(self, scenes: dict[int, Simulated], number: int, first: int) -> Item:
        scene = scenes[number]
        length = len(scene["position"])
        item = {
            name: value[first : first + self.frames].transpose(0, 1) if _is_field(value, length) else value
            for name, value in scene.items()
        }
        return item | {"scene_id": torch.tensor(number), "first": torch.tensor(first)}


def _is_field(value: Tensor, length: int) -> bool:
    return value.dim() > 1 and len(value) == length


@dataclass(frozen=True)
class _Round:
    """Scenes by their ids; on CUDA ``ready`` is recorded after the work of the simulation."""

    ids: Sequence[int]
    scenes: dict[int, Simulated]
    ready: Any

    def arrived(self) -> dict[int, Simulated]:
        """Scenes for the current stream of the caller, which waits for them; the host does not."""
        values = [value for scene in self.scenes.values() for value in scene.values() if value.is_cuda]
        if self.ready is not None and values:
            stream = torch.cuda.current_stream(values[0].device)
            stream.wait_event(self.ready)
            for value in values:
                value.record_stream(stream)
        return self.scenes


def _good(ids: Sequence[int], scenes: Sequence[Simulated | None]) -> dict[int, Simulated]:
    return {number: scene for number, scene in zip(ids, scenes, strict=True) if scene is not None}
