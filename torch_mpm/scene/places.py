"""Regions of bodies, and obstacles, from the words of a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from .. import boundaries
from ..boundaries import Obstacle
from ..geometry import seed
from . import schema

PLACES = ("lower", "upper", "offset", "view", *schema.POINT_KEYS)
"""Keys of coordinates [m]; `dam` is a single x."""


def relative(words: Any, origin: Sequence[float]) -> Any:
    """Words of a scene, or a part of them, with all coordinates minus an origin.

    The differences are those of the decimal numbers: a scene far from zero equals one near it to the last bit.
    """
    if isinstance(words, list):
        return [relative(item, origin) for item in words]
    if isinstance(words, dict):
        return {key: relative(value, origin) for key, value in words.items()}
    if not isinstance(words, BaseModel):
        return words
    changes = {name: _changed(name, value, origin) for name, value in words if value is not None}
    return words.model_copy(update=changes)


def _changed(name: str, value: Any, origin: Sequence[float]) -> Any:
    if name == "dam":
        return _less((value,), origin[:1])[0]
    return _less(value, origin) if name in PLACES else relative(value, origin)


def _less(value: Any, origin: Sequence[float]) -> Any:
    """Position, or a tuple of positions, relative to an origin."""
    if isinstance(value[0], tuple):
        return tuple(_less(place, origin) for place in value)
    return tuple(float(Decimal(repr(a)) - Decimal(repr(b))) for a, b in zip(value, origin, strict=True))


def region(body: schema.Body, folder: Path | None) -> seed.Region | None:
    """Region of a body; None for points, and without a folder for the content of a file."""
    if isinstance(body, schema.BoxBody):
        return seed.Box(body.lower, body.upper)
    if isinstance(body, schema.SphereBody):
        return seed.Sphere(body.center, body.radius)
    if isinstance(body, schema.CylinderBody):
        return seed.Cylinder(body.a, body.b, body.radius)
    if isinstance(body, schema.CapsuleBody):
        return seed.Capsule(body.a, body.b, body.radius)
    if isinstance(body, schema.MeshBody) and folder is not None:
        return seed.Mesh(folder / body.file, body.scale, body.offset)
    return None


def obstacle(words: Any, scene: int | None) -> Obstacle:
    """Boundary of the step for an obstacle of a scene."""
    shape, position = schema.OBSTACLE_SHAPES[words.shape].from_words(words)
    return boundaries.Obstacle(
        shape,
        position,
        kind=words.contact,
        friction=words.friction,
        velocity=words.velocity,
        rotation=words.rotation,
        angular_velocity=words.spin,
        start=words.start,
        end=math.inf if words.end is None else words.end,
        scene=scene,
    )
