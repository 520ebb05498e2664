"""The figures of several devices are drawn from the results alone."""

import shutil
from pathlib import Path

import pytest

from benchmarks import common, report
from benchmarks.speed import roofline, scaling


@pytest.fixture(autouse=True)
def _matplotlib() -> None:
    pytest.importorskip("matplotlib")


def _shown(path: Path) -> bool:
    """Whether a picture is more than one colour."""
    from matplotlib import pyplot as plt

    return float(plt.imread(path).std()) > 0.01


def test_report_draws_the_figures_of_the_committed_results(tmp_path: Path) -> None:
    for pattern in ("speed_*.json", "rollouts_*.json"):
        for file in common.RESULTS.glob(pattern):
            shutil.copy(file, tmp_path)
    report.draw(tmp_path)
    assert _shown(tmp_path / "roofline.png") and _shown(tmp_path / "rollouts.png")
    measured = report.documents(tmp_path)[report.MEASURED]
    assert "results/roofline.png)" in measured and "results/rollouts.png)" in measured


def test_nothing_is_drawn_without_results(tmp_path: Path) -> None:
    report.draw(tmp_path)
    assert not list(tmp_path.iterdir())


def test_parts_have_the_mark_of_the_memory(tmp_path: Path) -> None:
    part = {"name": "p2g", "ms": 0.5, "bytes": 10**8, "memory_ms": 0.2}
    sizes = [{"particles": 10**6, "parts": [part]}, {"particles": 8, "parts": []}]
    place = {"environment": {"device": "abacus"}, "sizes": sizes}
    for name, found in (("with", place), ("without", {**place, "sizes": [{"particles": 8, "parts": []}]})):
        roofline.plot([found, {**found, "copy_GB_s": 300.0}], tmp_path / f"{name}.png")
    assert _shown(tmp_path / "with.png") and _shown(tmp_path / "without.png")


def test_threads_are_named_where_there_are_any(tmp_path: Path) -> None:
    rows = [{"name": "one scene", "particles": n, "us": n**0.5} for n in (64, 1000, 8 * 10**6)]
    places = ({"device": "abacus", "threads": 2}, {"device": "slide rule"})
    scaling.plot([{"environment": place, "rollouts": rows} for place in places], tmp_path / "rollouts.png")
    assert _shown(tmp_path / "rollouts.png")
