"""Rigid bodies with mass and inertia, and the joints that guide them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..boundaries.obstacles import Obstacle
from ..errors import check_vector, shape_of
from ..geometry.values import filled, positive, shape_of_value
from .exchange import VELOCITY, Part, parts_of, swirl

NOT_ALLOWED = 1e-5
"""Largest share of a velocity that a joint does not allow."""


class Joint:
    """Motion that a body is free to have. This one allows all of it."""

    name: ClassVar[str] = "free"
    """The joint among `torch_mpm.ops.free_bodies.JOINTS`."""

    def directions(self, position: Tensor) -> Tensor | None:
        """Velocities and angular velocities [B, n, f] that the body at a position [B, D] may have; None for all."""
        return None

    def arm(self, position: Tensor) -> Tensor | None:
        """Vector from the fixed point to the position [B, D] [m]; None without such a point."""
        return None

    def check_dimension(self, dim: int) -> None:
        """Raise ValueError for a joint of another dimension than D."""


class Hinge(Joint):
    """Rotation about an axis that is fixed in the world.

    Args:
        anchor: a point of the axis [m], D numbers.
        axis: its direction, 3 numbers of any length but zero; None in 2-D.
    """

    name: ClassVar[str] = "hinge"

    def __init__(self, anchor: Sequence[float], axis: Sequence[float] | None = None) -> None:
        self.anchor = check_vector("anchor", anchor)
        self.axis = None if axis is None else _unit("axis", axis)

    def check_dimension(self, dim: int) -> None:
        if len(self.anchor) != dim or (self.axis is None) != (dim == 2) or (self.axis and len(self.axis) != dim):
            raise ValueError(f"hinge must have an anchor of {dim} numbers and, in 3-D alone, an axis of 3")

    def arm(self, position: Tensor) -> Tensor | None:
        return position - filled(self.anchor, position)

    def directions(self, position: Tensor) -> Tensor | None:
        arm = position - filled(self.anchor, position)
        spin = filled([1.0] if self.axis is None else self.axis, arm).expand(len(arm), -1)
        velocity = swirl(spin[:, 0] if self.axis is None else spin, arm)
        return torch.cat([velocity, spin], 1)[..., None]


class Slider(Joint):
    """Translation along a direction, without rotation.

    Args:
        axis: the direction, D numbers of any length but zero.
    """

    name: ClassVar[str] = "slider"

    def __init__(self, axis: Sequence[float]) -> None:
        self.axis = _unit("axis", axis)

    def check_dimension(self, dim: int) -> None:
        if len(self.axis) != dim:
            raise ValueError(f"slider must have an axis of {dim} numbers, got {self.axis}")

    def directions(self, position: Tensor) -> Tensor | None:
        dim = len(self.axis)
        way = [*self.axis, *[0.0] * (VELOCITY[dim] - dim)]
        return filled(way, position).expand(len(position), -1)[..., None]


class Driven(Joint):
    """No motion but the velocity that the body is given: nothing pushes it."""

    name: ClassVar[str] = "driven"

    def directions(self, position: Tensor) -> Tensor | None:
        return position.new_zeros(len(position), VELOCITY[position.shape[1]], 0)


class Body:
    """A rigid body, whose frame has its centre of mass as origin.

    Args:
        parts: an obstacle, a `Part`, or a list of these; shapes that the kernel of contact knows. Steps assign their
            position, rotation and velocities.
        mass: [kg], positive, a number or a tensor []. Differentiable.
        inertia: moment of inertia about the centre of mass [kg m²], positive: a number in 2-D; in 3-D a number, or
            three for the axes of the frame. Or a tensor [], [1] or [3]. Differentiable.
        joint: `Hinge`, `Slider` or `Driven`; None for a free body.

    All scenes have the same mass and inertia. Tensors are on the device of the state, where an `advance` reads them.

    Raises:
        TypeError, ValueError: for anything else.
    """

    def __init__(
        self,
        parts: Obstacle | Part | Sequence[Obstacle | Part],
        mass: float | Tensor,
        inertia: float | Sequence[float] | Tensor,
        joint: Joint | None = None,
    ) -> None:
        self.parts = parts_of(0, parts)
        self.mass = _positive("mass", mass, ((),))
        # A view of a tensor would have no gradient where the body is made before the tensor requires one.
        moments = _positive("inertia", inertia, ((), (1,), (3,)))
        self.inertia = moments if isinstance(moments, Tensor) else _tuple_of(moments)
        if joint is not None and type(joint) not in (Joint, Hinge, Slider, Driven):
            raise TypeError(f"joint must be a Hinge, a Slider, Driven or None, got {shape_of(joint)}")
        self.joint = joint or Joint()

    def check_dimension(self, dim: int) -> None:
        """Raise ValueError for a body of another dimension than D."""
        count = self.inertia.numel() if isinstance(self.inertia, Tensor) else len(self.inertia)
        if count not in ((1,) if dim == 2 else (1, 3)):
            raise ValueError(
                f"inertia must be {'a number in 2-D' if dim == 2 else 'one or three numbers'}, got {self.inertia}"
            )
        self.joint.check_dimension(dim)
        for part in self.parts:
            part.check_dimension(dim)

    def moves_as_its_joint(self, position: Tensor, velocity: Tensor) -> bool:
        """Whether the joint allows velocities [B, n] at positions [B, D], up to a share of `NOT_ALLOWED`; reads them.

        The projection on what it allows is by a frame that is not turned: a velocity that is allowed is its own
        projection for any inertia.
        """
        directions = self.joint.directions(position)
        if directions is None:
            return True
        count, dim = position.shape
        matrix = self.mass_matrix(torch.eye(dim, dtype=position.dtype).expand(count, -1, -1))
        allowed = (mobility(matrix, directions) @ matrix @ velocity[..., None])[..., 0]
        weights = matrix.diagonal(dim1=1, dim2=2)
        wrong, whole = ((v.square() * weights).sum(1) for v in (velocity - allowed, velocity))
        return not bool((wrong > NOT_ALLOWED**2 * whole).any())

    def mass_matrix(self, turn: Tensor) -> Tensor:
        """Mass and inertia [B, n, n] by the rotation of the frame [B, D, D], n = 3 in 2-D and 6 in 3-D."""
        count, dim = turn.shape[:2]
        matrix = turn.new_zeros(count, VELOCITY[dim], VELOCITY[dim])
        matrix[:, range(dim), range(dim)] = self.mass_like(turn)
        moments = self.moments_like(turn, dim)
        matrix[:, dim:, dim:] = moments if dim == 2 else turn @ torch.diag(moments) @ turn.mT
        return matrix

    def mass_like(self, like: Tensor) -> Tensor:
        """Mass [] in float64 on the device of `like`; raises ValueError for a tensor on another one."""
        return _like("mass", self.mass, like)

    def moments_like(self, like: Tensor, dim: int) -> Tensor:
        """Moments of inertia [1] (2-D) or [3] (3-D) in float64 on the device of `like`; see `mass_like`."""
        return _like("inertia", self.inertia, like).reshape(-1).expand(1 if dim == 2 else 3)


def mobility(matrix: Tensor, directions: Tensor | None) -> Tensor:
    """Velocities by impulses [B, n, n]: S (Sᵀ M S)⁻¹ Sᵀ for the mass matrix M and the directions S."""
    if directions is None:
        return torch.linalg.inv_ex(matrix)[0]
    return directions @ torch.linalg.solve_ex(directions.mT @ matrix @ directions, directions.mT)[0]


def _positive(name: str, value: Any, shapes: Sequence[tuple[int, ...]]) -> Any:
    """Positive numbers of one of some shapes."""
    value = positive(name, value)
    if shape_of_value(value) not in shapes:
        expected = " or ".join(str(list(shape)) for shape in shapes)
        raise ValueError(f"{name} must have shape {expected}, got {list(shape_of_value(value))}")
    return value


def _tuple_of(value: Any) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


def _like(name: str, value: Any, like: Tensor) -> Tensor:
    if not isinstance(value, Tensor):
        return filled(value, like, torch.float64)
    if value.device != like.device:
        raise ValueError(f"{name} must be on the device of the state, {like.device}, got {value.device}")
    return value.double()


def _unit(name: str, vector: Sequence[float]) -> tuple[float, ...]:
    numbers = check_vector(name, vector)
    length = math.hypot(*numbers)
    if not 0 < length < math.inf:
        raise ValueError(f"{name} must have a positive length, got {numbers}")
    return tuple(n / length for n in numbers)
