"""From the words of a scene to particles, laws, obstacles and emitters; and the checks that need geometry."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import boundaries, materials, plasticity, seed
from ..grid import Grid
from ..sand import QuarticSand
from ..state import State
from ..step import Step
from . import heat, schema
from .explain import SceneError

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Material:
    """A material of one scene: its words, the index of its scene, and its place among the laws of the step."""

    name: str
    words: schema.NeoHookean | schema.WeaklyCompressible | schema.QuarticSand | schema.Solid
    scene: int


@dataclass(frozen=True)
class Nozzle:
    """An emitter ready to run: a layer of particles appears at each of its times."""

    layer: State
    material: int
    times: list[float]

    def turned(self, number: int) -> State:
        """The layer, in 3-D turned about the axis of the nozzle, so that one does not line up with the one before."""
        x, v = self.layer.x, self.layer.v
        if x.shape[1] == 2:
            return self.layer
        turn = boundaries.rotation_matrix(GOLDEN_ANGLE * number * v[0] / v[0].norm(), 3)
        centre = x.mean(0)
        return self.layer.replace(x=centre + (x - centre) @ turn.mT)


@dataclass(frozen=True)
class Built:
    """A scene ready to run. ``materials`` are those of all scenes, ``material`` [P] those of the first particles."""

    grid: Grid
    step: Step
    state: State
    material: Tensor
    materials: list[Material]
    nozzles: list[Nozzle]
    scenes: list[str]

    def emissions(self) -> list[tuple[float, int]]:
        """(time, nozzle) of every layer, in the order in which they appear."""
        return sorted((time, k) for k, nozzle in enumerate(self.nozzles) for time in nozzle.times)

    @property
    def particles(self) -> int:
        """Number of particles once every emitter is empty."""
        return len(self.state) + sum(len(n.layer) * len(n.times) for n in self.nozzles)

    def statics(self) -> dict[str, Tensor]:
        """Mass, volume, material and scene of all particles, also of those still to come, by id."""
        layers = [(self.nozzles[k].layer, self.nozzles[k].material) for _, k in self.emissions()]
        states = [self.state, *(layer for layer, _ in layers)]
        material = [self.material, *(torch.full((len(s),), m, dtype=torch.int32, device="cpu") for s, m in layers)]
        values = {
            "mass": torch.cat([s.mass for s in states]),
            "volume": torch.cat([s.volume for s in states]),
            "material": torch.cat(material),
        }
        if len(self.scenes) > 1:
            values["scene"] = torch.cat([s.scene for s in states if s.scene is not None])
        return {name: value.cpu() for name, value in values.items()}


def build(scene: Any, device: torch.device) -> Built:
    """Seed and assemble a :class:`torch_mpm.Scene`.

    Raises:
        SceneError: for shapes outside the domain, overlapping bodies, unknown materials, a mesh that is not closed, ...
    """
    dtype = getattr(torch, scene.precision)
    entries = scene.entries()
    _check_words(scene, entries)
    words = scene.grid
    grid = Grid(words.dx, words.lower, words.upper, scenes=len(entries), kernel=words.kernel)
    reference = 0.0 if scene.heat is None else scene.heat.reference
    mixture = _Mixture(entries, reference)
    parts, material = [], []
    nozzles: list[Nozzle] = []
    obstacles: list[tuple[Any, boundaries.Obstacle]] = []
    problems: list[str] = []
    for index, entry in enumerate(entries):
        placed = _bodies(scene, entry, entry.path, problems)
        _check_placement(scene, entry, placed, problems)
        for body, points, _ in placed:
            matter = _matter(body, points, entry.material[body.material].density, index, dtype, device)
            parts.append(_warmed(matter, body, scene.heat))
            material.append(torch.full((len(points),), mixture.number(index, body.material), dtype=torch.int32))
        nozzles += _nozzles(scene, entry, index, mixture, dtype, device, problems)
        obstacles += [(o, obstacle(o, index if len(entries) > 1 else None)) for o in entry.obstacle]
    walls = _walls(words, grid, problems)
    if problems:
        raise SceneError(problems)
    dim = len(words.lower)
    empty = seed.Points(
        torch.empty(0, dim, dtype=dtype), torch.empty(0, dtype=dtype), torch.empty(0, dtype=torch.int32)
    )
    if not parts:
        nothing = State.at_rest(empty, dtype=dtype, device=device)
        parts = [nothing if scene.heat is None else nothing.replace(temperature=torch.zeros_like(nothing.mass))]
        material = [torch.empty(0, dtype=torch.int32)]
    first = _complete(State.concatenate(parts), mixture, torch.cat(material), single=len(entries) == 1)
    nozzles = [
        Nozzle(
            _complete(n.layer, mixture, torch.full((len(n.layer),), n.material), len(entries) == 1), n.material, n.times
        )
        for n in nozzles
    ]
    step = Step(
        grid,
        mixture.law(dtype, device),
        gravity=_gravity(entries, dtype, device),
        walls=walls,
        boundaries=[boundary for _, boundary in obstacles],
        transfer=scene.transfer,
        flip=scene.flip,
        heat=None if scene.heat is None else heat.conduction(scene, entries, grid, mixture.words(), obstacles, device),
    )
    ids = torch.arange(len(first), device=device)
    state = step.prepare(first.replace(ids=ids))
    nozzles = [Nozzle(step.prepare(n.layer), n.material, n.times) for n in nozzles]
    return Built(grid, step, state, torch.cat(material), mixture.materials, nozzles, [e.name for e in entries])


# ---- materials


class _Mixture:
    """Materials of all scenes, and the laws that serve them.

    Materials of one kind, at most one of them per scene, share one law whose parameters are per scene.
    """

    def __init__(self, entries: Sequence[Any], reference: float) -> None:
        self.reference = reference
        used = [{*(b.material for b in e.body), *(m.material for m in e.emitter)} for e in entries]
        self.scenes = len(entries)
        self.materials = [
            Material(name, words, index)
            for index, entry in enumerate(entries)
            for name, words in entry.material.items()
            if name in used[index]
        ]
        groups: dict[tuple[Any, ...], list[int]] = {}
        for number, m in enumerate(self.materials):
            form = _form(m.words)
            rank = sum(o.scene == m.scene and _form(o.words) == form for o in self.materials[:number])
            groups.setdefault((form, rank), []).append(number)
        self.groups = list(groups.values())

    def words(self) -> list[Any]:
        """The words of one material of each law."""
        return [self.materials[group[0]].words for group in self.groups]

    def number(self, scene: int, name: str) -> int:
        return next(k for k, m in enumerate(self.materials) if (m.scene, m.name) == (scene, name))

    def law_of(self, material: Tensor) -> Tensor:
        """Index of the law [P] for the material numbers [P]."""
        table = torch.zeros(max(1, len(self.materials)), dtype=torch.int32)
        for law, group in enumerate(self.groups):
            table[torch.tensor(group)] = law
        return table[material.long()]

    def law(self, dtype: torch.dtype, device: torch.device) -> materials.Material:
        laws = [self._one(group, dtype, device) for group in self.groups]
        return laws[0] if len(laws) == 1 else materials.Mixture(laws)

    def _one(self, group: list[int], dtype: torch.dtype, device: torch.device) -> materials.Material:
        law = self._mechanical(group, dtype, device)
        return heat.thermal(law, self.materials[group[0]].words, self.reference).to(device)

    def _mechanical(self, group: list[int], dtype: torch.dtype, device: torch.device) -> materials.Material:
        members = [self.materials[k] for k in group]

        def value(name: str) -> Any:
            words = getattr(members[0].words, name)
            if isinstance(words, schema.Curve):
                return heat.parameter(words, self.reference)
            values = [float(getattr(m.words, name)) for m in members]
            if len(set(values)) == 1:
                return values[0]
            per_scene = dict(zip((m.scene for m in members), values, strict=True))
            return torch.tensor([per_scene.get(b, values[0]) for b in range(self.scenes)], dtype=dtype, device=device)

        words = members[0].words
        if isinstance(words, schema.NeoHookean):
            return materials.NeoHookean(E=value("E"), nu=value("nu"))
        if isinstance(words, schema.WeaklyCompressible):
            return materials.WeaklyCompressible(value("bulk_modulus"), value("gamma"), value("viscosity"))
        if isinstance(words, schema.Solid):
            law = getattr(plasticity, type(words).__name__)
            others = {"law", "density", *schema.Thermal.model_fields}
            return law(**{name: value(name) for name in type(words).model_fields if name not in others})
        moduli = {name: value(name) for name in ("E", "nu", "mu", "lam") if getattr(words, name) is not None}
        return QuarticSand(
            **moduli,
            **_friction(words.hardening, value("friction_angle")),
            energy=words.energy,
            apex=words.apex,
            smallest_strain=words.smallest_strain,
            flow=words.flow,
            cohesion=value("cohesion") if words.cohesion > 0 else None,
            volume_correction=words.volume_correction,
        )


def _friction(hardening: Sequence[float] | None, angle: Any) -> dict[str, Any]:
    """Degrees to radians."""
    if hardening is None:
        return {"friction_angle": torch.deg2rad(angle) if isinstance(angle, Tensor) else math.radians(angle)}
    h0, h1, h2, h3 = hardening
    return {"hardening": (math.radians(h0), math.radians(h1), h2, math.radians(h3))}


def _form(words: Any) -> tuple[Any, ...]:
    """What must be the same in materials that share a law."""
    names = ("energy", "apex", "smallest_strain", "flow", "volume_correction", "hardening")
    options = [*(getattr(words, name, None) for name in names), getattr(words, "cohesion", 0.0) > 0]
    options += [getattr(words, name, None) for name in (*heat.THERMAL, "liquid")]
    curves = [v for name in ("E", "viscosity") if isinstance(v := getattr(words, name, None), schema.Curve)]
    viscosity = getattr(words, "viscosity", 0.0)
    viscous = isinstance(viscosity, schema.Curve) or viscosity > 0
    return words.law, viscous, getattr(words, "mu", None) is not None, repr(options), repr(curves)


def _complete(state: State, mixture: _Mixture, material: Tensor, single: bool) -> State:
    """Drop or add the indices that the step asks for."""
    law = mixture.law_of(material).to(state.x.device) if len(mixture.groups) > 1 else None
    return state.replace(scene=None if single else state.scene, material=law)


# ---- bodies


def shape_of(body: Any, folder: Path) -> seed.Shape | None:
    """The region of a body; None for points from a file."""
    if isinstance(body, schema.BoxBody):
        return seed.Box(body.lower, body.upper)
    if isinstance(body, schema.SphereBody):
        return seed.Sphere(body.center, body.radius)
    if isinstance(body, schema.CylinderBody):
        return seed.Cylinder(body.a, body.b, body.radius)
    if isinstance(body, schema.CapsuleBody):
        return seed.Capsule(body.a, body.b, body.radius)
    if isinstance(body, schema.MeshBody):
        return seed.Mesh(folder / body.file, body.scale, body.offset)
    return None


def _bodies(scene: Any, entry: Any, path: str, problems: list[str]) -> list[tuple[Any, seed.Points, seed.Shape | None]]:
    placed = []
    for k, body in enumerate(entry.body):
        try:
            shape = shape_of(body, scene.folder)
            if shape is None:
                points = seed.file(scene.folder / body.file, body.volume, dtype=torch.float64)
            else:
                options = {"method": body.seeding, "seed": scene.seed + k, "dtype": torch.float64}
                points = seed.fill(shape, scene.grid.dx, body.per_cell, **options)
            placed.append((body, points, shape))
        except (ValueError, FileNotFoundError) as error:
            problems.append(f"{path}body[{k}]{_called(body)}: {error}")
    return placed


def _matter(
    body: Any, points: seed.Points, density: float, scene: int, dtype: torch.dtype, device: torch.device
) -> State:
    index = torch.full((len(points),), scene, dtype=torch.int32)
    state = State.at_rest(seed.Points(points.x, points.volume, index), density, body.velocity, torch.float64)
    if body.spin is not None:
        gradient = _spin_matrix(body.spin, points.x.shape[1])
        center = (points.x * points.volume[:, None]).sum(0) / points.volume.sum()
        v = state.v + (points.x - center) @ gradient.T
        state = state.replace(v=v, C=gradient.expand(len(points), -1, -1))
    return state.to(device, dtype)


def _warmed(state: State, words: schema.Seeding, heat: schema.Heat | None) -> State:
    """Matter at its temperature, in a scene with heat."""
    if heat is None:
        return state
    temperature = 0.0 if words.temperature is None else words.temperature - heat.reference
    return state.replace(temperature=torch.full_like(state.mass, temperature))


def _spin_matrix(spin: float | Sequence[float], dim: int) -> Tensor:
    """W with W r = spin x r, [D, D]."""
    if isinstance(spin, (int, float)):
        return torch.tensor([[0.0, -spin], [spin, 0.0]], dtype=torch.float64)
    x, y, z = spin
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


# ---- walls and obstacles


def _walls(words: schema.Grid, grid: Grid, problems: list[str]) -> boundaries.Walls | None:
    if words.walls is None:
        return None
    walls = boundaries.Walls(words.walls, friction=words.friction)
    try:
        walls.faces(grid)
    except ValueError as error:
        problems.append(f"grid.walls: {error}")
    return walls


def obstacle(words: Any, scene: int | None) -> boundaries.Obstacle:
    """The boundary of the step that an obstacle of a scene names."""
    motion = {
        "kind": words.contact,
        "friction": words.friction,
        "velocity": words.velocity,
        "rotation": words.rotation,
        "angular_velocity": words.spin,
        "start": words.start,
        "end": math.inf if words.end is None else words.end,
        "scene": scene,
    }
    if isinstance(words, schema.PlaneObstacle):
        return boundaries.Plane(words.center, words.normal, **motion)
    if isinstance(words, schema.BoxObstacle):
        return boundaries.Box(words.center, words.size, **motion)
    if isinstance(words, schema.SphereObstacle):
        return boundaries.Sphere(words.center, words.radius, **motion)
    if isinstance(words, schema.RevolvedObstacle):
        return boundaries.Revolved(words.center, words.outline, words.axis, **motion)
    center = [0.5 * (p + q) for p, q in zip(words.a, words.b, strict=True)]
    half = [0.5 * (q - p) for p, q in zip(words.a, words.b, strict=True)]
    return boundaries.Capsule(center, half, words.radius, **motion)


# ---- emitters


def _nozzles(
    scene: Any,
    entry: Any,
    index: int,
    mixture: _Mixture,
    dtype: torch.dtype,
    device: torch.device,
    problems: list[str],
) -> list[Nozzle]:
    nozzles = []
    for k, words in enumerate(entry.emitter):
        try:
            density = entry.material[words.material].density
            points, times = emitter_layer(words, scene.grid, scene.duration)
        except ValueError as error:
            problems.append(f"{entry.path}emitter[{k}]{_called(words)}: {error}")
            continue
        if not _inside(scene.grid, points.x):
            problems.append(
                f"{entry.path}emitter[{k}]{_called(words)}: the nozzle is outside the domain; move it inside"
            )
        points = seed.Points(points.x, points.volume, torch.full((len(points),), index, dtype=torch.int32))
        layer = State.at_rest(points, density, words.velocity, torch.float64).to(device, dtype)
        layer = _warmed(layer, words, scene.heat)
        nozzles.append(Nozzle(layer, mixture.number(index, words.material), times))
    return nozzles


def emitter_layer(words: schema.Emitter, grid: schema.Grid, duration: float) -> tuple[seed.Points, list[float]]:
    """One layer of an emitter and the times at which it appears.

    A layer is one particle spacing thick; their number is whole and their volumes add up to rate x time.
    """
    velocity = torch.tensor(words.velocity, dtype=torch.float64)
    speed, dim = float(velocity.norm()), len(words.center)
    if speed == 0:
        raise ValueError("velocity must not be zero: it is the direction of the nozzle")
    spacing = grid.dx / words.per_cell ** (1 / dim)
    nozzle: seed.Shape
    if dim == 2:
        area, nozzle = 2 * words.radius, seed.Box([-words.radius, -1.0], [words.radius, 1.0])
    else:
        area, nozzle = math.pi * words.radius**2, seed.Sphere([0.0, 0.0], words.radius)
    counts = ((nozzle.upper - nozzle.lower) / spacing).round().clamp(min=1).tolist()
    axes = [(torch.arange(n, dtype=torch.float64) + 0.5) / n * 2 - 1 for n in map(int, counts[: dim - 1])]
    flat = torch.cartesian_prod(*axes).reshape(-1, dim - 1) * words.radius
    flat = flat[flat.square().sum(1) <= words.radius**2]
    end = min(duration, words.end or duration)
    rate = words.rate or area * speed
    if rate > area * speed * (1 + 1e-9):
        raise ValueError(f"rate must be at most area times speed, {area * speed:g} m^{dim}/s, got {words.rate}")
    if end <= words.start:
        raise ValueError(f"end must be after start, got start {words.start} and end {end}")
    layers = max(1, round((end - words.start) * rate / (area * spacing)))
    interval = (end - words.start) / layers
    x = torch.tensor(words.center, dtype=torch.float64) + flat @ _across(velocity / speed)
    volume = torch.full((len(x),), rate * interval / len(x), dtype=torch.float64)
    return seed.Points(x, volume), [words.start + k * interval for k in range(layers)]


def _across(direction: Tensor) -> Tensor:
    """Orthonormal vectors across a direction, [D - 1, D]."""
    basis = torch.linalg.qr(torch.cat([direction[None], torch.eye(len(direction), dtype=torch.float64)]).T).Q
    return basis.T[1 : len(direction)]


# ---- checks


def _check_words(scene: Any, entries: Sequence[Any]) -> None:
    """What can be said without seeding: lengths of vectors, names of materials."""
    problems = list(_dimension_problems(scene))
    for entry in entries:
        for kind in ("body", "emitter"):
            for k, item in enumerate(getattr(entry, kind)):
                if item.material not in entry.material:
                    known = ", ".join(sorted(entry.material)) or "there is none"
                    problems.append(
                        f"{entry.path}{kind}[{k}].material: there is no material {item.material!r}; known: {known}"
                    )
        if not entry.body and not entry.emitter:
            problems.append(f"{entry.path}body: the scene has no matter; give it a [[body]] or an [[emitter]]")
    problems += heat.problems(scene, entries)
    if any(a >= b for a, b in zip(scene.grid.lower, scene.grid.upper, strict=False)):
        problems.append(f"grid.upper: must be above grid.lower on every axis, got {scene.grid.upper}")
    if problems:
        raise SceneError(problems)


def _dimension_problems(scene: Any) -> Iterator[str]:
    dim = len(scene.grid.lower)
    if len(scene.grid.upper) != dim:
        yield f"grid.upper: must have {dim} numbers like grid.lower, got {scene.grid.upper}"
    if isinstance(scene.grid.walls, list) and len(scene.grid.walls) != dim:
        yield f"grid.walls: must have one entry per axis, {dim} in all, got {scene.grid.walls}"
    contents = [("", scene), *((f"scene[{k}].", entry) for k, entry in enumerate(scene.scene))]
    for path, content in contents:
        if content.gravity is not None and len(content.gravity) != dim:
            yield f"{path}gravity: must have {dim} numbers in this {dim}-D scene, got {content.gravity}"
        for kind in ("body", "obstacle", "emitter"):
            for k, item in enumerate(getattr(content, kind)):
                yield from _item_dimension(f"{path}{kind}[{k}]", item, dim)


def _item_dimension(path: str, item: Any, dim: int) -> Iterator[str]:
    if dim == 2 and getattr(item, "shape", "") in ("mesh", "cylinder"):
        yield f"{path}.shape: a {item.shape} needs three dimensions; this scene has two"
        return
    for key in ("center", "lower", "upper", "a", "b", "size", "normal", "axis", "velocity"):
        value = getattr(item, key, None)
        if value is not None and len(value) != dim:
            yield f"{path}.{key}: must have {dim} numbers in this {dim}-D scene, got {value}"
    for key in ("spin", "rotation"):
        value = getattr(item, key, None)
        if value is not None and isinstance(value, (int, float)) != (dim == 2):
            yield f"{path}.{key}: takes {'one number' if dim == 2 else 'a vector of 3 numbers'} in {dim}-D, got {value}"


def _inside(grid: schema.Grid, x: Tensor) -> bool:
    lower, upper = (torch.tensor(v, dtype=torch.float64) for v in (grid.lower, grid.upper))
    return bool(((x >= lower) & (x <= upper)).all())


def _check_placement(scene: Any, entry: Any, placed: list[tuple[Any, seed.Points, Any]], problems: list[str]) -> None:
    """Bodies inside the domain, apart from each other, and outside the obstacles."""
    grid = scene.grid
    numbers = {id(body): k for k, body in enumerate(entry.body)}
    paths = [f"{entry.path}body[{numbers[id(body)]}]{_called(body)}" for body, _, _ in placed]
    for (_, points, _), path in zip(placed, paths, strict=True):
        if not _inside(grid, points.x):
            lower, upper = points.x.amin(0), points.x.amax(0)
            problems.append(
                f"{path}: reaches from {_numbers(lower)} to {_numbers(upper)}, outside the domain "
                f"{_numbers(grid.lower)} to {_numbers(grid.upper)}; move the body or enlarge grid.lower, grid.upper"
            )
    for i, (_, points, _) in enumerate(placed):
        for j, (_, _, shape) in enumerate(placed):
            inside = 0 if i == j or shape is None else int(shape.inside(points.x).sum())
            if inside and f"{paths[j]}: overlaps {paths[i]}" not in str(problems):
                problems.append(
                    f"{paths[i]}: overlaps {paths[j]}, {inside} of its particles are inside it; move one of them"
                )
    for k, words in enumerate(entry.obstacle):
        if words.start > 0:
            continue
        solid = obstacle(words, None)
        pose = solid.pose(0.0)
        for (_, points, _), path in zip(placed, paths, strict=True):
            distance, _ = solid.surface((points.x - pose.centre) @ pose.rotation, None)
            inside = int((distance < 0).sum())
            if inside:
                problems.append(
                    f"{path}: {inside} of its particles are inside {entry.path}obstacle[{k}]{_called(words)}; "
                    "move one of them"
                )


def _gravity(entries: Sequence[Any], dtype: torch.dtype, device: torch.device) -> Tensor | None:
    values = [entry.gravity for entry in entries]
    if all(value is None for value in values):
        return None
    dim = next(len(value) for value in values if value is not None)
    rows = torch.tensor([value or (0.0,) * dim for value in values], dtype=dtype, device=device)
    return rows[0] if len(values) == 1 else rows


def _called(item: Any) -> str:
    return f" ({item.name})" if item.name else ""


def _numbers(values: Any) -> str:
    return "[" + ", ".join(f"{float(v):.4g}" for v in values) + "]"
