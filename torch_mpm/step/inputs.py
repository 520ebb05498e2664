"""NaN and infinite entries of what steps are given, which explain failures."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

from torch import Tensor

from ..boundaries import Obstacle
from .failures import Problem, problems_of_first_state

if TYPE_CHECKING:
    from ..state.state import State
    from .failures import Failures
    from .step import Step


def given_problems(step: Step, failures: Failures, state: State | None) -> dict[str, Problem]:
    """NaN or infinite entries of gravity, of obstacles and of the state given to the latest call, for scenes whose
    problems began in that call; synchronises.

    Args:
        step: the step.
        failures: its failures.
        state: a state after the steps, at whose time paths are evaluated; None for no paths.
    """
    scenes, status = step.grid.scenes, step._error_status
    if status.status is None:
        found = {} if state is None else problems_of_first_state(state, scenes)
        return {"x": found["x"]} if "x" in found else {}  # `problems_of_state` has advice for the others.
    latest, before = status.given_to_latest_call(scenes)
    first = failures.problems["not_finite"].step
    assert first is not None
    problems = {}
    for name, problem in latest.items():
        count = problem.count.masked_fill((first >= 0) & (first < before), 0)
        problems[f"{name} before step {before}"] = dataclasses.replace(problem, count=count)
    for name, value, rank in _inputs(step, state):
        bad = ~value.detach().isfinite()
        count = (bad.reshape(len(bad), -1) if value.dim() > rank else bad.reshape(1, -1)).sum(1).expand(scenes)
        problems[name] = Problem(count, f"components of {name} are NaN or infinite", "give finite numbers")
    return problems


def _inputs(step: Step, state: State | None) -> Iterator[tuple[str, Tensor, int]]:
    """Name, value and rank of the tensors that are the same for all particles of a scene."""
    if isinstance(step.gravity, Tensor):
        yield "the gravity", step.gravity, 1
    for k, obstacle in enumerate(step.boundaries.entries):
        if not isinstance(obstacle, Obstacle):
            continue
        of = f"of boundary {k} ({type(obstacle).__name__})"
        for name, rank in obstacle.RANKS.items():
            value = getattr(obstacle, name)
            if isinstance(value, Tensor):
                yield f"the {name} {of}", value, (0 if step.grid.dim == 2 else 1) if rank is None else rank
        if state is not None and obstacle.follows_path:
            yield f"the path {of} at the time of the state", obstacle.centre_at(state.time, state.x), 1
