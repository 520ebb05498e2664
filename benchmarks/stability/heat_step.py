"""One whole heat step as a linear map of the particles: `python -m benchmarks.stability.heat_step [--quick] [--out F]`.

Transfer to the nodes, solve, transfer back, for every unit vector of temperatures θ_p and gradients g_p, each in a
separate scene. The spectral radius ρ of this map must not exceed 1, nor must its norm with the energy Σ_p m_p C_p (θ_p²
+ D |g_p|²), which bounds all of its powers. Nodes are solved by a singular value decomposition, exact to rounding for
any contrast, so that only the method matters; a test compares it with the library's solve.

Particles on a lattice, random or Poisson-disc, 1 to 16 per cell, in 3 × 3 cells (2 × 2 for 16 per cell, 2 × 2 × 2 in
3-D). κ or ρ C jumps by the contrast, at a plane through the middle or from particle to particle at random;
r = dt κ/(ρ C dx²) is the largest diffusion number of a particle. Insulated, nodes held on one side, or exchange with an
ambient by the free surface. These take turns; every r meets every contrast with every layout, kernel and transfer.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.heat.boundaries import Convection, Fixed, FreeSurface, HeatNodes

from .. import common
from ..heat_matrix import node_gradients

TRANSFERS = ("hybrid", "apic", "flip", "pic")
NUMBERS = (1e-3, 0.05, 1.0, 1e3, 1e6)
CONTRASTS = (1.0, 10.0, 1e2, 1e4, 1e8)
BOUNDARIES = ("insulated", "held", "exchange")
BODIES = (
    *itertools.product((2,), ("quadratic", "cubic"), ("lattice", "random", "poisson"), (1, 4, 16)),
    *itertools.product((3,), ("quadratic", "cubic"), ("lattice", "random", "poisson"), (1, 8)),
)
BODY = ("dim", "kernel", "layout", "per_cell")
"""Fields of a case that define a body."""
VARIANTS = tuple(itertools.product(("conductivity", "capacity"), ("plane", "random"), BOUNDARIES))
"""Jumping parameter, place of the jump, and boundary."""
LARGE_CONTRASTS = (1e2, 1e8)
"""Contrasts of the largest bodies, which take a second each."""
LIMIT = 1e-12
"""Rounding error allowed for ρ above 1."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One step; `jump` is "conductivity" or "capacity", `at` "plane" or "random"."""

    dim: int
    kernel: str
    layout: str
    per_cell: int
    transfer: str
    number: float = 1.0
    contrast: float = 1.0
    jump: str = "conductivity"
    at: str = "plane"
    boundary: str = "insulated"


class Exact(mpm.Heat):
    """Heat in scenes that differ in their temperatures only, nodes solved to rounding.

    With W Wᵀ = dt M^(−1/2) (H + X) M^(−1/2) and W = U σ Vᵀ, the increment is −M^(−1/2) U σ²/(1 + σ²) Uᵀ M^(1/2) θ: no
    step away from θ is longer than θ, for any rounding of W.
    """

    def _solve(self, nodes: HeatNodes, dt: float | Tensor) -> Tensor:
        blocks, particles = nodes.blocks, nodes.state.scene == 0
        dense = blocks.to_dense(nodes.theta[:, None])
        scenes, *lattice, _ = dense.shape

        def by_site(values: Tensor) -> Tensor:
            return blocks.to_dense(values.to(dense)[:, None]).reshape(scenes, -1)

        sites = torch.arange(dense[0].numel()).reshape(1, *lattice, 1).expand(dense.shape)
        site = blocks.from_dense(sites)[:, 0]  # of each row
        rows, gradients = (values[particles] for values in node_gradients(blocks, nodes.state.x))
        P, S, D = gradients.shape
        gradient = dense.new_zeros(P, D, dense[0].numel())
        gradient.scatter_add_(2, site[rows][:, None].expand(P, D, S), gradients.mT)
        W = (dt * nodes.conductance[particles]).sqrt()[:, None, None] * gradient
        W = W.flatten(0, 1)
        if nodes.exchange is not None:
            W = torch.cat([W, torch.diag((dt * by_site(nodes.exchange)[0]).sqrt())])
        free = nodes.heat_capacity > 0
        if nodes.fixed is not None:
            free &= ~nodes.fixed
        solved = by_site(free)[0].nonzero()[:, 0]
        root = by_site(nodes.heat_capacity)[0, solved].sqrt()
        _, sigma, V = torch.linalg.svd(W[:, solved] / root, full_matrices=False)
        decay = V.T * (sigma**2 / (1 + sigma**2)) @ V
        after = by_site(torch.where(free, nodes.theta, 0))
        after[:, solved] -= (after[:, solved] * root) @ decay / root
        return blocks.from_dense(after.reshape(dense.shape))[:, 0] - nodes.theta


def positions(case: Case, dx: float) -> tuple[Tensor, int]:
    """Particles [P, D] of a body that is not aligned with the lattice, and its cells along an axis."""
    cells = 3 if case.dim == 2 and case.per_cell < 16 else 2
    lower, upper = (0.0,) * case.dim, (cells * dx,) * case.dim
    if case.layout == "random":
        generator = torch.Generator().manual_seed(case.per_cell)
        x = cells * dx * torch.rand(case.per_cell * cells**case.dim, case.dim, generator=generator, dtype=torch.float64)
    else:
        method = case.layout
        x = mpm.seed.box(lower, upper, dx, per_cell=case.per_cell, method=method, dtype=torch.float64).x
    return x + 0.37 * dx, cells


def boundary(case: Case, dx: float) -> list[Any]:
    """Held nodes at one side, or exchange at the same rate as conduction across a cell."""
    if case.boundary == "held":
        return [Fixed(mpm.Plane((dx,) * case.dim, (1.0,) + (0.0,) * (case.dim - 1)), 0.0)]
    return [Convection(FreeSurface(), 1 / dx, 0.0)] if case.boundary == "exchange" else []


def matrix(case: Case, kind: Callable[..., mpm.Heat] = Exact) -> Tensor:
    """The step in units in which the energy of its vectors is their norm: of θ_p √(m C) and g_p √(m C D)."""
    dx = 0.1
    x, cells = positions(case, dx)
    P, D = x.shape
    generator = torch.Generator().manual_seed(1)
    share = torch.rand(P, generator=generator, dtype=torch.float64)
    if case.at == "plane":
        share = (x[:, 0] < x[:, 0].mean()).double()
    jump = case.contrast ** (share - 1)  # of the largest
    ones = torch.ones_like(jump)
    kappa, capacity = (jump, ones) if case.jump == "conductivity" else (ones, jump)
    affine = case.transfer in ("hybrid", "apic")
    B = P * (1 + D) if affine else P
    grid = mpm.Grid(dx, (-0.2,) * D, (0.6,) * D, kernel=case.kernel, scenes=B)
    dt = case.number * dx**2 / float((kappa / capacity).max())
    heat = kind(grid, kappa.repeat(B), capacity.repeat(B), boundary(case, dx), transfer=case.transfer)
    volume = torch.full((P,), (cells * dx) ** D / P, dtype=torch.float64)
    norm = (capacity * volume).sqrt()
    if affine:
        norm = torch.cat([norm, (norm[:, None] / grid.inverse_inertia**0.5).expand(P, D).reshape(-1)])
    unit = torch.diag(1 / norm)
    state = mpm.State(
        x=x.repeat(B, 1), v=torch.zeros(B * P, D, dtype=torch.float64), mass=volume.repeat(B), volume=volume.repeat(B),
        scene=torch.arange(B, dtype=torch.int32).repeat_interleave(P), temperature=unit[:, :P].reshape(-1),
        extra={"temperature_gradient": unit[:, P:].reshape(-1, D)} if affine else {},
    )  # fmt: skip
    with torch.no_grad():
        end = heat(state, dt)
    assert end.temperature is not None
    columns = [end.temperature.reshape(B, P)]
    if affine:
        columns.append(end.extra["temperature_gradient"].reshape(B, P * D))
    return torch.cat(columns, 1).T * norm[:, None]


def measure(case: Case) -> dict[str, Any]:
    """Spectral radius and norm of a step, both minus 1."""
    A = matrix(case)
    radius = torch.linalg.eigvals(A).abs().max()
    return {**dataclasses.asdict(case), "radius": float(radius) - 1, "norm": float(torch.linalg.matrix_norm(A, 2)) - 1}


def cases(quick: bool) -> Iterator[Case]:
    """All cases of the table, or those of one body."""
    bodies = ((2, "quadratic", "random", 4),) if quick else BODIES
    for turn, (body, transfer) in enumerate(itertools.product(bodies, TRANSFERS)):
        large = body[0] == 3 and body[3] == 8
        pairs = itertools.product(NUMBERS, LARGE_CONTRASTS if large else CONTRASTS)
        for k, (number, contrast) in enumerate(pairs):
            yield Case(*body, transfer, number, contrast, *VARIANTS[(k + turn) % len(VARIANTS)])


def excess(row: dict[str, Any]) -> float:
    """The larger of ρ − 1 and norm − 1."""
    return max(row["radius"], row["norm"])


def summary(rows: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Number of cases, and the worst of each body and transfer and of each transfer and diffusion number."""
    rows = list(rows)
    worst: dict[tuple[Any, ...], int] = {}
    for k, row in enumerate(rows):
        for names in ((*BODY, "transfer"), ("transfer", "number")):
            group = tuple(row[name] for name in names)
            worst[group] = max(worst.get(group, k), k, key=lambda i: excess(rows[i]))
    return {"cases": len(rows), "rows": [rows[k] for k in sorted(set(worst.values()))]}


def largest(rows: Iterable[dict[str, Any]]) -> str:
    """Largest excess of some cases; values within rounding as a bound."""
    worst = max(excess(row) for row in rows)
    return f"< {LIMIT:g}" if worst < LIMIT else f"{worst:.1e}"


def table(result: dict[str, Any]) -> str:
    """Largest excess of ρ and norm over 1, by transfer and diffusion number."""
    rows = result["rows"]
    cells = [
        [name, *(largest(r for r in rows if r["transfer"] == name and r["number"] == number) for number in NUMBERS)]
        for name in TRANSFERS
    ]
    return common.table(("transfer", *(f"r = {number:g}" for number in NUMBERS)), cells)


def text(result: dict[str, Any]) -> str:
    """Tables in Markdown: by diffusion number, and by body and contrast."""
    rows = result["rows"]
    lines = ["# One heat step as a linear map", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 1)[1], f"{result['cases']} steps; the larger of ρ − 1 and norm − 1.", ""]
    lines += [table(result), ""]
    bodies: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        bodies.setdefault(tuple(row[name] for name in BODY), []).append(row)
    cells = [
        [*kind, *(largest(row for row in mine if row["transfer"] == name) for name in TRANSFERS)]
        for kind, mine in bodies.items()
    ]
    return "\n".join([*lines, common.table(("dimension", "kernel", "layout", "per cell", *TRANSFERS), cells)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one body, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    environment = common.environment()
    result = {"environment": environment, **summary(measure(case) for case in cases(arguments.quick))}
    print(text(result))
    common.write(arguments.out, "stability_heat_step", result, text(result))


if __name__ == "__main__":
    main()
