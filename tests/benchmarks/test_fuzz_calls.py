"""The fuzz program of calls: a short run of it, and that it sees what it looks for."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from benchmarks.fuzz import calls, operators, public


def test_every_op_is_called_and_every_valid_call_works() -> None:
    assert {op for op, _ in operators.calls(2)} == set(operators.operators())
    for make in public.calls().values():
        function, arguments = make()
        function(**arguments)


PROGRAM = """
import json
from benchmarks.fuzz import calls
calls.PUBLIC = 0.4
print(json.dumps([[r.name, r.end, r.error] for r in calls.fuzz(1500, seed=0)]))
"""


@pytest.mark.thorough
def test_no_call_crashes_or_ends_in_an_unclear_error(tmp_path: Path) -> None:
    """In a process of its own, that sees no GPU: one that has used CUDA must not fork."""
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert [call for call in found if call[1] in calls.FAULTS] == []
    assert {end for _, end, _ in found} == {"ok", "clear error"}
    assert {name for name, _, _ in found} >= set(calls.raw_calls())


def test_faults_are_found_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(kind: str, other: object = None) -> None:
        if kind == "unclear":
            raise AttributeError("'int' object has no attribute 'shape'")
        if kind == "clear":
            raise ValueError("kind must be a word")
        if kind == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)

    def changed(name: str, value: object, others: object, choose: object) -> tuple[str, object]:
        return ("made wrong", value) if name == "kind" else ("left", value)

    monkeypatch.setattr(calls, "raw_calls", dict)
    monkeypatch.setattr(calls, "mutate", changed)
    for kind, end in (("ok", "ok"), ("clear", "clear error"), ("unclear", "unclear"), ("crash", "crash")):
        faces = {"wrong": lambda kind=kind: (wrong, {"kind": kind})}
        monkeypatch.setattr(calls, "public_calls", lambda faces=faces: faces)
        found = calls.results(0, range(3), "wrong")
        assert [(r.number, r.name, r.end) for r in found] == [(k, "wrong", end) for k in range(3)]
        assert all(r.changes == (("kind", "made wrong"),) for r in found)


@pytest.mark.parametrize(
    "error, clear",
    [
        (ValueError("x must have shape [P, 2], got [3]"), True),
        (TypeError("dt must be a number, got str"), True),
        (RuntimeError("torch_mpm::p2g() is missing value for argument 'x'"), True),
        (TypeError("'<' not supported between instances of 'int' and 'str'"), False),
        (ValueError("not enough values to unpack (expected 2, got 1)"), False),
        (RuntimeError("aoti_torch_empty_strided(...) API call failed at csrc/common/allocate.op.cpp"), False),
        (KeyError("neo"), False),
        (IndexError("tuple index out of range"), False),
        (ValueError(), False),
    ],
)
def test_what_a_clear_error_is(error: Exception, clear: bool) -> None:
    assert calls.is_clear(error) == clear


def test_a_call_is_the_same_for_the_same_seed_and_number() -> None:
    def text(seed: int, number: int) -> str:
        name, _, _, changes = calls.malformed(seed, number)
        return f"{name} {[(argument, done) for argument, (done, _) in changes.items()]}"

    first = [text(5, number) for number in range(40)]
    torch.manual_seed(1)
    assert [text(5, number) for number in range(40)] == first != [text(6, number) for number in range(40)]
