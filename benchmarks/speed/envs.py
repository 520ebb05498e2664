"""Steps per second of the tasks of `torch_mpm.envs`, and times of resets by mask.

    python -m benchmarks.speed.envs [--device cuda]      # a minute
    python -m benchmarks.speed.envs --quick              # seconds

Each task has random actions in many scenes, which are reset where their episodes end. A step of one scene counts as
one: 16 scenes yield 16 steps. "Step" is the wall clock of a step of all scenes, of several in a row with one wait for
the device at their end. "Reset" is that of `env.reset` for a tenth of the scenes by a mask on the device, and "reset,
device" the time of its kernels alone (CUDA events, while the device is kept busy before them).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from torch_mpm import envs

from .. import common
from .timing import Clock

STEPS, SHARE = 10, 0.1
"""Steps of a measurement, and share of the scenes that are reset."""
BUSY = 40_000_000
"""Clock cycles that keep a GPU busy for longer than the host needs for a reset, some 20 ms."""
OF_CUP = 0.014
"""Width of a cell with which the water of `Pour` has about 735 particles [m]."""
TASKS = {task.__name__: (task, {}) for task in envs.TASKS} | {"Pour, fine": (envs.Pour, {"dx": OF_CUP})}


def measure(name: str, scenes: int, clock: Clock) -> dict[str, Any]:
    """Times of a task [ms]."""
    task, options = TASKS[name]
    device = str(clock.device)
    with torch.no_grad(), clock:
        env = task(scenes, device=device, dtype=torch.float32, **options)
        env.reset(seed=0)
        generator = torch.Generator(device).manual_seed(0)
        actions = 2 * torch.rand(STEPS, scenes, task.ACTIONS, generator=generator, device=device) - 1
        mask = torch.rand(scenes, generator=generator, device=device) < SHARE

        def steps() -> None:
            for action in actions:
                env.step(action)

        def reset() -> None:
            env.reset(options={"reset_mask": mask})

        step, whole = clock.steps(steps, STEPS), clock.steps(reset, 1)
        alone = [_kernels_ms(clock, reset) for _ in range(5)] if clock.cuda else []
        failed = int(env.bodies.step.failures(env.envs.state).failed.sum())
    return {
        "task": name,
        "scenes": scenes,
        "particles": len(env.first),
        "substeps": env.substeps,
        "step": step.ms,
        "rate": scenes / step.ms * 1e3,
        "reset": whole.ms,
        "reset, device": min(alone, default=None),
        "failed": failed,
    }


def _kernels_ms(clock: Clock, run: Any) -> float:
    """Time of the kernels of a program, which are all launched before the first one begins [ms]."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    clock.synchronize()
    torch.cuda._sleep(BUSY)
    start.record(clock.stream)
    run()
    end.record(clock.stream)
    if start.query():
        raise RuntimeError("the program has waited for the device, or has launched for longer than the device was busy")
    clock.synchronize()
    return float(start.elapsed_time(end))


def text(result: dict[str, Any]) -> str:
    about = (__doc__ or "").split("\n\n", 2)[2].strip()
    header = (
        *("task", "scenes", "particles of a scene", "substeps", "step [ms]", "steps/s", "reset [ms]"),
        *("reset, device [ms]", "failed scenes"),
    )
    rows = [tuple(row.values()) for row in result["tasks"]]
    return "\n\n".join(["# Environments", common.describe(result["environment"]), about, common.table(header, rows)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="few scenes of one task, to see that it works")
    parser.add_argument("--tasks", nargs="+", choices=tuple(TASKS), default=tuple(TASKS))
    parser.add_argument("--scenes", type=int, help="number of scenes")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    scenes = arguments.scenes or (2048 if arguments.device == "cuda" else 16)
    names = ["Push"] if arguments.quick else arguments.tasks
    common.use_all_cores()
    result: dict[str, Any] = {"environment": common.environment(arguments.device), "tasks": []}
    clock = Clock(arguments.device, 3, budget=5.0)
    for name in names:
        result["tasks"].append(measure(name, 2 if arguments.quick else scenes, clock))
        print(result["tasks"][-1], flush=True)
        common.release_memory()
    common.write(arguments.out, f"envs_{common.slug(common.device_name(arguments.device))}", result, text(result))


if __name__ == "__main__":
    main()
