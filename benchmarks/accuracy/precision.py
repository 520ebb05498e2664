"""float32 against float64 over a rollout: a soft block falls, bounces off the floor and rises.

    python -m benchmarks.accuracy.precision             # 10 seconds on 4 cores
    python -m benchmarks.accuracy.precision --quick     # seconds

Both begin with the same numbers, exact in float32, and take the same time steps. Rounding is the distance between them:
root of the mean square over particles of positions [in dx] and velocities [over the speed of impact], and the change of
energy [over the kinetic energy of impact]. The error of the lattice, the distance of the height of the mass centre from
that on the finest lattice, is given for comparison.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common

GRAVITY, IMPACT = 9.8, 2.0
DENSITY, E, NU = 1000.0, 1e5, 0.3
DURATION, RECORDS = 0.25, 5
"""Duration [s], long enough to fall 0.125 m onto the floor and leave it again; times of the comparison."""
CFL = 0.4


def setup(n: int, dtype: torch.dtype) -> tuple[mpm.Step, mpm.State]:
    """A block of a quarter metre in the unit box, thrown at the floor, on a lattice with n cells along each axis."""
    grid = mpm.Grid(dx=1 / n, lower=(0, 0, 0), upper=(1, 1, 1))
    points = mpm.seed.box((0.375, 0.125, 0.375), (0.625, 0.375, 0.625), grid, per_cell=8)
    state = mpm.State.at_rest(points, DENSITY, (0, -IMPACT, 0), dtype=torch.float32).to(dtype=dtype)
    return mpm.Step(grid, mpm.NeoHookean(E=E, nu=NU), gravity=(0, -GRAVITY, 0), walls="separate"), state


def energy(step: mpm.Step, state: mpm.State) -> float:
    """Kinetic, elastic and potential energy [J]."""
    affine = 0.0 if state.C is None else state.C.square().sum((1, 2)) / step.grid.inverse_inertia  # Jiang et al. 2015
    kinetic = 0.5 * state.mass * (state.v.square().sum(1) + affine)
    potential = GRAVITY * state.mass * state.x[:, 1]
    return float((kinetic + potential + step.law.energy(state)).double().sum())


def rollout(n: int, dtype: torch.dtype) -> tuple[list[tuple[mpm.State, float]], float, int]:
    """States and energies at the times of comparison, run time [s] and steps."""
    step, state = setup(n, dtype)
    speed = math.sqrt(step.law.wave_modulus(step.prepare(state)).max().item() / DENSITY)
    count = RECORDS * math.ceil(DURATION * speed * n / CFL / RECORDS)
    records, seconds = [], 0.0
    with torch.no_grad():
        for _ in range(RECORDS):
            begin = time.perf_counter()
            state = mpm.rollout(step, state, count // RECORDS, DURATION / count)
            seconds += time.perf_counter() - begin
            records.append((state, energy(step, state)))
    step.check(state)
    return records, seconds, count


def compare(n: int) -> dict[str, Any]:
    """One lattice in both precisions."""
    single, single_seconds, steps = rollout(n, torch.float32)
    double, double_seconds, _ = rollout(n, torch.float64)
    rows = []
    for i, ((s, s_energy), (d, d_energy)) in enumerate(zip(single, double, strict=True)):
        impact_energy = 0.5 * float(d.mass.sum()) * IMPACT**2
        rows.append({
            "time": DURATION * (i + 1) / RECORDS,
            "position": _rms(s.x - d.x) * n,
            "velocity": _rms(s.v - d.v) / IMPACT,
            "energy": abs(s_energy - d_energy) / impact_energy,
            "height": float(d.x[:, 1].mean()),
            "height_rounding": abs(float(s.x[:, 1].double().mean()) - float(d.x[:, 1].mean())),
        })  # fmt: skip
    return {
        "n": n,
        "particles": len(single[0][0]),
        "steps": steps,
        "float32_seconds": single_seconds,
        "float64_seconds": double_seconds,
        "rows": rows,
    }


def _rms(difference: Tensor) -> float:
    return float(difference.double().square().mean().sqrt())


def measure(sizes: Sequence[int]) -> dict[str, Any]:
    common.use_all_cores()
    rollout(4, torch.float32)  # first calls are slow
    result: dict[str, Any] = {"environment": common.environment(), "lattices": []}
    for n in sizes:
        result["lattices"].append(compare(n))
        print(f"n = {n}: {result['lattices'][-1]['rows'][-1]}", flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lattices = result["lattices"]
    finest, last = lattices[-1], lattices[-1]["rows"][-1]
    lines = ["# float32 against float64 over a rollout", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), "", f"## At the end, after {DURATION} s", ""]
    errors = ("position / dx", "velocity / impact", "energy / impact", "height: rounding [m]")
    header = ("n", "particles", "steps", "float32 s", "float64 s", *errors, "height: lattice [m]")
    rows = []
    for lattice in lattices:
        end = lattice["rows"][-1]
        off = None if lattice is finest else abs(end["height"] - last["height"])
        rows.append([lattice[k] for k in ("n", "particles", "steps", "float32_seconds", "float64_seconds")]
                    + [end[k] for k in ("position", "velocity", "energy", "height_rounding")] + [off])  # fmt: skip
    lines += [common.table(header, rows), "", f"## In time, n = {finest['n']}", ""]
    keys = ("time", "position", "velocity", "energy", "height", "height_rounding")
    columns = ("time [s]", *errors[:3], "height [m]", errors[3])
    lines += [common.table(columns, [[row[k] for k in keys] for row in finest["rows"]])]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one coarse lattice, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    result = measure([8] if arguments.quick else [16, 32, 64])
    print(text(result).split("\n\n", 3)[3])
    common.write(arguments.out, "precision", result, text(result))


if __name__ == "__main__":
    main()
