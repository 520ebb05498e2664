"""Streams on which CUDA graphs are captured, and the memory that graphs share."""

from __future__ import annotations

import collections
import contextlib
import threading
import weakref
from collections.abc import Iterator

import torch

from .capture import capturing

Replayed = int | None
"""The stream on which all graphs that share memory are replayed; None for any stream."""


class _Captures(threading.local):
    """Streams and memory of the graphs of a thread, for each device and stream of replays.

    Attributes:
        streams: the stream on which graphs are captured. It is always the same: libraries allocate memory per stream,
            and the memory of graphs is reused within a stream only.
        unused: graphs that are no longer replayed; each holds memory for later graphs.
    """

    def __init__(self) -> None:
        self.streams: dict[tuple[torch.device, Replayed], torch.cuda.Stream] = {}
        self.unused: dict[tuple[torch.device, Replayed], list[torch.cuda.CUDAGraph]] = collections.defaultdict(list)


_CAPTURES = _Captures()


class GraphMemory:
    """Memory shared by graphs, reused from destroyed graphs if possible.

    The allocator does not free the memory of a destroyed graph for other processes until it runs short. Therefore the
    last user of the memory stores one graph, and the next capture reuses its memory.

    Args:
        device: the device.
        waits: whether a capture waits for the device. Replays may then run on any stream; otherwise all run on the
            current one, in their order.
    """

    def __init__(self, device: torch.device, waits: bool) -> None:
        self._device, self._waits = device, waits
        self._replayed: Replayed = None if waits else torch.cuda.current_stream(device).cuda_stream
        self._unused = _CAPTURES.unused[device, self._replayed]
        self._owner: torch.cuda.CUDAGraph | None = None
        if self._unused:
            self._own(self._unused.pop())

    def _own(self, graph: torch.cuda.CUDAGraph) -> None:
        """Store the graph that holds the memory, unless there is one."""
        if self._owner is None:
            self._owner = graph
            weakref.finalize(self, self._unused.append, graph).atexit = False

    @contextlib.contextmanager
    def capturing(self, graph: torch.cuda.CUDAGraph) -> Iterator[None]:
        """Context whose operations are captured in an empty graph with this memory."""
        if self._waits:
            torch.cuda.synchronize(self._device)
        memory = None if self._owner is None else self._owner.pool()
        with on_own_stream(self._device, self._replayed), capturing(graph, memory, self._device):
            yield
        self._own(graph)


@contextlib.contextmanager
def on_own_stream(device: torch.device, replayed: Replayed = None) -> Iterator[None]:
    """The stream of captures as the current one, in order with the work before and after.

    The current stream waits on every exit, exceptions included. Otherwise memory of its tensors, freed at the exit,
    could be reused while kernels of the other stream still read it.
    """
    now, streams = torch.cuda.current_stream(device), _CAPTURES.streams
    if (device, replayed) not in streams:
        streams[device, replayed] = torch.cuda.Stream(device)
    stream = streams[device, replayed]
    stream.wait_stream(now)
    try:
        with torch.cuda.stream(stream):
            yield
    finally:
        now.wait_stream(stream)
