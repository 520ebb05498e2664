"""Environments for stable-baselines3: its vector interface, ends of episodes, and what PPO makes of them."""

import importlib
import sys
from typing import Any

import numpy as np
import pytest
import torch

from torch_mpm.envs import Push

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from torch_mpm.envs.stable_baselines import StableBaselinesEnv

pytestmark = pytest.mark.usefixtures("one_thread")


def make(scenes: int = 3, **options: Any) -> StableBaselinesEnv:
    return StableBaselinesEnv(Push(scenes, numpy=True, autoreset_mode="Disabled", **options))


def forward(scenes: int = 3, speed: float = 0.6) -> np.ndarray:
    return np.tile(np.array([speed, 0.0], np.float32), (scenes, 1))


def test_steps_and_seeds_are_those_of_the_environment(device):
    env, plain = make(device=device), Push(3, device=device)
    env.seed(5)
    observation, expected = env.reset(), plain.reset(seed=5)[0]
    for _ in range(3):
        assert observation.dtype == np.float32 and observation in plain.observation_space
        np.testing.assert_array_equal(observation, expected.cpu().numpy())
        observation, reward, ended, infos = env.step(forward())
        expected, of_plain, *_ = plain.step(forward())
        np.testing.assert_array_equal(reward, of_plain.cpu().numpy())
        assert ended.dtype == bool and not ended.any() and infos == [{}, {}, {}]
    assert not np.array_equal(env.reset(), plain.reset(seed=5)[0].cpu().numpy())  # The seed is used once.


def test_a_truncated_episode_returns_the_next_one():
    env, plain = make(max_episode_steps=2), Push(3, max_episode_steps=2, autoreset_mode="Disabled")
    env.seed(0)
    env.reset()
    plain.reset(seed=0)
    env.step(forward())
    plain.step(forward())
    observation, _, ended, infos = env.step(forward())
    last = plain.step(forward())[0].numpy()
    assert ended.all()
    for b, info in enumerate(infos):
        assert info.keys() == {"terminal_observation", "TimeLimit.truncated", "is_success"}
        assert info["TimeLimit.truncated"] is True and info["is_success"] is False
        np.testing.assert_array_equal(info["terminal_observation"], last[b])
    np.testing.assert_array_equal(observation, plain.reset()[0].numpy())
    assert not env.step(forward())[2].any()


def test_success_and_failure_terminate_their_scene():
    env = make(max_episode_steps=1)
    env.reset()
    env.env.goal[0] = env.env.mean("x")[0, :1]
    env.env.goal[1] = torch.nan
    _, _, ended, infos = env.step(forward(speed=0.0))
    assert ended.all() and [info["TimeLimit.truncated"] for info in infos] == [False, False, True]
    assert [info["is_success"] for info in infos] == [True, False, False]
    assert "not finite" in infos[1]["reason"] and not any("reason" in infos[b] for b in (0, 2))


@pytest.mark.parametrize("succeeds", [False, True])
def test_ppo_adds_the_value_of_the_last_observation_to_truncated_episodes_only(succeeds):
    """A learning rate of zero leaves the network of the value as it was in the steps."""
    env = make(1, max_episode_steps=2)
    if succeeds:
        env.env.success = lambda: env.env.steps == 2
    options = {"n_steps": 4, "batch_size": 4, "n_epochs": 1, "gamma": 0.5, "learning_rate": 0.0}
    model = PPO("MlpPolicy", VecMonitor(env), seed=0, device="cpu", **options)
    steps: list[tuple[float, dict[str, Any]]] = []
    model.learn(4, lambda local, _: steps.append((local["rewards"].item(), local["infos"][0])) or True)
    ends = [info for _, info in steps if info]
    assert len(ends) == 2 and all(info["TimeLimit.truncated"] is not succeeds for info in ends)
    last = torch.as_tensor(np.stack([info["terminal_observation"] for info in ends]))
    value = np.zeros(2) if succeeds else model.policy.predict_values(last).detach().numpy()[:, 0]
    expected = np.array([reward for reward, _ in steps])
    expected[1::2] += 0.5 * value
    np.testing.assert_allclose(model.rollout_buffer.rewards[:, 0], expected, rtol=1e-5)
    assert model.rollout_buffer.episode_starts[:, 0].tolist() == [1, 0, 1, 0]
    for info, at in zip(ends, (1, 3), strict=True):
        assert info["episode"]["l"] == 2
        assert info["episode"]["r"] == pytest.approx(sum(reward for reward, _ in steps[at - 1 : at + 1]), abs=1e-6)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: "Push", "env must be a MaterialEnv, got str"),
        (lambda: Push(1, autoreset_mode="Disabled"), "env must have numpy=True"),
        (lambda: Push(1, numpy=True), "env must have autoreset_mode='Disabled', got 'NextStep'"),
    ],
)
def test_other_environments_are_errors(env, message):
    with pytest.raises((TypeError, ValueError), match=message):
        StableBaselinesEnv(env())


def test_what_is_not_of_single_scenes_is_an_error():
    env = make()
    assert env.get_attr("max_episode_steps", [0, 2]) == [40, 40] and env.env_is_wrapped(VecMonitor) == [False] * 3
    env.set_options({"reset_mask": np.ones(3, bool)})
    with pytest.raises(ValueError, match="options must be empty"):
        env.reset()
    with pytest.raises(NotImplementedError, match="goal must be set on env"):
        env.set_attr("goal", 0.0)
    with pytest.raises(NotImplementedError, match="detach must be called on env"):
        env.env_method("detach")


def test_pictures_are_those_of_the_environment():
    pytest.importorskip("vtk")
    env = make(2, render_mode="rgb_array")
    env.reset()
    picture = env.render("rgb_array")
    assert picture.dtype == np.uint8 and picture.shape[2] == 3 and len(np.unique(picture)) > 10
    env.close()


def test_the_library_may_be_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    monkeypatch.delitem(sys.modules, "torch_mpm.envs.stable_baselines")
    with pytest.raises(ImportError, match="StableBaselinesEnv: the package stable_baselines3"):
        importlib.import_module("torch_mpm.envs.stable_baselines")
