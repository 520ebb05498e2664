"""The benchmark of implicit steps runs, and its results are those of the documentation."""

import pytest
from helpers import result, run_quick


@pytest.mark.slow
def test_implicit_steps(tmp_path):
    run_quick("benchmarks.implicit", tmp_path)

    def rows(study, title):
        return result(tmp_path, f"implicit_{study}.json")[title]

    assert all(row["10"] != "no" and row["100"] != "no" for row in rows("stability", "Stability"))
    assert {row["integrator"] for row in rows("vibration", "Waves and rotation")} == {"implicit"}
    explicit, *implicit = rows("quasistatic", "Gripper")
    assert explicit["error in time"] < implicit[-1]["error in time"] < implicit[0]["error in time"] < 0.1
    times = {row["integrator"]: row["time [s]"] for row in rows("quasistatic", "Settling")}
    assert times["implicit"] < times["explicit"] / 10
    assert 0.8 < rows("order", "Order in dt")[-1]["order"] < 1.2
    assert all(row["order"] > 0.7 for row in rows("order", "Order in dx") if row["cells"] > 4)
    assert all(row["unilateral"] > 0.99 for row in rows("sand", "Cohesion"))
    spread = {(row["return map"], row["energy"]): row["spread"] for row in rows("sand", "Clump")}
    assert spread.pop(("after the solve", "full")) < 0.5 and all(share > 0.98 for share in spread.values())
    assert len(rows("sand", "Collapse")) == 6 and len(rows("crossover", "Costs")) == 2
    assert len(rows("cost", "Batches")) == 1 and len(rows("cost", "Beside a fluid")) == 3
    assert all(row["converged"] and row["difference"] < 1e-5 for row in rows("multigrid", "Steps"))
    assert {file.name for file in tmp_path.glob("*.png")} == {f"implicit_{n}.png" for n in ("work", "order", "sand")}
