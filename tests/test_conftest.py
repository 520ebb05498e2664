"""The test session itself: a GPU is tested, or the session reports why not; threads, and which cases are quick."""

import itertools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from pairs import each_once, in_pairs

TESTS = Path(__file__).parent


def session(**environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", "test_build.py"]
    # Not in the root, whose package may be another build than the one under test.
    environment = {**os.environ, "TORCH_MPM_SANITIZE": "", "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    return subprocess.run(command, cwd=TESTS, env=environment, capture_output=True, text=True)


def session_with_a_hidden_gpu(directory: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A session on a machine that has a GPU which torch does not find."""
    lister = directory / "nvidia-smi"
    lister.write_text("#!/bin/sh\necho 'GPU 0: a GPU'\n")
    lister.chmod(0o755)
    path = os.pathsep.join([str(directory), os.environ["PATH"]])
    return session(**{"TORCH_MPM_CUDA": "", "CUDA_VISIBLE_DEVICES": "", "PATH": path, **environment})


@pytest.mark.thorough
def test_a_gpu_that_cannot_be_tested_is_an_error(tmp_path: Path) -> None:
    done = session_with_a_hidden_gpu(tmp_path)
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert "this machine has a GPU, but " in done.stderr


@pytest.mark.thorough
def test_a_gpu_may_be_left_out_by_name(tmp_path: Path) -> None:
    done = session_with_a_hidden_gpu(tmp_path, TORCH_MPM_CUDA="0")
    assert done.returncode == 0, done.stderr


@pytest.mark.thorough
def test_a_library_without_the_sanitizers_asked_for_is_an_error() -> None:
    done = session(TORCH_MPM_SANITIZE="thread", TORCH_MPM_CUDA="0")
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert "is not built with TORCH_MPM_SANITIZE=thread" in done.stderr


@pytest.mark.thorough
def test_the_package_that_the_environment_names_is_tested(tmp_path: Path) -> None:
    (tmp_path / "torch_mpm").mkdir()
    (tmp_path / "torch_mpm" / "__init__.py").write_text("raise ImportError('another build')")
    done = session(PYTHONPATH=str(tmp_path), TORCH_MPM_CUDA="0")
    assert done.returncode != 0 and "another build" in done.stdout + done.stderr


AXES = {"a": "uvwxyz", "b": range(5), "c": [True, False], "d": [None, 1.0, 2.0]}


@pytest.mark.parametrize(("product", "size", "most"), [(in_pairs, 2, 40), (each_once, 1, 6)])
def test_quick_cases_have_all_values_or_pairs(product: Callable[..., Any], size: int, most: int) -> None:
    names, cases = product(**AXES)
    assert names == tuple(AXES) and [case.values for case in cases] == list(itertools.product(*AXES.values()))
    quick = [dict(zip(names, case.values, strict=True)) for case in cases if not case.marks]
    assert len(quick) <= most
    for some in itertools.combinations(names, size):
        met = {tuple(case[name] for name in some) for case in quick}
        assert met == set(itertools.product(*[AXES[name] for name in some]))


@pytest.mark.parametrize("call", ["first", "second"])
def test_threads_that_a_test_has_set_do_not_stay(call: str) -> None:
    assert torch.get_num_threads() <= 2
    torch.set_num_threads(3)
