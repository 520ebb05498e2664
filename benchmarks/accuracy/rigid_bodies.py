"""Contact between material and rigid bodies against theory and experiments, in parts:

    python -m benchmarks.accuracy.rigid_bodies             # minutes on one core
    python -m benchmarks.accuracy.rigid_bodies --quick     # seconds

- Incline: an elastic block (E = 1e7 Pa, 12 by 4 cells, so low that it presses on the plane along its whole length) on a
  plane that is inclined against the lattice. It settles on a sticky plane, damped by PIC, and is let go for half a
  second: its acceleration in the second half of that time, beside g sin a − μ g cos a where that is positive; otherwise
  it should stick.
- Rolling: a free disc rolls from rest on an elastic bed (E = 1e5 Pa) in gravity that is inclined by an angle. Its
  acceleration, by least squares over the last three quarters of a second, beside 2/3 g sin a, that of a disc on a rigid
  plane; the distance that it travels over R times the angle that it turns; and the resistance, the energy that it loses
  over its weight and that distance. On level sand: a disc that begins to roll at 2 m/s, for half a second. It skids, as
  rigid wheels do that are towed through sand (Wong and Reece 1967).
- Drops: the largest depth d of balls that fall on sand, over (0.14/μ) (ρ_s/ρ_g)^½ D^⅔ H^⅓, measured for spheres
  (Uehara et al. 2003) with H the height of the fall and d, μ = tan φ. A quarter of a sphere between mirrors (3-D), and
  half of a disc (2-D), for which no law of this accuracy is published: a force in proportion to the depth alone has
  d ~ H^½, as discs that stop in a time that does not depend on their speed (Ciamarra et al. 2004), and drag in
  proportion to the square of the speed lowers the exponent. Exponents are those of least squares.
- Momentum: a spinning disc hits a block of material, without gravity and walls; the change of the linear and angular
  momentum of both, over the momentum that the disc starts with (angular: times its distance of 1 m from the origin).
- Floating: a disc of a given share of the density of water, let go 2 dx above or below the depth of Archimedes; the
  depth at which it comes to rest minus that of Archimedes, in cells, averaged over the last third of the time, and its
  standard deviation there. Its
  obstacle is larger by a margin on all sides, where the water starts at the disc itself. The level is that of the
  volume of water away from the disc.
- Gradients: derivatives through 200 steps of a body in contact with an elastic block (float64), in a direction of each
  input that is drawn at random, beside central differences. Free: a spinning ball falls on the block; the sum of the
  numbers of its pose and velocity at the end with different weights, and a loss of the velocities and heights of the
  particles. Driven: the mean wrench on a ball that moves into the block. Policy: a network of 16, 8 and 3 numbers turns
  a paddle on a hinge by a torque and moves a disc, with a new action every 10 steps.

Bodies but those of the gradients are integrated by semi-implicit Euler, one exchange per interval (docs/bodies.md).
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common
from . import body_gradients
from .containers import hydrostatic
from .limits import angular_momentum

GRAVITY, DENSITY = 9.8, 1000.0
F64 = torch.float64
INCLINES = tuple((angle, share) for angle in (10, 20, 30, 40) for share in (0.5, 0.8, 1.2, 1.5))
"""Angles [degrees] and coefficients of friction over their tangents."""
RADIUS, BED = 0.3, (3.0, 0.4)
"""Of the discs that roll, and the length and depth of their beds [m]."""
SAND = {"E": 2e7, "nu": 0.3, "friction_angle": 0.52, "smallest_strain": 0.03}
SAND_DENSITY = 1500.0
FALLS = (0.1, 0.2, 0.4, 0.8)
"""Heights of balls above the sand [m]."""
BALL, HEAP = 0.2, 0.4
"""Diameter of the balls, and depth and half of the width of the sand [m]."""
FLOAT, TANK = 0.15, (1.0, 0.5)
"""Radius of the discs that float, and width and depth of the water [m]."""


class Body:
    """A free rigid body, a disc or a ball, as row [1, 1, 6 or 13] of `mpm.RigidBodies`.

    Args:
        step: the step, with the gravity of the body.
        obstacle: of the body.
        position: of its middle [m].
        mass: [kg] (2-D: per metre).
        inertia: moment of inertia about its middle [kg m²].
    """

    def __init__(self, step: mpm.Step, obstacle: Any, position: Any, mass: float, inertia: float) -> None:
        self.step, self.bodies, self.mass, self.inertia = step, mpm.RigidBodies(step, [obstacle]), mass, inertia
        dim = step.grid.dim
        turn = [0.0] if dim == 2 else [1.0, 0.0, 0.0, 0.0]
        self.rates = 3 if dim == 2 else 6
        self.row = torch.tensor([[[*position, *turn, *[0.0] * self.rates]]], dtype=F64)

    @property
    def velocity(self) -> Tensor:
        """Velocity and angular velocity [3 or 6], which may be assigned."""
        return self.row[0, 0, -self.rates :]

    def advance(self, state: mpm.State, n: int, dt: float, free: Any = 1.0) -> mpm.State:
        """An interval of n steps; accelerations are multiplied by `free`, of one number or one for each component."""
        state, wrench = self.bodies.advance(state, self.row, n, dt)
        dim = self.step.grid.dim
        rates = wrench[0, 0].clone()
        rates[:dim] = rates[:dim] / self.mass + torch.tensor(self.step.gravity, dtype=F64)
        rates[dim:] /= self.inertia
        row = self.row.clone()
        row[0, 0, -self.rates :] += n * dt * rates * torch.as_tensor(free, dtype=F64)
        row[..., : -self.rates] = mpm.bodies.moved(row, n * dt)
        self.row = row
        return state


def still(state: mpm.State, share: float = 0.0) -> mpm.State:
    """A state with a share of its velocities."""
    return state.replace(v=share * state.v, C=None if state.C is None else share * state.C)


# ---- a block on an incline


def incline(angle: float, friction: float, duration: float = 0.5) -> dict[str, Any]:
    """Acceleration of a block along an incline, and that of a rigid block [m/s²]."""
    a, dx, length = math.radians(angle), 0.05, 2.0
    normal, along = (torch.tensor(v, dtype=F64) for v in ((math.sin(a), math.cos(a)), (math.cos(a), -math.sin(a))))
    grid = mpm.Grid(dx, (0.0, 0.0), (length * math.cos(a) + 0.6, length * math.sin(a) + 0.8))
    foot = torch.tensor([0.117, 0.123 + length * math.sin(a)], dtype=F64)
    points = mpm.seed.box((0.0, 0.0), (12 * dx, 4 * dx), grid, per_cell=4)
    x = points.x.double()
    x = foot + (x[:, :1] + 0.25) * along + x[:, 1:] * normal
    law = mpm.NeoHookean(E=1e7, nu=0.3)
    state = mpm.State.at_rest(points, DENSITY, dtype=F64).replace(x=x)

    def step(transfer: str, **plane: Any) -> mpm.Step:
        floor = mpm.Plane(foot.tolist(), normal.tolist(), **plane)
        return mpm.Step(grid, law, (0.0, -GRAVITY), boundaries=[floor], transfer=transfer)

    settling, sliding = step("pic", kind="sticky"), step("apic", friction=friction)
    state = sliding.prepare(state)
    dt = 0.4 * float(sliding.stable_dt(state, 1.0))
    n = round(0.5 * duration / dt)
    state = still(mpm.rollout(settling, state, n, dt))
    speeds = []
    for _ in range(2):
        state = mpm.rollout(sliding, state, n, dt)
        sliding.check(state)
        speeds.append(float(state.v.mean(0) @ along))
    exact = max(0.0, GRAVITY * (math.sin(a) - friction * math.cos(a)))
    found = {"angle": angle, "friction": friction, "tangent": math.tan(a), "speed": speeds[1]}
    return {**found, "acceleration": (speeds[1] - speeds[0]) / (n * dt), "rigid": exact}


# ---- a disc that rolls


def roll(
    cells: int, angle: float, law: Any, speed: float = 0.0, duration: float = 1.0, density: float = DENSITY
) -> dict[str, Any]:
    """Motion of a disc of some cells radius along a bed in inclined gravity: speeds and turns over time."""
    a, dx = math.radians(angle), RADIUS / cells
    disc = mpm.Sphere((0.0, 0.0), RADIUS, friction=0.8)
    grid = mpm.Grid(dx, (0.0, 0.0), (BED[0], BED[1] + 2.5 * RADIUS))
    points = mpm.seed.box((0.0, 0.0), BED, grid, per_cell=4)
    step = mpm.Step(grid, law, (0.0, -GRAVITY * math.cos(a)), "sticky", [disc])
    state = step.prepare(mpm.State.at_rest(points, density, dtype=F64))
    mass = DENSITY * math.pi * RADIUS**2
    body = Body(step, disc, (0.5, BED[1] + RADIUS), mass, 0.5 * mass * RADIUS**2)
    n, dt = 2, 0.4 * float(step.stable_dt(state, 1.0))
    settling = round(0.6 / (n * dt))
    for k in range(settling):  # under the part of gravity that presses the disc on the bed
        state = body.advance(state, n, dt, (0.0, 1.0, 0.0))
        if k < 0.8 * settling:
            share = math.exp(-30.0 * n * dt)
            state = still(state, share)
            body.velocity[:] *= share
    step.gravity = (GRAVITY * math.sin(a), -GRAVITY * math.cos(a))
    body.velocity[:] = torch.tensor([speed, 0.0, -speed / RADIUS], dtype=F64)
    rows = [body.row[0, 0]]
    for _ in range(round(duration / (n * dt))):
        state = body.advance(state, n, dt)
        rows.append(body.row[0, 0])
    step.check(state)
    return _rolled(torch.stack(rows), n * dt, {"cells": cells, "angle": angle, "speed": speed, "T": n * dt})


def _rolled(rows: Tensor, interval: float, found: dict[str, Any]) -> dict[str, Any]:
    seconds = torch.arange(len(rows), dtype=F64) * interval
    later = slice(len(rows) // 4, None)
    slope = math.sin(math.radians(found["angle"]))
    along, turned = float(rows[-1, 0] - rows[0, 0]), float(rows[0, 2] - rows[-1, 2])
    energy = rows[:, 3:5].square().sum(1) / 2 + (RADIUS * rows[:, 5]).square() / 4 - GRAVITY * slope * rows[:, 0]
    return {
        **found,
        "acceleration": float(np.polyfit(seconds[later].numpy(), rows[later, 3].numpy(), 1)[0]),
        "rigid": 2 / 3 * GRAVITY * slope,
        "ratio": along / (RADIUS * turned),
        "end": float(rows[-1, 3]),
        "resistance": float(energy[0] - energy[-1]) / (GRAVITY * along),
    }


# ---- a ball that falls on sand


class Heap:
    """Sand at rest with a ball above it.

    Args:
        dim: 2 for half of a disc at a mirror, 3 for a quarter of a sphere between two mirrors.
        dx: of the lattice [m].
    """

    def __init__(self, dim: int, dx: float) -> None:
        self.dim, self.radius = dim, 0.5 * BALL
        corner = (HEAP,) * dim
        grid = mpm.Grid(dx, (0.0,) * dim, (HEAP, HEAP + BALL + 4 * dx, HEAP)[:dim])
        self.ball = mpm.Sphere((0.0, HEAP + 2 * self.radius, 0.0)[:dim], self.radius, friction=0.5)
        gravity = (0.0, -GRAVITY, 0.0)[:dim]
        self.step = mpm.Step(grid, mpm.QuarticSand(**SAND), gravity, "mirror", [self.ball])
        points = mpm.seed.box((0.0,) * dim, corner, grid, per_cell=2**dim)
        state = self.step.prepare(mpm.State.at_rest(points, SAND_DENSITY, dtype=torch.float32))
        self.dt = 0.4 * float(self.step.stable_dt(state, 1.0))
        for _ in range(20):
            state = still(mpm.rollout(self.step, state, round(0.015 / self.dt), self.dt), 0.3)
        self.state = still(state)
        self.level = float(state.x[:, 1].max()) + 0.25 * dx

    def drop(self, height: float, density: float) -> dict[str, Any]:
        """Largest depth of a ball [m], with a density relative to that of the sand, and the time until then [s]."""
        share = 0.5 ** (self.dim - 1)
        volume = math.pi * self.radius**2 * (1.0 if self.dim == 2 else 4 / 3 * self.radius)
        start = (0.0, self.level + self.radius, 0.0)[: self.dim]
        body = Body(self.step, self.ball, start, share * density * SAND_DENSITY * volume, 1.0)
        body.velocity[1] = -math.sqrt(2 * GRAVITY * height)
        free = torch.zeros(body.rates, dtype=F64)
        free[1] = 1.0
        state, seconds = self.state, 0.0
        while float(body.velocity[1]) < 0:
            state = body.advance(state, 2, self.dt, free)
            seconds += 2 * self.dt
        self.step.check(state)
        depth = start[1] - float(body.row[0, 0, 1])
        return {
            "height": height,
            "density": density,
            "depth": depth,
            "law": _uehara(depth, height, density),
            "time": seconds,
        }


def _uehara(depth: float, height: float, density: float) -> float:
    friction = math.tan(SAND["friction_angle"])
    return 0.14 / friction * math.sqrt(density) * BALL ** (2 / 3) * (height + depth) ** (1 / 3)


def exponent(x: list[float], y: list[float]) -> float:
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def drops(dim: int, dx: float, densities: tuple[float, ...]) -> dict[str, Any]:
    """Depths by height, and by density, with the exponents of H, and of the density at d/H^⅓."""
    heap = Heap(dim, dx)
    falls = [heap.drop(height, 2.0) for height in FALLS]
    others = [heap.drop(FALLS[2], density) for density in densities]
    result = {"dim": dim, "dx": dx, "falls": falls, "others": others}
    result["height exponent"] = exponent([f["height"] + f["depth"] for f in falls], [f["depth"] for f in falls])
    if others:
        reduced = [f["depth"] / (f["height"] + f["depth"]) ** (1 / 3) for f in others]
        result["density exponent"] = exponent([f["density"] for f in others], reduced)
    return result


# ---- momentum


LAWS: dict[str, Callable[[], Any]] = {
    "elastic": lambda: mpm.NeoHookean(E=2e4, nu=0.2),
    "water": lambda: mpm.WeaklyCompressible(2e4, viscosity=1.0),
    "sand": lambda: mpm.QuarticSand(E=1e6, nu=0.3, friction_angle=0.5),
}


def momentum(name: str, kind: str, intervals: int = 60) -> dict[str, Any]:
    """Change of the momentum of material and a disc that hits it, relative to that of the disc."""
    disc = mpm.Sphere((0.0, 0.0), 0.15, kind, friction=0.3)
    grid = mpm.Grid(0.05, (0.0, 0.0), (2.0, 2.0))
    step = mpm.Step(grid, LAWS[name](), (0.0, 0.0), boundaries=[disc])
    points = mpm.seed.box((0.7, 0.6), (1.3, 1.0), grid, per_cell=4)
    state = step.with_impulses(step.prepare(mpm.State.at_rest(points, DENSITY, dtype=F64)))
    body = Body(step, disc, (0.95, 1.2), 100.0, 1.1)
    body.velocity[:] = torch.tensor([0.5, -2.0, 8.0], dtype=F64)
    scale = body.mass * float(body.velocity[:2].norm())

    def total() -> Tensor:
        x, v = body.row[0, 0, :2], body.velocity
        spin = body.mass * (x[0] * v[1] - x[1] * v[0]) + body.inertia * v[2]
        return torch.cat([state.mass @ state.v + body.mass * v[:2], (spin + angular_momentum(step, state))[None]])

    before, start = total(), body.velocity.clone()
    for _ in range(intervals):
        state = body.advance(state, 5, 4e-4)
    step.check(state)
    change = (total() - before).abs() / scale
    return {
        "material": name,
        "kind": kind,
        "linear": float(change[:2].max()),
        "angular": float(change[2]),
        "exchanged": float((body.velocity - start)[:2].norm()) * body.mass / scale,
    }


# ---- a disc that floats


def floating(cells: int, margin: float, density: float, start: float, duration: float = 4.0) -> dict[str, Any]:
    """Depth of a disc of a relative density minus that of Archimedes, in cells; it starts deeper by `start` cells."""
    dx, (width, depth) = FLOAT / cells, TANK
    disc = mpm.Sphere((0.0, 0.0), FLOAT + margin * dx)
    grid = mpm.Grid(dx, (0.0, 0.0), (width, depth + 2 * FLOAT))
    step = mpm.Step(grid, mpm.WeaklyCompressible(1e5, viscosity=30.0), (0.0, -GRAVITY), "mirror", [disc])
    points = mpm.seed.box((0.0, 0.0), (width, depth), grid, per_cell=4)
    middle = torch.tensor([0.5 * width + 0.3 * dx, depth - sunk(density) - start * dx], dtype=F64)
    water = mpm.State.at_rest(points, DENSITY, dtype=F64)
    water = water.select(((water.x - middle).norm(dim=1) > FLOAT).nonzero()[:, 0])
    state = hydrostatic(step, water, depth)
    mass = density * DENSITY * math.pi * FLOAT**2
    body = Body(step, disc, middle.tolist(), mass, 0.5 * mass * FLOAT**2)
    n, dt = 2, 0.4 * dx / 10.0
    found, intervals = [], round(duration / (n * dt))
    for k in range(intervals):
        state = body.advance(state, n, dt)
        if k >= intervals * 2 // 3 and k % 20 == 0:
            x = body.row[0, 0, 0]
            away = (state.x[:, 0] - x).abs() > 2 * FLOAT
            level = float((state.volume * state.J)[away].sum()) / (width - 4 * FLOAT)
            found.append((level - float(body.row[0, 0, 1]) - sunk(density)) / dx)
    step.check(state)
    spread = float(np.std(found))
    return {
        "cells": cells,
        "margin": margin,
        "density": density,
        "start": start,
        "error": float(np.mean(found)),
        "spread": spread,
    }


def sunk(density: float) -> float:
    """Depth of the middle of a floating disc below the level [m]: the segment below has that share of its area."""
    low, high = -1.0, 1.0
    for _ in range(60):
        y = 0.5 * (low + high)
        below = 0.5 + (y * math.sqrt(1 - y * y) + math.asin(y)) / math.pi
        low, high = (y, high) if below < density else (low, y)
    return low * FLOAT


# ---- the program


def jelly() -> mpm.NeoHookean:
    return mpm.NeoHookean(E=1e5, nu=0.3)


def measure(quick: bool) -> dict[str, Any]:
    begin = time.perf_counter()
    result: dict[str, Any] = {"environment": common.environment("cpu")}
    sand = mpm.QuarticSand(**SAND)
    cases: dict[str, list[Callable[[], Any]]] = {
        "inclines": [lambda a=a, s=s: incline(a, s * math.tan(math.radians(a))) for a, s in INCLINES],
        "momentum": [lambda m=m, k=k: momentum(m, k) for m in LAWS for k in ("separate", "sticky")],
        "jelly": [lambda c=c, a=a: roll(c, a, jelly()) for c, a in ((6, 10), (12, 10), (24, 10), (12, 20))],
        "sand": [lambda c=c: roll(c, 0, sand, 2.0, 0.5, SAND_DENSITY) for c in (6, 12)],
        "drops": [lambda: drops(2, 0.025, ()), lambda: drops(2, 0.0125, ()), lambda: drops(3, 0.025, (1.0, 2.0, 4.0))],
        "floating": [
            lambda c=c, m=m, d=d, s=s: floating(c, m, d, s)
            for c in (6, 12)
            for m in (0, 0.75)
            for d, s in ((0.5, -2.0), (0.5, 2.0), (0.8, 2.0))
        ],
        "gradients": [lambda n=n: list(body_gradients.compared(n)) for n in body_gradients.CASES],
    }
    if quick:
        cases = {name: cases[name][:1] for name in ("inclines", "momentum", "jelly", "drops", "gradients")}
    for name, calls in cases.items():
        result[name] = []
        for call in calls:
            result[name].append(call())
            print(name, result[name][-1], f"{time.perf_counter() - begin:.0f} s", flush=True)
    result["seconds"] = time.perf_counter() - begin
    return result


def text(result: dict[str, Any]) -> str:
    parts = {
        "A block on an incline": _inclines(result["inclines"]),
        "A disc that rolls down an elastic bed": _rolls(result["jelly"]),
        "A disc that rolls on level sand": _rolls(result.get("sand", [])),
        "Balls that fall on sand": _drops(result["drops"]),
        "Momentum of material and body": common.table(
            ("material", "contact", "momentum exchanged", "linear", "angular"),
            [(m["material"], m["kind"], m["exchanged"], m["linear"], m["angular"]) for m in result["momentum"]],
        ),
        "A disc that floats": common.table(
            (
                "radius, dx",
                "margin, dx",
                "relative density",
                "starts deeper by, dx",
                "rests deeper by, dx",
                "moves by, dx",
            ),
            [
                (
                    f["cells"],
                    f"{f['margin']:g}",
                    f["density"],
                    f"{f['start']:g}",
                    f"{f['error']:.2f}",
                    f"{f['spread']:.2f}",
                )
                for f in result.get("floating", [])
            ],
        ),
        "Gradients through bodies and material": common.table(
            ("case", "of", "by", "derivative", "deviation from differences"),
            [
                (g["case"], g["of"], g["by"], g["derivative"], f"{g['deviation']:.0e}")
                for found in result["gradients"]
                for g in found
            ],
        ),
    }
    lines = ["# Rigid bodies and material", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    for name, table in parts.items():
        lines += [f"## {name}", "", table, ""]
    return "\n".join(lines)


def _inclines(rows: list[dict[str, Any]]) -> str:
    header = ("angle", "tan a", "μ", "acceleration [m/s²]", "rigid block [m/s²]", "speed at the end [m/s]")
    keys = ("tangent", "friction", "acceleration", "rigid", "speed")
    return common.table(header, [(f"{r['angle']}°", *(f"{r[key]:.3f}" for key in keys)) for r in rows])


def _rolls(rows: list[dict[str, Any]]) -> str:
    header = (
        "radius, dx",
        "angle",
        "acceleration [m/s²]",
        "2/3 g sin a",
        "distance over turns",
        "end [m/s]",
        "resistance",
    )
    cells = []
    for row in rows:
        numbers = (f"{row[key]:.3f}" for key in ("acceleration", "rigid", "ratio", "end", "resistance"))
        cells.append((row["cells"], f"{row['angle']}°", *numbers))
    return common.table(header, cells)


def _drops(series: list[dict[str, Any]]) -> str:
    rows = [
        (f"{s['dim']}-D", s["dx"], f["height"], f["density"], f"{f['depth']:.4f}", f"{f['depth'] / f['law']:.2f}")
        + (f"{f['time']:.3f}",)
        for s in series
        for f in (*s["falls"], *s["others"])
    ]
    header = ("", "dx [m]", "fall [m]", "relative density", "depth [m]", "over the law of spheres", "time to stop [s]")
    lines = [common.table(header, rows), "", f"Diameter {BALL:g} m.", ""]
    for s in series:
        more = f", of the density {s['density exponent']:.2f} (published 1/2)" if "density exponent" in s else ""
        expected = "published 1/3" if s["dim"] == 3 else "at most 1/2"
        lines.append(
            f"- {s['dim']}-D, dx = {s['dx']:g} m: exponent of H {s['height exponent']:.3f} ({expected}){more}."
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one case of some parts, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    with common.one_thread():
        result = measure(arguments.quick)
    common.write(arguments.out, "rigid_bodies", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
