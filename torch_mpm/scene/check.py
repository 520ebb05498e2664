"""Problems of a scene that can be found before particles are seeded.

Invalid parts of the scene are None (:mod:`.partial`); parts that depend on them are not checked.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel
from torch import Tensor

from .. import boundaries
from ..data import host_memory
from ..files import check_file
from ..geometry import seed
from ..grid import resolution
from ..grid.grid import MOST_NODES, Grid
from . import heat, schema
from .places import obstacle, region, relative

PARTICLE_BYTES = 400
"""Minimum memory per particle while a scene is built and simulated."""
FRAMES = 10**8
PIXELS = range(16, 16385)


def problems(scene: Any, entries: Sequence[Any]) -> list[str]:
    """One line for each problem, beginning with its key."""
    found = [
        *_grid_problems(scene, len(entries)),
        *_time_problems(scene),
        *render_problems(scene),
        *output_problems(scene),
    ]
    for entry in entries:
        found += _material_problems(entry)
    found += _surface_problems(scene, entries)
    found += _range_problems(scene)
    found += heat.problems(scene, entries)
    if scene.grid is not None:
        dim = len(scene.grid.lower)
        for entry in entries:
            if entry.gravity is not None and len(entry.gravity) != dim:
                key = f"{entry.path if entry.own_gravity else ''}gravity"
                found.append(f"{key}: must have {dim} numbers in this {dim}-D scene, got {entry.gravity}")
            for kind in ("body", "obstacle", "emitter"):
                for key, item in entry.keyed(kind):
                    found += _item_problems(key, item, scene)
        if not found:
            found += _size_problems(scene, entries)
    return list(dict.fromkeys(found))  # Entries of a batch share everything outside of them.


def file_problems(entry: Any, folder: Path) -> Iterator[str]:
    """Unreadable files of bodies."""
    for key, body in entry.keyed("body"):
        if isinstance(body, schema.FileBody):
            try:
                check_file(folder / body.file, body.shape)
            except OSError as error:
                yield f"{key}.file: {error}"


# ---- words


def _grid_problems(scene: Any, scenes: int) -> Iterator[str]:
    grid: schema.Grid | None = scene.grid
    if grid is None:
        return
    found = list(corner_problems(grid))
    if scene.origin is not None and len(scene.origin) != len(grid.lower):
        found.append(f"origin: must have {len(grid.lower)} numbers like grid.lower, got {scene.origin}")
    yield from found
    if found:
        return
    if scene.origin is not None:
        grid = relative(grid, scene.origin)
    try:
        lattice = Grid(grid.dx, grid.lower, grid.upper, scenes, grid.kernel)
    except ValueError as error:
        yield f"grid: {error}"
        return
    if scene.precision is not None and (problem := resolution.refused(lattice, getattr(torch, scene.precision))):
        yield f"grid: {problem}"
    try:
        if grid.walls is not None:
            boundaries.Walls(grid.walls, friction=grid.friction).faces(lattice)
    except ValueError as error:
        yield f"grid.walls: {error}"


def corner_problems(grid: schema.Grid) -> Iterator[str]:
    """Corners, walls or cells of a grid that do not fit each other."""
    dim = len(grid.lower)
    if len(grid.upper) != dim:
        yield f"grid.upper: must have {dim} numbers like grid.lower, got {grid.upper}"
    if isinstance(grid.walls, list) and len(grid.walls) != dim:
        yield f"grid.walls: must have one entry per axis, {dim} in all, got {grid.walls}"
    if any(a >= b for a, b in zip(grid.lower, grid.upper, strict=False)):
        yield f"grid.upper: must be above grid.lower on every axis, got {grid.upper}"
    nodes = [(b - a) / grid.dx for a, b in zip(grid.lower, grid.upper, strict=False)]
    if max(nodes) > MOST_NODES:
        yield f"grid.dx: the domain has {max(nodes):.2g} nodes along an axis; make dx larger or the domain smaller"


def _range_problems(scene: Any) -> Iterator[str]:
    """Numbers of the file that exceed the precision of the simulation."""
    if scene.precision is None:
        return
    largest = torch.finfo(getattr(torch, scene.precision)).max
    for name in ("gravity", "material", "body", "obstacle", "emitter", "heat", "scene"):
        for key, value in _numbers_in(getattr(scene, name, None), name):
            if abs(value) > largest:
                yield f"{key}: must be at most {largest:.3g}, the largest number in {scene.precision}, got {value:g}"


def _numbers_in(words: Any, key: str) -> Iterator[tuple[str, float]]:
    """(key, value) of all numbers of a part of a scene."""
    if isinstance(words, BaseModel):
        words = {name: value for name, value in words if name not in ("seed", "particles")}
    if isinstance(words, dict):
        for name, value in words.items():
            yield from _numbers_in(value, f"{key}.{name}")
    elif isinstance(words, (list, tuple)):
        for k, value in enumerate(words):
            yield from _numbers_in(value, key if isinstance(value, (int, float)) else f"{key}[{k}]")
    elif isinstance(words, (int, float)):
        yield key, words


def _time_problems(scene: Any) -> Iterator[str]:
    if scene.duration is not None and scene.fps is not None and scene.duration * scene.fps > FRAMES:
        frames = scene.duration * scene.fps
        yield f"duration: {frames:.3g} frames are too many; make the duration shorter or fps smaller"


def _material_problems(entry: Any) -> Iterator[str]:
    for kind in ("body", "emitter"):
        for key, item in entry.keyed(kind):
            if item.material not in entry.material:
                known = ", ".join(sorted(entry.material)) or "there is none"
                yield f"{key}.material: there is no material {item.material!r}; known: {known}"
    if not entry.body and not entry.emitter:
        yield f"{entry.path}body: the scene has no matter; give it a [[body]] or an [[emitter]]"


def output_problems(scene: Any) -> Iterator[str]:
    """Fields that no trajectory of the scene can have."""
    if scene.grid is not None and len(scene.grid.lower) == 3 and "out_of_plane_stress" in scene.output.fields:
        yield "output.fields: out_of_plane_stress is for 2-D scenes; in 3-D the stress has all components"


def render_problems(scene: Any) -> Iterator[str]:
    """Problems of pictures."""
    words, grid = scene.render, scene.grid
    if words is None:
        return
    if any(n not in PIXELS for n in words.resolution):
        ends = f"{PIXELS[0]} to {PIXELS[-1]}"
        yield f"render.resolution: takes a width and a height of {ends} pixels, got {words.resolution}"
    if words.range is not None and not words.range[0] < words.range[1]:
        yield f"render.range: takes a lower and an upper end, got {words.range}"
    if grid is None:
        return
    dim = len(grid.lower)
    if words.view is not None:
        lower, upper = words.view
        if len(lower) != dim or len(upper) != dim or any(a >= b for a, b in zip(lower, upper, strict=False)):
            yield f"render.view: takes a lower and an upper corner of {dim} numbers each, got {words.view}"
    if dim == 2 and words.style == "surface":
        yield "render.style: a surface needs three dimensions; this scene has two"
    if dim == 2 and words.surface:
        yield "render.surface: a surface needs three dimensions; this scene has two"
    if words.surface and words.style == "surface":
        yield "render.surface: takes style = 'particles', that of sand, got 'surface'"
    if dim == 3 and words.exaggeration != 1:
        yield f"render.exaggeration: is for 2-D scenes, got {words.exaggeration}"
    if words.ritter is not None and (dim == 3 or not any(scene.gravity or ())):
        yield "render.ritter: needs a 2-D scene with gravity"


def _surface_problems(scene: Any, entries: Sequence[Any]) -> Iterator[str]:
    """Pictures of surfaces in which nothing has one."""
    if scene.render is None or not scene.render.surface:
        return
    items = [(entry, item) for entry in entries for kind in ("body", "emitter") for _, item in entry.keyed(kind)]
    laws = [entry.material.get(item.material) for entry, item in items]
    if laws and all(isinstance(law, schema.QuarticSand) for law in laws):
        yield "render.surface: all materials are sand, which is drawn as particles"


def _item_problems(key: str, item: Any, scene: Any) -> list[str]:
    """Problems of a body, an obstacle or an emitter."""
    dim = len(scene.grid.lower)
    if isinstance(item, schema.Obstacle):
        return obstacle_problems(key, item, dim)
    found = list(_dimension_problems(key, item, dim))
    if found or len(scene.grid.upper) != dim:
        return found
    try:
        if isinstance(item, schema.Emitter):
            return [*_nozzle_problems(key, item, scene)]
        if isinstance(item, (schema.PointsBody, schema.SplatsBody)) and item.particles is not None:
            return [f"{key}.particles: the particles of {item.file} are those of the file; remove the key"]
        shape = region(item, None)
        return [] if shape is None else list(bounds_problems(key, item, shape, scene.grid))
    except (ValueError, TypeError) as error:
        return [f"{key}{called(item)}: {error}"]


def obstacle_problems(key: str, item: schema.Obstacle, dim: int) -> list[str]:
    """Problems of an obstacle of a scene with ``dim`` dimensions."""
    if found := list(_dimension_problems(key, item, dim)):
        return found
    try:
        obstacle(item, None).pose(0.0)
    except (ValueError, TypeError) as error:
        return [f"{key}{called(item)}: {error}"]
    return []


def _dimension_problems(key: str, item: Any, dim: int) -> Iterator[str]:
    if dim == 2 and getattr(item, "shape", "") in ("mesh", "cylinder", "splats"):
        what = "splats need" if item.shape == "splats" else f"a {item.shape} needs"
        yield f"{key}.shape: {what} three dimensions; this scene has two"
        return
    values = vars(item)
    for name in ("lower", "upper", *schema.VECTOR_KEYS, "velocity", "offset"):
        value = values.get(name)
        if value is not None and len(value) != dim:
            yield f"{key}.{name}: must have {dim} numbers in this {dim}-D scene, got {value}"
    for name in ("spin", "rotation"):
        value = values.get(name)
        if value is not None and isinstance(value, (int, float)) != (dim == 2):
            yield f"{key}.{name}: takes {'one number' if dim == 2 else 'a vector of 3 numbers'} in {dim}-D, got {value}"


# ---- places


def bounds_problems(
    key: str, item: Any, shape: seed.Region, grid: schema.Grid, origin: Sequence[float] | None = None
) -> Iterator[str]:
    """Check of a region that extends beyond the domain by more than the distance of its outermost particles from its
    surface.

    With an `origin` the coordinates are relative to it, and messages have those of the file.
    """
    slack = 0.5 * _spacing(item, grid)
    if not inside(grid, torch.stack([shape.lower + slack, shape.upper - slack])):
        yield outside(f"{key}{called(item)}", shape.lower, shape.upper, grid, origin)


def inside(grid: schema.Grid, x: Tensor) -> bool:
    """Whether all points [..., D] lie in the domain."""
    lower, upper = (torch.tensor(v, dtype=torch.float64) for v in (grid.lower, grid.upper))
    rounding = 1e-9 * (upper - lower) + 1e-15 * torch.maximum(lower.abs(), upper.abs())
    return bool(((x >= lower - rounding) & (x <= upper + rounding)).all())


def outside(path: str, lower: Tensor, upper: Tensor, grid: schema.Grid, origin: Sequence[float] | None = None) -> str:
    return f"{path}: {reach(lower, upper, grid, origin)}"


def reach(lower: Tensor, upper: Tensor, grid: schema.Grid, origin: Sequence[float] | None = None) -> str:
    """Problem of a body with corners outside the domain, in the coordinates of the file."""
    ends = [
        _numbers([float(a) + b for a, b in zip(corner, origin or (0.0,) * len(grid.lower), strict=True)])
        for corner in (lower, upper, grid.lower, grid.upper)
    ]
    return (
        f"reaches from {ends[0]} to {ends[1]}, outside the domain {ends[2]} to {ends[3]}; "
        "move the body or enlarge grid.lower, grid.upper"
    )


def _nozzle_problems(key: str, words: schema.Emitter, scene: Any) -> Iterator[str]:
    velocity = torch.tensor(words.velocity, dtype=torch.float64)
    if not 0 < float(velocity.norm()) < math.inf:
        yield f"{key}{called(words)}: velocity must not be zero: it is the direction of the nozzle"
        return
    end = min(scene.duration or math.inf, words.end or math.inf)
    if end <= words.start:
        yield f"{key}{called(words)}: end must be after start, got start {words.start} and end {end}"
    most = nozzle_area(words) * float(velocity.norm())
    if words.rate is not None and words.rate > most * (1 + 1e-9):
        unit = f"m^{len(words.center)}/s"
        yield f"{key}{called(words)}: rate must be at most area times speed, {most:g} {unit}, got {words.rate}"
    center = torch.tensor(words.center, dtype=torch.float64)
    reach = words.radius * (1 - (velocity / velocity.norm()).square()).clamp(min=0).sqrt()
    slack = torch.minimum(reach, torch.tensor(0.5 * _spacing(words, scene.grid)))
    if not inside(scene.grid, center - reach + slack) or not inside(scene.grid, center + reach - slack):
        yield f"{key}{called(words)}: the nozzle is outside the domain; move it inside"


def nozzle_area(words: schema.Emitter) -> float:
    """Area of a nozzle [m^2], or width of a slit [m]."""
    return 2 * words.radius if len(words.center) == 2 else math.pi * words.radius * words.radius


# ---- sizes


def _size_problems(scene: Any, entries: Sequence[Any]) -> Iterator[str]:
    """Compare the particles of all bodies and emitters with limits of numbers and memory."""
    counts: dict[str, float] = {}
    for entry in entries:
        for key, body in entry.keyed("body"):
            if body.particles is not None:
                counts[f"{entry.path}|{key}"] = body.particles
            elif (shape := region(body, None)) is not None:
                counts[f"{entry.path}|{key}"] = _filling(shape.volume, len(shape.lower), _spacing(body, scene.grid))
        for key, words in entry.keyed("emitter") if scene.duration is not None else ():
            counts[f"{entry.path}|{key}"] = _poured(words, scene)
    total, free = sum(counts.values()), host_memory.available()
    if total <= seed.MOST and total * PARTICLE_BYTES <= free:
        return
    room = (
        f"{seed.MOST} can be numbered"
        if total > seed.MOST
        else f"they take {host_memory.in_words(total * PARTICLE_BYTES)}, and {host_memory.in_words(free)} are free"
    )
    key = max(counts, key=lambda name: counts[name]).partition("|")[2]
    yield (
        f"{key}.per_cell: about {max(counts.values()):.3g} of the {total:.3g} particles of the scene are "
        f"here, but {room}; make per_cell smaller or grid.dx larger"
    )


def _poured(words: schema.Emitter, scene: Any) -> float:
    """Approximate number of particles of an emitter; complete layers of at least one particle."""
    dim, spacing = len(words.center), _spacing(words, scene.grid)
    area, speed = nozzle_area(words), math.hypot(*words.velocity)
    seconds = max(0.0, min(scene.duration, words.end or scene.duration) - words.start)
    layers = max(1.0, seconds * (words.rate or area * speed) / (area * spacing))
    return layers * max(1.0, _filling(area, dim - 1, spacing))


def _filling(volume: float, dim: int, spacing: float) -> float:
    """Particles that fill a volume; infinite where a power would raise."""
    for _ in range(dim):
        volume /= spacing
    return volume


def _spacing(item: schema.Seeding, grid: schema.Grid) -> float:
    """Distance of particles [m]."""
    return max(1e-300, grid.dx / float(item.per_cell ** (1 / len(grid.lower))))


# ---- words of messages


def called(item: Any) -> str:
    return f" ({item.name})" if item.name else ""


def _numbers(values: Sequence[float]) -> str:
    """Four digits, or for positions far from zero as many as are needed to distinguish them."""
    digits = 4 if max(map(abs, values)) < 1e4 else 10
    return "[" + ", ".join(f"{v:.{digits}g}" for v in values) + "]"
