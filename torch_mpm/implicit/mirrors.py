"""Mirrors in the solve: velocities that are symmetric about the planes of mirrors.

A mirror represents the body together with its image. The velocities of a node and of its images are the same up to
reflection, and the energy of an implicit step is a function of symmetric velocities only. Gradients, products of the
Hessian and node blocks are those of all nodes, projected onto symmetric ones.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from ..boundaries import Walls
from ..grid.grid import Blocks
from ..ops.grid_update_composed import images


@dataclasses.dataclass
class Mirrors:
    """Nodes that are images of one another.

    Attributes:
        groups: int32 [G, 2^D]: entry k is the row of the node that the axes of the bits of k reflect, -1 for none. A
            node on the plane of a mirror is its own image.
    """

    groups: Tensor

    def symmetric(self, values: Tensor) -> Tensor:
        """Vectors [N, D] or matrices [N, D, D] of nodes, projected onto symmetric ones; differentiable."""
        rows, present, own = self._members()
        sign = self._signs(values.shape[1]).to(values)
        if values.dim() == 3:
            sign = sign[:, :, None] * sign[:, None, :]
        share = present.to(values.dtype).reshape(*present.shape, *[1] * (values.dim() - 1))
        mean = (share * sign * values[rows]).sum(1, keepdim=True) / share.sum(1, keepdim=True)
        parts = share * sign * mean / own.reshape(share.shape)
        rest = values.index_fill(0, rows.flatten(), 0)
        return rest.index_add(0, rows.flatten(), parts.flatten(0, 1))

    def gathered(self, mass: Tensor, chosen: Tensor) -> Tensor:
        """Masses of nodes [N], those of each group shared evenly among its chosen ones, bool [N]; differentiable."""
        rows, present, own = self._members()
        share = (present / own).to(mass.dtype)
        kept = share * chosen[rows]
        count = kept.sum(1, keepdim=True)
        each = (share * mass[rows]).sum(1, keepdim=True) / torch.where(count > 0, count, 1)
        return _replaced(mass, rows, kept > 0, each / own)

    def followed(self, v: Tensor, chosen: Tensor) -> Tensor:
        """Velocities of nodes [N, D]; the others of each group get those of its chosen ones, bool [N], which are
        symmetric already; differentiable.
        """
        rows, present, own = self._members()
        kept = (present & chosen[rows]).to(v.dtype)[:, :, None] / own[:, :, None]
        sign, count = self._signs(v.shape[1]).to(v), kept.sum(1, keepdim=True)
        mean = (kept * sign * v[rows]).sum(1, keepdim=True) / torch.where(count > 0, count, 1)
        return _replaced(v, rows, present & ((kept == 0) & (count > 0))[:, :, 0], sign * mean / own[:, :, None])

    def _members(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of the nodes of each group int64 [G, 2^D], which of them exist, and multiplicities of rows."""
        present = self.groups >= 0
        rows = torch.where(present, self.groups, self.groups[:, :1]).long()
        own = (rows[:, :, None] == rows[:, None, :]).logical_and_(present[:, None, :]).sum(-1)
        return rows, present, own

    def has(self, nodes: int) -> Tensor:
        """Whether each of n nodes has an image, bool [N]."""
        result = torch.zeros(nodes, dtype=torch.bool, device=self.groups.device)
        return result.index_fill_(0, self.groups.flatten().clamp_min(0).long(), True) if len(self.groups) else result

    def _signs(self, dim: int) -> Tensor:
        k = torch.arange(1 << dim, device=self.groups.device)
        return 1 - 2 * ((k[:, None] >> torch.arange(dim, device=k.device)) & 1)


def _replaced(values: Tensor, rows: Tensor, where: Tensor, parts: Tensor) -> Tensor:
    """Node tensor [N, ...] with the sums of parts [G, n, ...] in the rows [G, n] of entries, bool [G, n]."""
    return values.index_fill(0, rows[where], 0).index_add(0, rows[where], parts[where])


def mirrors_of(blocks: Blocks, walls: Walls | None, mass: Tensor) -> Mirrors | None:
    """Mirrors of walls, for nodes with masses [N]; None without any."""
    if walls is None:
        return None
    own = torch.arange(len(mass), device=mass.device)
    groups = own.new_full((len(mass), 1 << blocks.grid.dim), -1)
    groups[:, 0] = own
    for axes, rows in images(walls.faces(blocks.grid), blocks):
        groups[:, sum(1 << axis for axis in axes)] = rows
    present = (groups >= 0) & (mass[groups.clamp_min(0)] > 0)
    groups = torch.where(present, groups, -1)
    first = torch.where(present, groups, len(mass)).amin(1) == own
    return Mirrors(groups[first & present[:, 0] & (present.sum(1) > 1)].to(torch.int32))
