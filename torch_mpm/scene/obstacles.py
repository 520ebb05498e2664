"""Obstacles of a batch. Obstacles at the same index of the lists of several scenes that differ in numbers only are one
obstacle with numbers per scene.

So a thousand scenes with two obstacles each cost as much as one scene with two.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ..boundaries import Obstacle
from ..geometry import shapes
from ..geometry.shapes import Shape
from .places import obstacle
from .schema import OBSTACLE_WORDS

FAR = 1000.0
"""Distance of an obstacle from the scenes that lack it, in diagonals of the domain."""


@dataclass(frozen=True)
class Together:
    """Obstacle of some scenes of a batch, and its words in each, None where a scene lacks it."""

    boundary: Obstacle
    words: list[Any]

    @property
    def first(self) -> Any:
        """The words of the first scene that has it."""
        return next(words for words in self.words if words is not None)


def obstacles(entries: Sequence[Any], grid: Any, dtype: torch.dtype, device: torch.device) -> list[Together]:
    """All obstacles of all scenes.

    Args:
        entries: the scenes.
        grid: words of the domain.
        dtype, device: dtype and device of the particles.
    """
    if len(entries) == 1:
        return [Together(obstacle(words, None), [words]) for words in entries[0].obstacle]
    groups: dict[tuple[int, str], list[Any]] = {}
    for index, entry in enumerate(entries):
        for place, words in enumerate(entry.obstacle):
            groups.setdefault((place, _form(words)), [None] * len(entries))[index] = words
    made = []
    for _, words in sorted(groups.items(), key=lambda item: item[0]):  # One after another as in each scene.
        having = [k for k, w in enumerate(words) if w is not None]
        if len(having) == 1:
            made.append(Together(obstacle(words[having[0]], having[0]), words))
        else:
            made.append(Together(_joined(words, grid, dtype, device), words))
    return made


def _form(words: Any) -> str:
    """Properties that merged obstacles must share."""
    kept = (words.shape, words.contact, words.start, words.end, words.held)
    keys = OBSTACLE_WORDS[words.shape].keys.items()
    outlines = [getattr(words, name) for name, key in keys if key.kind == "outline"]
    optional = [name for name, key in keys if key.optional]
    absent = [getattr(words, name) is None for name in ("temperature", "velocity", "spin", *optional)]
    return repr((kept, outlines, absent))


def _joined(words: Sequence[Any], grid: Any, dtype: torch.dtype, device: torch.device) -> Obstacle:
    """One obstacle whose numbers are tensors [B] or [B, D]."""
    each = [None if w is None else obstacle(w, None) for w in words]
    one = next(o for o in each if o is not None)
    dim = len(grid.lower)

    def values(found: Sequence[Any], absent: Any) -> Any:
        rows = [absent if value is None else value for value in found]
        return torch.tensor(rows, dtype=dtype, device=device)

    def motion(name: str, absent: Any) -> Any:
        found = [None if o is None else getattr(o, name) for o in each]
        return None if all(value is None for value in found) else values(found, absent)

    still = 0.0 if dim == 2 else (0.0,) * 3
    return Obstacle(
        _shape([None if o is None else o.shape for o in each], values),
        values([None if o is None else o.position for o in each], _away(one.shape, grid)),
        kind=one.kind,
        friction=values([None if o is None else o.friction for o in each], 0.0),
        velocity=motion("velocity", (0.0,) * dim),
        rotation=motion("rotation", still),
        angular_velocity=motion("angular_velocity", still),
        start=one.start,
        end=one.end,
    )


def _shape(each: Sequence[Any], values: Any) -> Shape:
    one = next(shape for shape in each if shape is not None)
    found: dict[str, Any] = {}
    for name in one.arguments:
        own = getattr(one, name)
        if name not in one.RANKS or own is None:
            found[name] = own
        else:
            found[name] = values([None if shape is None else getattr(shape, name) for shape in each], own)
    made: Shape = type(one)(**found)
    return made


def _away(shape: Shape, grid: Any) -> list[float]:
    """Position at which a shape touches nothing in the domain."""
    diagonal = math.dist(grid.lower, grid.upper)
    direction: Iterator[float] = iter([1.0] * len(grid.lower))
    if isinstance(shape, shapes.Plane):
        normal = [float(a) for a in shape.normal]
        direction = (a / math.hypot(*normal) for a in normal)
    return [a - FAR * diagonal * along for a, along in zip(grid.lower, direction, strict=True)]
