"""Rows that became slower are found and marked, those of other devices are not compared."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import result, run_quick_here

from benchmarks import common, regressions
from benchmarks.speed import heat, laws, rollouts, step, svd


def _result(device: str = "abacus", **times: float) -> dict[str, Any]:
    return {"environment": {"device": device}, "rows": times}


def _times(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    yield from result["rows"].items()


def test_only_slower_rows_of_both_results_are_found() -> None:
    before = _result(same=1.0, faster=1.0, slower=1.0, gone=1.0)
    now = _result(same=1.09, faster=0.5, slower=1.2, new=9.0)
    assert regressions.slower(before, now, _times) == [("slower", 1.0, 1.2)]


def test_results_of_other_devices_are_not_compared() -> None:
    now = _result(row=2.0)
    assert regressions.slower(_result("slide rule", row=1.0), now, _times) == []
    now["environment"]["threads"] = 1
    assert regressions.slower(_result(row=1.0), now, _times) == []


def test_slower_row_is_printed_with_a_mark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    regressions.show("speed_abacus", _result(p2g=3.0), _times, tmp_path)
    assert capsys.readouterr().out == ""
    (tmp_path / "speed_abacus.json").write_text(json.dumps(_result(p2g=2.0, g2p=1.0)))
    regressions.show("speed_abacus", _result(p2g=3.0, g2p=1.0), _times, tmp_path)
    assert capsys.readouterr().out == "SLOWER: p2g: 3, was 2 (1.50 times)\n"


@pytest.mark.parametrize(
    ("pattern", "program"),
    [("speed_*", step), ("laws_*", laws), ("rollouts_*", rollouts), ("heat_[!fs]*", heat), ("svd_[!a]*", svd)],
)
def test_rows_of_the_committed_results_have_names_of_their_own(pattern: str, program: Any) -> None:
    for found in common.read(common.RESULTS, f"{pattern}.json"):
        rows = list(program.timed(found))
        assert rows and len(dict(rows)) == len(rows)
        assert all(time > 0 for _, time in rows)


@pytest.mark.parametrize(
    ("program", "module"), [("laws", laws), pytest.param("rollouts", rollouts, marks=pytest.mark.thorough)]
)
def test_program_writes_what_it_compares(program: str, module: Any, tmp_path: Path) -> None:
    run_quick_here(f"benchmarks.speed.{program}", tmp_path)
    assert dict(module.timed(result(tmp_path, f"{program}_*.json")))
