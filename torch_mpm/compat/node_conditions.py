"""Conditions on grid nodes in the conventions of other simulators, as boundaries of a `Step`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ..boundaries import Box, Obstacle, Plane
from ..errors import shape_of
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


def outer_planes(dx: float, cells: Sequence[int], padding: int, start: float, end: float) -> list[Obstacle]:
    """Stop nodes within `padding` nodes of the faces of a box from moving out, one axis after another."""
    planes: list[Obstacle] = []
    for axis, n in enumerate(cells):
        normal = [float(k == axis) for k in range(len(cells))]
        low, high = ([at * dx * one for one in normal] for at in (padding - 1, n - padding))
        planes.append(Plane(low, normal, "separate", start=start, end=end))
        planes.append(Plane(high, [-one for one in normal], "separate", start=start, end=end))
    return planes


class FreezeOutside(nn.Module):
    """Stops all nodes before `start`, and for some steps from `end` on."""

    def __init__(self, start: float, end: float, steps: int) -> None:
        super().__init__()
        self.start, self.end, self.steps = float(start), float(end), steps

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        stopped = (time < self.start) | ((time >= self.end) & (time < self.end + self.steps * dt))
        if isinstance(stopped, Tensor):  # Of a step in a graph.
            return torch.where(stopped, 0, velocity)
        return torch.zeros_like(velocity) if stopped else velocity


class NodeMask(nn.Module):
    """Holds the nodes of a mask at rest.

    Args:
        mask: bool, one entry for each node from the origin on.
        dx: node distance [m].
        cells: cells along each axis, which must be the shape of the mask.

    Raises:
        ValueError: for a mask of another shape.
    """

    mask: Tensor

    def __init__(self, mask: Tensor, dx: float, cells: Sequence[int]) -> None:
        super().__init__()
        if tuple(mask.shape) != tuple(cells):
            raise ValueError(f"selection_mask must have the shape of the grid, {list(cells)}, got {list(mask.shape)}")
        self.register_buffer("mask", mask)
        self.dx, self.cells = dx, tuple(cells)

    @staticmethod
    def checked(mask: Any) -> Tensor:
        """A mask of integers or bool with three axes, as bool.

        Raises:
            TypeError, ValueError: for other arguments.
        """
        if not isinstance(mask, Tensor) or mask.dim() != 3:
            raise ValueError(f"selection_mask must have shape [n, n, n], got {shape_of(mask)}")
        if mask.is_floating_point() or mask.is_complex():
            raise TypeError(f"selection_mask must be integers or bool, got {mask.dtype}")
        return mask >= 1 if mask.dtype != torch.bool else mask.clone()

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        axes = (positions / self.dx).round().long().unbind(1)
        inside, clamped = torch.ones_like(axes[0], dtype=torch.bool), []
        for index, n in zip(axes, self.cells, strict=True):
            inside = inside & (index >= 0) & (index < n)
            clamped.append(index.clamp(0, n - 1))
        held = self.mask[clamped[0], clamped[1], clamped[2]] & inside
        return torch.where(held[:, None], 0, velocity)


class StrictRegion(TensorModule):
    """Sets the velocity of nodes by a comparison in float32, as the other simulators do.

    A node on a face is inside or outside by the rounding of index times dx.

    Args:
        inside: function of nodes − point [N, 3], float32, bool [N].
        point: [m]; it moves with the velocity from `start` on.
        velocity: tensor [3] [m/s] on the device of the particles.
        dx: node distance [m].
        start, end: it acts while start ≤ time < end [s].
    """

    def __init__(
        self, inside: Callable[[Tensor], Tensor], point: Numbers, velocity: Tensor, dx: float, start: float, end: float
    ) -> None:
        super().__init__()
        self.inside, self.velocity, self.dx, self.start, self.end = inside, velocity, dx, float(start), float(end)
        like = {"dtype": torch.float32, "device": velocity.device}
        self.point = torch.tensor([float(p) for p in point], **like)  # type: ignore[arg-type]
        self.spacing = torch.tensor(dx, **like)  # type: ignore[arg-type]

    def forward(
        self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float | Tensor, dt: float
    ) -> Tensor:
        nodes = (positions.detach() / self.dx).round().float() * self.spacing
        given, elapsed = self.velocity.to(velocity.dtype), time - self.start
        elapsed = elapsed.clamp(min=0) if isinstance(elapsed, Tensor) else max(elapsed, 0.0)
        point = self.point + elapsed * given.detach().float()
        acting = self.inside(nodes - point) & (time >= self.start) & (time < self.end)
        return torch.where(acting[:, None], given, velocity)


def strict_plane(point: Numbers, normal: Numbers, dx: float, start: float, end: float, like: Tensor) -> StrictRegion:
    """As `stopping_plane`, compared in float32, on the device of a tensor."""
    size = math.sqrt(sum(float(n) ** 2 for n in normal))
    direction = [float(n) / size for n in normal]

    def behind(offset: Tensor) -> Tensor:
        x, y, z = offset.unbind(1)
        return x * direction[0] + y * direction[1] + z * direction[2] < 0

    return StrictRegion(behind, point, like.new_zeros(3), dx, start, end)


def strict_cuboid(point: Numbers, half: Numbers, velocity: Tensor, dx: float, start: float, end: float) -> StrictRegion:
    """As `moving_cuboid`, compared in float32, on the device of the velocity [3]."""
    sizes = [float(h) for h in half]

    def within(offset: Tensor) -> Tensor:
        x, y, z = offset.abs().unbind(1)
        return (x < sizes[0]) & (y < sizes[1]) & (z < sizes[2])

    return StrictRegion(within, point, velocity, dx, start, end)
