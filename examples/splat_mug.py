"""A mug of Gaussian splats wobbles, melts and pours.

The mug is made here: flat coloured Gaussians on its walls, its bottom and its handle, in a file as 3-D Gaussian
splatting writes it. Three scenes differ in its material: jelly that drops on the floor, wax on a hot plate, and syrup
that runs over a ball. Each writes the splats of its frames, pictures and a video; `torch-mpm splats` does the same with
a scene file.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm import render, splats
from torch_mpm.scene.splat_frames import write_frames
from torch_mpm.scene.splat_pictures import draw_frames

RADIUS, HEIGHT, WALL = 1.0, 2.4, 0.3  # of the mug, in units of its file
HANDLE, THICKNESS = 0.62, 0.17  # radius of the ring of the handle, and of its section
TEAL, CREAM, ORANGE = (0.05, 0.5, 0.55), (0.95, 0.9, 0.8), (0.95, 0.5, 0.15)

# ---- the mug


def uniform(count: int) -> tuple[Tensor, Tensor]:
    """Points that fill the unit square evenly (Roberts 2018)."""
    k = torch.arange(count, dtype=torch.float64) + 1
    return k * 0.7548776662466927 % 1, k * 0.5698402909980532 % 1


def revolved(start: tuple[float, float], end: tuple[float, float], density: float) -> tuple[Tensor, Tensor]:
    """Points and normals on the surface that a segment (radius, height) sweeps about the y axis."""
    (r0, y0), (r1, y1) = start, end
    length = math.hypot(r1 - r0, y1 - y0)
    a, b = uniform(round(density * math.pi * (r0 + r1) * length))
    if r0 != r1:
        a = (torch.sqrt(r0**2 + a * (r1**2 - r0**2)) - r0) / (r1 - r0)  # Evenly over a disc.
    r, y, angle = r0 + a * (r1 - r0), y0 + a * (y1 - y0), 2 * math.pi * b
    out, up = (y1 - y0) / length, (r0 - r1) / length
    x = torch.stack([r * angle.cos(), y, r * angle.sin()], 1)
    return x, torch.stack([out * angle.cos(), up + 0 * y, out * angle.sin()], 1)


def handle(density: float) -> tuple[Tensor, Tensor]:
    """Points and normals on the part of a ring outside the mug."""
    a, b = uniform(round(density * 4 * math.pi**2 * HANDLE * THICKNESS))
    a, b = 2 * math.pi * a, 2 * math.pi * b
    around = torch.stack([a.cos(), a.sin(), 0 * a], 1)
    normal = b.cos()[:, None] * around + b.sin()[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    x = torch.tensor([RADIUS, 0.5 * HEIGHT, 0.0], dtype=torch.float64) + HANDLE * around + THICKNESS * normal
    outside = x[:, [0, 2]].norm(dim=1) > RADIUS
    return x[outside], normal[outside]


def stripes(x: Tensor) -> Tensor:
    """Colours [N, 3] of the outer wall."""
    wave = x[:, 1] / HEIGHT + 0.06 * torch.sin(3 * torch.atan2(x[:, 2], x[:, 0]))
    light = ((wave * 6) % 1 > 0.68) & (wave > 0.12) & (wave < 0.95)
    return torch.where(light[:, None], torch.tensor(CREAM).double(), torch.tensor(TEAL).double())


def mug(count: int) -> splats.Gaussians:
    """About `count` Gaussians, with the y axis up."""
    inner, bottom = RADIUS - WALL, WALL
    area = 2 * math.pi * HEIGHT * (RADIUS + inner) + math.pi * (3 * RADIUS**2) + 4 * HANDLE * THICKNESS * math.pi**2
    density = count / area
    pieces = [
        revolved((RADIUS, 0.0), (RADIUS, HEIGHT), density),
        revolved((RADIUS, HEIGHT), (inner, HEIGHT), density),
        revolved((inner, HEIGHT), (inner, bottom), density),
        revolved((inner, bottom), (0.0, bottom), density),
        revolved((0.0, 0.0), (RADIUS, 0.0), density),
        handle(density),
    ]
    plain = [None, CREAM, CREAM, CREAM, TEAL, ORANGE]
    colors = [
        stripes(x) if color is None else torch.tensor(color).double().expand(len(x), 3)
        for (x, _), color in zip(pieces, plain, strict=True)
    ]
    x, normal, color = (torch.cat(t) for t in ([p[0] for p in pieces], [p[1] for p in pieces], colors))
    first = torch.nn.functional.normalize(
        torch.linalg.cross(normal, torch.eye(3, dtype=x.dtype)[normal.abs().argmin(1)]), dim=1
    )
    spacing = 0.65 / math.sqrt(density)
    axes = spacing * torch.stack([first, torch.linalg.cross(normal, first), 0.15 * normal], 2)
    harmonics = shaded(color, normal)
    return splats.Gaussians(x, axes, torch.full_like(x[:, 0], 4.0), harmonics).to(dtype=torch.float32)


def shaded(color: Tensor, normal: Tensor) -> Tensor:
    """Harmonics [N, 4, 3] of colours that are lighter on top, and where the surface faces the viewer.

    A part −0.25 (n · d) of the colour depends on the direction d of the view, in harmonics of the degree 1.
    """
    one = splats.basis(torch.zeros(3, dtype=color.dtype), 0)
    facing = torch.linalg.solve(splats.basis(torch.eye(3, dtype=color.dtype), 1)[:, 1:], -0.25 * normal.T).T
    base = color * (0.6 + 0.2 * normal[:, 1:2])
    return torch.cat([((base - 0.5) / one)[:, None], facing[:, :, None] * color[:, None]], 1)


# ---- the scenes


def scene(file: Path, frames: int, resolution: tuple[int, int], **changes: Any) -> mpm.Scene:
    """The mug in a tank."""
    body = {"shape": "splats", "file": str(file.resolve()), "extent": 0.3, "material": "mug", **changes.pop("body")}
    words: dict[str, Any] = {
        "gravity": (0, -9.8, 0),
        "fps": 30.0,
        "duration": frames / 30,
        "grid": {"lower": (0, 0, 0), "upper": (0.6, 0.6, 0.6), "dx": 1 / 64, "walls": "separate", "friction": 0.3},
        "body": [body],
        "render": {"resolution": resolution, "view": ((0.05, 0.0, 0.05), (0.55, 0.45, 0.55))},
        "device": changes.pop("device"),
    }
    return mpm.Scene(**words, **changes)


def scenes(file: Path, frames: int, resolution: tuple[int, int], device: str) -> dict[str, mpm.Scene]:
    """Jelly, wax and syrup."""
    jelly = {"law": "neo_hookean", "density": 1000.0, "E": 2e4, "nu": 0.4}
    wax = {
        "law": "neo_hookean",
        "density": 900.0,
        "E": 1e5,
        "nu": 0.35,
        "conductivity": 8000.0,
        "specific_heat": 1000.0,
        "melting_point": 330.0,
        "latent_heat": 2e4,
        "liquid": {"bulk_modulus": 1e5, "viscosity": 2.0},
    }
    plate = {
        "shape": "box", "center": (0.3, 0.0, 0.3), "size": (0.6, 0.1, 0.6), "contact": "sticky", "temperature": 450.0,
        "held": "surface",
    }  # fmt: skip
    syrup = {"law": "weakly_compressible", "density": 1300.0, "bulk_modulus": 1e5, "viscosity": 20.0}
    ball = {"shape": "sphere", "center": (0.28, 0.08, 0.3), "radius": 0.1, "contact": "sticky"}

    def make(**changes: Any) -> mpm.Scene:
        return scene(file, frames, resolution, device=device, **changes)

    return {
        "wobble": make(
            material={"mug": jelly}, body={"center": (0.3, 0.2, 0.3), "spin": (0.0, 0.0, -3.0), "velocity": (0.4, 0, 0)}
        ),
        "melt": make(
            material={"mug": wax}, body={"center": (0.3, 0.202, 0.3), "temperature": 305.0}, obstacle=[plate],
            heat={"reference": 330.0},
        ),
        "pour": make(material={"mug": syrup}, body={"center": (0.3, 0.34, 0.3)}, obstacle=[ball]),
    }  # fmt: skip


def main(
    out: Path, device: str = "cpu", count: int = 12000, frames: int = 45, resolution: tuple[int, int] = (480, 360)
) -> dict[str, list[Path]]:
    """Returns the pictures of each scene."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "mug.ply"
    splats.write(file, mug(count))
    pictures = {}
    for name, made in scenes(file, frames, resolution, device).items():
        summary = made.run(out / name)
        write_frames(out / name, made, torch.device(device))
        *pictures[name], _ = draw_frames(out / name, made, device=torch.device(device))
        print(f"{name}: {summary['particles']} particles, {summary['substeps']} substeps", flush=True)
    chosen = [round(share * frames) for share in (0.0, 0.25, 1.0)]
    sheet = render.contact_sheet([render.read_png(paths[k]) for paths in pictures.values() for k in chosen], 3)
    render.write_png(out / "splat_mug.png", sheet, width=640)
    return pictures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/splat_mug"), help="folder of the scenes; a new one")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--count", type=int, default=12000, help="number of Gaussians of the mug")
    parser.add_argument("--frames", type=int, default=45)
    options, begin = parser.parse_args(), time.perf_counter()
    main(options.out, options.device, options.count, options.frames)
    print(f"{time.perf_counter() - begin:.0f} s; see {options.out / 'splat_mug.png'}")
