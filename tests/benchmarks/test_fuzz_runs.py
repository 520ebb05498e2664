"""A short form of the fuzz program of runs: nothing crashes, lies or loses a frame."""

import json
import subprocess
import sys

import pytest

from benchmarks import common

pytest.importorskip("h5py")
pytest.importorskip("pydantic")


def test_nothing_crashes_lies_or_loses_a_frame(tmp_path):
    for package in ("matplotlib", "meshio", "trimesh"):
        pytest.importorskip(package)
    counts = {"mutations": 8, "kills": 1, "disks": 1, "corrupt": 3}
    options = [word for part, count in counts.items() for word in (f"--{part}", str(count))]
    command = [sys.executable, "-m", "benchmarks.fuzz.runs", "--seed", "1", "--out", str(tmp_path), *options]
    done = subprocess.run(command, cwd=common.ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "fuzz_runs.json").read_text())["rows"]
    assert {row["part"]: row["cases"] for row in rows} == counts
