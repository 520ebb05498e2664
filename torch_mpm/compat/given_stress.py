"""Steps with an external stress, for simulators that are called with it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import NUMBERS, Same, is_eager, version
from ..cuda_graphs.graph import Replays, WorkInFlight, copy_all
from ..cuda_graphs.keys import StepKey, surroundings
from ..errors import check_like
from ..laws import Material
from ..laws.parameters import has_hooks
from ..ops.precision import from_half
from ..rollouts.anomaly import detecting
from ..state.state import State, tensors_of
from ..step.step import Step

Particles = tuple[Tensor, Tensor, Tensor, Tensor]
"""x, v, C and F."""
STRESS = "stress"
"""Field of the states of a graph."""


class GivenStress(Material):
    """Law that returns the stress that was set last."""

    def __init__(self) -> None:
        super().__init__()
        self.given: Tensor | None = None

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert self.given is not None
        return {}, self.given

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        return ~state.F.isfinite().all((1, 2))


class GivenStressSteps:
    """Steps of a `GivenStress`, one by one.

    On CUDA and without gradients the second and later calls of one kind replay a CUDA graph, which the host launches in
    the time of a few kernels.

    Args:
        step: the step; it may be changed between two calls.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self._forget()

    def _forget(self) -> None:
        self._kind: Hashable = None
        self._replays: Replays | None = None
        self._in_flight: WorkInFlight | None = None
        self._status: Tensor | None = None  # of the graph
        self._unseen = 0  # replays since the latest block count

    def __getstate__(self) -> dict[str, Any]:
        """State for copies, without the graph."""
        return {"step": self.step}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.step = state["step"]
        self._forget()

    def __call__(
        self,
        given: Particles,
        stress: Tensor,
        mass: Tensor,
        volume: Tensor,
        time: float,
        dt: float,
        end: Callable[[State], Particles],
        read: Iterable[Any] | None = None,
    ) -> Particles:
        """Particles after a step.

        Args:
            given: particles before it.
            stress: Kirchhoff stress [P, 3, 3] [Pa].
            mass, volume: [P] [kg, m³].
            time: [s].
            dt: [s].
            end: particles of the state after the step; called in the capture of a graph.
            read: numbers and tensors that mass, volume, `end` and functions of the step depend on; None for steps that
                depend on others, such as the time.

        Raises:
            TypeError, ValueError: for wrong shapes, dtypes or devices.
        """
        x, v, C, F = given
        stress = from_half(stress, x)
        check_like("stress", stress, x, (len(x), 3, 3), "[P, 3, 3]")
        state = State(x=x, v=v, mass=mass.to(x), volume=volume.to(x), C=C, F=F, time=time)
        kind = None if read is None else self._kind_of(state, stress, dt, list(read))
        if kind is not None and self._may_replay(state, kind):
            return self._replayed(state, stress, dt, end)
        return self._stepped(state, stress, dt, end)

    def _stepped(self, state: State, stress: Tensor, dt: float, end: Callable[[State], Particles]) -> Particles:
        law = self.step.law
        assert isinstance(law, GivenStress)
        law.given = stress
        try:
            return end(self.step(state, dt))
        finally:
            law.given = None

    def _kind_of(self, state: State, stress: Tensor, dt: float, read: list[Any]) -> Hashable:
        """Key of calls with one graph; None for those without one."""
        x, step = state.x, self.step
        if not x.is_cuda or not is_eager(x) or detecting() or type(step) is not Step:
            return None
        if step.integrator is not None or step.heat is not None or any(has_hooks(m) for m in step.modules()):
            return None
        tensors = [value for value in read if isinstance(value, Tensor)]
        fixed = [*tensors, *step.parameters(), *step.buffers()]
        if torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors_of(state).values(), stress, *fixed)):
            return None
        if any(t.is_inference() or t.device != x.device for t in fixed):
            return None
        if not all(isinstance(value, (Tensor, *NUMBERS)) for value in read):
            return None
        contents = tuple((Same(value), version(value)) if isinstance(value, Tensor) else value for value in read)
        known = StepKey(step)
        with_gradients = tuple((name, Same(t)) for name, t in known.own.items())
        place = x.device, torch.cuda.current_stream(x.device).cuda_stream, surroundings(x.device)
        return dt, len(x), x.dtype, place, contents, known.key, with_gradients

    def _may_replay(self, state: State, kind: Hashable) -> bool:
        """Whether the previous call was of this kind too, and its pool is large enough."""
        step = self.step
        if step.grid.grows and self._unseen > 1:
            step.grid.wait()
        kind = kind, step.grid.pool(state.x, None)
        if kind == self._kind and step.status is not None:
            return True
        self._forget()
        self._kind = kind
        return False

    def _replayed(self, state: State, stress: Tensor, dt: float, end: Callable[[State], Particles]) -> Particles:
        if self._replays is None:
            self._capture(state.replace(extra={STRESS: stress}), dt, end)
        assert self._replays is not None and self._in_flight is not None
        self._continue_status()
        graph = self._replays.state
        to, of = (graph.x, graph.v, graph.C, graph.F, graph.extra[STRESS]), (state.x, state.v, state.C, state.F, stress)
        pairs = [(a, b) for a, b in zip(to, of, strict=True) if a is not None and b is not None]
        copy_all([a for a, _ in pairs], [b for _, b in pairs])
        self._replays.replay(1, self._in_flight)
        self._watch()
        x, v, C, F = (a.clone() for a, _ in pairs[:4])
        return x, v, C, F

    def _capture(self, state: State, dt: float, end: Callable[[State], Particles]) -> None:
        def advanced(state: State) -> State:
            x, v, C, F = self._stepped(state.replace(extra={}), state.extra[STRESS], dt, end)
            return state.replace(x=x, v=v, C=C, F=F)

        errors = self.step._error_status
        with torch.inference_mode(False), torch.no_grad(), errors.passing_graphs():
            self._replays = Replays(advanced, state, self.step.grid.pool(state.x, None))
        self._in_flight, self._status = WorkInFlight(state.x), errors.status

    def _continue_status(self) -> None:
        """Let the graph continue the status of steps that were computed without it."""
        errors = self.step._error_status
        if errors.status is self._status:
            return
        assert errors.status is not None and self._status is not None
        with torch.inference_mode():  # Any tensor may be written to there.
            self._status.copy_(errors.status)
        errors.status = self._status

    def _watch(self) -> None:
        """Request the number of blocks of the latest step, unless a request is pending."""
        assert self._status is not None
        self._unseen = self._unseen + 1 if self.step.grid.watches else 0
        self.step.grid.watch(self._status)


def clamped(x: Tensor, lower: float | Tensor, upper: float | Tensor) -> Tensor:
    """Positions between two bounds, numbers or [P, 1]."""
    if not ((torch.is_grad_enabled() and x.requires_grad) or isinstance(lower, Tensor) or isinstance(upper, Tensor)):
        return x.clamp(lower, upper)
    return torch.minimum(torch.maximum(x, x.new_zeros(()) + lower), x.new_zeros(()) + upper)
