"""Run the tests on a GPU machine and keep their outcome as a result: `python -m benchmarks.tests [TESTS ...]`.

    python -m benchmarks.tests                                   # the quick suite
    python -m benchmarks.tests --tool memcheck -k cuda tests/test_transfer.py
    python -m benchmarks.tests --tool racecheck -k cuda tests/test_transfer_cuda.py

With `--tool` the tests run under compute-sanitizer, and an error that it finds fails the run.
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tool", choices=["memcheck", "racecheck", "initcheck", "synccheck"])
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("-k", dest="expression", help="pytest's -k")
    parser.add_argument("tests", nargs="*", default=["tests"])
    arguments = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", f"--junitxml={report}", *arguments.tests]
        command += ["-k", arguments.expression] if arguments.expression else []
        done = subprocess.run((sanitized(arguments.tool) if arguments.tool else []) + command, cwd=common.ROOT)
        suite = next(ElementTree.parse(report).getroot().iter("testsuite")).attrib
    result: dict[str, Any] = {
        "environment": common.environment(device),
        "tool": arguments.tool,
        "selection": [*arguments.tests, *(["-k", arguments.expression] if arguments.expression else [])],
        "exit_status": done.returncode,
        "seconds": float(suite["time"]),
        **{name: int(suite[name]) for name in COUNTS},
    }
    lines = [
        f"# Tests{f' under compute-sanitizer {arguments.tool}' if arguments.tool else ''}",
        common.describe(result["environment"]),
        f"`pytest {' '.join(result['selection'])}`: exit status {done.returncode}",
        common.table((*COUNTS, "seconds"), [[result[name] for name in (*COUNTS, "seconds")]]),
    ]
    name = "_".join(filter(None, ("tests", arguments.tool, common.slug(common.device_name(device)))))
    common.write(arguments.out, name, result, "\n\n".join(lines))
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
