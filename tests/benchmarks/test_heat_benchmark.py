"""The benchmark of heat runs in its quick mode, and its numbers are those of the methods."""

from pathlib import Path

import pytest
import torch
from helpers import random_particles, result, run_quick_here
from oracle.heat import HeatOperator

from benchmarks import report
from benchmarks.accuracy.heat_fronts import root
from benchmarks.heat_matrix import node_gradients


def test_gradients_of_the_heat_matrix(dim: int, kernel: str) -> None:
    p = random_particles(dim, kernel)
    rows, gradient = node_gradients(p.blocks(), p.x)
    expected = HeatOperator.at(p.blocks(), p.x, p.mass)
    assert torch.equal(rows, expected.support.rows)
    torch.testing.assert_close(gradient, expected.gradient, rtol=1e-12, atol=1e-13)


@pytest.mark.thorough
def test_heat_benchmark(tmp_path: Path) -> None:
    run_quick_here("benchmarks.accuracy.heat", tmp_path)
    found = result(tmp_path, "heat.json")
    errors = {(c["problem"], c["transfer"]): c["rows"][-1]["error"] for c in found["cases"]}
    assert len(errors) == 20 and (tmp_path / "heat.png").exists()
    assert errors["heated bar", "hybrid"] < 0.5 * errors["heated bar", "flip"]
    assert errors["cosine mode", "hybrid"] < 0.3 * errors["cosine mode", "pic"]
    assert errors["held walls", "hybrid"] < 0.5 * errors["held walls", "flip"]
    assert found["float32"]["relative to 300 K"] < 0.05 < found["float32"]["absolute"]
    assert "melting front, St = 1" in report.heat(found)


def test_fronts_and_held_surfaces(tmp_path: Path) -> None:
    assert abs(root(1.0, 0.0) - 0.6200626) < 1e-6 and abs(root(0.1, 0.0) - 0.2200163) < 1e-6
    assert abs(root(1.7, -0.4) - 0.5625) < 1e-4
    run_quick_here("benchmarks.accuracy.heat_fronts", tmp_path)
    found = result(tmp_path, "heat_fronts.json")
    assert all(0 < row["lengths"] < 0.5 for row in found["fronts"])
    assert all(row["most"] < 0.05 for row in found["surfaces"])
