"""Time and memory of gradients through rollouts: checkpoints, a peer in plain torch, networks compiled and captured.

    python -m benchmarks.speed.training [--device cuda]      # minutes
    python -m benchmarks.speed.training --quick              # seconds

Rollouts: the neo-Hookean cube of `benchmarks/speed/work.py`, float32, one call of `torch_mpm.rollout` without
gradients, and with the gradient of its end by the velocities at its start. The op of many steps takes them again in the
backward pass in any case; what is held at a time differs.

Peer: the same cube with a fixed corotated law and forces by the gradient of the B-splines, in a rollout, in a script
for MPM-PyTorch whose import names `torch_mpm.compat`, and by that project's algorithm
(`benchmarks/speed/training_peer.py`). Checkpoints of scripts are those of torch around every step.

Networks: a network is the law of a step; some steps in a row, one by one, compiled, and as one CUDA graph.

Memory is the peak above that before: on CUDA that of PyTorch's allocator, on the CPU resident memory above that before
the first case.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.compat import mpm_pytorch

from .. import common, regressions
from . import memory, network_steps, work
from .rollouts import seconds
from .step import Setup, setup
from .training_peer import DenseSolver, Particles, steps

ROLLOUT = {"cpu": (22, 50), "cuda": (46, 1000)}
"""Particles along a side of the cube, and steps."""
PEER = {"cpu": (22, 20, 20), "cuda": (46, 1000, 100)}
"""Particles along a side, steps, and steps of which a script keeps all in a second row."""
NETWORK = {"cpu": (2048, 32768), "cuda": (2048, 32768)}
"""Particles."""
E, NU = work.MU * (3 * work.LAM + 2 * work.MU) / (work.LAM + work.MU), work.LAM / (2 * (work.LAM + work.MU))

Forward = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Velocities at the start -> positions and velocities at the end."""


# ---- one rollout or script


class Meter:
    """Time and memory of forward and backward passes on a device."""

    def __init__(self, device: str, samples: int) -> None:
        self.device, self.samples = device, samples
        self._resident = memory.Resident() if device == "cpu" and memory.Resident.available else None

    def peak(self, program: Callable[[], object]) -> int | None:
        """Memory of a program [bytes], or None where the system does not tell."""
        if self.device == "cuda":
            return memory.of_cuda(program)
        return None if self._resident is None else self._resident.peak(program)

    def row(self, forward: Forward, v: Tensor) -> dict[str, Any]:
        """Least times [s] and the memory [bytes] of a forward pass without gradients and of both passes; None for what
        does not fit into the memory of the device."""

        def alone() -> None:
            with torch.no_grad():
                forward(v)

        def both() -> None:
            start = v.clone().requires_grad_()
            x, speed = forward(start)
            torch.autograd.grad(x.square().sum() + speed.square().sum(), start)

        row: dict[str, Any] = {"forward": None, "both": None, "memory": None}
        try:
            alone()
            row["forward"] = min(seconds(self.device, alone) for _ in range(self.samples))
            row["memory"] = self.peak(both)
            row["both"] = min(seconds(self.device, both) for _ in range(self.samples))
        except torch.OutOfMemoryError as error:
            print(str(error).splitlines()[0])
            row["memory"] = None
        gc.collect()  # of the graph that an error has left
        return row


def with_room(s: Setup, law: mpm.Material, **options: Any) -> Setup:
    """The work with another law, on a grid whose pool has room for all steps, so that a call takes any number."""
    wanted = s.grid.activate(s.state.x).wanted
    grid = mpm.Grid(s.grid.dx, s.grid.lower, s.grid.upper, max_blocks=2 * wanted)
    step = mpm.Step(grid, law, gravity=s.step.gravity, **options)
    state = s.state.sorted(grid)
    return Setup(step.prepare(state), step)


def rolled(s: Setup, n: int, checkpoint: int | None = None) -> Forward:
    def forward(v: Tensor) -> tuple[Tensor, Tensor]:
        end = mpm.rollout(s.step, s.state.replace(v=v), n, work.DT, checkpoint)
        return end.x, end.v

    return forward


def rollouts(side: int, n: int, meter: Meter) -> Iterator[dict[str, Any]]:
    """What is held at a time."""
    s = with_room(setup(work.make(side), meter.device), mpm.NeoHookean(mu=work.MU, lam=work.LAM), walls="sticky")
    for name, checkpoint in (("by default", None), ("32 steps", 32), ("all steps", n)):
        yield {"held": name, "particles": len(s.state), "steps": n, **meter.row(rolled(s, n, checkpoint), s.state.v)}


# ---- beside the peer


def start_of(s: Setup) -> Particles:
    assert s.state.C is not None and s.state.F is not None
    return s.state.x, s.state.v, s.state.C.contiguous(), s.state.F.contiguous()


def corotated(w: work.Work, device: str, dtype: torch.dtype = torch.float32) -> Setup:
    """The work of the peer."""
    law = mpm.FixedCorotated(mu=work.MU, lam=work.LAM)
    return with_room(setup(w, device, dtype), law, stress_form="gradient")


def dense(w: work.Work, s: Setup) -> Callable[..., Particles]:
    return DenseSolver(w.n, w.mass, w.volume, work.MU, work.LAM, (0, -work.GRAVITY, 0), work.DT, s.state.x)


def migrated(w: work.Work, s: Setup) -> Callable[..., Particles]:
    """A step of a script for MPM-PyTorch."""
    x = s.state.x
    edge = (w.particles * w.volume) ** (1 / 3)
    solver = mpm_pytorch.MPMSolver(
        x, work.DENSITY, w.n, work.DT, (0.0, -work.GRAVITY, 0.0), size=(edge,) * 3, device=x.device
    )
    elasticity = mpm_pytorch.constitutive_models.CorotatedElasticity(E, NU).to(x.device)

    def step(x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> Particles:
        return solver(x, v, C, F, elasticity(F))

    return step


SCRIPTS: dict[str, Callable[[work.Work, Setup], Callable[..., Particles]]] = {
    "script, torch_mpm.compat": migrated,
    "script, MPM-PyTorch's algorithm": dense,
}


def scripted(step: Callable[..., Particles], s: Setup, n: int, checkpoints: bool) -> Forward:
    def forward(v: Tensor) -> tuple[Tensor, Tensor]:
        x, _, C, F = start_of(s)
        end = steps(step, (x, v, C, F), n, checkpoints and torch.is_grad_enabled())
        return end[0], end[1]

    return forward


def disagreement(w: work.Work, device: str, n: int) -> dict[str, float]:
    """Largest difference of positions from those of the rollout after some steps, over their largest way; in float64,
    of which the way is more than rounding."""
    s = corotated(w, device, torch.float64)
    with torch.no_grad():
        x, _ = rolled(s, n)(s.state.v)
        way = (x - s.state.x).abs().max()
        ends = {name: scripted(make(w, s), s, n, False)(s.state.v)[0] for name, make in SCRIPTS.items()}
    return {name: float((end - x).abs().max() / way) for name, end in ends.items()}


def beside_peer(side: int, n: int, kept: int, meter: Meter) -> Iterator[dict[str, Any]]:
    w = work.make(side)
    s = corotated(w, meter.device)
    about = {"particles": w.particles, "steps": n}
    yield {"name": "rollout", "kept": "by default", **about, **meter.row(rolled(s, n), s.state.v)}
    for name, make in SCRIPTS.items():
        step = make(w, s)
        yield {"name": name, "kept": "checkpoints", **about, **meter.row(scripted(step, s, n, True), s.state.v)}
        for count in dict.fromkeys((n, kept)):
            row = meter.row(scripted(step, s, count, False), s.state.v)
            yield {"name": name, "kept": "all steps", **about, "steps": count, **row}


# ---- the program


def warm_up(device: str) -> None:
    """First calls import what they need, for seconds and with memory."""
    w = work.make(4)
    s = corotated(w, device)
    x, _ = scripted(dense(w, s), s, 1, True)(s.state.v.clone().requires_grad_())
    x.sum().backward()


def measure(device: str, quick: bool = False) -> dict[str, Any]:
    common.use_all_cores()
    warm_up(device)
    meter = Meter(device, 1 if quick else 3)
    result: dict[str, Any] = {"environment": common.environment(device), "rollouts": [], "peer": [], "networks": []}
    side, n = (6, 10) if quick else ROLLOUT[device]
    for row in rollouts(side, n, meter):
        result["rollouts"].append(row)
        print(row, flush=True)
    side, n, kept = (8, 4, 2) if quick else PEER[device]
    w = work.make(side)
    result["disagreement"] = disagreement(w, device, 4 if quick else 20)
    assert max(result["disagreement"].values()) < 1e-6, f"this is not the same physics: {result['disagreement']}"
    for row in beside_peer(side, n, kept, meter):
        result["peer"].append(row)
        print(row, flush=True)
    for particles in (64,) if quick else NETWORK[device]:
        for row in network_steps.rows(particles, device, meter.samples, "aot_eager" if quick else "inductor"):
            result["networks"].append(row)
            print(row, flush=True)
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
        r["held"], r["particles"], r["steps"], r["forward"], r["both"], _ratio(r["both"], r["forward"]),
        _scaled(r["memory"], 1e-9),
    )  # fmt: skip


BESIDE = (
    "", "kept", "particles", "steps", "forward, ms a step", "forward and backward, ms a step", "times",
    "memory, MB a step", "times",
)  # fmt: skip


def rows_of_peer(result: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    """Those of a result, with multiples of the time and the memory of the first."""
    first = result["peer"][0]
    for r in result["peer"]:
        both, own = _ratio(r["both"], r["steps"]), _ratio(first["both"], first["steps"])
        taken, least = _ratio(r["memory"], r["steps"]), _ratio(first["memory"], first["steps"])
        yield (
            r["name"], r["kept"], r["particles"], r["steps"], _scaled(r["forward"], 1e3 / r["steps"]),
            "does not fit" if both is None else 1e3 * both, _times(both, own),
            "does not fit" if both is None else _scaled(taken, 1e-6), _times(taken, least),
        )  # fmt: skip


def _times(value: float | None, base: float | None) -> str | None:
    ratio = _ratio(value, base)
    return None if ratio is None else f"{ratio:.3g}x"


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Training", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    lines += [common.table(HELD, [row_of_rollout(r) for r in result["rollouts"]]), ""]
    worst = max(result["disagreement"].values())
    lines += [common.table(BESIDE, rows_of_peer(result)), ""]
    lines += [
        f"Positions of the scripts differ from those of the rollout by at most {worst:.1e} of the way, in float64.",
        "",
    ]
    return "\n".join([*lines, network_steps.text(result["networks"])])


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Seconds, for `regressions`."""
    for r in result["rollouts"]:
        if r["both"] is not None:
            yield f"{r['held']}, forward and backward", r["both"]
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
