"""The heat solve at any diffusion number and contrast of conductivity: `python -m benchmarks.stability.heat`.

A square of 64 × 64 cells with four jittered particles each, random temperatures, half of it conducting better by the
contrast; the diffusion number r = dt κ/(ρ c dx²) is that of the better half. Iterations, and the mass-weighted RMS
error relative to the RMS increment against a direct sparse solve in float64 (scipy); residuals are in the .json. Solves
end where the residual is 1e-10 (float64) or 1e-6 (float32) of the first one; refined ones, in float32 with residuals in
float64, at 1e-10 K.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import Any

import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops import scatter

from .. import common
from ..heat_matrix import node_gradients

NUMBERS = (1e-5, 1e-3, 0.1, 1.0, 10.0, 100.0, 1e4, 1e6)
CONTRASTS = (1.0, 1e3, 1e6)
MOST = 3000
RELATIVE = {torch.float32: 1e-6, torch.float64: 1e-10}
REFINED = 1e-10
"""Tolerance of refined solves [K]."""
KINDS = (
    *((m, d, False) for m in ("cg", "chebyshev", "multigrid") for d in (torch.float64, torch.float32)),
    ("multigrid", torch.float32, True),
)
"""Method, precision, and whether refined."""


def assembled(blocks: mpm.Blocks, x: Tensor, conductance: Tensor) -> sparse.csr_matrix:
    """H as a sparse matrix in float64 on the rows of node tensors: Gᵀ κ V G per axis, G the gradient of a particle."""
    nodes, gradient = node_gradients(blocks, x.double())
    P, S, D = gradient.shape
    rows = torch.arange(P).repeat_interleave(S).numpy()
    columns = nodes.reshape(-1).numpy()
    weight = sparse.diags(conductance.double().numpy())
    total = sparse.csr_matrix((blocks.node_count, blocks.node_count))
    for axis in range(D):
        values = gradient[:, :, axis].reshape(-1).numpy()
        G = sparse.csr_matrix((values, (rows, columns)), shape=(P, blocks.node_count))
        total = total + G.T @ weight @ G
    return total.tocsr()


def case(n: int, r: float, contrast: float, method: str, dtype: torch.dtype, refine: bool) -> dict[str, Any]:
    """One row of the table."""
    generator = torch.Generator().manual_seed(1)
    dx = 1.0 / n
    axis = (torch.arange(2 * n) + 0.5) * dx / 2
    x = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    x = (x + 0.2 * dx * (torch.rand(x.shape, generator=generator) - 0.5)).to(dtype)
    grid = mpm.Grid(dx=dx, lower=(0, 0), upper=(1, 1))
    blocks = grid.activate(x)
    volume = dx * dx / 4
    conductance = torch.where(x[:, 0] < 0.5, volume, volume / contrast).to(dtype)
    heat_capacity = scatter(blocks, x, torch.full_like(x[:, :1], volume))[:, 0]
    theta = torch.rand(blocks.node_count, generator=generator, dtype=torch.float64).to(dtype)
    dt = r * dx * dx
    solve = mpm.heat_cg(
        blocks, x, conductance, heat_capacity, theta, dt, tolerance=REFINED if refine else 0.0,
        relative_tolerance=0.0 if refine else RELATIVE[dtype], max_iterations=MOST, method=method, refine=refine,
    )  # fmt: skip
    some = (heat_capacity > 0).numpy()
    H = assembled(blocks, x, conductance)
    mass = heat_capacity.double().numpy()
    A = (H + sparse.diags(mass / dt))[some][:, some].tocsc()
    exact = spsolve(A, -(H @ theta.double().numpy())[some])
    weight = mass[some] / mass.sum()
    error = (weight @ (solve.increment.double().numpy()[some] - exact) ** 2) ** 0.5
    return {
        "r": r,
        "contrast": contrast,
        "dtype": str(dtype).removeprefix("torch."),
        "method": method,
        "refined": refine,
        "iterations": int(solve.iterations),
        "converged": bool(solve.converged),
        "residual": float(solve.residual),
        "error": float(error / (weight @ exact**2) ** 0.5),
    }


def kind(row: dict[str, Any]) -> str:
    return f"{row['method']} {row['dtype']}" + (" refined" if row["refined"] else "")


def cell(row: dict[str, Any]) -> str:
    return f"{row['iterations']}: {row['error']:.0e}" if row["converged"] else f"over {MOST}: {row['error']:.0e}"


def text(result: dict[str, Any]) -> str:
    """The table in Markdown, precisions and methods side by side."""
    lines = ["# Heat solve: diffusion number and contrast", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 1)[1], "Iterations: error", ""]
    header = ["r", "contrast", *dict.fromkeys(kind(row) for row in result["rows"])]
    rows: dict[tuple[float, float], list[Any]] = {}
    for row in result["rows"]:
        cells = rows.setdefault((row["r"], row["contrast"]), [f"{row['r']:g}", f"{row['contrast']:g}"])
        cells.append(cell(row))
    return "\n".join([*lines, common.table(header, rows.values())])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small grid and few cases, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    numbers, contrasts = ((0.1, 10.0), (1.0, 1e3)) if arguments.quick else (NUMBERS, CONTRASTS)
    rows = [
        case(16 if arguments.quick else 64, r, contrast, *choice)
        for r, contrast, choice in itertools.product(numbers, contrasts, KINDS)
    ]
    result = {"environment": common.environment(), "rows": rows}
    print(text(result))
    common.write(arguments.out, "heat_stability", result, text(result))


if __name__ == "__main__":
    main()
