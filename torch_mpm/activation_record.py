"""What the activations of one user of a grid have told, for `check` and `failures`."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .capture import (
    is_captured,
    is_exported,
    is_of_library,
    is_traced,
    is_transformed,
    outside_transforms,
    remember,
    without_transforms,
)
from .failures import Problem, contradicted_poses, problems_of_first_state, problems_of_status, refused_steps
from .grid import Blocks, Grid
from .topology import COUNTS_OF_PROBLEMS, FIRST_PROBLEMS, Status

if TYPE_CHECKING:
    from .state import State

NO_PROBLEM = tuple(-1 if column in FIRST_PROBLEMS else 0 for column in Status)
"""A row of the status before the first activation (csrc/grid/status.h)."""


class ActivationRecord:
    """The status of all activations of one user of a grid, also of those that CUDA graphs replay.

    A replay reads and writes the tensors of the capture. So captured activations go on in the tensor that they found,
    which is kept; the first activation of all should not be a captured one, or each replay forgets those before.

    Attributes:
        status: int32 [1 + B, 8], see csrc/grid/status.h; None before the first activation.
        given: what was NaN or infinite in the first state, by field.
        refused: steps of each scene whose entry of a tensor dt could not be taken, int32 [B]; None before the first
            tensor dt.
        contradicted: obstacles of each scene, added up over calls, whose pose is not where their velocity has led,
            int32 [B]; None before the first one that could be.
    """

    def __init__(self) -> None:
        self.status: Tensor | None = None
        self.refused: Tensor | None = None
        self.contradicted: Tensor | None = None
        self.given: dict[str, Problem] = {}
        self._replayed: list[Tensor] = []

    def begin(self, state: State, scenes: int) -> None:
        """Before a step from a state: look at the first one."""
        if self.status is None and not (is_traced(state.x) or is_captured(state.x) or is_transformed()):
            with torch.no_grad():  # not as a decorator, which an export would keep
                self.given = problems_of_first_state(state, scenes)

    def activate(self, grid: Grid, x: Tensor, scene: Tensor | None, ids: Tensor | None = None) -> Blocks:
        """As `Grid.activate`; `max_blocks` of the grid follows."""
        if is_exported():
            return grid.activate(x, scene, None, ids)
        before = self.status_for(x)
        blocks = grid.activate(x, scene, before, ids)
        status = without_transforms(blocks.status)
        grid.watch(status)
        self.follow(before, status)
        return blocks

    def status_for(self, x: Tensor) -> Tensor | None:
        """The status so far, on the device of a tensor: a step may have been moved."""
        if self.status is not None and self.status.device != x.device:
            self.status = self.status.to(x.device)
        return self.status

    def follow(self, before: Tensor | None, status: Tensor) -> None:
        """Take the status of activations that went on from one before, which replays of a graph find there again."""
        if before is None or not is_captured(status):
            self.status = status
            return
        with torch.inference_mode(), outside_transforms():  # in which any tensor may be written to
            before.copy_(status)
        self.status = before
        remember(self._replayed, before)

    @contextlib.contextmanager
    def passing_graphs(self) -> Iterator[None]:
        """Graphs that are captured meanwhile are not replayed afterwards: then the latest status is all they tell."""
        known = list(self._replayed)
        try:
            yield
        finally:
            self._replayed = known

    def all(self) -> list[Tensor]:
        """The latest status, and those that graphs go on with."""
        latest = [] if self.status is None else [self.status]
        return latest + [kept for kept in self._replayed if kept is not self.status]

    def problems(self, grid: Grid) -> dict[str, Problem]:
        """What these steps tell about scenes, without synchronising."""
        problems = problems_of_status(self.all(), grid)
        if self.refused is not None:
            problems["dt"] = refused_steps(self.refused)
        if self.contradicted is not None:
            problems["pose"] = contradicted_poses(self.contradicted)
        return problems

    @torch.no_grad()
    def contradict(self, scenes: Tensor, count: int) -> None:
        """Count an obstacle whose pose is not where its velocity has led, in scenes of a bool [] or [B]."""
        if self.contradicted is None or self.contradicted.device != scenes.device:
            with outside_transforms(), torch.inference_mode(False):
                self.contradicted = torch.zeros(count, dtype=torch.int32, device=scenes.device)
        with outside_transforms():
            self.contradicted += without_transforms(scenes)

    @torch.no_grad()
    def refuse(self, entries: Tensor, scenes: int, steps: int = 1) -> None:
        """Count entries of a tensor dt that could not be taken in some steps: bool of shape [], [1] or [B]."""
        refused = self.counts(scenes, entries.device)
        with outside_transforms():
            refused += steps * without_transforms(entries)

    def counts(self, scenes: int, device: torch.device) -> Tensor:
        """`refused`, made at the first tensor dt."""
        if self.refused is None or self.refused.device != device:
            with outside_transforms(), torch.inference_mode(False):
                self.refused = torch.zeros(scenes, dtype=torch.int32, device=device)
        return self.refused

    def reset(self) -> None:
        self.status, self.given = None, {}
        if self.refused is not None:  # and CUDA graphs may write to it
            self.refused.zero_()
        self.contradicted = None
        with torch.inference_mode():
            for kept in self._replayed:
                kept.copy_(torch.tensor(NO_PROBLEM, dtype=torch.int32, device="cpu"))

    def forget(self, scenes: Tensor) -> None:
        """Problems of scenes, bool [B], and those that are counted of all scenes together."""
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


RECORDS = ("_activations", "unsolved", "residual", "_unsolved", "_residual", "report", "adjoint_converged")
"""Attributes in which steps, heat and integrators keep what became of them."""


@contextlib.contextmanager
def aside(step: Any, x: Tensor) -> Iterator[None]:
    """Where steps leave nothing behind: not in what they tell of the steps so far, nor in random numbers.

    Args:
        step: a module, whose parts are meant too, or a function, which has no records.
        x: a tensor on the device of the particles.
    """
    modules = _recorders(step) if isinstance(step, torch.nn.Module) else []
    integrators = [i for m in modules if (i := getattr(m, "integrator", None)) is not None]
    kept = [(m, name, getattr(m, name)) for m in (*modules, *integrators) for name in RECORDS if hasattr(m, name)]
    for owner, name, _ in kept:
        setattr(owner, name, ActivationRecord() if name == "_activations" else None)
    try:
        with torch.random.fork_rng([x.device] if x.is_cuda else []):
            yield
    finally:
        for owner, name, value in kept:
            setattr(owner, name, value)


COUNTS = ("unsolved", "residual")
"""Attributes of heat that its steps add to."""


def _recorders(step: torch.nn.Module) -> list[Any]:
    return [m for m in step.modules() if hasattr(m, "_activations")]


def counts_of(step: torch.nn.Module) -> list[tuple[Any, str, Tensor | None]]:
    """Where explicit steps keep what they tell of the steps so far: owner, attribute and tensor."""
    modules = _recorders(step)
    places: list[tuple[Any, str]] = [(m._activations, name) for m in modules for name in ("status", "refused")]
    places += [(m, name) for m in modules for name in COUNTS if hasattr(m, name)]
    return [(owner, name, getattr(owner, name)) for owner, name in places]


@contextlib.contextmanager
def uncounted(step: torch.nn.Module) -> Iterator[None]:
    """Where explicit steps leave nothing behind in what they tell of the steps so far; but unlike after `aside`, that
    has its tensors then, in which the steps of graphs go on."""
    tensors = counts_of(step)
    written = [t for m in _recorders(step) for t in m._activations._replayed] + buffers_of_users(step)
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
                    now = t if made is None or made.device == t.device else made  # the step may have been moved
                    now.copy_(values)
                    setattr(owner, name, now)
                elif (made := getattr(owner, name)) is not None:
                    made.zero_()
                    if name == "status":
                        made.copy_(torch.tensor(NO_PROBLEM, dtype=torch.int32, device="cpu"))
            for t, values in replayed:
                t.copy_(values)


def buffers_of_users(step: torch.nn.Module) -> list[Tensor]:
    """What modules of the user's may write in each call, as batch normalisation does."""
    own = [m for m in step.modules() if not any(map(is_of_library, type(m).__mro__))]
    return [t for m in own for t in m._buffers.values() if t is not None and not t.requires_grad]
