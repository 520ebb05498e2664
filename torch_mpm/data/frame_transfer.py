"""Transfer of the frames of a batch to host memory, as arrays or packed, while the device computes the next ones."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from .packing import Compressed, Packing
from .statistics import Motion, MotionSums

Array = npt.NDArray[Any]
SLAB_BYTES = 2**27
"""Approximate size of the frames that are copied from a device at once."""
LEAST_SLABS = 8
"""The same where arrays are packed: the last slab arrives after the end of the simulation, and should be a small
part.
"""
TASKS = 24
"""Number of parts of a slab for the threads of an executor: few, since each needs Python's lock."""


@dataclass(frozen=True)
class StoredFrames:
    """Fields [T, N, ...] of a scene, float32, each as an array or packed, and in the latter case sums of its motion."""

    arrays: dict[str, Array]
    packed: dict[str, Compressed]
    motion: Motion | None


@dataclass(frozen=True)
class _Slab:
    """Some frames in host memory; `ready` is recorded after their copies from a device."""

    first: int
    values: dict[str, Tensor]
    ready: torch.cuda.Event | None


class FrameTransfer:
    """Fields [T, N, ...] in float32 of each scene of a batch, filled frame by frame.

    On CUDA, and with an executor, frames are collected in slabs; on CUDA a separate stream copies these to pinned
    memory. A thread processes them, so that neither the device nor the host waits.

    Args:
        frames: T.
        particles: N of each scene; particles are ordered by scene.
        shapes: shape per particle of each field by name, including ``position``.
        device: device of the values.
        executor: its threads separate slabs, scene by scene; without one a single thread does.
        packed: whether each scene is packed during the transfer, in place; by default none is.
        behind: fields [T, n, ...] of additional particles of each scene, which are not part of sums.
    """

    def __init__(
        self,
        frames: int,
        particles: Sequence[int],
        shapes: Mapping[str, tuple[int, ...]],
        device: torch.device,
        executor: Executor | None = None,
        packed: Sequence[bool] | None = None,
        behind: Sequence[Mapping[str, Array]] | None = None,
    ) -> None:
        self._arrays: list[dict[str, Array]] = []
        self._packings: list[dict[str, Packing]] = []
        self._behind = behind or [{}] * len(particles)
        for own, wanted, others in zip(particles, packed or [False] * len(particles), self._behind, strict=True):
            count = own + (others["position"].shape[1] if others else 0)
            whole: dict[str, tuple[int, ...]] = {name: (frames, count, *shape) for name, shape in shapes.items()}
            begun = {name: Packing(shape, np.float32) for name, shape in whole.items() if wanted and 0 not in shape}
            self._packings.append(begun)
            self._arrays.append({name: np.empty(v, np.float32) for name, v in whole.items() if name not in begun})
        self._motion = MotionSums() if any(packed or ()) else None
        self._ends = np.cumsum([0, *particles]).tolist()
        self._shapes, self._device, self._executor = shapes, device, executor
        row = sum(4 * self._ends[-1] * math.prod(shape) for shape in shapes.values())
        most = -(-frames // LEAST_SLABS) if any(packed or ()) else frames
        self._slab_frames = max(1, min(most, SLAB_BYTES // max(row, 1)))
        self._count = 0
        self._slab: dict[str, Tensor] = {}
        self._error: BaseException | None = None
        self._abandoned = False
        self._thread: threading.Thread | None = None
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        if self._stream is not None or executor is not None:
            self._jobs: queue.Queue[_Slab | None] = queue.Queue(maxsize=2)
            self._thread = threading.Thread(target=self._work, name="torch_mpm frames", daemon=True)
            self._thread.start()

    def put(self, values: Mapping[str, Tensor]) -> None:
        """Add the next frame: fields [P, ...] of the particles of all scenes, scene by scene."""
        if self._motion is not None:
            self._motion.add(values["position"])
        if self._thread is None:
            self._take(self._count, {name: value.numpy()[None] for name, value in values.items()})
            self._count += 1
            return
        place = self._count % self._slab_frames
        if place == 0:
            rows = (self._slab_frames, self._ends[-1])
            self._slab = {
                name: torch.empty(*rows, *shape, dtype=torch.float32, device=self._device)
                for name, shape in self._shapes.items()
            }
        for name, value in values.items():
            self._slab[name][place].copy_(value)
        self._count += 1
        if place == self._slab_frames - 1:
            self._send()

    def finish(self) -> list[StoredFrames]:
        """Wait for all frames; returns the data of each scene.

        Raises:
            Exceptions of the transfer.
        """
        if self._thread is not None:
            if self._slab:
                self._send()
            self._jobs.put(None)
            self._thread.join()
            if self._error is not None:
                raise self._error
        motions = [None] * len(self._arrays) if self._motion is None else self._motion.of_scenes(self._ends)
        return [
            StoredFrames(arrays, {name: packing.finish() for name, packing in packings.items()}, motion)
            for arrays, packings, motion in zip(self._arrays, self._packings, motions, strict=True)
        ]

    def abandon(self) -> None:
        """End the thread without waiting for results."""
        self._abandoned = True
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join()

    def _send(self) -> None:
        """Pass on the slab, from a device after its present work."""
        count = (self._count - 1) % self._slab_frames + 1
        if self._stream is None:
            slab = _Slab(self._count - count, {name: slab[:count] for name, slab in self._slab.items()}, None)
        else:
            slab = self._copied(count, self._stream)
        self._jobs.put(slab)
        self._slab = {}

    def _copied(self, count: int, stream: torch.cuda.Stream) -> _Slab:
        """Copies of some frames in pinned memory."""
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            host = {}
            for name, slab in self._slab.items():
                slab.record_stream(stream)
                pinned = torch.empty((count, *slab.shape[1:]), dtype=slab.dtype, device="cpu", pin_memory=True)
                host[name] = pinned.copy_(slab[:count], non_blocking=True)
            ready = torch.cuda.Event()
            ready.record(stream)
        return _Slab(self._count - count, host, ready)

    def _work(self) -> None:
        while (slab := self._jobs.get()) is not None:
            if self._error is not None or self._abandoned:
                continue  # The rest is discarded, but the producer must not wait.
            try:
                if slab.ready is not None:
                    slab.ready.synchronize()
                self._take(slab.first, {name: value.numpy() for name, value in slab.values.items()})
            except BaseException as error:
                self._error = error

    def _take(self, first: int, values: Mapping[str, Array]) -> None:
        """Add the next frames of all scenes. Returns when all are done, so that those of a scene arrive in order."""

        def take(scenes: Iterable[int]) -> None:
            for k in scenes:
                for name, rows in values.items():
                    own = rows[:, self._ends[k] : self._ends[k + 1]]
                    if self._behind[k]:
                        own = np.concatenate([own, self._behind[k][name][first : first + len(rows)]], axis=1)
                    if name in self._packings[k]:
                        self._packings[k][name].append(own)
                    else:
                        self._arrays[k][name][first : first + len(rows)] = own

        count = len(self._arrays)
        if self._executor is None:
            take(range(count))
        else:
            for _ in self._executor.map(take, [range(k, count, TASKS) for k in range(min(count, TASKS))]):
                pass  # Errors are raised here.
