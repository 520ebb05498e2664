"""Windows of frames for training: consecutive frames of one scene, and batches of them.

An item is a dictionary: fields [N, T, ...] of the T frames of a window, particles first, constants [N], and
``scene_id`` and ``first``, the scene and its first frame. Batches are packed, [sum N, T, ...] with ``scene`` [sum N],
or padded, [B, N, T, ...] with ``mask`` [B, N].
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from ..errors import check_count
from .folder import DatasetFolder, MissingError
from .shard import StoredScene

Item = dict[str, Tensor]
Collate = Callable[[Sequence[Item]], Item]


class WindowDataset(Dataset[Item]):
    """All windows of the valid scenes of a split, read from the files on access.

    Args:
        dataset: folder of the data set.
        split: name of the split.
        frames: T of a window, such as 7 for five velocities, the present and the next position.
        fields: arrays [frames, N, ...] of the data set to read.
        constants: arrays [N] of the scenes to read, such as "particle_type", "mass" or "friction_angle". Batches of
            `OnlineStream` have all of them.

    Raises:
        FileNotFoundError, DamagedFileError: as :class:`DatasetFolder`; the second also when damaged frames are read.
        KeyError: for an unknown split or field, or, when a window is read, for an unknown constant.
        TypeError: for fields or constants that are not a list of names.
        ValueError: for windows longer than the scenes.

    Works in workers of a data loader, forked or spawned.
    """

    def __init__(
        self,
        dataset: str | Path | DatasetFolder,
        split: str = "train",
        frames: int = 7,
        fields: Sequence[str] = ("position",),
        constants: Sequence[str] = ("particle_type",),
    ) -> None:
        self.dataset = dataset if isinstance(dataset, DatasetFolder) else DatasetFolder(dataset)
        length = self.dataset.record.frames
        if not 1 <= check_count("frames", frames) <= length:
            raise ValueError(f"frames must be within 1 and {length}, the frames of a scene, got {frames}")
        self.frames = frames
        self.fields, self.constants = _names("fields", fields), _names("constants", constants)
        for name in self.fields:
            if name not in (known := self.dataset.record.fields):
                raise MissingError(
                    f"fields must be arrays [frames, N, ...] of the data set, {', '.join(known)}, got {name!r}; "
                    "arrays [N] belong in constants"
                )
        self.scene_ids = [scene.id for scene in self.dataset.scenes(split)]
        self.windows_per_scene = length - frames + 1

    def __len__(self) -> int:
        return len(self.scene_ids) * self.windows_per_scene

    def __getitem__(self, index: int) -> Item:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index must be within {-len(self)} and {len(self) - 1}, got {index}")
        place, first = divmod(int(index) % len(self), self.windows_per_scene)
        scene = self.dataset.scene(self.scene_ids[place])
        item = {name: particles_first(scene.window(name, first, self.frames)) for name in self.fields}
        item |= {name: torch.from_numpy(_constant(scene, name)) for name in self.constants}
        return item | {"scene_id": torch.tensor(self.scene_ids[place]), "first": torch.tensor(first)}


def _names(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"{argument} must be a list of names, got {names!r}")
    return tuple(names)


def _constant(scene: StoredScene, name: str) -> Any:
    """Array [N] of a scene; MissingError for one that is missing or changes between frames."""
    if name not in scene or len(scene.shape(name)) > 1:
        known = [known for known in scene.names if len(scene.shape(known)) == 1]
        raise MissingError(f"constants must be arrays [N] of the scenes, {', '.join(known)}, got {name!r}")
    return scene[name]


def particles_first(window: Any) -> Tensor:
    """[T, N, ...] to [N, T, ...]."""
    return torch.from_numpy(window).transpose(0, 1)


# ---- batches


def pack(items: Sequence[Item]) -> Item:
    """Concatenated particles of all items: [sum N, ...], with ``scene`` int64 [sum N], the item of each particle.

    ``scene_id`` and ``first`` are [B].
    """
    counts = [_count(item) for item in items]
    scene = torch.repeat_interleave(torch.arange(len(items)), torch.tensor(counts))
    batch = {
        name: torch.stack(values) if values[0].dim() == 0 else torch.cat(values) for name, values in _columns(items)
    }
    return batch | {"scene": scene.to(_device(items[0]), non_blocking=True)}


def pad(items: Sequence[Item]) -> Item:
    """Items padded with zeros to N particles: [B, N, ...], with ``mask`` [B, N], true where a particle is.

    ``scene_id`` and ``first`` are [B].
    """
    counts = torch.tensor([_count(item) for item in items])
    most = int(counts.max())

    def padded(values: list[Tensor]) -> Tensor:
        if values[0].dim() == 0:
            return torch.stack(values)
        out = values[0].new_zeros(len(values), most, *values[0].shape[1:])
        for row, value in zip(out, values, strict=True):
            row[: len(value)] = value
        return out

    batch = {name: padded(values) for name, values in _columns(items)}
    return batch | {"mask": (torch.arange(most) < counts[:, None]).to(_device(items[0]), non_blocking=True)}


def _count(item: Item) -> int:
    return next((len(value) for value in item.values() if value.dim()), 0)


def _device(item: Item) -> torch.device:
    return next(value.device for value in item.values() if value.dim())


def _columns(items: Sequence[Item]) -> Iterator[tuple[str, list[Tensor]]]:
    return ((name, [item[name] for item in items]) for name in items[0])


# ---- order


def rank_and_world() -> tuple[int, int]:
    """Rank and number of processes of torch.distributed where it is in use; (0, 1) otherwise."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


class WindowStream(IterableDataset[Item]):
    """Endless batches of windows, epoch after epoch, in an order that depends on the seed only.

    Each rank has its share of every epoch, with the same number of batches; windows that do not fill a batch on every
    rank are dropped from that epoch. Workers share the batches of their rank, in the same order for any number of them:

        stream = WindowStream(WindowDataset("out/sand"), batch_size=8, seed=1)
        for batch in stream.loader(num_workers=2):
            ...
            torch.save(stream.state_dict(), "order.pt")  # the consumed batches, not those read ahead

    Args:
        windows: a map dataset, such as a `WindowDataset`.
        batch_size: windows of a batch.
        seed: seed of the order; None for the order of the windows.
        collate: `pack`, `pad`, or a user function of a list of items.
        rank, world: rank and number of the training processes; those of torch.distributed by default.

    Raises:
        ValueError: where there is no batch for every rank.
    """

    def __init__(
        self,
        windows: Dataset[Item],
        batch_size: int,
        *,
        seed: int | None = 0,
        collate: Collate = pack,
        rank: int | None = None,
        world: int | None = None,
    ) -> None:
        here, of = rank_and_world()
        self.windows, self.seed, self.collate = windows, seed, collate
        self.batch_size = check_count("batch_size", batch_size, 1)
        self.rank, self.world = here if rank is None else rank, of if world is None else world
        if not 0 <= self.rank < self.world:
            raise ValueError(f"rank must be within 0 and {self.world - 1}, got {self.rank}")
        self.length = len(windows)  # type: ignore[arg-type]
        self.batches_per_epoch = self.length // (batch_size * self.world)
        if not self.batches_per_epoch:
            raise ValueError(
                f"batch_size must be at most {self.length // self.world}, the windows of each rank, got {batch_size}"
            )
        self.taken = 0
        self._permutation: tuple[int, Any] = (-1, None)

    def __iter__(self) -> Iterator[Item]:
        """Batches of this worker; without workers they count as consumed."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        for number in itertools.count(self.taken + worker, workers):
            batch = self.collate([self.windows[int(k)] for k in self._indices(number)])
            if not info:
                self.taken = number + 1
            yield batch

    def loader(self, num_workers: int = 0, **options: Any) -> Iterator[Item]:
        """Batches from the first unconsumed one on, read by ``num_workers`` processes.

        ``options`` are those of `torch.utils.data.DataLoader`, such as ``pin_memory`` and ``multiprocessing_context``.
        """
        for batch in DataLoader(self, batch_size=None, num_workers=num_workers, **options):
            if num_workers:
                self.taken += 1
            yield batch

    def state_dict(self) -> dict[str, Any]:
        """Position of this stream; `load_state_dict` continues from there, with any number of workers."""
        return {"taken": self.taken, **self._order()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue at the position of another stream.

        Raises:
            ValueError: for one of another order: data, seed, size of a batch or number of ranks.
        """
        different = [name for name, value in self._order().items() if state.get(name) != value]
        if different:
            raise ValueError(f"state is of a stream with another {', '.join(different)}")
        self.taken = check_count("taken", state["taken"])

    def _order(self) -> dict[str, Any]:
        return {"seed": self.seed, "batch_size": self.batch_size, "world": self.world, "length": self.length}

    def _indices(self, number: int) -> Any:
        """Windows of batch ``number`` of this rank, counted over all epochs."""
        epoch, batch = divmod(number, self.batches_per_epoch)
        first = (batch * self.world + self.rank) * self.batch_size
        return self._epoch(epoch)[first : first + self.batch_size]

    def _epoch(self, epoch: int) -> Any:
        if self.seed is None:
            return range(self.length)
        if self._permutation[0] != epoch:
            rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([self.seed, epoch])))
            self._permutation = (epoch, rng.permutation(self.length))
        return self._permutation[1]
