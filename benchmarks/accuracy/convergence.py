"""Convergence to a manufactured solution: order in dx and dt, and error against run time.

    python -m benchmarks.accuracy.convergence             # 2 minutes on 4 cores
    python -m benchmarks.accuracy.convergence --full      # finer lattices too, 10 minutes
    python -m benchmarks.accuracy.convergence --quick     # seconds

The motion is that of `benchmarks.accuracy.manufactured`: a block that fills the unit box and oscillates for one period.
Particles begin on a regular lattice; the body force, known at each material point, enters as an impulse dt b before
P2G, which is exact for APIC. Velocities belong to the middles of the steps ("staggered"): symplectic Euler is then the
leapfrog scheme, of second order in dt. dt follows dx at a fixed CFL number. Errors: root of the mean square over
particles of displacement and velocity at the end, relative to their amplitudes; "largest" is the largest displacement
error of a particle.

Two kinds of wall show the limits of the order. With `walls="slip"` the nodes beyond a wall absorb the momentum that the
kernel spreads there, and return a velocity of zero: each is about half of an error of first order. "mirror" reflects
the node values at the wall, so that the kernel has the same values there as in the middle of a body. Particles per cell
show the second limit: particles spread by the strain no longer integrate the kernel exactly, an error of the forces
that does not shrink with dx. The cubic kernel and more particles lower it.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torch_mpm as mpm

from .. import common
from . import manufactured as exact

CFL = 0.4
"""dt over dx / wave speed at rest."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Cases, on the lattices with `sizes` cells along each axis."""

    dim: int
    kernel: str
    walls: str
    sizes: tuple[int, ...]
    stress_form: str = "mls"
    per_axis: int = 2
    dtype: str = "float64"

    @property
    def plain(self) -> bool:
        return (self.stress_form, self.per_axis, self.dtype) == ("mls", 2, "float64")

    @property
    def name(self) -> str:
        extra = [f"{self.per_axis**self.dim} per cell"] * (self.per_axis != 2) + [self.dtype] * (
            self.dtype != "float64"
        )
        return ", ".join([f"{self.dim}-D", self.kernel, self.stress_form, f"{self.walls} walls", *extra])


SQUARE, CUBE = (8, 16, 32, 64, 128), (8, 12, 16, 24, 32)
CASES = (
    Case(2, "quadratic", "slip", SQUARE),
    Case(2, "quadratic", "slip", SQUARE, "gradient"),
    Case(2, "quadratic", "slip", SQUARE, dtype="float32"),
    Case(2, "cubic", "slip", SQUARE),
    Case(2, "cubic", "slip", SQUARE, "gradient"),
    Case(2, "quadratic", "mirror", SQUARE),
    Case(2, "quadratic", "mirror", SQUARE, "gradient"),
    Case(2, "quadratic", "mirror", SQUARE[:-1], per_axis=4),
    Case(2, "cubic", "mirror", SQUARE),
    Case(2, "cubic", "mirror", SQUARE, "gradient"),
    Case(2, "cubic", "mirror", SQUARE, dtype="float32"),
    Case(3, "quadratic", "slip", CUBE),
    Case(3, "quadratic", "slip", CUBE, dtype="float32"),
    Case(3, "cubic", "slip", CUBE),
    Case(3, "quadratic", "mirror", CUBE),
    Case(3, "cubic", "mirror", CUBE),
)
DT_NOTE = """Displacement errors; what halving dt changes, in root of mean square relative to the amplitude; and the
order of that change. Below a certain dt the change grows again: each pair of transfers damps the motion by an amount of
order dx⁴ that does not depend on dt, so that more steps damp more."""
FULL = {2: (256,), 3: (48, 64)}
"""Lattices that --full adds to the plain cases."""


def run(case: Case, n: int, steps: int | None = None, staggered: bool = True) -> tuple[mpm.State, dict[str, Any]]:
    """One period; the final state, its errors and the run time.

    Args:
        steps: number of time steps; None for the CFL number of this benchmark.
        staggered: start with the velocity of half a step before the positions.
    """
    steps = steps or math.ceil(exact.PERIOD * exact.WAVE_SPEED * n / CFL)
    dt = exact.PERIOD / steps
    lag = dt / 2 if staggered else 0.0
    solution = exact.Solution(exact.lattice(n, case.dim, case.per_axis, getattr(torch, case.dtype)))
    state = exact.initial_state(solution, -lag)
    grid = mpm.Grid(dx=1 / n, lower=(0,) * case.dim, upper=(1,) * case.dim, kernel=case.kernel)
    law = mpm.NeoHookean(mu=exact.MU, lam=exact.LAM)
    step = mpm.Step(grid, law, walls=case.walls, stress_form=case.stress_form)
    begin = time.perf_counter()
    with torch.no_grad():
        for k in range(steps):
            impulse = dt * solution.body_force(k * dt)
            state = step(state.replace(v=state.v + impulse), dt)
            if k % 20 == 19:
                common.release_memory()
    seconds = time.perf_counter() - begin
    displacement = (state.x - solution.X - solution.displacement(exact.PERIOD)).double() / exact.AMPLITUDE
    velocity = (state.v - solution.velocity(exact.PERIOD - lag)).double() / (exact.AMPLITUDE * math.pi * exact.SPEED)
    return state, {
        "n": n,
        "particles": len(state),
        "steps": steps,
        "seconds": seconds,
        "displacement": float(displacement.square().mean().sqrt()),
        "velocity": float(velocity.square().mean().sqrt()),
        "largest": float(displacement.abs().max()),
    }


def order_in_dt(case: Case, n: int, halvings: int) -> list[dict[str, Any]]:
    """Errors at CFL number 1 and below, and the change by halving dt, without the error of the lattice.

    With velocities in the middles of the steps ("staggered"), and at their beginnings.
    """
    least = math.ceil(exact.PERIOD * exact.WAVE_SPEED * n)
    rows: list[dict[str, Any]] = [{"steps": least * 2**k} for k in range(halvings + 1)]
    for name, staggered in (("staggered", True), ("not staggered", False)):
        finals = []
        for row in rows:
            state, errors = run(case, n, row["steps"], staggered)
            finals.append(state.x)
            row[name] = errors["displacement"]
        for row, x, halved in zip(rows, finals, finals[1:], strict=False):
            row[f"{name} change"] = float((x - halved).square().mean().sqrt()) / exact.AMPLITUDE
    return rows


def fitted_order(rows: Sequence[dict[str, Any]], key: str) -> float:
    """Slope of the error over 1/n, both logarithmic."""
    n, error = ([math.log(row[name]) for row in rows] for name in ("n", key))
    return float(-np.polyfit(n, error, 1)[0])


def measure(cases: Iterable[Case], dt_case: Case, dt_lattice: int, halvings: int) -> dict[str, Any]:
    common.use_all_cores()
    result: dict[str, Any] = {"environment": common.environment(), "cfl": CFL, "cases": []}
    run(Case(2, "quadratic", "slip", ()), 4)  # first calls are slow
    for case in cases:
        rows = []
        for n in case.sizes:
            rows.append(run(case, n)[1])
            print(f"{case.name}, n = {n}: {rows[-1]['displacement']:.2e} in {rows[-1]['seconds']:.2f} s", flush=True)
        orders = {key: fitted_order(rows, key) for key in ("displacement", "velocity", "largest")}
        result["cases"].append({**dataclasses.asdict(case), "name": case.name, "order": orders, "rows": rows})
    result["dt"] = {"case": dt_case.name, "n": dt_lattice, "rows": order_in_dt(dt_case, dt_lattice, halvings)}
    return result


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Convergence to the manufactured solution", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), "", f"dt = {result['cfl']} dx / c.", ""]
    lines += ["## Orders", "", "Fitted over all sizes; errors of the finest lattice.", ""]
    header = ("case", "n", "order", "displacement", "order", "velocity", "order", "largest", "seconds")
    rows = []
    for case in result["cases"]:
        last, order = case["rows"][-1], case["order"]
        errors = [v for k in ("displacement", "velocity", "largest") for v in (f"{order[k]:.2f}", last[k])]
        rows.append((case["name"], f"{case['rows'][0]['n']}-{last['n']}", *errors, last["seconds"]))
    lines += [common.table(header, rows), "", f"## Order in dt ({result['dt']['case']}, n = {result['dt']['n']})", ""]
    lines += [DT_NOTE, "", _dt_table(result["dt"])]
    for case in result["cases"]:
        lines += ["", f"## {case['name']}", "", _case_table(case["rows"])]
    return "\n".join(lines)


def _dt_table(dt: dict[str, Any]) -> str:
    header, columns = ["steps"], [[row["steps"] for row in dt["rows"]]]
    for key in ("staggered", "not staggered"):
        changes = [row[f"{key} change"] for row in dt["rows"][:-1]]
        header += [key, "change", "order"]
        columns += [[row[key] for row in dt["rows"]], [*changes, None]]
        columns.append([*_orders([1 / s for s in columns[0][:-1]], changes), None])
    return common.table(header, zip(*columns, strict=True))


def _case_table(rows: Sequence[dict[str, Any]]) -> str:
    header = ["n", "particles", "steps", "seconds"]
    columns = [[row[key] for row in rows] for key in header]
    for key in ("displacement", "velocity", "largest"):
        errors = [row[key] for row in rows]
        header += [key, "order"]
        columns += [errors, _orders([1 / row["n"] for row in rows], errors)]
    return common.table(header, zip(*columns, strict=True))


def _orders(sizes: Sequence[float], errors: Sequence[float]) -> list[str | None]:
    return [None if order is None else f"{order:.2f}" for order in common.order_of(sizes, errors)]


def plot(result: dict[str, Any], path: Path) -> None:
    """Error over dx and over run time, 2-D above, 3-D below."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(13, 8.5), sharey="row")
    colors = {"quadratic": "tab:blue", "cubic": "tab:orange"}
    for dim, (over_dx, over_time) in zip((2, 3), axes, strict=True):
        for case in (c for c in result["cases"] if c["dim"] == dim):
            style = {
                "color": colors[case["kernel"]] if case["per_axis"] == 2 else "tab:green",
                "linestyle": "-" if case["walls"] == "mirror" else "--",
                "marker": "x" if case["dtype"] == "float32" else "s" if case["stress_form"] == "gradient" else "o",
                "markersize": 5,
                "label": case["name"].split(", ", 1)[1],
            }
            errors = [row["displacement"] for row in case["rows"]]
            over_dx.loglog([1 / row["n"] for row in case["rows"]], errors, **style)
            over_time.loglog([row["seconds"] for row in case["rows"]], errors, **style)
        sizes = np.array(sorted({1 / row["n"] for c in result["cases"] if c["dim"] == dim for row in c["rows"]}))
        if len(sizes):
            for order, start in ((1, 0.5), (2, 0.03)):
                over_dx.loglog(sizes, start * (sizes / sizes[-1]) ** order, color="gray", linewidth=0.8, linestyle=":")
                over_dx.annotate(f"order {order}", (sizes[0], start * (sizes[0] / sizes[-1]) ** order), color="gray")
        over_dx.set(xlabel="dx [m]", ylabel="displacement error / amplitude", title=f"{dim}-D: error over dx")
        over_time.set(xlabel="run time [s]", title=f"{dim}-D: error over run time")
        over_time.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.02, 1))
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    print(f"wrote {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few coarse lattices, to see that it works")
    parser.add_argument("--full", action="store_true", help="finer lattices too")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    cases: Iterable[Case] = CASES
    if arguments.quick:
        cases = [dataclasses.replace(c, sizes=(6, 12)) for c in CASES if c.plain]
    elif arguments.full:
        cases = [dataclasses.replace(c, sizes=(*c.sizes, *FULL[c.dim])) if c.plain else c for c in CASES]
    dt_case = Case(2, "cubic", "mirror", ())
    result = measure(cases, dt_case, *((8, 2) if arguments.quick else (64, 3)))
    print(text(result).split("## 2-D")[0])
    common.write(arguments.out, "convergence", result, text(result))
    plot(result, arguments.out / "convergence.png")


if __name__ == "__main__":
    sys.exit(main())
