"""Replays of a CUDA graph of one step, or of one segment of steps, without gradients."""

from __future__ import annotations

from collections.abc import Callable

from ..cuda_graphs.graph import Replays, WorkInFlight, time_tensor
from ..state.state import State
from ..step.clocks import time_after
from ..step.step import Step
from .steps import Steps

LEAST_STEPS = 6
"""Least number of replays for which a step is captured: a capture takes the host as long as one or two steps."""
CHUNK = 64
"""Steps between two queries of the number of active blocks, for a pool that grows with the scene on CUDA."""


def replayed(steps: Steps, state: State) -> State:
    """The state after the steps: the first step from Python, the others as replays of a graph, for plans with the
    executor "replay".

    The first step creates the tensors that later steps reuse, and makes the checks that wait for the device, which a
    graph cannot.
    """
    step, n, dt, *_ = steps
    assert isinstance(step, Step)
    time = time_after(state.time, dt, n)
    # The time is a tensor in the graph, which cannot read the host's time, so that obstacles that begin later are
    # part of it. It stays a number if no part of the step reads the time, except before time zero, the default begin
    # of obstacles.
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
    """The state after `times` calls of `function`, as replays of a graph. A grid that grows is checked after at most
    `most` replays, and has a larger pool and a new graph where that is too small. The step must have activated its grid
    before."""
    graph: Replays | None = None
    in_flight = WorkInFlight(state.x)
    with step._error_status.passing_graphs():
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
