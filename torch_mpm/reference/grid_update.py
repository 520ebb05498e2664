"""The grid update in plain torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .contact import contact_change

if TYPE_CHECKING:
    from ..boundaries import Face
    from ..grid import Blocks


def grid_update(
    blocks: Blocks,
    nodes: Tensor,
    gravity: Tensor | None = None,
    dt: float | Tensor | None = None,
    faces: Sequence[Face] = (),
) -> Tensor:
    """Node mass and velocity [N, 1 + D] from mass and momentum; see `torch_mpm.ops.grid_update` and `Walls.faces`."""
    active = blocks.active_nodes()[:, None]
    mass, momentum = torch.where(active, nodes, 0).split([1, nodes.shape[1] - 1], 1)
    heavy = mass != 0
    velocity = torch.where(heavy, momentum, 0) / torch.where(heavy, mass, 1)
    if gravity is not None and dt is not None:
        change = gravity * (dt[:, None] if isinstance(dt, Tensor) and dt.dim() == 1 else dt)
        scene = blocks.node_scene().clamp_min(0)
        velocity = velocity + (change if change.dim() == 1 else change[scene])
    velocity = _act(faces, blocks, velocity)
    return torch.cat([mass, torch.where(heavy, velocity, 0)], 1)


def _act(faces: Sequence[Face], blocks: Blocks, velocity: Tensor) -> Tensor:
    position = blocks.node_positions(torch.float64)
    axes = torch.eye(velocity.shape[1], dtype=velocity.dtype, device=velocity.device)
    for number, face in enumerate(faces):
        if face.kind == "open":
            continue
        axis, sign = number // 2, 1 - 2 * (number % 2)
        beyond = sign * (position[:, axis : axis + 1] - face.plane) <= 1e-6 * blocks.grid.dx
        touching = torch.where(beyond, velocity, 0)
        velocity = velocity + contact_change(touching, sign * axes[axis], face.kind, face.friction)
    return velocity
