"""Water at rest in containers made of obstacles, and a block that slides over ten seams of its floor.

    python -m benchmarks.accuracy.containers             # 10 s of each, some minutes on one core
    python -m benchmarks.accuracy.containers --quick     # seconds

Water starts at rest under its own pressure. Particles count as outside when they are more than dx below the floor, in a
wall, or beyond the container. Contact acts at the nodes in a wall, so that material reaches the first of them: up to
dx, and dx/2 on average, where the surface is not one of nodes. The depth is the largest in all records. The force is
the vertical momentum that obstacles and walls take in the last fifth of the time, over that of the weight. The pressure
is the volume average over layers of particles at least dx away from obstacles and 1.5 dx below the surface, over the
weight per area of the water above in a column that is open to the surface; the table has the least-squares factor
between the two. The stress is that per volume of the column, averaged with a hat function of height 4 dx: the pressure
times the volume of the particles there over the volume of the column, which balances the weight. The filling is the
volume of these particles over that of the column: the volume that particles store drifts from that which they take up,
and their pressure with it. A tank of walls of the domain, without obstacles, is the reference. Averages are over
records of the last fifth of the time. The block slides without friction and should keep its speed.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torch_mpm as mpm

from .. import common

GRAVITY, DENSITY, BULK, GAMMA, VISCOSITY = 9.81, 1000.0, 5e4, 7.0, 20.0
"""The viscosity ends sound within seconds."""
SIDE, DEPTH, WALL = 0.4, 0.2, 0.16
"""Width of the containers, depth of the water, and thickness of floor and walls [m]; the floor is at zero."""
SPEED = 2.0
"""Of the block [m/s]."""


@dataclasses.dataclass(frozen=True)
class Container:
    """A container.

    Attributes:
        obstacles: that make it.
        floor: height of the floor above the x, z of points [N, D] [m]: water starts above.
        water: lower and upper corner of the box of water. Particles in obstacles or below them are left out.
        column: middle and half of the width along x of a column that is open to the surface.
        walls: of the domain; none but for the reference.
    """

    name: str
    dim: int
    obstacles: Callable[[], list[Any]]
    floor: Callable[[Tensor], Tensor]
    water: tuple[tuple[float, ...], tuple[float, ...]]
    column: tuple[float, float] = (0.0, 0.08)
    walls: str | None = None


def _box(lower: Sequence[float], upper: Sequence[float]) -> mpm.Box:
    middle = [0.5 * (a + b) for a, b in zip(lower, upper, strict=True)]
    return mpm.Box(middle, [b - a for a, b in zip(lower, upper, strict=True)])


def _tank(dim: int) -> list[Any]:
    """A floor and walls that stand on its level, of boxes that touch."""
    half, out = 0.5 * SIDE, 0.5 * SIDE + WALL
    around = [(-out, out)] * dim
    around[1] = (-WALL, 0.0)
    boxes = [_box(*zip(*around, strict=True))]
    for axis, up in itertools.product([a for a in range(dim) if a != 1], (-1, 1)):
        sides = [(-out, out)] * dim
        sides[1] = (0.0, 2 * DEPTH)
        sides[axis] = (half, out) if up > 0 else (-out, -half)
        boxes.append(_box(*zip(*sides, strict=True)))
    return boxes


def _cup(dim: int) -> list[Any]:
    r, top = 0.5 * SIDE, 2 * DEPTH
    outline = [(0, -WALL), (r + WALL, -WALL), (r + WALL, top), (r, top), (r, 0), (0, 0)]
    return [mpm.Revolved((0.0,) * dim, outline)]


def _hopper(dim: int) -> list[Any]:
    """A closed trough of two boxes at 45° on a floor."""
    length, turn = 1.2, 0.25 * math.pi
    parts: list[Any] = [_box((-1.0, -WALL, -1.0)[:dim], (1.0, 0.0, 1.0)[:dim])]
    for side in (-1, 1):
        foot, along, out = 0.1, length / 2 * math.cos(turn), WALL / 2 * math.sin(turn)
        middle = (side * (foot + along - 0.0 + out), along - out, 0.0)[:dim]
        angle = side * turn
        parts.append(mpm.Box(middle, (length, WALL, 2.0)[:dim], rotation=angle if dim == 2 else (0.0, 0.0, angle)))
    if dim == 3:
        parts += [_box((-1.0, 0.0, a), (1.0, 0.6, a + WALL)) for a in (-0.5 * SIDE - WALL, 0.5 * SIDE)]
    return parts


def _channel(dim: int) -> list[Any]:
    """A channel with an upright and a level arm. A fourth box is the step between them."""
    half = 0.5 * SIDE
    parts = [*_tank(dim), _box((0.0, 0.1, -half)[:dim], (half, 2 * DEPTH, half)[:dim])]
    return parts


def _bowl(dim: int) -> list[Any]:
    """A hemisphere in a block, as a closed mesh that is sampled."""
    import trimesh

    r = 0.5 * SIDE
    rim = [(r * math.sin(t), r - r * math.cos(t)) for t in np.linspace(0.0, 0.5 * math.pi, 17)]
    outline = [(0.0, -WALL), (r + WALL, -WALL), (r + WALL, r + 0.1), (r, r + 0.1), *reversed(rim)]
    solid = trimesh.creation.revolve(np.array(outline), sections=64)
    solid.apply_transform(trimesh.transformations.rotation_matrix(-0.5 * math.pi, (1, 0, 0)))
    shape, margin = mpm.shapes.Mesh(solid), 0.06
    lower, upper = (v.tolist() for v in shape.bounds(3))
    whole = mpm.shapes.Sampled.of(shape, [v - margin for v in lower], [v + margin for v in upper], 0.02)
    return [mpm.boundaries.Obstacle(whole, (0.0,) * dim)]


def _flat(x: Tensor) -> Tensor:
    return torch.zeros_like(x[:, 0])


def _slope(x: Tensor) -> Tensor:
    return (x[:, 0].abs() - 0.1).clamp_min(0)


def _sphere(x: Tensor) -> Tensor:
    r = 0.5 * SIDE
    across = x[:, 0].square() + x[:, 2].square()
    return r - (r * r - across).clamp_min(0).sqrt()


def containers(bowl: bool = True) -> list[Container]:
    half = 0.5 * SIDE
    found = []
    for dim in (2, 3):
        full = ((-half, 0.0, -half)[:dim], (half, DEPTH, half)[:dim])
        wide = ((-half - DEPTH, 0.0, -half)[:dim], (half + DEPTH, DEPTH, half)[:dim])
        found += [
            Container("walls of the domain", dim, list, _flat, full, walls="separate"),
            Container("tank of boxes", dim, lambda dim=dim: _tank(dim), _flat, full),
            Container("cup", dim, lambda dim=dim: _cup(dim), _flat, full),
            Container("hopper", dim, lambda dim=dim: _hopper(dim), _slope, wide),
            Container("L-shaped channel", dim, lambda dim=dim: _channel(dim), _flat, full, (-0.1, 0.06)),
        ]
    if bowl:
        found.append(Container("mesh bowl", 3, lambda: _bowl(3), _sphere, ((-half, 0.0, -half), (half, DEPTH, half))))
    return found


def run(case: Container, dx: float, duration: float) -> dict[str, Any]:
    """Particles that have left, and the force and the pressure relative to the weight."""
    step, state, obstacles = start(case, dx)
    dt = float(step.stable_dt(state, cfl=0.4))
    records, begin = 50, time.perf_counter()
    n = math.ceil(duration / records / dt)
    dt = duration / records / n
    profile, left, depth, taken = Profile(case, dx), 0, 0.0, torch.zeros(())
    for k in range(records):
        if k == records * 4 // 5:
            taken = state.impulse[0, :, 1].sum().double()
        state = mpm.rollout(step, state, n, dt)
        step.check(state)
        depths = depth_of(case, obstacles, state.x)
        left, depth = max(left, int((depths > dx).sum())), max(depth, float(depths.max()) / dx)
        if k >= records * 4 // 5:
            profile.add(state, obstacles)
    taken = state.impulse[0, :, 1].sum().double() - taken
    weight = GRAVITY * float(state.mass.double().sum())
    return {
        "name": f"{case.name}, {case.dim}-D",
        "particles": len(state),
        "steps": records * n,
        "outside": left,
        "depth": depth,
        "force": -float(taken) / (weight * 0.2 * duration),
        "pressure": profile.factor(),
        "stress": profile.stress(),
        "filling": profile.filling(),
        "speed": float(state.v.norm(dim=1).mean()),
        "seconds": time.perf_counter() - begin,
    }


def start(case: Container, dx: float) -> tuple[mpm.Step, mpm.State, list[Any]]:
    """A step, water at rest under its own pressure, and the obstacles."""
    dim, half = case.dim, 0.5 * SIDE + WALL + DEPTH
    if case.walls is None:
        grid = mpm.Grid(dx, (-half, -WALL - 4 * dx, -half)[:dim], (half, 3 * DEPTH, half)[:dim])
    else:
        grid = mpm.Grid(dx, case.water[0], (*case.water[1][:1], 3 * DEPTH, *case.water[1][2:]))
    obstacles = case.obstacles()
    points = mpm.seed.box(*case.water, grid, per_cell=2**dim)
    free = points.x[:, 1] > case.floor(points.x)
    free &= distance(obstacles, points.x) > 0.2 * dx
    points = mpm.seed.Points(points.x[free], points.volume[free])
    law = mpm.WeaklyCompressible(BULK, GAMMA, VISCOSITY)
    step = mpm.Step(grid, law, (0.0, -GRAVITY, 0.0)[:dim], walls=case.walls, boundaries=obstacles)
    state = hydrostatic(step, mpm.State.at_rest(points, DENSITY, dtype=torch.float32), DEPTH)
    return step, step.with_impulses(state), obstacles


def hydrostatic(step: mpm.Step, water: mpm.State, depth: float, gravity: float = GRAVITY) -> mpm.State:
    """Water of a given depth above zero under its own pressure: p = K/γ (J^-γ − 1) with dp/dh = ρ g / J."""
    law, state = step.law, step.prepare(water)
    bulk, gamma = float(law.bulk_modulus), float(law.gamma)
    density = state.mass / state.volume
    J = (1 + (gamma - 1) * density * gravity / bulk * (depth - state.x[:, 1])) ** (-1 / (gamma - 1))
    return state.replace(J=J, volume=state.volume / J, mass=state.mass / J)


def distance(obstacles: list[Any], x: Tensor) -> Tensor:
    if not obstacles:
        return torch.full_like(x[:, 0], math.inf)
    return torch.stack([o.signed_distance(x, None, 0.0) for o in obstacles]).amin(0)


class Profile:
    """Layers of pressure, and the weight above them; stress, filling and weight in parts of the column [n, 3]."""

    def __init__(self, case: Container, dx: float) -> None:
        self.case, self.dx = case, dx
        self.parts: list[list[float]] = []
        self.edges = np.arange(0.0, 1.5 * DEPTH, 0.5 * dx)
        self.mass, self.volume, self.work = (np.zeros(len(self.edges) - 1) for _ in range(3))
        self.records = 0

    def add(self, state: mpm.State, obstacles: list[Any]) -> None:
        x, J = state.x.double(), state.J.double()
        middle, half = self.case.column
        column = (x[:, 0] - middle).abs() <= half
        if self.case.dim == 3:
            column &= x[:, 2].abs() <= half
        self.mass += self._sum(x[column], state.mass[column])
        inner = (distance(obstacles, state.x) > self.dx) & (x[:, 1] > self.case.floor(x) + self.dx)
        volume = state.volume.double() * J
        self.volume += self._sum(x[inner], volume[inner])
        work = volume * BULK / GAMMA * (J**-GAMMA - 1)
        self.work += self._sum(x[inner], work[inner])
        self.records += 1
        self._add_parts(x[column, 1], volume[column], work[column], state.mass[column].double())

    def _add_parts(self, y: Tensor, volume: Tensor, work: Tensor, mass: Tensor) -> None:
        middle, half = self.case.column
        edge = torch.zeros(1, self.case.dim, dtype=torch.float64)
        edge[:, ::2] = half
        edge[:, 0] += middle
        reach, area = 2 * self.dx, (2 * half) ** (self.case.dim - 1)
        height = float(self.case.floor(edge)) + reach
        while height + reach < float(y.max()) - 1.5 * self.dx:
            away = ((y - height) / reach).clamp(-1, 1)
            share = (1 - away.abs()) / reach
            below = 0.5 + away - 0.5 * away * away.abs()  # its integral up to y
            sums = (work * share).sum(), (volume * share).sum(), GRAVITY * (mass * below).sum()
            self.parts.append([float(v) / area for v in sums])
            height += 0.5 * self.dx

    def _sum(self, x: Tensor, value: Tensor) -> np.ndarray:
        return np.histogram(x[:, 1].numpy(), self.edges, weights=value.double().numpy())[0]

    def stress(self) -> float:
        """Of the least squares between stress and weight above; NaN where the water is too low for a part."""
        stress, _, weight = np.array(self.parts).reshape(-1, 3).T
        return float((stress * weight).sum() / (weight * weight).sum()) if self.parts else math.nan

    def filling(self) -> float:
        return float(np.mean([filling for _, filling, _ in self.parts])) if self.parts else math.nan

    def factor(self) -> float:
        """Of the least squares between pressure and weight above."""
        area = (2 * self.case.column[1]) ** (self.case.dim - 1) * self.records
        above = (np.cumsum(self.mass[::-1])[::-1] - 0.5 * self.mass) * GRAVITY / area
        there = (self.volume > 0) & (above > 1.5 * self.dx * DENSITY * GRAVITY)
        pressure, weight = self.work[there] / self.volume[there], above[there]
        share = self.volume[there]
        return float((share * pressure * weight).sum() / (share * weight * weight).sum())


def depth_of(case: Container, obstacles: list[Any], x: Tensor) -> Tensor:
    """How far particles are below the floor, in obstacles or beyond these [P] [m]; negative inside the container."""
    beyond = torch.maximum(-x[:, 1], x[:, 0].abs() - (0.5 * SIDE + DEPTH))
    return torch.maximum(beyond, -distance(obstacles, x))


def slide(seams: int, dx: float, duration: float) -> dict[str, Any]:
    """Speed of a block after it slid over a floor of boxes, over its speed before."""
    ends = [-0.4, *(0.5 + (k + 0.37 * (k % 3)) * 1.3 / seams for k in range(seams)), 3.0]
    grid = mpm.Grid(dx, (0.0, -0.4), (2.6, 0.6))
    block = mpm.seed.box((0.1, 0.0), (0.3, 0.2), grid, per_cell=4)
    state = mpm.State.at_rest(block, DENSITY, velocity=(SPEED, 0.0), dtype=torch.float32)
    floor = [_box((a, -0.4), (b, 0.0)) for a, b in itertools.pairwise(ends)]
    step = mpm.Step(grid, mpm.NeoHookean(E=1e5, nu=0.3), (0.0, -GRAVITY), boundaries=floor)
    dt = float(step.stable_dt(state, cfl=0.4))
    state = mpm.rollout(step, state, math.ceil(duration / dt), dt)
    step.check(state)
    return {"seams": seams, "kept": float(state.v[:, 0].mean()) / SPEED, "lowest": float(state.x[:, 1].min())}


def measure(cases: Sequence[Container], dx: float, duration: float) -> dict[str, Any]:
    result: dict[str, Any] = {"environment": common.environment("cpu"), "dx": dx, "duration": duration, "cases": []}
    for case in cases:
        found = run(case, dx, duration)
        result["cases"].append(found)
        print(
            f"{found['name']}: {found['outside']} of {found['particles']} particles outside, depth "
            f"{found['depth']:.2f} dx, force {found['force']:.4f}, pressure {found['pressure']:.4f}, stress "
            f"{found['stress']:.4f}, filling {found['filling']:.4f}, {found['seconds']:.0f} s",
            flush=True,
        )
    result["block"] = slide(10, dx, min(1.0, duration))
    print(f"block over {result['block']['seams']} seams: {result['block']['kept']:.4f} of its speed", flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    lines = ["# Water in containers", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    lines += [f"dx = {result['dx']:g} m, {result['duration']:g} s, float32.", ""]
    header = (
        *("container", "particles", "steps", "outside", "depth, dx", "force", "pressure", "stress", "filling"),
        *("mean speed m/s", "seconds"),
    )
    rows = [
        (
            *(c["name"], c["particles"], c["steps"], c["outside"]),
            f"{c['depth']:.2f}",
            *(f"{c[name]:.4f}" for name in ("force", "pressure", "stress", "filling", "speed")),
            f"{c['seconds']:.0f}",
        )
        for c in result["cases"]
    ]
    block = result["block"]
    lines += [common.table(header, rows), "", f"The block keeps {block['kept']:.4f} of its speed over ten seams.", ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a coarse lattice for a short time, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    cases = containers(bowl=not arguments.quick)
    if arguments.quick:
        cases = [case for case in cases if case.dim == 2]
    result = measure(cases, 0.04 if arguments.quick else 0.02, 0.5 if arguments.quick else 10.0)
    common.write(arguments.out, "containers", result, text(result))


if __name__ == "__main__":
    sys.exit(main())
