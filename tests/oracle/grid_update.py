"""Grid update on full lattices, one for each scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_mpm.grid.topology import BLOCK_WIDTH, PADDING

from .contact import contact_velocity

if TYPE_CHECKING:
    from torch_mpm.boundaries import Face
    from torch_mpm.grid.topology import Topology

MIRROR_REACH = 2
"""Nodes on both sides of a mirror that have images (csrc/grid/grid_update.h)."""


def grid_update(
    blocks: Topology,
    nodes: Tensor,
    gravity: Tensor | None = None,
    dt: float | Tensor | None = None,
    faces: Sequence[Face] = (),
) -> Tensor:
    """Node mass and velocity [N, 1 + D] from mass and momentum; see `torch_mpm.ops.grid_update` and `Walls.faces`."""
    rows = blocks.active_nodes().nonzero()[:, 0]
    dim, scene = nodes.shape[1] - 1, blocks.node_scene()[rows].long()
    at = (scene, *blocks.node_indices()[rows].long().unbind(1))
    mass, momentum = nodes[rows].split([1, dim], 1)
    if gravity is not None and dt is not None:
        t = dt.to(gravity) if isinstance(dt, Tensor) else gravity.new_tensor(dt)
        change = gravity.expand(blocks.scenes, dim) * t.expand(blocks.scenes)[:, None]
        momentum = momentum + mass * change[scene]
    extent = [count * BLOCK_WIDTH for count in blocks.grid.blocks]
    lattice = nodes.new_zeros(blocks.scenes, *extent, 1 + dim).index_put(at, torch.cat([mass, momentum], 1))
    for number, face in enumerate(faces):
        if face.kind == "mirror":
            middle = 2 * ((face.plane - blocks.grid.lower[number // 2]) / blocks.grid.dx + PADDING)
            lattice = lattice + _image(lattice, number // 2, round(middle))
    summed, momentum = lattice[at].split([1, dim], 1)
    heavy = summed[:, 0] != 0
    velocity = momentum[heavy] / summed[heavy]
    position = blocks.grid.dx * (blocks.node_indices()[rows][heavy].double() - PADDING)
    position = position + torch.tensor(blocks.grid.lower, dtype=torch.float64, device=nodes.device)
    for number, face in enumerate(faces):
        velocity = _act(face, number, position, velocity, blocks.grid.dx)
    result = torch.zeros_like(nodes).index_put((rows[heavy],), torch.cat([mass[heavy], velocity], 1))
    return result.index_put((rows[~heavy],), torch.cat([mass[~heavy], torch.zeros_like(momentum[~heavy])], 1))


def _image(lattice: Tensor, axis: int, twice: int) -> Tensor:
    """Image of a mirror at node twice/2 of an axis: [B, ..., 1 + D]."""
    count = lattice.shape[1 + axis]
    node = torch.arange(count, device=lattice.device)
    there = twice - node
    seen = ((node - there).abs() <= 2 * MIRROR_REACH) & (there >= 0) & (there < count)
    image = lattice.index_select(1 + axis, there.clamp(0, count - 1))
    sign = lattice.new_ones(lattice.shape[-1])
    sign[1 + axis] = -1
    column = seen.reshape([-1 if a == axis else 1 for a in range(lattice.dim() - 2)] + [1])
    return torch.where(column, sign * image, 0)


def _act(face: Face, number: int, position: Tensor, velocity: Tensor, dx: float) -> Tensor:
    """Velocities after one face."""
    if face.kind in ("open", "mirror"):
        return velocity
    axis, sign = number // 2, 1 - 2 * (number % 2)
    (beyond,) = (sign * (position[:, axis] - face.plane) <= 1e-6 * dx).nonzero(as_tuple=True)
    normal = torch.zeros_like(velocity[beyond])
    normal[:, axis] = sign
    return velocity.index_put((beyond,), contact_velocity(velocity[beyond], normal, face.kind, face.friction))
