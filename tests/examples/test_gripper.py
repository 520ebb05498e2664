"""A gripper of MuJoCo lifts a soft cube where friction bears its weight, and draws its picture."""

import pytest
from helpers import example

pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("one_thread")  # as the script runs


@pytest.fixture(scope="module")
def runs():
    """On a coarse grid; more friction than weight / (2 force) = 0.28 is needed."""
    gripper = example("gripper")
    return gripper, {friction: gripper.grasp(friction, dx=0.025, seconds=1.1) for friction in gripper.FRICTIONS}


@pytest.mark.thorough
def test_friction_lifts_the_cube(runs):
    """It hangs by its weight, or stays on the table."""
    gripper, (held, slipped) = runs[0], runs[1].values()
    assert held["hand"][-1] > 0.1 and held["cube"][-1] > 0.75 * held["hand"][-1]
    weight = gripper.DENSITY * gripper.SIDE**3 * gripper.GRAVITY
    assert sum(held["lift"][-5:]) / 5 == pytest.approx(weight, rel=0.03)
    assert slipped["hand"][-1] > 0.1 and abs(slipped["cube"][-1]) < 0.02
    assert abs(slipped["lift"][-1]) < 0.05 * weight


@pytest.mark.thorough
def test_pictures(runs, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    gripper = runs[0]
    gripper.draw(
        {friction: {name: rows[::24] for name, rows in run.items()} for friction, run in runs[1].items()}, tmp_path
    )
    assert (tmp_path / "gripper.png").stat().st_size > 10_000
    assert {path.name for path in tmp_path.glob("*.mp4")} == {"gripper_0.5.mp4", "gripper_0.2.mp4"}
