"""Time of the surfaces of the demo, and size of its USD files: `python -m benchmarks.speed.surfaces [RUN]`."""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import torch_mpm as mpm
from torch_mpm.scene.folder import load_run
from torch_mpm.scene.surfaces import RunSurfaces
from torch_mpm.scene.usd import export_usd
from torch_mpm.surfaces.files import write_surface

from .. import common

REPEATS = 3
"""Number of measurements of a frame. The shortest counts, because other programs share the machine."""
KINDS: dict[str, dict[str, Any]] = {"points": {}, "grains": {"grains": True}, "surfaces": {"surface": True}}


def times(run: Path, folder: Path) -> list[dict[str, Any]]:
    """Time to read each frame of a run, reconstruct its surfaces and write them as PLY [s]."""
    rows = []
    with mpm.Trajectory(run) as trajectory:
        surfaces = RunSurfaces(load_run(run), trajectory)
        for k in range(len(trajectory)):
            rows.append({"frame": k, **_best(trajectory, surfaces, k, folder)})
    return rows


def _best(trajectory: mpm.Trajectory, surfaces: RunSurfaces, k: int, folder: Path) -> dict[str, Any]:
    seconds, processors = [], []
    for _ in range(REPEATS):
        begin, started = time.perf_counter(), time.process_time()
        frame, triangles = trajectory.frame(k), 0
        for found in surfaces.of_frame(frame):
            write_surface(folder / f"{found.group.name}.ply", found.surface, found.velocity(frame))
            triangles += len(found.surface.faces)
        seconds.append(time.perf_counter() - begin)
        processors.append(time.process_time() - started)
    times = {"seconds": min(seconds), "processor_seconds": min(processors)}
    return {"particles": int(frame["particles"]), "triangles": triangles, **times}


def sizes(run: Path, folder: Path) -> list[dict[str, Any]]:
    """Sizes of the trajectory of a run and of its USD files, and bytes per particle and frame."""
    with mpm.Trajectory(run) as trajectory:
        total, paths = int(trajectory["particles"].sum()), {"HDF5": trajectory.path}
    for name, words in KINDS.items():
        paths[f"USD, {name}"] = export_usd(run, folder / f"{name}.usdc", **words)
    rows = []
    for name, path in paths.items():
        size = path.stat().st_size
        rows.append({"file": name, "bytes": size, "bytes_per_particle": size / total})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("run", nargs="?", type=Path, help="run folder of the demo; by default it is simulated")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        run = arguments.run or Path(name) / "run"
        if arguments.run is None:
            mpm.Scene.load(common.ROOT / "examples" / "demo.toml").run(run)
        frames, files = times(run, Path(name)), sizes(run, Path(name))
    environment = common.environment("cpu")
    slowest = max(frames, key=lambda row: row["seconds"])
    columns = ("particles", "triangles", "seconds", "processor_seconds")
    rows = [
        ["mean", *(sum(row[column] for row in frames) / len(frames) for column in columns)],
        [f"slowest ({slowest['frame']})", *(slowest[column] for column in columns)],
    ]
    text = (
        f"# Surfaces and USD files of the demo\n\n{common.describe(environment)}\n\n"
        "Time to read a frame, reconstruct its surfaces and write them as PLY, with all cores.\n"
        "Other programs that use the cores (load) lengthen it, and not the time of the processors.\n\n"
        f"{common.table(('frame', 'particles', 'triangles', 'time [s]', 'of all processors [s]'), rows)}\n\n"
        "Positions and velocities in float32 are 24 bytes per particle and frame.\n\n"
    )
    header = ("file", "size [bytes]", "bytes per particle and frame")
    text += common.table(header, [[row["file"], row["bytes"], row["bytes_per_particle"]] for row in files])
    name = f"surfaces_{common.slug(common.device_name('cpu'))}"
    common.write(arguments.out, name, {"environment": environment, "frames": frames, "files": files}, text)


if __name__ == "__main__":
    main()
