"""Paths through given points, for obstacles that follow a controller or a table."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..errors import check_numbers, shape_of
from ..laws.parameters import check_knots, store


class Waypoints(nn.Module):
    """A piecewise linear path through points at given times, at rest before the first and after the last.

        path = torch.nn.Parameter(points)  # [K, D]
        hand = torch_mpm.Sphere(torch_mpm.Waypoints(times, path), radius=0.1)

    Args:
        time: K increasing numbers [s], two or more; or a tensor [K].
        position: the points [m], a tensor [K, D] that may require grad, or K lists of D numbers.

    Raises:
        ValueError: for times that do not increase, numbers that are not finite, or different lengths.
    """

    time: Tensor
    position: Tensor

    def __init__(self, time: Sequence[float] | Tensor, position: Sequence[Sequence[float]] | Tensor) -> None:
        super().__init__()
        if not isinstance(time, Tensor):
            time = torch.tensor(check_numbers("time", time), dtype=torch.float64, device="cpu")
        if not isinstance(position, (Tensor, list, tuple)) and not hasattr(position, "__array__"):
            raise TypeError(f"position must be a tensor [K, D] or K lists of D numbers, got {shape_of(position)}")
        if not isinstance(position, Tensor):
            rows = [check_numbers(f"position[{k}]", row) for k, row in enumerate(position)]
            if len({len(row) for row in rows}) > 1:
                raise ValueError(f"position must have D numbers for each time, got {[len(row) for row in rows]}")
            position = torch.tensor(rows, dtype=torch.float64, device="cpu")
        if time.dim() != 1 or len(time) < 2 or position.dim() != 2 or len(position) != len(time):
            raise ValueError(
                "time and position must have shapes [K] and [K, D], K at least 2, "
                f"got {shape_of(time)} and {shape_of(position)}"
            )
        if not position.is_floating_point():
            raise TypeError(f"position must be a floating tensor, got {position.dtype}")
        if time.is_meta or position.is_meta:
            raise ValueError("time and position must have values, got tensors on the device meta")
        check_knots("time", time, "position", position)
        self.register_buffer("time", time)
        store(self, "position", position)

    def forward(self, time: Tensor) -> Tensor:
        """The position at times [] or [B], [D] or [B, D]."""
        knots, points = self.time.to(time), self.position.to(time.device)
        now = time[..., None]  # an index of one entry, which can be mapped
        left = ((now.detach()[..., None] >= knots).sum(-1) - 1).clamp(0, len(knots) - 2)
        begin, end = knots[left], knots[left + 1]
        share = torch.where((now >= begin) & (now < end), (now - begin) / (end - begin), (now >= end).to(now.dtype))
        return torch.lerp(points[left], points[left + 1], share[..., None].to(points.dtype)).squeeze(-2)
