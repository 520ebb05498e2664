"""Times of an object of Gaussian splats, part by part, and of runs with files of all frames:

    python -m benchmarks.speed.splats [--device cuda]      # two minutes
    python -m benchmarks.speed.splats --quick              # seconds

A soft torus drops on the floor. Each of its frames has 20 substeps in one rollout, the deformation of the Gaussians,
and a file; some frames have a picture. The parts are those of Gaussians of the degree 3, one after another; a file is
on the disk before the clock stops. Runs are those of users: threads of `splats.FrameWriter` write files while the next
frames are computed, and the clock stops when the last file is on the disk. The same number of threads then writes as
many files of the same bytes from memory.
Threads of torch are those of its default: OMP_NUM_THREADS=1 on a busy machine.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torch_mpm as mpm
from torch_mpm import splats
from torch_mpm.data.whole_files import replacing
from torch_mpm.render.camera import framing
from torch_mpm.splats.picture import chosen_backend

from .. import common, regressions
from ..catalogue.splats import torus

SUBSTEPS = 20
FRAMES = {"cpu": 25, "cuda": 100}
DEGREES = (0, 3)
"""Degrees of the harmonics in runs."""
PICTURES = 5
"""Number of frames that are drawn."""
RESOLUTION = (1280, 720)
PARTS = ("read", "fill", "simulate", "deform", "write", "draw")


@dataclass(frozen=True)
class Scene:
    """Object at rest and its step."""

    rest: splats.Gaussians
    step: mpm.Step
    state: mpm.State
    dt: float


class Clock:
    """Seconds of the parts of a run."""

    def __init__(self, device: str) -> None:
        self._device = device
        self.seconds: dict[str, list[float]] = {part: [] for part in PARTS}

    def timed(self, part: str, work: Callable[[], Any]) -> Any:
        _synchronize(self._device)
        begin = time.perf_counter()
        result = work()
        _synchronize(self._device)
        self.seconds[part].append(time.perf_counter() - begin)
        return result


def scene(count: int, device: str, folder: Path, clock: Clock) -> Scene:
    """Object of the degree 3 from a file, and its state after a step, with capacities and caches."""
    dx = 0.6 / count ** (1 / 3)
    grid = mpm.Grid(dx, (0, 0, 0), (1, 1, 1))
    splats.write(folder / "object.ply", torus(1.0, 0.4, count, 3))
    rest = clock.timed("read", lambda: splats.read(folder / "object.ply"))
    rest = splats.placed(rest, extent=0.5, center=(0.5, 0.2, 0.5))
    points = clock.timed("fill", lambda: splats.particles(rest, grid))
    rest, state = rest.to(device), mpm.State.at_rest(points, 1000.0, device=device)
    step = mpm.Step(grid, mpm.NeoHookean(E=2e4, nu=0.3), gravity=(0, -9.8, 0), walls="separate")
    dt = float(step.stable_dt(state, 0.3))
    return Scene(rest, step, mpm.rollout(step, state, 1, dt), dt)


def measure_parts(count: int, frames: int, device: str, folder: Path) -> tuple[dict[str, Any], Scene]:
    """Median seconds of each part, and the scene."""
    clock = Clock(device)
    made = scene(count, device, folder, clock)
    rest, state = made.rest, made.state
    camera = framing(np.zeros(3), np.ones(3), np.array([0.0, 1.0, 0.0]), RESOLUTION, 28.0, 18.0)
    drawn = set(np.linspace(0, frames - 1, PICTURES).round().astype(int).tolist())
    for k in range(frames):
        state = clock.timed("simulate", lambda now=state: mpm.rollout(made.step, now, SUBSTEPS, made.dt))
        moved = clock.timed("deform", lambda now=state: splats.moved(rest, now))
        size = clock.timed("write", lambda now=moved: splats.write(folder / "frame.ply", now))
        (folder / "frame.ply").unlink()
        if k in drawn:
            clock.timed("draw", lambda now=moved: splats.render(now, camera))
    made.step.check()
    run = {
        "gaussians": count, "particles": len(state), "frames": frames, "dx": made.step.grid.dx, "bytes": size,
        "backend": chosen_backend(rest),
        "seconds": {part: statistics.median(values) for part, values in clock.seconds.items()},
    }  # fmt: skip
    return run, made


def measure_run(made: Scene, degree: int, frames: int, device: str, folder: Path) -> dict[str, Any]:
    """Seconds of a run with files of all frames, and of writing the same bytes from memory."""
    rest = made.rest.replace(harmonics=made.rest.harmonics[:, : (degree + 1) ** 2].contiguous())
    paths, state = [folder / f"{k:05d}.ply" for k in range(frames)], made.state
    _synchronize(device)
    begin = time.perf_counter()
    with splats.FrameWriter() as files:
        for path in paths:
            state = mpm.rollout(made.step, state, SUBSTEPS, made.dt)
            files.write(path, splats.moved(rest, state))
    seconds = time.perf_counter() - begin
    made.step.check()
    data = paths[-1].read_bytes()
    for path in paths:
        path.unlink()
    bound = seconds_of_writing(data, paths, files.threads)
    for path in paths:
        path.unlink()
    return {
        "gaussians": len(rest), "degree": degree, "frames": frames, "bytes": len(data), "threads": files.threads,
        "held_bytes": min(files.most, frames) * len(data), "seconds": seconds, "from_memory": bound,
    }  # fmt: skip


def seconds_of_writing(data: bytes, paths: Sequence[Path], threads: int) -> float:
    """Time in which threads write whole files of the same bytes to the disk [s]."""

    def write(path: Path) -> None:
        with replacing(path) as temporary:
            temporary.write_bytes(data)

    begin = time.perf_counter()
    with ThreadPoolExecutor(threads) as executor:
        list(executor.map(write, paths))
    return time.perf_counter() - begin


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
    return "\n".join([*lines, common.table(header, rows), "", *runs_text(result["loops"])])


def runs_text(loops: list[dict[str, Any]]) -> list[str]:
    """Lines of the table of runs."""
    lines = [
        f"Seconds of a run of frames of {SUBSTEPS} substeps until all files are on the disk, written by threads while "
        "the next frames are computed; and of the same bytes written from memory by the same number of threads. The "
        "memory is the largest that frames may take.",
        "",
    ]
    header = ("Gaussians", "degree", "frames", "bytes of a frame", "threads", "memory [MB]", "run", "from memory")
    rows = [
        (r["gaussians"], r["degree"], r["frames"], r["bytes"], r["threads"], round(1e-6 * r["held_bytes"], 1),
         r["seconds"], r["from_memory"])
        for r in loops
    ]  # fmt: skip
    return [*lines, common.table(header, rows)]


def timed_parts(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Milliseconds by part, for `regressions`."""
    for run in result["runs"]:
        for part, value in run["seconds"].items():
            yield f"{part}, {run['gaussians']} Gaussians", 1e3 * value
    for run in result.get("loops", []):  # Earlier results have none.
        yield (
            f"frame of a run, degree {run['degree']}, {run['gaussians']} Gaussians",
            1e3 * run["seconds"] / run["frames"],
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="a small size, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    count, frames = (2000, 3) if arguments.quick else (200_000, FRAMES[arguments.device])
    folder = Path(tempfile.mkdtemp())
    try:
        with torch.no_grad():
            run, made = measure_parts(count, frames, arguments.device, folder)
            loops = [measure_run(made, degree, frames, arguments.device, folder) for degree in DEGREES]
    finally:
        shutil.rmtree(folder)
    result = {"environment": common.environment(arguments.device), "runs": [run], "loops": loops}
    print(text(result))
    name = f"splats_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed_parts)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
