"""Water at rest in containers made of obstacles, and a block that slides over ten seams of its floor.

    python -m benchmarks.accuracy.containers             # 10 s of each, some minutes on one core
    python -m benchmarks.accuracy.containers --quick     # seconds

Water is seeded at rest under its own pressure. Counted are particles that are more than dx/2
below the floor or outside of the container. The pressure on the floor is that of a line through the pressures of the
particles of a column in the middle, averaged over records of the last fifth of the time. It should be the weight of the
column over its area. The block should keep its speed, without friction.
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
        floor: height of the floor above the x, z of points [N, D] [m]: water is nowhere below.
        water: lower and upper corner of the box of water, of which what is in obstacles or below is left out.
    """

    name: str
    dim: int
    obstacles: Callable[[], list[Any]]
    floor: Callable[[Tensor], Tensor]
    water: tuple[tuple[float, ...], tuple[float, ...]]


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
    """A channel with an upright and a level arm, of which the step between them is a fourth box."""
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
            Container("tank of boxes", dim, lambda dim=dim: _tank(dim), _flat, full),
            Container("cup", dim, lambda dim=dim: _cup(dim), _flat, full),
            Container("hopper", dim, lambda dim=dim: _hopper(dim), _slope, wide),
            Container("L-shaped channel", dim, lambda dim=dim: _channel(dim), _flat, full),
        ]
    if bowl:
        found.append(Container("mesh bowl", 3, lambda: _bowl(3), _sphere, ((-half, 0.0, -half), (half, DEPTH, half))))
    return found


def run(case: Container, dx: float, duration: float) -> dict[str, Any]:
    """Particles that have left and the pressure on the floor relative to the weight of a column."""
    dim, half = case.dim, 0.5 * SIDE + WALL + DEPTH
    grid = mpm.Grid(dx, (-half, -WALL - 4 * dx, -half)[:dim], (half, 3 * DEPTH, half)[:dim])
    obstacles = case.obstacles()
    points = mpm.seed.box(*case.water, grid, per_cell=2**dim)
    distance = torch.stack([o.signed_distance(points.x, None, 0.0) for o in obstacles]).amin(0)
    free = (distance > 0.2 * dx) & (points.x[:, 1] > case.floor(points.x))
    points = mpm.seed.Points(points.x[free], points.volume[free])
    state = mpm.State.at_rest(points, DENSITY, dtype=torch.float32)
    law = mpm.WeaklyCompressible(BULK, GAMMA, VISCOSITY)
    step = mpm.Step(grid, law, (0.0, -GRAVITY, 0.0)[:dim], boundaries=obstacles)
    state = step.prepare(state)
    pressure = DENSITY * GRAVITY * (DEPTH - state.x[:, 1])
    state = state.replace(J=(1 + GAMMA / BULK * pressure) ** (-1 / GAMMA))
    dt = float(step.stable_dt(state, cfl=0.4))
    records, begin = 50, time.perf_counter()
    n = math.ceil(duration / records / dt)
    pressures, left = [], 0
    for k in range(records):
        state = mpm.rollout(step, state, n, duration / records / n)
        step.check(state)
        left = max(left, int(outside(case, state.x, dx).sum()))
        if k >= 0.8 * records:
            pressures.append(pressure_on_floor(state, dim, dx))
    return {
        "name": f"{case.name}, {dim}-D",
        "particles": len(state),
        "steps": records * n,
        "outside": left,
        "pressure": float(np.mean(pressures)),
        "speed": float(state.v.norm(dim=1).mean()),
        "seconds": time.perf_counter() - begin,
    }


def outside(case: Container, x: Tensor, dx: float) -> Tensor:
    """Which particles are below the floor, or beyond the walls, by more than dx/2, bool [P]."""
    below = x[:, 1] < case.floor(x) - 0.5 * dx
    return below | (x[:, 0].abs() > 0.5 * SIDE + DEPTH + 0.5 * dx)


def pressure_on_floor(state: mpm.State, dim: int, dx: float) -> float:
    """Over the weight of the water above, in a column beside the middle."""
    width, middle = 3 * dx, -0.06 if dx < 0.03 else 0.0
    there = (state.x[:, 0] - middle).abs() <= width
    area = 2 * width
    if dim == 3:
        there = there & (state.x[:, 2].abs() <= width)
        area *= 2 * width
    x, mass = state.x[there].double(), state.mass[there].double()
    J = state.J[there].double()
    pressure = BULK / GAMMA * (J**-GAMMA - 1)
    height = x[:, 1].numpy()
    low = height < 0.7 * height.max()
    _, floor = np.polyfit(height[low], pressure.numpy()[low], 1)
    return float(floor / (float(mass.sum()) * GRAVITY / area))


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
            f"{found['name']}: {found['outside']} of {found['particles']} particles outside, pressure "
            f"{found['pressure']:.4f}, {found['seconds']:.0f} s",
            flush=True,
        )
    result["block"] = slide(10, dx, min(1.0, duration))
    print(f"block over {result['block']['seams']} seams: {result['block']['kept']:.4f} of its speed", flush=True)
    return result


def text(result: dict[str, Any]) -> str:
    lines = ["# Water in containers", "", common.describe(result["environment"]), ""]
    lines += [(__doc__ or "").split("\n\n", 2)[2].strip(), ""]
    lines += [f"dx = {result['dx']:g} m, {result['duration']:g} s, float32.", ""]
    header = ("container", "particles", "steps", "outside", "pressure", "mean speed m/s", "seconds")
    rows = [
        (c["name"], c["particles"], c["steps"], c["outside"], f"{c['pressure']:.4f}", f"{c['speed']:.4f}", c["seconds"])
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
