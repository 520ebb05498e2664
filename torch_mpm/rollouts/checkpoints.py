"""States stored for the backward pass of a rollout; the steps in between are recomputed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree

from ..boundaries.control import Poses, motions_of
from ..errors import check_count, check_flag, check_number
from ..grid.grid import same_pools
from ..state.state import CONSTANTS, State
from ..step.status import aside, uncounted
from .recompute import called_again


class Stored(Protocol):
    """A `State`, or a pytree of tensors with one."""

    @property
    def x(self) -> Tensor: ...
    @property
    def poses(self) -> Poses: ...
    def with_poses(self: S, poses: Poses) -> S: ...


S = TypeVar("S", bound=Stored)
Advance = Callable[[S, int, int], S]
"""Function of (state, count, k) that returns the state `count` steps later; the first of them is step k."""


class Needs(NamedTuple):
    """Memory and time of steps with gradients: what schedules of stored states are chosen by."""

    state: int
    """Size of a stored state [bytes]."""
    step: int
    """Size of a step that is recorded for its backward pass [bytes]."""
    call: int = 0
    """Size of everything else while recorded steps are differentiated [bytes]."""
    path: int = 0
    """Size of the arguments of a stored call, per step of it [bytes]."""
    steps_of_a_call: float = 0.0
    """Time of a call beside its steps, in steps."""
    in_op: bool = False
    """Whether a call stores its arguments, and its backward pass recomputes and records its steps: a call of the fused
    op. Otherwise autograd records steps as they are computed."""

    def bytes_of(self, states: int, steps: int) -> int:
        """Memory of a number of stored states, and of the steps that are recorded meanwhile [bytes]."""
        return states * (self.state + steps * self.path) + steps * (self.step + self.path) + self.call


@dataclasses.dataclass(frozen=True)
class Checkpoints:
    """States of a rollout to store for the backward pass. Set `memory`, or `every`, `states` or both.

    Attributes:
        every: stores the state of every `every` steps; each step is recomputed once. Memory: n/every states and the
            memory of `every` steps.
        states: stores at most `states` states at a time beside the initial one, 2 or more, placed so that recomputation
            costs least (binomial checkpoints, Griewank and Walther 2000), at the beginnings of parts of `every` steps.
            With s states and at most r repetitions of each part, the number of parts is at most (s + r)!/(s! r!).
            Memory: these states and the memory of the steps of a part. Without `every` a part is one step from Python,
            or the `graph` steps of `rollout`; in the fused op it has as many steps as need no more memory than the
            states, or 16 MB (512 MB on CUDA), and at least one.
        memory: limit [bytes]. Where all steps fit, none is recomputed, as long as no grid has to grow on the CPU.
            Otherwise `every` and `states` are those that take the least time. Memory that allocators keep after the
            tensors in it is not included. A step launched from Python is run once without effect, to measure it.
        offload: whether stored states on a CUDA device are moved to host memory; `memory` is then that of the
            recomputed steps. Not with `states`.

    Raises:
        TypeError, ValueError: for a wrong number, or none of them, or `memory` with another.
    """

    every: int | None = None
    states: int | None = None
    memory: float | None = None
    offload: bool = False

    def __post_init__(self) -> None:
        given = [name for name in ("every", "states", "memory") if getattr(self, name) is not None]
        if not given or (self.memory is not None and len(given) > 1):
            found = " and ".join(given) or "none"
            raise ValueError(f"Checkpoints must have memory, or one or both of every and states, got {found}")
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

    def parts(self, n: int) -> int:
        """Number of parts of n steps."""
        return -(-n // (self.every or 1))

    def repetitions(self, n: int, in_op: bool = False) -> int:
        """Number of steps that the backward pass of n steps recomputes.

        Args:
            n: number of steps.
            in_op: whether each part is a call of the fused op, which recomputes its steps to record them.
        """
        if n == 0 or self.states is None:
            return n
        every, parts = self.every or 1, self.parts(n)
        last, again = n - (parts - 1) * every, in_op or _recomputes_last(every, parts)
        other_calls = _calls(parts, min(self.states, parts), in_op) - (2 if in_op else 1)
        return every * other_calls + last * (2 if again else 1) - n

    def kept(self, n: int, in_op: bool = False) -> int:
        """Maximum number of states stored at a time; `in_op` as in `repetitions`."""
        parts = self.parts(n)
        if self.states is None:
            return parts
        return min(self.states + in_op, parts) if in_op else min(self.states, max(parts - 1, 1), n)


def as_checkpoints(checkpoint: int | Checkpoints | None) -> Checkpoints | None:
    """The argument of `rollout`.

    Raises:
        TypeError, ValueError: unless it is a positive integer, `Checkpoints` or None.
    """
    if checkpoint is None or isinstance(checkpoint, Checkpoints):
        return checkpoint
    return Checkpoints(every=int(check_count("checkpoint", checkpoint, 1)))


def fitting(memory: float, n: int, needs: Needs, offload: bool = False) -> Checkpoints | None:
    """Checkpoints of n steps that take the least time within a limit of memory [bytes]; None where none are needed.

    The steps are divided into m = ⌈n / every⌉ parts. While a part is differentiated, its steps are recorded, and s
    states are stored beside its own; `Needs.bytes_of` adds them up. For each length of a part the largest s that fits,
    up to m − 1, determines how often parts are computed. Long parts save calls, and leave memory for fewer states, so
    that parts are repeated more often. The length with the least time of steps and calls is chosen. With s = m − 1 each
    part is recomputed once.

    Raises:
        ValueError: where no schedule fits. Each needs m − 1 states, or at least 2.
    """
    if n == 0 or needs.bytes_of(0 if offload else 1, n) <= memory:
        return None
    if offload:
        needs = needs._replace(state=0, path=0)
    schedules = [s for every in _lengths(n) if (s := _largest(memory, n, every, needs)) is not None]
    if not schedules:
        least, states, steps = min((needs.bytes_of(*_least(n, k)), *_least(n, k)) for k in _lengths(n))
        kept = "" if offload else f"{states} stored states and "
        raise ValueError(
            f"memory must be at least {least} bytes, for {kept}the backward pass of {steps} recorded "
            f"{'step' if steps == 1 else 'steps'}, got {memory:g}"
        )
    fastest = min(schedules, key=lambda checkpoints: _time(checkpoints, n, needs))
    return Checkpoints(every=fastest.every, offload=True) if offload else fastest


def _lengths(n: int) -> Iterator[int]:
    """Lengths ⌈n / m⌉ of m parts, from n to 1."""
    every = n
    while every > 1:
        yield every
        every = min(-(-n // (-(-n // every) + 1)), every - 1)
    yield 1


def _least(n: int, every: int) -> tuple[int, int]:
    """Number of states that n steps in parts of a given length need, and of steps of a part."""
    return min(-(-n // every) - 1, 2), every


def _largest(memory: float, n: int, every: int, needs: Needs) -> Checkpoints | None:
    """Checkpoints of parts of a given length with as many states as fit; None where too few do."""
    most, without = -(-n // every) - 1, needs.bytes_of(0, every)
    each = needs.bytes_of(1, every) - without
    states = min((memory - without) // max(each, 1), most)
    return Checkpoints(every=every, states=max(int(states), 2)) if states >= min(most, 2) else None


def _time(checkpoints: Checkpoints, n: int, needs: Needs) -> float:
    """Time of a rollout and of the recomputed steps of its backward pass, in steps."""
    parts = checkpoints.parts(n)
    calls = _calls(parts, min(checkpoints.states or parts, parts), needs.in_op)
    return n + checkpoints.repetitions(n, needs.in_op) + needs.steps_of_a_call * calls


def from_python(
    advance: Advance[S], state: S, n: int, checkpoints: Checkpoints | None, step: Any, steps_per_call: int = 1
) -> S:
    """The state n steps later, of single steps or of calls of several that autograd records as they are computed; with
    checkpoints, which have no `memory`, as many states are stored as these say."""
    if checkpoints is None or n == 0:
        return advance(state, n, 0)
    if checkpoints.states is not None:
        parts = dataclasses.replace(checkpoints, every=checkpoints.every or steps_per_call)
        return binomial(advance, state, n, parts, step)
    return _in_segments(advance, state, n, checkpoints, step)


# ---- every n-th step


def _in_segments(advance: Advance[S], state: S, n: int, checkpoints: Checkpoints, step: Any) -> S:
    """The state n steps later; only the first state of each segment is stored for the backward pass."""
    assert checkpoints.every is not None
    for first in range(0, n, checkpoints.every):
        state = recomputed(advance, state, min(checkpoints.every, n - first), first, step)
    return state


def recomputed(advance: Advance[S], state: S, count: int, first: int, step: Any) -> S:
    """`advance(state, count, first)` whose arguments are stored; the backward pass recomputes its steps.

    The recomputed steps use the pools and the motions of obstacles of the first computation, and are not counted for
    `check` of the step.
    """
    leaves, layout = _pytree.tree_flatten(state)
    motions, poses = motions_of(step, state.poses), state.poses  # A stored state would keep the preceding graph alive.
    again, pools = False, list[int]()

    def steps(*tensors: Tensor) -> S:
        nonlocal again
        given: S = _pytree.tree_unflatten(tensors, layout).with_poses(poses)
        with contextlib.ExitStack() as stack:
            stack.enter_context(same_pools(pools))
            if again:  # Graphs write to the tensors that `aside` would replace.
                stack.enter_context(motions())
                from_graphs = isinstance(step, torch.nn.Module) and "_captured_graphs" in vars(step)
                stack.enter_context(uncounted(step) if from_graphs else aside(step, given.x))
            again = True
            return advance(given, count, first)

    result: S = called_again(steps, *leaves)
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


def binomial(advance: Advance[S], state: S, n: int, checkpoints: Checkpoints, step: Any, in_op: bool = False) -> S:
    """The state n steps later, with at most `states` states stored at a time beside the initial one; n is 1 or more.

    The parts of `every` steps are split in two groups. The backward pass processes the second group first, with one
    state less; then it recomputes the first group from its first state, with all states. The position of the split is
    that of Griewank and Walther 2000 (algorithm 799, "revolve"). It minimises the steps where autograd records them as
    they are computed. A call of the fused op (`in_op`) recomputes its part itself: a group of one part is not wrapped,
    and the number of calls is at most 2 % above the least.
    """
    every = checkpoints.every or 1

    parts = checkpoints.parts(n)

    def part(state: S, k: int) -> S:
        return advance(state, min(every, n - k * every), k * every)

    def group(state: S, first: int, count: int, states: int) -> S:
        def again(now: S, *_: int) -> S:
            return run(now, first, count, states)

        return recomputed(again, state, count * every, first * every, step)

    def run(state: S, first: int, count: int, states: int) -> S:
        while count > 1:
            size = _split(count, states)
            state = part(state, first) if size == 1 and in_op else group(state, first, size, states)
            first, count, states = first + size, count - size, states - 1
        if first == parts - 1 and not in_op and _recomputes_last(every, parts):
            return recomputed(lambda now, *_: part(now, first), state, every, first * every, step)
        return part(state, first)

    return run(state, 0, parts, min(checkpoints.states or parts, parts))


def _recomputes_last(every: int, parts: int) -> bool:
    """Whether the last of several parts is recomputed, too, where autograd records steps as they are computed. What it
    has recorded for nodes that no gradient reaches would remain until the end of the backward pass."""
    return parts > 1 and every > 1


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
def _calls(parts: int, states: int, in_op: bool) -> int:
    """Number of parts that a rollout and its backward pass compute, by `binomial`."""
    of_one = 2 if in_op else 1  # A call of the op computes its part, and records it later.
    computed = of_one
    while parts > 1:
        size = _split(parts, states)
        computed += of_one if size == 1 and in_op else size + _calls(size, states, in_op)
        parts, states = parts - size, states - 1
    return computed


# ---- on the host


def offloading(checkpoints: Checkpoints | None, state: State) -> contextlib.AbstractContextManager[None]:
    """Context of `Checkpoints(offload=True)` for steps from a state; one without effect for other checkpoints."""
    return _offloaded(state) if checkpoints is not None and checkpoints.offload else contextlib.nullcontext()


@contextlib.contextmanager
def _offloaded(state: State) -> Iterator[None]:
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
