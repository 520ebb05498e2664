"""Times of an object of Gaussian splats, part by part:

    python -m benchmarks.speed.splats [--device cuda]      # a minute
    python -m benchmarks.speed.splats --quick              # seconds

A soft torus with Gaussians of the degree 3 drops on the floor. Each of its frames has 20 substeps in one rollout, the
deformation of the Gaussians, and a file; some frames have a picture. The file is on the disk before the clock stops.
Threads are those of torch's default: OMP_NUM_THREADS=1 on a busy machine.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torch_mpm as mpm
from torch_mpm import splats
from torch_mpm.render.camera import framing
from torch_mpm.splats.picture import chosen_backend

from .. import common, regressions
from ..catalogue.splats import torus

SUBSTEPS = 20
PICTURES = 5
"""Number of frames that are drawn."""
RESOLUTION = (1280, 720)
PARTS = ("read", "fill", "simulate", "deform", "write", "draw")


def measure(count: int, frames: int, device: str, folder: Path) -> dict[str, Any]:
    """Seconds of each part of a run, and what it made."""
    seconds: dict[str, list[float]] = {part: [] for part in PARTS}

    def timed(part: str, work: Callable[[], Any]) -> Any:
        _synchronize(device)
        begin = time.perf_counter()
        result = work()
        _synchronize(device)
        seconds[part].append(time.perf_counter() - begin)
        return result

    dx = 0.6 / count ** (1 / 3)
    grid = mpm.Grid(dx, (0, 0, 0), (1, 1, 1))
    splats.write(folder / "object.ply", torus(1.0, 0.4, count, 3))
    rest = timed("read", lambda: splats.read(folder / "object.ply"))
    rest = splats.placed(rest, extent=0.5, center=(0.5, 0.2, 0.5))
    points = timed("fill", lambda: splats.particles(rest, grid))
    rest, state = rest.to(device), mpm.State.at_rest(points, 1000.0, device=device)
    step = mpm.Step(grid, mpm.NeoHookean(E=2e4, nu=0.3), gravity=(0, -9.8, 0), walls="separate")
    dt = float(step.stable_dt(state, 0.3))
    state = mpm.rollout(step, state, 1, dt)  # Capacities and caches.
    camera = framing(np.zeros(3), np.ones(3), np.array([0.0, 1.0, 0.0]), RESOLUTION, 28.0, 18.0)
    drawn = set(np.linspace(0, frames - 1, PICTURES).round().astype(int).tolist())
    for k in range(frames):
        state = timed("simulate", lambda now=state: mpm.rollout(step, now, SUBSTEPS, dt))
        moved = timed("deform", lambda now=state: splats.moved(rest, now))
        size = timed("write", lambda now=moved, path=folder / f"{k:05d}.ply": splats.write(path, now))
        if k in drawn:
            timed("draw", lambda now=moved: splats.render(now, camera))
    step.check()
    return {
        "gaussians": count, "particles": len(state), "frames": frames, "dx": dx, "bytes": size,
        "backend": chosen_backend(rest),
        "seconds": {part: statistics.median(values) for part, values in seconds.items()},
    }  # fmt: skip


def _synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = [
        "# Gaussian splats",
        "",
        common.describe(result["environment"]),
        "",
        f"Median seconds: of reading and filling the object once; of {SUBSTEPS} substeps, of the deformation of the "
        f"Gaussians and of the file of a frame; and of a picture of {RESOLUTION[0]} x {RESOLUTION[1]} pixels.",
        "",
    ]
    header = ("Gaussians", "particles", "frames", "bytes of a frame", *PARTS, "drawn by")
    rows = [
        (r["gaussians"], r["particles"], r["frames"], r["bytes"], *(r["seconds"][part] for part in PARTS), r["backend"])
        for r in result["runs"]
    ]
    return "\n".join([*lines, common.table(header, rows)])


def timed_parts(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Milliseconds by part, for `regressions`."""
    for run in result["runs"]:
        for part, value in run["seconds"].items():
            yield f"{part}, {run['gaussians']} Gaussians", 1e3 * value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="a small size, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    count, frames = (2000, 3) if arguments.quick else (200_000, 100)
    folder = Path(tempfile.mkdtemp())
    try:
        with torch.no_grad():
            run = measure(count, frames, arguments.device, folder)
    finally:
        shutil.rmtree(folder)
    result = {"environment": common.environment(arguments.device), "runs": [run]}
    print(text(result))
    name = f"splats_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed_parts)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
