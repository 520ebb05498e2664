"""Anomaly detection of autograd with substep and scene: operation and place of the first NaN in a gradient."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from ..grid.grid import Grid
from ..state.state import State
from ..step.failures import NAMED


def detecting() -> bool:
    """Whether `torch.autograd.set_detect_anomaly` or `detect_anomaly` is active."""
    enabled = not torch.compiler.is_compiling() and torch.is_anomaly_enabled()
    return enabled and torch.is_anomaly_check_nan_enabled() and torch.is_grad_enabled()


def begin() -> int:
    """Mark in the order of operations, for `watch`."""
    number: int = torch._C._autograd._get_sequence_nr()
    return number


def watch(before: State, after: State, mark: int, substep: int, grid: Grid | None) -> None:
    """Make every operation since a mark, between two states, report its place if its gradient is NaN.

    Args:
        before, after: states before and after the step.
        mark: result of `begin` before the step.
        substep: number of the step.
        grid: grid of the step, which gives the scenes of nodes.
    """
    place = _Place(substep, before.detach(), grid)
    waiting = [t.grad_fn for t in _tensors(after) if t.grad_fn is not None]
    known: set[Any] = set()
    while waiting:
        node = waiting.pop()
        if node in known or node.name().endswith("AccumulateGrad") or node._sequence_nr() < mark:
            continue
        known.add(node)
        node.register_hook(_check(node.name(), place))
        waiting += [parent for parent, _ in node.next_functions if parent is not None]


def _tensors(state: State) -> list[Tensor]:
    values = [getattr(state, f.name) for f in dataclasses.fields(state) if f.name != "extra"]
    return [t for t in [*values, *state.extra.values()] if isinstance(t, Tensor)]


@dataclasses.dataclass
class _Place:
    substep: int
    state: State
    grid: Grid | None

    def scenes(self, gradient: Tensor) -> str:
        """Names of the scenes of rows with NaN."""
        rows = gradient.isnan().flatten(1).any(1) if gradient.dim() > 1 else gradient.isnan()
        if (self.grid is not None and self.grid.scenes == 1) or self.state.scene is None:
            of_rows = torch.zeros_like(rows, dtype=torch.int32)
        elif len(rows) == len(self.state):
            of_rows = self.state.scene
        else:
            return self._of_nodes(rows)
        return _named("scene", of_rows[rows])

    def _of_nodes(self, rows: Tensor) -> str:
        if self.grid is None:
            return "some scene"
        with torch.no_grad():
            blocks = self.grid.activate(self.state.x, self.state.scene)
            nodes = blocks.node_scene() if len(rows) == blocks.node_count else None
        return "some scene" if nodes is None else _named("scene", nodes[rows])


def _named(kind: str, numbers: Tensor) -> str:
    found = numbers.unique().tolist()
    words = ", ".join(map(str, found[:NAMED])) + (", ..." if len(found) > NAMED else "")
    return f"{kind}{'s' if len(found) > 1 else ''} {words}"


def _check(name: str, place: _Place) -> Any:
    def check(grad_inputs: Any, grad_outputs: Any) -> None:
        for number, gradient in enumerate(grad_inputs):
            if isinstance(gradient, Tensor) and gradient.dim() > 0 and bool(gradient.isnan().any()):
                given = any(isinstance(g, Tensor) and bool(g.isnan().any()) for g in grad_outputs)
                origin = "; its incoming gradient was NaN already" if given else ""
                raise RuntimeError(
                    f"the gradient of {name} is NaN (of its input {number}) in substep {place.substep} of the rollout, "
                    f"{place.scenes(gradient)}{origin}"
                )

    return check
