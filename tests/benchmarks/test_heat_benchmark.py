"""The benchmark of heat runs in its quick mode, and its numbers are those of the methods."""

from pathlib import Path

from helpers import result, run_quick

from benchmarks import report


def test_heat_benchmark(tmp_path: Path) -> None:
    run_quick("benchmarks.accuracy.heat", tmp_path)
    found = result(tmp_path, "heat.json")
    errors = {(c["problem"], c["transfer"]): c["rows"][-1]["error"] for c in found["cases"]}
    assert len(errors) == 20 and (tmp_path / "heat.png").exists()
    assert errors["heated bar", "hybrid"] < 0.5 * errors["heated bar", "flip"]
    assert errors["cosine mode", "hybrid"] < 0.3 * errors["cosine mode", "pic"]
    assert errors["held walls", "hybrid"] < 0.5 * errors["held walls", "flip"]
    assert found["float32"]["relative to 300 K"] < 0.05 < found["float32"]["absolute"]
    assert "melting front, St = 1" in report.heat(found)
