"""Rollouts without gradients as replays of a CUDA graph of one step, or of a segment."""

from __future__ import annotations

from collections.abc import Callable

from ..cuda_graphs.graph import Replays, WorkInFlight, time_tensor
from ..state.state import State
from ..step.clocks import time_after
from ..step.step import Step

LEAST_STEPS = 6
"""For which a step is recorded: that takes the host as long as one or two steps."""
CHUNK = 64
"""Steps between two looks at how many blocks are active, where the pool follows the scene on CUDA."""


def replayed(step: Step, state: State, n: int, dt: float) -> State:
    """The state n steps later, all but the first replays of a graph; a plan has it.

    The first step from Python makes what steps keep, and asks about these tensors what would be a wait in the graph.
    """
    time = time_after(state.time, dt, n)
    # What begins later is made now, too: in a graph, nobody knows what time it is. Where nobody asks it stays a number,
    # but before the time zero, when obstacles begin that do not say otherwise.
    if n > LEAST_STEPS and (step.reads_time or state.time < 0):
        state = state.replace(time=time_tensor(state))
    if n > 0:
        state, n = step(state, dt), n - 1
    replays = n if n >= LEAST_STEPS else 0
    state = replay_all(step, lambda state: step(state, dt), state, replays, CHUNK)
    for _ in range(n - replays):
        state = step(state, dt)
    return state.replace(time=time)


def replay_all(step: Step, function: Callable[[State], State], state: State, times: int, most: int) -> State:
    """`function`, applied so many times, as replays of a graph; of `most` of them where nobody looks meanwhile whether
    the pool must grow. One activation of the step must be before."""
    graph: Replays | None = None
    in_flight = WorkInFlight(state.x)
    with step._activations.passing_graphs():
        while times > 0:
            count = min(times, most) if step.grid.grows else times
            step.grid.wait()
            blocks = step.grid.pool(state.x, state.scene)
            if graph is None or graph.blocks != blocks:
                graph = Replays(function, state, blocks)
            graph.replay(count, in_flight)
            state, times = graph.state, times - count
            assert step.status is not None
            step.grid.watch(step.status)
    return state
