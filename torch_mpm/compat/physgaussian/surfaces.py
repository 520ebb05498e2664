"""The surface "cut" of PhysGaussian's simulator."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..gradients import Numbers
from ..node_conditions import stopping_plane

LOW, HIGH = 0.4, 0.53
"""Heights [m] between which a cut lets nodes move."""
KEPT = 0.3


class Cut(nn.Module):
    """Stops the nodes behind a plane, except those between two heights z, which retain 0.3 of v_x and v_z."""

    def __init__(self, point: Numbers, normal: Numbers, margin: float, start: float, end: float) -> None:
        super().__init__()
        self.start, self.end = float(start), float(end)
        self.plane = stopping_plane(point, normal, margin, start, end)

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        behind = (self.plane.signed_distance(positions, scene, time) < 0)[:, None]
        height = positions[:, 2:3]
        between = (height >= LOW) & (height <= HIGH)
        x, y, z = (KEPT * velocity).unbind(1)
        kept = torch.stack([x, torch.zeros_like(y), z], 1)
        return torch.where(behind, torch.where(between, kept, 0), velocity)
