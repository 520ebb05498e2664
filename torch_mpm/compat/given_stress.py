"""Steps with an external stress, for simulators that are called with it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import Same, is_eager, version
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


class GivenStress(Material):
    """Law that returns the stress in `extra` of the state."""

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        return {}, state.extra[STRESS]

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        return ~state.F.isfinite().all((1, 2))


class GivenStressSteps:
    """Steps of a `GivenStress`, one by one.

    On CUDA and without gradients the second and later calls of one kind replay a CUDA graph: a launch of it takes the
    host as long as that of a few kernels.

    Args:
        step: the step; it may be changed between two calls.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self._kind: Hashable = None
        self._replays: Replays | None = None
        self._unseen = 0  # Replays since the latest block count.

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
            read: numbers and tensors that mass, volume and `end` depend on; None for steps that are not captured.

        Raises:
            TypeError, ValueError: for wrong shapes, dtypes or devices.
        """
        x, v, C, F = given
        stress = from_half(stress, x)
        check_like("stress", stress, x, (len(x), 3, 3), "[P, 3, 3]")
        extra = {STRESS: stress}
        state = State(x=x, v=v, mass=mass.to(x), volume=volume.to(x), C=C, F=F, time=time, extra=extra)

        def advanced(state: State) -> State:
            x, v, C, F = end(self.step(state, dt))
            return state.replace(x=x, v=v, C=C, F=F)

        kind = None if read is None else self._kind_of(state, dt, read)
        after = advanced(state) if kind is None else self._replayed(advanced, state, kind)
        assert after.C is not None and after.F is not None
        return after.x, after.v, after.C, after.F

    def _kind_of(self, state: State, dt: float, read: Iterable[Any]) -> Hashable:
        """Key of calls with one graph; None for those without one."""
        x, step = state.x, self.step
        if not x.is_cuda or not is_eager(x) or detecting() or any(has_hooks(module) for module in step.modules()):
            return None
        tensors = [*tensors_of(state).values(), *(value for value in read if isinstance(value, Tensor))]
        if torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors, *step.parameters(), *step.buffers())):
            return None
        contents = [(Same(value), version(value)) if isinstance(value, Tensor) else value for value in read]
        if any(t.is_inference() or t.device != x.device for t in tensors):
            return None
        return dt, len(x), x.dtype, x.device, tuple(contents), StepKey(step).key, surroundings(x.device)

    def _replayed(self, advanced: Callable[[State], State], state: State, kind: Hashable) -> State:
        """The state after a replay, or after a step that is to be captured if the next call is of the same kind."""
        step = self.step
        if step.grid.grows and self._unseen > 1:
            step.grid.wait()
        kind = kind, step.grid.pool(state.x, None)
        if kind != self._kind:
            self._kind, self._replays = kind, None
            return advanced(state)
        if self._replays is None:
            self._replays = Replays(advanced, state, step.grid.pool(state.x, None))
            self._in_flight = WorkInFlight(state.x)
        graph = self._replays.state
        assert graph.C is not None and graph.F is not None
        given = state.x, state.v, state.C, state.F, state.extra[STRESS]
        copy_all([graph.x, graph.v, graph.C, graph.F, graph.extra[STRESS]], [t for t in given if t is not None])
        self._replays.replay(1, self._in_flight)
        self._watch()
        return graph.replace(x=graph.x.clone(), v=graph.v.clone(), C=graph.C.clone(), F=graph.F.clone())

    def _watch(self) -> None:
        """Request the number of blocks of the latest step, unless a request is pending."""
        grid, status = self.step.grid, self.step.status
        assert status is not None
        self._unseen = self._unseen + 1 if grid.watches else 0
        grid.watch(status)


def clamped(x: Tensor, lower: float | Tensor, upper: float | Tensor) -> Tensor:
    """Positions between two bounds, numbers or [P, 1]."""
    if not ((torch.is_grad_enabled() and x.requires_grad) or isinstance(lower, Tensor) or isinstance(upper, Tensor)):
        return x.clamp(lower, upper)
    return torch.minimum(torch.maximum(x, x.new_zeros(()) + lower), x.new_zeros(()) + upper)
