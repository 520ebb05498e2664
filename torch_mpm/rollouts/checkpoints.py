"""States stored for the backward pass of a rollout; the steps in between are recomputed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree

from ..boundaries.control import motions_of
from ..errors import check_count, check_flag, check_number
from ..grid.grid import same_pools
from ..state.state import CONSTANTS, State
from ..step.status import aside, uncounted
from .recompute import called_again

Advance = Callable[[State, int, int], State]
"""Function of (state, count, k) that returns the state `count` steps later; the first of them is step k."""


@dataclasses.dataclass(frozen=True)
class Checkpoints:
    """States of a rollout to store for the backward pass. Set exactly one of `every`, `states` and `memory`.

    Attributes:
        every: stores the state of every `every` steps; each step is recomputed once. Memory: n/every states and the
            memory of `every` steps.
        states: stores at most `states` states at a time, 2 or more, placed so that recomputation costs least (binomial
            checkpoints, Griewank and Walther 2000). Memory: these states and the memory of one step; with s states and
            at most r repetitions of each step, n ≤ (s + r)!/(s! r!).
        memory: limit [bytes]. Where all steps fit, none is recomputed, as long as no grid has to grow on the CPU.
            Otherwise the largest `every` that fits is used, or the number of `states` that fits where no `every` does.
            A step launched from Python is run once without effect, to measure it.
        offload: whether stored states on a CUDA device are moved to host memory; `memory` is then that of the
            recomputed steps. Not with `states`.

    Raises:
        TypeError, ValueError: for a wrong number, or none or two of them.
    """

    every: int | None = None
    states: int | None = None
    memory: float | None = None
    offload: bool = False

    def __post_init__(self) -> None:
        given = [name for name in ("every", "states", "memory") if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"Checkpoints must have one of every, states and memory, got {found}")
        if self.every is not None:
            check_count("every", self.every, 1)
        if self.states is not None:
            check_count("states", self.states, 2)
        if self.memory is not None:
            check_number("memory", self.memory, "a positive number of bytes", lambda v: 0 < v < math.inf)
        if check_flag("offload", self.offload) and self.states is not None:
            raise ValueError(
                "offload must be False with states, got True: only every and memory move states to the host"
            )

    def repetitions(self, n: int) -> int:
        """Number of steps that the backward pass of n steps recomputes."""
        if self.every is not None:
            return n
        assert self.states is not None
        return _evaluations(n, min(self.states, n)) - n

    def kept(self, n: int) -> int:
        """Maximum number of states stored at a time."""
        return -(-n // self.every) if self.every is not None else min(self.states or 0, n)


def as_checkpoints(checkpoint: int | Checkpoints | None) -> Checkpoints | None:
    """The argument of `rollout`.

    Raises:
        TypeError, ValueError: unless it is a positive integer, `Checkpoints` or None.
    """
    if checkpoint is None or isinstance(checkpoint, Checkpoints):
        return checkpoint
    return Checkpoints(every=int(check_count("checkpoint", checkpoint, 1)))


def fitting(memory: float, n: int, state_bytes: int, step_bytes: int, offload: bool = False) -> Checkpoints | None:
    """Checkpoints of n steps with the least work within a limit of memory [bytes]; None where none are needed.

    Raises:
        ValueError: where two states and a step need more.
    """
    if n == 0 or state_bytes + n * step_bytes <= memory:
        return None
    on_device = 0 if offload else state_bytes

    def needed(every: int) -> int:
        return -(-n // every) * on_device + every * step_bytes

    # All of them recompute each step once, and more steps between stored states mean fewer calls.
    best = n if on_device == 0 else max(round(math.sqrt(n * on_device / max(step_bytes, 1))), 1)
    smallest = 1 if on_device == 0 else min(best, n)
    if needed(smallest) <= memory:
        every = smallest
        while needed(min(2 * every, n)) <= memory and every < n:
            every = min(2 * every, n)
        return Checkpoints(every=every, offload=offload)
    states = int((memory - step_bytes) // max(on_device, 1))
    if on_device == 0 or states < 2:
        least = step_bytes + 2 * on_device
        raise ValueError(f"memory must be at least {least} bytes, for a step and stored states, got {memory:g}")
    return Checkpoints(states=min(states, n))


# ---- every n-th step


def in_segments(advance: Advance, state: State, n: int, checkpoints: Checkpoints, step: Any) -> State:
    """The state n steps later; only the first state of each segment is stored for the backward pass."""
    assert checkpoints.every is not None
    with offloaded(state) if checkpoints.offload else contextlib.nullcontext():
        for first in range(0, n, checkpoints.every):
            state = recomputed(advance, state, min(checkpoints.every, n - first), first, step)
    return state


def recomputed(advance: Advance, state: State, count: int, first: int, step: Any) -> State:
    """`advance(state, count, first)` whose arguments are stored; the backward pass recomputes its steps.

    The recomputed steps use the pools and the motions of obstacles of the first computation, and are not counted for
    `check` of the step.
    """
    leaves, layout = _pytree.tree_flatten(state)
    motions, poses = motions_of(step, state), state.poses  # A stored state would keep the preceding graph alive.
    again, pools = False, list[int]()

    def steps(*tensors: Tensor) -> State:
        nonlocal again
        given = _pytree.tree_unflatten(tensors, layout).with_poses(poses)
        with contextlib.ExitStack() as stack:
            stack.enter_context(same_pools(pools))
            if again:  # Graphs write to the tensors that `aside` would replace.
                stack.enter_context(motions())
                from_graphs = isinstance(step, torch.nn.Module) and "_captured_graphs" in vars(step)
                stack.enter_context(uncounted(step) if from_graphs else aside(step, given.x))
            again = True
            return advance(given, count, first)

    result: State = called_again(steps, *leaves)
    return result


def contexts() -> tuple[contextlib.AbstractContextManager[None], contextlib.AbstractContextManager[None]]:
    """Contexts for `torch.utils.checkpoint.checkpoint(..., use_reentrant=False, context_fn=contexts)` around steps: on
    grids without `max_blocks`, recomputed steps find pools of their original size. `rollout` does this itself.
    """
    sizes = list[int]()
    return same_pools(sizes), _EachTime(sizes)


class _EachTime(contextlib.AbstractContextManager[None]):
    """`same_pools` for each backward pass through the graph."""

    def __init__(self, sizes: list[int]) -> None:
        self._sizes = sizes

    def __enter__(self) -> None:
        self._now = same_pools(self._sizes)
        self._now.__enter__()

    def __exit__(self, *error: Any) -> None:
        self._now.__exit__(*error)


# ---- binomial


def binomial(advance: Advance, state: State, n: int, states: int, step: Any) -> State:
    """The state n steps later, with at most `states` states stored at a time; n is 1 or more.

    The steps are split in two parts. The backward pass processes the second part first, with one state less; then it
    recomputes the first part from its first state, with all states. The position of the split is that of Griewank and
    Walther 2000 (algorithm 799, "revolve").
    """

    def part_of(first: int, count: int, states: int) -> Advance:
        return lambda now, *_: run(now, first, count, states)

    def run(state: State, first: int, count: int, states: int) -> State:
        while count > 1:
            part = _split(count, states)
            state = recomputed(part_of(first, part, states), state, part, first, step)
            first, count, states = first + part, count - part, states - 1
        return advance(state, 1, first)

    return run(state, 0, n, states)


def _reach(states: int, repetitions: int) -> int:
    """Maximum number of steps for given numbers of states and of repetitions of each step."""
    return math.comb(states + repetitions, states) if states >= 0 and repetitions >= 0 else 0


def _split(n: int, states: int) -> int:
    repetitions = 0
    while _reach(states, repetitions) < n:
        repetitions += 1
    part = min(_reach(states, repetitions - 1), n - _reach(states - 1, repetitions - 1))
    return min(max(part, 1), n - 1)


@functools.lru_cache(maxsize=1 << 16)
def _evaluations(n: int, states: int) -> int:
    """Number of steps that a rollout and its backward pass compute."""
    computed = 1
    while n > 1:
        part = _split(n, states)
        computed += part + _evaluations(part, states)
        n, states = n - part, states - 1
    return computed


# ---- on the host


@contextlib.contextmanager
def offloaded(state: State) -> Iterator[None]:
    """Context in which particle tensors on a CUDA device that autograd stores are moved to pinned host memory.

    Fields that steps do not change stay on the device, since all stored states share them. Copies are queued on the
    stream.
    """
    shared = {t.untyped_storage().data_ptr() for name in CONSTANTS if (t := getattr(state, name)) is not None}
    P = len(state)

    def pack(t: Tensor) -> tuple[torch.device, Tensor]:
        moves = t.is_cuda and t.is_floating_point() and t.dim() > 0 and t.shape[0] == P
        if not moves or t.untyped_storage().data_ptr() in shared:
            return t.device, t
        t = t.contiguous() if 0 in t.stride() else t  # An expanded tensor.
        there = torch.empty_strided(t.shape, t.stride(), dtype=t.dtype, device="cpu", pin_memory=True)
        return t.device, there.copy_(t.detach(), non_blocking=True)

    def unpack(kept: tuple[torch.device, Tensor]) -> Tensor:
        device, t = kept
        return t.to(device, non_blocking=True)

    with torch.autograd.graph.saved_tensors_hooks(pack, unpack):
        yield
