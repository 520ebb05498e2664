"""Time of generating data sets, including files, and utilisation of the device.

    python -m benchmarks.datasets                      # CPU: some scenes of the presets
    python -m benchmarks.datasets --device cuda        # also the size of DeepMind's Sand set: 1000 scenes of 2000
                                                       # particles, 320 frames of 2.5 ms and the first
    python -m benchmarks.datasets --device cuda --large  # 32 such sets in one: a long run, several GPUs
    python -m benchmarks.datasets --out DIRECTORY --work FOLDER

Each data set is generated in a separate process, from the start of Python to the last byte on the disk of FOLDER. The
share of time in which the GPU runs a kernel is sampled by nvidia-smi every 100 ms between the first and the last frame
(its utilization), where nvidia-smi is available, over the GPUs in CUDA_VISIBLE_DEVICES, or all.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from . import common, regressions

SAND = ["dataset.splits={train=1000}", "dataset.particles=2000"]
WATER = ["dataset.splits={train=32}", "dataset.scenes_per_shard=8", "dataset.frames=101"]
SETS: dict[str, list[tuple[str, str, list[str], int]]] = {
    "cuda": [
        ("Sand, 1000 x 2000", "sand", SAND, 1),
        ("Sand, 1000 x 2000, 4 processes a GPU", "sand", [*SAND, "dataset.scenes_per_shard=125"], 4),
        ("Sand, 4000 x 2000, 4 processes a GPU", "sand",
         [*SAND, "dataset.splits={train=4000}", "dataset.scenes_per_shard=125"], 4),
        ("Sand, 1000 x 2000, not deterministic", "sand", [*SAND, "grid.deterministic=false"], 1),
        ("Water, 3-D, 64 scenes", "water_3d", ["dataset.splits={train=64}", "dataset.scenes_per_shard=32"], 1),
        ("Melting, 128 scenes", "melting", ["dataset.splits={train=128}"], 1),
    ],
    "cpu": [
        ("Water drop, 32 scenes", "water_drop", WATER, 1),
        ("Water drop, 32 scenes, a process per core", "water_drop", WATER, len(os.sched_getaffinity(0))),
        ("Sand, 32 x 2000", "sand", ["dataset.splits={train=32}", "dataset.particles=2000",
                                     "dataset.scenes_per_shard=16", "dataset.frames=101"], 1),
    ],
}  # fmt: skip
"""Name, preset and overrides of the data sets by device, and processes that generate them, of each GPU."""
LARGE = [
    ("Sand, 32000 x 2000, 8 processes a GPU", "sand",
     [*SAND, "dataset.splits={train=32000}", "dataset.scenes_per_shard=125"], 8),
]  # fmt: skip
"""As `SETS`; 126 GB."""
PEER = {"water_drop": "water", "sand": "sand"}
"""Presets whose scenes `datasets_peer` simulates one by one, and their kinds."""
QUICK = ["dataset.splits={train=4}", "dataset.scenes_per_shard=2", "dataset.frames=4"]


def generate(preset: str, overrides: list[str], device: str, folder: Path) -> dict[str, Any]:
    """Generate a data set in this process; prints the values that the others read."""
    from torch_mpm.data.configuration import Configuration
    from torch_mpm.data.folder import DatasetFolder
    from torch_mpm.data.generate import generate

    marks: list[float] = []

    def progress(figures: dict[str, Any]) -> None:
        marks[1:] = [time.time()]

    configuration = Configuration.preset(preset, overrides)
    summary = generate(configuration, folder, device=device, progress=progress)
    dataset = DatasetFolder(folder)
    scenes = dataset.scenes()
    substeps = [dataset.scene(s.id).attributes["substeps_per_frame"] for s in scenes[:: max(1, len(scenes) // 8)]]
    return {
        **summary,
        "between": marks,
        "valid": len(scenes),
        "again": sum(s.attempts > 1 for s in dataset.attempted()),
        "particles": sum(s.particles for s in scenes),
        "frames": dataset.record.frames,
        "substeps": sum(substeps) / max(len(substeps), 1),
        "bytes": sum(p.stat().st_size for p in (folder / "shards").glob("*.h5")),
    }


def measured(name: str, preset: str, overrides: list[str], device: str, work: Path, processes: int) -> dict[str, Any]:
    """One data set in separate processes."""
    folder = work / "set"
    shutil.rmtree(folder, ignore_errors=True)
    words = [sys.executable, "-m", "benchmarks.datasets", "--one", json.dumps([preset, overrides, device, str(folder)])]
    sampler = _sampler() if device == "cuda" else None
    begin = time.perf_counter()
    pipe = subprocess.PIPE
    started = [
        subprocess.Popen(words, cwd=common.ROOT, env=environment, stdout=pipe, stderr=pipe, text=True)
        for environment in _environments(processes)
    ]
    outputs = [one.communicate() for one in started]
    seconds = time.perf_counter() - begin
    samples = _samples(sampler)
    for one, (_, errors) in zip(started, outputs, strict=True):
        if one.returncode:
            raise RuntimeError(f"{name}: {errors}")
    rows = [json.loads(output.splitlines()[-1]) for output, _ in outputs]
    rows.sort(key=lambda r: (r["valid"], r["complete"]))
    marks = [when for row in rows for when in row.pop("between")]
    row = {**rows[-1], "processes": len(rows)}  # The data set after the last process, and the time of the slowest.
    row |= {key: max(r[key] for r in rows) for key in ("seconds", "simulating", "waiting")}
    busy = [value for when, value in samples if min(marks) <= when <= max(marks)]
    shutil.rmtree(folder)
    return {"name": name, **row, "process": seconds, "busy": sum(busy) / len(busy) / 100 if busy else None}


def peer(row: dict[str, Any], material: str, device: str) -> float | None:
    """Time per frame and scene of a script in Taichi [s]; None without Taichi."""
    particles = str(row["particles"] // max(row["valid"], 1))
    words = [sys.executable, "-m", "benchmarks.datasets_peer", material, "--device", device, "--particles", particles]
    done = subprocess.run(words, cwd=common.ROOT, capture_output=True, text=True)
    if done.returncode:
        print(done.stderr, file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])["s_per_frame"]


def _environments(processes: int) -> list[dict[str, str]]:
    """Environment variables of torchrun."""
    if processes == 1:
        return [dict(os.environ)]
    counts = {"WORLD_SIZE": str(processes), "LOCAL_WORLD_SIZE": str(processes), "OMP_NUM_THREADS": "1"}
    return [{**os.environ, **counts, "RANK": str(k), "LOCAL_RANK": str(k)} for k in range(processes)]


def _sampler() -> subprocess.Popen[str] | None:
    """nvidia-smi, which samples the utilization of each GPU every 100 ms."""
    query = ["nvidia-smi", "--query-gpu=timestamp,utilization.gpu", "--format=csv,noheader,nounits", "-lms", "100"]
    if gpus := os.environ.get("CUDA_VISIBLE_DEVICES"):
        query += ["--id", gpus]
    try:
        return subprocess.Popen(query, stdout=subprocess.PIPE, text=True)
    except OSError:
        return None


def _samples(sampler: subprocess.Popen[str] | None) -> list[tuple[float, float]]:
    """(time, percent) of all samples."""
    if sampler is None:
        return []
    sampler.terminate()
    found = []
    for line in sampler.communicate()[0].splitlines():
        when, _, value = line.partition(",")
        try:
            moment = time.mktime(time.strptime(when.strip().partition(".")[0], "%Y/%m/%d %H:%M:%S"))
            found.append((moment + float("0." + when.strip().partition(".")[2]), float(value)))
        except ValueError:
            continue  # A truncated line, or a device without this value.
    return found


HEADER = (
    "data set", "processes", "scenes", "tried again", "particles a scene", "frames", "substeps a frame", "s",
    "with start of Python", "simulating, s", "waiting, s", "scenes/s", "M particle steps/s", "GPU busy", "GB",
    "us a frame and scene", "Taichi", "times",
)  # fmt: skip


def row_of(r: dict[str, Any]) -> tuple[Any, ...]:
    steps = r["particles"] * (r["frames"] - 1) * r["substeps"]
    scenes = max(r["valid"], 1)
    per_frame, there = r["seconds"] / scenes / (r["frames"] - 1), r.get("peer")
    return (
        r["name"], r["processes"], r["valid"], r["again"], r["particles"] // scenes, r["frames"], r["substeps"],
        r["seconds"], r["process"], r["simulating"], r["waiting"], r["valid"] / r["seconds"],
        steps / r["seconds"] * 1e-6, r["busy"], r["bytes"] * 1e-9, 1e6 * per_frame, there and 1e6 * there,
        there and there / per_frame,
    )  # fmt: skip


def text(result: dict[str, Any]) -> str:
    """The table of a result in Markdown."""
    rows = [row_of(r) for r in result["sets"]]
    lines = ["# Generating data sets", "", common.describe(result["environment"]), "", common.table(HEADER, rows), ""]
    return "\n".join(
        [
            *lines,
            "Simulating: time in which the host simulates; waiting: for scenes or files, beside it. "
            "Taichi: time a frame of scenes one by one, files included, compilation not.",
        ]
    )


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Milliseconds per scene, for `regressions`."""
    for r in result["sets"]:
        yield r["name"], 1e3 * r["seconds"] / max(r["valid"], 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--peers", action="store_true", help="also scenes one by one in Taichi")
    parser.add_argument("--quick", action="store_true", help="small sets, to see that it works")
    parser.add_argument("--large", action="store_true", help="the set of 32000 scenes alone; with a GPU")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    parser.add_argument("--work", type=Path, help="where the data sets are written; by default a temporary folder")
    parser.add_argument("--only", default="", metavar="TEXT", help="data sets whose name has this text")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        preset, overrides, device, folder = json.loads(arguments.one)
        print(json.dumps(generate(preset, overrides, device, Path(folder))))
        return
    if arguments.large and arguments.device != "cuda":
        parser.error("--large is for a GPU: --device cuda")
    gpus = torch.cuda.device_count() if arguments.device == "cuda" else 1
    result: dict[str, Any] = {"environment": common.environment(arguments.device, gpus), "sets": []}
    if arguments.work:
        arguments.work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=arguments.work) as work:
        for name, preset, overrides, processes in LARGE if arguments.large else SETS[arguments.device]:
            if arguments.only in name:
                more = QUICK if arguments.quick else []
                set_of = (name, preset, [*overrides, *more], arguments.device, Path(work), processes * gpus)
                result["sets"].append(row := measured(*set_of))
                if preset in PEER and arguments.peers:
                    row["peer"] = peer(row, PEER[preset], arguments.device)
                print(common.table(HEADER, [row_of(result["sets"][-1])]), flush=True)
    name = f"datasets{'_large' if arguments.large else ''}_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
