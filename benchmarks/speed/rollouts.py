"""Times of typical work: example scenes, rollouts of many sizes, batches and large domains.

    python -m benchmarks.speed.rollouts                    # CPU, all cores
    python -m benchmarks.speed.rollouts --device cuda      # either takes about a minute
    python -m benchmarks.speed.rollouts --out DIRECTORY

Scenes: `torch_mpm.scene.run` with its files, a process each; time of the simulation. The others are the neo-Hookean
cube of `benchmarks/speed/work.py`, steps of one call of `torch_mpm.rollout`, wall clock, synchronised once. Warp and
Taichi take steps of the same cube where they are installed (`pip install torch-mpm[bench]`), Warp's also launched one
by one from Python beside each scene. The figure has every device that has results in DIRECTORY.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

import torch_mpm as mpm
from torch_mpm.scene.run import Simulation

from .. import common, regressions
from . import peers, scaling, work
from .step import Setup, run_peer, setup

SCENES = {"cpu": ("demo", "batch"), "cuda": ("demo", "batch", "sand_column", "sand_drum", "spinner", "melt")}
SIDES = {"cpu": (4, 10, 22, 46, 64), "cuda": (4, 10, 22, 46, 100, 200)}
LARGE_SIDES = {"cpu": (100, 200), "cuda": (464,)}
"""Measured last: the memory of a CPU has few large pages afterwards, and others then take a quarter longer."""
BATCHES = {"cpu": ((64, 512),), "cuda": ((4096, 512), (1024, 2197))}
"""Numbers of scenes, and of particles of each."""
DOMAINS = {"cpu": (1, 4, 32), "cuda": (1, 8, 16)}
"""Cells along a side of the domain, in those of its cube."""
DOMAIN_SIDE = {"cpu": 64, "cuda": 100}
"""Particles along a side of that cube."""
LAWS: dict[str, Callable[[], mpm.Material]] = {
    "fixed corotated": lambda: mpm.FixedCorotated(mu=work.MU, lam=work.LAM),
    "quartic sand": lambda: mpm.QuarticSand(mu=work.MU, lam=work.LAM),
    "fluid": lambda: mpm.WeaklyCompressible(work.LAM),
}
"""Laws of the largest cubes beside the neo-Hookean ones."""
LAW_SIDES = {"cpu": (64,), "cuda": (100, 200)}
DETERMINISTIC = {"cpu": (), "cuda": (22, 46, 100)}
"""Sides of the cubes, some of SIDES, whose results are bit-identical from run to run; on a CPU all are."""
PEER_SIDES = {"cpu": (10, 64), "cuda": (4, 22, 46, 100, 200)}
"""Sides of the cubes that peers compute too, some of SIDES. The batches above are theirs too."""
PEER_DOMAINS = {"cpu": (4,), "cuda": (8, 16)}
"""Those of DOMAINS whose dense grid fits into memory."""
SECONDS = 0.5
"""Approximate number of steps in one measurement."""


def seconds(device: str, program: Callable[[], object]) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    start = time.perf_counter()
    program()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def least(device: str, program: Callable[[], object], samples: int) -> float:
    """Minimum of the times of n calls [s]; of more of them, until they have taken SECONDS together, unless n is one."""
    times = [seconds(device, program) for _ in range(samples)]
    while samples > 1 and sum(times) < SECONDS:
        times.append(seconds(device, program))
    return min(times)


def per_step(s: Setup, device: str, samples: int, dt: float = work.DT, ordered: bool = True) -> dict[str, Any]:
    """Minimum time of a substep of a rollout, with particles sorted before if `ordered`."""
    state = s.state.sorted(s.grid) if ordered else s.state

    def rolled(steps: int) -> Callable[[], object]:
        return lambda: mpm.rollout(s.step, state, steps, dt)

    with torch.no_grad():
        seconds(device, rolled(4))
        steps = max(16, min(1000, int(SECONDS / (seconds(device, rolled(32)) / 32))))
        best = min(seconds(device, rolled(steps)) for _ in range(samples)) / steps
    return {"particles": len(state), "steps": steps, "us": best * 1e6, "rate": len(state) / best}


def beside_a_busy_process(s: Setup, samples: int) -> dict[str, Any]:
    """Time of a substep beside a busy process."""
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        return per_step(s, "cpu", samples)
    finally:
        busy.kill()
        busy.wait()


def side_of(particles: int) -> int:
    """Times of a cube."""
    return round(particles ** (1 / 3))


def changed(s: Setup, **options: Any) -> mpm.Step:
    """Step of a cube with some options."""
    same = {"grid": s.grid, "law": s.step.law, "gravity": s.step.gravity, "walls": "sticky"}
    return mpm.Step(**same | options)


def batched(scenes: int, particles: int, device: str) -> Setup:
    """Many scenes of one small cube each."""
    w = work.make(side_of(particles))
    one = setup(w, device)
    grid = mpm.Grid(dx=1 / w.n, lower=(0, 0, 0), upper=(1, 1, 1), scenes=scenes)
    scene = torch.arange(scenes, dtype=torch.int32, device=device).repeat_interleave(w.particles)
    state = one.state.select(torch.arange(w.particles, device=device).repeat(scenes)).replace(scene=scene)
    step = changed(one, grid=grid)
    return Setup(step.prepare(state), step)


def in_domain(side: int, times: int, device: str, deterministic: bool = False) -> Setup:
    """The cube in a larger domain."""
    s = setup(work.make(side), device)
    grid = mpm.Grid(dx=s.grid.dx, lower=(0, 0, 0), upper=(times, times, times), deterministic=deterministic)
    return Setup(s.state, changed(s, grid=grid))


def flipped(side: int, device: str) -> Setup:
    """The cube with FLIP."""
    s = setup(work.make(side), device)
    return Setup(s.state, changed(s, flip=0.95))


def of_two_materials(side: int, device: str) -> Setup:
    """The cube, half of it a fluid."""
    s = setup(work.make(side), device)
    x = s.state.x[:, 1]
    step = changed(s, law=mpm.Mixture([s.step.law, LAWS["fluid"]()]))
    return Setup(step.prepare(s.state.replace(material=(x > x.mean()).int())), step)


def in_no_order(side: int, device: str) -> Setup:
    """The same with unsorted particles."""
    s = of_two_materials(side, device)
    return Setup(s.state.select(torch.randperm(len(s.state)).to(device)), s.step)


def with_muscles(side: int, device: str) -> Setup:
    """The cube with a muscle activation of each particle."""
    s = setup(work.make(side), device)
    step = changed(s, law=mpm.Active(s.step.law, (0.0, 1.0, 0.0)))
    state = step.prepare(s.state)
    return Setup(state.replace(extra={"activation": 1e-3 * work.MU * torch.rand_like(state.mass)}), step)


def beside_a_path(side: int, device: str) -> Setup:
    """The cube and a ball that swings in it."""
    s = setup(work.make(side), device)
    middle, width = s.state.x.mean(0), s.state.x.std(0).mean()
    way = lambda t: middle + width * torch.stack([torch.sin(20 * t), 0 * t, 0 * t], -1)  # noqa: E731
    return Setup(s.state, changed(s, boundaries=[mpm.Sphere(way, float(width) / 2)]))


OTHERS: dict[str, Callable[[int, str], Setup]] = {
    "two materials": of_two_materials,
    "two materials, in no order": in_no_order,
    "muscles": with_muscles,
    "an obstacle on a path": beside_a_path,
}


def name_of_domain(times: int, side: int) -> str:
    return f"domain of {times * work.cells_of(side)}^3 cells"


def made_of(law: mpm.Material, side: int, device: str) -> Setup:
    """The cube of another material."""
    s = setup(work.make(side), device)
    step = changed(s, law=law)
    return Setup(step.prepare(s.state.replace(C=None, F=None)), step)


def on_its_way(name: str, device: str, frames: int = 6) -> tuple[Setup, float]:
    """An example scene after some frames, and its time step."""
    scene = mpm.Scene.load(common.ROOT / "examples" / f"{name}.toml").model_copy(update={"device": device})
    simulation = Simulation(scene, scene.build(device))
    with torch.no_grad():
        for frame in range(frames):
            simulation._advance(scene.time_of(frame), scene.time_of(frame + 1))
    dt = float(simulation.step.stable_dt(simulation.state).min())
    return Setup(simulation.state, simulation.step), dt


RUN = """
import sys, torch_mpm
from torch_mpm.scene.run import run
file, device, out = sys.argv[1:]
run(torch_mpm.Scene.load(file).model_copy(update={"device": device}), out)
"""
"""A program, so that the start-up of a process is included."""


def scenes(names: tuple[str, ...], device: str) -> Iterator[dict[str, Any]]:
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            out, file = Path(folder) / name, common.ROOT / "examples" / f"{name}.toml"
            subprocess.run([sys.executable, "-c", RUN, str(file), device, str(out)], check=True)
            summary = json.loads((out / "run.json").read_text())["summary"]
        substeps, spent = summary["substeps"], summary["seconds"]["simulation"]
        yield {
            "name": f"{name}, as run",
            "particles": summary["particles"],
            "steps": substeps,
            "seconds": spent,
            "us": spent / substeps * 1e6,
            "rate": summary["particles"] * substeps / spent,
        }


def of_peers(device: str, rollouts: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Minimum times of a step, and speed-up by a rollout of the same work."""
    ours = {(r["name"], r["particles"]): r["us"] for r in rollouts}
    programs = [("one scene", PEER_SIDES[device], [])]
    for scenes, particles in BATCHES[device]:
        programs.append((f"{scenes} scenes", [side_of(particles)], ["--scenes", str(scenes)]))
    for times in PEER_DOMAINS[device]:
        programs.append((name_of_domain(times, DOMAIN_SIDE[device]), [DOMAIN_SIDE[device]], ["--domain", str(times)]))
    for peer in filter(peers.is_installed, peers.PEERS):
        for work_name, sides, options in programs:
            for r in run_peer(peer, device, sides, 7, *options):
                us, count = 1e3 * r["fastest_ms"], r["particles"]
                row = {"name": f"{peer} {r['version']}", "work": work_name, "particles": count, "us": us}
                yield {**row, "rate": count / us * 1e6, "times": us / ours[work_name, count]}


def plain_programs(device: str, scenes: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """A step of Warp launched from Python, three kernels for the neo-Hookean cube with about as many particles as a
    scene, and the speed-up by the complete scene, with its laws, obstacles, heat and output.
    """
    if device != "cuda" or not peers.is_installed("warp"):
        return
    sides = [side_of(scene["particles"]) for scene in scenes]
    for scene, r in zip(scenes, run_peer("warp", device, sides, 7, "--launches", steps=200), strict=True):
        us = 1e3 * r["fastest_ms"]
        yield {"name": scene["name"], "particles": r["particles"], "us": us, "times": us / scene["us"]}


def measure(device: str, quick: bool = False) -> dict[str, Any]:
    common.use_all_cores()
    samples = 1 if quick else 5
    parts: dict[str, list[Any]] = {name: [] for name in ("scenes", "rollouts", "peers", "plain")}
    result: dict[str, Any] = {"environment": common.environment(device), **parts}
    sides = SIDES[device][:2] if quick else SIDES[device]
    for side in sides:
        s = setup(work.make(side), device)
        result["rollouts"].append({"name": "one scene", **per_step(s, device, samples)})
    for side in () if quick else DETERMINISTIC[device]:
        row = per_step(in_domain(side, 1, device, deterministic=True), device, samples)
        result["rollouts"].append({"name": "one scene, deterministic", **row})
    if device == "cpu":
        s = setup(work.make(sides[-1] if quick else PEER_SIDES[device][-1]), device)
        result["rollouts"].append({"name": "beside a busy process", **beside_a_busy_process(s, samples)})
    for side in sides[-1:] if quick else LAW_SIDES[device]:
        for name, law in LAWS.items():
            row = per_step(made_of(law(), side, device), device, samples)
            result["rollouts"].append({"name": name, **row})
        row = per_step(flipped(side, device), device, samples)
        result["rollouts"].append({"name": "FLIP", **row})
    for name, make in OTHERS.items():
        s = make(sides[-1] if quick else LAW_SIDES[device][0], device)
        row = per_step(s, device, samples, ordered=make is not in_no_order)
        result["rollouts"].append({"name": name, **row})
    for count, particles in [(4, 64)] if quick else BATCHES[device]:
        row = per_step(batched(count, particles, device), device, samples)
        result["rollouts"].append({"name": f"{count} scenes", **row})
    cube = 10 if quick else DOMAIN_SIDE[device]
    for times in DOMAINS[device]:
        row = per_step(in_domain(cube, times, device), device, samples)
        result["rollouts"].append({"name": name_of_domain(times, cube), **row})
    result["peers"] += () if quick else of_peers(device, result["rollouts"])
    s, dt = on_its_way("demo", device, frames=1 if quick else 6)
    result["rollouts"].append({"name": "demo, one call", **per_step(s, device, samples, dt)})
    result["scenes"] += scenes(() if quick else SCENES[device], device)
    for side in () if quick else LARGE_SIDES[device]:
        result["rollouts"].append({"name": "one scene", **per_step(setup(work.make(side), device), device, samples)})
    result["plain"] += () if quick else plain_programs(device, result["scenes"])
    return result


def row_of_steps(r: dict[str, Any]) -> tuple[Any, ...]:
    return r["name"], r["particles"], r["steps"], r["us"], r["rate"] * 1e-6


def row_of_peer(r: dict[str, Any]) -> tuple[Any, ...]:
    return r["name"], r.get("work", "one scene"), r["particles"], r["us"], r["times"]


def row_beside(r: dict[str, Any]) -> tuple[Any, ...]:
    """Comparison of Warp's step with a scene."""
    return r["name"], r["particles"], r["us"], r["times"]


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    header = ("", "particles", "substeps", "us per substep", "M particles/s")
    rows = [row_of_steps(r) for r in result["rollouts"]]
    lines = [
        "# Speed of rollouts and scenes",
        "",
        common.describe(result["environment"]),
        "",
        common.table(header, rows),
        "",
    ]
    rows = [(*row_of_steps(r), r["seconds"]) for r in result["scenes"]]
    lines += [common.table((*header, "simulation, s"), rows), ""]
    if rows := [row_of_peer(r) for r in result.get("peers", ())]:
        header = ("a step", "of", "particles", "us", "speed-up by the rollout")
        lines += [common.table(header, rows), ""]
    if rows := [row_beside(r) for r in result.get("plain", ())]:
        header = ("scene", "particles of Warp's plain step", "us", "speed-up by the scene")
        lines += [common.table(header, rows), ""]
    return "\n".join(lines)


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Microseconds per substep, for `regressions`."""
    for r in (*result["rollouts"], *result["scenes"]):
        yield f"{r['name']}, {r['particles']} particles", r["us"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    result = measure(arguments.device, arguments.quick)
    print(text(result))
    name = f"rollouts_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))
    if importlib.util.find_spec("matplotlib"):
        scaling.plot(common.read(arguments.out, "rollouts_*.json"), arguments.out / "rollouts.png")


if __name__ == "__main__":
    main()
