"""Times of steps with free bodies beside those of the same steps without.

    python -m benchmarks.speed.bodies [--device cuda]      # a minute
    python -m benchmarks.speed.bodies --quick              # seconds
    python -m benchmarks.speed.bodies --out DIRECTORY

Balls: two balls on an elastic block in 3-D, one scene. Vessels: 735 particles of water in each scene, in a cup that
swings on a hinge, and beside it a glass that slides, both of three boxes, in 2-D; as obstacles at rest ("obstacles"),
and as bodies. Steps are those of one call, by the wall clock, with one wait for the device at the end. Steps without
bodies have the fastest schedule, and beside it the schedule of those with bodies, `per_step`. "Tracked" are steps
whose gradient is wanted, forward only.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torch_mpm as mpm
from torch_mpm.bodies import Body, FreeBodies, Hinge, Part, Slider
from torch_mpm.envs.vessel import THICK, vessel

from .. import common
from .timing import Clock

Run = Callable[[], object]
DX, WATER = 0.015, (0.2625, 0.1575)
"""Cells [m], and the water in the cup [m]: 35 by 21 particles."""


def balls(dtype: torch.dtype, device: str) -> tuple[mpm.Step, mpm.State, FreeBodies, torch.Tensor]:
    """Two balls on a block of 2048 particles."""
    grid = mpm.Grid(0.1, (0.0,) * 3, (2.0,) * 3)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), (0.0, -9.81, 0.0), "slip")
    points = mpm.seed.box((0.6, 0.6, 0.6), (1.4, 1.0, 1.4), grid, per_cell=8)
    state = mpm.State.at_rest(points, 1000.0, dtype=dtype, device=device)
    bodies = FreeBodies(step, [Body(mpm.Sphere((0.0,) * 3, 0.2, friction=0.5), 10.0, 0.16) for _ in range(2)])
    rows = torch.zeros(1, 2, 13, dtype=torch.float64, device=device)
    rows[..., 1], rows[..., 2], rows[..., 3], rows[..., 8] = 1.18, 1.0, 1.0, -1.0
    rows[0, :, 0] = torch.tensor([0.8, 1.25], device=device)
    return step, state, bodies, rows


def vessels(scenes: int, dtype: torch.dtype, device: str) -> tuple[mpm.Step, mpm.State, FreeBodies, torch.Tensor]:
    """A cup with water and a glass in each scene; the step has them as obstacles, the bodies have a step of their
    own."""
    grid = mpm.Grid(DX, (0.0, 0.0), (1.2, 0.9), scenes=scenes)
    law = mpm.WeaklyCompressible(bulk_modulus=1e5)
    places = [(0.3, 0.4), (0.8, 0.1)]

    def parts() -> list[list[Part]]:
        return [vessel(WATER[0], 0.24, THICK * DX, friction=0.1) for _ in places]

    def step_of(boundaries: list[mpm.Obstacle]) -> mpm.Step:
        return mpm.Step(grid, law, (0.0, -9.81), "separate", boundaries=boundaries)

    at_rest = [
        mpm.Box([a + b for a, b in zip(place, part.position or (0, 0), strict=True)], part.obstacle.shape.size)
        for place, own in zip(places, parts(), strict=True)
        for part in own
    ]
    low = [places[0][0] - 0.5 * WATER[0], places[0][1]]
    points = mpm.seed.box(low, [a + b for a, b in zip(low, WATER, strict=True)], grid, per_cell=4)
    one = mpm.State.at_rest(points, 1000.0, dtype=dtype, device=device)
    state = mpm.State.concatenate([one] * scenes, scene=True)
    cup, glass = parts()
    bodies = [Body(cup, 8.0, 0.2, joint=Hinge((0.35, 0.55))), Body(glass, 8.0, 0.2, joint=Slider((1.0, 0.0)))]
    rows = torch.zeros(scenes, 2, 6, dtype=torch.float64, device=device)
    rows[..., :2] = torch.tensor(places, dtype=torch.float64, device=device)
    return step_of(at_rest), state, FreeBodies(step_of([]), bodies), rows


def times(
    name: str,
    made: tuple[mpm.Step, mpm.State, FreeBodies, torch.Tensor],
    n: int,
    dt: float,
    clock: Clock,
    tracks: bool,
) -> list[object]:
    """A row of the table: ms per step without bodies, without them by `per_step`, and with them; the share of the
    bodies, beside both; and ms with a graph."""
    step, state, bodies, rows = made
    with torch.no_grad(), clock:
        without = clock.steps(lambda: mpm.rollout(step, state, n, dt), n).fastest_ms
        alike = clock.steps(lambda: mpm.rollout(step, state, n, dt, schedule="per_step"), n).fastest_ms
        own = clock.steps(lambda: bodies.advance(state, rows, n, dt), n).fastest_ms
        bodies.check()
        step.check(mpm.rollout(step, state, n, dt))
    given = rows.clone().requires_grad_()
    few = 5
    slow = clock.steps(lambda: bodies.advance(state, given, few, dt), few).fastest_ms if tracks else None
    dtype = str(state.x.dtype).removeprefix("torch.")
    shares = [f"{100 * (own / ms - 1):.0f}" for ms in (without, alike)]
    return [name, len(rows), len(state), dtype, without, alike, own, *shares, slow]


HEADER = (
    "case", "scenes", "particles", "dtype", "without [ms]", "per_step [ms]", "with bodies [ms]", "bodies [%]",
    "of per_step [%]", "tracked [ms]",
)  # fmt: skip


def text(result: dict[str, Any]) -> str:
    place, table = common.describe(result["environment"]), common.table(HEADER, result["rows"])
    return f"# Steps with free bodies\n\n{place}\n\n{table}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="few scenes and steps, to see that it works")
    parser.add_argument("--scenes", type=int, nargs="*", help="numbers of scenes of vessels")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    cuda = arguments.device == "cuda"
    scenes = arguments.scenes or ([1, 4] if arguments.quick else [1, 64, 2048] if cuda else [1, 16])
    n, samples = (5, 3) if arguments.quick else (100, 5)
    clock = Clock(arguments.device, samples, budget=20.0)
    rows = []
    for dtype in (torch.float32, torch.float64):
        rows.append(times("balls", balls(dtype, arguments.device), n, 1e-3, clock, tracks=True))
        for count in scenes:
            made = vessels(count, dtype, arguments.device)
            rows.append(times("vessels", made, n, 1e-4, clock, tracks=count * 735 < 20000))
            common.release_memory()
    result = {"environment": common.environment(arguments.device), "rows": rows}
    print(text(result))
    common.write(arguments.out, f"bodies_{common.slug(result['environment']['device'])}", result, text(result))


if __name__ == "__main__":
    main()
