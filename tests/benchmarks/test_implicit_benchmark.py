"""The benchmark of implicit steps runs, and what it finds is what the documentation says."""

import pytest
from helpers import result, run_quick


@pytest.mark.slow
def test_implicit_steps(tmp_path):
    run_quick("benchmarks.implicit", tmp_path)
    found = result(tmp_path, "implicit.json")
    assert all(row["10"] != "no" and row["100"] != "no" for row in found["stability"])
    assert all(row["unilateral"] > 0.99 for row in found["cohesion"])
    assert min(row["full"] for row in found["cohesion"]) < 0.5
    assert {row["integrator"] for row in found["work"]} == {"implicit"} and len(found["batches"]) == 1
