"""Frames of many steps: stored states, and hooks between steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import check_count, shape_of
from ..state.state import State, check_state
from ..step.step import Step
from .checkpoints import Checkpoints
from .hooks import Hook, Parts, Reader
from .plan import RolloutPlan
from .run import rollout


class Frames(NamedTuple):
    """Result of `frames`: T = n // every + 1 frames, beginning with the start."""

    time: Tensor
    """Times of the frames [s], float64: [T], on the CPU where they are numbers; [T, 1] or [T, B] where dt or the time
    of the state has shape [1] or [B]."""
    fields: dict[str, Tensor]
    """Values [T, P, ...] of each requested field, in the order of the particles of the state."""
    end: State
    """State after all n steps."""


def frames(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    every: int = 1,
    fields: Sequence[str] = ("x", "v"),
    hook: Hook | None = None,
    checkpoint: int | Checkpoints | None = None,
    *,
    prefix: int = 0,
    truncate: int | None = None,
    graph: int | None = None,
    schedule: str | None = None,
    plan: RolloutPlan | None = None,
) -> Frames:
    """A `rollout` that stores some fields of every n-th step, and lets a hook act there.

    Args:
        step, state, n, dt, checkpoint, prefix, truncate, graph, schedule, plan: as `rollout`.
        every: steps between two frames.
        fields: names of fields of `State` or of `state.extra`.
        hook: called as `hook(state, k)` before step k = 0, every, 2 every, ..., after the frame of that step is stored.
            It may return another state with as many particles, for example for a control, or set gravity or obstacles
            of the step; None leaves the state unchanged. For an intermediate loss it may read the state, and gradients
            pass.

    Differentiable as `rollout`. The steps between two frames are one call of an op where `rollout` can do so. Without a
    hook all n steps are one control step, see `Obstacle`.

    Raises:
        TypeError, ValueError: as `rollout`; for a field that the state lacks, or another result of the hook.
    """
    check_state(state)
    check_count("n", n)
    check_count("every", every, 1)
    if isinstance(step, Step):
        state = step.prepare(state)
    kept: dict[str, list[Tensor]] = {name: [] for name in _checked(fields, state)}
    times: list[Any] = []

    def keep(state: State) -> None:
        times.append(state.time)
        for name, values in kept.items():
            value = _field(state, name)
            # A hook may write into the tensors of the state.
            values.append(value if value.requires_grad or hook is None else value.clone())

    def acted(state: State, k: int) -> State | None:
        keep(state)
        return None if hook is None else hook(state, k)

    Parts(n, hook=hook)  # `rollout` refuses a hook that is not callable.
    seen = Reader(lambda state, k: keep(state)) if hook is None else acted
    options: dict[str, Any] = {"prefix": prefix, "truncate": truncate, "graph": graph}
    options |= {"schedule": schedule, "plan": plan}
    end = rollout(step, state, n, dt, checkpoint, hook=seen, every=every, **options)
    if n % every == 0:
        keep(end)
    return Frames(_stacked(times), {name: torch.stack(values) for name, values in kept.items()}, end)


def _stacked(times: Sequence[float | Tensor]) -> Tensor:
    """Times in one tensor; the first may be numbers where later ones are tensors."""
    tensors = [t for t in times if isinstance(t, Tensor)]
    if not tensors:
        return torch.tensor(times, dtype=torch.float64)
    longest = max(tensors, key=lambda t: (t.dim(), t.numel()))
    rows = [t if isinstance(t, Tensor) else longest.new_full((), t) for t in times]
    return torch.stack([row.to(longest.device).expand(longest.shape) for row in rows])


def _checked(fields: Sequence[str], state: State) -> Sequence[str]:
    if isinstance(fields, str) or not isinstance(fields, (list, tuple)):
        raise TypeError(f"fields must be a list of names, got {shape_of(fields)}")
    for name in fields:
        if not isinstance(name, str) or not isinstance(_field(state, name), Tensor):
            present = [k for k, v in {**vars(state), **state.extra}.items() if isinstance(v, Tensor) and k[0] != "_"]
            raise ValueError(f"fields must be names of fields that the state has, {', '.join(present)}, got {name!r}")
    return fields


def _field(state: State, name: str) -> Any:
    return state.extra[name] if name in state.extra else getattr(state, name, None)
