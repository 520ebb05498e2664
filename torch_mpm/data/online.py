"""Training windows of scenes that are simulated as they are needed, and never written to a disk."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from ..errors import SimulationError, check_count
from .windows import Collate, Item, pack, rank_and_world

Simulated = dict[str, Tensor]
"""A scene: ``position`` and other fields [T, N, ...], and what does not change [N]."""
Simulate = Callable[[Sequence[int]], Sequence["Simulated | None"]]
"""Simulates the scenes of some ids together, on any device; None for a scene that failed."""
MOST_FAILED_ROUNDS = 3


class OnlineStream(IterableDataset[Item]):
    """Batches of windows, without end, of scenes that are new in every round.

    A round is some scenes that are simulated together; while its windows are trained on, in random order, the next is
    simulated, on a CUDA stream of its own where the device is one. The batches are those of a `WindowStream`, on the
    device of the simulation. Everything depends on the seed and the scene ids alone:

        stream = OnlineStream(simulator(configuration, "cuda"), batch_size=8, scenes=64)
        for batch in stream:
            ...

    Args:
        simulate: simulates the scenes of some ids: :func:`torch_mpm.data.simulator`, or a function of your own.
        batch_size: windows of a batch; what does not fill one is left out of a round.
        scenes: scenes of a round.
        frames: T of a window.
        device: of the simulation; its thread works there, on CUDA on a stream of its own.
        passes: how often the windows of a round are gone through.
        first: id of the first scene, beyond those that a model is tested with.
        seed: of the order.
        ahead: rounds that are simulated ahead; 0 simulates when the windows are wanted.
        collate: `pack`, `pad`, or a function of your own of a list of items.
        rank, world: this process among those that train together; those of torch.distributed by default.

    Raises:
        SimulationError: where all scenes of three rounds in a row have failed.
        ValueError: for a round without a batch, or a rank that is not one.

    It has a thread of its own in the place of workers; in a worker of a data loader it raises RuntimeError.
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
        with ThreadPoolExecutor(1, "torch_mpm online") as pool:
            rounds: deque[Future[_Round]] = deque()
            try:
                while True:
                    while len(rounds) <= self.ahead:
                        rounds.append(pool.submit(self._simulated, self.round + len(rounds)))
                    made = rounds.popleft().result()
                    failed = 0 if made.scenes else failed + 1
                    if failed == MOST_FAILED_ROUNDS:
                        raise SimulationError(f"all scenes of {failed} rounds have failed, up to {made.ids[-1]}")
                    if made.scenes:
                        yield from self._batches(made.arrived())
                    self.round, self.taken = self.round + 1, 0
            finally:
                pool.shutdown(cancel_futures=True)

    def state_dict(self) -> dict[str, int]:
        """Where this stream stands; the round is simulated again after `load_state_dict`."""
        return {"round": self.round, "taken": self.taken, "world": self.world}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on where another stream of the same arguments stood.

        Raises:
            ValueError: for one of another number of ranks.
        """
        if state["world"] != self.world:
            raise ValueError(f"state is of {state['world']} ranks, got {self.world}")
        self.round, self.taken = check_count("round", state["round"]), check_count("taken", state["taken"])

    def _simulated(self, number: int) -> _Round:
        """A round, in the thread of the simulation."""
        ids = self.scene_ids(number)
        if self.device.type != "cuda":
            return _Round(ids, _good(ids, self.simulate(ids)), None)
        with torch.cuda.device(self.device), torch.cuda.stream(torch.cuda.Stream(self.device)):
            scenes = _good(ids, self.simulate(ids))
            ready = torch.cuda.Event()
            ready.record()
        return _Round(ids, scenes, ready)

    def _batches(self, scenes: dict[int, Simulated]) -> Iterator[Item]:
        places = [
            (number, first)
            for number, scene in scenes.items()
            for first in range(len(scene["position"]) - self.frames + 1)
        ]
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([self.seed, self.rank, self.round])))
        order = np.concatenate([rng.permutation(len(places)) for _ in range(self.passes)])
        count = len(order) // self.batch_size
        if not count:
            raise ValueError(f"batch_size must be at most {len(order)}, the windows of a round, got {self.batch_size}")
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
    """Scenes by their ids; ``ready`` comes behind the work of the simulation on CUDA."""

    ids: Sequence[int]
    scenes: dict[int, Simulated]
    ready: Any

    def arrived(self) -> dict[int, Simulated]:
        """The scenes, for the current stream of the caller, which waits for them; the host does not."""
        values = [value for scene in self.scenes.values() for value in scene.values() if value.is_cuda]
        if self.ready is not None and values:
            stream = torch.cuda.current_stream(values[0].device)
            stream.wait_event(self.ready)
            for value in values:
                value.record_stream(stream)
        return self.scenes


def _good(ids: Sequence[int], scenes: Sequence[Simulated | None]) -> dict[int, Simulated]:
    return {number: scene for number, scene in zip(ids, scenes, strict=True) if scene is not None}
