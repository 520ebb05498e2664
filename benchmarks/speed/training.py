"""Time and memory of gradients through rollouts: checkpoints, peers, networks compiled and captured.

    python -m benchmarks.speed.training [--device cuda]      # minutes
    python -m benchmarks.speed.training --quick              # seconds

Rollouts: the neo-Hookean cube of `benchmarks/speed/work.py`, float32, one call of `torch_mpm.rollout` without
gradients, and with the gradient of its end by the velocities at its start. The op of many steps recomputes them in the
backward pass, some at a time, unless the forward pass has stored everything.

Peers: the same cube with a fixed corotated law, in a rollout, in a script of another project whose import names
`torch_mpm.compat`, and by that project's algorithm: that of MPM-PyTorch in plain torch
(`benchmarks/speed/training_peer.py`), that of NCLaw by kernels of Warp inside an autograd Function
(`benchmarks/speed/training_peer_warp.py`), and that of PhysGaussian by kernels of Warp, without gradients
(`benchmarks/speed/inference_peer_warp.py`), where Warp is installed. Checkpoints are those of torch around every step.

Networks: a network is the law of a step; some steps in a row, one by one, compiled, and as one CUDA graph.

Memory is the peak above that before both passes, or before a forward pass alone: on CUDA that of PyTorch's allocator,
on the CPU resident memory, in a process for each case.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import functools
import gc
import multiprocessing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common, regressions
from . import memory, network_steps, work
from .rollouts import least
from .step import Setup, setup
from .training_scripts import PROJECTS, Make, Project

ROLLOUT = {"cpu": (22, 50), "cuda": (46, 1000)}
"""Particles along a side of the cube, and steps."""
PEER = {"cpu": (22, 20, 20), "cuda": (46, 1000, 100)}
"""Particles along a side, steps of rollouts, and of scripts."""
EVERYTHING = mpm.Checkpoints(memory=1e11)
NETWORKS = ((8, 8, 4), (16, 16, 16))
"""Cells along the edges of the block, of 8 particles each."""
AGREEMENT = {torch.float32: 1e-4, torch.float64: 1e-7}
"""Relative tolerance of velocities after 20 steps; scripts store the logarithm of E in float32."""

Forward = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Velocities at the start -> positions and velocities at the end."""


# ---- the work


def with_room(s: Setup, law: mpm.Material, **options: Any) -> Setup:
    """The work with another law, on a grid with a pool for all steps, so that a call computes any number of them."""
    wanted = s.grid.activate(s.state.x).wanted
    grid = mpm.Grid(s.grid.dx, s.grid.lower, s.grid.upper, max_blocks=2 * wanted)
    step = mpm.Step(grid, law, gravity=s.step.gravity, **options)
    return Setup(step.prepare(s.state.sorted(grid)), step)


def elastic(w: work.Work, device: str) -> Setup:
    return with_room(setup(w, device), mpm.NeoHookean(mu=work.MU, lam=work.LAM), walls="sticky")


def corotated(project: Project, w: work.Work, device: str, dtype: torch.dtype = torch.float32) -> Setup:
    """Work of a project."""
    law = mpm.FixedCorotated(mu=work.MU, lam=work.LAM)
    return with_room(setup(w, device, dtype), law, stress_form=project.stress_form)


def rolled(s: Setup, n: int, checkpoint: int | mpm.Checkpoints | None = None) -> Forward:
    def forward(v: Tensor) -> tuple[Tensor, Tensor]:
        end = mpm.rollout(s.step, s.state.replace(v=v), n, work.DT, checkpoint)
        return end.x, end.v

    return forward


def scripted(make: Make, w: work.Work, s: Setup, n: int, checkpoints: bool) -> Forward:
    assert s.state.C is not None and s.state.F is not None
    x, C, F = s.state.x, s.state.C.contiguous(), s.state.F.contiguous()
    run = make(w, x)

    def forward(v: Tensor) -> tuple[Tensor, Tensor]:
        end = run((x, v, C, F), n, checkpoints and torch.is_grad_enabled())
        return end[0], end[1]

    return forward


def disagreement(project: Project, w: work.Work, device: str, n: int) -> dict[str, float]:
    """Largest difference of velocities from those of the rollout after some steps, over the largest velocity."""
    s = corotated(project, w, device, project.precision)
    with torch.no_grad():
        _, v = rolled(s, n)(s.state.v)
        ends = {name: scripted(make, w, s, n, False)(s.state.v)[1] for name, make in project.scripts().items()}
    return {name: float((end - v).abs().max() / v.abs().max()) for name, end in ends.items()}


# ---- time and memory


@dataclasses.dataclass(frozen=True)
class Case:
    """A rollout of the neo-Hookean cube, or a program that does the work of a project; and its stored steps."""

    name: str
    kept: str
    side: int
    steps: int
    checkpoint: int | mpm.Checkpoints | None = None
    project: str | None = None

    def program(self, device: str) -> tuple[Forward, Tensor]:
        """Forward pass, and initial velocities."""
        w = work.make(self.side)
        s = elastic(w, device) if self.project is None else corotated(PROJECTS[self.project], w, device)
        scripts = {} if self.project is None else PROJECTS[self.project].scripts()
        if self.name in scripts:
            return scripted(scripts[self.name], w, s, self.steps, self.checkpoint is not None), s.state.v
        return rolled(s, self.steps, self.checkpoint), s.state.v

    def work(self) -> Callable[[Forward, Tensor], None]:
        """Both passes, or the forward pass of a project without gradients."""
        return both if self.project is None or PROJECTS[self.project].gradients else alone


def rollout_cases(side: int, n: int) -> list[Case]:
    held = {"by default": None, "32 steps": 32, "all steps": n, "everything, none again": EVERYTHING}
    return [Case("rollout", name, side, n, checkpoint) for name, checkpoint in held.items()]


def peer_cases(side: int, n: int, of_script: int) -> Iterator[Case]:
    for key, project in PROJECTS.items():
        yield Case("rollout", "by default" if project.gradients else "nothing", side, n, project=key)
        if project.gradients:
            yield Case("rollout", "everything", side, n, EVERYTHING, key)
        for name in project.scripts():
            if project.checkpoints:
                yield Case(name, "checkpoints", side, of_script, 1, key)
            yield Case(name, "all steps" if project.gradients else "nothing", side, of_script, project=key)


def both(forward: Forward, v: Tensor) -> None:
    start = v.clone().requires_grad_()
    x, speed = forward(start)
    torch.autograd.grad(x.square().sum() + speed.square().sum(), start)


def alone(forward: Forward, v: Tensor) -> None:
    with torch.no_grad():
        forward(v)


def measured(case: Case, device: str, samples: int, with_memory: bool = True) -> dict[str, Any]:
    """Minimum times [s] of a forward pass without gradients and of both passes, and the memory [bytes]; None for passes
    that a project lacks or that exceed the memory of the device.
    """
    about = {"project": case.project, "name": case.name, "kept": case.kept}
    row: dict[str, Any] = {**about, "particles": case.side**3, "steps": case.steps}
    row |= {"forward": None, "both": None, "memory": None, "fits": True}
    program, work = case.program(device), case.work()
    try:
        for key, passes in {"forward": alone, "both": both}.items():
            if passes is alone or work is both:
                passes(*program)
                row[key] = least(device, functools.partial(passes, *program), samples)
        if with_memory:
            row["memory"] = memory.of_cuda(lambda: work(*program)) if device == "cuda" else resident(case)
    except torch.OutOfMemoryError as error:
        print(str(error).splitlines()[0])
        row["fits"] = False
    gc.collect()  # Of the graph of a failed pass.
    return row


def resident(case: Case) -> int | None:
    """Resident memory of a case on the CPU in a separate process, where allocators retain nothing of others."""
    if not memory.Resident.available:
        return None
    with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_resident, case).result()


def _resident(case: Case) -> int:
    common.use_all_cores()
    case.work()(*dataclasses.replace(case, side=4, steps=1).program("cpu"))  # First calls import modules.
    program = case.program("cpu")
    return memory.Resident().peak(lambda: case.work()(*program))


# ---- the program


def measure(device: str, quick: bool = False) -> dict[str, Any]:
    common.use_all_cores()
    samples, with_memory = (1, device == "cuda") if quick else (3, True)
    result: dict[str, Any] = {"environment": common.environment(device)}
    cases = {
        "rollouts": rollout_cases(*((6, 10) if quick else ROLLOUT[device])),
        "peers": list(peer_cases(*((8, 4, 2) if quick else PEER[device]))),
    }
    w = work.make(cases["peers"][0].side)
    result["disagreement"] = {key: disagreement(project, w, device, 20) for key, project in PROJECTS.items()}
    for key, found in result["disagreement"].items():
        assert max(found.values()) < AGREEMENT[PROJECTS[key].precision], f"{key} is not the same physics: {found}"
    for part, of_part in cases.items():
        result[part] = [measured(case, device, samples, with_memory) for case in of_part]
    backend = "aot_eager" if quick else "inductor"
    result["networks"] = [
        row
        for cells in (((2, 2, 2),) if quick else NETWORKS)
        for row in network_steps.rows(cells, device, samples, backend)
    ]
    return result


def _ratio(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a / b


def _scaled(value: float | None, by: float) -> float | None:
    return None if value is None else value * by


HELD = (
    "held at a time", "particles", "steps", "forward, s", "forward and backward, s", "over forward", "memory, GB",
)  # fmt: skip


def row_of_rollout(r: dict[str, Any]) -> tuple[Any, ...]:
    return (
        r["kept"], r["particles"], r["steps"], r["forward"], r["both"], _ratio(r["both"], r["forward"]),
        _scaled(r["memory"], 1e-9),
    )  # fmt: skip


BESIDE = (
    "work of", "program", "stored", "particles", "steps", "forward, ms a step", "times",
    "forward and backward, ms a step", "times", "memory, MB", "times, a step",
)  # fmt: skip


def rows_of_peers(result: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    """Rows of a result with the ratios of times and memory per step to those of the rollout of the same work."""
    for r in result["peers"]:
        own = next(o for o in result["peers"] if (o["project"], o["name"]) == (r["project"], "rollout"))
        cells: list[Any] = [r["project"], r["name"], r["kept"], r["particles"], r["steps"]]
        for key, unit in (("forward", 1e3), ("both", 1e3), ("memory", 1e-6)):
            value, base = (_ratio(row[key], row["steps"]) for row in (r, own))
            shown = _scaled(r[key] if key == "memory" else value, unit)
            cells += [shown if r["fits"] or value else "does not fit", _times(value, base)]
        yield tuple(cells)


def _times(value: float | None, base: float | None) -> str | None:
    ratio = _ratio(value, base)
    return None if ratio is None else f"{ratio:.3g}x"


def agreement(result: dict[str, Any]) -> str:
    """Differences of the programs from the rollout."""
    return "; ".join(f"{key} {max(found.values()):.1e}" for key, found in result["disagreement"].items())


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Training", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    lines += [common.table(HELD, [row_of_rollout(r) for r in result["rollouts"]]), ""]
    lines += [common.table(BESIDE, rows_of_peers(result)), ""]
    lines += [
        f"Largest differences of velocities from those of the rollout, over the largest: {agreement(result)}.",
        "",
    ]
    return "\n".join([*lines, network_steps.text(result["networks"])])


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Seconds, for `regressions`."""
    for r in result["rollouts"]:
        if r["both"] is not None:
            yield f"{r['kept']}, forward and backward", r["both"]
    yield from network_steps.timed(result["networks"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="few particles and steps, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    result = measure(arguments.device, arguments.quick)
    print(text(result))
    name = f"training_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
