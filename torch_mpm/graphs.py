"""Steps from CUDA graphs: the host launches a step of many small kernels once, and replays it after that."""

from __future__ import annotations

import collections
import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from .activation_record import ActivationRecord
from .capture import GraphCache
from .errors import check_count, shape_of
from .grid import Grid
from .laws.custom import CustomLaw
from .parameters import has_hooks
from .state import FIELDS, State, check_state
from .step import Step

LEAST_STEPS = 6
"""For which a step is recorded: that takes the host as long as one or two steps."""
CHUNK = 64
"""Steps between two looks at how many blocks are active, where the pool follows the scene on CUDA."""


def time_after(time: float | Tensor, dt: float | Tensor, n: int) -> float | Tensor:
    """The time n steps later, rounded as single steps do."""
    for _ in range(n):
        time = time + dt
    return time


# ---- rollouts without gradients


def obstacle_to_replays(step: Any, state: State, dt: float | Tensor) -> str | None:
    """Why `replayed` cannot take the steps from a state; None where it can. What the library does not know stays in
    Python: a function may count its calls, or look at the time."""
    check_state(state)
    if type(step) is not Step:
        return "it is not a plain Step"
    if not state.x.is_cuda:
        return "there are no graphs on the CPU"
    if isinstance(dt, Tensor) or isinstance(state.time, Tensor):
        return "dt or the time of the state is a tensor"
    if torch.compiler.is_compiling() or torch.cuda.is_current_stream_capturing():
        return "it is compiled or captured"
    if torch._C._are_functorch_transforms_active() or torch.autograd.forward_ad._current_level >= 0:
        return "it is transformed"
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*_tensors(state).values(), *_all_of(step))):
        return "it is differentiated"
    if any(has_hooks(module) for module in step.modules()):
        return "there are hooks"
    if step.integrator is not None:
        return "an implicit step waits for its solve"
    if step.heat is not None and step.heat.method == "multigrid":
        return "multigrid does all of its iterations in a graph"
    if state.x.dtype != torch.float64 and step.boundaries.reads_time:
        return f"obstacles would look at a time in {str(state.x.dtype).removeprefix('torch.')}"
    return _foreign(step, state.x.device, [])


_NUMBERS = (type(None), bool, int, float, str, torch.dtype, torch.device)
_OWN = (GraphCache, ActivationRecord, Grid)
"""Made for graphs."""


def _foreign(part: Any, device: torch.device, seen: list[Any]) -> str | None:
    """What a step, or a part of it, has of the user's, or on another device; None for nothing."""
    if isinstance(part, _NUMBERS) or type(part) in _OWN or any(part is known for known in seen):
        return None
    if isinstance(part, Tensor):
        return None if part.device == device else f"a tensor of it is on {part.device}, the particles on {device}"
    seen.append(part)
    if type(part) in (dict, collections.OrderedDict):
        members = list(part.values())
    elif type(part) in (list, tuple, set) or (_is_known(part) and isinstance(part, tuple)):
        members = list(part)
    elif _is_known(part):
        members = list(vars(part).values())
    else:
        return f"it has something of the user's, {shape_of(part)}"
    return next(filter(None, (_foreign(member, device, seen) for member in members)), None)


def _is_known(part: Any) -> bool:
    known = type(part).__module__.startswith("torch_mpm.") or type(part) in (nn.ModuleList, nn.ModuleDict)
    return known and not isinstance(part, CustomLaw)


def _all_of(step: Step) -> list[Tensor]:
    gravity = [step.gravity] if isinstance(step.gravity, Tensor) else []
    return [*gravity, *step.parameters(), *step.buffers()]


def replayed(step: Step, state: State, n: int, dt: float) -> State:
    """The state n steps later, all but the first replays of a graph; `obstacle_to_replays` must be None.

    The first step from Python makes what steps keep, and asks about these tensors what would be a wait in the graph.
    """
    time = time_after(state.time, dt, n)
    # What begins later is made now, too: in a graph, nobody knows what time it is. Where nobody asks it stays a number,
    # but before the time zero, when obstacles begin that do not say otherwise.
    if n > LEAST_STEPS and (step.reads_time or state.time < 0):
        state = state.replace(time=_time_tensor(state))
    if n > 0:
        state, n = step(state, dt), n - 1
    replays = n if n >= LEAST_STEPS else 0
    state = replay_all(step, lambda state: step(state, dt), state, replays, CHUNK)
    for _ in range(n - replays):
        state = step(state, dt)
    return state.replace(time=time)


def replay_all(step: Step, function: Callable[[State], State], state: State, times: int, most: int) -> State:
    """`function`, applied so many times, as replays of a graph; of `most` of them where nobody looks meanwhile whether
    the pool must grow. One activation of the step must be before."""
    graph: Replays | None = None
    with step._activations.passing_graphs():
        while times > 0:
            count = min(times, most) if step.grid.grows else times
            step.grid.wait()
            blocks = step.grid.pool(state.x, state.scene)
            if graph is None or graph.blocks != blocks:
                graph = Replays(function, state, blocks)
            graph.replay(count)
            state, times = graph.state, times - count
            assert step.status is not None
            step.grid.watch(step.status)
    return state


class _Latest(threading.local):
    """For each stream of a thread, the one that graphs for it are captured on, and the latest of these graphs: the next
    one runs after it, and takes the same memory, which the allocator gives to the same stream alone."""

    def __init__(self) -> None:
        self.captures: dict[tuple[torch.device, int], tuple[torch.cuda.Stream, torch.cuda.CUDAGraph | None]] = {}


_LATEST = _Latest()


class Replays:
    """A graph of a function state -> state, of one step or of some, that leaves its state where it has found it.

    Args:
        function: what is recorded; it must not wait for the device.
        state: the state before the first replay; `Replays.state` is that after the last one.
        blocks: of the pool of its activations.
    """

    def __init__(self, function: Callable[[State], State], state: State, blocks: int) -> None:
        self.blocks = blocks
        self.state = state.map(_copied)
        impulse = None if state.impulse is None else _copied(state.impulse)
        self.state = self.state.replace(material=state.material, scene=state.scene, ids=state.ids, impulse=impulse)
        self._graph = torch.cuda.CUDAGraph()
        device = state.x.device
        now = torch.cuda.current_stream(device)
        place = device, now.cuda_stream
        aside, latest = _LATEST.captures.get(place) or (torch.cuda.Stream(device), None)
        aside.wait_stream(now)
        with torch.cuda.stream(aside):
            # Other threads may go on meanwhile.
            pool = None if latest is None else latest.pool()
            self._graph.capture_begin(pool, capture_error_mode="thread_local")
            self._record(function)
        now.wait_stream(aside)
        _LATEST.captures[place] = aside, self._graph

    def _record(self, function: Callable[[State], State]) -> None:
        try:
            before, after = _tensors(self.state), _tensors(function(self.state))
            changed = [name for name, value in after.items() if value is not before[name]]
            _copy_all([before[name] for name in changed], [after[name] for name in changed])
        except BaseException:
            with contextlib.suppress(RuntimeError):  # the capture has failed, as what is raised says
                self._graph.capture_end()
            raise
        self._graph.capture_end()

    def replay(self, times: int) -> None:
        for _ in range(times):
            self._graph.replay()


def _copy_all(to: Sequence[Tensor], of: Sequence[Tensor]) -> None:
    """Copy tensors, those of one dtype in one kernel."""
    for dtype in {t.dtype for t in to}:
        alike = [k for k, t in enumerate(to) if t.dtype == dtype]
        torch._foreach_copy_([to[k] for k in alike], [of[k] for k in alike])


def _copied(t: Tensor) -> Tensor:
    """A copy with the strides of a tensor, gaps included, which `clone` closes."""
    if 0 in t.stride():  # entries that are one
        return t.clone()
    return torch.empty_strided(t.shape, t.stride(), dtype=t.dtype, device=t.device).copy_(t)


def _time_tensor(state: State) -> Tensor:
    if isinstance(state.time, Tensor):
        return state.time
    return torch.full((), state.time, dtype=torch.float64, device=state.x.device)


def _tensors(state: State) -> dict[str, Tensor]:
    """The tensors of a state by name, those of `extra` as "extra.name"."""
    fields = {name: getattr(state, name) for name in FIELDS if name != "extra"}
    fields |= {f"extra.{name}": value for name, value in state.extra.items()}
    return {name: value for name, value in fields.items() if isinstance(value, Tensor)}


def _with(state: State, tensors: dict[str, Tensor | None]) -> State:
    extra = {name.removeprefix("extra."): value for name, value in tensors.items() if name.startswith("extra.")}
    fields: dict[str, Any] = {name: value for name, value in tensors.items() if not name.startswith("extra.")}
    return state.replace(**fields, extra={**state.extra, **extra})


# ---- training


class Captured:
    """What `captured` returns: call it with a state like the one it was captured with."""

    def __init__(self, step: nn.Module, state: State, dt: float, n: int) -> None:
        self._steps = _Steps(step, state, dt, n)
        inputs = self._steps.inputs(self._steps.prepared(state))
        self._given = {name: _kind(t) for name, t in inputs.items()}
        self._read = tuple(_copied(t.detach()).requires_grad_(t.requires_grad) for t in inputs.values())
        self._call: Any = torch.cuda.make_graphed_callables(self._steps, self._read, allow_unused_input=True)

    def __call__(self, state: State) -> State:
        prepared = self._steps.prepared(state)
        inputs = self._steps.inputs(prepared)
        kinds = {name: _kind(t) for name, t in inputs.items()}
        if kinds != self._given:
            expected, came = (
                "; ".join(f"{name} {_told(kind)}" for name, kind in k.items()) for k in (self._given, kinds)
            )
            raise ValueError(f"state must be as it was captured, {expected}; got {came}")
        given, differentiable = [inputs[name] for name in self._given], torch.is_grad_enabled()
        with torch.no_grad():
            _copy_all(self._read, given)
        outputs = self._call(
            *(
                _OwnGradient.apply(t, (read,)) if differentiable and t.requires_grad else read
                for t, read in zip(given, self._read, strict=True)
            )
        )
        results: dict[str, Any] = {name: t.clone() for name, t in zip(self._steps.changed, outputs, strict=True)}
        if not isinstance(state.time, Tensor):
            results["time"] = time_after(state.time, self._steps.dt, self._steps.n)
        return _with(prepared, results | dict.fromkeys(self._steps.dropped))


def _kind(t: Tensor) -> tuple[Any, ...]:
    return t.shape, t.dtype, t.device, t.requires_grad


def _told(kind: tuple[Any, ...]) -> str:
    shape, dtype, device, differentiable = kind
    return f"{tuple(shape)} {dtype} on {device}{' with a gradient' if differentiable else ''}"


class _OwnGradient(torch.autograd.Function):
    """What a graph reads in the place of a tensor. Its gradient is a copy: that of the graph is overwritten by the next
    replay."""

    @staticmethod
    def forward(ctx: Any, t: Tensor, read: tuple[Tensor]) -> Tensor:
        ctx.set_materialize_grads(False)
        return read[0].detach()

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        return None if grads[0] is None else grads[0].clone(), None


class _Steps:
    """Steps as a function of tensors to tensors: those of the state, and those of the step that may have gradients."""

    def __init__(self, step: nn.Module, state: State, dt: float, n: int) -> None:
        self.step, self.dt, self.n = step, dt, n
        self.changed: list[str] = []
        self.dropped: list[str] = []
        self._like = self.prepared(state)
        self._names = list(self.inputs(self._like))

    def prepared(self, state: State) -> State:
        """With the fields that steps need, and its time as a tensor."""
        prepare = getattr(self.step, "prepare", None)
        state = state if prepare is None else prepare(state)
        return state.replace(time=_time_tensor(state))

    def inputs(self, prepared: State) -> dict[str, Tensor]:
        """Of a prepared state and the step."""
        named = (*self.step.named_parameters(), *self.step.named_buffers())
        return _tensors(prepared) | {f"step.{name}": t for name, t in named if t.requires_grad}

    def __call__(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(self._names, tensors, strict=True))
        own = {name.removeprefix("step."): given.pop(name) for name in self._names if name.startswith("step.")}
        state = _with(self._like, {**given})
        for _ in range(self.n):
            state = torch.func.functional_call(self.step, own, (state, self.dt))
        ends = _tensors(state)
        results = {name: t for name, t in ends.items() if t is not given.get(name)}
        self.changed, self.dropped = list(results), [name for name in given if name not in ends]
        return tuple(results.values())


def captured(step: nn.Module, state: State, dt: float, n: int = 1) -> Captured:
    """n steps as one CUDA graph, and their backward pass as another: for training with networks in a step, where
    launching its kernels one by one takes longer than running them.

        advance = torch_mpm.captured(step, state, dt=1e-4, n=8)
        for batch in data:
            loss(advance(batch)).backward()

    The graphs read and write the same memory in each call: call backward before the next call, and capture all steps
    between which gradients pass as one, with `n`. Parameters and buffers are read anew in each call; numbers and Python
    code are those of the capture, which calls the step some times. The pool of blocks stays as it is: give the grid
    `max_blocks` with room for what comes, and `Step.check` tells where it has not been enough. Obstacles look at the
    time in the precision of the particles.

    Args:
        step: a `Step`, or another module (state, dt) -> state; no hooks.
        state: a state like those to come, on a CUDA device: the same fields, shapes and dtypes. Gradients pass to the
            fields that require them here, and to parameters and buffers of the step that do.
        dt: time step [s].
        n: number of steps.

    Returns:
        A function state -> state n steps later, differentiable once.

    Raises:
        TypeError, ValueError: for a wrong argument, and in calls for another kind of state.
        RuntimeError: where something in the step waits for the device, which a graph cannot.
    """
    if not isinstance(step, nn.Module):
        raise TypeError(f"step must be a Step or another module (state, dt) -> state, got {shape_of(step)}")
    check_state(state)
    check_count("n", n, 1)
    if not state.x.is_cuda:
        raise ValueError(f"state must be on a CUDA device, got {state.x.device}")
    if any(has_hooks(module) for module in step.modules()):
        raise ValueError("step must have no hooks, nor any of its parts: a graph would not call them")
    return Captured(step, state, dt, n)
