"""The time of a state against the sum of its steps: in double precision, in every way to take steps."""

import copy
import io

import numpy as np
import pytest
import torch
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.scenes import block

F32, F64 = torch.float32, torch.float64
START, DT, STEPS = 1000.0, 1e-4, 9
"""In float32 a time of 1000 s is a multiple of 6e-5 s."""


def grid(scenes: int) -> mpm.Grid:
    return mpm.Grid(dx=0.1, lower=(0.0, 0.0), upper=(1.0, 1.0), scenes=scenes, max_blocks=25)


def step_of(scenes: int, **options) -> mpm.Step:
    """A body, and obstacles that come and go between two steps: one that moves, and one that stands."""
    moving = mpm.Sphere((0.2, 0.5), 0.3, kind="sticky", velocity=(50.0, 0.0), start=START + 3.5 * DT)
    brief = mpm.Plane((0.0, 0.5), (0.0, 1.0), kind="sticky", start=START + 1.5 * DT, end=START + 5.5 * DT)
    law = mpm.NeoHookean(E=1e4, nu=0.3)
    return mpm.Step(grid(scenes), law, gravity=(0.0, -100.0), boundaries=[moving, brief], **options)


def state_of(scenes: int, dtype: torch.dtype, device: str) -> mpm.State:
    body = block((0.3, 0.3), (0.7, 0.7), grid(1), velocity=(1.0, 0.0))
    return mpm.State.concatenate([body] * scenes, scene=True).to(device, dtype).replace(time=START)


def loop(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    for _ in range(STEPS):
        state = step(state, dt)
    return state


def from_python(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    step.on_grid = lambda blocks, velocity, mass, dt: velocity
    return mpm.rollout(step, state, STEPS, dt)


def with_gradient(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    with torch.enable_grad():
        return mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), STEPS, dt).detach()


def with_record(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    with torch.enable_grad():
        kept = mpm.Checkpoints(memory=1e9)
        return mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), STEPS, dt, kept).detach()


def checkpointed(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    with torch.enable_grad():
        return mpm.rollout(step, state.replace(v=state.v.clone().requires_grad_()), STEPS, dt, 2).detach()


def in_frames(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    result = mpm.frames(step, state, STEPS, dt, every=3)
    assert result.time.dtype == F64
    assert float((result.time[-1] - result.end.time).abs().max()) == 0
    assert float((result.time[0] - START).abs().max()) == 0
    return result.end


def with_a_path(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    far = mpm.Sphere(lambda t: torch.stack([5.0 + 0 * t, 5.0 + 0 * t], -1), 0.1)
    step.boundaries = [*step.boundaries.entries, far]
    return mpm.rollout(step, state, STEPS, dt)


def in_calls(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    state = mpm.rollout(step, state, 4, dt)
    file = io.BytesIO()
    torch.save(copy.deepcopy(state), file)
    file.seek(0)
    return mpm.rollout(step, torch.load(file, weights_only=True), STEPS - 4, dt)


def graphed_steps(step: mpm.Step, state: mpm.State, dt: float | Tensor) -> mpm.State:
    step.on_grid = lambda blocks, velocity, mass, dt: velocity
    return mpm.rollout(step, state, STEPS, dt, graph=4)


WAYS = (
    loop,
    mpm.rollout,
    from_python,
    with_gradient,
    with_record,
    checkpointed,
    in_frames,
    with_a_path,
    in_calls,
    graphed_steps,
)
FORMS = {
    "number": lambda dt, x: dt,
    "number of NumPy": lambda dt, x: np.float32(dt),
    "[]": lambda dt, x: x.new_full((), dt),
    "[1]": lambda dt, x: x.new_full((1,), dt),
    "[B]": lambda dt, x: x.new_full((2,), dt),
    "[B] in float64": lambda dt, x: x.new_full((2,), dt, dtype=F64),
}
"""Forms of dt."""
TIMES = {
    "number": lambda x: START,
    "[1]": lambda x: x.new_full((1,), START, dtype=F64),
    "[B] in the dtype of x": lambda x: x.new_full((2,), START),
}


@pytest.mark.parametrize(*in_pairs(time=TIMES, form=FORMS, way=WAYS))
@torch.no_grad()
def test_time_is_the_sum_of_the_steps_and_obstacles_follow_it(way, form, time, device):
    """Against the same scene in float64 with numbers."""
    state = state_of(2, F32, device)
    state.time = TIMES[time](state.x)
    dt = FORMS[form](DT, state.x)
    arguments = (STEPS, dt) if way is mpm.rollout else (dt,)
    end = way(step_of(2), state, *arguments)
    assert not isinstance(end.time, Tensor) or end.time.dtype == F64
    now = torch.as_tensor(end.time, dtype=F64)
    assert float((now - (START + STEPS * torch.as_tensor(dt, dtype=F64))).abs().max()) < 1e-12 * START
    expected = loop(step_of(2), state_of(2, F64, device), DT)
    assert float((end.v - expected.v).abs().max()) < 1e-3
    assert float(expected.v[:, 0].max()) > 2  # pushed by the sphere
