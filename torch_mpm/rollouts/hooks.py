"""Actions between the steps of a rollout: hooks, the end of a prefix without gradients, cuts and norms of gradients."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..errors import check_count, shape_of
from ..state.state import FIELDS, State
from .gradient_norms import GradientNorms

Control = Callable[[State, int], contextlib.AbstractContextManager[Callable[[State], State]]]
"""Control step of n steps from a state, see `torch_mpm.boundaries.control`."""
Hook = Callable[[State, int], "State | None"]
"""Called with a state and the number of steps before it; may return another state to continue from."""


@dataclasses.dataclass(frozen=True)
class Reader:
    """A hook that only reads states, so that no control step ends at its calls."""

    read: Callable[[State, int], None]

    def __call__(self, state: State, k: int) -> None:
        self.read(state, k)


@dataclasses.dataclass
class Parts:
    """Actions between the n steps of a rollout; see `rollout` for the arguments.

    Raises:
        TypeError, ValueError: for a wrong argument.
    """

    n: int
    prefix: int = 0
    truncate: int | None = None
    hook: Hook | None = None
    every: int = 1
    norms: GradientNorms | None = None

    def __post_init__(self) -> None:
        check_count("prefix", self.prefix)
        check_count("every", self.every, 1)
        if self.truncate is not None:
            check_count("truncate", self.truncate, 1)
        if self.hook is not None and not callable(self.hook):
            raise TypeError(f"hook must be a function (state, k) -> state or None, got {shape_of(self.hook)}")
        if self.norms is not None and not isinstance(self.norms, GradientNorms):
            raise TypeError(f"norms must be GradientNorms or None, got {shape_of(self.norms)}")

    def first_with_gradient(self) -> int:
        """First step that a gradient may reach: without a hook the loss depends on the end only."""
        prefix = min(self.prefix, self.n)
        return prefix if self.truncate is None or self.hook is not None else max(prefix, self.n - self.truncate)

    def cuts(self) -> set[int]:
        """Steps before which the gradient is cut, counted from the end."""
        if self.truncate is None:
            return set()
        return set(range(self.n - self.truncate, self.first_with_gradient(), -self.truncate))

    def stops(self) -> list[int]:
        """Steps before which there is an action, in ascending order, with the first and the end."""
        return sorted({0, self.first_with_gradient(), self.n} | self.cuts() | self._hooked() | self._measured())

    def lengths_with_gradient(self) -> list[int]:
        """Numbers of steps between two actions, of the steps that a gradient may reach."""
        stops = [k for k in self.stops() if k >= self.first_with_gradient()]
        return [following - k for k, following in itertools.pairwise(stops)]

    def _hooked(self) -> set[int]:
        return set() if self.hook is None else set(range(0, self.n, self.every))

    def _measured(self) -> set[int]:
        return set() if self.norms is None else set(self.norms.points(self.first_with_gradient(), self.n))

    def run(self, advance: Callable[[State, int, int], State], state: State, scales: Any, control: Control) -> State:
        """The state n steps later.

        Args:
            advance: function of (state, count, k) that returns the state `count` steps later; the first of them is step
                k.
            state: the initial state.
            scales: scales of the gradient norms, see `GradientNorms.start`.
            control: function of (state, count) that returns the control step of `count` steps between two calls of the
                hook.
        """
        prefix, cuts = self.first_with_gradient(), self.cuts()
        hooked, measured, stops = self._hooked(), self._measured(), self.stops()
        if self.norms is not None:
            self.norms.start(sorted(measured), *scales)
        ends = set() if isinstance(self.hook, Reader) else hooked
        began, control_steps = state, _ControlSteps(control, sorted({0, self.n} | ends))
        with control_steps:
            for k, following in zip(stops, [*stops[1:], self.n], strict=True):
                mode = torch.no_grad if k < prefix else contextlib.nullcontext
                state = control_steps.end(state, k)
                with mode():
                    if k in hooked:
                        returned = self._after_hook(state, k)
                        if returned is not state and k in cuts:
                            raise ValueError(
                                f"hook must not return a state before step {k}, where truncate={self.truncate} cuts "
                                f"the gradient, also that of its result: choose truncate and every={self.every} such "
                                "that n - truncate, n - 2 truncate, ... are not multiples of every"
                            )
                        if returned is not state:
                            began = state = returned
                    if k in cuts:
                        began = state = _cut(state, began)
                    if k in measured:
                        assert self.norms is not None
                        state = self.norms.watched(state, k)
                control_steps.begin(state, k)
                with mode():
                    state = advance(state, following - k, k) if following > k else state
        return state

    def _after_hook(self, state: State, k: int) -> State:
        """The state that the hook returns before step k, or the given one."""
        assert self.hook is not None
        result = self.hook(state, k)
        if result is None:
            return state
        if not isinstance(result, State) or len(result) != len(state):
            raise TypeError(f"hook must return None or a State of {len(state)} particles, got {shape_of(result)}")
        return result


class _ControlSteps(contextlib.ExitStack):
    """Consecutive control steps, which begin and end before some steps."""

    def __init__(self, control: Control, bounds: list[int]) -> None:
        super().__init__()
        self._control, self._bounds = control, bounds
        self._end: Callable[[State], State] | None = None

    def end(self, state: State, k: int) -> State:
        """State before step k, after the end of a control step if it ends there."""
        if k in self._bounds and self._end is not None:
            state, self._end = self._end(state), None
            self.close()
        return state

    def begin(self, state: State, k: int) -> None:
        """Begin the control step before step k, if there is one."""
        if k in self._bounds and k < self._bounds[-1]:
            count = next(bound for bound in self._bounds if bound > k) - k
            self._end = self.enter_context(self._control(state, count))


def _cut(state: State, began: State) -> State:
    """State without the gradient of fields that steps have changed; fields that are the same as in `began` keep
    theirs.
    """

    def changed(name: str) -> Any:
        value = getattr(state, name)
        return value.detach() if isinstance(value, Tensor) and value is not getattr(began, name) else value

    names = [name for name in FIELDS if name != "extra"]
    extra = {name: t if t is began.extra.get(name) else t.detach() for name, t in state.extra.items()}
    return state.replace(**{name: changed(name) for name in names}, extra=extra)
