"""Commands under memory limits below their need, from failing imports to failing work.

    python -m benchmarks.fuzz.memory_limits FOLDER COUNT SEED

is a process of its own, which has imported torch_mpm and nothing else, so that its children import under the limit.
FOLDER is that of the inputs of `benchmarks.fuzz.files`; what is found is printed, one line of JSON for each case.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import sys
from pathlib import Path

from torch_mpm import cli

from . import common

BLAME = re.compile(r"not installed|remove it|generate again|is damaged|is no |DamagedFile|unreadable")
"""Words of messages that wrongly blame a file or an installation."""
LEAST, MOST = 2**19, 2**31
"""Limits above the memory of the process at its start [bytes]."""


def commands(inputs: Path, out: Path) -> list[list[str]]:
    folder, made = str(inputs / "set"), str(out)
    return [
        ["run", str(inputs / "scene.toml"), "-o", made, "--quiet"],
        ["run", str(inputs / "solid.toml"), "-o", made, "--quiet"],
        ["check", str(inputs / "scene.toml")],
        ["generate", str(inputs / "set.toml"), "-o", made, "--quiet"],
        ["stats", folder, "-o", str(out / "x.png")],
        ["verify", folder],
        ["render", folder, "-o", made, "--no-video"],
        *(["export", folder, "-o", made, "--format", name] for name in ("gns", "well", "vtk", "tfrecord")),
        ["export", str(inputs / "run"), "-o", made],
    ]


def case(folder: Path, rng: random.Random) -> dict[str, object]:
    """Run a command below a limit; returns the command, the limit and the fault, "" without one."""
    out = folder / "limited"
    command = rng.choice(commands(folder / "good", out))
    memory = int(LEAST * (MOST / LEAST) ** rng.random())

    def work() -> int:
        os.chdir(folder / "here")
        return cli.main(command)

    outcome = common.run(work, memory=memory, seconds=120.0)
    shutil.rmtree(out, ignore_errors=True)
    left = sorted(p.name for p in folder.iterdir() if p.name not in ("good", "here", "case"))
    for name in left:
        shutil.rmtree(folder / name)
    fault = "" if outcome.kind == "ok" else outcome.kind
    if not fault and outcome.status and BLAME.search(outcome.text):
        fault = "unclear message"
    if not fault and left:
        fault = "written outside"
    text = outcome.text[-1500:] if fault else outcome.text[-200:]
    return {"command": command, "memory": memory, "status": outcome.status, "fault": fault, "text": text}


def main() -> None:
    folder, count, seed = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    for number in range(count):
        print(json.dumps({"number": number, **case(folder, random.Random(f"{seed} memory {number}"))}), flush=True)


if __name__ == "__main__":
    main()
