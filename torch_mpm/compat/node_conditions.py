"""Conditions on grid nodes in the conventions of other simulators, as boundaries of a `Step`."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ..boundaries import Box, Obstacle, Plane
from ..laws.parameters import TensorModule
from .gradients import Numbers


def surface_margin(dtype: torch.dtype, extent: float) -> float:
    """Displacement [m] of a surface, so that nodes on it are outside, where the other simulators compare with <.

    An `Obstacle` treats nodes within 16 roundings of the largest coordinate as inside.
    """
    return 64 * torch.finfo(dtype).eps * extent


def stopping_plane(
    point: Numbers, normal: Numbers, margin: float, start: float, end: float, kind: str = "sticky"
) -> Plane:
    """Acts on the nodes behind a plane, except those within a margin [m] behind it."""
    size = math.sqrt(sum(n * n for n in normal))
    if not 0 < size < math.inf:
        raise ValueError(f"normal must have a positive length, got {list(normal)}")
    position = [float(p) - margin * n / size for p, n in zip(point, normal, strict=True)]
    return Plane(position, [n / size for n in normal], kind, start=start, end=end)


def moving_cuboid(
    point: Numbers,
    half: Numbers,
    velocity: Numbers,
    margin: float,
    start: float,
    end: float,
) -> Obstacle:
    """Sets its velocity on the nodes inside, and moves with it from `start` on; nodes within a margin [m] of its faces
    are outside.
    """
    size = [2 * (float(h) - margin) for h in half]
    if min(size) <= 0:
        raise ValueError(f"size must be more than {margin:.3g} m on every axis, got {list(half)}")
    moving = velocity if isinstance(velocity, Tensor) or any(velocity) else None
    return Box(list(point), size, "sticky", velocity=moving, start=start, end=end)


def outer_planes(lower: float, upper: float, dim: int, start: float, end: float) -> list[Obstacle]:
    """Stop nodes at or beyond the faces of a cube from moving out, one axis after another."""
    planes: list[Obstacle] = []
    for axis in range(dim):
        normal = [float(k == axis) for k in range(dim)]
        low = [lower if k == axis else 0.0 for k in range(dim)]
        high = [upper if k == axis else 0.0 for k in range(dim)]
        planes.append(Plane(low, normal, "separate", start=start, end=end))
        planes.append(Plane(high, [-n for n in normal], "separate", start=start, end=end))
    return planes


class NodeDamping(TensorModule):
    """Multiplies the velocity of all nodes in every step by a number, or a tensor [] that may require grad, up to 1."""

    reads_time = False

    def __init__(self, scale: float | Tensor) -> None:
        self.scale = scale

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        scale = self.scale.clamp(max=1) if isinstance(self.scale, Tensor) else min(self.scale, 1.0)
        return scale * velocity


class FreezeOutside(nn.Module):
    """Stops all nodes before `start`, and for some steps from `end` on."""

    def __init__(self, start: float, end: float, steps: int) -> None:
        super().__init__()
        self.start, self.end, self.steps = float(start), float(end), steps

    def acts_within(self, first: float, last: float, dt: float) -> bool:
        """Whether it is active at a time from `first` to `last`."""
        return first < self.start or (last >= self.end and first < self.end + self.steps * dt)

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        stopped = (time < self.start) | ((time >= self.end) & (time < self.end + self.steps * dt))
        if isinstance(stopped, Tensor):  # Of a step in a graph.
            return torch.where(stopped, 0, velocity)
        return torch.zeros_like(velocity) if stopped else velocity
