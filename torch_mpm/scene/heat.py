"""Thermal words of a scene: temperature-dependent materials, and the `Heat` of the step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from .. import laws
from ..grid.grid import Grid
from ..heat.boundaries import Convection, Fixed, FixedSurface, Flux, FreeSurface, Radiation, Surface
from ..heat.heat import Heat
from ..laws.parameters import PerMaterial, Table
from ..laws.thermal import Melting, ThermalExpansion
from . import schema
from .obstacles import Together

THERMAL = tuple(schema.Thermal.model_fields)


def problems(scene: Any, entries: Sequence[Any]) -> Iterator[str]:
    """Missing and superfluous thermal keys of a scene."""
    for entry in entries:
        used = {item.material for kind in ("body", "emitter") for _, item in entry.keyed(kind)}
        for name, words in entry.material.items():
            if words is None:
                continue
            path = f"{entry.path}material.{name}"
            given = [key for key in (*THERMAL, "liquid") if getattr(words, key, None) is not None]
            given += [key for key in ("E", "viscosity") if isinstance(getattr(words, key, None), schema.Curve)]
            if scene.heat is None:
                yield from (f"{path}.{key}: needs a [heat] table, which lets heat flow" for key in given)
                continue
            if name in used:
                missing = [key for key in ("conductivity", "specific_heat") if key not in given]
                yield from (f"{path}.{key}: missing, but the scene has a [heat] table" for key in missing)
            if len({"melting_point", "latent_heat"} & set(given)) == 1:
                yield f"{path}: melting_point and latent_heat must be given together"
            if "liquid" in given and "latent_heat" not in given:
                yield f"{path}.liquid: needs melting_point and latent_heat"
        for kind in ("body", "emitter", "obstacle"):
            for key, item in entry.keyed(kind):
                if scene.heat is None and item.temperature is not None:
                    yield f"{key}.temperature: needs a [heat] table, which lets heat flow"
        for key, item in entry.keyed("obstacle"):
            if item.held == "surface" and item.temperature is None:
                yield f'{key}.held: "surface" needs a temperature'
            if item.held == "surface" and scene.heat is not None and scene.heat.method == "chebyshev":
                yield f'{key}.held: "surface" needs heat.method "cg" or "multigrid"'
    if scene.heat is not None and scene.grid is not None:
        yield from _face_problems(scene.heat.face, scene.grid)


def _face_problems(faces: Sequence[schema.Face], grid: schema.Grid) -> Iterator[str]:
    dim = len(grid.lower)
    for k, face in enumerate(faces):
        for key in ("lower", "upper"):
            if len(getattr(face, key)) != dim:
                yield f"heat.face[{k}].{key}: must have {dim} numbers in this {dim}-D scene, got {getattr(face, key)}"
        flat = [a == b for a, b in zip(face.lower, face.upper, strict=False)]
        if sum(flat) != 1 or any(a > b for a, b in zip(face.lower, face.upper, strict=False)):
            yield f"heat.face[{k}]: upper must equal lower along one axis and be above it along the others"
        ends = zip(grid.lower, face.lower, face.upper, grid.upper, strict=False)
        if any(p < a - grid.dx or q > b + grid.dx for a, p, q, b in ends):
            yield f"heat.face[{k}]: is outside the domain, {grid.lower} to {grid.upper}"


def parameter(words: float | schema.Curve, reference: float) -> float | Table:
    """A number, or a table of temperatures relative to the reference."""
    if isinstance(words, schema.Curve):
        return Table([t - reference for t in words.temperature], words.value)
    return float(words)


def thermal(law: laws.Material, words: Any, reference: float) -> laws.Material:
    """Law with the melting and the expansion of its material."""
    liquid = getattr(words, "liquid", None)
    if liquid is not None:
        fluid = laws.WeaklyCompressible(liquid.bulk_modulus, liquid.gamma, parameter(liquid.viscosity, reference))
        law = Melting(law, fluid)
    return law if words.expansion is None else ThermalExpansion(law, words.expansion)


def conduction(scene: Any, entries: Sequence[Any], grid: Grid, laws: Sequence[Any], obstacles: Sequence[Together],
               device: torch.device) -> Heat:  # fmt: skip
    """The `Heat` of a step.

    Args:
        scene, entries: the scene and the content of each domain of its batch.
        grid: the lattice.
        laws: the words of a material of each law of the step.
        obstacles: obstacles of all scenes.
        device: device of the particles.
    """
    words, reference = scene.heat, scene.heat.reference

    def value(name: str, absent: float) -> Any:
        values = [absent if getattr(m, name) is None else parameter(getattr(m, name), reference) for m in laws]
        return values[0] if len(values) == 1 else PerMaterial(values)

    melting: dict[str, Any] = {}
    if any(m.latent_heat is not None for m in laws):
        points = [math.inf if m.melting_point is None else m.melting_point - reference for m in laws]
        melting = {
            "melting_point": points[0] if len(points) == 1 else PerMaterial(points),
            "latent_heat": value("latent_heat", 1.0),
        }
    return Heat(
        grid,
        value("conductivity", 0.0),
        value("specific_heat", 1.0),
        list(_terms(scene, entries, obstacles, device)),
        transfer=words.transfer,
        plastic_heating=words.plastic_heating,
        method=words.method,
        reference=reference,
        **melting,
    ).to(device)


def _terms(scene: Any, entries: Sequence[Any], obstacles: Sequence[Together], device: torch.device) -> Iterator[Any]:
    reference = scene.heat.reference
    for solid in obstacles:
        if solid.first.temperature is not None:
            hold = FixedSurface if solid.first.held == "surface" else Fixed
            rows = [0.0 if w is None else w.temperature - reference for w in solid.words]
            yield hold(
                solid.boundary,
                rows[0] if len(set(rows)) == 1 else torch.tensor(rows, dtype=torch.float64, device=device),
            )
    for exchange in scene.heat.exchange:
        if exchange.coefficient:
            yield Convection(FreeSurface(), exchange.coefficient, exchange.ambient - reference)
        if exchange.emissivity:
            yield Radiation(FreeSurface(), exchange.emissivity, exchange.ambient - reference)
    for face in scene.heat.face:
        yield Flux(_face(face, scene.grid.dx, len(entries), device), face.flux)


def _face(words: schema.Face, dx: float, scenes: int, device: torch.device) -> Surface:
    """Points half a node distance apart on an axis-aligned face, in every scene."""
    sides = [b - a for a, b in zip(words.lower, words.upper, strict=True)]
    counts = [max(1, math.ceil(2 * side / dx)) if side else 1 for side in sides]
    axes = [
        a + (torch.arange(n, dtype=torch.float64) + 0.5) * side / n
        for a, side, n in zip(words.lower, sides, counts, strict=True)
    ]
    points = torch.cartesian_prod(*axes).to(device)
    area = math.prod(side for side in sides if side) / len(points)
    if scenes == 1:
        return Surface(points, area)
    scene: Tensor = torch.arange(scenes, dtype=torch.int32, device=device).repeat_interleave(len(points))
    return Surface(points.repeat(scenes, 1), area, scene)
