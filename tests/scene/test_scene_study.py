"""The examples against what is known about them: studies of a minute or two each (make study)."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from benchmarks.accuracy import ritter
from torch_mpm import Trajectory
from torch_mpm.scene import Scene

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("level", [0.02, 0.05, 0.1, 0.2, 0.4])
def test_the_fronts_of_a_dam_break_are_those_of_ritter(dam_break, level):
    """Within 3% of the distance of the dry front: fronts and times as defined in `benchmarks.accuracy.ritter`.

    A film of 1% of the depth, a sixth of a cell, is thinner than a particle here and has holes.
    """
    with Trajectory(dam_break) as read:
        frames = [read.frame(k) for k in range(len(read))]
    late = [f for f in frames if f["time"] / ritter.UNIT >= ritter.JUDGED]
    assert len(late) > 10
    for frame in late:
        place = ritter.foremost(*ritter.profile(frame["position"][:, 0] - 28.0, frame["volume"], frame["time"]), level)
        error = place / (2 * ritter.SPEED * frame["time"]) - (1 - 1.5 * np.sqrt(level))
        assert abs(error) < 0.03, f"{error:+.2%} at t* = {frame['time'] / ritter.UNIT:.1f}"


@pytest.fixture(scope="module")
def dam_break(tmp_path_factory):
    out = tmp_path_factory.mktemp("dam_break") / "out"
    Scene.load(EXAMPLES / "dam_break.toml", ["device=cpu"]).run(out)
    return out


def test_colliding_bodies_keep_momentum_and_lose_energy_by_dt(tmp_path):
    """Momentum to rounding; the energy that is gone at the end against the time step."""
    for cfl in (0.5, 0.25, 0.125):
        changes = ["device=cpu", "precision=float64", "grid.dx=0.04", f"cfl={cfl}"]
        out = tmp_path / str(cfl)
        summary = Scene.load(EXAMPLES / "collision.toml", changes).run(out)
        with Trajectory(out) as read:
            drift = np.abs(read["momentum"] - read["momentum"][0]).max() / np.abs(read["momentum"][0]).max()
            energy = read["kinetic_energy"] + read["elastic_energy"]
        print(f"dt = {summary['smallest_dt']:.2e} s: energy {energy[-1] / energy[0] - 1:+.3%}, momentum {drift:.1e}")
        assert drift < 1e-11
        assert energy.max() <= energy[0] * (1 + 1e-6)  # APIC loses, more so in more steps, and never gains
