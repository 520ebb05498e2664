"""The benchmark of PPO trains a task, and its table and curves are written."""

from pathlib import Path

import pytest
from helpers import result, run_quick_here

from benchmarks import envs_ppo


@pytest.mark.thorough
def test_a_task_is_trained_and_reported(tmp_path: Path) -> None:
    for package in ("gymnasium", "matplotlib", "stable_baselines3"):
        pytest.importorskip(package)
    run_quick_here("benchmarks.envs_ppo", tmp_path)
    found = result(tmp_path, "envs_ppo_*.json")
    (task,) = found["tasks"]
    assert task["name"] == "push" and task["training"]["steps"] == 240 and task["curve"]["steps"] == [160, 240]
    assert task["scene 0"]["best plan"] > 0.2 and task["training"]["failed"] == 0
    name = envs_ppo.file_name(found)
    assert envs_ppo.table(found) in (tmp_path / f"{name}.md").read_text()
    assert (tmp_path / f"{name}.png").stat().st_size > 5_000
