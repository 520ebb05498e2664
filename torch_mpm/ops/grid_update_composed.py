"""Grid update made of torch operations, for its second derivatives."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..boundaries.contact import contact_change
from ..grid.topology import PADDING, Topology

if TYPE_CHECKING:
    from ..boundaries import Face

See = Callable[[int, Tensor], None]
MIRROR_REACH = 2
"""Nodes on both sides of a mirror that have images (csrc/grid/grid_update.h)."""


def composed_grid_update(
    blocks: Topology,
    nodes: Tensor,
    gravity: Tensor | None = None,
    dt: float | Tensor | None = None,
    faces: Sequence[Face] = (),
    see: See | None = None,
) -> Tensor:
    """Node mass and velocity [N, 1 + D] from mass and momentum; see `grid_update` and `Walls.faces`.

    `see(face, momentum)` is called with the impulse of each node on a face [N, D] [N s], possibly several times.
    """
    active = blocks.active_nodes()[:, None]
    mass, momentum = torch.where(active, nodes, 0).split([1, nodes.shape[1] - 1], 1)
    if gravity is not None and dt is not None:
        change = gravity * (dt[:, None] if isinstance(dt, Tensor) and dt.dim() == 1 else dt)
        scene = blocks.node_scene().clamp_min(0)
        momentum = momentum + mass * (change if change.dim() == 1 else change[scene])
    own = momentum
    summed, momentum = _mirror(faces, blocks, torch.cat([mass, own], 1)).split([1, nodes.shape[1] - 1], 1)
    heavy = summed != 0
    velocity = torch.where(heavy, momentum, 0) / torch.where(heavy, summed, 1)
    if see is not None:
        _see_mirrors(faces, blocks, torch.where(heavy, own - mass * velocity, 0), see)
    velocity = _act(faces, blocks, velocity, mass, see)
    return torch.cat([mass, torch.where(heavy, velocity, 0)], 1)


def _mirror(faces: Sequence[Face], blocks: Topology, rows: Tensor) -> Tensor:
    """Rows of mass and momentum plus those of the images in all mirrors and corners of mirrors."""
    result = rows
    for axes, image in images(faces, blocks):
        sign = torch.ones_like(rows[:1])
        sign[:, [1 + axis for axis in axes]] = -1
        result = result + torch.where(image[:, None] >= 0, sign * rows[image.clamp_min(0)], 0)
    return result


def images(faces: Sequence[Face], blocks: Topology) -> Iterator[tuple[tuple[int, ...], Tensor]]:
    """Row of each node's image, int64 [N], -1 for none, for each set of axes that mirrors reflect."""
    node, scene = blocks.node_indices(), blocks.node_scene().clamp_min(0)
    distance, near = torch.zeros_like(node), torch.zeros_like(node, dtype=torch.bool)
    mirrored = []
    for number, face in enumerate(faces):
        if face.kind != "mirror":
            continue
        axis = number // 2
        cells = _half_cells(blocks, node, axis, face.plane)
        has = blocks.active_nodes() & (cells.abs() <= 2 * MIRROR_REACH)
        distance[:, axis] = torch.where(has, cells, distance[:, axis])
        near[:, axis] |= has
        mirrored += [axis] if axis not in mirrored else []
    for count in range(1, len(mirrored) + 1):
        for axes in itertools.combinations(mirrored, count):
            reflected = node.clone()
            reflected[:, axes] -= distance[:, axes]
            row = blocks.rows_at(reflected, scene)
            yield axes, torch.where(near[:, axes].all(1), row, -1)


def _half_cells(blocks: Topology, node: Tensor, axis: int, plane: float) -> Tensor:
    """Twice the distance of lattice nodes from a mirror, in cells."""
    return 2 * node[:, axis] - round(2 * ((plane - blocks.grid.lower[axis]) / blocks.grid.dx + PADDING))


def _see_mirrors(faces: Sequence[Face], blocks: Topology, momentum: Tensor, see: See) -> None:
    """Each component is assigned to the mirror along its axis, or else to the first mirror in which the node has an
    image.
    """
    node = blocks.node_indices()
    near = {
        number: blocks.active_nodes() & (_half_cells(blocks, node, number // 2, face.plane).abs() <= 2 * MIRROR_REACH)
        for number, face in enumerate(faces)
        if face.kind == "mirror"
    }
    for axis, unit in enumerate(torch.eye(momentum.shape[1], dtype=torch.bool, device=momentum.device)):
        free = torch.ones_like(node[:, 0], dtype=torch.bool)
        for number in [n for n in near if n // 2 == axis] + [n for n in near if n // 2 != axis]:
            see(number, torch.where((near[number] & free)[:, None] & unit, momentum, 0))
            free = free & ~near[number]


def _act(faces: Sequence[Face], blocks: Topology, velocity: Tensor, mass: Tensor, see: See | None) -> Tensor:
    position = blocks.node_positions(torch.float64)
    axes = torch.eye(velocity.shape[1], dtype=velocity.dtype, device=velocity.device)
    for number, face in enumerate(faces):
        if face.kind in ("open", "mirror"):
            continue
        axis, sign = number // 2, 1 - 2 * (number % 2)
        beyond = sign * (position[:, axis : axis + 1] - face.plane) <= 1e-6 * blocks.grid.dx
        touching = torch.where(beyond, velocity, 0)
        change = contact_change(touching, sign * axes[axis], face.kind, face.friction)
        if see is not None:
            see(number, -mass * change)
        velocity = velocity + change
    return velocity
