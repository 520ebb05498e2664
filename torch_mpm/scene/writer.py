"""Frames and checkpoints: copied from the device while it computes, and written by a separate thread."""

from __future__ import annotations

import contextlib
import functools
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..data.host_copies import Copies
from ..data.trajectory import TrajectoryWriter
from ..state import state_file

CHECKPOINT_SECONDS = 1.0
"""Minimum time between two checkpoints [s]: the work that a killed run may have to recompute."""

_stream_of = functools.cache(torch.cuda.Stream)
"""Stream of a device for copies of checkpoints: only one, since torch hands out 32 streams in turn, and work of another
thread on a stream during capture would enter its graph.
"""


def _copied(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of a device in host memory: on a separate stream, so that only this thread waits."""
    device = next(iter(tensors.values())).device
    with torch.cuda.stream(_stream_of(device)) if device.type == "cuda" else contextlib.nullcontext():
        return {name: t.cpu() for name, t in tensors.items()}


@dataclass(frozen=True)
class Frame:
    """One frame: copies of its fields in id order, its scalars, and for a checkpoint its state on the device; the
    record describes the rest.
    """

    number: int
    copies: Copies
    scalars: Mapping[str, Any]
    state: Mapping[str, Tensor]
    record: dict[str, Any]


class FrameWriter:
    """Queue of frames for a trajectory and its checkpoint; at most two are queued, so that memory is bounded: frames in
    pinned memory, and their states, which stay on the device until there is a checkpoint.

    A frame is counted in the trajectory first and checkpoints are rarer, so after a kill the frames since are
    recomputed with the same bytes. A run that ends otherwise before its last frame leaves a checkpoint of its latest
    frame.
    """

    def __init__(self, trajectory: TrajectoryWriter, checkpoint_path: Path) -> None:
        self.trajectory = trajectory
        self.checkpoint_path = checkpoint_path
        self.seconds = 0.0
        self.waited = 0.0
        self._saved = time.perf_counter()
        self._unsaved: Frame | None = None  # The latest frame, where it has no checkpoint.
        self._finished = self._failed = False
        self._error: BaseException | None = None
        self._frames: queue.Queue[Frame | None] = queue.Queue(maxsize=2)
        self._thread = threading.Thread(target=self._work, name="torch_mpm frame writer", daemon=True)
        self._thread.start()

    def submit(self, frame: Frame) -> None:
        """Queue a frame.

        Raises:
            OSError: an error of an earlier frame.
        """
        begin = time.perf_counter()
        self._raise()
        self._frames.put(frame)
        self.waited += time.perf_counter() - begin

    def close(self, finished: bool = False) -> None:
        """Wait for all frames and close the trajectory; `finished` if no checkpoint is needed.

        Raises:
            OSError: an error of a frame.
        """
        begin = time.perf_counter()
        self._finished = finished
        self._frames.put(None)
        self._thread.join()
        self._unsaved = None  # Pinned memory must not outlive CUDA.
        self.trajectory.close()
        self.waited += time.perf_counter() - begin
        self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _work(self) -> None:
        while (frame := self._frames.get()) is not None:
            if not self._failed:
                self._attempt(self._write, frame)
        if self._unsaved is not None and not self._finished:
            self._attempt(self._save, self._unsaved)

    def _attempt(self, action: Callable[[Frame], None], frame: Frame) -> None:
        """Action whose error is raised by the next call of the main thread."""
        begin = time.perf_counter()
        try:
            action(frame)
        except BaseException as error:
            self._error, self._failed = error, True
        self.seconds += time.perf_counter() - begin

    def _write(self, frame: Frame) -> None:
        values = frame.copies.arrays() | {k: np.asarray(v) for k, v in frame.scalars.items()}
        self.trajectory.write(frame.number, values)
        self._unsaved = frame
        if time.perf_counter() - self._saved >= CHECKPOINT_SECONDS:
            self._save(frame)

    def _save(self, frame: Frame) -> None:
        with contextlib.suppress(torch.AcceleratorError):  # Its state is lost, and the run fails with it.
            state_file.save(self.checkpoint_path, _copied(frame.state), frame.record)
        self._saved, self._unsaved = time.perf_counter(), None
