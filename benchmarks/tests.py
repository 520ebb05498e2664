"""Run the tests on a GPU machine and keep their outcome as a result: `python -m benchmarks.tests [TESTS ...]`.

    python -m benchmarks.tests                                   # the quick suite
    python -m benchmarks.tests --tool memcheck -k cuda tests/test_transfer.py
    python -m benchmarks.tests --tool racecheck -k cuda --processes 12

With `--tool` the tests run under compute-sanitizer, and an error that it finds fails the run. `--processes` deals the
tests out to several processes side by side, each under a compute-sanitizer of its own.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import torch

from . import common

COUNTS = ("tests", "failures", "errors", "skipped")


def sanitized(tool: str) -> list[str]:
    """The command in front of Python; PyTorch's own kernels are not looked into."""
    options = ["--error-exitcode", "9", "--target-processes", "all", "--print-limit", "20"]
    return ["compute-sanitizer", "--tool", tool, *options, "--kernel-regex", "kns=mpm"]


def deal(command: list[str], processes: int) -> list[list[str]]:
    """The tests that `command` selects, dealt out in turn."""
    listed = subprocess.run([*command, "--collect-only"], cwd=common.ROOT, capture_output=True, text=True)
    names = [line for line in listed.stdout.splitlines() if "::" in line]
    return [names[first::processes] for first in range(min(processes, len(names)))]


def run_side_by_side(
    tool: list[str], command: list[str], hands: list[list[str]], folder: Path
) -> tuple[int, dict[str, str]]:
    """The worst exit status of all hands, and their counts together."""
    running = []
    for number, names in enumerate(hands):
        arguments, report = folder / f"{number}.txt", folder / f"{number}.xml"
        arguments.write_text("\n".join(names))
        with open(folder / f"{number}.log", "w") as log:
            started = subprocess.Popen(
                [*tool, *command, f"--junitxml={report}", f"@{arguments}"], cwd=common.ROOT, stdout=log, stderr=log
            )
        running.append(started)
    statuses, total = [], dict.fromkeys((*COUNTS, "time"), 0.0)
    for number, started in enumerate(running):
        statuses.append(started.wait())
        log, report = folder / f"{number}.log", folder / f"{number}.xml"
        print(f"process {number}: exit status {statuses[-1]}\n{log.read_text()[-2000:]}", flush=True)
        if not report.exists():  # it crashed
            total["errors"] += 1
            continue
        suite = counts_of(report)
        for name in COUNTS:
            total[name] += int(suite[name])
        total["time"] = max(total["time"], float(suite["time"]))
    return max(statuses, key=abs), {name: str(value) for name, value in total.items()}


def counts_of(report: Path) -> dict[str, str]:
    return next(ElementTree.parse(report).getroot().iter("testsuite")).attrib


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tool", choices=["memcheck", "racecheck", "initcheck", "synccheck"])
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("-k", dest="expression", help="pytest's -k")
    parser.add_argument("--processes", type=int, default=1, help="that share the tests")
    parser.add_argument("tests", nargs="*", default=["tests"])
    arguments = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    tool = sanitized(arguments.tool) if arguments.tool else []
    selection = [*arguments.tests, *(["-k", arguments.expression] if arguments.expression else [])]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow"]
    with tempfile.TemporaryDirectory() as name:
        folder, report = Path(name), Path(name) / "report.xml"
        if arguments.processes > 1:
            hands = deal([*command, *selection], arguments.processes)
            status, suite = run_side_by_side(tool, command, hands, folder)
        else:
            status = subprocess.run([*tool, *command, f"--junitxml={report}", *selection], cwd=common.ROOT).returncode
            suite = counts_of(report)
    result: dict[str, Any] = {
        "environment": common.environment(device),
        "tool": arguments.tool,
        "selection": selection,
        "exit_status": status,
        "seconds": float(suite["time"]),
        **{name: int(float(suite[name])) for name in COUNTS},
    }
    lines = [
        f"# Tests{f' under compute-sanitizer {arguments.tool}' if arguments.tool else ''}",
        common.describe(result["environment"]),
        f"`pytest {' '.join(result['selection'])}`: exit status {status}",
        common.table((*COUNTS, "seconds"), [[result[name] for name in (*COUNTS, "seconds")]]),
    ]
    name = "_".join(filter(None, ("tests", arguments.tool, common.slug(common.device_name(device)))))
    common.write(arguments.out, name, result, "\n\n".join(lines))
    sys.exit(status)


if __name__ == "__main__":
    main()
