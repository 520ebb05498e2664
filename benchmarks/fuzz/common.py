"""Cases of fuzz programs as child processes of a warm process, and their outcomes.

Import what the cases need first, then fork: a case then costs milliseconds. The parent must have one thread
(OMP_NUM_THREADS=1, set before torch is imported), because a fork copies the thread that calls it alone.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import io
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torch_mpm import cli

from .. import common as benchmark

FAULTS = ("crash", "traceback", "wrong exit status 0", "time limit")
TRACEBACK = "Traceback (most recent call last)"


@dataclass(frozen=True)
class Outcome:
    """Outcome of a case: "ok" or one of FAULTS, exit status (negative: a signal), and printed text."""

    kind: str
    status: int
    text: str


def run(work: Callable[[], int], *, must_fail: bool = False, seconds: float = 60.0, memory: int = 4 << 30) -> Outcome:
    """Call ``work`` in a child process whose exit status is its result.

    With ``must_fail``, exit status 0 is a fault. After ``seconds`` the child is killed. It may allocate ``memory``
    bytes beyond what it starts with.
    """
    with _Child(work, memory) as child:
        ended = child.wait(seconds)
        return child.outcome(ended, must_fail)


def succeed(*arguments: object) -> None:
    """Call `torch-mpm` in this process, whose children find imported what it needs.

    Raises:
        RuntimeError: for another exit status than 0.
    """
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = cli.main([str(a) for a in arguments])
    if status:
        raise RuntimeError(f"{arguments} ended with exit status {status}: {printed.getvalue()}")


def run_and_signal(
    work: Callable[[], int], number: signal.Signals, delay: float, seconds: float
) -> tuple[Outcome, float]:
    """As `run`, with a signal ``delay`` seconds after ``work`` has begun.

    Returns:
        The outcome, which is "ok" if the signal itself has ended the child, and the CPU time that the child has used
        from the signal to its end [s], which does not depend on what else the machine does; 0 for a child that has
        ended before.
    """
    with _Child(work, 4 << 30) as child:
        child.wait_for_begin()
        if child.wait(delay):
            return child.outcome(True), 0.0
        before = child.cpu_seconds()
        os.kill(child.pid, number)
        ended = child.wait(seconds)
        outcome = child.outcome(ended)
    late = max(child.used - before, 1e-3)
    return replace(outcome, kind="ok") if ended and outcome.status == -number else outcome, late


class _Child:
    """A child process that calls ``work`` and ends; a context manager."""

    def __init__(self, work: Callable[[], int], memory: int) -> None:
        self.used = 0.0  # CPU time [s], once it has ended
        self._output = tempfile.TemporaryFile()
        self._begun, begins = os.pipe()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # or the child prints it again
        self.pid = os.fork()
        if self.pid == 0:
            _child(work, self._output.fileno(), memory, begins)
        os.close(begins)
        self._descriptor = os.pidfd_open(self.pid)

    def __enter__(self) -> _Child:
        return self

    def __exit__(self, *error: Any) -> None:
        os.close(self._descriptor)
        os.close(self._begun)
        self._output.close()

    def wait_for_begin(self) -> None:
        os.read(self._begun, 1)

    def wait(self, seconds: float) -> bool:
        """Whether the child ends within some seconds."""
        return bool(select.select([self._descriptor], [], [], seconds)[0])

    def cpu_seconds(self) -> float:
        """CPU time of all threads of the child [s]."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def outcome(self, ended: bool, must_fail: bool = False) -> Outcome:
        """Outcome of the child, which is killed if it is still running."""
        if not ended:
            os.kill(self.pid, signal.SIGKILL)
        _, status, usage = os.wait4(self.pid, 0)
        status, self.used = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
        self._output.seek(0)
        text = self._output.read().decode(errors="replace")
        return Outcome(_kind(ended, status, text, must_fail), status, text)


def _kind(ended: bool, status: int, text: str, must_fail: bool) -> str:
    if not ended:
        return "time limit"
    if status < 0:
        return "crash"
    if TRACEBACK in text:
        return "traceback"
    return "wrong exit status 0" if must_fail and status == 0 else "ok"


def _child(work: Callable[[], int], output: int, memory: int, begins: int) -> None:
    """Does not return. The process exits normally: exit handlers of libraries are part of the case.

    Args:
        output: file for all that it prints.
        begins: pipe that it writes to when the work begins.
    """
    status = 1
    try:
        os.dup2(output, 1)
        os.dup2(output, 2)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + memory, size + memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGINT, signal.default_int_handler)  # Shells start background processes that ignore it.
        os.write(begins, b"1")
        status = work()
        signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))  # the case is over
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
    figures: Sequence[str] = (),
) -> bool:
    """Run the parts of a program in a temporary folder, print their table and write it as a result.

    Args:
        fuzz: function of the folder, the counts and the seed that returns a row of each part.
        counts: number of cases by part.
        seed: of the cases.
        columns: kinds of faults.
        title, name: of the result, and of its file in the folder `out`.
        figures: further columns, which are no faults.

    Returns:
        Whether there is a fault.
    """
    torch.set_num_threads(1)  # before the first fork
    folder = Path(tempfile.mkdtemp())  # a TemporaryDirectory would be removed by the first child that ends
    try:
        rows = fuzz(folder, counts, seed)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    names = ("part", "cases", *columns, *figures, "seconds")
    table = benchmark.table(names, [[row[name] for name in names] for row in rows])
    print(table)
    result = {"environment": benchmark.environment(), "seed": seed, "rows": rows}
    text = f"# {title}\n\n{benchmark.describe(result['environment'])}\n\nseed {seed}\n\n{table}"
    benchmark.write(out, name, result, text)
    return any(row[column] for row in rows for column in columns)
