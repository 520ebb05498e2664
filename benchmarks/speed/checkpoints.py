"""Memory and time of checkpoints of rollouts, and accuracy of the estimate.

    python -m benchmarks.speed.checkpoints [--device cuda]      # minutes
    python -m benchmarks.speed.checkpoints --quick              # seconds

A block of a neo-Hookean solid falls in three dimensions for some steps, and the gradient of its final position by its
velocities is computed: once with the compiled law, whose steps are computed in one op, and once with that law in torch
code, one step at a time. Memory is the peak above that before the rollout: on CUDA that of PyTorch's allocator, on the
CPU that of the tensors that ops return, which excludes the internal memory of the op of many steps. The estimate is
that of `estimate_rollout` with the same arguments, an upper bound. Budgets are shares of the memory in which no step is
recomputed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common
from . import memory

KEPT: dict[str, Any] = {
    "all steps": None,
    "every 10": mpm.Checkpoints(every=10),
    "every 10, on the host": mpm.Checkpoints(every=10, offload=True),
    "20 states": mpm.Checkpoints(states=20),
    "5 states": mpm.Checkpoints(states=5),
    "2 states": mpm.Checkpoints(states=2),
    "half of the memory": 2,
    "a fifth": 5,
    "a tenth": 10,
}
"""Checkpoints by name; a number is the share of a budget in the memory in which no step is recomputed."""
SHARES = ("half of the memory", "a fifth", "a tenth")
LEAST_STEPS = {"a fifth": 20, "a tenth": 50}
DT = 1e-4
E, NU = 1e5, 0.3


def neo_hookean(F: Tensor) -> Tensor:
    """μ (F Fᵀ − I) + λ ln J I."""
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    return mu * (F @ F.mT - eye) + lam * torch.linalg.det(F).log()[:, None, None] * eye


LAWS: dict[str, Callable[[], Any]] = {"compiled": lambda: mpm.NeoHookean(E=E, nu=NU), "torch code": lambda: neo_hookean}


def setup(law: str, cells: int, device: str) -> tuple[mpm.Step, mpm.State]:
    grid = mpm.Grid(1 / (2 * cells), (0, 0, 0), (1, 1, 1))
    points = mpm.seed.box((0.25, 0.2, 0.25), (0.75, 0.7, 0.75), grid, per_cell=8)
    state = mpm.State.at_rest(points, 1000.0, (0, -1, 0), dtype=torch.float32, device=device)
    step = mpm.Step(grid, LAWS[law](), gravity=(0, -9.8, 0), walls="separate")
    return step, step(state, DT).detach()


def case(law: str, name: str, cells: int, n: int, device: str) -> dict[str, Any]:
    step, state = setup(law, cells, device)
    kept = KEPT[name]
    if name in SHARES:
        everything = mpm.estimate_rollout(step, state, n, DT, mpm.Checkpoints(memory=1e15))
        kept = mpm.Checkpoints(memory=everything.memory / kept)
    estimate = mpm.estimate_rollout(step, state, n, DT, kept)

    def run() -> Tensor:
        v = state.v.clone().requires_grad_()
        end = mpm.rollout(step, state.replace(v=v), n, DT, kept)
        (gradient,) = torch.autograd.grad(end.x.square().sum(), v)
        return gradient

    if device == "cuda":
        taken: int | None = memory.of_cuda(run)
    else:
        taken = memory.of_returned_tensors(run) if law != "compiled" else None
    begin = time.perf_counter()
    assert bool(run().isfinite().all())  # It waits for the device.
    seconds = time.perf_counter() - begin
    return {
        "law": law, "kept": name, "particles": len(state), "memory": taken, "seconds": seconds,
        "estimated_memory": estimate.memory, "estimated_seconds": estimate.seconds, "steps": estimate.steps,
    }  # fmt: skip


def measure(cells: int, n: int, device: str) -> dict[str, Any]:
    common.use_all_cores()
    result: dict[str, Any] = {"environment": common.environment(device), "steps": n, "cases": []}
    case("torch code", "every 10", 4, 20, device)  # first calls are slow
    for law in LAWS:
        for name in KEPT:
            if n >= LEAST_STEPS.get(name, 1) and (device == "cuda" or "host" not in name):
                result["cases"].append(case(law, name, cells, n, device))
                print(result["cases"][-1], flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    lines = ["# Checkpoints of rollouts", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    lines += [f"{result['cases'][0]['particles']} particles, float32, {result['steps']} steps.", ""]
    header = ("law", "stored", "memory [MB]", "estimated", "seconds", "estimated", "steps taken")
    rows = [
        (
            c["law"],
            c["kept"],
            "" if c["memory"] is None else f"{c['memory'] / 1e6:.0f}",
            f"{c['estimated_memory'] / 1e6:.0f}",
        )
        + (c["seconds"], c["estimated_seconds"], c["steps"])
        for c in result["cases"]
    ]
    return "\n".join([*lines, common.table(header, rows)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="few particles and steps, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    large = arguments.device == "cuda"
    cells, n = (4, 12) if arguments.quick else (64, 200) if large else (16, 100)
    result = measure(cells, n, arguments.device)
    name = f"checkpoints_{common.slug(common.device_name(arguments.device))}"
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
