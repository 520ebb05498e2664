"""Discs of three densities float in water as deep as Archimedes' law says, without another simulator.

Contact acts at the nodes inside a shape, so that water under pressure reaches somewhat into it: the discs have contact
shapes that are 3/4 dx larger (docs/limitations.md).
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch

import torch_mpm as mpm
from torch_mpm import render
from torch_mpm.bodies import Body, FreeBodies

DENSITIES = 0.3, 0.6, 0.9  # of the discs, over that of the water
RADIUS, WIDTH, DEPTH, DENSITY, GRAVITY = 0.12, 1.5, 0.4, 1000.0, 9.8
BULK_MODULUS, VISCOSITY = 1e5, 20.0  # of the water [Pa], [Pa s]
LOWER, UPPER = (0.0, 0.0), (WIDTH, 0.9)
PLACES = 0.25, 0.75, 1.25  # of the discs [m]
LARGER = 0.75  # of the contact shapes, in dx


def height_of_water_line(density: float) -> float:
    """Height of the water above the centre of a floating disc, over its radius."""
    low, high = -1.0, 1.0
    for _ in range(60):
        h = 0.5 * (low + high)
        below = 0.5 + (h * math.sqrt(1 - h * h) + math.asin(h)) / math.pi  # share of the area
        low, high = (h, high) if below < density else (low, h)
    return low


def scene(dx: float, device: str) -> tuple[FreeBodies, mpm.State, torch.Tensor]:
    """Water at rest, and discs that touch it."""
    grid = mpm.Grid(dx, LOWER, UPPER)
    step = mpm.Step(grid, mpm.WeaklyCompressible(BULK_MODULUS, viscosity=VISCOSITY), (0.0, -GRAVITY), "slip")
    discs = []
    for density in DENSITIES:
        mass = density * DENSITY * math.pi * RADIUS**2
        discs.append(Body(mpm.Sphere((0.0, 0.0), RADIUS + LARGER * dx), mass, 0.5 * mass * RADIUS**2))
    points = mpm.seed.box((0.0, 0.0), (WIDTH, DEPTH), grid, per_cell=4)
    rows = [[x, DEPTH + RADIUS + LARGER * dx, 0.0, 0.0, 0.0, 0.0] for x in PLACES]
    water = mpm.State.at_rest(points, DENSITY, device=device)
    return FreeBodies(step, discs), water, torch.tensor([rows], dtype=torch.float64, device=device)


def float_discs(dx: float = 0.02, seconds: float = 5.0, device: str = "cpu") -> dict[str, list]:
    """Times [s], positions of the water, and centres and angles of the discs [K, 3]."""
    bodies, state, rows = scene(dx, device)
    dt = 0.4 * float(bodies.step.stable_dt(state, 1.0))
    n = round(0.04 / dt)
    found: dict[str, list] = {"time": [], "water": [], "discs": []}
    while state.time < seconds:
        state, rows = bodies.advance(state, rows, n, dt)
        bodies.check()
        found["time"].append(state.time)
        found["water"].append(state.x.cpu())
        found["discs"].append(rows[0, :, :3].cpu())
    bodies.step.check(state)
    return found


def water_level() -> float:
    """Height of the water at rest [m]: with the displaced volumes, and compressed by its own weight."""
    level = DEPTH + sum(DENSITIES) * math.pi * RADIUS**2 / WIDTH
    return level - DENSITY * GRAVITY * level**2 / (2 * BULK_MODULUS)


def depths(found: dict[str, list]) -> list[float]:
    """Heights of the water above the centres of the discs, over their radius, by the means of the last second."""
    centres = torch.stack(
        [d[:, 1] for d, t in zip(found["discs"], found["time"], strict=True) if t > found["time"][-1] - 1]
    )
    return [(water_level() - float(y)) / RADIUS for y in centres.mean(0)]


def draw(found: dict[str, list], out: Path) -> None:
    """A video, and a picture of three times."""
    disc = render.shapes.sphere((0.0, 0.0), RADIUS)
    with render.Renderer((LOWER, UPPER), (640, 384), None, gravity=(0.0, -1.0)) as renderer:
        frames = [
            renderer.frame(x, obstacles=[disc.posed(at[:2].numpy(), _turn(float(at[2]))) for at in discs], time=seconds)
            for x, discs, seconds in zip(found["water"], found["discs"], found["time"], strict=True)
        ]
    with render.VideoWriter(out / "floating_bodies.mp4", fps=25) as video:
        for frame in frames:
            video.append(frame)
    images = [frames[round(share * (len(frames) - 1))] for share in (0.0, 0.15, 1.0)]
    render.write_png(out / "floating_bodies.png", render.contact_sheet(images, 3), width=960)


def _turn(angle: float):
    return render.shapes.rotation_matrix(angle, 2)


def main(out: Path, device: str = "cpu", dx: float = 0.02, seconds: float = 5.0) -> list[float]:
    """Returns the heights of the water above the centres, over the radius."""
    out.mkdir(parents=True, exist_ok=True)
    found = float_discs(dx, seconds, device)
    measured = depths(found)
    for density, height in zip(DENSITIES, measured, strict=True):
        exact = height_of_water_line(density)
        print(f"density {density:g}: water {height:.3f} R above the centre, Archimedes {exact:.3f} R")
    draw(found, out)
    return measured


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/floating"), help="folder of the picture and the video")
    parser.add_argument("--device", default="cpu")
    torch.set_num_threads(1)  # Few particles: more threads would only wait for each other.
    options, begin = parser.parse_args(), time.perf_counter()
    with torch.no_grad():
        main(options.out, options.device)
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'floating_bodies.png'}")
