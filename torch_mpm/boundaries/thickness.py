"""Walls that are too thin for the grid: what material on one side does to the nodes of the other."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from ..errors import ThinWallWarning
from .obstacles import Obstacle

LEAST = 4.0
"""Thickness of a wall in dx below which it is reported: the nodes that material at it sees on both sides, two each."""


def thin_walls(boundaries: Sequence[Any], dx: float) -> Iterator[str]:
    """A sentence about each obstacle that is thinner than `LEAST`."""
    for number, boundary in enumerate(boundaries):
        if isinstance(boundary, Obstacle) and (found := boundary.shape.thinnest_wall()) < LEAST * dx * (1 - 1e-6):
            yield (
                f"obstacle {number} ({boundary.shape.name}) is {found / dx:.2g} dx thick where it is thinnest, and "
                f"material passes through walls that are thinner than {LEAST:g} dx unless another obstacle is behind: "
                f"make it {LEAST * dx:.3g} m thick, or refine the grid"
            )


def warn_of_thin_walls(boundaries: Sequence[Any], dx: float) -> None:
    """Warn of obstacles that are thinner than `LEAST`, at the line that called a public `check`."""
    for found in thin_walls(boundaries, dx):
        warnings.warn(found, ThinWallWarning, stacklevel=3)
