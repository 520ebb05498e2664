"""Impulses on walls and obstacles, from the momentum that the nodes have before and after each of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_mpm.boundaries.solid import SolidNodes, after_contact

from .grid_update import grid_update

if TYPE_CHECKING:
    from torch_mpm.boundaries import Face
    from torch_mpm.grid.topology import Topology


def moments(blocks: Topology, momentum: Tensor) -> Tensor:
    """Sum of node momenta [N, D] and of their moments about the origin over the nodes of each scene."""
    rows = []
    positions, scenes = blocks.node_positions(torch.float64), blocks.node_scene()
    for b in range(blocks.scenes):
        x, p = positions[scenes == b], momentum[scenes == b].double()
        turns = [x[:, i] @ p[:, j] - x[:, j] @ p[:, i] for i, j in _planes(x.shape[1])]
        rows.append(torch.cat([p.sum(0), torch.stack(turns)]))
    return torch.stack(rows)


def _planes(dim: int) -> list[tuple[int, int]]:
    return [(0, 1)] if dim == 2 else [(1, 2), (2, 0), (0, 1)]


def wall_impulses(
    blocks: Topology, nodes: Tensor, gravity: Tensor | None, dt: float | Tensor | None, faces: Sequence[Face]
) -> Tensor:
    """[B, 2 D, D + 1 or 3] without mirrors: momentum lost by nodes when one more face closes."""

    def momentum(count: int) -> Tensor:
        closed = [*faces[:count], *(face._replace(kind="open", friction=0.0) for face in faces[count:])]
        rows = grid_update(blocks, nodes, gravity, dt, closed)
        return rows[:, :1] * rows[:, 1:]

    return torch.stack([moments(blocks, momentum(k) - momentum(k + 1)) for k in range(len(faces))], 1)


def contact_impulses(
    blocks: Topology, velocity: Tensor, mass: Tensor, obstacles: Sequence[Any], time: float | Tensor
) -> Tensor:
    """[B, K, D + 1 or 3], from the changes of velocity by each obstacle of the solid."""
    positions = blocks.node_positions(velocity.dtype)
    scene = blocks.node_scene() if blocks.scenes > 1 else None
    acts = [blocks.active_nodes()] * len(obstacles)
    _, changes = after_contact(velocity, SolidNodes(obstacles, acts, positions, scene, time, blocks.grid.dx))
    return torch.stack([moments(blocks, -mass[:, None] * change) for change in changes], 1)
