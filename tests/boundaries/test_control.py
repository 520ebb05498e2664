"""Obstacles whose pose or velocity is assigned between calls: they move there, and push what is in their way."""

import copy
import dataclasses
import functools
import gc
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers import relative_error
from torch import Tensor
from torch.utils import _pytree

import torch_mpm as mpm
from torch_mpm import heat_boundaries
from torch_mpm.boundaries import control
from torch_mpm.cuda_graphs.keys import StepKey
from torch_mpm.geometry import shapes

F64 = torch.float64
DT, N, V = 5e-4, 20, 1.0
LAW = mpm.NeoHookean(E=5e4, nu=0.3)


def grid_of(dim: int = 2, scenes: int = 1, dx: float = 0.05) -> mpm.Grid:
    return mpm.Grid(dx, (0.0,) * dim, (1.4, 0.8, 0.6)[:dim], scenes=scenes, deterministic=True)


def block(dim: int = 2, device: str = "cpu", dx: float = 0.05) -> mpm.State:
    points = mpm.seed.box((0.42, 0.1, 0.2)[:dim], (0.6, 0.4, 0.4)[:dim], dx, per_cell=2**dim)
    return mpm.State.at_rest(points, 1000.0, dtype=F64, device=device)


def box(position: Any, dim: int = 2, **given: Any) -> mpm.Box:
    return mpm.Box(position, (0.1, 0.6, 0.6)[:dim], **given)


def start(dim: int = 2, device: str = "cpu") -> Tensor:
    return torch.tensor((0.35, 0.25, 0.3)[:dim], dtype=F64, device=device)


def at(k: int, dim: int = 2, device: str = "cpu") -> Tensor:
    """Where a paddle is at the end of call k, at changing speeds."""
    return start(dim, device) + torch.tensor(
        [V * N * DT * (k + 0.2 * (k % 2)), 0.002 * k * (k - 2), 0.001 * k][:dim], dtype=F64, device=device
    )


def along(poses: list[Tensor]) -> mpm.Waypoints:
    """The path that a paddle takes which is at each pose at the end of a call."""
    times = torch.arange(len(poses), dtype=F64, device=poses[0].device) * N * DT
    return mpm.Waypoints(times, torch.stack(poses))


def step_with(paddle: Any, dim: int = 2, scenes: int = 1, **options: Any) -> mpm.Step:
    return mpm.Step(grid_of(dim, scenes), LAW, walls="separate", boundaries=[paddle], **options)


def assert_alike(a: mpm.State, b: mpm.State, tolerance: float = 1e-9) -> None:
    for name in ("x", "v", "F"):
        assert relative_error(getattr(a, name), getattr(b, name)) < tolerance, name
    assert float(b.v.abs().max()) > 0.2  # which was pushed


# ---- one clear motion, however it is given

Run = Callable[[mpm.Step, mpm.Box, mpm.State, list[Tensor]], mpm.State]


def by_rollouts(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    for pose in poses:
        paddle.position = pose
        state = mpm.rollout(step, state, N, DT)
    return state


def by_numbers(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    for k, pose in enumerate(poses):
        paddle.position = (tuple, list, np.array)[k % 3](pose.tolist())
        state = mpm.rollout(step, state, N, DT)
    return state


def in_place(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    paddle.position = poses[0].clone()
    for pose in poses:
        paddle.position.copy_(pose)
        state = mpm.rollout(step, state, N, DT)
    return state


def by_environments(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    envs = mpm.Environments(step, [state])
    for pose in poses:
        paddle.position = pose[None]
        envs.advance(N, DT)
    return envs.scene(0)


def by_hooks(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    def control(state: mpm.State, k: int) -> None:
        paddle.position = poses[k // N]

    return mpm.frames(step, state, N * len(poses), DT, every=N, hook=control, truncate=7).end


def by_frames(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    for pose in poses:
        paddle.position = pose
        state = mpm.frames(step, state, N, DT, every=7).end  # without a hook: one control step
    return state


def by_norms(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    for pose in poses:
        paddle.position = pose
        state = mpm.rollout(step, state, N, DT, prefix=3, truncate=5)
    return state


def in_a_module(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    class Outer(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.step = step

        def forward(self, state: mpm.State, dt: float) -> mpm.State:
            return self.step(state, dt)

    return by_rollouts(Outer(), paddle, state, poses)


def by_graphs(step: mpm.Step, paddle: mpm.Box, state: mpm.State, poses: list[Tensor]) -> mpm.State:
    step.on_grid = Nothing()
    for pose in poses:
        paddle.position = pose
        state = mpm.rollout(step, state, N, DT, graph=8)
    return state


class Nothing(torch.nn.Module):
    def forward(self, blocks: mpm.Blocks, velocity: Tensor, mass: Tensor, dt: float) -> Tensor:
        return velocity


WAYS = {
    "rollouts": by_rollouts, "numbers": by_numbers, "in place": in_place, "environments": by_environments,
    "hooks": by_hooks, "frames": by_frames, "parts": by_norms, "a module": in_a_module, "graphs": by_graphs,
}  # fmt: skip


@functools.cache
def on_the_path(dim: int, device: str) -> mpm.State:
    poses = [at(k, dim, device) for k in range(4)]
    path = along([start(dim, device), *poses])
    return mpm.rollout(step_with(box(path, dim), dim), block(dim, device), N * len(poses), DT)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("dim", [2, 3])
def test_assigned_positions_push_as_a_path_does(way, dim, device):
    poses = [at(k, dim, device) for k in range(4)]
    paddle = box(start(dim, device), dim)
    end = WAYS[way](step_with(paddle, dim), paddle, block(dim, device), poses)
    assert_alike(end, on_the_path(dim, device))
    assert float(end.v[:, 0].mean()) > 0.5


def test_single_steps_push(device):
    """A single step is a control step. A controller in `on_particles` acts one step late."""
    n, speed = 120, torch.tensor([V, 0.1], dtype=F64, device=device)
    paddle = box(start(device=device))
    step, state = step_with(paddle), block(device=device)
    for k in range(n):
        paddle.position = start(device=device) + k * DT * speed  # the first assignment places it
        state = step(state, DT)
    times = torch.tensor([DT, n * DT], dtype=F64, device=device)
    path = mpm.Waypoints(times, torch.stack([start(device=device), start(device=device) + (n - 1) * DT * speed]))
    expected = mpm.rollout(step_with(box(path)), block(device=device), n, DT)
    assert_alike(state, expected)

    late = box(start(device=device))

    def control(state: mpm.State, dt: float) -> mpm.State:
        late.position = start(device=device) + (state.time + dt) * speed
        return state

    pushed = mpm.rollout(step_with(late, on_particles=control), block(device=device), n, DT)
    assert relative_error(pushed.v, expected.v) < 0.05


def test_a_time_to_reach(device):
    """Every scene is where it should be at its time, in substeps of its own."""
    paddle, given = box(start(device=device)), box(start(device=device), velocity=(V, 0.0))
    step, state = step_with(paddle), block(device=device)
    state = mpm.rollout_to(step, state, 1e-9).state
    paddle.position = start(device=device) + torch.tensor([V * 0.02, 0.0], dtype=F64, device=device)
    end = mpm.rollout_to(step, state.replace(time=0.0), 0.02, longest=2e-4, cfl=0.1)
    expected = mpm.rollout_to(step_with(given), block(device=device), 0.02, longest=2e-4, cfl=0.1)
    assert end.arrived.all() and torch.equal(end.substeps, expected.substeps)
    assert_alike(end.state, expected.state, 1e-6)
    torch.testing.assert_close(paddle.pose_in(end.state).centre, paddle.position)


PATHS = {
    "tensor of numbers": lambda t: torch.tensor([0.35 + V * float(t), 0.25], dtype=F64),
    "tuple": lambda t: (0.35 + V * float(t), 0.25),
    "list": lambda t: [0.35 + V * float(t), 0.25],
    "array": lambda t: np.array([0.35 + V * float(t), 0.25]),
    "function of NumPy": lambda t: np.array([0.35, 0.25]) + np.array([V, 0.0]) * np.asarray(t.cpu()),
    "numbers and tensors": lambda t: [0.35 + V * t, 0.25],
    "tensors and a number that moves": lambda t: torch.stack(
        [torch.tensor(0.35 + V * float(t), dtype=F64, device=t.device), 0.25 + 0 * t]
    ),
    "partly a number": lambda t: torch.stack([0.35 + 0.3 * V * t + 0.7 * V * float(t), 0.25 + 0 * t]),
    "partly detached": lambda t: torch.stack([0.35 + 0.3 * V * t + 0.7 * V * t.detach(), 0.25 + 0 * t]),
    "partly against the rest": lambda t: torch.stack([0.35 - V * t + 2 * V * float(t), 0.25 + 0 * t]),
}


def block_pushed(run: str, device: str, position: Any, **motion: Any) -> mpm.State:
    """The block after 18 steps; the paddle acts by torch operations if `run` says so."""
    form = box if run != "torch operations" else functools.partial(mpm.SDF, shapes.Box((0.1, 0.6)).signed_distance)
    step, state = step_with(form(position, **motion)), block(device=device)
    if run != "steps":
        return mpm.rollout(step, state, 18, 2 * DT)
    for _ in range(18):
        state = step(state, 2 * DT)
    return state


@functools.cache
def block_at_constant_speed(run: str, device: str) -> mpm.State:
    return block_pushed(run, device, (0.35, 0.25), velocity=(V, 0.0))


@pytest.mark.parametrize("run", ["rollout", "steps", "torch operations"])
@pytest.mark.parametrize("path", PATHS)
def test_paths_without_a_derivative_are_differenced(path, run, device):
    position = PATHS[path] if path != "tensor of numbers" else lambda t: PATHS[path](t).to(t.device)
    assert_alike(block_pushed(run, device, position), block_at_constant_speed(run, device), 1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("pace", [1e-6, 1e-3, 0.05])
@pytest.mark.parametrize(
    "path",
    [lambda t: (0.3 * t) % 0.1, lambda t: torch.sin(9 * t), lambda t: 0.3 * t + 1e3],
    ids=["jumps", "curved", "far away"],
)
def test_a_complete_derivative_is_the_velocity(path, pace, dtype):
    """For the steps in which the path jumps too."""
    paddle = box(lambda t: torch.stack([path(t), 0.25 + 0 * t]))
    paddle.pace = pace
    times = torch.linspace(0.01, 0.99, 97, dtype=dtype, requires_grad=True)
    (expected,) = torch.autograd.grad(path(times).sum(), times)
    _, velocity = paddle.path_over(times.detach(), torch.empty(0, 2, dtype=dtype))
    torch.testing.assert_close(velocity[:, 0, 0], expected)


def vector(x: float, y: float) -> Tensor:
    return torch.tensor([x, y], dtype=F64)


ONE_TIME = {
    "numbers": lambda t: (0.35 + V * float(t), 0.25),
    "array": lambda t: np.array([0.35 + V * t.item(), 0.25]),
    "first axis": lambda t: torch.stack([0.35 + V * t, torch.full_like(t, 0.25)]),
    "last axis": lambda t: torch.stack([0.35 + V * t, torch.full_like(t, 0.25)], -1),
    "time times a vector": lambda t: vector(0.35, 0.25).to(t) + t * vector(V, 0.0).to(t),
    "one row": lambda t: vector(0.35, 0.25)[None].to(t) + t * vector(V, 0.0)[None].to(t),
    "row of a scene": lambda t: vector(0.35, 0.25)[None].to(t) + t[..., None] * vector(V, 0.0)[None].to(t),
}


def scenes_pushed(run: str, scenes: int, device: str, position: Any, **motion: Any) -> mpm.State:
    """Blocks in scenes with times of their own; the paddle acts by torch operations if `run` says so."""
    dt = 2 * DT * torch.arange(1, scenes + 1, dtype=F64, device=device)
    paddle = box(position, **motion)
    if run == "torch operations":
        paddle = mpm.SDF(shapes.Box((0.1, 0.6)).signed_distance, position, **motion)
    step = step_with(paddle, scenes=scenes)
    state = mpm.State.concatenate([block(device=device)] * scenes, scene=True)
    if run == "to":
        return mpm.rollout_to(step, state, 20 * dt, longest=2e-3).state
    if run == "rollout":
        return mpm.rollout(step, state, 30, dt)
    state = state.replace(time=torch.zeros(scenes, dtype=F64, device=device))
    for _ in range(20):
        state = step(state, dt)
    return state


@functools.cache
def scenes_at_constant_speed(run: str, scenes: int, device: str) -> mpm.State:
    return scenes_pushed(run, scenes, device, (0.35, 0.25), velocity=(V, 0.0))


@pytest.mark.thorough(scenes=3)
@pytest.mark.parametrize(
    ("run", "scenes"), [("rollout", 2), ("rollout", 3), ("steps", 1), ("steps", 2), ("to", 3), ("torch operations", 2)]
)
@pytest.mark.parametrize("path", ONE_TIME)
def test_paths_of_one_time_serve_scenes_with_times_of_their_own(path, scenes, run, device):
    """Whatever the number of scenes is, also that of the dimensions."""
    assert_alike(
        scenes_pushed(run, scenes, device, ONE_TIME[path]), scenes_at_constant_speed(run, scenes, device), 1e-6
    )


def test_paths_with_rows_of_scenes(device):
    """Rows of all scenes, for one time or for that of each scene."""
    speed = torch.tensor([1.0, 2.0], dtype=F64, device=device)
    start = torch.tensor([0.35, 0.36], dtype=F64, device=device)
    time = torch.tensor([0.1, 0.3], dtype=F64, device=device)
    expected = torch.stack([start + speed * time, torch.full_like(start, 0.25)], -1)
    for path in (
        lambda t: (start + speed * t, 0.25),
        lambda t: torch.stack([start + speed * t, torch.full_like(start, 0.25)], -1),
        lambda t: torch.stack([start, 0.25 + 0 * start], -1) + t[:, None] * torch.stack([speed, 0 * speed], -1),
    ):
        torch.testing.assert_close(box(path).pose(time, start).centre, expected)
        arm = torch.zeros(2, 2, dtype=F64, device=device)
        scene = torch.arange(2, dtype=torch.int32, device=device)
        rate = box(path).velocity_at(arm, scene, time)
        torch.testing.assert_close(rate, torch.stack([speed, torch.zeros_like(speed)], -1))
    with pytest.raises(ValueError, match=r"position must return \[D\] or \[B, D\] at a time, with B = 2, got \[3, 2\]"):
        box(lambda t: torch.zeros(3, 2, dtype=F64, device=device)).pose(time, start)


WRONG_PATHS = {
    "three numbers": (
        lambda t: (0.4, 0.4, 0.4),
        ValueError,
        r"position must return \[2\] or \[B, 2\] at a time, got \[3\]",
    ),
    "one number": (lambda t: 0.4, ValueError, r"position must return \[D\] or \[B, D\] at a time, got \[\]"),
    "bool": (
        lambda t: torch.tensor([True, False]),
        TypeError,
        "position must return real numbers at a time, got torch.bool",
    ),
    "complex": (lambda t: torch.tensor([0.4j, 0.4]), TypeError, "position must return real numbers at a time"),
    "NaN": (lambda t: (np.nan, 0.4), ValueError, "position must return finite numbers at a time"),
    "infinite": (
        lambda t: torch.stack([0.4 / (0 * t), t]),
        ValueError,
        "position must return finite numbers at a time",
    ),
}


@pytest.mark.parametrize("run", ["rollout", "steps", "to", "environments"])
@pytest.mark.parametrize("path", WRONG_PATHS)
def test_wrong_results_of_paths_are_told(path, run):
    given, error, message = WRONG_PATHS[path]
    step = step_with(box(given), scenes=2)
    with pytest.raises(error, match=message):
        state = mpm.State.concatenate([block()] * 2, scene=True)
        if run == "rollout":
            mpm.rollout(step, state, 3, DT)
        elif run == "steps":
            step(state, DT)
        elif run == "to":
            mpm.rollout_to(step, state, 3 * DT)
        else:
            mpm.Environments(step, [block()] * 2).advance(3, DT)


def test_a_path_need_not_be_finite_while_its_obstacle_is_away():
    def path(t: Tensor) -> Tensor:
        return torch.stack([0.35 + torch.where(t < 10.5 * DT, V * t, torch.nan), 0.25 + 0 * t])

    brief, still = box(path, end=10 * DT), box((0.35, 0.25), velocity=(V, 0.0), end=10 * DT)
    for dt in (DT, torch.full((1,), DT, dtype=F64)):
        ends = [mpm.rollout(step_with(paddle), block(), 40, dt) for paddle in (brief, still)]
        torch.testing.assert_close(ends[0].x, ends[1].x, rtol=0, atol=1e-12)


def test_a_path_that_returns_no_position():
    step = step_with(box(lambda t: "here"))
    with pytest.raises(TypeError, match="position must return a tensor, an array or numbers at a time, got str"):
        mpm.rollout(step, block(), 2, DT)


def test_paths_that_refuse_what_stands_for_a_time():
    """Such a path is differenced; only its position is computed where its velocity is not needed."""
    times = []

    def path(t: Tensor) -> Tensor:
        if t.requires_grad or torch._C._functorch.is_functorch_wrapped_tensor(t):
            raise ValueError("a number is needed")
        times.append(float(t))
        return torch.stack([0.35 + V * t, 0.25 + 0 * t])

    ends = [
        mpm.rollout(step_with(paddle), block(), N, DT) for paddle in (box(path), box((0.35, 0.25), velocity=(V, 0.0)))
    ]
    assert_alike(*ends, 1e-8)
    times.clear()
    box(path).pose(0.1)
    assert times == [0.1]


# ---- rotations


@pytest.mark.parametrize("dt", [None, "1e-4"])
def test_wrong_dt_is_named(dt):
    """Before the motion of obstacles is computed with it."""
    step = mpm.Step(grid_of(), mpm.NeoHookean(E=1e4, nu=0.3), boundaries=[box((0.5, 0.5))])
    state = step.prepare(block())
    for run in (lambda: step(state, dt), lambda: mpm.rollout(step, state, 2, dt)):
        with pytest.raises(TypeError, match="dt must be a number of seconds or a tensor"):
            run()


@pytest.mark.parametrize("form", ["tensor", "numbers", "scenes"])
@pytest.mark.parametrize("dim", [2, 3])
def test_assigned_rotations_turn(dim, form, device):
    """The velocity is that of the turn from one orientation to the next, about the centre."""
    turns = [0.1, 0.25] if dim == 2 else [[0.1, -0.2, 0.3], [0.25, -0.1, 0.2]]
    first, second = (torch.tensor(t, dtype=F64, device=device) for t in turns)
    if form == "scenes":
        first, second = first[None], second[None]
    paddle = box(start(dim, device), dim, kind="sticky", rotation=first)
    if form == "numbers":
        paddle.rotation = turns[0] if dim == 2 else tuple(turns[0])
    step = step_with(paddle, dim)
    state = mpm.rollout(step, block(dim, device), N, DT)
    paddle.rotation = second if form != "numbers" else turns[1]
    end = mpm.rollout(step, state, N, DT)

    before, after = (mpm.Box((0.0,) * dim, (1.0,) * dim, rotation=t).pose(0.0) for t in turns)
    turn = after.rotation @ before.rotation.mT
    rate = skew_of(turn) / (N * DT)
    if dim == 2:
        assert float(rate) == pytest.approx((turns[1] - turns[0]) / (N * DT))
    given = box(
        start(dim, device), dim, kind="sticky", rotation=turns[0], angular_velocity=rate.to(device), start=N * DT
    )
    expected = mpm.rollout(step_with(given, dim), state.with_poses({}), N, DT)
    assert_alike(end, expected)
    found = paddle.pose_in(end).rotation.reshape(dim, dim)
    torch.testing.assert_close(found.cpu(), after.rotation, rtol=1e-9, atol=1e-9)


def skew_of(turn: Tensor) -> Tensor:
    """The angle, or the rotation vector, of a rotation matrix, from its eigenvalues."""
    if turn.shape[0] == 2:
        return torch.atan2(turn[1, 0], turn[0, 0])
    values, vectors = torch.linalg.eig(turn)
    logarithm = (vectors @ torch.diag(values.log()) @ torch.linalg.inv(vectors)).real
    return torch.stack([logarithm[2, 1], logarithm[0, 2], logarithm[1, 0]])


def test_the_shortest_turn(device):
    paddle = box(start(device=device), rotation=3.1)
    step = step_with(paddle)
    state = mpm.rollout(step, block(device=device), 1, DT)
    paddle.rotation = 3.1 - 2 * np.pi + 0.1
    with mpm.boundaries.control.control_step(step, state, 1, DT):
        rate = float(paddle.motion.angular_velocity)
    assert rate == pytest.approx(0.1 / DT)
    nearly = torch.tensor([[0.0, 0.0, 3.0], [3.0, 0.5, -0.4]], dtype=F64)
    for a in nearly:
        for b in -0.9 * nearly:
            found = mpm.vectors.composed(a, b)
            expected, got = (mpm.boundaries.motion.rotation_matrix(v, 3) for v in (a, found))
            expected = expected @ mpm.boundaries.motion.rotation_matrix(b, 3)
            torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(
        mpm.vectors.composed, (nearly[0].requires_grad_(), nearly[1].clone().requires_grad_())
    )
    zero, b = torch.zeros(3, dtype=F64, requires_grad=True), torch.tensor([0.1, 0.2, -0.3], dtype=F64)
    for other in (-0.5 * zero, b + zero):
        assert torch.autograd.gradcheck(
            lambda a, other=other: mpm.vectors.composed(a, other.detach() + 0.1 * a), (zero,)
        )


# ---- momentum, scenes, time steps


@pytest.mark.parametrize("dim", [2, 3])
def test_impulses_are_the_change_of_momentum(dim, device):
    paddle = box(start(dim, device), dim, rotation=0.0 if dim == 2 else (0.0, 0.0, 0.0))
    step = mpm.Step(grid_of(dim), LAW, boundaries=[paddle])
    state = step.with_impulses(block(dim, device))
    for k in range(4):
        paddle.position = at(k, dim, device)
        paddle.rotation = 0.02 * k if dim == 2 else (0.0, 0.01 * k, 0.02 * k)
        state = mpm.rollout(step, state, N, DT)
    momentum = (state.mass[:, None] * state.v).sum(0)
    assert float(momentum[0]) > 5.0
    torch.testing.assert_close(-step.impulses(state)[paddle].linear[0], momentum, rtol=1e-11, atol=1e-11)


def test_scenes_move_at_their_own_speed(device):
    """The obstacle of a scene that was reset is at the pose of its attributes, and pushes nothing on its way there."""
    speeds = torch.tensor([0.0, 0.5, 1.0], dtype=F64, device=device)
    home = start(device=device).repeat(3, 1)
    paddle = box(home)
    envs = mpm.Environments(step_with(paddle, scenes=3), [block(device=device)] * 3)
    single = box(start(device=device))
    alone = mpm.Environments(step_with(single), [block(device=device)])
    for k in range(4):
        if k == 2:
            envs.reset([2])
        paddle.position = home + k * N * DT * speeds[:, None] * torch.tensor([1.0, 0.0], dtype=F64, device=device)
        single.position = paddle.position[1:2].clone()
        envs.advance(N, DT)
        alone.advance(N, DT)
        if k == 2:  # at rest, at a place that touches the block
            resting = mpm.rollout(step_with(box(paddle.position[2].clone())), block(device=device), N, DT)
            torch.testing.assert_close(envs.scene(2).v, resting.v, rtol=1e-9, atol=1e-9)
    assert_alike(envs.scene(1), alone.scene(0))
    assert float(envs.scene(0).v.abs().max()) < 1e-9


def test_a_scene_moves_again_after_its_reset(device):
    """Its obstacle is placed once: a pose that is assigned some calls later is reached by a motion."""
    home, away = start(device=device).repeat(2, 1), torch.tensor([0.02, 0.0], dtype=F64, device=device)
    paddle = box(home)
    envs = mpm.Environments(step_with(paddle, scenes=2), [block(device=device)] * 2)
    envs.advance(N, DT)
    envs.reset([1])
    envs.advance(N, DT)
    paddle.position = home + away
    envs.advance(N, DT)
    assert_alike(envs.scene(1), envs.scene(0))


def test_transforms_and_compiled_steps(device):
    """The gradient of torch.func is that of autograd; what is compiled runs, also from a state that steps have left."""
    paddle = box(start(device=device), kind="sticky")
    step, state = step_with(paddle), block(device=device)
    before = mpm.rollout(step, state, 4, DT)

    def loss(position: Tensor) -> Tensor:
        paddle.position = position
        end = step(step(before, DT), DT)
        return (end.v[:, 0] * end.x[:, 0]).sum()

    target = start(device=device) + torch.tensor([0.001, 0.0], dtype=F64, device=device)
    expected = torch.autograd.grad(loss(leaf := target.clone().requires_grad_()), leaf)[0]
    assert float(expected.abs().max()) > 1e-3
    torch.testing.assert_close(torch.func.grad(loss)(target), expected)
    paddle.position = target
    fixed = step_with(box(start(device=device)))
    fixed.grid = mpm.Grid(0.05, (0.0, 0.0), (1.4, 0.8), max_blocks=54)
    left = fixed(state, DT)
    compiled = torch.compile(fixed, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(left, DT).v, fixed(left, DT).v)


@pytest.mark.parametrize("form", ["[B]", "[1]", "[]"])
def test_a_time_step_of_each_scene(form, device):
    """The obstacle of a paused scene waits, and continues to its pose later."""
    scenes = 2 if form == "[B]" else 1
    values = {"[B]": [DT, 0.5 * DT], "[1]": [0.5 * DT], "[]": 0.5 * DT}[form]
    dt = torch.tensor(values, dtype=F64, device=device)
    target = start(device=device) + torch.tensor([0.02, 0.0], dtype=F64, device=device)
    paddle = box(start(device=device).repeat(scenes, 1))
    envs = mpm.Environments(step_with(paddle, scenes=scenes), [block(device=device)] * scenes)
    envs.advance(N, dt)
    paddle.position = target.repeat(scenes, 1)
    envs.advance(N, dt * torch.tensor([1.0, 0.0], dtype=F64, device=device)[:scenes] if scenes == 2 else dt)
    if scenes == 2:
        torch.testing.assert_close(paddle.pose_in(envs.state).centre, torch.stack([target, start(device=device)]))
        envs.advance(N, dt)
    torch.testing.assert_close(paddle.pose_in(envs.state).centre, paddle.position)
    slow = box(start(device=device))
    step = step_with(slow)
    state = mpm.rollout(step, block(device=device), N, 0.5 * DT)
    slow.position = target
    expected = mpm.rollout(step, state, N, 0.5 * DT)
    assert_alike(envs.scene(scenes - 1), expected)


COPIES = {
    "replace": lambda s: s.replace(v=s.v + 0), "dataclasses": lambda s: dataclasses.replace(s, v=s.v + 0),
    "detach": lambda s: s.detach(), "copy": copy.copy, "deepcopy": copy.deepcopy,
    "tree": lambda s: _pytree.tree_map(lambda t: t.clone(), s),
    "two trees": lambda s: _pytree.tree_map(lambda a, b: 0.5 * (a + b), s, s.with_poses({})),
}  # fmt: skip


@pytest.mark.parametrize("of", COPIES)
def test_copies_of_a_state_know_their_obstacles(of, device):
    """A paddle with a velocity has moved away from its position, which has not been assigned."""
    paddle = box(start(device=device), velocity=(V, 0.0))
    step = step_with(paddle)
    state = mpm.rollout(step, block(device=device), N, DT)
    like = COPIES[of](state)
    assert list(like.poses) == [paddle.key]
    assert_alike(mpm.rollout(step, like, N, DT), mpm.rollout(step, state, N, DT))


def test_copies_of_environments_know_their_obstacles(device):
    paddle = box(start(device=device)[None])
    envs = mpm.Environments(step_with(paddle), [block(device=device)])
    envs.advance(N, DT)
    again = copy.deepcopy(envs)
    for each in (envs, again):
        (own,) = each.step.boundaries.entries
        assert list(each.state.poses) == [own.key]
        own.position = own.position + torch.tensor([0.02, 0.0], dtype=F64, device=device)
        each.advance(N, DT)
    assert_alike(again.state, envs.state)


def test_an_obstacle_twice_in_the_list_is_one(device):
    def end(times: int) -> mpm.State:
        paddle = box(start(device=device))
        step = mpm.Step(grid_of(), LAW, walls="separate", boundaries=[paddle] * times)
        state = mpm.rollout(step, block(device=device), 1, DT)
        for k in range(1, 4):
            paddle.position = at(k, device=device)
            state = mpm.rollout(step, state, N, DT)
        return state

    assert_alike(end(2), end(1))


@pytest.mark.parametrize("made", [copy.copy, copy.deepcopy, lambda o: pickle.loads(pickle.dumps(o))])
def test_a_copy_beside_an_obstacle_is_one_of_its_own(made):
    first = box((0.2, 0.25), velocity=(0.01, 0.0))
    second = made(first)
    second.position = (1.0, 0.25)
    step, state = mpm.Step(grid_of(), LAW, walls="separate", boundaries=[first, second]), block()
    for _ in range(2):
        state = mpm.rollout(step, state, N, DT)
    for paddle, x in ((first, 0.2), (second, 1.0)):
        expected = torch.tensor([x + 0.01 * 2 * N * DT, 0.25], dtype=F64)
        torch.testing.assert_close(paddle.pose_in(state).centre, expected)
    assert float(state.v.abs().max()) < 1e-9  # as of a paddle that went from one to the other


def test_states_forget_obstacles_that_are_gone():
    """And no others: a step without an obstacle leaves it where it is."""
    paddle, state = box((0.35, 0.25)), block()
    step = step_with(paddle)
    state = mpm.rollout(step, state, 2, DT)
    for _ in range(2):
        state = step_with(box((1.2, 0.25)))(state, DT)
        gc.collect()
    state = step_with(box((1.2, 0.25)))(state, DT)
    assert len(state.poses) == 2 and paddle.key in state.poses


def test_a_call_depends_on_its_arguments_alone(device):
    """Candidates from one state; a state that was never moved; a copy, and one that was read."""
    paddle = box(start(device=device))
    step = step_with(paddle)
    state = mpm.rollout(step, block(device=device), N, DT)
    ends = []
    for far in (0.02, 0.01, 0.02):
        paddle.position = start(device=device) + torch.tensor([far, 0.0], dtype=F64, device=device)
        ends.append(mpm.rollout(step, state, N, DT))
    assert torch.equal(ends[0].x, ends[2].x) and not torch.equal(ends[0].x, ends[1].x)
    for like in (*COPIES.values(), lambda s: s.to(device), lambda s: step.sorted(s).restored()):
        like = like(state)
        torch.testing.assert_close(mpm.rollout(step, like, N, DT).v, ends[0].v, rtol=1e-9, atol=1e-9)
    placed = mpm.rollout(step_with(box(paddle.position.clone())), state, N, DT)
    for anew in (state.with_poses({}), pickle.loads(pickle.dumps(state)), state.split(1)[0]):
        torch.testing.assert_close(mpm.rollout(step, anew, N, DT).v, placed.v, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(placed.v, ends[0].v)
    with torch.inference_mode():
        torch.testing.assert_close(mpm.rollout(step, state, N, DT).v, ends[0].v, rtol=1e-9, atol=1e-9)


POSITION = [0.36, 0.25]
CHANGES = {
    "number of a list": lambda paddle: paddle.position.__setitem__(0, 0.3),
    "another list": lambda paddle: setattr(paddle, "position", [0.3, 0.25]),
    "a tensor": lambda paddle: setattr(paddle, "position", torch.tensor([0.3, 0.25], dtype=F64)),
    "velocity": lambda paddle: setattr(paddle, "velocity", (0.5, 0.0)),
    "start of the velocity": lambda paddle: (setattr(paddle, "velocity", (0.5, 0.0)), setattr(paddle, "start", -0.1)),
    "end": lambda paddle: setattr(paddle, "end", N * DT / 2),
    "place": lambda paddle: paddle.place((0.3, 0.25), 0.1),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_state_made_anew_finds_obstacles_at_their_latest_attributes(change):
    """The second rollout from the same state begins at the attributes of now, as that of a new obstacle does."""

    def ends(before: Callable[[mpm.Step], Any]) -> tuple[mpm.State, mpm.State]:
        paddle = box((0.4, 0.25))
        paddle.position = list(POSITION)
        step, state = step_with(paddle), block()
        before(step)
        change(paddle)
        end = mpm.rollout(step, state, N, DT)
        paddle.velocity, paddle.position = None, (0.38, 0.25)  # From where the state has left it.
        return end, mpm.rollout(step, end, N, DT)

    again, fresh = ends(lambda step: mpm.rollout(step, block(), N, DT)), ends(lambda step: None)
    for a, b in zip(again, fresh, strict=True):
        for name in ("x", "v", "F"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-12, atol=1e-12)


def test_poses_are_differentiable_after_a_call_in_inference_mode():
    """The first pose of a paddle, from which it moves to an assigned one, has its gradient."""

    def gradient(before: bool) -> Tensor:
        first = start().requires_grad_()
        paddle = box(first)
        step = step_with(paddle)
        if before:
            with torch.inference_mode():
                mpm.rollout(step, block(), N, DT)
        state = mpm.rollout(step, block(), N, DT)
        paddle.position = at(1)
        mpm.rollout(step, state, N, DT).v.sum().backward()
        assert first.grad is not None
        return first.grad

    torch.testing.assert_close(gradient(True), gradient(False), rtol=1e-12, atol=1e-12)


def test_an_obstacle_is_placed_without_a_push(device):
    paddle = box(start(device=device), rotation=0.1)
    step = step_with(paddle)
    state = mpm.rollout(step, block(device=device), N, DT)
    paddle.place((0.36, 0.25), 0.2)
    placed = mpm.rollout(step, state, N, DT)
    expected = mpm.rollout(step_with(box((0.36, 0.25), rotation=0.2)), state.with_poses({}), N, DT)
    torch.testing.assert_close(placed.v, expected.v, rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="position must be finite"):
        paddle.place((np.nan, 0.0))


# ---- velocities that are given


def test_an_assigned_velocity_goes_on_from_where_the_obstacle_is(device):
    """As a path with kinks does, at clocks that are not zero."""
    paddle = box((0.35, 0.25), velocity=(V, 0.0))
    step, state = step_with(paddle), block(device=device)
    speeds = [(V, 0.0), (0.5 * V, 0.2), None, (0.8 * V, 0.0)]
    poses = [start(device=device)]
    for speed in speeds:
        paddle.velocity = speed if speed is None else torch.tensor(speed, dtype=F64, device=device)
        state = mpm.rollout(step, state, N, DT)
        poses.append(poses[-1] + N * DT * torch.tensor(speed or (0.0, 0.0), dtype=F64, device=device))
        torch.testing.assert_close(paddle.pose_in(state).centre, poses[-1])
    expected = mpm.rollout(step_with(box(along(poses))), block(device=device), N * len(speeds), DT)
    assert_alike(state, expected)


def test_velocities_that_agree_with_the_change_of_the_pose(device):
    paddle = box(start(device=device), velocity=(V, 0.0))
    step, state = step_with(paddle), block(device=device)
    for k in range(4):
        paddle.position = start(device=device) + torch.tensor([V * k * N * DT, 0.0], dtype=F64, device=device)
        state = mpm.rollout(step, state, N, DT)
    step.check(state)
    expected = mpm.rollout(step_with(box((0.35, 0.25), velocity=(V, 0.0))), block(device=device), 4 * N, DT)
    assert_alike(state, expected)


@pytest.mark.parametrize("given", ["velocity", "angular velocity", "path", "scenes"])
def test_a_velocity_that_contradicts_the_change_of_the_pose_is_reported(given, device):
    scenes = 2 if given == "scenes" else 1
    paddle = box(start(device=device).repeat(scenes, 1), rotation=0.0)
    step = step_with(paddle, scenes=scenes)
    states = [block(device=device)] * scenes
    state = mpm.rollout(step, mpm.State.concatenate(states, scene=True), N, DT)
    if given == "angular velocity":
        paddle.angular_velocity, paddle.rotation = 0.0, 0.1
    elif given == "path":
        paddle.position = lambda t: torch.stack([0.4 + V * t, 0.25 + 0 * t])
    else:
        paddle.velocity = torch.zeros(2, dtype=F64, device=device)
        paddle.position = paddle.position + torch.tensor([[0.0, 0.0], [0.02, 0.0]], dtype=F64, device=device)[-scenes:]
    place = r" in scenes \[1\]" if given == "scenes" else ".*"
    if device == "cpu":
        with pytest.raises(ValueError, match=rf"obstacle 0 \(Box\) is not where its velocity has led it{place}: a pos"):
            mpm.rollout(step, state, N, DT)
    else:
        state = mpm.rollout(step, state, N, DT)
        assert step.failures().failed.tolist() == [False, True][-scenes:]
        with pytest.raises(mpm.SimulationError, match="obstacles were assigned a pose while they have a velocity"):
            step.check(state)
        step.forget_failures(torch.ones(scenes, dtype=torch.bool, device=device))
        step.check(state)
    paddle.place()
    mpm.rollout(step, state, N, DT)


# ---- assignments inside a step


@pytest.mark.parametrize("rollout", [True, False])
@pytest.mark.parametrize("assign", ["assigned", "in place", "placed"])
def test_an_assignment_inside_a_step_acts_in_the_next_one(assign, rollout, device):
    """The obstacle waits, sweeps during the next step, and rests; one that is placed jumps."""
    paddle, seen = box(torch.tensor([0.2, 0.25], dtype=F64, device=device)), []
    target = torch.tensor([0.3, 0.25], dtype=F64, device=device)
    clock = [0.0]

    def act(state: mpm.State, dt: float) -> mpm.State:
        clock[0] = state.time
        if len(seen) == 2:
            if assign == "assigned":
                paddle.position = target
            elif assign == "in place":
                paddle.position.copy_(target)
            else:
                paddle.place(target)
        return state

    def look(blocks: mpm.Blocks, velocity: Tensor, mass: Tensor, dt: float) -> Tensor:
        speed = paddle.velocity_at(torch.zeros_like(velocity[:1]), None, clock[0])
        centre = paddle.centre_at(clock[0], velocity)
        seen.append((float(centre[0]), 0.0 if speed is None else float(speed.reshape(-1)[0])))
        return velocity

    step, state = step_with(paddle, on_particles=act, on_grid=look), block(device=device)
    if rollout:
        mpm.rollout(step, state, 5, DT)
    else:
        for _ in range(5):
            state = step(state, DT)
    moves = [0.2, 0.2, 0.2, 0.2, 0.3] if assign != "placed" else [0.2, 0.2, 0.2, 0.3, 0.3]
    assert [x for x, _ in seen] == pytest.approx(moves)
    assert [v for _, v in seen] == pytest.approx([0.0, 0.0, 0.0, 0.1 / DT if assign != "placed" else 0.0, 0.0])


@pytest.mark.parametrize("rollout", [True, False])
def test_a_contradiction_inside_a_call_is_reported(rollout, device):
    paddle = box(start(device=device), velocity=(0.0, 0.0))

    def act(state: mpm.State, dt: float) -> mpm.State:
        paddle.position = start(device=device) + (0.02 if state.time > 1.5 * DT else 0.0)
        return state

    step, state = step_with(paddle, on_particles=act), block(device=device)

    def run(state: mpm.State) -> None:
        if rollout:
            mpm.rollout(step, state, 5, DT)
        else:
            for _ in range(5):
                state = step(state, DT)

    if device == "cpu":
        with pytest.raises(ValueError, match="is not where its velocity has led it"):
            run(state)
        assert paddle.course is None and paddle.motion is paddle
    else:
        run(state)
        assert step.failures().failed.tolist() == [True]


def test_a_step_that_fails_inside_a_call_leaves_its_obstacles():
    """The step may be repeated, for example with another time step."""
    paddle = box((0.35, 0.25))
    fails = [False]

    def on_grid(blocks: mpm.Blocks, velocity: Tensor, mass: Tensor, dt: float) -> Tensor:
        if fails[0]:
            raise ArithmeticError
        return velocity

    class Twice(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.step = step_with(paddle, on_grid=on_grid)

        def forward(self, state: mpm.State, dt: float) -> mpm.State:
            paddle.position = (paddle.position[0] + 0.001, 0.25)
            if fails[0]:
                with pytest.raises(ArithmeticError):
                    self.step(state, 2 * dt)
                fails[0] = False
            return self.step(state, dt)

    ends = []
    for trial in (False, True):
        paddle.place((0.35, 0.25))
        state = mpm.rollout(step := Twice(), block(), 2, DT)
        paddle.position, fails[0] = (0.36, 0.25), trial
        ends.append(mpm.rollout(step, state, 3, DT))
    assert_alike(*ends, 1e-12)


def test_keys_of_steps_from_graphs_do_not_depend_on_calls():
    """So that steps with an obstacle at rest are captured once."""
    step, state = step_with(box((0.35, 0.25))), block()
    keys = [StepKey(step).key]
    for _ in range(3):
        with control.control_step(step, state, N, DT) as left:
            keys.append(StepKey(step).key)
            state = left(state)
    assert all(key == keys[0] for key in keys)
    step.boundaries.entries[0].position = lambda t: torch.stack([0.35 + V * t, 0.25 + 0 * t])
    with control.control_step(step, block(), N, DT):
        assert StepKey(step).key != keys[0]


def test_contradictions_are_counted_of_heat_too(device):
    """Also of heat that is stepped alone."""
    heat = mpm.Heat(grid_of(), 10.0, 100.0)
    step = mpm.Step(grid_of(), LAW, heat=mpm.Heat(grid_of(), 10.0, 100.0))
    for module in (heat, step):
        state = block(device=device)
        module(state.replace(temperature=torch.zeros_like(state.mass)), DT)
        module.check()
        control._count(module, torch.tensor([True], device=device))
        with pytest.raises(mpm.SimulationError, match="obstacles were assigned a pose while they have a velocity"):
            module.check()
        module.reset()
        module.check()


@pytest.mark.cuda
def test_numbers_do_not_wait_for_the_device():
    paddle = box((0.35, 0.25))
    step, state = step_with(paddle), block(device="cuda")
    for k, mode in enumerate(("default", "error", "error")):
        torch.cuda.set_sync_debug_mode(mode)
        try:
            paddle.position = (0.35 + 0.001 * k, 0.25)
            with control.control_step(step, state, N, DT) as left:
                state = left(state)
        finally:
            torch.cuda.set_sync_debug_mode("default")


# ---- gradients


def pushed(step: Any, paddle: mpm.Box, state: mpm.State, poses: Tensor, **options: Any) -> Tensor:
    for pose in poses:
        paddle.position = pose
        state = mpm.rollout(step, state, 8, DT, **options)
    return (state.x[:, 0] * state.v[:, 0]).sum() + state.v.square().sum()


@pytest.mark.parametrize("options", [{}, {"checkpoint": 3}, {"checkpoint": mpm.Checkpoints(states=2)}], ids=str)
@pytest.mark.parametrize("way", ["op", "python"])
def test_gradients_of_poses_are_those_of_finite_differences(way, options, device):
    """Through the velocity of the change, too; also where another pose has been assigned before the backward pass."""
    aside = torch.tensor([-0.0113, 0.0077], dtype=F64, device=device)  # so that no face is on a node
    paddle = box(start(device=device) + aside, kind="sticky")
    on_grid = None if way == "op" else lambda blocks, velocity, mass, dt: velocity
    step, state = step_with(paddle, on_grid=on_grid), block(device=device)
    poses = torch.stack([at(k, device=device) + aside for k in range(3)]).requires_grad_()
    loss = pushed(step, paddle, state, poses, **options)
    paddle.position = (9.0, 9.0)
    (gradient,) = torch.autograd.grad(loss, poses)
    h = 1e-7
    with torch.no_grad():
        for k, axis in ((0, 0), (1, 0), (2, 0), (2, 1)):
            shift = torch.zeros_like(poses)
            shift[k, axis] = h
            high, low = (pushed(step, paddle, state, poses + sign * shift) for sign in (1, -1))
            difference = float(high - low) / (2 * h)
            assert float(gradient[k, axis]) == pytest.approx(difference, rel=2e-5, abs=1e-3)
    assert float(gradient[1:, 0].abs().min()) > 1.0


@pytest.mark.parametrize("way", ["calls", "inside"])
def test_gradients_after_poses_were_written_in_place(way, device):
    """A backward pass that computes steps again finds the poses of their time, and what was assigned inside a call."""

    def gradient(write: bool, **options: Any) -> Tensor:
        paddle = box(start(device=device), velocity=torch.zeros(2, dtype=F64, device=device))
        poses = [start(device=device), start(device=device) + torch.tensor([0.02, 0.0], dtype=F64, device=device)]
        v = block(device=device).v.requires_grad_()
        state = block(device=device).replace(v=v)

        def assign(pose: Tensor) -> None:
            paddle.velocity = None
            if write:
                paddle.position.copy_(pose)
            else:
                paddle.position = pose.clone()

        def act(state: mpm.State, dt: float) -> mpm.State:
            if way == "inside":
                assign(poses[0] + (poses[1] - poses[0]) * min(state.time / (N * DT), 1.0))
            return state

        step = step_with(paddle, on_particles=act)
        for pose in (poses[0], *poses, poses[0]):
            if way == "calls":
                assign(pose)
            state = mpm.rollout(step, state, N, DT, **options)
        paddle.position.copy_(poses[0] - 0.1)
        return torch.autograd.grad((state.x.square()).sum(), v)[0]

    expected = gradient(False)
    for write in (False, True):
        assert relative_error(gradient(write, checkpoint=7), expected) < 1e-12


def test_gradients_of_rotations(device):
    state = block(3, device)
    first = torch.tensor([0.1, -0.1, 0.2], dtype=F64, device=device)
    step = step_with(paddle := box(start(3, device), 3, kind="sticky", rotation=first), 3)
    before = mpm.rollout(step, state, 4, DT)
    angle = torch.tensor([0.12, -0.1, 0.25], dtype=F64, device=device, requires_grad=True)

    def loss(angle: Tensor) -> Tensor:
        paddle.rotation = angle
        end = mpm.rollout(step, before, 4, DT)
        return (end.v[:, 1] * end.x[:, 0]).sum()

    (gradient,) = torch.autograd.grad(loss(angle), angle)
    h = 1e-6 * torch.eye(3, dtype=F64, device=device)
    with torch.no_grad():
        differences = torch.stack([(loss(angle + e) - loss(angle - e)) / 2e-6 for e in h])
    torch.testing.assert_close(gradient, differences, rtol=1e-5, atol=1e-6)


# ---- heat, implicit steps


def test_held_regions_follow(device):
    """A ball that is held at a temperature, alone and beside the boundaries of the step."""
    grid = grid_of()
    ends = []
    for moved in (True, False):
        path = along([start(device=device)] + [at(k, device=device) for k in range(3)])
        ball = mpm.Sphere(start(device=device) if moved else path, 0.15)
        held = mpm.Heat(grid, 10.0, 100.0, [heat_boundaries.Fixed(ball, 50.0)])
        step = mpm.Step(grid, LAW, heat=held)
        state = block(device=device)
        state = state.replace(temperature=torch.zeros_like(state.mass))
        for k in range(3):
            ball.position = at(k, device=device) if moved else path
            state = mpm.rollout(step, state, N, DT)
        ends.append(state.temperature)
    assert float(ends[1].max()) > 10
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-6, atol=1e-6)


def test_implicit_steps_are_pushed(device):
    poses = [at(k, device=device) for k in range(3)]
    paddle = box(start(device=device), kind="sticky")
    step = step_with(paddle, integrator="implicit")
    state = block(device=device)
    for pose in poses:
        paddle.position = pose
        state = mpm.rollout(step, state, 4, 5 * DT)
    given = box(along([start(device=device), *poses]), kind="sticky")
    expected = mpm.rollout(step_with(given, integrator="implicit"), block(device=device), 12, 5 * DT)
    assert_alike(state, expected, 1e-6)
