"""Selection of particles by PhysGaussian and MPM-PyTorch, and their rotation."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..errors import shape_of
from ..state.state import State
from ..step.particle_operations import Timed
from .gradients import Numbers, number


class Rotation(Timed):
    """Rotates particles about an axis n through a point and moves them along it: v = ω (x − p) × n + s n.

    Args:
        point, normal: point and direction of the axis: three numbers, or tensors [3] that may require grad.
        rotation: ω [rad/s], about −n: a number, or a tensor [] that may require grad.
        translation: s [m/s], likewise.
        start, end, particles: see `Timed`.
    """

    def __init__(
        self,
        point: Numbers,
        normal: Numbers,
        rotation: float | Tensor,
        translation: float | Tensor,
        start: float,
        end: float,
        particles: Tensor,
    ) -> None:
        super().__init__(start, end, particles)
        self.point, self.normal = (small_vector(v, particles.device) for v in (point, normal))
        if not 0 < float(self.normal.detach().norm()) < math.inf:
            raise ValueError(f"normal must have a positive length, got {self.normal.tolist()}")
        for name, value in (("rotation_scale", rotation), ("translation_scale", translation)):
            if not isinstance(value, Tensor):
                number(name, value)
        self.rotation, self.translation = rotation, translation

    def forward(self, state: State, dt: float | Tensor) -> State:
        acting = self.acting(state)
        if acting is False:
            return state
        normal = self.normal / self.normal.norm()
        point, axis = self.point.to(state.x.dtype), normal.to(state.x.dtype)
        v = self.rotation * torch.linalg.cross(state.x - point, axis.expand_as(state.x)) + self.translation * axis
        return state.replace(v=torch.where(acting[:, None], v, state.v))  # type: ignore[index]


def in_box(x: Tensor, point: Numbers, size: Numbers) -> Tensor:
    """Whether positions are in a box of half edges `size` about a point, bool [P].

    Raises:
        ValueError: for a negative size, which would select nothing.
    """
    centre, half = small_vector(point, x.device).to(x.dtype), small_vector(size, x.device).to(x.dtype)
    if bool((half.detach() < 0).any()):
        raise ValueError(f"size must not be negative, got {half.tolist()}")
    return ((x.detach() - centre).abs() < half).all(1)


def chosen(name: str, mask: Any, x: Tensor) -> Tensor:
    """A mask of particles as bool [P]: not zero where a particle is chosen.

    Raises:
        TypeError, ValueError: for another shape, or no integers or bool.
    """
    if not isinstance(mask, Tensor) or tuple(mask.shape) != (len(x),):
        raise ValueError(f"{name} must have shape [P] = [{len(x)}], got {shape_of(mask)}")
    if mask.is_floating_point() or mask.is_complex():
        raise TypeError(f"{name} must be integers or bool, got {mask.dtype}")
    return (mask >= 1 if mask.dtype != torch.bool else mask.clone()).to(x.device)


def in_cylinder(
    x: Tensor,
    point: Numbers,
    normal: Numbers,
    half_height_and_radius: Numbers,
) -> Tensor:
    """Whether positions are in a cylinder, bool [P]."""
    offset = x.detach() - small_vector(point, x.device).detach().to(x.dtype)
    direction = small_vector(normal, x.device).detach()
    axis = (direction / direction.norm()).to(x.dtype)
    height = (offset * axis).sum(1)
    radius = (offset - height[:, None] * axis).norm(dim=1)
    half_height, largest = half_height_and_radius
    return (height.abs() < half_height) & (radius < largest)


def small_vector(v: Numbers, device: torch.device) -> Tensor:
    """Numbers on a device, float64; gradients of a tensor are preserved."""
    if isinstance(v, Tensor):
        return v.to(device, torch.float64)
    return torch.tensor([float(a) for a in v], dtype=torch.float64, device=device)
