"""A network learns to push a lump to a target by gradients through the environment, and its picture is drawn."""

import pytest
from helpers import example

pytest.importorskip("gymnasium")
pytestmark = pytest.mark.usefixtures("one_thread")  # as the script runs


@pytest.mark.thorough
def test_a_few_gradient_steps_raise_the_reward(tmp_path):
    """In scenes that the training has not seen; pushing on at the first speed moves the lumps half of the way."""
    pytest.importorskip("matplotlib")
    learn_push = example("learn_push")
    policy, training, tests = learn_push.train(3, scenes=3)
    assert len(training) == 3 and tests[-1] > tests[0] + 0.08
    assert learn_push.draw(policy, training, tests, tmp_path, "cpu") < 0.1
    assert (tmp_path / "learn_push.png").stat().st_size > 10_000
