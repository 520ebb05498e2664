"""A short form of the fuzz program of runs: nothing crashes, lies or loses a frame."""

import json
import subprocess
import sys

import pytest

from benchmarks import common

pytest.importorskip("h5py")
pytest.importorskip("pydantic")


FEW = {"mutations": 3, "kills": 1, "disks": 1, "corrupt": 1}
SHORT = {"mutations": 8, "kills": 1, "disks": 1, "corrupt": 3}


@pytest.mark.parametrize(
    "counts", [pytest.param(FEW, id="few"), pytest.param(SHORT, id="short", marks=pytest.mark.thorough)]
)
def test_nothing_crashes_lies_or_loses_a_frame(tmp_path, counts):
    for package in ("matplotlib", "meshio", "trimesh"):
        pytest.importorskip(package)
    options = [word for part, count in counts.items() for word in (f"--{part}", str(count))]
    command = [sys.executable, "-m", "benchmarks.fuzz.runs", "--seed", "1", "--out", str(tmp_path), *options]
    done = subprocess.run(command, cwd=common.ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "fuzz_runs.json").read_text())["rows"]
    assert {row["part"]: row["cases"] for row in rows} == counts
