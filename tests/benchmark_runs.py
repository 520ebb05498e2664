"""Benchmark programs in their quick mode."""

import json
import os
import subprocess
import sys
from pathlib import Path

from benchmarks import common

# Threads that wait without spinning: tests share their machine.
PASSIVE = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}


def run_quick(program: str, out: Path, *options: str) -> str:
    command = [sys.executable, "-m", program, "--quick", "--out", str(out), *options]
    done = subprocess.run(command, cwd=common.ROOT, env=PASSIVE, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def result(out: Path, pattern: str) -> dict:
    (file,) = out.glob(pattern)
    assert file.with_suffix(".md").read_text().startswith("# ")
    found = json.loads(file.read_text())
    assert {"device", "torch_mpm", "torch", "commit", "date"} <= found["environment"].keys()
    return found
