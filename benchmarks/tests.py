"""Run the tests on a GPU machine and store their outcome as a result: `python -m benchmarks.tests [TESTS ...]`.

    python -m benchmarks.tests                                   # the quick suite
    python -m benchmarks.tests --tool memcheck -k cuda tests/ops/test_transfer.py
    python -m benchmarks.tests --tool racecheck -k cuda --processes 12

With `--tool` the tests run under compute-sanitizer, and an error that it finds fails the run. With `--processes`, n
processes run concurrently and share the cores and the GPUs, each under a separate compute-sanitizer; each runs only a
few tests then, because racecheck retains host memory until its process ends. The result is written after each.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import torch

from . import common

COUNTS = ("tests", "failures", "errors", "skipped")
SANITIZED_TESTS = {"memcheck": 16, "racecheck": 4, "initcheck": 16, "synccheck": 16}
"""Maximum number of tests of one process; racecheck takes some .1 GB per second."""
Counts = dict[str, Any]
Outcome = tuple[int, Counts | None]
"""The exit status of pytest, and the counts of its tests, None if it crashed."""


def sanitized(tool: str) -> list[str]:
    """Command in front of Python; PyTorch's own kernels are excluded."""
    options = ["--error-exitcode", "9", "--target-processes", "all", "--print-limit", "20"]
    return ["compute-sanitizer", "--tool", tool, *options, "--kernel-regex", "kns=mpm"]


def deal(command: list[str], processes: int, most: int | None) -> list[list[str]]:
    """Tests selected by `command`, distributed in turn over groups of at most `most` tests."""
    listed = subprocess.run([*command, "--collect-only"], cwd=common.ROOT, capture_output=True, text=True)
    names = [line for line in listed.stdout.splitlines() if "::" in line]
    hands = min(len(names), max(processes, math.ceil(len(names) / most) if most else 0))
    return [names[first::hands] for first in range(hands)]


def visible_gpus() -> list[str]:
    """The values of CUDA_VISIBLE_DEVICES that name one GPU each; a single empty one where there is none."""
    numbered = ",".join(map(str, range(torch.cuda.device_count())))
    return os.environ.get("CUDA_VISIBLE_DEVICES", numbered).split(",")


def run_hand(command: list[str], environment: dict[str, str], folder: Path, number: int, names: list[str]) -> Outcome:
    """The exit status of pytest on these tests, and their counts, None if it crashed."""
    arguments, report = folder / f"{number}.txt", folder / f"{number}.xml"
    arguments.write_text("\n".join(names))
    started = subprocess.run(
        [*command, f"--junitxml={report}", f"@{arguments}"],
        cwd=common.ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    print(f"hand {number}: exit status {started.returncode}\n{started.stdout}", flush=True)
    return started.returncode, counts_of(report) if report.exists() else None


def run_side_by_side(
    tool: list[str], command: list[str], hands: list[list[str]], processes: int, folder: Path
) -> Iterator[dict[int, Outcome]]:
    """Outcomes of all groups that have run so far, after each."""
    command = [*tool, *command]
    environment = {**os.environ, "OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // processes))}
    if tool:  # memcheck loses a kernel that is loaded late and first launched by a graph: "misaligned address"
        environment["CUDA_MODULE_LOADING"] = "EAGER"
        environment["TORCH_MPM_HOST_LOOPS"] = "1"  # Loops of graphs are not supported (NVIDIA/warp issue 1406).
    gpus = visible_gpus()

    def run(number: int) -> Outcome:
        on_one_gpu = {**environment, "CUDA_VISIBLE_DEVICES": gpus[number % len(gpus)]}
        return run_hand(command, on_one_gpu, folder, number, hands[number])

    outcomes: dict[int, Outcome] = {}
    unfinished = list(range(len(hands)))
    # Groups killed for lack of memory of a sanitizer run again with more of it; without one a crash is a crash.
    for side_by_side in (processes, max(1, processes // 4)) if tool else (processes,):
        with ThreadPoolExecutor(side_by_side) as pool:
            started = {pool.submit(run, number): number for number in unfinished}
            for finished in as_completed(started):
                outcomes[started[finished]] = finished.result()
                yield outcomes
        unfinished = [number for number, (_, counts) in outcomes.items() if counts is None]


def counts_of(report: Path) -> Counts:
    """The counts of a report, and the names of its tests that did not pass."""
    suite = next(ElementTree.parse(report).getroot().iter("testsuite"))
    cases = [case for case in suite.iter("testcase") if {"failure", "error"} & {part.tag for part in case}]
    return {
        **{name: int(suite.attrib[name]) for name in COUNTS},
        "failed": [f"{case.get('classname')}.{case.get('name')}" for case in cases],
    }


def summary(outcomes: dict[int, Outcome]) -> dict[str, Any]:
    """Worst exit status of the groups, their total counts, and the tests that did not pass."""
    total: Counts = {**dict.fromkeys(COUNTS, 0), "failed": []}
    for number, (_, counts) in outcomes.items():
        for name, value in (counts or {"errors": 1, "failed": [f"hand {number}"]}).items():
            total[name] += value
    return {"exit_status": max((status for status, _ in outcomes.values()), key=abs), **total}


def write(out: Path, result: dict[str, Any]) -> None:
    tool, columns = result["tool"], ("selected", *COUNTS, "seconds")
    lines = [
        f"# Tests{f' under compute-sanitizer {tool}' if tool else ''}",
        common.describe(result["environment"]),
        f"`pytest {' '.join(result['selection'])}`: exit status {result['exit_status']}",
        common.table(columns, [[result[name] for name in columns]]),
        *(f"Did not pass: {name}" for name in result["failed"]),
    ]
    device = common.slug(result["environment"]["device"])
    common.write(out, "_".join(filter(None, ("tests", tool, device))), result, "\n\n".join(lines))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tool", choices=sorted(SANITIZED_TESTS))
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("-k", dest="expression", help="pytest's -k")
    parser.add_argument("--processes", type=int, default=1, help="that share the tests")
    parser.add_argument("tests", nargs="*", default=["tests"])
    arguments = parser.parse_args()
    tool = sanitized(arguments.tool) if arguments.tool else []
    selection = [*arguments.tests, *(["-k", arguments.expression] if arguments.expression else [])]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow"]
    start = time.monotonic()
    hands = deal([*command, *selection], arguments.processes, SANITIZED_TESTS.get(arguments.tool))
    result: dict[str, Any] = {
        "environment": common.environment("cuda" if torch.cuda.is_available() else "cpu"),
        "tool": arguments.tool,
        "selection": selection,
        "selected": sum(map(len, hands)),
        "exit_status": 5,  # pytest: no test was selected
    }
    with tempfile.TemporaryDirectory() as name:
        for outcomes in run_side_by_side(tool, command, hands, arguments.processes, Path(name)):
            result |= summary(outcomes) | {"seconds": time.monotonic() - start}
            write(arguments.out, result)  # After each group: results survive an interruption.
    print("\n".join(f"Did not pass: {name}" for name in result.get("failed", [])))
    sys.exit(result["exit_status"])


if __name__ == "__main__":
    main()
