"""Times of substeps beside another version of the library, in the same run.

    python -m benchmarks.beside SOURCES                      # CPU, one thread
    python -m benchmarks.beside SOURCES --device cuda
    python -m benchmarks.beside SOURCES --only obstacles

SOURCES is a folder with a built version of torch_mpm, such as a worktree of an older commit. Each scene is computed by
both versions in turn, in processes of their own, and the least time of each counts. The exit status is 1 where a scene
is slower than LIMIT.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from . import beside_worker, common

LIMIT = 0.97
"""Least speed relative to the other version."""
STEPS = {"cpu": 50, "cuda": 1000}
"""Substeps of a rollout."""
REPEATS, ROUNDS = 3, 3
"""Rollouts in each process, and processes of each version."""


def least_time(sources: Path, name: str, device: str, steps: int) -> float:
    """Least time of a substep in a new process, by the library in `sources` [s]."""
    command = [sys.executable, str(Path(beside_worker.__file__)), name, device, str(steps), str(REPEATS)]
    environment = {**os.environ, "PYTHONPATH": str(sources.resolve())}
    if device == "cpu":
        environment["OMP_NUM_THREADS"] = "1"
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{name} failed with {sources}: {done.stderr.strip()}")
    return min(json.loads(done.stdout.splitlines()[-1]))


def row(sources: Path, name: str, device: str, steps: int, rounds: int) -> dict[str, Any]:
    """Times of both versions [s]."""
    found = [[least_time(tree, name, device, steps) for tree in (sources, common.ROOT)] for _ in range(rounds)]
    before, now = (min(times) for times in zip(*found, strict=True))
    return {"scene": name, "before": before, "now": now}


def text(result: dict[str, Any]) -> str:
    header = ("scene", "before, us", "now, us", "speed")
    rows = [(r["scene"], 1e6 * r["before"], 1e6 * r["now"], r["before"] / r["now"]) for r in result["rows"]]
    place = common.describe(result["environment"])
    return "\n".join(
        [
            "# Substeps beside another version",
            "",
            f"{place} The other version is of commit {result['other']}.",
            "",
            common.table(header, rows),
            "",
        ]
    )


def commit_of(sources: Path) -> str:
    command = ["git", "-C", str(sources), "rev-parse", "--short", "HEAD"]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else "unknown"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", type=Path, help="folder with the other version")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--only", default="", help="part of the names of the scenes")
    parser.add_argument("--steps", type=int, help="substeps of a rollout")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="processes of each version")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    options = parser.parse_args(arguments)
    if not (options.sources / "torch_mpm").is_dir():
        parser.error(f"sources must contain a folder torch_mpm, got {options.sources}")
    names = [name for name in beside_worker.CASES if options.only in name]
    if not names:
        parser.error(f"--only must be a part of a scene's name, got {options.only!r}")
    steps = options.steps or STEPS[options.device]
    result: dict[str, Any] = {
        "environment": common.environment(options.device),
        "other": commit_of(options.sources),
        "rows": [],
    }
    for name in names:
        result["rows"].append(row(options.sources, name, options.device, steps, options.rounds))
        print(
            common.table(("scene", "before", "now"), [tuple(result["rows"][-1].values())]).splitlines()[-1], flush=True
        )
    common.write(options.out, f"beside_{common.slug(common.device_name(options.device))}", result, text(result))
    return int(any(r["before"] / r["now"] < LIMIT for r in result["rows"]))


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    sys.exit(main())
