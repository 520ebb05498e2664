"""Run the benchmarks one after the other: `python -m benchmarks [--quick] [--device cpu|cuda] [--out DIRECTORY]`.

Each is a separate process; the exit status is zero if all succeeded. Without `--device` all programs run, on CUDA where
there is a GPU; with `--device cuda` only those that use it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import torch

from . import common

PROGRAMS = (
    "benchmarks.speed.step",
    "benchmarks.speed.svd",
    "benchmarks.speed.laws",
    "benchmarks.speed.heat",
    "benchmarks.speed.thermal",
    "benchmarks.speed.rollouts",
    "benchmarks.speed.checkpoints",
    "benchmarks.speed.training",
    "benchmarks.speed.splats",
    "benchmarks.speed.coupling",
    "benchmarks.speed.envs",
    "benchmarks.implicit",
    "benchmarks.datasets",
    "benchmarks.accuracy.precision",
    "benchmarks.accuracy.convergence",
    "benchmarks.accuracy.heat",
    "benchmarks.accuracy.heat_fronts",
    "benchmarks.accuracy.svd",
    "benchmarks.accuracy.sand",
    "benchmarks.accuracy.sand_gradient",
    "benchmarks.accuracy.ritter",
    "benchmarks.accuracy.runout",
    "benchmarks.accuracy.limits",
    "benchmarks.accuracy.obstacle_surfaces",
    "benchmarks.accuracy.rigid_bodies",
    "benchmarks.accuracy.locking",
    "benchmarks.accuracy.rollout_gradients",
    "benchmarks.stability.stable_dt",
    "benchmarks.stability.law_dt",
    "benchmarks.stability.adversarial",
    "benchmarks.stability.heat",
    "benchmarks.stability.heat_step",
    "benchmarks.stability.sand",
    "benchmarks.stability.collapse",
    "benchmarks.stability.bodies",
)
ON_DEVICE = (
    "benchmarks.speed.step",
    "benchmarks.speed.svd",
    "benchmarks.speed.laws",
    "benchmarks.speed.heat",
    "benchmarks.speed.thermal",
    "benchmarks.speed.rollouts",
    "benchmarks.speed.checkpoints",
    "benchmarks.speed.training",
    "benchmarks.speed.splats",
    "benchmarks.speed.envs",
    "benchmarks.implicit",
    "benchmarks.datasets",
    "benchmarks.accuracy.ritter",
    "benchmarks.accuracy.runout",
    "benchmarks.stability.law_dt",
    "benchmarks.stability.collapse",
)
"""Programs with --device; the others run on the CPU."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that the programs work")
    parser.add_argument("--device", choices=["cpu", "cuda"])
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    options = ["--out", str(arguments.out.resolve()), *(["--quick"] if arguments.quick else [])]
    device = arguments.device or ("cuda" if torch.cuda.is_available() else "cpu")
    failed = []
    for program in ON_DEVICE if arguments.device == "cuda" else PROGRAMS:
        print(f"\n== {program}", flush=True)
        words = ["--device", device] if program in ON_DEVICE else []
        if subprocess.run([sys.executable, "-m", program, *options, *words], cwd=common.ROOT).returncode:
            failed.append(program)
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
