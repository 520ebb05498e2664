"""Steps with an external stress, for simulators that are called with it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import NUMBERS, Same
from ..cuda_graphs.graph import Graphs, WorkInFlight, copy_all
from ..cuda_graphs.keys import StepKey, surroundings
from ..errors import check_like
from ..laws import Material
from ..ops.precision import from_half
from ..rollouts.graph_segments import another_device
from ..rollouts.reasons import why_not_captured
from ..state.state import State
from ..step.step import Step

Particles = tuple[Tensor, Tensor, Tensor, Tensor]
"""x, v, C and F."""
WATCHED = 16
"""Replays between two requests of the number of active blocks."""


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
        self._graph: Graphs | None = None
        self._in_flight: WorkInFlight | None = None
        self._status: Tensor | None = None  # of the graph
        self._unwatched = 0  # replays since the latest request of the number of blocks

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
        constants: Callable[[Tensor], tuple[Tensor, Tensor]],
        time: float,
        dt: float,
        end: Callable[[State], Particles],
        read: Iterable[Any] | None = None,
    ) -> Particles:
        """Particles after a step.

        Args:
            given: particles before it.
            stress: Kirchhoff stress [P, 3, 3] [Pa].
            constants: mass and volume [P] [kg, m³] of particles at positions.
            time: [s].
            dt: [s].
            end: particles of the state after the step. A capture of a graph calls it, and `constants`.
            read: numbers and tensors that `constants`, `end` and functions of the step depend on; None for steps that
                depend on others, such as the time.

        Raises:
            TypeError, ValueError: for wrong shapes, dtypes or devices.
        """

        def stepped(x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor) -> Particles:
            mass, volume = constants(x)
            return self._stepped(State(x=x, v=v, mass=mass, volume=volume, C=C, F=F, time=time), stress, dt, end)

        stress = from_half(stress, given[0])
        tensors = (*given, stress)
        kind = None if read is None else self._kind_of(tensors, dt, list(read))
        return stepped(*tensors) if kind is None else self._replayed(stepped, tensors, kind)

    def _stepped(self, state: State, stress: Tensor, dt: float, end: Callable[[State], Particles]) -> Particles:
        check_like("stress", stress, state.x, (len(state), 3, 3), "[P, 3, 3]")
        law = self.step.law
        assert isinstance(law, GivenStress)
        law.given = stress
        try:
            return end(self.step(state, dt))
        finally:
            law.given = None

    def _kind_of(self, given: tuple[Tensor, ...], dt: float, read: list[Any]) -> Hashable:
        """Key of calls with one graph; None for those without one."""
        x, step = given[0], self.step
        if not isinstance(x, Tensor) or not x.is_cuda or type(step) is not Step or step.heat is not None:
            return None
        if why_not_captured(step, dt, x) is not None or another_device(step, x.device) is not None:
            return None
        fixed = [*(value for value in read if isinstance(value, Tensor)), *step.parameters(), *step.buffers()]
        if torch.is_grad_enabled() and any([t.requires_grad for t in (*given, *fixed)]):
            return None
        if any([r.device != x.device if isinstance(r, Tensor) else not isinstance(r, NUMBERS) for r in read]):
            return None
        fields = tuple([(t.shape, t.dtype, t.device) for t in given])
        contents = tuple([Same(value) if isinstance(value, Tensor) else value for value in read])
        known = StepKey(step)
        with_gradients = tuple([(name, Same(t)) for name, t in known.own.items()])
        stream = torch.cuda.current_stream(x.device).cuda_stream
        return dt, fields, stream, surroundings(x.device), contents, known.key, with_gradients

    def _replayed(self, stepped: Callable[..., Particles], given: tuple[Tensor, ...], kind: Hashable) -> Particles:
        """Particles after a replay, or after a step that is captured if the next call is of the same kind."""
        step, x = self.step, given[0]
        blocks = step.grid.pool(x, None)
        if (kind, blocks) != self._kind or step.status is None:
            self._forget()
            self._kind = kind, blocks
            return stepped(*given)
        if self._graph is None or self._in_flight is None:
            with torch.inference_mode(False), torch.no_grad(), step._error_status.passing_graphs():
                self._graph = Graphs(stepped, given, [False] * len(given))
                self._graph.capture(None)
            self._in_flight, self._status = WorkInFlight(x), step._error_status.status
        self._continue_status()
        ends = self._graph.forward(given)
        self._in_flight.launched()
        x, v, C, F = after = [torch.empty_like(t) for t in ends]
        copy_all(after, ends)  # in one kernel
        self._watch()
        return x, v, C, F

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
        """Request the number of blocks once in a while, and wait for it before the next request."""
        grid = self.step.grid
        self._unwatched += 1
        if not grid.grows or self._unwatched < WATCHED:
            return
        assert self._status is not None
        grid.wait()
        self._unwatched = 0
        grid.watch(self._status)


def clamped(x: Tensor, lower: float | Tensor, upper: float | Tensor) -> Tensor:
    """Positions between two bounds, numbers or [P, 1]."""
    if not ((torch.is_grad_enabled() and x.requires_grad) or isinstance(lower, Tensor) or isinstance(upper, Tensor)):
        return x.clamp(lower, upper)
    return torch.minimum(torch.maximum(x, x.new_zeros(()) + lower), x.new_zeros(()) + upper)
