"""Fronts of two phases and held surfaces: `python -m benchmarks.accuracy.heat_fronts [--quick] [--out FOLDER]`.

A solid below its melting point touches a wall at 1, and melts (Stefan's problem of two phases, Neumann's solution,
equal conductivities, the melting point is 0): how far the front lags behind, in cells and in lengths of conduction in a
step √(κ dt/(ρ C)), for diffusion numbers r = κ dt/(ρ C dx²), Stefan numbers and temperatures of the solid. The
temperature between two held surfaces, which is linear: its largest error, as the length over which it changes by as
much, for places of the surfaces between the nodes. Particles are regular, float64.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.heat.boundaries import FixedSurface

from .. import common

BEGIN, END = 0.15, 0.6
"""Positions of the front at the start and at the end."""
CASES = ((0.2, -0.4), (1.7, -0.1), (1.7, -0.4), (1.7, -1.0), (5.0, -0.4))
"""Stefan numbers and temperatures of the solid."""
NUMBERS = (0.01, 0.1, 1.0, 10.0)
SIZES = (20, 40)
PLACES = (0.0, 0.13, 0.25, 0.37, 0.5, 0.75, 0.9)
"""Offsets of the held surfaces, in cells."""
LAYOUTS: tuple[dict[str, Any], ...] = (
    {}, {"kernel": "cubic"}, {"per_cell": 9}, {"per_cell": 1}, {"transfer": "apic"}, {"transfer": "flip"},
)  # fmt: skip


def root(stefan: float, solid: float) -> float:
    """λ of the front 2 λ √t, by bisection: exp(−λ²)/erf λ + θ_s exp(−λ²)/erfc λ = λ √π/St."""

    def left_over(x: float) -> float:
        e = math.exp(-x * x)
        return e / math.erf(x) + solid * e / math.erfc(x) - x * math.sqrt(math.pi) / stefan

    low, high = 1e-6, 3.0
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if left_over(middle) > 0 else (low, middle)
    return low


def exact(x: Tensor, time: float, stefan: float, solid: float) -> Tensor:
    """Temperature at a time."""
    factor, y = root(stefan, solid), x / (2 * math.sqrt(time))
    liquid = 1 - torch.erf(y) / math.erf(factor)
    return torch.where(y < factor, liquid, solid * (1 - torch.erfc(y) / math.erfc(factor)))


def lag(stefan: float, solid: float, n: int, number: float) -> float:
    """Distance of the front behind that of the exact solution at the end, over dx."""
    dx, factor = 1 / n, root(stefan, solid)
    start, end = ((place / (2 * factor)) ** 2 for place in (BEGIN, END))
    grid = mpm.Grid(dx, (-6 * dx, 0), (3, 6 * dx))
    points = mpm.seed.box((0, 0), (2, 2 * dx), grid, per_cell=4, dtype=torch.float64)
    state = mpm.State.at_rest(points, 1.0, dtype=torch.float64)
    x = state.x[:, 0]
    liquid = {"liquid": (x < BEGIN).double()}
    state = state.replace(temperature=exact(x, start, stefan, solid), extra=liquid)
    wall = FixedSurface(mpm.Plane((0.0, 0.0), (1.0, 0.0)), 1.0)
    heat = mpm.Heat(grid, 1.0, 1.0, [wall], melting_point=0.0, latent_heat=1 / stefan, tolerance=1e-8)
    steps = round((end - start) / (number * dx * dx))
    with torch.no_grad():
        state = mpm.rollout(heat, state, steps, (end - start) / steps)
    return (END - float((state.extra["liquid"] * state.volume).sum()) / (2 * dx)) / dx


def between_surfaces(
    n: int, place: float, kernel: str = "quadratic", per_cell: int = 4, transfer: str = "hybrid"
) -> float:
    """Largest error of a steady temperature from 1 to 0 between surfaces one apart, over dx."""
    dx = 1 / n
    shift = place * dx
    grid = mpm.Grid(dx, (-0.3, 0), (1.4, 6 * dx), kernel=kernel)
    points = mpm.seed.box((shift, 0), (1 + shift, 6 * dx), grid, per_cell=per_cell, dtype=torch.float64)
    state = mpm.State.at_rest(points, 1.0, dtype=torch.float64)
    left = FixedSurface(mpm.Plane((shift, 0.0), (1.0, 0.0)), 1.0)
    right = FixedSurface(mpm.Plane((1 + shift, 0.0), (-1.0, 0.0)), 0.0)
    heat = mpm.Heat(grid, 1.0, 1.0, [left, right], transfer=transfer, tolerance=1e-12, max_iterations=5000)
    linear = 1 - (state.x[:, 0] - shift)
    with torch.no_grad():
        start = state.replace(temperature=linear + 0.3 * torch.sin(9 * (1 - linear)))
        end = mpm.rollout(heat, start, 80, 0.5)
    return float((end.temperature - linear).abs().max()) * n


def measure(quick: bool) -> dict[str, Any]:
    result: dict[str, Any] = {"environment": common.environment("cpu"), "fronts": [], "surfaces": []}
    for stefan, solid in CASES[2:3] if quick else CASES:
        for number in NUMBERS[2:] if quick else NUMBERS:
            for n in (10,) if quick else SIZES if number > 0.05 else SIZES[:1]:
                cells = lag(stefan, solid, n, number)
                row = {"stefan": stefan, "solid": solid, "number": number, "n": n, "lag": cells}
                result["fronts"].append({**row, "lengths": cells / math.sqrt(number)})
                print(result["fronts"][-1], flush=True)
    for layout in LAYOUTS[:1] if quick else LAYOUTS:
        for n in (8,) if quick else (10, 40):
            errors = [between_surfaces(n, place, **layout) for place in PLACES]
            name = ", ".join(f"{key} {value}" for key, value in layout.items()) or "default"
            result["surfaces"].append({"layout": name, "n": n, "least": min(errors), "most": max(errors)})
            print(result["surfaces"][-1], flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    fronts = [(r["stefan"], r["solid"], r["number"], r["n"], r["lag"], r["lengths"]) for r in result["fronts"]]
    surfaces = [(r["layout"], r["n"], r["least"], r["most"]) for r in result["surfaces"]]
    lines = ["# Fronts and held surfaces", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[1], "", "## Lag of a front of two phases", ""]
    lines += [common.table(("St", "solid", "r", "n", "lag [dx]", "lag [√(κ dt/(ρ C))]"), fronts), ""]
    lines += ["## Between held surfaces", "", "Over all places of the surfaces between the nodes.", ""]
    return "\n".join([*lines, common.table(("layout", "n", "least error [dx]", "largest error [dx]"), surfaces)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse lattices, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    result = measure(arguments.quick)
    common.write(arguments.out, "heat_fronts", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
