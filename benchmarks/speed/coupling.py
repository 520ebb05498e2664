"""Times of the coupling with MuJoCo, and of MuJoCo's steps of many scenes.

    python -m benchmarks.speed.coupling [--device cuda]      # minutes
    python -m benchmarks.speed.coupling --quick              # seconds

Coupled steps: a body of each model falls on a block of 160 particles in each scene, in calls of `advance` over ten
steps of MuJoCo with four substeps each. The parts are MuJoCo's steps (the last of a call by one thread), the material,
and the exchange, which is the rest: poses, obstacles, impulses and wrenches. Times are those of one step of MuJoCo, in
the call with the median time; on CUDA the exchange includes the wait for the material.

Steps of MuJoCo: times of one scene by a loop over `mj_step` alone, by as many threads of Python that do so, and by the
coupling, which assigns wrenches and reads warnings, by a loop and by MuJoCo's threads with copies of states. They are
the least of many short runs from the same states, because threads compete with other work on a busy machine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import torch_mpm as mpm
from torch_mpm.bodies import coupling as coupling_module
from torch_mpm.bodies.mujoco_scenes import MujocoScenes

from .. import common

HEAD = '<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="3 3 1" contype="2" conaffinity="2"/>'
LINK = '<body pos="0 0 {z}"><joint axis="{x} {y} 0" damping="1"/><geom size=".03" mass="1" contype="0"/>'
BOX = '<body pos="{x} 2 {z}"><freejoint/><geom type="box" size=".1 .1 .1" mass="1" contype="2" conaffinity="2"/></body>'
BALL = '<body name="body" pos="0.5 0.5 0.66"><freejoint/><geom size="0.15" mass="5"/></body>'


def arm() -> str:
    """Seven joints, and a ball at the end."""
    heights = [1.8] + 6 * [-0.16]
    links = "".join(LINK.format(z=z, x=k % 2, y=1 - k % 2) for k, z in enumerate(heights))
    ball = '<body name="body" pos="0 0 -0.16"><geom size="0.15" mass="1"/></body>'
    return f'{HEAD}<body pos="0.5 0.5 0">{links}{ball}{"</body>" * 8}</worldbody></mujoco>'


def boxes() -> str:
    """Nine boxes in three layers on the floor."""
    return "".join(BOX.format(x=2 + 0.21 * (k % 3), z=0.1 + 0.2 * (k // 3)) for k in range(9))


MODELS = {
    "ball": f"{HEAD}{BALL}</worldbody></mujoco>",
    "arm": arm(),
    "ball and 9 boxes": f"{HEAD}{BALL}{boxes()}</worldbody></mujoco>",
}
COUPLED = "arm", "ball and 9 boxes"
"""Models of coupled steps."""
STEPS = 10
"""Steps of MuJoCo in a call of `advance`."""


class Parts:
    """Seconds in functions of a coupling while a call of `advance` runs."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            begin = time.perf_counter()
            result = function(*arguments, **options)
            self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - begin
            return result

        return run


def coupled_steps(name: str, scenes: int, threads: int, calls: int, device: str) -> dict[str, Any]:
    """Milliseconds of the parts of one step of MuJoCo and of the material."""
    grid = mpm.Grid(0.1, (0, 0, 0), (1, 1, 1), scenes=scenes)
    step = mpm.Step(grid, mpm.NeoHookean(E=2e4, nu=0.2), (0.0, 0.0, -9.81), walls="slip")
    one = mpm.State.at_rest(mpm.seed.box((0.4, 0.4, 0.0), (0.6, 0.6, 0.5), grid, per_cell=8), 1000.0, device=device)
    state = mpm.State.concatenate([one] * scenes, scene=True)
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    coupling = mpm.couple(model, step, ["body"], substeps=4, threads=threads)
    state = coupling.advance(state, STEPS)
    parts, taken, rollout = Parts(), [], coupling_module.rollout
    coupling._scenes.step = parts.timed("MuJoCo", coupling._scenes.step)
    coupling_module.rollout = parts.timed("material", rollout)
    try:
        for _ in range(calls):
            parts.seconds = {}
            begin = time.perf_counter()
            state = coupling.advance(state, STEPS)
            total = time.perf_counter() - begin
            taken.append({"total": total, **parts.seconds, "exchange": total - sum(parts.seconds.values())})
    finally:
        coupling_module.rollout = rollout
    step.check(state)
    median = sorted(taken, key=lambda call: call["total"])[len(taken) // 2]
    found = {part: seconds / STEPS * 1e3 for part, seconds in median.items()}
    return {"model": name, "scenes": scenes, "threads": threads, "particles": len(state), "ms": found}


def mujoco_steps(name: str, scenes: int, threads: int, samples: int) -> dict[str, Any]:
    """Least microseconds of `mj_step` of one scene, for each of the ways."""
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    bodies, wrenches = [model.body("body").id], np.zeros((scenes, 1, 6))
    data = [mujoco.MjData(model) for _ in range(scenes)]
    loop, native = (MujocoScenes(model, data, bodies, count) for count in (1, threads))
    for _ in range(50):
        loop.step(wrenches, derived=True)
    states, chunks = loop.states(), [data[k::threads] for k in range(threads)]

    def steps(some: list[Any]) -> None:
        for one in some:
            mujoco.mj_step(model, one)

    with ThreadPoolExecutor(threads) as executor:
        ways: dict[str, Callable[[], Any]] = {
            "mj_step": lambda: steps(data),
            "mj_step in threads of Python": lambda: list(executor.map(steps, chunks)),
            "coupling, one thread": lambda: loop.step(wrenches, derived=True),
            "coupling, threads of MuJoCo": lambda: native.step(wrenches, derived=False),
        }
        seconds: dict[str, list[float]] = {way: [] for way in ways}
        for _ in range(samples):
            for way, run in ways.items():
                loop.restore(states)
                time.sleep(0.002)  # so that the scheduler lets the threads run at once
                begin = time.perf_counter()
                run()
                seconds[way].append(time.perf_counter() - begin)
    least = {way: min(values) / scenes * 1e6 for way, values in seconds.items()}
    return {"model": name, "scenes": scenes, "threads": threads, "dofs": scenes * model.nv, "us": least}


def measure(scenes: list[int], of_mujoco: list[int], calls: int, samples: int, device: str) -> dict[str, Any]:
    threads = common.use_all_cores()
    result: dict[str, Any] = {"environment": common.environment(device), "steps": [], "coupled": []}
    result["environment"]["mujoco"], result["environment"]["cores"] = mujoco.__version__, threads
    for name in MODELS:
        for count in of_mujoco:
            result["steps"].append(mujoco_steps(name, count, max(threads, 2), samples))
            print(result["steps"][-1], flush=True)
    for name in COUPLED:
        for count in scenes:
            for used in sorted({1, min(count, threads)}):
                result["coupled"].append(coupled_steps(name, count, used, calls, device))
                print(result["coupled"][-1], flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    lines = ["# Coupling with MuJoCo", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), "", "## Coupled steps", ""]
    header = ("model", "scenes", "threads", "ms", "MuJoCo [%]", "exchange [%]", "material [%]")
    rows = [
        (run["model"], run["scenes"], run["threads"], run["ms"]["total"])
        + tuple(f"{100 * run['ms'][part] / run['ms']['total']:.0f}" for part in ("MuJoCo", "exchange", "material"))
        for run in result["coupled"]
    ]
    lines += [common.table(header, rows), "", "## Steps of MuJoCo", ""]
    ways = list(result["steps"][0]["us"])
    header = ("model", "scenes", "degrees of freedom", "threads", *(f"{way} [µs]" for way in ways))
    steps = [
        (run["model"], run["scenes"], run["dofs"], run["threads"], *(run["us"][way] for way in ways))
        for run in result["steps"]
    ]
    return "\n".join([*lines, common.table(header, steps)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="few scenes and calls, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    sizes: tuple[list[int], list[int]] = ([1, 4], [4]) if arguments.quick else ([1, 64, 512], [8, 32, 128, 512])
    calls, samples = (2, 3) if arguments.quick else (3, 150)
    result = measure(*sizes, calls, samples, arguments.device)
    name = f"coupling_{common.slug(common.device_name(arguments.device))}"
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
