"""The test session itself: a GPU is tested, or the session says why not."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def session_with_a_hidden_gpu(directory: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A session on a machine that has a GPU which torch does not find."""
    lister = directory / "nvidia-smi"
    lister.write_text("#!/bin/sh\necho 'GPU 0: a GPU'\n")
    lister.chmod(0o755)
    path = os.pathsep.join([str(directory), os.environ["PATH"]])
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", "tests/test_build.py"]
    environment = {**os.environ, "TORCH_MPM_CUDA": "", "CUDA_VISIBLE_DEVICES": "", "PATH": path, **environment}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)


def test_a_gpu_that_cannot_be_tested_is_an_error(tmp_path: Path) -> None:
    done = session_with_a_hidden_gpu(tmp_path)
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert "this machine has a GPU, but " in done.stderr


def test_a_gpu_may_be_left_out_by_name(tmp_path: Path) -> None:
    done = session_with_a_hidden_gpu(tmp_path, TORCH_MPM_CUDA="0")
    assert done.returncode == 0, done.stderr
