"""Error status accumulated over the activations of one user of a grid, for `check` and `failures`."""

from __future__ import annotations

import contextlib
import dataclasses
import weakref
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import (
    is_captured,
    is_eager,
    is_exported,
    is_of_library,
    outside_transforms,
    remember,
    without_transforms,
)
from ..grid.grid import Blocks, Grid
from ..grid.topology import COUNTS_OF_PROBLEMS, FIRST_PROBLEMS, Status
from .failures import Problem, contradicted_poses, problems_of_first_state, problems_of_status, refused_steps

if TYPE_CHECKING:
    from ..state.state import State

NO_PROBLEM = tuple(-1 if column in FIRST_PROBLEMS else 0 for column in Status)
"""Row of the status before the first activation (csrc/grid/status.h)."""


KEPT_PARTICLES = 2**18
"""Number of particles up to which a given state is kept, some 30 MB."""


class _Call:
    """Calls of one user of a grid, one after another.

    A given state of at most `KEPT_PARTICLES` is kept until the next call, so that a failure can be explained by it;
    results are not kept.

    Attributes:
        goes_on: whether the host is inside a call.
        given: state given to the latest call and the status before it; None for the first state, which
            `ErrorStatus.begin` examines, for the result of the previous call, and for larger states.
    """

    def __init__(self) -> None:
        self.goes_on = False
        self.given: tuple[State, Tensor] | None = None
        self._end: list[Callable[[], Tensor | None]] = []

    def of(self, state: State, status: Tensor | None) -> _Call:
        """The context of a call from a state, after steps with a status."""
        self.given, fields = None, _fields(state)
        if status is None or state.x.shape[0] > KEPT_PARTICLES or self._continues(fields) or not is_eager(state.x):
            return self
        trained = any([t is not None and t.requires_grad for t in fields])
        self.given = state.detach() if trained else state, status
        return self

    def _continues(self, fields: tuple[Tensor | None, ...]) -> bool:
        """Whether these are the fields of the result of the previous call."""
        for end, field in zip(self._end, fields, strict=False):
            if end() is not field:
                return False
        return bool(self._end)

    def __enter__(self) -> Callable[[State], State]:
        self.goes_on = True
        return self._ended

    def __exit__(self, *_: object) -> None:
        self.goes_on = False

    def _ended(self, result: State) -> State:
        self._end = [_absent if t is None else weakref.ref(t) for t in _fields(result)]
        return result


def _absent() -> None:
    """In place of a weak reference to a field that is None."""


def _fields(state: State) -> tuple[Tensor | None, ...]:
    """Fields by which a state is recognised as the result of steps."""
    return state.x, state.v, state.mass, state.volume, state.C, state.F, state.J


_INSIDE: contextlib.AbstractContextManager[Callable[[State], State]] = contextlib.nullcontext(lambda state: state)


class ErrorStatus:
    """Errors of all activations of one user of a grid, including those replayed by CUDA graphs.

    A replay reads and writes the tensors of the capture. Captured activations therefore continue in the tensor that
    they found, which is stored. The first activation of all should not be captured: otherwise each replay discards
    earlier ones.

    Attributes:
        status: int32 [1 + B, 8], see csrc/grid/status.h; None before the first activation.
        given: entries of the first state that were NaN or infinite, by field.
        refused: number of steps of each scene with an invalid entry of a tensor dt, int32 [B]; None before the first
            tensor dt.
        contradicted: number of obstacles of each scene, accumulated over calls, whose pose differs from the result of
            their velocity, int32 [B]; None before the first one that could.
    """

    def __init__(self) -> None:
        self.status: Tensor | None = None
        self.refused: Tensor | None = None
        self.contradicted: Tensor | None = None
        self.given: dict[str, Problem] = {}
        self._replayed: list[Tensor] = []
        self._call = _Call()

    def __getstate__(self) -> dict[str, Any]:
        """State for copies, without the states of calls."""
        return {**self.__dict__, "_call": _Call()}

    def call(self, state: State) -> contextlib.AbstractContextManager[Callable[[State], State]]:
        """Context of steps from a state; the function it returns gets their result, and returns it. Contexts inside are
        part of the same call.
        """
        return _INSIDE if self._call.goes_on else self._call.of(state, self.status)

    def given_to_latest_call(self, scenes: int) -> tuple[dict[str, Problem], int]:
        """Entries that were NaN or infinite in the state given to the latest call, by field, and the number of steps
        before it; nothing where the state is the first one, or the result of the previous call. Synchronises.
        """
        if self._call.given is None:
            return {}, 0
        state, before = self._call.given
        steps = int(before[0, Status.ACTIVATIONS])
        return problems_of_first_state(state, scenes, f"given before step {steps}"), steps

    def begin(self, state: State, scenes: int) -> None:
        """Check the first state, before a step from it."""
        if self.status is None and is_eager(state.x):
            with torch.no_grad():  # A decorator would be stored by an export.
                self.given = problems_of_first_state(state, scenes)

    def activate(self, grid: Grid, x: Tensor, scene: Tensor | None, ids: Tensor | None = None) -> Blocks:
        """As `Grid.activate`; updates `max_blocks` of the grid."""
        if is_exported():
            return grid.activate(x, scene, None, ids)
        before = self.status_for(x)
        blocks = grid.activate(x, scene, before, ids)
        status = without_transforms(blocks.status)
        grid.watch(status)
        self.follow(before, status)
        return blocks

    def status_for(self, x: Tensor) -> Tensor | None:
        """Status so far, on the device of a tensor: a step may have been moved."""
        if self.status is not None and self.status.device != x.device:
            self.status = self.status.to(x.device)
        return self.status

    def follow(self, before: Tensor | None, status: Tensor) -> None:
        """Store the status of activations that continued an earlier one, where replays of a graph find it."""
        if before is None or not is_captured(status):
            self.status = status
            return
        with torch.inference_mode(), outside_transforms():  # Any tensor may be written to there.
            before.copy_(status)
        self.status = before
        remember(self._replayed, before)

    @contextlib.contextmanager
    def passing_graphs(self) -> Iterator[None]:
        """Graphs captured inside are not replayed afterwards: only the latest status is stored."""
        known = list(self._replayed)
        try:
            yield
        finally:
            self._replayed = known

    def all(self) -> list[Tensor]:
        """The latest status, and the statuses that graphs continue."""
        latest = [] if self.status is None else [self.status]
        return latest + [kept for kept in self._replayed if kept is not self.status]

    def problems(self, grid: Grid, state: State | None = None) -> dict[str, Problem]:
        """Problems of scenes in these steps, and of positions of a state that the next step would find; without
        synchronisation.
        """
        statuses = self.all()
        if state is not None:
            statuses.append(grid.status_at(state.x, state.scene, self.status_for(state.x), state.ids))
        problems = problems_of_status(statuses, grid)
        if self.refused is not None:
            problems["dt"] = refused_steps(self.refused)
        if self.contradicted is not None:
            problems["pose"] = contradicted_poses(self.contradicted)
        return problems

    @torch.no_grad()
    def contradict(self, scenes: Tensor, count: int) -> None:
        """Count an obstacle whose pose differs from the result of its velocity, in scenes given by a bool [] or [B]."""
        if self.contradicted is None or self.contradicted.device != scenes.device:
            with outside_transforms(), torch.inference_mode(False):
                self.contradicted = torch.zeros(count, dtype=torch.int32, device=scenes.device)
        with outside_transforms():
            self.contradicted += without_transforms(scenes)

    @torch.no_grad()
    def refuse(self, entries: Tensor, scenes: int, steps: int = 1) -> None:
        """Count invalid entries of a tensor dt: bool of shape [], [1] or [B]."""
        refused = self.counts(scenes, entries.device)
        with outside_transforms():
            refused += steps * without_transforms(entries)

    def counts(self, scenes: int, device: torch.device) -> Tensor:
        """`refused`, allocated at the first tensor dt."""
        if self.refused is None or self.refused.device != device:
            with outside_transforms(), torch.inference_mode(False):
                self.refused = torch.zeros(scenes, dtype=torch.int32, device=device)
        return self.refused

    def reset(self) -> None:
        self.status, self.given, self._call.given = None, {}, None
        if self.refused is not None:  # CUDA graphs may write to it.
            self.refused.zero_()
        self.contradicted = None
        with torch.inference_mode():
            for kept in self._replayed:
                kept.copy_(torch.tensor(NO_PROBLEM, dtype=torch.int32, device="cpu"))

    def forget(self, scenes: Tensor) -> None:
        """Problems per scene, bool [B], and problems counted over all scenes."""
        if self.refused is not None:
            self.refused.masked_fill_(scenes, 0)
        if self.contradicted is not None:
            self.contradicted.masked_fill_(scenes, 0)
        for name, problem in self.given.items():
            self.given[name] = dataclasses.replace(problem, count=problem.count.masked_fill(scenes, 0))
        with torch.inference_mode():
            for status in self.all():
                status[1:].masked_fill_(scenes[:, None], 0)
                for column in COUNTS_OF_PROBLEMS:
                    status[0, column].masked_fill_(scenes.any(), 0)
                for column in FIRST_PROBLEMS:
                    status[1:, column].masked_fill_(scenes, -1)
                    status[0, column].masked_fill_(scenes.any(), -1)


STORED = ("_error_status", "unsolved", "residual", "_unsolved", "_residual", "report", "adjoint_converged")
"""Attributes in which steps, heat and integrators store their status."""


@contextlib.contextmanager
def aside(step: Any, x: Tensor) -> Iterator[None]:
    """Context in which steps leave no trace: neither in their status nor in the random number generators.

    Args:
        step: a module, including its parts, or a function, which has no status.
        x: a tensor on the device of the particles.
    """
    modules = _with_status(step) if isinstance(step, torch.nn.Module) else []
    integrators = [i for m in modules if (i := getattr(m, "integrator", None)) is not None]
    kept = [(m, name, getattr(m, name)) for m in (*modules, *integrators) for name in STORED if hasattr(m, name)]
    for owner, name, _ in kept:
        setattr(owner, name, ErrorStatus() if name == "_error_status" else None)
    try:
        with torch.random.fork_rng([x.device] if x.is_cuda else []):
            yield
    finally:
        for owner, name, value in kept:
            setattr(owner, name, value)


COUNTS = ("unsolved", "residual")
"""Attributes of heat that its steps add to."""


def _with_status(step: torch.nn.Module) -> list[Any]:
    return [m for m in step.modules() if hasattr(m, "_error_status")]


def counts_of(step: torch.nn.Module) -> list[tuple[Any, str, Tensor | None]]:
    """Storage of the status of explicit steps: owner, attribute and tensor."""
    modules = _with_status(step)
    places: list[tuple[Any, str]] = [(m._error_status, name) for m in modules for name in ("status", "refused")]
    places += [(m, name) for m in modules for name in COUNTS if hasattr(m, name)]
    return [(owner, name, getattr(owner, name)) for owner, name in places]


@contextlib.contextmanager
def uncounted(step: torch.nn.Module) -> Iterator[None]:
    """Context in which explicit steps leave no trace in their status. Unlike after `aside`, the tensors of the status
    exist afterwards, and the steps of graphs continue in them.
    """
    tensors = counts_of(step)
    written = [t for m in _with_status(step) for t in m._error_status._replayed] + buffers_of_users(step)
    with torch.inference_mode(), outside_transforms():
        before = [None if t is None else t.clone() for _, _, t in tensors]
        replayed = [(t, t.clone()) for t in written]
    try:
        yield
    finally:
        with torch.inference_mode(), outside_transforms():
            for (owner, name, t), values in zip(tensors, before, strict=True):
                if t is not None and values is not None:
                    made = getattr(owner, name)
                    now = t if made is None or made.device == t.device else made  # The step may have been moved.
                    now.copy_(values)
                    setattr(owner, name, now)
                elif (made := getattr(owner, name)) is not None:
                    made.zero_()
                    if name == "status":
                        made.copy_(torch.tensor(NO_PROBLEM, dtype=torch.int32, device="cpu"))
            for t, values in replayed:
                t.copy_(values)


def buffers_of_users(step: torch.nn.Module) -> list[Tensor]:
    """Buffers that user modules may write in each call, as batch normalisation does."""
    own = [m for m in step.modules() if not any(map(is_of_library, type(m).__mro__))]
    return [t for m in own for t in m._buffers.values() if t is not None and not t.requires_grad]
