"""Locking of nearly incompressible bodies: `python -m benchmarks.accuracy.locking [--quick] [--out FOLDER]`.

The static sag of a cantilever under its weight over that of Timoshenko's theory (plane strain in 2-D), for Poisson's
ratios, cells across its height, kernels, particles per cell, slenderness and places between the nodes, float64. The
minimum share according to `torch_mpm.locking` is given for comparison.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import torch

import torch_mpm as mpm
from torch_mpm.implicit import Implicit, equilibrium
from torch_mpm.laws.locking import least_bending

from .. import common

HEIGHT, YOUNG, DENSITY = 0.1, 1e7, 1000.0
RATIOS = (0.3, 0.45, 0.49, 0.495, 0.499, 0.4999, 0.49999)
LAYOUTS: tuple[dict[str, Any], ...] = (
    {}, {"per_cell": 9}, {"per_cell": 16}, {"shift": 0.3}, {"shift": 0.5}, {"slender": 5},
    {"dim": 3, "per_cell": 8, "slender": 5},
)  # fmt: skip
"""Arguments of `sag`, for both kernels."""


def sag(
    nu: float,
    cells: int,
    kernel: str = "quadratic",
    per_cell: int = 4,
    slender: float = 10,
    shift: float = 0.0,
    dim: int = 2,
) -> float | None:
    """Sag of the tip over Timoshenko's; None where the solve has not converged.

    Args:
        nu: Poisson's ratio.
        cells: across the height.
        kernel: of the grid.
        per_cell: particles per cell.
        slender: length over height.
        shift: of the body against the nodes, in cells, upwards.
        dim: 2 or 3; in 3-D the cross-section is a square.
    """
    dx, length, low = HEIGHT / cells, slender * HEIGHT, shift * HEIGHT / cells
    gravity = 50 / slender**3
    third = (0.0,) * (dim - 2)
    grid = mpm.Grid(dx, (-0.2, -0.2, -0.2)[:dim], (length + 0.2, 0.3, 0.3)[:dim], kernel=kernel)
    corner = (length, low + HEIGHT, HEIGHT)[:dim]
    points = mpm.seed.box((-4 * dx, low, *third), corner, grid, per_cell=per_cell, dtype=torch.float64)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    clamp = mpm.Box((-0.5, 0.0, *third), (1.0, 4.0, 4.0)[:dim], "sticky")
    law = mpm.NeoHookean(E=YOUNG, nu=nu)
    solver = Implicit(1e-8, max_cg_iterations=20000)
    step = mpm.Step(grid, law, (0, -gravity, *third), boundaries=[clamp], integrator=solver)
    after = equilibrium(step, state, 1e4)
    if not bool(step.solve_report.converged):
        return None
    tip = state.x[:, 0] > length - dx / 1.5
    return float((state.x - after.x)[tip, 1].mean()) / timoshenko(nu, length, gravity, dim)


def timoshenko(nu: float, length: float, gravity: float, dim: int) -> float:
    """Sag of the tip of a cantilever under its weight [m], per width, with a shear coefficient of 5/6."""
    load, inertia, shear = DENSITY * gravity * HEIGHT, HEIGHT**3 / 12, YOUNG / (2 * (1 + nu))
    plane = 1 - nu**2 if dim == 2 else 1.0
    return load * length**4 * plane / (8 * YOUNG * inertia) + load * length**2 / (2 * 5 / 6 * shear * HEIGHT)


def measure(quick: bool) -> dict[str, Any]:
    result: dict[str, Any] = {"environment": common.environment("cpu"), "sags": []}
    for layout in LAYOUTS[:1] if quick else LAYOUTS:
        name = ", ".join(f"{key} {value}" for key, value in layout.items()) or "default"
        for kernel in ("quadratic", "cubic"):
            for cells in (4,) if quick or layout.get("dim") == 3 else (2, 4, 8):
                for nu in RATIOS[-2:-1] if quick else RATIOS:
                    share = sag(nu, cells, kernel, **layout)
                    bound = least_bending(2 * nu / (1 - 2 * nu), cells, kernel)
                    row = {"layout": name, "kernel": kernel, "cells": cells, "nu": nu, "share": share, "bound": bound}
                    result["sags"].append(row)
                    print(row, flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown: a row per layout, kernel and cells, a column per Poisson's ratio."""
    rows: dict[tuple[Any, ...], dict[float, float]] = {}
    for r in result["sags"]:
        rows.setdefault((r["kernel"], r["layout"], r["cells"]), {})[r["nu"]] = r["share"]
        rows.setdefault((r["kernel"], "least of the report", r["cells"]), {})[r["nu"]] = r["bound"]
    ratios = sorted({r["nu"] for r in result["sags"]})
    table = [(*key, *(shares.get(nu) for nu in ratios)) for key, shares in sorted(rows.items())]
    head = ("kernel", "layout", "cells", *(f"ν = {nu:g}" for nu in ratios))
    lines = ["# Locking", "", common.describe(result["environment"]), "", (__doc__ or "").split("\n\n", 2)[1], ""]
    return "\n".join([*lines, common.table(head, table)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two sags, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    result = measure(arguments.quick)
    common.write(arguments.out, "locking", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
