"""Scenes drawn from a configuration. A scene depends only on the hash of the configuration and its id.

Bodies are placed one after another. A body that extends beyond the domain or is nearer than the gap to another body or
an obstacle is drawn again; if that does not help, the whole scene is.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter, ValidationError
from torch import Tensor

from ..geometry import shapes
from ..geometry.seed import Region
from ..scene import schema
from ..scene.places import obstacle, region
from .configuration import Configuration
from .distribution import Words, sample

TRIES, RESTARTS = 100, 10
"""Maximum number of draws of a body, and of the scene."""
PROBES = 20_000
"""Maximum number of points of a body for checks of distances."""

_BODY: TypeAdapter[Any] = TypeAdapter(schema.AnyBody)
_OBSTACLE: TypeAdapter[Any] = TypeAdapter(schema.AnyObstacle)


class NoRoom(ValueError):
    """A scene without space for a body."""


def generator(configuration: Configuration, scene_id: int) -> np.random.Generator:
    """Random numbers of a scene."""
    entropy = np.random.SeedSequence([int(configuration.hash[:32], 16), scene_id])
    return np.random.Generator(np.random.Philox(entropy))


def content(configuration: Configuration, scene_id: int) -> Words:
    """Content of a scene in the form of a scene file: gravity, material, body, obstacle and seed.

    Raises:
        NoRoom: where no position was found for a body.
    """
    rng, dim, words, full = generator(configuration, scene_id), configuration.dim, configuration.words, ""
    for _ in range(RESTARTS):
        drawn: Words = {key: sample(words[key], rng, dim) for key in ("gravity", "material") if key in words}
        drawn["seed"] = int(rng.integers(2**31))
        drawn["obstacle"] = [
            with_ends(sample(item, rng, dim), ALONG_OBSTACLES)
            for _, item in _repeated(words.get("obstacle", []), rng, dim)
        ]
        places = _Places(configuration, drawn["obstacle"])
        bodies = _repeated(words.get("body", []), rng, dim)
        full = next((f"body[{k}]" for k, item in bodies if not places.put(item, rng)), "")
        if not full:
            drawn["body"] = places.bodies()
            return drawn
    raise NoRoom(
        f"scene {scene_id}: no room for {full} in {RESTARTS} scenes with {TRIES} tries each; make bodies smaller or "
        "fewer, dataset.gap smaller or the domain larger"
    )


def _repeated(items: Any, rng: np.random.Generator, dim: int) -> Iterator[tuple[int, Words]]:
    """(number in the file, words without their count) of all bodies, or obstacles, of a scene."""
    for k, item in enumerate(items):
        count = sample(item.get("count", 1), rng, dim)
        for _ in range(int(count)):
            yield k, {key: value for key, value in item.items() if key != "count"}


ALONG_OBSTACLES = {"capsule": "axis"}
ALONG = {"box": "size", "cylinder": "axis", **ALONG_OBSTACLES}
"""Vectors between the ends of a shape, by the name of the shape."""


def with_ends(words: Words, names: dict[str, str] = ALONG) -> Words:
    """Shape with its ends, as in scene files, instead of a center and a vector between the ends."""
    shape = words.get("shape")
    along = names.get(shape) if isinstance(shape, str) else None
    if along is None or "center" not in words or along not in words:
        return words
    center, whole = words["center"], words[along]
    try:
        ends = [[c + sign * w for c, w in zip(center, whole, strict=True)] for sign in (-0.5, 0.5)]
    except (TypeError, ValueError):
        return words  # The checks of scene files explain these.
    first, last = ("lower", "upper") if along == "size" else ("a", "b")
    rest = {key: value for key, value in words.items() if key not in ("center", along)}
    return {**rest, first: ends[0], last: ends[1]}


class _Places:
    """Obstacles and bodies of a scene so far."""

    def __init__(self, configuration: Configuration, obstacles: list[Words]) -> None:
        grid = configuration.words["grid"]
        self.configuration = configuration
        self.lower, self.upper, self.dx = grid["lower"], grid["upper"], grid["dx"]
        gap = configuration.dataset.gap
        self.gap = self.dx if gap is None else gap
        self.obstacles = [o for words in obstacles if (o := self._obstacle(words)) is not None]
        self.placed: list[tuple[Words, Region | None]] = []

    def put(self, words: Words, rng: np.random.Generator) -> bool:
        """Draw a body until there is space for it; returns whether there is."""
        for _ in range(TRIES):
            drawn = with_ends(sample(words, rng, self.configuration.dim))
            body = self._region(drawn)
            if body is None or self._has_room(body):
                self.placed.append((drawn, body))
                return True
        return False

    def bodies(self) -> list[Words]:
        """The words of all bodies, with their shares of the particles of the scene where their number is given."""
        words = [drawn for drawn, _ in self.placed]
        budget = self.configuration.dataset.particles
        regions = [shape for _, shape in self.placed]
        if budget is None or None in regions:
            return words
        shares = divided(budget, [shape.volume for shape in regions if shape is not None])
        return [{**item, "particles": share} for item, share in zip(words, shares, strict=True)]

    def _obstacle(self, words: Words) -> Any:
        try:
            model = _OBSTACLE.validate_python(words)
            found = obstacle(model, None)
            found.signed_distance(torch.zeros(1, self.configuration.dim, dtype=torch.float64), None, 0.0)
            return None if model.start > 0 else found
        except (ValidationError, ValueError, TypeError):
            return None  # The checks of scene files explain it.

    def _region(self, words: Words) -> Region | None:
        """Region of a body; None for points, and for words that the checks of scene files will refuse."""
        try:
            body = _BODY.validate_python(words)
            if isinstance(body, schema.MeshBody):
                return Region(_mesh(self.configuration.folder / body.file, body.scale), body.offset)
            found = region(body, None)
        except (ValidationError, ValueError, TypeError, OSError):
            return None
        return found if found is not None and len(found.lower) == self.configuration.dim else None

    def _has_room(self, body: Region) -> bool:
        lower, upper = body.lower.tolist(), body.upper.tolist()
        slack = 1e-9 * self.dx
        if any(a < b - slack for a, b in zip(lower, self.lower, strict=True)):
            return False
        if any(a > b + slack for a, b in zip(upper, self.upper, strict=True)):
            return False
        near = [shape for _, shape in self.placed if shape is not None and self._boxes_meet(shape, lower, upper)]
        if not near and not self.obstacles:
            return True
        probes, missed = _probes(body, 0.25 * self.dx)
        least = self.gap + missed  # Distances from a shape change by no more than the displacement.
        if any(bool((other.shape.signed_distance(probes - other.position) < least).any()) for other in near):
            return False
        return not any(bool((o.signed_distance(probes, None, 0.0) < least).any()) for o in self.obstacles)

    def _boxes_meet(self, other: Region, lower: Sequence[float], upper: Sequence[float]) -> bool:
        """Whether the box around a region is nearer than the gap to the box around another."""
        sides = zip(lower, upper, other.lower.tolist(), other.upper.tolist(), strict=True)
        return all(a - self.gap < d and c < b + self.gap for a, b, c, d in sides)


@functools.lru_cache(maxsize=64)
def _mesh(path: Path, scale: float) -> shapes.Mesh:
    return shapes.Mesh(path, scale)


def _probes(body: Region, spacing: float) -> tuple[Tensor, float]:
    """Points [N, D] [m] all over a region and just outside, and a distance [m] within which all of the region is."""
    sides = (body.upper - body.lower).tolist()
    spacing = max(spacing, (math.prod(sides) / PROBES) ** (1 / len(sides)))
    axes = [
        torch.linspace(a, b, max(2, math.ceil((b - a) / spacing) + 1), dtype=torch.float64)
        for a, b in zip(body.lower.tolist(), body.upper.tolist(), strict=True)
    ]
    missed = 0.5 * math.hypot(*(float(axis[1] - axis[0]) for axis in axes))
    points = torch.cartesian_prod(*axes)
    return points[body.shape.signed_distance(points - body.position) <= missed * (1 + 1e-9)], missed


def divided(total: int, shares: Sequence[float]) -> list[int]:
    """Integers that add up to ``total``, as near as possible to these shares of it, and none of them zero."""
    if total < len(shares):
        raise NoRoom(f"dataset.particles: {total} particles are too few for {len(shares)} bodies")
    spare = total - len(shares)
    exact = [spare * share / sum(shares) for share in shares]
    counts = [math.floor(value) for value in exact]
    order = sorted(range(len(shares)), key=lambda k: counts[k] - exact[k])
    for k in order[: spare - sum(counts)]:
        counts[k] += 1
    return [1 + count for count in counts]
