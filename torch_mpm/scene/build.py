"""Particles, laws, obstacles and emitters of a scene file; and the checks that need geometry."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from .. import boundaries, laws
from ..geometry import seed
from ..grid.grid import Grid
from ..laws.sand import QuarticSand
from ..laws.thermal import LIQUID
from ..state.state import State
from ..step.step import Step
from . import check, heat, schema, splat_bodies
from .explain import SceneError
from .obstacles import obstacles
from .places import obstacle, region

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Material:
    """Material of one scene: its words, the index of its scene, and its index among the laws of the step."""

    name: str
    words: schema.NeoHookean | schema.WeaklyCompressible | schema.QuarticSand | schema.Solid
    scene: int


@dataclass(frozen=True)
class Nozzle:
    """Emitter ready to run: a layer of particles appears at each of its times."""

    layer: State
    material: int
    times: list[float]

    def turned(self, number: int) -> State:
        """Layer, in 3-D rotated about the axis of the nozzle, so that it is not aligned with the previous one."""
        x, v = self.layer.x, self.layer.v
        if x.shape[1] == 2:
            return self.layer
        turn = boundaries.rotation_matrix(GOLDEN_ANGLE * number * v[0] / v[0].norm(), 3)
        centre = x.mean(0)
        return self.layer.replace(x=centre + (x - centre) @ turn.mT)


@dataclass(frozen=True)
class Built:
    """Scene ready to run. ``materials`` are those of all scenes, ``material`` [P] those of the initial particles."""

    grid: Grid
    step: Step
    state: State
    material: Tensor
    materials: list[Material]
    nozzles: list[Nozzle]
    scenes: list[str]
    projected: Tensor | None = None
    """Particles of each scene that were moved out of obstacles, int64 [B]; None unless the scene wants that."""
    gaussian: Tensor | None = None
    """Numbers of the Gaussians of the initial particles, int32 [P], see `splat_bodies.numbers`; None without any."""

    def emissions(self) -> list[tuple[float, int]]:
        """(time, nozzle) of every layer, in the order of appearance."""
        return sorted((time, k) for k, nozzle in enumerate(self.nozzles) for time in nozzle.times)

    @property
    def particles(self) -> int:
        """Number of particles after the last layer."""
        return len(self.state) + sum(len(n.layer) * len(n.times) for n in self.nozzles)

    def statics(self) -> dict[str, Tensor]:
        """Mass, volume, material, scene and Gaussian of all particles, including those not yet emitted, by id."""
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
        if self.gaussian is not None:
            emitted = torch.full((self.particles - len(self.state),), splat_bodies.NONE, dtype=torch.int32)
            values["gaussian"] = torch.cat([self.gaussian, emitted])
        return {name: value.cpu() for name, value in values.items()}


def build(scene: Any, device: torch.device) -> Built:
    """Seed and assemble a :class:`torch_mpm.Scene`.

    Raises:
        SceneError: for shapes outside the domain, overlapping bodies, unknown materials, a mesh that is not closed, ...
    """
    dtype = getattr(torch, scene.precision)
    entries = scene.entries()
    problems = check.problems(scene, entries)
    problems += [p for entry in entries for p in check.file_problems(entry, scene.folder) if p not in problems]
    if any(problem.startswith("origin") for problem in problems):
        raise SceneError(problems)
    origin, scene = scene.origin, scene.relative()
    entries = scene.entries()
    placed = [_placed(scene, origin, entry, problems) for entry in entries]
    if problems:
        raise SceneError(list(dict.fromkeys(problems)))
    words = scene.grid
    grid = Grid(
        words.dx, words.lower, words.upper, scenes=len(entries), kernel=words.kernel, deterministic=words.deterministic
    )
    reference = 0.0 if scene.heat is None else scene.heat.reference
    mixture = _Mixture(entries, reference)
    parts, material = [], []
    nozzles: list[Nozzle] = []
    for index, entry in enumerate(entries):
        for key, body, points, _ in placed[index]:
            density = entry.material[body.material].density
            parts.append(_named(key, _matter, body, points, density, index, scene.heat, dtype))
            material.append(torch.full((len(points),), mixture.number(index, body.material), dtype=torch.int32))
        for key, emitter in entry.keyed("emitter"):
            nozzles.append(_named(key, _nozzle, scene, entry, emitter, index, mixture, dtype, device))
    walls = None if words.walls is None else boundaries.Walls(words.walls, friction=words.friction)
    solids = obstacles(entries, words, dtype, device)
    dim = len(words.lower)
    empty = seed.Points(
        torch.empty(0, dim, dtype=dtype), torch.empty(0, dtype=dtype), torch.empty(0, dtype=torch.int32)
    )
    if not parts:
        nothing = State.at_rest(empty, dtype=dtype)
        parts = [nothing if scene.heat is None else nothing.replace(temperature=torch.zeros_like(nothing.mass))]
        material = [torch.empty(0, dtype=torch.int32)]
    together = State.concatenate(parts).to(device)  # Together, since each copy to a device waits.
    first = _complete(together, mixture, torch.cat(material), single=len(entries) == 1)
    nozzles = [
        Nozzle(
            _complete(n.layer, mixture, torch.full((len(n.layer),), n.material), len(entries) == 1), n.material, n.times
        )
        for n in nozzles
    ]
    _check_mass(scene, [first, *(n.layer for n in nozzles)])
    step = Step(
        grid,
        mixture.law(dtype, device),
        gravity=_gravity(entries, dtype, device),
        walls=walls,
        boundaries=[solid.boundary for solid in solids],
        transfer=scene.transfer,
        flip=scene.flip,
        heat=None
        if scene.heat is None
        else _named("heat", heat.conduction, scene, entries, grid, mixture.words(), solids, device),
    )
    ids = torch.arange(len(first), device=device)
    C = first.C if step._keeps_C else None  # Of bodies that spin; checkpoints do not have it either.
    state = step.prepare(first.replace(ids=ids, C=C))
    moved = None
    if scene.project:
        state, moved = step.project(state)
    _check_fields(scene, state)
    nozzles = [Nozzle(step.prepare(n.layer), n.material, n.times) for n in nozzles]
    gaussian = splat_bodies.numbers([points for bodies in placed for _, _, points, _ in bodies])
    names = [entry.name for entry in entries]
    return Built(grid, step, state, torch.cat(material), mixture.materials, nozzles, names, moved, gaussian)


def _named(key: str, make: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call ``make``; an error is reported under a key of the scene."""
    try:
        return make(*arguments, **options)
    except (ValueError, TypeError) as error:
        raise SceneError([f"{key}: {error}"]) from error


def _check_mass(scene: Any, states: Sequence[State]) -> None:
    for mass in (values for state in states for values in (state.mass, state.volume)):
        if not bool(((mass > 0) & mass.isfinite()).all()):
            raise SceneError(
                [
                    f"precision: {scene.precision} cannot hold a mass or a volume of the particles; "
                    "change density, grid.dx or per_cell"
                ]
            )


def _check_fields(scene: Any, state: State) -> None:
    """Check that the fields of the outputs exist for some material."""
    values = {"F": state.F, "J": state.J, "temperature": state.temperature, "liquid": state.extra.get(LIQUID)}
    absent = [name for name in scene.trajectory_fields if name in values and values[name] is None]
    if absent:
        requested = set(scene.output.fields)
        keys = {name: "output.fields" if name in requested else "render.color_by" for name in absent}
        raise SceneError([f"{key}: no material of this scene has {name!r}" for name, key in keys.items()])


# ---- materials


class _Mixture:
    """Materials of all scenes, and their laws.

    Materials of one kind, at most one of them per scene, share one law with parameters per scene.
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
        self._numbers = {(m.scene, m.name): number for number, m in enumerate(self.materials)}
        groups: dict[tuple[Any, ...], list[int]] = {}
        before: Counter[tuple[Any, ...]] = Counter()  # Materials of one form in one scene.
        for number, m in enumerate(self.materials):
            form = _form(m.words)
            groups.setdefault((form, before[m.scene, form]), []).append(number)
            before[m.scene, form] += 1
        self.groups = list(groups.values())

    def words(self) -> list[Any]:
        """Words of one material of each law."""
        return [self.materials[group[0]].words for group in self.groups]

    def number(self, scene: int, name: str) -> int:
        return self._numbers[scene, name]

    def law_of(self, material: Tensor) -> Tensor:
        """Index of the law [P] for the material numbers [P]."""
        table = torch.zeros(max(1, len(self.materials)), dtype=torch.int32)
        for law, group in enumerate(self.groups):
            table[torch.tensor(group)] = law
        return table[material.long()]

    def law(self, dtype: torch.dtype, device: torch.device) -> laws.Material:
        made = [self._one(group, dtype, device) for group in self.groups]
        return made[0] if len(made) == 1 else laws.Mixture(made)

    def _one(self, group: list[int], dtype: torch.dtype, device: torch.device) -> laws.Material:
        first = self.materials[group[0]]
        law = _named(f"material.{first.name}", self._mechanical, group, dtype, device)
        return _named(f"material.{first.name}", heat.thermal, law, first.words, self.reference).to(device)

    def _mechanical(self, group: list[int], dtype: torch.dtype, device: torch.device) -> laws.Material:
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
            return laws.NeoHookean(E=value("E"), nu=value("nu"))
        if isinstance(words, schema.WeaklyCompressible):
            return laws.WeaklyCompressible(value("bulk_modulus"), value("gamma"), value("viscosity"))
        if isinstance(words, schema.Solid):
            law = getattr(laws, type(words).__name__)
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
    """Properties that materials with a common law must share."""
    names = ("energy", "apex", "smallest_strain", "flow", "volume_correction", "hardening")
    options = [*(getattr(words, name, None) for name in names), getattr(words, "cohesion", 0.0) > 0]
    options += [getattr(words, name, None) for name in (*heat.THERMAL, "liquid")]
    curves = [v for name in ("E", "viscosity") if isinstance(v := getattr(words, name, None), schema.Curve)]
    viscosity = getattr(words, "viscosity", 0.0)
    viscous = isinstance(viscosity, schema.Curve) or viscosity > 0
    return words.law, viscous, getattr(words, "mu", None) is not None, repr(options), repr(curves)


def _complete(state: State, mixture: _Mixture, material: Tensor, single: bool) -> State:
    """Drop or add the indices that the step needs."""
    law = mixture.law_of(material).to(state.x.device) if len(mixture.groups) > 1 else None
    return state.replace(scene=None if single else state.scene, material=law)


# ---- bodies


Placed = list[tuple[str, Any, seed.Points, "seed.Region | None"]]
"""(key, words, particles, region) of the bodies of a scene."""


def _placed(scene: Any, origin: Sequence[float] | None, entry: Any, problems: list[str]) -> Placed:
    """Bodies without problems; problems shown by their particles are added to the list.

    The coordinates of the scene are relative to its origin; those of files and messages are not.
    """
    if any(problem.startswith("grid") or ".per_cell: " in problem for problem in problems):
        return []  # Without a lattice, or with too many particles for the memory.
    placed = []
    for k, (key, body) in enumerate(entry.keyed("body")):
        if not _is_good(key, problems):
            continue
        try:
            points, shape = _seeded(scene, origin, entry, body, (scene.seed if entry.seed is None else entry.seed) + k)
        except (ValueError, OSError) as error:
            problems.append(f"{key}{check.called(body)}: {error}")
            continue
        file = isinstance(body, schema.MeshBody)  # Other shapes were checked before.
        found = list(check.bounds_problems(key, body, shape, scene.grid, origin)) if file and shape is not None else []
        if not found and not check.inside(scene.grid, points.x):
            lower, upper = points.x.amin(0), points.x.amax(0)
            found = [check.outside(f"{key}{check.called(body)}", lower, upper, scene.grid, origin)]
        problems += found
        placed.append((key + check.called(body), body, points, shape))
    solids = [] if scene.project else [o for o in entry.keyed("obstacle") if _is_good(o[0], problems)]
    problems += _overlaps(placed, solids)
    return placed


def _is_good(key: str, problems: list[str]) -> bool:
    return not any(problem.startswith((f"{key}.", f"{key}:", f"{key} ")) for problem in problems)


def _seeded(
    scene: Any, origin: Sequence[float] | None, entry: Any, body: Any, number: int
) -> tuple[seed.Points, seed.Region | None]:
    if isinstance(body, schema.PointsBody):
        options = {"dim": scene.dim, "origin": origin, "dtype": torch.float64}
        return seed.file(scene.folder / body.file, body.volume, **options), None
    if isinstance(body, schema.SplatsBody):
        return splat_bodies.seeded(scene, origin, entry, body, number), None
    shape = region(body, scene.folder)
    assert shape is not None
    options = {"method": body.seeding, "seed": number, "count": body.particles, "dtype": torch.float64}
    return seed.fill(shape, scene.grid.dx, body.per_cell, **options), shape


def _matter(
    body: Any,
    points: seed.Points,
    density: float,
    scene: int,
    heat: schema.Heat | None,
    dtype: torch.dtype,
) -> State:
    """Particles of a body without internal motion, on the host."""
    index = torch.full((len(points),), scene, dtype=torch.int32)
    points = seed.Points(points.x, points.volume, index)
    if body.spin is None:
        return _warmed(State.at_rest(points, density, body.velocity, dtype), body, heat)
    state = State.at_rest(points, density, body.velocity, torch.float64)
    gradient = _spin_matrix(body.spin, points.x.shape[1])
    center = (points.x * points.volume[:, None]).sum(0) / points.volume.sum()
    v = state.v + (points.x - center) @ gradient.T
    state = state.replace(v=v, C=gradient.expand(len(points), -1, -1))
    return _warmed(state.to(dtype=dtype), body, heat)


def _warmed(state: State, words: schema.Seeding, heat: schema.Heat | None) -> State:
    """State with the temperature of the body, in a scene with heat."""
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


# ---- emitters


def _nozzle(
    scene: Any, entry: Any, words: schema.Emitter, index: int, mixture: _Mixture, dtype: torch.dtype,
    device: torch.device,
) -> Nozzle:  # fmt: skip
    points, times = emitter_layer(words, scene.grid, scene.duration)
    if not check.inside(scene.grid, points.x):
        raise ValueError("the nozzle is outside the domain; move it inside")
    points = seed.Points(points.x, points.volume, torch.full((len(points),), index, dtype=torch.int32))
    density = entry.material[words.material].density
    layer = State.at_rest(points, density, words.velocity, torch.float64).to(device, dtype)
    return Nozzle(_warmed(layer, words, scene.heat), mixture.number(index, words.material), times)


def emitter_layer(words: schema.Emitter, grid: schema.Grid, duration: float) -> tuple[seed.Points, list[float]]:
    """One layer of an emitter and the times at which it appears.

    A layer is one particle spacing thick; their number is an integer and their volumes add up to rate x time.
    """
    velocity = torch.tensor(words.velocity, dtype=torch.float64)
    speed, dim = float(velocity.norm()), len(words.center)
    spacing = grid.dx / words.per_cell ** (1 / dim)
    area = check.nozzle_area(words)
    count = max(1, round(2 * words.radius / spacing))
    axes = [(torch.arange(count, dtype=torch.float64) + 0.5) / count * 2 - 1] * (dim - 1)
    flat = torch.cartesian_prod(*axes).reshape(-1, dim - 1) * words.radius
    flat = flat[flat.square().sum(1) <= words.radius**2]
    end = min(duration, words.end or duration)
    rate = words.rate or area * speed
    layers = max(1, round((end - words.start) * rate / (area * spacing)))
    interval = (end - words.start) / layers
    x = torch.tensor(words.center, dtype=torch.float64) + flat @ _across(velocity / speed)
    volume = torch.full((len(x),), rate * interval / len(x), dtype=torch.float64)
    return seed.Points(x, volume), [words.start + k * interval for k in range(layers)]


def _across(direction: Tensor) -> Tensor:
    """Orthonormal vectors normal to a direction, [D - 1, D]."""
    basis = torch.linalg.qr(torch.cat([direction[None], torch.eye(len(direction), dtype=torch.float64)]).T).Q
    return basis.T[1 : len(direction)]


# ---- overlaps


def _overlaps(placed: Placed, obstacles: Sequence[tuple[str, Any]]) -> Iterator[str]:
    """Overlaps of bodies with each other, and with obstacles that exist from the start; the first other body of
    each.
    """
    meet = _boxes_meet(placed)
    seen = set()
    for i, (key, _, points, _) in enumerate(placed):
        for j in meet[i].nonzero()[0].tolist():
            other, _, _, shape = placed[j]
            if i == j or shape is None or (j, i) in seen:
                continue
            inside = int(shape.inside(points.x).sum())
            if inside:
                seen.add((i, j))
                yield f"{key}: overlaps {other}, {inside} of its particles are inside it; move one of them"
                break
    for path, words in obstacles:
        if words.start > 0:
            continue
        solid = obstacle(words, None)
        for key, _, points, _ in placed:
            inside = int((solid.signed_distance(points.x, None, 0.0) < 0).sum())
            if inside:
                where = f"{path}{check.called(words)}"
                yield f"{key}: {inside} of its particles are inside {where}; move one of them, or set project = true"


def _boxes_meet(placed: Placed) -> npt.NDArray[Any]:
    """Whether the box around the points of body i and that around the shape of body j overlap, bool [n, n].

    Without a shape, a body has no box.
    """
    dim = placed[0][2].x.shape[1] if placed else 2
    nowhere = torch.full((dim,), torch.nan, dtype=torch.float64)
    lower, upper, a, b = np.empty((4, len(placed), dim))
    for k, (_, _, points, shape) in enumerate(placed):
        lower[k], upper[k] = (end.numpy() for end in points.x.aminmax(dim=0))
        a[k], b[k] = (nowhere, nowhere) if shape is None else (shape.lower, shape.upper)
    meet = np.ones((len(placed), len(placed)), bool)
    for axis in range(dim):  # Comparisons with NaN are false.
        meet &= (lower[:, None, axis] <= b[None, :, axis]) & (upper[:, None, axis] >= a[None, :, axis])
    return meet


def _gravity(entries: Sequence[Any], dtype: torch.dtype, device: torch.device) -> Tensor | None:
    values = [entry.gravity for entry in entries]
    if all(value is None for value in values):
        return None
    dim = next(len(value) for value in values if value is not None)
    rows = torch.tensor([value or (0.0,) * dim for value in values], dtype=dtype, device=device)
    return rows[0] if len(values) == 1 else rows
