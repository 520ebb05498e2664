"""The program that times steps beside another version of the library."""

import json
from pathlib import Path

import pytest

from benchmarks import beside, beside_worker, common

NAME = "2-D, 9216 particles, 1 obstacles"


@pytest.mark.thorough
def test_both_versions_compute_the_scene(tmp_path: Path) -> None:
    """With its own sources as the other version, `before` and `now` are times of the same library."""
    beside.main([str(common.ROOT), "--only", NAME, "--steps", "2", "--rounds", "1", "--out", str(tmp_path)])
    (file,) = tmp_path.glob("beside_*.json")
    (row,) = json.loads(file.read_text())["rows"]
    assert row["scene"] == NAME and 0.1 < row["before"] / row["now"] < 10
    assert NAME in file.with_suffix(".md").read_text()


def test_the_other_version_is_the_one_that_runs(tmp_path: Path) -> None:
    (tmp_path / "torch_mpm").mkdir()
    (tmp_path / "torch_mpm" / "__init__.py").write_text("raise ImportError('the other version')")
    with pytest.raises(RuntimeError, match="the other version"):
        beside.least_time(tmp_path, NAME, "cpu", 2)


def test_wrong_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        ([str(tmp_path)], "sources must contain a folder torch_mpm"),
        ([str(common.ROOT), "--only", "no such scene"], "--only must be a part of a scene's name"),
    ):
        with pytest.raises(SystemExit):
            beside.main(arguments)
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", [n for n in beside_worker.CASES if "9216" in n or ("with heat" in n and "10648" in n)])
def test_obstacles_touch_the_particles(name: str) -> None:
    """A scene without contact would time nothing."""
    step, state = beside_worker.CASES[name]("cpu")
    state = step.with_impulses(state) if step.heat is None else state
    for _ in range(10):
        state = step(state, beside_worker.DT)
    step.check(state)
    if state.impulse is not None and len(step.boundaries.entries):
        touched = state.impulse[0, : len(step.boundaries.entries)].abs().amax(1)
        assert bool((touched > 0).all())
