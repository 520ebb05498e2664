"""CUDA graphs of steps: a step that replays update in place, and a function of tensors with its gradients."""

from __future__ import annotations

import collections
import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from ..state.state import State, tensors_of
from .memory import GraphMemory, on_own_stream

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


class Graphs:
    """A function of tensors as a CUDA graph, and its gradients as another, which read and write the same memory in each
    replay.

    Args:
        steps: the function; it must not wait for the device.
        given: its arguments.
        wanted: whether the gradient by an argument is computed, for each of them.

    Attributes:
        follows: whether a result has a gradient, for each of them; set by `capture`.
    """

    def __init__(
        self, steps: Callable[..., tuple[Tensor, ...]], given: Sequence[Tensor], wanted: Sequence[bool]
    ) -> None:
        self._steps = steps
        self._device = given[0].device
        self.read = [copied(t.detach()).requires_grad_(w) for t, w in zip(given, wanted, strict=True)]
        self.follows: list[bool] = []

    def try_out(self) -> None:
        """Call the function and its gradients once on the stream of graphs, so that work of a first call is done before
        the capture.

        Raises:
            ValueError: gradients would pass to a tensor that is no argument, and replays would lose them.
        """
        with on_own_stream(self._device):
            ends = self._steps(*self.read)
            if other := next(_others(ends, self.read), None):
                raise ValueError(
                    "a tensor that requires a gradient must be a parameter or buffer of the step or a field of the "
                    f"state in steps from CUDA graphs, got {other}: make the function that reads it a "
                    "torch.nn.Module that has it"
                )
            self._gradients(ends, [torch.zeros_like(t) for t in ends if t.requires_grad])

    def _gradients(self, ends: Sequence[Tensor], grads: Sequence[Tensor]) -> list[Tensor | None]:
        outputs = [t for t in ends if t.requires_grad]
        if not outputs:
            return [None] * len(self.read)
        wanted = [t for t in self.read if t.requires_grad]
        with torch.autocast(self._device.type, enabled=False):  # as in every backward pass
            found = iter(torch.autograd.grad(outputs, wanted, grads, allow_unused=True))
        return [next(found) if t.requires_grad else None for t in self.read]

    def capture(self, beside: Graphs | None) -> None:
        """Capture the graphs, in the memory of `beside` if given."""
        self._forward, self._backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        self._memory: GraphMemory = GraphMemory(self._device, waits=True) if beside is None else beside._memory
        with self._memory.capturing(self._forward):
            ends = self._steps(*self.read)
        self.follows = [t.requires_grad for t in ends]
        self._grads = [torch.zeros_like(t) for t in ends if t.requires_grad]
        if self._grads:
            with self._memory.capturing(self._backward):
                self._found = self._gradients(ends, self._grads)
        self._ends = [t.detach() for t in ends]
        del self._steps  # It may refer to the owner of the graphs, whose release a cycle would delay.

    def forward(self, given: Sequence[Tensor]) -> Sequence[Tensor]:
        """The results, in memory that the next replay overwrites."""
        with torch.no_grad():
            copy_all(self.read, given)
        self._forward.replay()
        return self._ends

    def backward(self, grads: Sequence[Tensor | None]) -> Sequence[Tensor | None]:
        """Gradients with respect to the arguments of the latest replay, from those of the results."""
        self._take(grads)
        self._backward.replay()
        return self._found

    def _take(self, grads: Sequence[Tensor | None]) -> None:
        own = [grad for grad, follows in zip(grads, self.follows, strict=True) if follows]
        there = [(to, grad) for to, grad in zip(self._grads, own, strict=True) if grad is not None]
        for to, grad in zip(self._grads, own, strict=True):
            if grad is None:
                to.zero_()
        copy_all([to for to, _ in there], [grad for _, grad in there])


def _others(ends: Sequence[Tensor], read: Sequence[Tensor]) -> Iterator[str]:
    """Descriptions of leaves to which gradients of the results would pass, other than the tensors that are read."""
    waiting: list[Any] = [t.grad_fn for t in ends if t.grad_fn is not None]
    known = set[Any]()
    while waiting:
        node = waiting.pop()
        if node in known:
            continue
        known.add(node)
        if node.name().endswith("AccumulateGrad") and not any(node.variable is t for t in read):
            yield f"one of shape {list(node.variable.shape)}"
        waiting += [parent for parent, _ in node.next_functions if parent is not None]


def no_hooks() -> contextlib.AbstractContextManager[Any]:
    """Context without the hooks of a surrounding checkpoint, which would count tensors saved by autograd or move them
    to the host."""
    if torch._C._autograd._top_saved_tensors_default_hooks(True) is None:
        return contextlib.nullcontext()  # transforms refuse hooks
    return torch.autograd.graph.saved_tensors_hooks(lambda t: t, lambda t: t)


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
