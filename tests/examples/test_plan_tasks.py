"""Plans for tasks are improved by gradients through the environments, and their pictures are drawn."""

import pytest
from helpers import example

pytest.importorskip("gymnasium")
pytestmark = pytest.mark.usefixtures("one_thread")  # as the script runs


@pytest.mark.thorough
def test_gradients_improve_plans(tmp_path):
    """In 2-D and in 3-D; the picture of the cheaper ones alone."""
    pytest.importorskip("matplotlib")
    plan_tasks = example("plan_tasks")
    least, found = {"roll": 0.004, "lift": 0.006}, {}
    for name, gain in least.items():
        found[name] = plan_tasks.improve(plan_tasks.GUESSES[name]._replace(iterations=2))
        rewards = found[name][1]
        assert len(rewards) == 2 and rewards[-1] > rewards[0] + gain, name
    plan_tasks.draw({"roll": found["roll"]}, tmp_path / "plan_tasks.png", "cpu")
    assert (tmp_path / "plan_tasks.png").stat().st_size > 10_000
