"""Rollouts without gradients from CUDA graphs: the host launches a step of many small kernels once, and replays it."""

from __future__ import annotations

import collections
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..state.state import State, tensors_of
from .memory import GraphMemory

PIECE, PIECES, LEAST_PARTICLES = 2**25, 4, 2**13
"""Work of a piece, as particles times steps; number of pieces in flight; number of particles below which the time of a
step does not decrease (csrc/common/signals.op.cpp)."""


class WorkInFlight:
    """Bound on the launched work that the device has not done yet: a fraction of a second. Launched graphs cannot be
    interrupted, so the next wait for the device would delay a signal by that time.

    Args:
        x: the positions of the particles.
        steps: number of steps of a graph.
    """

    def __init__(self, x: Tensor, steps: int = 1) -> None:
        self._launches = max(PIECE // (max(len(x), LEAST_PARTICLES) * steps), 1)
        self._since, self._marks = 0, collections.deque[torch.cuda.Event]()

    def launched(self) -> None:
        """After a launch on the current stream: wait where too much is in flight."""
        self._since += 1
        if self._since < self._launches:
            return
        self._since = 0
        mark = torch.cuda.Event()
        mark.record()
        self._marks.append(mark)
        if len(self._marks) > PIECES:
            self._marks.popleft().synchronize()


class Replays:
    """A CUDA graph of a function state -> state, of one step or several, which updates its state in place.

    Args:
        function: the function; it must not wait for the device.
        state: the state before the first replay; `Replays.state` is that after the last one.
        blocks: number of blocks of the pool of its activations.
    """

    def __init__(self, function: Callable[[State], State], state: State, blocks: int) -> None:
        self.blocks = blocks
        self.state = state.map(copied)
        impulse = None if state.impulse is None else copied(state.impulse)
        self.state = self.state.replace(material=state.material, scene=state.scene, ids=state.ids, impulse=impulse)
        self._graph, self._memory = torch.cuda.CUDAGraph(), GraphMemory(state.x.device, waits=False)
        with self._memory.capturing(self._graph):
            self._capture(function)

    def _capture(self, function: Callable[[State], State]) -> None:
        before, after = tensors_of(self.state), tensors_of(function(self.state))
        changed = [name for name, value in after.items() if value is not before[name]]
        copy_all([before[name] for name in changed], [after[name] for name in changed])

    def replay(self, times: int, in_flight: WorkInFlight) -> None:
        for _ in range(times):
            self._graph.replay()
            in_flight.launched()


def copy_all(to: Sequence[Tensor], of: Sequence[Tensor]) -> None:
    """Copy tensors, those of one dtype in one kernel."""
    for dtype in {t.dtype for t in to}:
        alike = [k for k, t in enumerate(to) if t.dtype == dtype]
        torch._foreach_copy_([to[k] for k in alike], [of[k] for k in alike])


def copied(t: Tensor) -> Tensor:
    """A copy with the strides of a tensor, gaps included, which `clone` closes."""
    if 0 in t.stride():  # entries that are one
        return t.clone()
    return torch.empty_strided(t.shape, t.stride(), dtype=t.dtype, device=t.device).copy_(t)


def time_tensor(state: State) -> Tensor:
    if isinstance(state.time, Tensor):
        return state.time
    return torch.full((), state.time, dtype=torch.float64, device=state.x.device)
