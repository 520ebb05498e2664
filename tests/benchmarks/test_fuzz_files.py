"""The fuzz program of command lines, foreign files, damaged data sets and limits of memory: a few cases to many."""

import json
import os
import subprocess
import sys

import pytest

from benchmarks import common

for package in ("h5py", "isal", "matplotlib", "meshio", "pydantic", "trimesh"):
    pytest.importorskip(package)

FEW = {"lines": 2, "inputs": 1, "configurations": 1, "shards": 1, "records": 1, "memory": 1}
SHORT = {"lines": 6, "inputs": 5, "configurations": 4, "shards": 4, "records": 5, "memory": 2}
LONG = {"lines": 600, "inputs": 200, "configurations": 400, "shards": 100, "records": 1000, "memory": 500}


@pytest.mark.parametrize(
    "counts",
    [
        pytest.param(FEW, id="few"),
        pytest.param(SHORT, id="short", marks=pytest.mark.thorough),
        pytest.param(LONG, id="long", marks=pytest.mark.slow),
    ],
)
def test_no_command_trusts_what_it_is_given(tmp_path, counts):
    options = [word for part, count in counts.items() for word in (f"--{part}", str(count))]
    command = [sys.executable, "-m", "benchmarks.fuzz.files", "--seed", "1", "--out", str(tmp_path), *options]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # a process with more threads cannot fork
    done = subprocess.run(command, cwd=common.ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "fuzz_files.json").read_text())["rows"]
    assert {row["part"]: row["cases"] for row in rows} == counts
