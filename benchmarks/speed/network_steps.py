"""Steps with a network as their law: one by one, compiled, and from CUDA graphs. Part of `training`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

import torch_mpm as mpm

from .. import common
from .rollouts import least

DX, DT, STEPS = 1 / 32, 1e-4, 8
"""Node distance [m], time step [s], and number of consecutive steps."""
WIDTH = 64
"""Width of the layers of the network."""

Advance = Callable[[mpm.State], mpm.State]


class Law(nn.Module):
    """F [P, 3, 3] -> Kirchhoff stress F S Fᵀ [Pa], with S computed by a network from the strain."""

    def __init__(self) -> None:
        super().__init__()
        hidden = nn.Linear(9, WIDTH), nn.GELU(), nn.Linear(WIDTH, WIDTH), nn.GELU()
        self.layers = nn.Sequential(*hidden, nn.Linear(WIDTH, 9))

    def forward(self, F: Tensor) -> Tensor:
        strain = 0.5 * (F.mT @ F - torch.eye(3, dtype=F.dtype, device=F.device))
        S = 1e5 * strain + 1e3 * self.layers(strain.flatten(1)).view_as(F)
        return F @ (0.5 * (S + S.mT)) @ F.mT


def setup(cells: Sequence[int], device: str) -> tuple[mpm.Step, mpm.State]:
    """A block with a number of cells along its edges, 8 particles in each, and a smooth velocity with a gradient."""
    grid = mpm.Grid(DX, (0, 0, 0), (1, 1, 1), max_blocks=9**3)
    points = mpm.seed.box((8 * DX,) * 3, tuple((8 + count) * DX for count in cells), grid, per_cell=8)
    torch.manual_seed(0)
    step = mpm.Step(grid, Law(), gravity=(0, -9.8, 0), walls="separate").to(device)
    state = mpm.State.at_rest(points, 1000.0, torch.sin(9 * points.x), dtype=torch.float32, device=device)
    with torch.no_grad():
        state = mpm.rollout(step, step.prepare(state), STEPS, DT)
    return step, state.replace(v=state.v.clone().requires_grad_())


def eager(step: nn.Module) -> Advance:
    return lambda state: mpm.rollout(step, state, STEPS, DT)


def gradients(advance: Advance, step: nn.Module, state: mpm.State) -> list[Tensor]:
    """Final state, and its gradient by velocities and weights."""
    end = advance(state)
    found = torch.autograd.grad(end.x.square().sum() + end.v.square().sum(), [state.v, *step.parameters()])
    return [end.x.detach(), end.v.detach(), *found]


def error(values: Sequence[Tensor], reference: Sequence[Tensor]) -> float:
    """The largest error of a tensor over its largest entry."""
    return max(float((a - b).abs().max() / b.abs().max()) for a, b in zip(values, reference, strict=True))


def rows(cells: Sequence[int], device: str, samples: int, backend: str) -> Iterator[dict[str, Any]]:
    """For each way to compute the steps: start-up time, minimum times of the forward pass without gradients and of both
    passes [s], and difference from steps one by one.
    """
    step, state = setup(cells, device)
    ways: dict[str, Callable[[], Advance]] = {"step by step": lambda: eager(step)}
    ways[f"torch.compile, {backend}"] = lambda: eager(_compiled(step, backend))
    if device == "cuda":
        ways["captured"] = lambda: mpm.make_graphed_step(step, state, DT, STEPS)
        ways["rollout(graph=4)"] = lambda: lambda state: mpm.rollout(step, state, STEPS, DT, graph=STEPS // 2)
    reference = gradients(eager(step), step, state)
    for name, make in ways.items():
        row: dict[str, Any] = {"name": name, "particles": len(state), "steps": STEPS}
        try:
            yield row | _measured(make, step, state, device, samples, reference)
        except Exception as failure:  # Of a missing compiler, for example.
            yield row | {"failure": f"{type(failure).__name__}: {str(failure).strip().splitlines()[0]}"}


def _compiled(step: nn.Module, backend: str) -> nn.Module:
    torch.compiler.reset()
    compiled: nn.Module = torch.compile(step, fullgraph=True, backend=backend)  # type: ignore[assignment]
    return compiled


def _measured(
    make: Callable[[], Advance], step: nn.Module, state: mpm.State, device: str, samples: int, reference: list[Tensor]
) -> dict[str, Any]:
    begin = time.perf_counter()
    advance = make()

    def both() -> list[Tensor]:
        return gradients(advance, step, state)

    def forward() -> None:
        with torch.no_grad():
            advance(state)

    found = both()
    forward()
    started = time.perf_counter() - begin
    times = {name: least(device, run, samples) for name, run in (("forward", forward), ("both", both))}
    return {"begins": started, **times, "error": error(found, reference)}


HEADER = (
    "steps with a network", "particles", "begins after, s", "forward, us a step", "times",
    "forward and backward, us a step", "times", "largest relative error",
)  # fmt: skip


def table_rows(networks: Sequence[dict[str, Any]]) -> Iterator[tuple[Any, ...]]:
    """Times as multiples of those of steps one by one."""
    first = {r["particles"]: r for r in networks if r["name"] == "step by step"}
    for r in networks:
        if "failure" in r:
            yield r["name"], r["particles"], *[None] * 5, r["failure"]
            continue
        cells: list[Any] = [r["name"], r["particles"], r["begins"]]
        for key in ("forward", "both"):
            cells += [1e6 * r[key] / r["steps"], f"{first[r['particles']][key] / r[key]:.3g}x"]
        yield *cells, r["error"]


def text(networks: Sequence[dict[str, Any]]) -> str:
    return common.table(HEADER, table_rows(networks))


def timed(networks: Sequence[dict[str, Any]]) -> Iterator[tuple[str, float]]:
    for r in networks:
        if "failure" not in r:
            yield f"{r['name']}, {r['particles']} particles", r["both"]
