"""Contact conditions on the faces of the domain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from ..errors import check_number, check_numbers

CONTACTS = ("sticky", "slip", "separate")
WALL_KINDS = (*CONTACTS, "mirror", "open")
LEAST_BETWEEN_MIRRORS = 5
"""Least number of cells between a mirror and the opposite wall, so that no node has two images
(csrc/grid/grid_update.h)."""


class Face(NamedTuple):
    """One side of the domain: the contact condition of nodes at or beyond `plane` [m]."""

    kind: str
    plane: float
    friction: float


class _Box(Protocol):
    """The part of a `Grid` that walls read."""

    dim: int
    dx: float
    lower: tuple[float, ...]
    upper: tuple[float, ...]


class Walls:
    """Contact conditions on the faces of an axis-aligned box at rest, applied by `grid_update`.

    Nodes at or beyond a face (within 1e-6 dx) lose their velocity ("sticky"), its normal component ("slip"), or its
    normal component where it points into the wall ("separate"); an "open" face does nothing. Coulomb friction lowers
    the tangential speed by `friction` times the normal velocity that the wall stops. Where faces meet, they act one
    after another in the order of the axes.

    A "mirror" is a frictionless wall of second order in dx, where "slip" is of first: nodes near it get the velocity
    of the particles together with their images behind the wall, so particles at the wall move as in the middle of a
    body. It must lie on a node or halfway between two, and `LEAST_BETWEEN_MIRRORS` cells
    from the wall opposite. It acts before the other faces and obstacles, whose effect on a node it does not reflect.

    Args:
        kind: "sticky", "slip", "separate", "mirror" or "open", for all faces; or D of these, one per axis, each either
            a name or a pair (lower face, upper face).
        lower, upper: corners of the box [m], D numbers each; None for those of the grid.
        friction: Coulomb coefficient ≥ 0, in the same forms as `kind`; 0 for mirrors. It has no gradient: use a `Plane`
            for that.

    Raises:
        ValueError, TypeError: for a wrong argument, some of them at the first use with a grid.
    """

    def __init__(
        self,
        kind: str | Sequence[str | tuple[str, str]] = "slip",
        lower: Sequence[float] | None = None,
        upper: Sequence[float] | None = None,
        friction: float | Sequence[float | tuple[float, float]] = 0.0,
    ) -> None:
        self.kind, self.friction = _frozen(kind), _frozen(friction)
        self.lower, self.upper = _numbers("lower", lower), _numbers("upper", upper)
        self._faces: tuple[Any, tuple[Face, ...]] = (None, ())
        _check(self.kind, self.friction)

    def __repr__(self) -> str:
        return f"Walls({self.kind!r}, lower={self.lower}, upper={self.upper}, friction={self.friction})"

    def faces(self, grid: _Box) -> tuple[Face, ...]:
        """The 2 D faces: lower and upper of the first axis, then of the next."""
        own = tuple(map(_frozen, (self.kind, self.friction, self.lower, self.upper)))
        key = (*own, grid.dx, grid.lower, grid.upper)
        if self._faces[0] != key:
            self._faces = (key, self._resolve(grid))
        return self._faces[1]

    def _resolve(self, grid: _Box) -> tuple[Face, ...]:
        _check(self.kind, self.friction)  # which may have been assigned
        lower = grid.lower if self.lower is None else self.lower
        upper = grid.upper if self.upper is None else self.upper
        if len(lower) != grid.dim or len(upper) != grid.dim:
            raise ValueError(f"lower and upper of walls must have {grid.dim} numbers, got {lower} and {upper}")
        if not all(a < b for a, b in zip(lower, upper, strict=True)):
            raise ValueError(f"upper of walls must be above lower on every axis, got {lower} and {upper}")
        planes = [plane for pair in zip(lower, upper, strict=True) for plane in pair]
        kinds = _per_face("kind", self.kind, grid.dim)
        frictions = _per_face("friction", self.friction, grid.dim)
        faces = tuple(Face(k, p, float(f)) for k, p, f in zip(kinds, planes, frictions, strict=True))
        for axis in range(grid.dim):
            _check_mirrors(grid, axis, faces[2 * axis : 2 * axis + 2])
        return faces

    def mirrors(self) -> Walls | None:
        """The mirrors alone, all other faces open; None without mirrors."""
        if "mirror" not in _flat(self.kind):
            return None
        return Walls(_replaced(self.kind, {name: "open" for name in CONTACTS}), self.lower, self.upper)


def _check(kind: Any, friction: Any) -> None:
    """Raise for a kind or a coefficient that no wall can have."""
    for name in _flat(kind):
        if name not in WALL_KINDS:
            raise ValueError(f"kind of a wall must be one of {sorted(WALL_KINDS)}, got {name!r}")
    for coefficient in _flat(friction):
        if isinstance(coefficient, Tensor):
            raise TypeError("friction of walls must be a number, got Tensor: use a Plane for friction with a gradient")
        check_number("friction of walls", coefficient, "a finite number >= 0", lambda v: 0 <= v < math.inf)


def _check_mirrors(grid: _Box, axis: int, faces: Sequence[Face]) -> None:
    for face in faces:
        if face.kind != "mirror":
            continue
        cells = (face.plane - grid.lower[axis]) / grid.dx
        if abs(2 * cells - round(2 * cells)) > 2e-6:
            raise ValueError(
                f"a mirror must lie on a node or halfway between two: the one at {face.plane} m on axis {axis} is "
                f"{cells:g} cells from the lower corner of the grid"
            )
        if face.friction != 0:
            raise ValueError(f"friction of a mirror must be 0, got {face.friction}")
        between = (faces[1].plane - faces[0].plane) / grid.dx
        if all(other.kind != "open" for other in faces) and between < LEAST_BETWEEN_MIRRORS - 1e-6:
            raise ValueError(
                f"a mirror must be at least {LEAST_BETWEEN_MIRRORS} cells from the wall opposite, got {between:g} on "
                f"axis {axis}"
            )


def _replaced(value: Any, names: dict[str, str]) -> Any:
    """Nested tuples of names with some names replaced."""
    return names.get(value, value) if isinstance(value, str) else tuple(_replaced(item, names) for item in value)


def _numbers(name: str, values: Sequence[float] | None) -> tuple[float, ...] | None:
    if values is None:
        return None
    return check_numbers(f"{name} of walls", values)


def _frozen(value: Any) -> Any:
    """Nested sequences as tuples, which cannot change after `Walls` has read them."""
    if value is None or isinstance(value, (str, float)) or not isinstance(value, Sequence):
        return value
    return tuple([_frozen(item) for item in value])


def _flat(value: Any) -> list[Any]:
    if isinstance(value, (str, Tensor)) or not isinstance(value, Sequence):
        return [value]
    return [item for entry in value for item in _flat(entry)]


def _per_face(name: str, value: Any, dim: int) -> list[Any]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        return [value] * (2 * dim)
    pairs = [(v, v) if isinstance(v, str) or not isinstance(v, Sequence) else tuple(v) for v in value]
    if len(pairs) != dim or any(len(pair) != 2 for pair in pairs):
        raise ValueError(f"{name} of walls must have one entry or pair per axis, {dim} in all, got {value}")
    return [item for pair in pairs for item in pair]
