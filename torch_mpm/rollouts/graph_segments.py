"""Steps with functions of the user's, and their gradients, from CUDA graphs: for training with networks in a step."""

from __future__ import annotations

import collections
import contextlib
import functools
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ..boundaries.control import control_step, steady
from ..cuda_graphs.capture import Recordings, Same, capturing
from ..cuda_graphs.graph import WorkInFlight, copied, copy_all, tensors_of, time_tensor
from ..cuda_graphs.keys import StepKey, autocast_of, surroundings
from ..errors import check_count, shape_of
from ..grid.grid import own_pools
from ..laws.mixture import Mixture
from ..laws.parameters import has_hooks
from ..state.state import State, check_state
from ..step.clocks import time_after
from ..step.status import counts_of, uncounted
from ..step.step import Step

TRIALS = 3
"""Times that steps are taken from Python before they are recorded, as torch does: compilers of code of the user's look
at the first ones."""


def captured(step: nn.Module, state: State | None, dt: float, n: int = 1) -> Captured:
    """n steps as one CUDA graph, and their backward pass as another: for training with networks in a step, where
    launching its kernels one by one takes longer than running them.

        advance = torch_mpm.captured(step, state, dt=1e-4, n=8)
        for batch in data:
            loss(advance(batch)).backward()

    A state of another kind (fields, shapes, dtypes, those that require gradients), another grad mode or autocast, a
    larger pool of a grid without `max_blocks`, numbers, tensors and parts of the step that were assigned: for each of
    them the first call records, which takes as long as a few rollouts of so many steps; the latest 8 recordings are
    kept. So a pose of an obstacle that is assigned between two calls (see `Obstacle`) makes the next one record anew:
    give the obstacle a path, or call `rollout`. Recordings share memory: as much as the largest one needs, with
    gradients what autograd keeps of n steps, and the state and parameters before and after of each one.

    Parameters and buffers are read anew in each call. Code, and numbers of modules of the user's, are those of the
    recording, which calls the step some times; `state.time` is a tensor there. The graphs read and write the same
    memory in each call: a backward pass that comes after another call takes the steps of its own once more.
    `rollout(graph=n)` makes segments of such graphs.

    Args:
        step: a `Step`, or another module (state, dt) -> state; no hooks.
        state: a state like those to come, on a CUDA device. Gradients pass to the fields that require them, and to
            parameters and buffers of the step that do. None: the first call records.
        dt: time step [s].
        n: number of steps.

    Returns:
        A function state -> state n steps later, differentiable once; for one thread at a time.

    Raises:
        TypeError, ValueError: for a wrong argument, and for a tensor with a gradient that takes part in the steps but
            is not of the step.
        RuntimeError: where something in the step waits for the device, which a graph cannot.
    """
    if not isinstance(step, nn.Module):
        raise TypeError(f"step must be a Step or another module (state, dt) -> state, got {shape_of(step)}")
    check_count("n", n, 1)
    refuse_hooks(step)
    result = Captured(step, dt, int(n), Recordings())
    if state is not None:
        result.record(state)
    return result


# ---- in rollouts


def in_graphs(step: nn.Module, state: State, n: int, dt: float, most: int) -> State:
    """The state n steps later, by graphs of `most` steps and of what is left; a plan has it.

    What they read is kept for the backward pass, which replays the steps of all but the latest graph again.
    """
    recordings = step.__dict__.setdefault("_recordings", Recordings())
    known = StepKey(step)
    in_flight = WorkInFlight(state.x, most)
    while n > 0:
        count = min(n, most)
        state = Captured(step, dt, count, recordings).after(state, known, alike=True)
        in_flight.launched()
        n -= count
    return state


def refuse_hooks(step: nn.Module) -> None:
    if any(has_hooks(module) for module in step.modules()):
        raise ValueError("step must have no hooks, nor any of its parts: a graph would not call them")


def has_graphs(device: torch.device) -> bool:
    return device.type == "cuda"


def another_device(step: nn.Module, device: torch.device) -> torch.device | None:
    """Of a parameter or buffer of a step, whose value would go into a graph as a number; None where there is none."""
    return next((t.device for t in (*step.parameters(), *step.buffers()) if t.device != device), None)


# ---- calls


class Captured:
    """What `captured` returns: a function state -> state."""

    def __init__(self, step: nn.Module, dt: float, n: int, recordings: Recordings) -> None:
        self._step, self._dt, self._n, self._recordings = step, dt, n, recordings

    def __call__(self, state: State) -> State:
        check_state(state)
        with control_step(self._step, state, self._n, self._dt) as left:
            return left(self.after(state, StepKey(self._step)))

    def record(self, state: State) -> None:
        """For a kind of states, in the grad mode and autocast of now."""
        known = StepKey(self._step)
        self._recording(self._prepared(state), known, False)

    def after(self, state: State, known: StepKey, alike: bool = False) -> State:
        """The state n steps later.

        Args:
            state: the state.
            known: of the step as it is now.
            alike: whether all that steps change counts as if it required a gradient once something does, so that
                segments of a rollout are of one kind.
        """
        prepared = self._prepared(state)
        recording, given = self._recording(prepared, known, alike)
        call = _Call(self._step, self._recordings, recording)
        if recording.wanted:
            ends = _Replayed.apply(call, *given)
        else:
            with torch.no_grad():
                ends = call.forward(given)
        recording.watch(self._recordings)
        results: dict[str, Any] = dict(zip(recording.steps.changed, ends, strict=True))
        if isinstance(self._step, Step) and not isinstance(state.time, Tensor):
            results["time"] = time_after(state.time, self._dt, self._n)
        return _with(prepared, results | recording.steps.dropped)

    def _check(self, device: torch.device) -> None:
        """That the step can be recorded now.

        Raises:
            ValueError: for a step with hooks, or with a tensor on another device.
        """
        refuse_hooks(self._step)
        if (place := another_device(self._step, device)) is not None:
            raise ValueError(f"step must be on the device of the state, {device}, got a tensor on {place}")

    def _prepared(self, state: State) -> State:
        """With the fields that steps need, and its time as a tensor."""
        check_state(state)
        if not has_graphs(state.x.device):
            raise ValueError(f"state must be on a CUDA device, got {state.x.device}")
        step = self._step
        prepare = getattr(step, "prepare", None)
        state = state if prepare is None else prepare(state)
        if isinstance(step, Step):
            state = step.with_residual(state, self._dt)
        if isinstance(step, Step) and state.C is None and (step.transfer == "apic" or step.law.viscous):
            state = state.replace(C=state.x.new_zeros(*state.x.shape, state.x.shape[1]))  # as after the first step
        return state.replace(time=time_tensor(state))

    def _recording(self, prepared: State, known: StepKey, alike: bool) -> tuple[_Recording, list[Tensor]]:
        """The recording that serves a state, made where there is none, and what it reads."""
        inputs = tensors_of(prepared) | known.own
        fixed = {name: self._recordings.same_content(name, inputs.pop(name)) for name in known.by_content(prepared)}
        wanted = {name for name, t in inputs.items() if torch.is_grad_enabled() and t.requires_grad}
        if alike and wanted:
            wanted |= {name for name, t in inputs.items() if name in _MOVED or name.startswith("extra.")}
            wanted = {name for name in wanted if inputs[name].is_floating_point()}
        kinds = frozenset((name, t.shape, t.dtype, t.device, name in wanted) for name, t in inputs.items())
        contents = tuple((name, Same(t)) for name, t in fixed.items())
        around = self._n, self._dt, surroundings(prepared.x.device), contents
        known.follow(prepared, self._recordings.unseen)
        recording = self._recordings.get((kinds, around, known.key, known.pools()))
        if recording is None:
            self._check(prepared.x.device)
            steps = _Steps(self._step, self._dt, self._n, prepared, fixed, list(inputs))
            recording = _Recording(steps, inputs, wanted, self._recordings)
            known.look()
            self._recordings.keep((kinds, around, known.key, known.pools()), recording)
        return recording, [inputs[name] for name in recording.steps.names]


_MOVED = ("x", "v", "C", "F", "J", "temperature", "impulse")
"""Fields that steps change, and that have gradients."""


def _with(state: State, tensors: Mapping[str, Any]) -> State:
    extra = {name.removeprefix("extra."): value for name, value in tensors.items() if name.startswith("extra.")}
    fields: dict[str, Any] = {name: value for name, value in tensors.items() if not name.startswith("extra.")}
    kept = {name: value for name, value in {**state.extra, **extra}.items() if value is not None}
    return state.replace(**fields, extra=kept)


class _Steps:
    """Steps as a function of tensors to tensors: those of the state, and those of the step that may have gradients.

    Args:
        fixed: fields that are no arguments, and the same tensors in each call.
        names: of the arguments.

    Attributes:
        changed: of the results; dropped: fields that are no tensors after the steps: None, or a time that is a number.
            Known after a call.
    """

    def __init__(
        self, step: nn.Module, dt: float, n: int, like: State, fixed: Mapping[str, Any], names: list[str]
    ) -> None:
        self._step, self.names, self.device = weakref.ref(step), names, like.x.device
        self.changed: list[str] = []
        self.dropped: dict[str, float | None] = {}
        self._dt, self._n, self._like, self._fixed = dt, n, like, fixed

    @property
    def step(self) -> nn.Module:
        step = self._step()
        assert step is not None, "its recordings go with a step"
        return step

    def __call__(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(self.names, tensors, strict=True))
        own = {name.removeprefix("step."): given.pop(name) for name in self.names if name.startswith("step.")}
        state = begin = _with(self._like, given).replace(**self._fixed)
        self._like = begin.detach()  # so that the first state may go, and what it follows from
        with steady():
            for _ in range(self._n):
                state = torch.func.functional_call(self.step, own, (state, self._dt))
        before, after = tensors_of(begin), tensors_of(state)
        results = {name: t for name, t in after.items() if t is not before.get(name)}
        self.changed = list(results)
        self.dropped = {name: None for name in before if name not in after}
        if "time" in self.dropped:
            self.dropped["time"] = float(state.time)
        return tuple(results.values())


class _Call:
    """One call of a recording. Its backward pass recomputes the steps if another call has used the recording since."""

    def __init__(self, step: nn.Module, recordings: Recordings, recording: _Recording) -> None:
        self._step, self._recordings, self.recording = step, recordings, recording
        self._mark = object()  # of this call in the recordings, which must not keep it
        self._random = _random_numbers(recording.steps.device) if recording.wanted else None

    def forward(self, given: Sequence[Tensor]) -> list[Tensor]:
        self._recordings.latest = self._mark
        with self._recordings.in_turn(self.recording.steps.device):
            return [t.clone() for t in self.recording.graphs.forward(given)]

    def gradients(self, given: Sequence[Tensor], grads: Sequence[Tensor | None]) -> list[Tensor | None]:
        """By the arguments; None where there is none."""
        graphs = self.recording.graphs
        with self._recordings.in_turn(self.recording.steps.device):
            if self._recordings.latest is not self._mark:
                with uncounted(self._step), self._same_random_numbers():
                    graphs.forward(given)
            self._recordings.latest = None  # the backward pass makes use of the memory of what it has read
            # The next replay writes over its gradients.
            return [None if grad is None else grad.clone() for grad in graphs.backward(grads)]

    @contextlib.contextmanager
    def _same_random_numbers(self) -> Iterator[None]:
        device = self.recording.steps.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            assert self._random is not None
            if device.type == "cuda":
                torch.cuda.set_rng_state(self._random, device)
            else:
                torch.set_rng_state(self._random)
            yield


def _random_numbers(device: torch.device) -> Tensor:
    return torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()


class _Replayed(torch.autograd.Function):
    """The steps of a call as one operation, which keeps its arguments alone."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *given: Tensor) -> tuple[Tensor, ...]:
        ctx.call = call
        ctx.save_for_backward(*given)
        ctx.set_materialize_grads(False)
        ends = call.forward(given)
        follows = call.recording.graphs.follows
        ctx.mark_non_differentiable(*(t for t, with_gradient in zip(ends, follows, strict=True) if not with_gradient))
        return tuple(ends)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> Any:
        return None, *ctx.call.gradients(ctx.saved_tensors, grads)


# ---- recordings


class _Recording:
    """Steps from a kind of states, their gradients, and what they tell of the blocks that they want."""

    def __init__(self, steps: _Steps, inputs: Mapping[str, Tensor], wanted: set[str], recordings: Recordings) -> None:
        self.steps, self.wanted = steps, bool(wanted)
        kept, device = recordings.some(), steps.device
        recordings.latest = None
        names, with_gradients = steps.names, torch.is_grad_enabled()
        with contextlib.ExitStack() as stack:
            stack.enter_context(own_pools())
            stack.enter_context(torch.inference_mode(False))
            stack.enter_context(torch.set_grad_enabled(with_gradients))
            stack.enter_context(no_hooks())
            # A cache of casts would keep parameters as they were.
            casts, dtype = autocast_of(device)
            stack.enter_context(torch.autocast(device.type, dtype, casts, cache_enabled=False))
            self.graphs = Graphs(steps, [inputs[name] for name in names], [name in wanted for name in names])
            with uncounted(steps.step), torch.random.fork_rng([device] if device.type == "cuda" else []):
                for _ in range(TRIALS):
                    self.graphs.try_out()
            self.graphs.record(None if kept is None else kept.graphs)
        # Which the graphs read, and mixtures give up for those of other particles.
        self._indices = [m.indices for m in steps.step.modules() if isinstance(m, Mixture)]
        self._counts = [count for _, _, count in counts_of(steps.step)]  # to which they write
        parts = [m for m in steps.step.modules() if isinstance(m, Step)]
        self._statuses = [(part.grid, part.status) for part in parts if part.status is not None]

    def watch(self, recordings: Recordings) -> None:
        """Ask the device how many blocks the latest steps wanted, unless it has not answered yet."""
        for grid, status in self._statuses:
            if not grid.watches:
                recordings.unseen = 0
            grid.watch(status)
        recordings.unseen += 1


def no_hooks() -> contextlib.AbstractContextManager[Any]:
    """Where what autograd keeps is none of what a checkpoint around a rollout counts, or moves to the host."""
    if torch._C._autograd._top_saved_tensors_default_hooks(True) is None:
        return contextlib.nullcontext()  # as transforms want it
    return torch.autograd.graph.saved_tensors_hooks(lambda t: t, lambda t: t)


class Graphs:
    """A function of tensors as a CUDA graph, and its gradients as another, which read and write the same memory in each
    replay.

    Args:
        steps: the function; it must not wait for the device.
        given: its arguments.
        wanted: of which there are gradients.

    Attributes:
        follows: whether a result has a gradient, for each of them; known after `record`.
    """

    def __init__(
        self, steps: Callable[..., tuple[Tensor, ...]], given: Sequence[Tensor], wanted: Sequence[bool]
    ) -> None:
        self._steps = steps
        self._device = given[0].device
        self.read = [copied(t.detach()).requires_grad_(w) for t, w in zip(given, wanted, strict=True)]
        self.follows: list[bool] = []

    def try_out(self) -> None:
        """Call the function and its gradients once, on the stream of graphs: what they make at a first call is none.

        Raises:
            ValueError: where gradients would pass to something that is no argument, whose replays would lose them.
        """
        with _on_own_stream(self._device):
            ends = self._steps(*self.read)
            if other := next(_others(ends, self.read), None):
                raise ValueError(
                    "a tensor that requires a gradient must be a parameter or buffer of the step or a field of the "
                    f"state to take part in steps from CUDA graphs, got {other}: make the function that reads it a "
                    "torch.nn.Module that has it"
                )
            self._gradients(ends, [torch.zeros_like(t) for t in ends if t.requires_grad])

    def _gradients(self, ends: Sequence[Tensor], grads: Sequence[Tensor]) -> list[Tensor | None]:
        outputs = [t for t in ends if t.requires_grad]
        if not outputs:
            return [None] * len(self.read)
        wanted = [t for t in self.read if t.requires_grad]
        with torch.autocast(self._device.type, enabled=False):  # as backward passes are taken
            found = iter(torch.autograd.grad(outputs, wanted, grads, allow_unused=True))
        return [next(found) if t.requires_grad else None for t in self.read]

    def record(self, beside: Graphs | None) -> None:
        """Make the graphs, in the memory of others where there are some."""
        self._forward, self._backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        self._memory: _GraphMemory = _GraphMemory(self._device) if beside is None else beside._memory
        with _into(self._forward, self._memory.pool, self._device):
            ends = self._steps(*self.read)
        self._memory.owned_by(self._forward)
        self.follows = [t.requires_grad for t in ends]
        self._grads = [torch.zeros_like(t) for t in ends if t.requires_grad]
        if self._grads:
            with _into(self._backward, self._memory.pool, self._device):
                self._found = self._gradients(ends, self._grads)
        self._ends = [t.detach() for t in ends]

    def forward(self, given: Sequence[Tensor]) -> Sequence[Tensor]:
        """The results, in memory that the next replay writes to."""
        with torch.no_grad():
            copy_all(self.read, given)
        self._forward.replay()
        return self._ends

    def backward(self, grads: Sequence[Tensor | None]) -> Sequence[Tensor | None]:
        """Gradients by the arguments of the latest replay, from those by the results."""
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
    """In words, the leaves beside the tensors that are read to which gradients of results would pass."""
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


class _Streams(threading.local):
    """The stream of a thread for each device on which graphs are captured: libraries keep memory for each stream.

    Attributes:
        of: the stream of a device.
        unused: graphs that are not replayed any more, each of which holds memory for later ones of its device.
    """

    def __init__(self) -> None:
        self.of: Callable[[torch.device], torch.cuda.Stream] = functools.cache(torch.cuda.Stream)
        self.unused: dict[torch.device, list[torch.cuda.CUDAGraph]] = collections.defaultdict(list)


_STREAMS = _Streams()


class _GraphMemory:
    """Memory that graphs share: that of graphs which are gone, where there is some.

    The allocator keeps the memory of a graph that is gone until it is short of memory, and other processes cannot have
    it. So the last user of the memory leaves one graph behind, whose memory the next recording takes.
    """

    def __init__(self, device: torch.device) -> None:
        self._unused = _STREAMS.unused[device]
        self._owner: torch.cuda.CUDAGraph | None = None
        if self._unused:
            self.owned_by(self._unused.pop())

    @property
    def pool(self) -> Any:
        """Identity of the memory; None before the first graph."""
        return None if self._owner is None else self._owner.pool()

    def owned_by(self, graph: torch.cuda.CUDAGraph) -> None:
        """Name the graph that holds the memory, unless there is one."""
        if self._owner is None:
            self._owner = graph
            weakref.finalize(self, self._unused.append, graph).atexit = False


@contextlib.contextmanager
def _on_own_stream(device: torch.device) -> Iterator[None]:
    """The stream of graphs as the current one, in order with the work before and after.

    The current stream waits on every way out, an exception included: memory of its tensors goes back to its allocator
    then, and would be given out again while kernels of the other stream still read it.
    """
    now, stream = torch.cuda.current_stream(device), _STREAMS.of(device)
    stream.wait_stream(now)
    try:
        with torch.cuda.stream(stream):
            yield
    finally:
        now.wait_stream(stream)


@contextlib.contextmanager
def _into(graph: torch.cuda.CUDAGraph, pool: Any, device: torch.device) -> Iterator[None]:
    """Operations go into a graph with the memory of a pool, None for new memory."""
    torch.cuda.synchronize(device)
    with _on_own_stream(device), capturing(graph, pool, device):
        yield
