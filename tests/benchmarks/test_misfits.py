"""The program of arguments that do not fit: a short run of it, a long one, and that it sees what it looks for."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import torch_mpm as mpm
from benchmarks.fuzz import calls, misfits, public

RESULTS = (
    "Blocks", "DamagedFileError", "Failures", "Frames", "GridOverflowError", "HeatSolve", "Material",
    "FrontWarning", "LockingWarning", "Obstacle", "PrecisionWarning", "RolloutEstimate", "RolloutPlan",
    "RolloutToResult", "SimulationError", "ThinWallWarning", "Trajectory",
)  # fmt: skip
"""Classes that functions return or raise, and base classes."""
CUDA_ALONE = ("captured", "make_graphed_step")
OF_OTHERS = ("couple", "isotropic")
"""Functions whose arguments are made by other packages (tests/bodies/test_mujoco.py), or by a law."""

PROGRAM = """
import json, sys
from benchmarks.fuzz import misfits
print(json.dumps(misfits.fuzz(int(sys.argv[1]), int(sys.argv[2]))))
"""


def found(count: int, seed: int, place: Path) -> list[list[Any]]:
    """In a process of its own, that sees no GPU: one that has used CUDA must not fork."""
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", PROGRAM, str(count), str(seed)]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    results: list[list[Any]] = json.loads(done.stdout.splitlines()[-1])
    return results


@pytest.mark.parametrize("count", [150, pytest.param(600, marks=pytest.mark.thorough)])
def test_what_does_not_fit_is_refused_by_name(count: int, tmp_path: Path) -> None:
    results = found(count, 0, tmp_path)
    assert len(results) == count
    assert [result for result in results if result[4] in misfits.FAULTS] == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
def test_what_does_not_fit_is_refused_by_name_many_times(seed: int, tmp_path: Path) -> None:
    results = found(10_000, seed, tmp_path)
    assert [result for result in results if result[4] in misfits.FAULTS] == []


def test_every_public_function_has_a_call() -> None:
    covered = {name.split(" ")[0].split(".")[0] for name in public.calls()}
    functions = {name for name in mpm.__all__ if callable(getattr(mpm, name))}
    assert functions - covered <= {*RESULTS, *CUDA_ALONE, *OF_OTHERS}


def test_faults_are_found_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def function(kind: Any) -> None:
        if kind == "unclear":
            raise AttributeError("'int' object has no attribute 'kind'")
        if kind == "unnamed":
            raise ValueError("it must be a word")
        if kind == "refused":
            raise ValueError("kind must be a word, got refused")

    monkeypatch.setattr(calls, "raw_calls", dict)
    monkeypatch.setattr(calls, "public_calls", lambda: {"function": lambda: (function, {"kind": 1})})
    for kind, end in (("ok", "accepted"), ("unclear", "another error"), ("unnamed", "unnamed"), ("refused", "refused")):
        monkeypatch.setattr(misfits, "misfits", lambda value, kind=kind: [("another kind", kind)])
        judged = [misfits.judged(0, number, "function") for number in range(8)]
        assert {found_end for _, argument, _, found_end, _ in judged if argument == "kind"} == {end}


def test_a_call_is_the_same_for_the_same_seed_and_number() -> None:
    def texts(seed: int) -> list[tuple[str, str, str]]:
        made = [misfits.changed(seed, number) for number in range(40)]
        return [(name, argument, done) for name, _, argument, _, done in made]

    assert texts(5) == texts(5) != texts(6)
