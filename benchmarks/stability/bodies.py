"""Stability of rigid bodies of any mass in contact: `python -m benchmarks.stability.bodies [--quick]`.

A disc falls on an elastic block that rests in a tank, and a constant force presses on it. The kinetic and the elastic
energy and that of the force may only become less. The growth is the largest energy in the run over that at the
beginning, and the penetration the largest depth of a particle inside the disc, in cells; both are taken at twelve
times of the run. "solved": `FreeBodies`, whose velocities are solved for with the contact of the nodes. "one exchange":
a disc that takes the impulses of each step after it, as in `RigidBodies.advance`. "penalty": springs and dashpots
between the disc and the particles inside it (benchmarks/stability/penalty.py), whose energy is not counted. "stiff
penalty": springs that are ten times stiffer. The time step is a share of the largest stable one of the material alone.
Blocks under discs that are heavier than themselves are stiffer by the ratio of the masses, and so are the springs.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.bodies import Body, FreeBodies, RigidBodies, moved

from .. import common
from . import penalty

RATIOS = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
"""Density of the disc over that of the block."""
FRICTIONS, SHARES = (0.0, 0.5, 1.0, 2.0), (0.3, 0.9, 1.0)
RADIUS, DENSITY, DX, SPEED, SECONDS = 0.2, 1000.0, 0.05, 0.5, 0.25
YOUNG, NU = 1e5, 0.3
FORCE = 300.0
"""Force that presses on the disc, times the ratio of the stiffness [N/m]."""
RECORDS = 12
STOP = 1e3
"""Growth at which a run ends."""
GROWS = 1.001
"""Growth from which a run counts as one that grows."""

Advance = Callable[[mpm.State, Tensor, int, float], tuple[mpm.State, Tensor]]


class Run(NamedTuple):
    """Growth of the energy, largest penetration in cells, and largest number of iterations of a step."""

    growth: float
    penetration: float
    iterations: int


def stiffness(mass: float) -> float:
    """Stiffness of the block under a disc of a mass [kg/m] over that under a light one."""
    return max(1.0, mass / (DENSITY * math.pi * RADIUS**2))


def scene(ratio: float) -> tuple[mpm.Step, mpm.State, float, Tensor]:
    """The block, the mass of the disc [kg/m], and its row."""
    grid = mpm.Grid(DX, (0.0, 0.0), (1.2, 1.0))
    mass = ratio * DENSITY * math.pi * RADIUS**2
    step = mpm.Step(grid, mpm.NeoHookean(E=YOUNG * stiffness(mass), nu=NU), walls="slip")
    points = mpm.seed.box((0.0, 0.0), (1.2, 0.4), grid, per_cell=4)
    rows = torch.tensor([[[0.6, 0.4 + RADIUS + DX, 0.0, 0.5 * SPEED, -SPEED, 0.0]]], dtype=torch.float64)
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float64)
    return step, state, mass, rows


def energy(step: mpm.Step, state: mpm.State, rows: Tensor, mass: float) -> float:
    own, density = rows[0, 0, 3:], step.diagnostics(state).energy
    assert density is not None
    of_disc = 0.5 * mass * float(own[:2].square().sum() + 0.5 * RADIUS**2 * own[2] ** 2)
    kinetic = 0.5 * float((state.mass * state.v.square().sum(1)).sum())
    of_force = force_on(mass) * (float(rows[0, 0, 1]) - RADIUS)
    return of_disc + kinetic + of_force + float((density * state.volume).sum())


def force_on(mass: float) -> float:
    """Force on a disc [N/m]."""
    return FORCE * stiffness(mass)


def solved(step: mpm.Step, disc: penalty.Disc) -> tuple[Advance, FreeBodies]:
    ball = mpm.Sphere((0.0, 0.0), RADIUS, friction=disc.friction)
    bodies, force = FreeBodies(step, [Body(ball, disc.mass, disc.inertia)]), wrench(disc)[None, None]
    return lambda state, rows, n, dt: bodies.advance(state, rows, n, dt, force), bodies


def one_exchange(step: mpm.Step, disc: penalty.Disc) -> tuple[Advance, None]:
    ball = mpm.Sphere((0.0, 0.0), RADIUS, friction=disc.friction)
    step.boundaries.append(ball)
    bodies, force = RigidBodies(step, [ball]), wrench(disc)
    inertia = force.new_tensor([disc.mass, disc.mass, disc.inertia])

    def advance(state: mpm.State, rows: Tensor, n: int, dt: float) -> tuple[mpm.State, Tensor]:
        for _ in range(n):
            if not bool(rows.isfinite().all()) or float(rows.abs().max()) > 1e3:
                return state.replace(v=state.v + math.inf), rows
            state, wrenches = bodies.advance(state, rows, 1, dt)
            velocity = rows[..., 3:] + dt * (wrenches + force) / inertia
            rows = torch.cat([moved(torch.cat([rows[..., :3], velocity], -1), dt), velocity], -1)
        return state, rows

    return advance, None


def by_penalty(share: float, step: mpm.Step, disc: penalty.Disc) -> tuple[Advance, None]:
    modulus = YOUNG * stiffness(disc.mass) * (1.0 - NU) / ((1.0 + NU) * (1.0 - 2.0 * NU))  # P-wave modulus
    return partial(penalty.advance, step, disc, share * modulus, wrench(disc)), None


COUPLINGS: Mapping[str, Callable[[mpm.Step, penalty.Disc], tuple[Advance, FreeBodies | None]]] = {
    "solved": solved,
    "one exchange": one_exchange,
    "penalty": partial(by_penalty, penalty.SHARE),
    "stiff penalty": partial(by_penalty, 10.0 * penalty.SHARE),
}


def wrench(disc: penalty.Disc) -> Tensor:
    """Force and torque that press on a disc [3]."""
    return torch.tensor([0.0, -force_on(disc.mass), 0.0], dtype=torch.float64)


def run(coupling: str, ratio: float, friction: float, share: float) -> Run:
    step, state, mass, rows = scene(ratio)
    disc = penalty.Disc(RADIUS, mass, 0.5 * mass * RADIUS**2, friction)
    advance, bodies = COUPLINGS[coupling](step, disc)
    dt = share * float(step.stable_dt(state, 1.0))
    first, growth, depth, iterations = energy(step, state, rows, mass), 0.0, 0.0, 0
    for _ in range(RECORDS):
        state, rows = advance(state, rows, max(1, round(SECONDS / dt / RECORDS)), dt)
        if bodies is not None:
            bodies.check()
            assert bodies.report is not None
            iterations = max(iterations, int(bodies.report.iterations.max()))
        now = energy(step, state, rows, mass)
        growth = max(growth, now / first if math.isfinite(now) else math.inf)
        if growth > STOP:
            break
        depth = max(depth, float(penalty.penetration(disc, state.x, rows[0, 0, :2]).max()) / DX)
    return Run(min(growth, STOP), depth, iterations)


def table(rows: list[dict[str, Any]]) -> str:
    """Every run."""
    header = (
        *("density ratio", "friction", "dt over the limit", *(f"growth, {k}" for k in COUPLINGS)),
        *(f"penetration, {k}" for k in COUPLINGS),
        "iterations, solved",
    )
    cells = [
        (
            *(r["ratio"], r["friction"], r["share"], *(_growth(r[k]["growth"]) for k in COUPLINGS)),
            *(None if r[k]["growth"] >= STOP else r[k]["penetration"] for k in COUPLINGS),
            r["solved"]["iterations"],
        )
        for r in rows
    ]
    return common.table(header, cells)


def summary(rows: list[dict[str, Any]]) -> str:
    """Of each coupling the runs that grow, at each share of the time step, and the largest penetration."""
    shares = sorted({r["share"] for r in rows})
    header = ("coupling", *(f"grow at {s} of the limit" for s in shares), "without bound", "penetration [cells]")
    cells = []
    for k in COUPLINGS:
        grow = [r for r in rows if r[k]["growth"] > GROWS]
        unbounded = [r for r in rows if r[k]["growth"] >= STOP]
        of_share = [f"{sum(r['share'] == s for r in grow)} of {sum(r['share'] == s for r in rows)}" for s in shares]
        depth = max(r[k]["penetration"] for r in rows if r[k]["growth"] < STOP)
        cells.append((k, *of_share, len(unbounded), depth))
    return common.table(header, cells)


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    lines = ["# Stability of rigid bodies of any mass", "", f"{common.describe(result['environment'])}.", ""]
    lines += [(__doc__ or "").split("\n\n", 1)[1].replace("\n", " ").strip(), ""]
    lines += [f"A run grows where its growth is above {GROWS}, and without bound where it is above {STOP:g}.", ""]
    return "\n".join([*lines, summary(result["rows"]), "", table(result["rows"])])


def _growth(value: float) -> Any:
    return value if value < STOP else f"> {STOP:g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two ratios, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    options = parser.parse_args()
    environment, begin, rows = common.environment(), time.perf_counter(), []
    cases = itertools.product(
        *((RATIOS[::6], FRICTIONS[::3], SHARES[-1:]) if options.quick else (RATIOS, FRICTIONS, SHARES))
    )
    for ratio, friction, share in cases:
        rows.append({"ratio": ratio, "friction": friction, "share": share})
        rows[-1] |= {k: run(k, ratio, friction, share)._asdict() for k in COUPLINGS}
        print(rows[-1], flush=True)
    result = {"environment": environment, "seconds": time.perf_counter() - begin, "rows": rows}
    common.write(options.out, "stability_bodies", result, text(result))


if __name__ == "__main__":
    with torch.no_grad(), common.one_thread():
        main()
