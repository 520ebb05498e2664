"""Networks learn tasks by PPO, and their files and curves are written."""

import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import example

from benchmarks import common

pytest.importorskip("gymnasium")
pytest.importorskip("stable_baselines3")
pytestmark = pytest.mark.usefixtures("one_thread")  # as the script runs


@pytest.fixture
def learn_ppo(monkeypatch) -> Any:
    monkeypatch.syspath_prepend(common.ROOT / "examples")  # It imports `plan_tasks`.
    return example("learn_ppo")


@pytest.mark.thorough
def test_push_is_learnt(learn_ppo, tmp_path, capsys):
    """In scenes that the training has not seen; the untrained network moves nothing. The file has the same network."""
    pytest.importorskip("matplotlib")
    result = learn_ppo.train("push", learn_ppo.Training(1600))
    assert result.after.returns.mean() > result.before.returns.mean() + 0.1 and result.failed == 0
    assert [steps for steps, _ in result.curve] == sorted(steps for steps, _ in result.curve) and result.curve
    learn_ppo.save(result.policy, tmp_path / "push.pt")
    policy = learn_ppo.load("push", tmp_path / "push.pt")
    again = learn_ppo.episode(learn_ppo.make_env("push", 16, "cpu"), policy, learn_ppo.TEST)
    assert torch.equal(again.returns, result.after.returns)
    learn_ppo.draw("push", result, tmp_path / "push.png")
    assert (tmp_path / "push.png").stat().st_size > 5_000


def test_files_are_read_as_tensors_only(learn_ppo, tmp_path):
    torch.save({"0.mean": Path("x")}, tmp_path / "push.pt")
    with pytest.raises(pickle.UnpicklingError, match="Weights only load failed"):
        learn_ppo.load("push", tmp_path / "push.pt")


@pytest.mark.thorough
def test_a_seed_determines_the_training(learn_ppo):
    training = learn_ppo.Training(240, 2, 40)
    first, again, other = (learn_ppo.train("push", training, seed) for seed in (3, 3, 4))
    assert first.curve == again.curve and torch.equal(first.after.returns, again.after.returns)
    assert [steps for steps, _ in first.curve] == [160, 240] and first.curve != other.curve


def test_returns_are_those_of_stable_baselines3(learn_ppo):
    """Of a network after an update, by its own evaluation."""
    from stable_baselines3.common.evaluation import evaluate_policy

    model = learn_ppo.make_model("lift", learn_ppo.Training(0, 2, 20), 0, "cpu")
    model.learn(40)
    env = model.get_env()
    env.training = False
    env.seed(7)
    expected, lengths = evaluate_policy(model, env, 2, return_episode_rewards=True)
    assert lengths == [60, 60]
    found = learn_ppo.episode(learn_ppo.make_env("lift", 2, "cpu"), learn_ppo.network_of(model, "lift"), 7)
    torch.testing.assert_close(found.returns, torch.tensor(expected), rtol=1e-3, atol=1e-5)
