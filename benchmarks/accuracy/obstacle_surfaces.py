"""Where obstacles act between nodes: the lift of discs in water, and bodies that land on a plane.

    python -m benchmarks.accuracy.obstacle_surfaces             # minutes on one core
    python -m benchmarks.accuracy.obstacle_surfaces --quick     # seconds

Obstacles are larger than the bodies that they stand for by a margin on all sides, in cells; the middle of a disc and
the height of a plane lie at several places between the nodes.

A disc is held in water at rest. Its lift is relative to the weight of the water that it displaces, at the density of
the water at its level (mean 1/J away from the disc), and averaged over time after the water has settled. The water
starts under its own pressure: up to the disc without its margin; up to the margin; or up to the disc, which then moves
by 4 dx upwards and stops. Contact of nodes has a band of places where water rests, so these differ.

A body falls from 3 dx above a plane and comes to rest. Its height is the mean height of its lowest 20 particles above
the plane without its margin. Two particles along each axis of a cell: a body that touches the plane has them at
0.25 dx. Walls of the domain are mirrors, so sand and water rest between them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torch_mpm as mpm

from .. import common
from .containers import hydrostatic

GRAVITY, DENSITY = 9.8, 1000.0
RADIUS, WIDTH, DEPTH = 0.15, 0.8, 0.6
"""Of the discs, and of the water around them [m]."""
BULK, VISCOSITY = 1e5, 30.0
"""Of the water around discs: sound ends within a tenth of a second."""
CELLS = (6, 12)
"""Radii of the discs over dx."""
PLACES = ((0.1, 0.05), (0.3, 0.4))
"""Offsets of the middle of discs from a node, in cells."""
MOVED = 4
"""Distance that discs move, in cells."""
STARTS = ("water at the disc", "water at the margin", "disc moved")
HEIGHTS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Offsets of planes from nodes, in cells."""
MARGINS = (0.0, 0.49, 0.75, 1.0)
"""No surface is at a node, where rounding would decide on which side the node is."""
DX = 0.05
"""Of bodies that land, which are ten cells high [m]."""
MATERIALS: dict[str, tuple[Any, bool]] = {
    "elastic block, E = 1e6 Pa": (mpm.NeoHookean(E=1e6, nu=0.3), False),
    "elastic block, E = 1e5 Pa": (mpm.NeoHookean(E=1e5, nu=0.3), False),
    "sand": (mpm.QuarticSand(E=1e6, nu=0.3, friction_angle=0.6), True),
    "water": (mpm.WeaklyCompressible(BULK, viscosity=1.0), True),
}
"""Laws, and whether a body fills the width of the domain."""


def lift(cells: int, place: tuple[float, float], margin: float, start: str, settle: float, average: float) -> float:
    """Of a disc in water, over the weight of the displaced water."""
    dx = RADIUS / cells
    middle = torch.tensor([0.5 * WIDTH + place[0] * dx, 0.5 * DEPTH + place[1] * dx], dtype=torch.float64)
    away = torch.tensor([0.0, -MOVED * dx if start == "disc moved" else 0.0], dtype=torch.float64)
    disc = mpm.Sphere((middle + away).tolist(), RADIUS + margin * dx)
    grid = mpm.Grid(dx, (0.0, 0.0), (WIDTH, DEPTH + 4 * dx))
    step = mpm.Step(grid, mpm.WeaklyCompressible(BULK, viscosity=VISCOSITY), (0.0, -GRAVITY), "mirror", [disc])
    points = mpm.seed.box((0.0, 0.0), (WIDTH, DEPTH), grid, per_cell=4)
    water = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    inside = RADIUS + (margin * dx if start == "water at the margin" else 0.0)
    water = water.select(((water.x - middle - away).norm(dim=1) > inside).nonzero()[:, 0])
    state = hydrostatic(step, water, DEPTH)
    n = round(settle / 4 / (0.2 * dx / math.sqrt(BULK / DENSITY)))
    dt = settle / 4 / n
    disc.velocity = (-away / (n * dt)).tolist()
    state = mpm.rollout(step, state, n, dt)
    disc.velocity = (0.0, 0.0)
    state = step.with_impulses(mpm.rollout(step, state, 3 * n, dt))
    n = round(average / dt)
    end = mpm.rollout(step, state, n, dt)
    step.check(end)
    level = ((end.x[:, 1] - middle[1]).abs() < 0.1) & ((end.x[:, 0] - middle[0]).abs() > RADIUS + 0.1)
    density = DENSITY * float((1 / end.J[level]).mean())
    force = float(step.impulses(end)[disc].linear[0, 1]) / (n * dt)
    return force / (density * GRAVITY * math.pi * RADIUS**2)


def landing(name: str, place: float, margin: float) -> float:
    """Height of the lowest particles of a body at rest above a plane on which it fell, in cells."""
    law, wide = MATERIALS[name]
    level = 0.4 + place * DX
    plane = mpm.Plane((0.0, level + margin * DX), (0.0, 1.0))
    grid = mpm.Grid(DX, (0.0, 0.0), (2.0, 1.6))
    step = mpm.Step(grid, law, (0.0, -GRAVITY), "mirror", [plane])
    left, right = (0.0, 2.0) if wide else (0.5, 1.5)
    points = mpm.seed.box((left, level + 3 * DX), (right, level + 13 * DX), grid, per_cell=4)
    state = mpm.State.at_rest(points, DENSITY, (0.0, -0.3), dtype=torch.float64)
    dt = float(step.stable_dt(state, 0.3))
    for k in range(60):
        state = mpm.rollout(step, state, round(0.03 / dt), dt)
        if 6 < k < 50:  # it has landed, and is let settle
            state = state.replace(v=0.7 * state.v, C=0.7 * state.C)
    step.check(state)
    return float(state.x[:, 1].sort()[0][:20].mean() - level) / DX


def measure(quick: bool) -> dict[str, Any]:
    result: dict[str, Any] = {"environment": common.environment("cpu"), "lift": [], "rest": []}
    begin = time.perf_counter()
    times = (0.05, 0.05) if quick else (1.6, 0.4)
    for cells in CELLS[:1] if quick else CELLS:
        for margin in MARGINS:
            values = {start: [lift(cells, place, margin, start, *times) for place in PLACES] for start in STARTS}
            result["lift"].append({"cells": cells, "margin": margin, **values})
            shown = [round(v, 3) for row in values.values() for v in row]
            print(cells, margin, shown, f"{time.perf_counter() - begin:.0f} s", flush=True)
    for name in list(MATERIALS)[:1] if quick else MATERIALS:
        for margin in MARGINS:
            values = [landing(name, place, margin) for place in HEIGHTS]
            result["rest"].append({"material": name, "margin": margin, "values": values})
            print(name, margin, [round(v, 2) for v in values], f"{time.perf_counter() - begin:.0f} s", flush=True)
    result["settle"], result["average"] = times
    result["seconds"] = time.perf_counter() - begin
    return result


def text(result: dict[str, Any]) -> str:
    discs = [
        (row["cells"], f"{row['margin']:g}", *(f"{v:.3f}" for start in STARTS for v in row[start]))
        for row in result["lift"]
    ]
    rests = [
        (row["material"], f"{row['margin']:g}", *(f"{v:.2f}" for v in row["values"]), f"{np.mean(row['values']):.2f}")
        for row in result["rest"]
    ]
    columns = [f"{start}, {place}" for start in STARTS for place in PLACES]
    times = f"{result['settle']:g} s of settling, averages over {result['average']:g} s, places in cells:"
    return "\n".join(
        [
            *("# Where obstacles act", "", common.describe(result["environment"]), ""),
            *((__doc__ or "").split("\n\n", 2)[2].strip(), ""),
            *(f"The lift of discs over the weight of the displaced water. {times}", ""),
            *(common.table(("radius, dx", "margin, dx", *columns), discs), ""),
            *("Heights of the lowest particles above planes at these places, in cells; 0.25 is exact.", ""),
            common.table(("material", "margin, dx", *(f"{h:g}" for h in HEIGHTS), "mean"), rests),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one disc and one block, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    with common.one_thread():
        result = measure(arguments.quick)
    common.write(arguments.out, "obstacle_surfaces", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
