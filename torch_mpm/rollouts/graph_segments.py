"""CUDA graphs of steps with user functions, and of their gradients, for training with networks in a step."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ..boundaries.control import control_step, steady
from ..cuda_graphs.capture import CapturedGraphs, Same
from ..cuda_graphs.graph import Graphs, WorkInFlight, no_hooks, time_tensor
from ..cuda_graphs.keys import StepKey, autocast_of, surroundings
from ..errors import check_count, shape_of
from ..grid.grid import own_pools
from ..laws.mixture import Mixture
from ..laws.parameters import has_hooks
from ..state.state import EXTRA, TRACKED, State, check_state, tensors_of
from ..step.clocks import time_after
from ..step.status import counts_of, uncounted
from ..step.step import Step
from .steps import Steps

TRIALS = 3
"""Number of times that steps are computed from Python before they are captured, as torch does: compilers of user code
trace or tune in the first ones."""


def make_graphed_step(step: nn.Module, state: State | None, dt: float, n: int = 1) -> GraphedStep:
    """Function of n steps as one CUDA graph, with the backward pass as another.

    It serves training with networks in a step, where launching the kernels takes longer than running them.

        advance = torch_mpm.make_graphed_step(step, state, dt=1e-4, n=8)
        for batch in data:
            loss(advance(batch)).backward()

    A capture takes as long as a few rollouts of n steps. The graphs of the latest 8 captures are stored. A call
    captures again after a change of one of these:

    - the fields of the state, their shapes and dtypes, and those that require gradients;
    - the grad mode or autocast;
    - the pool of a grid without `max_blocks`, if it grew;
    - assigned numbers, tensors and parts of the step. For example, a pose assigned to an obstacle between two calls
      (see `Obstacle`) makes the next call capture: give the obstacle a path instead, or call `rollout`.

    Captured graphs share memory: as much as the largest ones need (with gradients, everything that autograd stores for
    n steps), and for each capture the state and parameters before and after the steps.

    Parameters and buffers are read in each call. Code, and numbers in user modules, are those of the capture, which
    calls the step a few times with `state.time` as a tensor. The graphs read and write the same memory in each call: a
    backward pass after another call recomputes its steps. `rollout(graph=n)` divides a rollout into such graphs.

    Args:
        step: a `Step`, or another module (state, dt) -> state; no hooks.
        state: a state like those to come, on a CUDA device. Gradients pass to the fields that require them, and to
            parameters and buffers of the step that do. None: the first call captures.
        dt: time step [s].
        n: number of steps.

    Returns:
        A function state -> state n steps later, differentiable once; for one thread at a time.

    Raises:
        TypeError, ValueError: for a wrong argument, and for a tensor with a gradient that the steps read but that is
            no parameter or buffer of the step.
        RuntimeError: a part of the step waits for the device, which a graph cannot.
    """
    if not isinstance(step, nn.Module):
        raise TypeError(f"step must be a Step or another module (state, dt) -> state, got {shape_of(step)}")
    check_count("n", n, 1)
    refuse_hooks(step)
    result = GraphedStep(step, dt, int(n), CapturedGraphs())
    if state is not None:
        result.capture(state)
    return result


# ---- in rollouts


def graphed_steps(steps: Steps, state: State, most: int) -> State:
    """The state after the steps, by graphs of `most` steps and one of the remaining steps, for plans with the executor
    "graph".

    The inputs of each graph are stored for the backward pass, which recomputes the steps of all but the last one.
    """
    step, n, dt, *_ = steps
    assert isinstance(step, nn.Module) and not isinstance(dt, Tensor)
    graphs = step.__dict__.setdefault("_captured_graphs", CapturedGraphs())
    known = StepKey(step)
    in_flight = WorkInFlight(state.x, most)
    while n > 0:
        count = min(n, most)
        state = GraphedStep(step, dt, count, graphs).after(state, known, alike=True)
        in_flight.launched()
        n -= count
    return state


def refuse_hooks(step: nn.Module) -> None:
    if any(has_hooks(module) for module in step.modules()):
        raise ValueError("step must have no hooks, nor any of its parts: a graph would not call them")


def has_graphs(device: torch.device) -> bool:
    return device.type == "cuda"


def another_device(step: nn.Module, device: torch.device) -> torch.device | None:
    """Another device that a parameter or buffer of the step is on, whose value would be a constant in a graph; None
    without one."""
    return next((t.device for t in (*step.parameters(), *step.buffers()) if t.device != device), None)


# ---- calls


class GraphedStep:
    """Result of `make_graphed_step`: a function state -> state."""

    def __init__(self, step: nn.Module, dt: float, n: int, graphs: CapturedGraphs) -> None:
        self._step, self._dt, self._n, self._graphs = step, dt, n, graphs

    def __call__(self, state: State) -> State:
        check_state(state)
        with control_step(self._step, state, self._n, self._dt) as end_motion:
            return end_motion(self.after(state, StepKey(self._step)))

    def capture(self, state: State) -> None:
        """Capture the steps for states like this one, in the current grad mode and autocast."""
        known = StepKey(self._step)
        self._captured(self._prepared(state), known, False)

    def after(self, state: State, known: StepKey, alike: bool = False) -> State:
        """The state n steps later.

        Args:
            state: the state.
            known: key of the step as it is now.
            alike: whether all fields that steps change count as requiring a gradient if any input does, so that one
                capture serves all segments of a rollout.
        """
        prepared = self._prepared(state)
        captured, given = self._captured(prepared, known, alike)
        call = _Call(self._step, self._graphs, captured)
        if captured.wanted:
            ends = _Replayed.apply(call, *given)
        else:
            with torch.no_grad():
                ends = call.forward(given)
        captured.watch(self._graphs)
        results: dict[str, Any] = dict(zip(captured.steps.changed, ends, strict=True))
        if isinstance(self._step, Step) and not isinstance(state.time, Tensor):
            results["time"] = time_after(state.time, self._dt, self._n)
        return _with(prepared, results | captured.steps.dropped)

    def _check(self, device: torch.device) -> None:
        """Check that the step can be captured now.

        Raises:
            ValueError: for a step with hooks, or with a tensor on another device.
        """
        refuse_hooks(self._step)
        if (place := another_device(self._step, device)) is not None:
            raise ValueError(f"step must be on the device of the state, {device}, got a tensor on {place}")

    def _prepared(self, state: State) -> State:
        """The state with the fields that steps need, and with its time as a tensor."""
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

    def _captured(self, prepared: State, known: StepKey, alike: bool) -> tuple[_CapturedSteps, list[Tensor]]:
        """The captured steps for a state, captured now if there are none, and their inputs."""
        inputs = tensors_of(prepared) | known.own
        fixed = {name: self._graphs.same_content(name, inputs.pop(name)) for name in known.by_content(prepared)}
        wanted = {name for name, t in inputs.items() if torch.is_grad_enabled() and t.requires_grad}
        if alike and wanted:
            wanted |= {name for name, t in inputs.items() if name in TRACKED or name.startswith(EXTRA)}
            wanted = {name for name in wanted if inputs[name].is_floating_point()}
        kinds = frozenset((name, t.shape, t.dtype, t.device, name in wanted) for name, t in inputs.items())
        contents = tuple((name, Same(t)) for name, t in fixed.items())
        around = self._n, self._dt, surroundings(prepared.x.device), contents
        known.follow(prepared, self._graphs.unseen)
        captured = self._graphs.get((kinds, around, known.key, known.pools()))
        if captured is None:
            self._check(prepared.x.device)
            steps = _Steps(self._step, self._dt, self._n, prepared, fixed, list(inputs))
            captured = _CapturedSteps(steps, inputs, wanted, self._graphs)
            known.refresh()
            self._graphs.keep((kinds, around, known.key, known.pools()), captured)
        return captured, [inputs[name] for name in captured.steps.names]


def _with(state: State, tensors: Mapping[str, Any]) -> State:
    extra = {name.removeprefix(EXTRA): value for name, value in tensors.items() if name.startswith(EXTRA)}
    fields: dict[str, Any] = {name: value for name, value in tensors.items() if not name.startswith(EXTRA)}
    kept = {name: value for name, value in {**state.extra, **extra}.items() if value is not None}
    return state.replace(**fields, extra=kept)


class _Steps:
    """Steps as a function of tensors to tensors: those of the state, and those of the step that may have gradients.

    Args:
        fixed: fields that are no arguments: the same tensors in each call.
        names: names of the arguments.

    Attributes:
        changed: names of the results.
        dropped: fields that are no tensors after the steps: None, or the time as a number. Both are set by a call.
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
        assert step is not None, "captured graphs are deleted with their step"
        return step

    def __call__(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(self.names, tensors, strict=True))
        own = {name.removeprefix("step."): given.pop(name) for name in self.names if name.startswith("step.")}
        state = begin = _with(self._like, given).replace(**self._fixed)
        self._like = begin.detach()  # so that the first state and its autograd graph can be freed
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
    """One call of captured steps. Its backward pass recomputes the steps if another call has used the memory since."""

    def __init__(self, step: nn.Module, graphs: CapturedGraphs, captured: _CapturedSteps) -> None:
        self._step, self._graphs, self.captured = step, graphs, captured
        self._mark = object()  # identifies this call in the captured graphs, which must not keep the call alive
        self._random = _random_numbers(captured.steps.device) if captured.wanted else None

    def forward(self, given: Sequence[Tensor]) -> list[Tensor]:
        self._graphs.latest = self._mark
        with self._graphs.in_turn(self.captured.steps.device):
            return [t.clone() for t in self.captured.graphs.forward(given)]

    def gradients(self, given: Sequence[Tensor], grads: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Gradients with respect to the arguments; None where there is none."""
        graphs = self.captured.graphs
        with self._graphs.in_turn(self.captured.steps.device):
            if self._graphs.latest is not self._mark:
                with uncounted(self._step), self._same_random_numbers():
                    graphs.forward(given)
            self._graphs.latest = None  # The backward pass overwrites its inputs.
            # The next replay overwrites its gradients.
            return [None if grad is None else grad.clone() for grad in graphs.backward(grads)]

    @contextlib.contextmanager
    def _same_random_numbers(self) -> Iterator[None]:
        device = self.captured.steps.device
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
    """The steps of a call as one operation, for which only the arguments are stored."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *given: Tensor) -> tuple[Tensor, ...]:
        ctx.call = call
        ctx.save_for_backward(*given)
        ctx.set_materialize_grads(False)
        ends = call.forward(given)
        follows = call.captured.graphs.follows
        ctx.mark_non_differentiable(*(t for t, with_gradient in zip(ends, follows, strict=True) if not with_gradient))
        return tuple(ends)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> Any:
        return None, *ctx.call.gradients(ctx.saved_tensors, grads)


# ---- captured graphs


class _CapturedSteps:
    """Graphs of steps and their gradients for one kind of states, with the status tensors that count their blocks."""

    def __init__(self, steps: _Steps, inputs: Mapping[str, Tensor], wanted: set[str], graphs: CapturedGraphs) -> None:
        self.steps, self.wanted = steps, bool(wanted)
        kept, device = graphs.some(), steps.device
        graphs.latest = None
        names, with_gradients = steps.names, torch.is_grad_enabled()
        with contextlib.ExitStack() as stack:
            stack.enter_context(own_pools())
            stack.enter_context(torch.inference_mode(False))
            stack.enter_context(torch.set_grad_enabled(with_gradients))
            stack.enter_context(no_hooks())
            # A cache of casts would hold old values of parameters.
            casts, dtype = autocast_of(device)
            stack.enter_context(torch.autocast(device.type, dtype, casts, cache_enabled=False))
            self.graphs = Graphs(steps, [inputs[name] for name in names], [name in wanted for name in names])
            with uncounted(steps.step), torch.random.fork_rng([device] if device.type == "cuda" else []):
                for _ in range(TRIALS):
                    self.graphs.try_out()
            self.graphs.capture(None if kept is None else kept.graphs)
        # The graphs read these tensors, which mixtures replace for other particles.
        self._indices = [m.indices for m in steps.step.modules() if isinstance(m, Mixture)]
        self._counts = [count for _, _, count in counts_of(steps.step)]  # The graphs write to these.
        parts = [m for m in steps.step.modules() if isinstance(m, Step)]
        self._statuses = [(part.grid, part.status) for part in parts if part.status is not None]

    def watch(self, graphs: CapturedGraphs) -> None:
        """Request the block count of the latest steps from the device, unless a request is pending."""
        for grid, status in self._statuses:
            if not grid.watches:
                graphs.unseen = 0
            grid.watch(status)
        graphs.unseen += 1
