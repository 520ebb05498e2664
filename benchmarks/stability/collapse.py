"""Ten thousand steps of columns of sand of any stiffness and friction: `python -m benchmarks.stability.collapse`.

Columns of one size with E from 1e3 Pa (half crushed by its own weight) to 1e9 Pa and friction angles from 0° to 60°
collapse as one batch of scenes, each with half of its own stability limit (`Step.stable_dt`) as its time step,
estimated at every step. A column starts without strain, so it falls on itself first. The exit status is zero if all
states stayed finite and no scene gained energy.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from pathlib import Path
from typing import Any

import torch

import torch_mpm as mpm

from .. import common
from ..accuracy.runout import DX, GRAVITY, SEGMENT, Segment, record

MODULI = (1e3, 1e5, 1e7, 1e9)
ANGLES = (0, 15, 30, 45, 60)
FORMS = (
    (2, "unilateral", "zero"), (2, "unilateral", "keep"), (2, "full", "zero"), (2, "hencky", "zero"),
    (2, "mixed", "zero"), (3, "unilateral", "zero"), (3, "hencky", "zero"),
)  # fmt: skip
SIZE = {2: (12, 24), 3: (6, 12, 6)}
"""Cells of a column, from the wall at x = 0 (and z = 0)."""


def measure(dim: int, energy: str, apex: str, steps: int, device: str) -> list[dict[str, Any]]:
    """One row per stiffness and friction angle."""
    cases = list(itertools.product(MODULI, ANGLES))
    size = SIZE[dim]
    height = DX * size[1]
    points = mpm.seed.box((0.0,) * dim, [DX * n for n in size], DX, 2**dim)
    column = mpm.State.at_rest(points, 1600.0)
    packed = mpm.State.concatenate([column] * len(cases), scene=True).to(device, torch.float32)
    upper = (40 * size[0] * DX if dim == 2 else 15 * size[0] * DX, 1.5 * height, 15 * size[0] * DX)[:dim]
    roomy = mpm.Grid(DX, (0.0,) * dim, upper, scenes=len(cases))
    room = min(12 * roomy.activate(packed.x, packed.scene).wanted, roomy.block_count)
    grid = mpm.Grid(DX, (0.0,) * dim, upper, scenes=len(cases), max_blocks=room)
    E, angle = (torch.tensor(v, dtype=torch.float32, device=device) for v in zip(*cases, strict=True))
    law = mpm.QuarticSand(
        E=E, nu=torch.full_like(E, 0.3), friction_angle=torch.deg2rad(angle), energy=energy, apex=apex
    )
    walls = mpm.Walls([("slip", "separate"), ("separate", "separate"), ("slip", "separate")][:dim], friction=0.3)
    step = mpm.Step(grid, law, gravity=(0.0, -GRAVITY, 0.0)[:dim], walls=walls)
    segment = Segment(step, step.prepare(packed), lambda state: step.stable_dt(state, 0.5), every_step=True)
    records = [record(step, segment.state)]
    for _ in range(math.ceil(steps / SEGMENT)):
        segment.run()
        records.append(record(step, segment.state))
    step.check()
    state = segment.state
    finite = state.x.isfinite().all(1) & state.v.isfinite().all(1) & ~law.invalid(state)
    rows = []
    for b, (modulus, degrees) in enumerate(cases):
        total = [sum(r[name][b] for name in ("kinetic", "potential", "elastic")) for r in records]
        rises = [after - before for before, after in itertools.pairwise(total)]
        rows.append(
            {
                "case": f"{dim}-D, {energy}, apex {apex}",
                "E": modulus,
                "angle": degrees,
                "time": float(segment.time[b]) / math.sqrt(height / GRAVITY),
                "finite": bool(finite[state.scene == b].all()) and all(map(math.isfinite, total)),
                "rise": max(rises) / total[0],
                "end": total[-1] / total[0],
            }
        )
    return rows


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown: for each law the worst of all stiffnesses and angles, then all cases."""
    header = ("law", "columns", "steps", "all finite", "largest rise of energy", "least time / √(H/g)", "seconds")
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in result["rows"]:
        groups.setdefault(row["case"], []).append(row)
    worst = [
        (name, len(rows), result["steps"], all(r["finite"] for r in rows), max(r["rise"] for r in rows))
        + (min(r["time"] for r in rows), result["seconds"][name])
        for name, rows in groups.items()
    ]
    lines = ["# Long runs of columns of sand", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 1)[1].strip(), "", "Energies relative to the first.", ""]
    keys = ("case", "E", "angle", "time", "finite", "rise", "end")
    return "\n".join(
        [*lines, common.table(header, worst), "", common.table(keys, [[r[k] for k in keys] for r in result["rows"]])]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few steps of two laws")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    common.use_all_cores()
    steps = 64 if arguments.quick else 10_000
    result: dict[str, Any] = {"environment": common.environment(arguments.device), "steps": steps, "seconds": {}}
    result["rows"] = []
    with torch.no_grad():
        for form in FORMS[:1] + FORMS[-2:-1] if arguments.quick else FORMS:
            begin = time.perf_counter()
            rows = measure(*form, steps, arguments.device)
            result["rows"] += rows
            result["seconds"][rows[0]["case"]] = time.perf_counter() - begin
            print(f"{rows[0]['case']}: {time.perf_counter() - begin:.1f} s", flush=True)
    common.write(arguments.out, "collapse", result, text(result))
    print(text(result).split("\n\n")[-2])
    sys.exit(any(not row["finite"] or row["rise"] > 1e-3 for row in result["rows"]))


if __name__ == "__main__":
    main()
