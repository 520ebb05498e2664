"""Bodies of a scene made of Gaussian splats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..geometry.seed import Points
from ..splats import Gaussians, particles, placed, read, visible
from ..splats.particles import FIELD
from . import check, schema

INNER, NONE = -1, -2
"""Numbers in place of that of a Gaussian, of particles inside an object and of those of other bodies."""


def seeded(scene: Any, origin: Sequence[float] | None, entry: Any, body: schema.SplatsBody, number: int) -> Points:
    """Particles of a body, float64, relative to the origin of its scene; `number` is the seed of random numbers.

    Raises:
        ValueError: for an object outside the domain, before it is filled, and as `loaded` and `particles`.
    """
    gaussians = loaded(scene, entry, body)
    shift = None if body.center is not None else origin  # A center is relative to it.
    x = gaussians.x.double() - (0 if shift is None else torch.tensor(shift, dtype=torch.float64))
    if not check.inside(scene.grid, x):
        raise ValueError(check.reach(x.amin(0), x.amax(0), scene.grid, origin))
    return particles(
        gaussians,
        scene.grid.dx,
        body.per_cell,
        fill=body.fill,
        method=body.seeding,
        seed=number,
        origin=shift,
        dtype=torch.float64,
    )


def loaded(scene: Any, entry: Any, body: schema.SplatsBody) -> Gaussians:
    """Gaussians of a body at rest, without faint ones, in the order of its particles."""
    gaussians = read(scene.folder / body.file, getattr(torch, scene.precision))
    gaussians = gaussians[visible(gaussians, body.min_opacity)]
    if len(gaussians) == 0:
        raise ValueError(f"no Gaussian of {body.file} has an opacity of min_opacity = {body.min_opacity:g} or more")
    return placed(gaussians, body.up, body.extent, body.center, world_up=up_axis(entry.gravity))


def up_axis(gravity: Sequence[float] | None) -> str:
    """Signed axis that is nearest to the opposite of gravity; y without gravity."""
    if gravity is None or not any(gravity):
        return "+y"
    axis = max(range(3), key=lambda k: abs(gravity[k]))
    return ("+" if gravity[axis] < 0 else "-") + "xyz"[axis]


def numbers(parts: Sequence[Points]) -> Tensor | None:
    """Numbers of the Gaussians of the particles of all bodies, int32 [P], counted from body to body.

    Particles inside an object have `INNER`, and those of other bodies `NONE`. The result is None without Gaussians.
    """
    if not any(FIELD in points.fields for points in parts):
        return None
    found, first = [], 0
    for points in parts:
        number = points.fields.get(FIELD)
        if number is None:
            found.append(torch.full((len(points),), NONE, dtype=torch.int32))
            continue
        found.append(torch.where(number >= 0, number + first, INNER).to(torch.int32))
        first += int((number >= 0).sum())
    return torch.cat(found)
