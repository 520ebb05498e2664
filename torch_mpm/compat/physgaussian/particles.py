"""What PhysGaussian's simulator does to particles, and which ones it selects."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...particle_operations import Timed
from ...state import State

LAYERS = 50
"""Of a sequential release."""


class DampedAffine(Timed):
    """RPIC: the symmetric part of C less a share; without C, which is PIC, for a negative share."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, state: State, dt: float | Tensor) -> State:
        assert state.C is not None
        if self.share < 0:
            return state.replace(C=torch.zeros_like(state.C))
        return state.replace(C=state.C - self.share / 2 * (state.C + state.C.mT))


class Rotation(Timed):
    """Turns particles about an axis n through a point and moves them along it: v = ω (x − p) × n + s n.

    Args:
        point, normal: of the axis.
        rotation: ω [rad/s], about −n.
        translation: s [m/s]
        start, end, particles: see `Timed`.
    """

    def __init__(
        self,
        point: Sequence[float],
        normal: Sequence[float],
        rotation: float,
        translation: float,
        start: float,
        end: float,
        particles: Tensor,
    ) -> None:
        super().__init__(start, end, particles)
        self.point, self.axis = (_vector(v, particles.device) for v in (point, unit_vector(normal)))
        self.rotation, self.translation = rotation, translation

    def forward(self, state: State, dt: float | Tensor) -> State:
        acting = self.acting(state)
        if acting is False:
            return state
        point, axis = self.point.to(state.x.dtype), self.axis.to(state.x.dtype)
        v = self.rotation * torch.linalg.cross(state.x - point, axis.expand_as(state.x)) + self.translation * axis
        return state.replace(v=torch.where(acting[:, None], v, state.v))  # type: ignore[index]


def unit_vector(v: Sequence[float]) -> list[float]:
    """A vector of length one.

    Raises:
        ValueError: for the zero vector.
    """
    length = math.sqrt(sum(float(a) ** 2 for a in v))
    if not 0 < length < math.inf:
        raise ValueError(f"normal must have a positive length, got {list(v)}")
    return [float(a) / length for a in v]


def in_box(x: Tensor, point: Sequence[float], size: Sequence[float]) -> Tensor:
    """Which positions are in a box of half edges `size` about a point, bool [P]."""
    centre, half = _vector(point, x.device).to(x.dtype), _vector(size, x.device).to(x.dtype)
    return ((x.detach() - centre).abs() < half).all(1)


def in_cylinder(
    x: Tensor, point: Sequence[float], normal: Sequence[float], half_height_and_radius: Sequence[float]
) -> Tensor:
    """Which positions are in a cylinder, bool [P]."""
    offset = x.detach() - _vector(point, x.device).to(x.dtype)
    axis = _vector(unit_vector(normal), x.device).to(x.dtype)
    height = (offset * axis).sum(1)
    radius = (offset - height[:, None] * axis).norm(dim=1)
    half_height, largest = half_height_and_radius
    return (height.abs() < half_height) & (radius < largest)


def release_times(x: Tensor, normal: Sequence[float], start: float, end: float, end_time: float) -> Tensor:
    """When each particle is let go [P] [s]; at once where it is in no layer.

    Layer k of n holds the particles nearer to `end` than (n − k)/n of the way from `start` until (k + 1)/n of the time,
    and on the axes without a normal those within 1 m of 1 m.
    """
    point, size, axis = [1.0] * 3, [1.0] * 3, -1
    for i in range(3):
        if normal[i] != 0:
            axis, point[i], size[i] = i, end, 0.0
    times = torch.full_like(x[:, 0], -math.inf, dtype=torch.float64)
    for k in range(LAYERS):
        size[axis] = abs(start - end) / LAYERS * (LAYERS - k)
        times = torch.where(in_box(x, point, size), end_time / LAYERS * (k + 1), times)
    return times


def _vector(v: Sequence[float], device: torch.device) -> Tensor:
    return torch.tensor([float(a) for a in v], dtype=torch.float64, device=device)
