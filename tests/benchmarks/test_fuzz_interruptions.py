"""The fuzz program of interrupted commands, in short and long."""

import json
import os
import subprocess
import sys

import pytest

from benchmarks import common

for package in ("h5py", "imageio_ffmpeg", "isal", "matplotlib", "meshio", "pydantic"):
    pytest.importorskip(package)


ALL = ("run", "generate", "export", "render")


@pytest.mark.parametrize(
    ("commands", "count"),
    [
        (("run",), 1),
        pytest.param(("generate",), 1, marks=pytest.mark.thorough),
        pytest.param(ALL, 100, marks=pytest.mark.slow),
    ],
)
def test_nothing_is_lost_and_nothing_is_left(tmp_path, commands, count):
    counts = ["--kills", str(count), "--signals", str(count), "--commands", *commands]
    command = [sys.executable, "-m", "benchmarks.fuzz.interruptions", *counts, "--out", str(tmp_path), "--seed", "1"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # a process with more threads cannot fork
    done = subprocess.run(command, cwd=common.ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "fuzz_interruptions.json").read_text())["rows"]
    assert len(rows) == 2 * len(commands) and all(row["cases"] == count for row in rows)
