"""A case of a fuzz program as a child process of a warm one, and what its end means.

Import what the cases need first, then fork: a case then costs milliseconds. The parent must have one thread
(OMP_NUM_THREADS=1, set before torch is imported), because a fork copies the thread that calls it alone.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from .. import common as benchmark

FAULTS = ("crash", "traceback", "wrong exit status 0", "time limit")
TRACEBACK = "Traceback (most recent call last)"


@dataclass(frozen=True)
class Outcome:
    """How a case ended: "ok" or one of FAULTS, its exit status (negative: a signal), and all that it printed."""

    kind: str
    status: int
    text: str


def run(work: Callable[[], int], *, must_fail: bool = False, seconds: float = 60.0, memory: int = 4 << 30) -> Outcome:
    """Call ``work`` in a child process, which ends with the exit status that it returns.

    With ``must_fail``, exit status 0 is a fault. After ``seconds`` the child is killed. It may allocate ``memory``
    bytes beyond what it starts with.
    """
    with tempfile.TemporaryFile() as output:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # or the child prints it again
        pid = os.fork()
        if pid == 0:
            _child(work, output.fileno(), memory)
        descriptor = os.pidfd_open(pid)
        ended = bool(select.select([descriptor], [], [], seconds)[0])
        os.close(descriptor)
        if not ended:
            os.kill(pid, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        output.seek(0)
        text = output.read().decode(errors="replace")
    return Outcome(_kind(ended, status, text, must_fail), status, text)


def _kind(ended: bool, status: int, text: str, must_fail: bool) -> str:
    if not ended:
        return "time limit"
    if status < 0:
        return "crash"
    if TRACEBACK in text:
        return "traceback"
    return "wrong exit status 0" if must_fail and status == 0 else "ok"


def _child(work: Callable[[], int], output: int, memory: int) -> None:
    """Does not return. It ends as any process does: what libraries do at exit belongs to the case."""
    status = 1
    try:
        os.dup2(output, 1)
        os.dup2(output, 2)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + memory, size + memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        status = work()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    ctypes.CDLL(None).exit(status)


# ---- programs

Row = dict[str, Any]
"""A part of a program: its name, cases and seconds, and the number of its faults by kind."""


def report(
    fuzz: Callable[[Path, dict[str, int], int], list[Row]],
    counts: dict[str, int],
    seed: int,
    columns: Sequence[str],
    title: str,
    name: str,
    out: Path,
) -> bool:
    """Run the parts of a program in a temporary folder, print their table and write it as a result.

    Args:
        fuzz: function of the folder, the counts and the seed that returns a row of each part.
        counts: number of cases by part.
        seed: of the cases.
        columns: kinds of faults.
        title, name: of the result, and of its file in the folder `out`.

    Returns:
        Whether there is a fault.
    """
    torch.set_num_threads(1)  # before the first fork
    folder = Path(tempfile.mkdtemp())  # a TemporaryDirectory would be removed by the first child that ends
    try:
        rows = fuzz(folder, counts, seed)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    names = ("part", "cases", *columns, "seconds")
    table = benchmark.table(names, [[row[name] for name in names] for row in rows])
    print(table)
    result = {"environment": benchmark.environment(), "seed": seed, "rows": rows}
    text = f"# {title}\n\n{benchmark.describe(result['environment'])}\n\nseed {seed}\n\n{table}"
    benchmark.write(out, name, result, text)
    return any(row[column] for row in rows for column in columns)
