"""Time of a substep of one scene, by whichever torch_mpm is imported; started by `benchmarks/beside.py`.

    python benchmarks/beside_worker.py NAME DEVICE STEPS REPEATS

Prints the times of all repeats [s], as JSON. It uses nothing of the other benchmarks, so that it also runs with older
versions of the library.
"""

from __future__ import annotations

import inspect
import json
import sys
import time
import warnings
from collections.abc import Callable, Sequence

import torch

import torch_mpm as mpm

Case = Callable[[str], tuple[mpm.Step, mpm.State]]
"""Makes a step and a state on a device."""
DENSITY, DX, SPACING = 1000.0, 1.0, 0.5
DT = 1e-3
"""A time step [s] far below the limit."""


def cube(dim: int, side: int, scenes: int, device: str) -> tuple[mpm.Grid, mpm.State]:
    """Cubes of `side` particles along an edge, with room on all sides."""
    cells = side * SPACING
    grid = mpm.Grid(DX, (0.0,) * dim, (2 * cells + 8,) * dim, scenes=scenes)
    axis = 4 + cells / 2 + SPACING * (torch.arange(side) + 0.5)
    x = torch.cartesian_prod(*[axis] * dim).to(torch.float32)
    scene = torch.arange(scenes, dtype=torch.int32).repeat_interleave(len(x)) if scenes > 1 else None
    points = mpm.seed.Points(x.repeat(scenes, 1), torch.full((scenes * len(x),), SPACING**dim), scene)
    velocity = (0.5, -1.0, 0.25)[:dim]
    return grid, mpm.State.at_rest(points, DENSITY, velocity, torch.float32, device=device)


def obstacles(count: int, dim: int, side: int) -> list[mpm.boundaries.Obstacle]:
    """A plane below the cube, a box and a sphere that touch it."""
    middle, low = 4 + side * SPACING, 4 + side * SPACING / 2
    size = side * SPACING / 2
    at = (middle, low, middle)[:dim]
    contact = {"kind": "separate", "friction": 0.3}
    shapes = [
        (mpm.shapes.Box((size,) * dim), at),
        (mpm.shapes.Plane((0.0, 1.0, 0.0)[:dim]), at),
        (mpm.shapes.Sphere(size / 2), (low, middle, low)[:dim]),
    ]
    return [mpm.boundaries.Obstacle(shape, place, **contact) for shape, place in shapes[:count]]


def not_compensated() -> dict[str, bool]:
    """Options of a step whose positions are not compensated for rounding, as older versions never do."""
    return {"compensated": False} if "compensated" in inspect.signature(mpm.Step).parameters else {}


def elastic(dim: int, side: int, scenes: int = 1, bodies: int = 0, law: str = "elastic") -> Case:
    def made(device: str) -> tuple[mpm.Step, mpm.State]:
        grid, state = cube(dim, side, scenes, device)
        laws = {
            "elastic": lambda: mpm.NeoHookean(E=1e5, nu=0.3),
            "sand": lambda: mpm.QuarticSand(E=1e5, nu=0.3, friction_angle=0.6),
            "fluid": lambda: mpm.WeaklyCompressible(1e5),
        }
        options = {"boundaries": obstacles(bodies, dim, side), **not_compensated()}
        step = mpm.Step(grid, laws[law](), (0.0, -10.0, 0.0)[:dim], "separate", **options)
        return step, step.prepare(state)

    return made


def heated(dim: int, side: int) -> Case:
    def made(device: str) -> tuple[mpm.Step, mpm.State]:
        grid, state = cube(dim, side, 1, device)
        heat = mpm.Heat(grid, conductivity=1.0, specific_heat=1000.0)
        law, options = mpm.NeoHookean(E=1e5, nu=0.3), not_compensated()
        step = mpm.Step(grid, law, (0.0, -10.0, 0.0)[:dim], "separate", heat=heat, **options)
        return step, step.prepare(state.replace(temperature=state.x[:, 0].clone()))

    return made


CASES: dict[str, Case] = {
    **{
        f"{dim}-D, {side**dim * scenes} particles{f' in {scenes} scenes' if scenes > 1 else ''}, {bodies} obstacles": (
            elastic(dim, side, scenes, bodies)
        )
        for dim, side, scenes in ((2, 96, 1), (3, 24, 1), (3, 56, 1), (3, 126, 1), (3, 13, 64))
        for bodies in (0, 1, 2, 3)
    },
    **{
        f"3-D, {side**3} particles of {law}": elastic(3, side, law=law)
        for law in ("sand", "fluid")
        for side in (22, 46)
    },
    **{f"3-D, {side**3} particles with heat": heated(3, side) for side in (22, 46)},
}
"""Steps and states by name."""


def times(name: str, device: str, steps: int, repeats: int) -> Sequence[float]:
    """Times of a substep [s]; the first call is not measured."""
    step, state = CASES[name](device)

    def wait() -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    found = []
    for _ in range(1 + repeats):
        wait()
        start = time.perf_counter()
        end = mpm.rollout(step, state, steps, DT)
        wait()
        found.append((time.perf_counter() - start) / steps)
    step.check(end)
    return found[1:]


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # motion below rounding, thin walls
    with torch.no_grad():
        print(json.dumps(times(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))))
