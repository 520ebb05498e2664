"""PPO on the tasks of `torch_mpm.envs`: returns before and after, and times.

    python -m benchmarks.envs_ppo --processes 2     # half an hour on 2 cores, without `write`
    python -m benchmarks.envs_ppo --device cuda --processes 3
    python -m benchmarks.envs_ppo --quick           # seconds

Each task is trained once by examples/learn_ppo.py, from seed 0, and tested without the noise of the training in as many
scenes that the training has not seen. A return is the sum of the rewards of an episode. The plans are the first guess
and the best one by gradients of examples/plan_tasks.py, for the scene of seed 0 alone. Tasks that are not chosen keep
their rows.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import functools
import multiprocessing
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from . import common

LARGE = ("write",)
"""Tasks that need a GPU, with millions of particles in all scenes together."""


def example() -> Any:
    """The example as a module, which imports another one."""
    folder = str(common.ROOT / "examples")
    if folder not in sys.path:
        sys.path.append(folder)
    import learn_ppo

    return learn_ppo


def measure(names: Sequence[str], quick: bool, processes: int, device: str) -> dict[str, Any]:
    """The tasks, in as many processes at a time, each with one thread; on "cuda" by all GPUs in turn."""
    gpus = torch.cuda.device_count() if device == "cuda" else 1
    with common.one_thread():
        environment = common.environment(device, gpus)
    places = [f"cuda:{k % gpus}" if device == "cuda" else device for k in range(len(names))]
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(processes, spawn) as pool:
        tasks = list(pool.map(functools.partial(measure_task, quick=quick), names, places))
    return {"environment": environment | {"processes": processes}, "tasks": tasks}


def measure_task(name: str, device: str, quick: bool) -> dict[str, Any]:
    learn = example()
    training = learn.TRAININGS[name]
    if quick:
        training = training._replace(steps=240, scenes=2, steps_per_update=40)
    with common.one_thread():
        begin = time.perf_counter()
        trained = learn.train(name, training, device=device)
        seconds = time.perf_counter() - begin
        network, first, best = learn.beside_the_plan(name, trained.policy, device)
    result = {
        "name": name,
        "commit": common.commit(),
        "training": {
            "steps": trained.steps,
            "scenes": training.scenes,
            "failed": trained.failed,
            "seconds": seconds,
        },
        "test": {
            "untrained": trained.before.returns.mean().item(),
            "trained": trained.after.returns.mean().item(),
            "deviation": trained.after.returns.std().item(),
            "success": trained.after.success.double().mean().item(),
        },
        "scene 0": {"trained": network, "first plan": first, "best plan": best},
        "curve": {
            "steps": [steps for steps, _ in trained.curve],
            "returns": [float(f"{value:.4g}") for _, value in trained.curve],
        },
    }
    print({key: result[key] for key in ("name", "training", "test", "scene 0")}, flush=True)
    return result


def with_others(tasks: list[dict[str, Any]], earlier: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Tasks, and those of earlier results that are not among them, in the order of the example."""
    known = {task["name"]: task for result in [*earlier, {"tasks": tasks}] for task in result["tasks"]}
    return [known[name] for name in example().TRAININGS if name in known]


def table(result: dict[str, Any]) -> str:
    header = (
        "task", "commit", "steps", "scenes", "untrained", "trained", "deviation", "success", "trained, scene 0",
        "first plan, scene 0", "best plan, scene 0", "failed", "time [s]",
    )  # fmt: skip
    rows = []
    for task in result["tasks"]:
        test, training = task["test"], task["training"]
        rows.append((
            *(task["name"], task["commit"][:8], training["steps"], training["scenes"]),
            *(test["untrained"], test["trained"], test["deviation"], test["success"], *task["scene 0"].values()),
            *(training["failed"], training["seconds"]),
        ))  # fmt: skip
    return common.table(header, rows)


def text(result: dict[str, Any]) -> str:
    about = (__doc__ or "").split("\n\n", 2)[2].strip()
    picture = f"![]({file_name(result)}.png)"
    parts = ["# PPO", common.describe(result["environment"]), about, table(result), picture]
    return "\n\n".join(parts)


def file_name(result: dict[str, Any]) -> str:
    return f"envs_ppo_{common.slug(result['environment']['device'])}"


def plot(result: dict[str, Any], path: Path) -> None:
    """Mean return of the episodes of the training, and those of the test, over the steps of the environment."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3 * -(-len(result["tasks"]) // 3)), layout="constrained")
    places = list(figure.subplots(-(-len(result["tasks"]) // 3), 3, squeeze=False).flat)
    for place in places[len(result["tasks"]) :]:
        place.axis("off")
    for task, place in zip(result["tasks"], places, strict=False):
        place.plot(*task["curve"].values(), color="C0", label="training")
        for key, color in (("untrained", "C7"), ("trained", "C1")):
            place.axhline(task["test"][key], color=color, linestyle="--", label=f"{key}, test")
        place.set(title=task["name"], xlabel="steps", ylabel="return")
        place.grid(alpha=0.3)
    figure.axes[0].legend(loc="lower right")
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few steps of one task, to see that it works")
    parser.add_argument("--tasks", nargs="+", choices=tuple(example().TRAININGS))
    parser.add_argument("--processes", type=int, default=1, help="tasks that are trained at a time")
    parser.add_argument("--device", default="cpu", help="of the simulations")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    large = arguments.device != "cpu"
    chosen = ["push"] if arguments.quick else [name for name in example().TRAININGS if large or name not in LARGE]
    result = measure(arguments.tasks or chosen, arguments.quick, arguments.processes, arguments.device)
    name = file_name(result)
    if arguments.tasks:
        result["tasks"] = with_others(result["tasks"], common.read(arguments.out, f"{name}.json"))
    common.write(arguments.out, name, result, text(result))
    plot(result, arguments.out / f"{name}.png")


if __name__ == "__main__":
    main()
