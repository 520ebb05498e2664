"""Which particles PhysGaussian and MPM-PyTorch select, and how they turn them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..particle_operations import Timed
from ..state import State


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
        self.point, self.axis = (small_vector(v, particles.device) for v in (point, unitsmall_vector(normal)))
        self.rotation, self.translation = rotation, translation

    def forward(self, state: State, dt: float | Tensor) -> State:
        acting = self.acting(state)
        if acting is False:
            return state
        point, axis = self.point.to(state.x.dtype), self.axis.to(state.x.dtype)
        v = self.rotation * torch.linalg.cross(state.x - point, axis.expand_as(state.x)) + self.translation * axis
        return state.replace(v=torch.where(acting[:, None], v, state.v))  # type: ignore[index]


def unitsmall_vector(v: Sequence[float]) -> list[float]:
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
    centre, half = small_vector(point, x.device).to(x.dtype), small_vector(size, x.device).to(x.dtype)
    return ((x.detach() - centre).abs() < half).all(1)


def in_cylinder(
    x: Tensor, point: Sequence[float], normal: Sequence[float], half_height_and_radius: Sequence[float]
) -> Tensor:
    """Which positions are in a cylinder, bool [P]."""
    offset = x.detach() - small_vector(point, x.device).to(x.dtype)
    axis = small_vector(unitsmall_vector(normal), x.device).to(x.dtype)
    height = (offset * axis).sum(1)
    radius = (offset - height[:, None] * axis).norm(dim=1)
    half_height, largest = half_height_and_radius
    return (height.abs() < half_height) & (radius < largest)


def small_vector(v: Sequence[float], device: torch.device) -> Tensor:
    """Numbers on a device, float64."""
    return torch.tensor([float(a) for a in v], dtype=torch.float64, device=device)
