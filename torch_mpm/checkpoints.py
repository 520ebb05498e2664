"""What a rollout keeps of its states for the backward pass, which takes the steps between them again."""

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

from .activation_record import aside, uncounted
from .boundaries.control import motions_of
from .errors import check_count, check_flag, check_number
from .grid import same_pools
from .recompute import called_again
from .state import State

Advance = Callable[[State, int, int], State]
"""(state, count, k) to the state so many steps later, the first of which is step k."""

CONSTANT = ("mass", "volume", "scene", "ids", "material")
"""Fields that steps leave as they are."""


@dataclasses.dataclass(frozen=True)
class Checkpoints:
    """Which states of a rollout are kept: exactly one of `every`, `states` and `memory` says it.

    Attributes:
        every: the state of every so many steps is kept, and its steps are taken again once. Memory: n/every states and
            what `every` steps need.
        states: at most so many states are kept at a time, 2 or more, where taking steps again costs least (binomial
            checkpoints, Griewank and Walther 2000). Memory: so many states, and what one step needs; with s states and
            r repetitions of each step at most, n ≤ (s + r)!/(s! r!).
        memory: [bytes]. Where all steps fit, none is taken again, as long as no grid has to grow on the CPU; else the
            largest `every` that fits, or as many `states` where none does. A step from Python is taken aside once, to
            measure it.
        offload: whether kept states wait in the memory of the host, as far as they are on a CUDA device; `memory` then
            is that of the steps which are taken again. Not with `states`.

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
            raise ValueError("offload must be False with states: with every or memory, states may wait on the host")

    def repetitions(self, n: int) -> int:
        """Steps that the backward pass of n steps takes again."""
        if self.every is not None:
            return n
        assert self.states is not None
        return _evaluations(n, min(self.states, n)) - n

    def kept(self, n: int) -> int:
        """States that are kept at a time at most."""
        return -(-n // self.every) if self.every is not None else min(self.states or 0, n)


def as_checkpoints(checkpoint: int | Checkpoints | None) -> Checkpoints | None:
    """The argument of `rollout`.

    Raises:
        TypeError, ValueError: for anything else than a whole number from 1 on, `Checkpoints` or None.
    """
    if checkpoint is None or isinstance(checkpoint, Checkpoints):
        return checkpoint
    return Checkpoints(every=int(check_count("checkpoint", checkpoint, 1)))


def fitting(memory: float, n: int, state_bytes: int, step_bytes: int, offload: bool = False) -> Checkpoints | None:
    """The checkpoints of n steps with the least work that need no more than some memory [bytes]; None for no need.

    Raises:
        ValueError: where two states and a step need more.
    """
    if n == 0 or state_bytes + n * step_bytes <= memory:
        return None
    on_device = 0 if offload else state_bytes

    def needed(every: int) -> int:
        return -(-n // every) * on_device + every * step_bytes

    # All of them take each step again once, and with more steps between kept states calls are fewer.
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
        raise ValueError(f"memory must be at least {least} bytes, of a step and of kept states, got {memory:g}")
    return Checkpoints(states=min(states, n))


# ---- every so many steps


def in_segments(advance: Advance, state: State, n: int, checkpoints: Checkpoints, step: Any) -> State:
    """The state n steps later; of every so many steps only the first state is kept for the backward pass."""
    assert checkpoints.every is not None
    with offloaded(state) if checkpoints.offload else contextlib.nullcontext():
        for first in range(0, n, checkpoints.every):
            state = recomputed(advance, state, min(checkpoints.every, n - first), first, step)
    return state


def recomputed(advance: Advance, state: State, count: int, first: int, step: Any) -> State:
    """`advance(state, count, first)`, of which the backward pass keeps the arguments and takes the steps again.

    A second time the steps find the pools and the motions of obstacles of the first one, and do not count for `check`
    of the step.
    """
    leaves, layout = _pytree.tree_flatten(state)
    motions, poses = motions_of(step, state), state.poses  # a state that is kept would keep the graph before it
    again, pools = False, list[int]()

    def steps(*tensors: Tensor) -> State:
        nonlocal again
        given = _pytree.tree_unflatten(tensors, layout).with_poses(poses)
        with contextlib.ExitStack() as stack:
            stack.enter_context(same_pools(pools))
            if again:  # graphs write to the tensors that `aside` would put away
                stack.enter_context(motions())
                from_graphs = isinstance(step, torch.nn.Module) and "_recordings" in vars(step)
                stack.enter_context(uncounted(step) if from_graphs else aside(step, given.x))
            again = True
            return advance(given, count, first)

    result: State = called_again(steps, *leaves)
    return result


def contexts() -> tuple[contextlib.AbstractContextManager[None], contextlib.AbstractContextManager[None]]:
    """For `torch.utils.checkpoint.checkpoint(..., use_reentrant=False, context_fn=contexts)` around steps: on grids
    without `max_blocks`, steps that are taken again find pools of the size they had. `rollout` sees to that itself."""
    sizes = list[int]()
    return same_pools(sizes), _EachTime(sizes)


class _EachTime(contextlib.AbstractContextManager[None]):
    """`same_pools` as often as a graph is gone back through."""

    def __init__(self, sizes: list[int]) -> None:
        self._sizes = sizes

    def __enter__(self) -> None:
        self._now = same_pools(self._sizes)
        self._now.__enter__()

    def __exit__(self, *error: Any) -> None:
        self._now.__exit__(*error)


# ---- binomial


def binomial(advance: Advance, state: State, n: int, states: int, step: Any) -> State:
    """The state n steps later, with at most so many states kept at a time; n is 1 or more.

    The first part of a rollout is taken again from its first state, with as many states, once the rest of it is done
    with one less; Griewank and Walther 2000 say where to part them (algorithm 799, "revolve").
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
    """Steps that so many states and repetitions of each step serve."""
    return math.comb(states + repetitions, states) if states >= 0 and repetitions >= 0 else 0


def _split(n: int, states: int) -> int:
    repetitions = 0
    while _reach(states, repetitions) < n:
        repetitions += 1
    part = min(_reach(states, repetitions - 1), n - _reach(states - 1, repetitions - 1))
    return min(max(part, 1), n - 1)


@functools.lru_cache(maxsize=1 << 16)
def _evaluations(n: int, states: int) -> int:
    """Steps that a rollout and its backward pass take."""
    taken = 1
    while n > 1:
        part = _split(n, states)
        taken += part + _evaluations(part, states)
        n, states = n - part, states - 1
    return taken


# ---- on the host


@contextlib.contextmanager
def offloaded(state: State) -> Iterator[None]:
    """Where tensors of particles on a CUDA device that autograd keeps wait in pinned memory of the host.

    Fields that steps leave as they are stay, since all kept states share them. Copies take their turn on the stream.
    """
    shared = {t.untyped_storage().data_ptr() for name in CONSTANT if (t := getattr(state, name)) is not None}
    P = len(state)

    def pack(t: Tensor) -> tuple[torch.device, Tensor]:
        moves = t.is_cuda and t.is_floating_point() and t.dim() > 0 and t.shape[0] == P
        if not moves or t.untyped_storage().data_ptr() in shared:
            return t.device, t
        t = t.contiguous() if 0 in t.stride() else t  # one that was expanded
        there = torch.empty_strided(t.shape, t.stride(), dtype=t.dtype, device="cpu", pin_memory=True)
        return t.device, there.copy_(t.detach(), non_blocking=True)

    def unpack(kept: tuple[torch.device, Tensor]) -> Tensor:
        device, t = kept
        return t.to(device, non_blocking=True)

    with torch.autograd.graph.saved_tensors_hooks(pack, unpack):
        yield
