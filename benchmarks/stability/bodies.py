"""Stability of rigid bodies of any mass in contact: `python -m benchmarks.stability.bodies [--quick]`.

A disc falls on an elastic block that rests in a tank, and a constant force presses on it. The kinetic and the elastic
energy and that of the force may only become less. The growth is the largest energy in the run over that at the
beginning. "solved": `FreeBodies`, whose velocities are solved for with the contact of the nodes. "one exchange": a disc
that takes the impulses of each step after it, as in `RigidBodies.advance`. The time step is a share of the largest
stable one of the material alone. Blocks under discs that are heavier than themselves are stiffer by the ratio of the
masses.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.bodies import Body, FreeBodies, RigidBodies, moved

from .. import common

RATIOS = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
"""Density of the disc over that of the block."""
FRICTIONS, SHARES = (0.0, 0.5, 2.0), (0.3, 0.9)
RADIUS, DENSITY, DX, SPEED, SECONDS = 0.2, 1000.0, 0.05, 0.5, 0.25
FORCE = 300.0
"""Force that presses on the disc, times the ratio of the stiffness [N/m]."""
RECORDS = 12
STOP = 1e3
"""Growth at which a run ends."""

Advance = Callable[[mpm.State, Tensor, int, float], tuple[mpm.State, Tensor]]


def scene(ratio: float) -> tuple[mpm.Step, mpm.State, float, Tensor]:
    """The block, the mass of the disc [kg/m], and its row."""
    grid = mpm.Grid(DX, (0.0, 0.0), (1.2, 1.0))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5 * max(1.0, ratio), nu=0.3), walls="slip")
    points = mpm.seed.box((0.0, 0.0), (1.2, 0.4), grid, per_cell=4)
    rows = torch.tensor([[[0.6, 0.4 + RADIUS + DX, 0.0, 0.5 * SPEED, -SPEED, 0.0]]], dtype=torch.float64)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    return step, state, ratio * DENSITY * math.pi * RADIUS**2, rows


def energy(step: mpm.Step, state: mpm.State, rows: Tensor, mass: float) -> float:
    own, density = rows[0, 0, 3:], step.diagnostics(state).energy
    assert density is not None
    of_disc = 0.5 * mass * float(own[:2].square().sum() + 0.5 * RADIUS**2 * own[2] ** 2)
    kinetic = 0.5 * float((state.mass * state.v.square().sum(1)).sum())
    of_force = force_on(mass) * (float(rows[0, 0, 1]) - RADIUS)
    return of_disc + kinetic + of_force + float((density * state.volume).sum())


def force_on(mass: float) -> float:
    """Force on a disc [N/m]."""
    return FORCE * max(1.0, mass / (DENSITY * math.pi * RADIUS**2))


def growth(ratio: float, friction: float, share: float, solved: bool) -> tuple[float, int]:
    """Largest energy over that at the beginning, and the largest number of iterations."""
    step, state, mass, rows = scene(ratio)
    ball = mpm.Sphere((0.0, 0.0), RADIUS, friction=friction)
    force = torch.tensor([[[0.0, -force_on(mass), 0.0]]], dtype=torch.float64)
    inertia, most = 0.5 * mass * RADIUS**2, 0
    if solved:
        bodies = FreeBodies(step, [Body(ball, mass, inertia)])
        advance: Advance = lambda state, rows, n, dt: bodies.advance(state, rows, n, dt, force)  # noqa: E731
    else:
        step.boundaries.append(ball)
        advance = staggered(RigidBodies(step, [ball]), mass, inertia, force)
    dt = share * float(step.stable_dt(state, 1.0))
    first, largest = energy(step, state, rows, mass), 0.0
    for _ in range(RECORDS):
        state, rows = advance(state, rows, max(1, round(SECONDS / dt / RECORDS)), dt)
        if solved:
            bodies.check()
            assert bodies.report is not None
            most = max(most, int(bodies.report.iterations.max()))
        now = energy(step, state, rows, mass)
        largest = max(largest, now / first if math.isfinite(now) else math.inf)
        if largest > STOP:
            break
    return largest, most


def staggered(bodies: RigidBodies, mass: float, inertia: float, force: Tensor) -> Advance:
    def advance(state: mpm.State, rows: Tensor, n: int, dt: float) -> tuple[mpm.State, Tensor]:
        for _ in range(n):
            if not bool(rows.isfinite().all()) or float(rows.abs().max()) > 1e3:
                return state.replace(v=state.v + math.inf), rows
            state, wrenches = bodies.advance(state, rows, 1, dt)
            velocity = rows[..., 3:] + dt * (wrenches + force) / wrenches.new_tensor([mass, mass, inertia])
            rows = torch.cat([moved(torch.cat([rows[..., :3], velocity], -1), dt), velocity], -1)
        return state, rows

    return advance


def text(result: dict[str, Any]) -> str:
    """Table of a result in Markdown."""
    header = ("density ratio", "friction", "dt over the limit", "growth, solved", "iterations", "growth, one exchange")
    rows = [
        (r["ratio"], r["friction"], r["share"], *(_growth(r[k]) if k != "iterations" else r[k] for k in KEYS))
        for r in result["rows"]
    ]
    lines = ["# Stability of rigid bodies of any mass", "", f"{common.describe(result['environment'])}.", ""]
    lines += [(__doc__ or "").split("\n\n", 1)[1].replace("\n", " ").strip(), "", common.table(header, rows)]
    return "\n".join(lines)


KEYS = ("solved", "iterations", "one exchange")


def _growth(value: float) -> Any:
    return value if value < STOP else f"> {STOP:g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two ratios, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    options = parser.parse_args()
    begin, rows = time.perf_counter(), []
    cases = itertools.product(
        RATIOS[::6] if options.quick else RATIOS, FRICTIONS, SHARES[1:] if options.quick else SHARES
    )
    for ratio, friction, share in cases:
        solved, iterations = growth(ratio, friction, share, True)
        other, _ = growth(ratio, friction, share, False)
        rows.append({"ratio": ratio, "friction": friction, "share": share, "solved": solved,
                     "iterations": iterations, "one exchange": min(other, STOP)})  # fmt: skip
        print(rows[-1], flush=True)
    result = {"environment": common.environment(), "seconds": time.perf_counter() - begin, "rows": rows}
    common.write(options.out, "stability_bodies", result, text(result))


if __name__ == "__main__":
    with torch.no_grad():
        main()
