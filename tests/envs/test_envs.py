"""Environments: gymnasium's interface, seeds, resets by mask, ends of episodes, failures, rewards and gradients."""

import importlib
import math
import re
import sys
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from torch import Tensor

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

import torch_mpm as mpm  # noqa: E402
from torch_mpm import envs  # noqa: E402
from torch_mpm.envs import write  # noqa: E402
from torch_mpm.geometry.values import to_device  # noqa: E402

F64 = torch.float64
COARSE = {envs.Push: 0.05, envs.Roll: 0.05, envs.Pour: 0.04, envs.Scoop: 0.03, envs.Lift: 0.03, envs.Write: 0.04}
TASKS = pytest.mark.parametrize("task", envs.TASKS, ids=lambda task: task.__name__)


def make(task: type = envs.Push, num_envs: int = 3, **options: Any) -> envs.MaterialEnv:
    return task(num_envs, next(COARSE[kind] for kind in task.__mro__ if kind in COARSE), **options)


def forward(env: envs.MaterialEnv, speed: float = 0.6) -> Tensor:
    """Actions that push to the right."""
    actions = torch.zeros(env.num_envs, env.ACTIONS, dtype=env.dtype)
    actions[:, 0] = speed
    return actions


def run(env: envs.MaterialEnv, seed: Any, n: int = 3) -> list[tuple[Tensor, ...]]:
    first, _ = env.reset(seed=seed)
    return [(first,), *(env.step(forward(env))[:4] for _ in range(n))]


# ---- gymnasium's interface


@TASKS
def test_tasks_are_made_by_gymnasium(task):
    env = gymnasium.make_vec(f"torch_mpm.envs:torch_mpm/{task.__name__}-v0", num_envs=2, dx=COARSE[task], numpy=True)
    assert type(env) is task and env.num_envs == 2 and env.spec.max_episode_steps == task.MAX_EPISODE_STEPS
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.single_action_space.shape == (task.ACTIONS,) and env.action_space.shape == (2, task.ACTIONS)
    observation, info = env.reset(seed=3)
    assert observation in env.observation_space and info == {}
    env.action_space.seed(0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert observation in env.observation_space and observation.dtype == np.float32
    assert reward.shape == terminated.shape == truncated.shape == info["success"].shape == (2,)
    assert reward.dtype == np.float32 and terminated.dtype == truncated.dtype == bool
    env.close()


class Single(gymnasium.Env):
    """One scene as an environment that is no vector, for gymnasium's checker."""

    def __init__(self) -> None:
        self.env = make(num_envs=1, numpy=True, render_mode="rgb_array")
        self.observation_space, self.action_space = self.env.single_observation_space, self.env.single_action_space
        self.metadata, self.render_mode = self.env.metadata, "rgb_array"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.env.np_random = self.np_random
        return self.env.reset(seed=seed, options={})[0][0], {}

    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(action[None])
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}

    def render(self):
        return self.env.render()[0]


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_gymnasiums_checker_accepts_a_scene():
    pytest.importorskip("matplotlib")
    check_env(Single(), skip_render_check=True)


def test_wrappers_of_gymnasium():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(make(numpy=True, max_episode_steps=2))
    env.reset(seed=0)
    first = env.step(forward(env.unwrapped).numpy())[1]
    _, second, _, _, info = env.step(forward(env.unwrapped).numpy())
    np.testing.assert_allclose(info["episode"]["r"], first + second, rtol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_results_are_tensors(dtype, device):
    env = make(dtype=dtype, device=device)
    observation, _ = env.reset(seed=0)
    results = env.step(forward(env).to(device))
    assert results[0].shape == observation.shape == (3, env.OBSERVATIONS)
    assert {r.dtype for r in (observation, *results[:2])} == {dtype} == {env.poses.float().to(dtype).dtype}
    assert {r.device.type for r in (observation, *results[:4], results[4]["success"])} == {device.split(":")[0]}


# ---- seeds and resets


@TASKS
def test_scenes_depend_on_their_seed_alone(task):
    """Not on the scenes around them: a number is for the first scene, the next one has the next number."""
    both, other = run(make(task), [7, 4, 9]), run(make(task), 3)
    alone = run(make(task, 1), 4)
    for values, of_others, single in zip(both, other, alone, strict=True):
        for value, of_other, expected in zip(values, of_others, single, strict=True):
            assert torch.equal(value[1], expected[0]) and torch.equal(of_other[1], expected[0])
    assert not torch.equal(both[0][0][0], both[0][0][1])


def test_random_numbers_continue_without_a_seed():
    env, again = make(), make()
    first, second = env.reset(seed=5)[0], env.reset()[0]
    assert not torch.equal(first, second)
    assert torch.equal(first, again.reset(seed=5)[0]) and torch.equal(second, again.reset()[0])


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_reset_by_mask_leaves_other_scenes(kind):
    env, plain = make(), make()
    for each in (env, plain):
        run(each, 0)
    options = {"reset_mask": kind([False, True, False])}
    observation, _ = env.reset(seed=[None, 1, None], options=options)
    assert set(options) == {"reset_mask"}
    assert torch.equal(observation[1], make(num_envs=1).reset(seed=1)[0][0])
    for _ in range(2):
        (observation, *_), (expected, *_) = env.step(forward(env)), plain.step(forward(plain))
        assert torch.equal(observation[[0, 2]], expected[[0, 2]])
        rows = [env.envs.observe(name)[[0, 2]] for name in ("x", "v", "F")]
        assert all(torch.equal(a, plain.envs.observe(n)[[0, 2]]) for a, n in zip(rows, ("x", "v", "F"), strict=True))
        assert not torch.equal(observation[1], expected[1])
    assert env.steps.tolist() == [5, 2, 5]


class BusyDevice:
    """Work of half a second on a GPU, which begins anew at each part of what is launched.

    A stream holds about a thousand launches, and the host waits for room where more of them follow: a step of many
    kernels and the end of an episode may have more.
    """

    def __init__(self) -> None:
        self.event = torch.cuda.Event()
        self.begin()

    def begin(self) -> None:
        torch.cuda.synchronize()
        torch.cuda._sleep(1_000_000_000)
        self.event.record()

    def check(self, part: str) -> None:
        assert not self.event.query(), f"the host has waited before {part}"


def test_large_seeds_are_folded():
    """Those of `SeedSequence().entropy`, and numbers that pass 2^63 from scene to scene."""
    env, again, entropy = make(), make(), 0x1234_5678_9ABC_DEF0_0FED_CBA9_8765_4321
    first = env.reset(seed=entropy)[0]
    assert torch.equal(first, again.reset(seed=[entropy, entropy + 1, entropy + 2])[0])
    low, high = entropy & (2**63 - 1), entropy >> 63
    assert env.seeds[0] == low ^ (high & (2**63 - 1)) ^ (high >> 63) and bool((env.seeds >= 0).all())
    other = env.reset(seed=entropy + 2**64)[0]
    assert not any(torch.equal(a, b) for a, b in zip(first, other, strict=True))
    env.reset(seed=2**63 - 1)
    assert env.seeds.tolist() == [2**63 - 1, 1, 0]


@pytest.mark.parametrize("of_env", ["cpu", "other"])
def test_masks_and_actions_of_another_device(device, of_env):
    """They are read after the copy has ended, also where the device is busy before."""
    there = "cpu" if of_env == "cpu" else device
    env, plain = make(device=there), make(device=there)
    for each in (env, plain):
        each.reset(seed=0)
    if device != "cpu":
        torch.cuda._sleep(100_000_000)
    mask, actions = torch.tensor([1, 0, 1], device=device) > 0, forward(env).to(device)
    env.reset(options={"reset_mask": mask})
    plain.reset(options={"reset_mask": np.array([True, False, True])})
    torch.testing.assert_close(env.step(actions)[0], plain.step(forward(plain).to(there))[0])
    assert env.steps.tolist() == [1, 1, 1] and env.episodes.tolist() == [1, 0, 1]
    env.envs.reset(mask)
    env.envs.freeze(torch.ones(3, device=device).cumsum(0).long() - 1)
    assert env.envs.time.tolist()[::2] == [0.0, 0.0] and env.envs.frozen.all()


@pytest.mark.parametrize("to", ["device", "host"])
def test_copies_do_not_share_pinned_memory(device, to):
    """Its owner may write to it before the device has read it."""
    if device == "cpu":
        pytest.skip("of CUDA")
    torch.cuda._sleep(100_000_000)
    given = torch.ones(3) if to == "device" else torch.ones(3, device=device)
    given = given.pin_memory() if to == "device" else given
    found = to_device(given, torch.device(device if to == "device" else "cpu"))
    if to == "device":
        given.zero_()
    assert found.tolist() == [1.0, 1.0, 1.0]


@TASKS
def test_a_gpu_is_not_waited_for(task, device):
    """By steps, automatic resets and resets by mask, which return while it has not begun with them."""
    if device == "cpu":
        pytest.skip("of CUDA")
    busy: BusyDevice | None = None

    class Watched(task):
        def observation(self) -> Tensor:
            if busy is not None:
                busy.check("an observation")
                busy.begin()
            return super().observation()

    env = make(Watched, device=device, max_episode_steps=3)
    mask = torch.tensor([True, False, True], device=device)
    with torch.no_grad():
        for k in range(6):
            if k in (0, 4):  # the first calls make constants and the pool of blocks
                env.reset(seed=0 if k == 0 else None, options=None if k == 0 else {"reset_mask": mask})
            env.step(forward(env).to(device))
        busy = BusyDevice()
        env.step(forward(env).to(device, non_blocking=True))
        busy.check("the end of a step")
        env.reset(options={"reset_mask": mask})
        busy.check("the end of a reset")
    assert not env.bodies.step.failures(env.envs.state).failed.any()


def test_actions_of_a_gpu_that_are_not_finite_fail_their_scene(device):
    """On the CPU they are an error, see below; here the particles that the body touches are not finite either."""
    if device == "cpu":
        pytest.skip("of CUDA")
    env = make(device=device)
    env.reset(seed=0)
    actions = forward(env)
    actions[1, 1] = math.nan
    *_, terminated, _, info = env.step(actions.to(device))
    assert terminated.tolist() == info["failed"].tolist() == [False, True, False]
    reason = env.failure_reasons()[1]
    assert re.match("[0-9]+ particles have a position that is NaN or infinite: .* in scene 1 ", reason)
    env.step(forward(env).to(device))
    assert not env.step(forward(env).to(device))[2].any()


# ---- ends of episodes


def test_next_step_resets_truncated_scenes():
    env = make(max_episode_steps=3)
    env.reset(seed=0)
    env.step(forward(env))
    env.reset(options={"reset_mask": np.array([True, False, False])})
    results = [env.step(forward(env)) for _ in range(4)]
    assert [r[3].tolist() for r in results] == [[False] * 3, [False, True, True], [True, False, False], [False] * 3]
    assert not any(bool(r[2].any()) for r in results)
    assert results[2][1][1:].tolist() == [0.0, 0.0] and float(results[2][1][0]) > 0  # of the step that resets
    again = make()
    again.reset(seed=0)
    expected = again.reset()[0]
    assert torch.equal(results[2][0][1:], expected[1:])
    assert float(results[3][1][1]) == float(again.step(forward(again))[1][1])


def test_disabled_autoreset_keeps_ended_scenes():
    env = make(max_episode_steps=2, autoreset_mode="Disabled")
    assert env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    run(env, 0, 1)
    last, *_ = env.step(forward(env))
    env.reset(seed=0, options={"reset_mask": torch.tensor([True, False, False])})
    observation, reward, _, truncated, _ = env.step(forward(env))
    assert truncated.tolist() == [False, True, True] and reward[1:].tolist() == [0.0, 0.0]
    assert torch.equal(observation[1:], last[1:]) and float(reward[0]) > 0


def test_success_ends_an_episode():
    env = make()
    env.reset(seed=0)
    env.goal[1] = env.mean("x")[1, :1]
    _, _, terminated, truncated, info = env.step(forward(env, 0.0))
    assert terminated.tolist() == info["success"].tolist() == [False, True, False] and not truncated.any()


def spoiled(values: Tensor, value: float) -> Tensor:
    """With another value for a particle of scene 1 of 3."""
    row = len(values) // 3 + 5
    return torch.where(torch.arange(len(values))[:, None] == row, value, values)


def fail_by_velocity(env: envs.MaterialEnv) -> None:
    env.envs.state = env.envs.state.replace(v=spoiled(env.envs.state.v, math.nan))


def fail_by_position(env: envs.MaterialEnv) -> None:
    env.envs.state = env.envs.state.replace(x=spoiled(env.envs.state.x, 9.0))


def fail_by_score(env: envs.MaterialEnv) -> None:
    env.goal[1] = math.nan


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
@pytest.mark.parametrize(
    ("fail", "reason"),
    [
        (fail_by_velocity, "NaN or infinite.* in scene 1"),
        (fail_by_position, "1 particles left the grid .* in scene 1"),
        (fail_by_score, "the observation, the score or a pose is not finite"),
    ],
)
def test_failed_scenes_end_with_a_reason(fail, reason, mode):
    env, plain = make(autoreset_mode=mode), make()
    for each in (env, plain):
        last = run(each, 0, 1)[-1][0]
    fail(env)
    observation, reward, terminated, truncated, info = env.step(forward(env))
    expected = plain.step(forward(plain))
    assert terminated.tolist() == info["failed"].tolist() == [False, True, False]
    assert not truncated.any() and not info["success"].any()
    reasons = env.failure_reasons()
    assert reasons[0] is None and reasons[2] is None and re.search(reason, reasons[1])
    assert float(reward[1]) == 0.0 and torch.equal(observation[1], last[1])
    assert torch.equal(observation[[0, 2]], expected[0][[0, 2]]) and torch.equal(reward[[0, 2]], expected[1][[0, 2]])
    if mode == "Disabled":
        assert env.step(forward(env))[2].tolist() == [False, True, False]
        env.reset(options={"reset_mask": torch.tensor([False, True, False])})
    else:
        env.step(forward(env))
    *_, terminated, _, info = env.step(forward(env))
    assert not terminated.any() and not info["failed"].any() and env.failure_reasons() == [None] * 3


# ---- rewards


def of_push(env: envs.MaterialEnv, b: int, x: np.ndarray) -> float:
    centre, disc = x.mean(0), env.poses[b, 0, :2].numpy()
    return -abs(centre[0] - env.goal[b, 0].item()) - 0.1 * np.hypot(*(centre - disc))


def of_roll(env: envs.MaterialEnv, b: int, x: np.ndarray) -> float:
    return -x[:, 1].mean()


def of_pour(env: envs.MaterialEnv, b: int, x: np.ndarray) -> float:
    left, bottom = env.poses[b, 1, 0].item() - 0.12, 4 * 0.04
    nearest = np.stack([x[:, 0].clip(left, left + 0.24), x[:, 1].clip(bottom, bottom + 0.24)], 1)
    return -np.linalg.norm(x - nearest, axis=1).mean()


def of_lift(env: envs.MaterialEnv, b: int, x: np.ndarray) -> float:
    centre, fingers = x.mean(0), env.poses[b, :, :3].numpy()
    return -abs(centre[2] - env.goal[b, 0].item()) - 0.1 * np.linalg.norm(fingers - centre, axis=1).mean()


def of_scoop(env: envs.MaterialEnv, b: int, x: np.ndarray) -> float:
    return x[:, 1].mean()


def of_write(env: envs.MaterialEnv, b: int, x: np.ndarray) -> float:
    """With the distance from the nearest of many points of the stroke."""
    corners, _, first, _ = (part[b].numpy() for part in env.parts())
    stroke = np.concatenate([np.linspace(*corners[k : k + 2], 1001) for k in range(3)])
    distance = KDTree(stroke).query(x[:, :2])[0]
    left = np.maximum(x[:, 2] - 0.06, 0) * np.maximum(1 - distance / 0.08, 0)
    return -left.mean() / first


SCORES = {
    envs.Push: of_push,
    envs.Roll: of_roll,
    envs.Pour: of_pour,
    envs.Scoop: of_scoop,
    envs.Lift: of_lift,
    envs.Write: of_write,
}


@TASKS
def test_rewards_are_gains_of_the_score(task):
    """Computed here from the positions of the particles, which have equal masses."""
    score, rounding = SCORES[task], 3e-5 if task is envs.Write else 1e-12
    env = make(task, 2, dtype=F64)
    env.reset(seed=1)
    now = [score(env, b, env.envs.scene(b).x.numpy()) for b in range(2)]
    actions = torch.tensor(np.random.default_rng(0).uniform(-1, 1, (3, 2, task.ACTIONS)))
    for action in actions:
        before, reward = now, env.step(action)[1]
        now = [score(env, b, env.envs.scene(b).x.numpy()) for b in range(2)]
        np.testing.assert_allclose(reward.numpy(), np.subtract(now, before), atol=rounding)
        assert np.abs(np.subtract(now, before)).min() > 10 * rounding


@TASKS
def test_tasks_know_how_scenes_begin(task):
    env = make(task, 3)
    env.reset(seed=2)
    env.step(torch.zeros(3, task.ACTIONS))
    env.reset(options={"reset_mask": torch.tensor([True, False, True])})
    for known, computed in zip(env.start(), (env.observation(), env.score()), strict=True):
        torch.testing.assert_close(known[[0, 2]], computed[[0, 2]], rtol=0, atol=1e-6)


def test_a_task_with_another_score_has_another_start():
    """Not that of the class that it extends."""

    class Twice(envs.Write):
        def score(self):
            return 2 * super().score()

    class Named(envs.Write):
        """Nothing else is different."""

    env = Twice(1, 0.04)
    env.reset(seed=0)
    torch.testing.assert_close(env.start()[1], torch.full((1,), -2.0), rtol=0, atol=1e-6)
    assert Named.start is envs.Write.start is not envs.MaterialEnv.start


def test_a_task_may_change_its_reward():
    class Frugal(envs.Push):
        def reward(self, gain, actions):
            return gain - 0.01 * actions.square().sum(1)

    env, plain = Frugal(2, 0.05), make(num_envs=2)
    rewards = [run(each, 0, 1)[-1][1] for each in (env, plain)]
    torch.testing.assert_close(rewards[0], rewards[1] - 0.01 * 0.36)


def test_actions_move_the_bodies():
    env = make(num_envs=2, dtype=F64)
    env.reset(seed=0)
    first = env.poses.clone()
    env.step(np.array([[0.5, 0.25], [-5.0, -1.0]]))
    torch.testing.assert_close(env.poses[0, 0], first[0, 0] + 0.04 * torch.tensor([0.5, 0.25, 0.0], dtype=F64))
    # Clamped to -1, and the disc stays on the floor.
    torch.testing.assert_close(env.poses[1, 0], first[1, 0] + 0.04 * torch.tensor([-1.0, 0.0, 0.0], dtype=F64))
    for _ in range(9):
        env.step(np.array([[0.0, 0.0], [-1.0, 0.0]]))
    assert float(env.poses[1, 0, 0]) == pytest.approx(0.1)


def test_a_cup_pours():
    env = make(envs.Pour, 1)
    env.reset(seed=0)
    for k in range(110):
        *_, info = env.step(torch.tensor([[0.9, 0.0, 0.0] if k < 20 else [0.0, 0.0, -0.8]]))
        if info["success"].any():
            return
    assert float(env.share()) > 0.5


def test_water_at_rest_in_the_glass_is_in_it():
    """Its pressure moves some of it into the walls, less than half a cell."""

    class Full(envs.Pour):
        def scenes(self, random: torch.Tensor) -> envs.Scenes:
            made = super().scenes(random)
            return made._replace(fields=self.shifted(made.poses[:, 1, 0] - 0.12, self.thick))

    env = make(Full, 1)
    env.reset(seed=0)
    *_, info = env.step(torch.zeros(1, 3))
    assert info["success"].all()
    env.success = lambda: torch.zeros_like(env.ended)
    env.reset(seed=0)
    for _ in range(60):
        env.step(torch.zeros(1, 3))
    assert float((env.distances() == 0).double().mean()) < 0.97 < float(env.share())


def test_a_bucket_scoops():
    env = make(envs.Scoop, 1)
    env.reset(seed=0)
    phases = [(10, (0.3, -0.9, -0.7)), (35, (0.9, 0.0, 0.0)), (20, (0.6, 0.2, 0.7)), (30, (0.0, 0.8, 0.3))]
    for action in [action for count, action in phases for _ in range(count)]:
        *_, info = env.step(torch.tensor([action]))
        if info["success"].any():
            return
    pytest.fail("too little sand was lifted")


@pytest.mark.parametrize("seed", range(4))
def test_a_stylus_writes(seed):
    """It follows the points of the observation, around which the share of the clay falls from one to about a half."""
    env = make(envs.Write, 1)
    observation, _ = env.reset(seed=seed)
    assert observation[0, 27:].tolist() == [1.0] * 12
    k, height = 0, 0.33
    for _ in range(100):
        to_points = observation[0, 3:27].reshape(12, 2)
        way = torch.cat([to_points[k], height - observation[0, 2:3]])
        if way.norm() < 0.03:
            k, height = (k, 0.22) if height > 0.3 else (k + 1, 0.22)
        observation, *_, info = env.step((way / 0.02)[None])
        if info["success"].any():
            assert 0.4 < float(observation[0, 27:].mean()) < 0.6  # The score is that of the whole groove.
            return
    pytest.fail("too much clay was left in the groove")


def test_points_lie_along_the_strokes_of_letters():
    """The lengths from the first corner to the points, along the stroke, are odd multiples of the first of them."""
    for corners in write.LETTERS.values():
        corners, points = np.array(corners), np.array(write.points_along(corners))
        ends = np.concatenate([[0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])
        for k, point in enumerate(points):
            length = (k + 0.5) / 12 * ends[-1]
            i = np.searchsorted(ends, length) - 1
            way = (corners[i + 1] - corners[i]) / (ends[i + 1] - ends[i])
            np.testing.assert_allclose(point, corners[i] + (length - ends[i]) * way, atol=1e-12)


def test_fingers_lift():
    env = make(envs.Lift, 1)
    env.reset(seed=0)
    for k in range(24):
        env.step(torch.tensor([[0.5, -0.5, 0.0] if k < 6 else [0.1, -0.1, 0.5]]))
    assert float(env.envs.scene(0).x[:, 2].min()) > 0.05


# ---- gradients


TOUCHING = {
    envs.Push: (0.5, 0.1),
    envs.Roll: (0.1, -0.9),
    envs.Pour: (0.5, 0.0, -0.5),
    envs.Scoop: (0.2, -0.9, 0.5),
    envs.Lift: (0.8, -0.8, 0.1),
    envs.Write: (0.2, -0.2, -0.9),
}
"""Actions that touch the material from the first steps on."""


@TASKS
def test_gradients_are_those_of_finite_differences(task):
    """Along the gradient, at a plan without symmetry: a node exactly on the surface of a body makes a jump."""
    env = make(task, 1, dtype=F64, differentiable=True)
    noise = torch.tensor(np.random.default_rng(0).normal(size=(4, 1, task.ACTIONS)))
    plan = torch.tensor(TOUCHING[task], dtype=F64) + 0.05 * noise.clamp(-1, 1)

    def total(plan: Tensor) -> Tensor:
        env.reset(seed=0)
        if task is envs.Scoop:
            env.poses[:, 0, 1] -= 0.1  # into the sand
        return torch.stack([env.step(action)[1].sum() for action in plan]).sum()

    (gradient,) = torch.autograd.grad(total(plan.requires_grad_()), plan)
    along = gradient / gradient.norm()
    with torch.no_grad():
        found = float(total(plan + 1e-6 * along) - total(plan - 1e-6 * along)) / 2e-6
    assert found > 1e-4 and float(gradient.norm()) == pytest.approx(found, rel=1e-5)


def test_gradients_end_at_resets_and_at_detach():
    actions = torch.full((3, 3, 2), 0.5, requires_grad=True)
    env = make(differentiable=True)
    env.reset(seed=0)
    env.step(actions[0])
    env.reset(options={"reset_mask": np.array([True, False, False])})
    observation = env.step(actions[1])[0]
    (gradient,) = torch.autograd.grad(observation.sum(), actions, retain_graph=True)
    assert not gradient[0, 0].any() and gradient[0, 1:].any() and gradient[1].any()
    env.detach()
    env.step(actions[2])[1].sum().backward()
    assert not actions.grad[:2].any() and actions.grad[2].any()
    env.reset()
    env.step(actions[2])[1].sum().backward()  # not through steps before the reset


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_gradients_end_at_a_mask_of_all_scenes(kind, device):
    """A mask on the host frees the memory of the graph; one on a device is not read, and makes gradients zero."""
    env = make(differentiable=True, device=device)
    env.reset(seed=0)
    actions = forward(env).to(device).requires_grad_()
    env.step(actions)
    assert env.envs.state.x.requires_grad and env.poses.requires_grad
    env.reset(options={"reset_mask": kind([True] * 3)})
    assert not any(t.requires_grad for t in (env.envs.state.x, env.envs.state.F, env.poses, env._score))
    observation = env.step(actions)[0]
    if device != "cpu":
        env.reset(options={"reset_mask": torch.ones(3, dtype=torch.bool, device=device)})
        assert env.envs.state.x.requires_grad
        (gradient,) = torch.autograd.grad(env.step(forward(env).to(device))[1].sum(), actions, retain_graph=True)
        assert not gradient.any()
    observation.sum().backward()
    assert actions.grad.any()


@pytest.mark.parametrize("fail", [fail_by_velocity, fail_by_position, fail_by_score])
def test_a_failed_scene_has_no_gradient_and_harms_no_other(fail):
    env = make(differentiable=True)
    actions = torch.full((2, 3, 2), 0.5, requires_grad=True)
    env.reset(seed=0)
    rewards = env.step(actions[0])[1]
    fail(env)
    rewards = rewards + env.step(actions[1])[1]
    rewards.sum().backward()
    assert actions.grad.isfinite().all() and not actions.grad[1, 1].any()
    assert all(actions.grad[k, b].any() for k, b in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2)))


@pytest.mark.parametrize("differentiable", [False, True])
def test_no_graph_is_built_where_none_is_wanted(differentiable):
    env = make(differentiable=differentiable)
    env.reset(seed=0)
    with torch.no_grad() if differentiable else torch.enable_grad():
        results = env.step(forward(env).requires_grad_(differentiable))
    assert not any(r.requires_grad for r in (*results[:2], env.envs.state.x, env.poses))


# ---- pictures


def test_pictures_show_the_scenes():
    pytest.importorskip("matplotlib")
    env = make(num_envs=2, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    assert len(before) == 2 and all(p.shape == (360, 480, 3) and p.dtype == np.uint8 for p in before)
    assert not np.array_equal(*before)
    env.step(forward(env))
    assert not np.array_equal(before[0], env.render()[0])
    env.close()


# ---- errors


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"autoreset_mode": "SameStep"}, r"autoreset_mode must be one of \['Disabled', 'NextStep'\], got 'SameStep'"),
        ({"autoreset_mode": AutoresetMode.SAME_STEP}, "got 'SameStep'"),
        ({"render_mode": "human"}, "render_mode must be None or 'rgb_array', got 'human'"),
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, got 0"),
        ({"differentiable": True, "numpy": True}, "numpy must be False where differentiable is True"),
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"dtype": torch.float16}, "dtype must be float32 or float64, got torch.float16"),
    ],
)
def test_wrong_options_are_errors(options, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make(**options)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "torch_mpm.envs.package")
    with pytest.raises(ImportError, match=r"gymnasium is not installed: pip install torch-mpm\[envs\]"):
        importlib.import_module("torch_mpm.envs.package")


def test_wrong_calls_are_errors():
    env = make()
    with pytest.raises(RuntimeError, match="reset must be called before the first step"):
        env.step(forward(env))
    with pytest.raises(RuntimeError, match="reset must be called without a mask"):
        env.reset(options={"reset_mask": np.array([True, False, False])})
    env.reset(seed=0)
    for actions, message in (
        (forward(env)[:2], r"actions must be a tensor or an array \[B, A\] = \[3, 2\], got \[2, 2\]"),
        ([[0.0, 0.0]] * 3, "got list"),
        (forward(env, math.nan), "actions must be finite"),
        (forward(env).requires_grad_(), "actions must not require grad where differentiable is False"),
    ):
        with pytest.raises(ValueError, match=message):
            env.step(actions)
    for mask, message in (
        ([True, False, False], "reset_mask must be bool .* got list"),
        (np.array([True, False]), r"got bool \[2\]"),
        (torch.tensor([1, 0, 0]), r"got int64 \[3\]"),
        (np.array([1, 0, 0]), r"got int64 \[3\]"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="options must have the key 'reset_mask' only, got 'mask'"):
        env.reset(options={"mask": None})
    with pytest.raises(ValueError, match="seed must be a number or a list of 3, got 2"):
        env.reset(seed=[1, 2])
    for seed in (-1, 0.5, [1, "a", None]):
        with pytest.raises(ValueError, match="seed must be a whole number >= 0, or a list of such numbers and None"):
            env.reset(seed=seed)
    with pytest.raises(TypeError, match="options must be a dictionary, got list"):
        env.reset(options=[1])
    with pytest.raises(ValueError, match="render_mode must be 'rgb_array' where pictures are drawn, got None"):
        env.render()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda made: {"poses": made.poses[:, 0]}, r"poses of scenes must have shape \[3, 1, 3\], got \[3, 3\]"),
        (lambda made: {"goal": made.goal[:, 0]}, r"goal of scenes must have shape \[B, G\] = \[3, G\], got \[3\]"),
        (lambda made: {"goal": made.goal[:1]}, r"goal of scenes .* got \[1, 1\]"),
        (lambda made: {"fields": {"colour": made.goal}}, r"fields of scenes must be among \[.*'x'\], .* got 'colour'"),
        (lambda made: {"fields": {"x": made.fields["x"][:, :-1]}}, r"field 'x' of scenes must have shape \[3, 64, 2\]"),
        (lambda made: {"fields": {"mass": made.fields["x"]}}, r"field 'mass' .* \[3, 64\], got \[3, 64, 2\]"),
        (lambda made: {"fields": {"x": made.fields["x"].long()}}, "field .x. .* must be torch.float32, got"),
    ],
)
def test_what_scenes_return_is_checked(change, message):
    class Changed(envs.Push):
        def scenes(self, random):
            made = super().scenes(random)
            return made._replace(**change(made))

    with pytest.raises((TypeError, ValueError), match=message):
        Changed(3, 0.05)


class Mixed(envs.Push):
    """A lump of two laws, whose share differs from scene to scene, as do their plastic strain and their speed."""

    RANDOM = 3

    def __init__(self, num_envs: int, dx: float, **options: Any) -> None:
        self.grid = mpm.Grid(dx, (0.0, 0.0), (1.0, 1.0), scenes=num_envs)
        self.points = mpm.seed.box((0.0, 0.0), (0.2, 0.2), self.grid, per_cell=4)
        disc = mpm.Sphere((0.0, 0.0), 0.1, "separate")
        law = mpm.Mixture([mpm.NeoHookean(E=2e4, nu=0.3), mpm.VonMises(E=2e4, nu=0.3, yield_stress=1e3)])
        step = mpm.Step(self.grid, law, walls="separate", boundaries=[disc])
        envs.MaterialEnv.__init__(self, step, [disc], substeps=4, dt=1e-3, **options)

    def particles(self):
        state = super().particles()
        return state.replace(material=torch.zeros(len(state), dtype=torch.int32, device=self.device))

    def scenes(self, random):
        made, rows = super().scenes(random), torch.arange(len(self.first), device=self.device)
        second = rows < len(rows) * random[:, 2:]
        fields = {"material": second.int(), "v": 0.1 * second[..., None].expand(-1, -1, 2).double()}
        strain = next(iter(self.envs.first.extra))
        return made._replace(fields={**made.fields, **fields, strain: 0.01 * second.double()})


def test_fields_of_scenes_have_their_dtypes(device):
    """Whole numbers stay whole, and histories of laws are fields too."""
    env = make(Mixed, device=device)
    env.reset(seed=0)
    material, (strain, *_) = env.envs.observe("material"), env.envs.first.extra
    assert material.dtype == torch.int32 and len(set(material.sum(1).tolist())) == 3
    torch.testing.assert_close(env.envs.observe(strain), 0.01 * material.float())
    torch.testing.assert_close(env.envs.observe("v")[..., 0], 0.1 * material.float())
    assert not env.step(forward(env).to(device))[4]["failed"].any()


def test_constants_of_inference_mode_serve_gradients():
    """Numbers alone are not kept."""
    env = make(differentiable=True)
    with torch.inference_mode():
        made = env.constant(((1.0, 2.0), (3.0, 4.0)))
    kept = len(env._constants)
    for k in range(3):
        assert float(env.constant(0.1 * k, F64)) == 0.1 * k
    assert len(env._constants) == kept and env.constant(((1.0, 2.0), (3.0, 4.0))) is made
    leaf = torch.ones(2, 2, requires_grad=True)
    (leaf * made).sum().backward()
    assert torch.equal(leaf.grad, made)


@TASKS
def test_scenes_are_stable(task):
    """Time steps are within the limit, bodies thick enough for the cells, and both as tasks are made by default."""
    for env in (task(1), make(task, 1)):
        env.reset(seed=0)
        step = env.bodies.step
        assert env.dt <= float(step.stable_dt(env.envs.state))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.step(torch.zeros(1, task.ACTIONS))
            step.check(env.envs.state)
