"""Frames of a batch on their way to arrays in host memory, while the device computes the next ones."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array = npt.NDArray[Any]
SLAB_BYTES = 2**27
"""Of the frames that are copied from a device at once, about."""


@dataclass(frozen=True)
class _Slab:
    """Some frames in pinned memory; `ready` comes behind their copies."""

    first: int
    values: dict[str, Tensor]
    ready: torch.cuda.Event


class Recording:
    """Arrays [T, N, ...] in float32 of each scene of a batch, filled frame by frame.

    On CUDA, frames are gathered in slabs and copied to pinned memory by a stream of their own; a thread takes them from
    there, so that neither the device nor the host waits.

    Args:
        frames: T.
        particles: N of each scene, whose particles follow one another.
        shapes: of a field the shape per particle, by name.
        device: of the values.
    """

    def __init__(
        self, frames: int, particles: Sequence[int], shapes: Mapping[str, tuple[int, ...]], device: torch.device
    ) -> None:
        self.arrays = [
            {name: np.empty((frames, count, *shape), np.float32) for name, shape in shapes.items()}
            for count in particles
        ]
        self._ends = np.cumsum([0, *particles]).tolist()
        self._shapes, self._device = shapes, device
        row = sum(4 * self._ends[-1] * math.prod(shape) for shape in shapes.values())
        self._slab_frames = max(1, min(frames, SLAB_BYTES // max(row, 1)))
        self._count = 0
        self._slab: dict[str, Tensor] = {}
        self._error: BaseException | None = None
        self._thread: threading.Thread | None = None
        if device.type == "cuda":
            self._stream = torch.cuda.Stream(device)
            self._jobs: queue.Queue[_Slab | None] = queue.Queue(maxsize=2)
            self._thread = threading.Thread(target=self._work, name="torch_mpm recording", daemon=True)
            self._thread.start()

    def put(self, values: Mapping[str, Tensor]) -> None:
        """The next frame: fields [P, ...] of the particles of all scenes, scene by scene."""
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

    def finish(self) -> list[dict[str, Array]]:
        """Wait for all frames; returns the arrays of each scene.

        Raises:
            what went wrong on the way.
        """
        if self._thread is not None:
            if self._slab:
                self._send()
            self._jobs.put(None)
            self._thread.join()
            if self._error is not None:
                raise self._error
        return self.arrays

    def abandon(self) -> None:
        """End the thread without waiting for what is right."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join()

    def _send(self) -> None:
        """Copy the slab to pinned memory behind what the device is doing."""
        count = (self._count - 1) % self._slab_frames + 1
        self._stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(self._stream):
            host = {}
            for name, slab in self._slab.items():
                slab.record_stream(self._stream)
                pinned = torch.empty((count, *slab.shape[1:]), dtype=slab.dtype, device="cpu", pin_memory=True)
                host[name] = pinned.copy_(slab[:count], non_blocking=True)
            ready = torch.cuda.Event()
            ready.record(self._stream)
        self._jobs.put(_Slab(self._count - count, host, ready))
        self._slab = {}

    def _work(self) -> None:
        while (slab := self._jobs.get()) is not None:
            try:
                slab.ready.synchronize()
                self._take(slab.first, {name: value.numpy() for name, value in slab.values.items()})
            except BaseException as error:
                self._error = self._error or error

    def _take(self, first: int, values: Mapping[str, Array]) -> None:
        for name, rows in values.items():
            for k, arrays in enumerate(self.arrays):
                arrays[name][first : first + len(rows)] = rows[:, self._ends[k] : self._ends[k + 1]]
