"""A vessel of three boxes, in 2-D: the cup and the glass of `Pour`, and the bucket of `Scoop`."""

from __future__ import annotations

from ..bodies.exchange import Part
from ..boundaries import Box

THICK = 4
"""Thickness of walls in cells; material on both sides of thinner ones moves the same nodes."""


def vessel(width: float, depth: float, thick: float, friction: float = 0.0) -> list[Part]:
    """Bottom, left and right wall of a vessel.

    Args:
        width, depth: of the inside [m].
        thick: thickness of the walls [m].
        friction: Coulomb coefficient.

    Returns:
        Parts of a body whose position is the middle of the bottom inside, and which is open upwards at angle zero.
    """
    side, middle = 0.5 * (width + thick), 0.5 * (depth - thick)
    boxes = [
        ((width + 2 * thick, thick), (0.0, -0.5 * thick)),
        ((thick, depth + thick), (-side, middle)),
        ((thick, depth + thick), (side, middle)),
    ]
    return [Part(Box((0.0, 0.0), size, "separate", friction=friction), at) for size, at in boxes]
