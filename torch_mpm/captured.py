"""Steps from CUDA graphs: the host launches a step of many small kernels once, and their replays after that."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor, nn

from .activation_record import ActivationRecord
from .capture import GraphCache
from .errors import check_count, shape_of
from .grid import Grid
from .laws.custom import CustomLaw
from .parameters import has_hooks
from .state import State, check_state
from .step import Step

LEAST_STEPS = 6
"""Of one recording, which takes the host as long as some steps do."""
CHUNK = 64
"""Replays between which the pool of blocks follows the scene."""

_FIELDS = tuple(f.name for f in dataclasses.fields(State) if f.name not in ("extra", "time"))


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
    return _foreign(step, state.x.device, [])


_NUMBERS = (type(None), bool, int, float, str, torch.dtype, torch.device)
_OWN = (GraphCache, ActivationRecord, Grid)
"""Made for graphs."""


def _foreign(part: Any, device: torch.device, seen: list[Any]) -> str | None:
    """What a step, or a part of it, has of the user's, or on another device; None for nothing."""
    if isinstance(part, _NUMBERS) or isinstance(part, _OWN) or any(part is known for known in seen):
        return None
    if isinstance(part, Tensor):
        return None if part.device == device else f"a tensor of it is on {part.device}, the particles on {device}"
    seen.append(part)
    if isinstance(part, dict):
        members = list(part.values())
    elif isinstance(part, (list, tuple, set)):
        members = list(part)
    elif _is_known(part):
        members = list(vars(part).values())
    else:
        return f"it has something of the user's, {shape_of(part)}"
    return next(filter(None, (_foreign(member, device, seen) for member in members)), None)


def _all_of(step: Step) -> list[Tensor]:
    gravity = [step.gravity] if isinstance(step.gravity, Tensor) else []
    return [*gravity, *step.parameters(), *step.buffers()]


def replayed(step: Step, state: State, n: int, dt: float) -> State:
    """The state n steps later, all but the first replays of a graph; `obstacle_to_replays` must be None.

    The first step from Python makes what steps keep, and asks about these tensors what would be a wait in the graph.
    """
    time = state.time
    for _ in range(n):
        time = time + dt
    if n > 0:
        state, n = step(state, dt), n - 1
    graph: _Replays | None = None
    while n >= LEAST_STEPS:
        count = min(n, CHUNK) if step.grid.grows else n
        step.grid.wait()
        blocks = step.grid.pool(state.x, state.scene)
        if graph is None or graph.blocks != blocks:
            graph = _Replays(step, state, dt, blocks)
        graph.replay(count)
        state, n = graph.state, n - count
        assert step.status is not None
        step.grid.watch(step.status)
    for _ in range(n):
        state = step(state, dt)
    return state.replace(time=time)


class _Replays:
    """A graph of one step that leaves its state where it has found it."""

    def __init__(self, step: Step, state: State, dt: float, blocks: int) -> None:
        self.blocks = blocks
        self.state = state.map(_copied).replace(time=_time_tensor(state))
        self.state = self.state.replace(material=state.material, scene=state.scene, ids=state.ids)
        self._graph = torch.cuda.CUDAGraph()
        stream = torch.cuda.Stream(state.x.device)
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self._graph.capture_begin(capture_error_mode="thread_local")  # others may go on meanwhile
            try:
                before, after = _tensors(self.state), _tensors(step(self.state, dt))
                for name, value in after.items():
                    if value is not before[name]:
                        before[name].copy_(value)
            finally:
                self._graph.capture_end()
        torch.cuda.current_stream().wait_stream(stream)

    def replay(self, times: int) -> None:
        for _ in range(times):
            self._graph.replay()


def _copied(t: Tensor) -> Tensor:
    """A copy with the strides of a tensor, gaps included, which `clone` closes."""
    return torch.empty_strided(t.shape, t.stride(), dtype=t.dtype, device=t.device).copy_(t)


def _time_tensor(state: State) -> Tensor:
    if isinstance(state.time, Tensor):
        return state.time
    return torch.full((), state.time, dtype=torch.float64, device=state.x.device)


def _tensors(state: State) -> dict[str, Tensor]:
    """The tensors of a state by name, those of `extra` as "extra.name"."""
    fields = {name: getattr(state, name) for name in (*_FIELDS, "time")}
    fields |= {f"extra.{name}": value for name, value in state.extra.items()}
    return {name: value for name, value in fields.items() if isinstance(value, Tensor)}


def _with(state: State, tensors: dict[str, Tensor]) -> State:
    extra = {name.removeprefix("extra."): value for name, value in tensors.items() if name.startswith("extra.")}
    fields = {name: value for name, value in tensors.items() if not name.startswith("extra.")}
    return state.replace(**fields, extra={**state.extra, **extra})


def _is_known(part: Any) -> bool:
    known = type(part).__module__.startswith("torch_mpm.") or isinstance(part, (nn.ModuleList, nn.ModuleDict))
    return known and not isinstance(part, CustomLaw)


# ---- training


class Captured:
    """What `captured` returns: call it with a state like the one it was captured with."""

    def __init__(self, step: nn.Module, state: State, dt: float, n: int) -> None:
        self._flat = _Flat(step, state, dt, n)
        self._duration = n * dt
        self._given = {name: (t.shape, t.dtype) for name, t in self._flat.inputs(state).items()}
        samples = tuple(_copied(t.detach()).requires_grad_(t.requires_grad) for t in self._flat.inputs(state).values())
        self._call: Any = torch.cuda.make_graphed_callables(self._flat, samples, allow_unused_input=True)

    def __call__(self, state: State) -> State:
        tensors = self._flat.inputs(state)
        if {name: (t.shape, t.dtype) for name, t in tensors.items()} != self._given:
            expected = ", ".join(f"{name} {tuple(shape)} {dtype}" for name, (shape, dtype) in self._given.items())
            came = ", ".join(f"{name} {tuple(t.shape)} {t.dtype}" for name, t in tensors.items())
            raise ValueError(f"state must be as it was captured, {expected}; got {came}")
        results = dict(zip(self._flat.changed, (t.clone() for t in self._call(*tensors.values())), strict=True))
        if not isinstance(state.time, Tensor):
            results["time"] = state.time + self._duration
        return _with(state, results)


class _Flat(nn.Module):
    """Steps as a function of tensors to tensors."""

    def __init__(self, step: nn.Module, state: State, dt: float, n: int) -> None:
        super().__init__()
        self.step = step
        self._like, self._dt, self._n = state, dt, n
        self.changed: list[str] = []

    def inputs(self, state: State) -> dict[str, Tensor]:
        """The tensors of a state with the fields that steps need, and its time."""
        prepare = getattr(self.step, "prepare", None)
        state = state if prepare is None else prepare(state)
        return _tensors(state.replace(time=_time_tensor(state)))

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(self.inputs(self._like), tensors, strict=True))
        state = _with(self._like, given)
        for _ in range(self._n):
            state = self.step(state, self._dt)
        results = {name: t for name, t in _tensors(state).items() if t is not given.get(name)}
        self.changed = list(results)
        return tuple(results.values())


def captured(step: nn.Module, state: State, dt: float, n: int = 1) -> Captured:
    """n steps as one CUDA graph, and their backward pass as another: for training with networks in a step, where
    launching its kernels one by one takes longer than running them.

        advance = torch_mpm.captured(step, state, dt=1e-4, n=8)
        for batch in data:
            loss(advance(batch)).backward()

    The graphs read and write the same memory in each call: call backward before the next call, and capture all steps
    between which gradients pass as one, with `n`. Parameters are read anew in each call; numbers and Python code are
    those of the capture, which calls the step four times. The pool of blocks stays as it is: give the grid `max_blocks`
    with room for what comes, and `Step.check` tells where it has not been enough.

    Args:
        step: a `Step`, or another module (state, dt) -> state; no hooks.
        state: a state like those to come, on a CUDA device: the same fields, shapes and dtypes. Gradients pass to the
            fields that require them here.
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
    return Captured(step, state, dt, n)
