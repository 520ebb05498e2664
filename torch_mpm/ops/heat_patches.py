"""Additive Schwarz on patches of 2^D nodes for the heat operator: Python side of `heat_stencil` and `heat_patches`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..grid.topology import BLOCK_WIDTH, Topology, unravel
from .arguments import refuse_vmap, sizes
from .autograd import register_autograd


class Patches:
    """z = Σ_o R_oᵀ W (R_o A R_oᵀ)⁻¹ W R_o r, o over the cells, R_o their 2^D nodes and W² one over the cells of a node.

    Where only a corner of their supports has particles, splines are nearly linearly dependent: with its diagonal only,
    A has eigenvalues from 3e-4 at the edges of a block in 3-D, with the patches from 1e-2 (De Prenter et al. 2019 for
    elements cut by a boundary).

    Args:
        blocks: active blocks of x.
        x, conductance: particles [P, D] [m] and κ V [P] of A = weight + H.
        weight: [N].
        free: unknown nodes, bool [N]; z is zero on the others.
    """

    def __init__(self, blocks: Topology, x: Tensor, conductance: Tensor, weight: Tensor, free: Tensor) -> None:
        dim, device = blocks.grid.dim, x.device
        local, pair = torch.arange(BLOCK_WIDTH, device=device), torch.arange(2, device=device)

        def corners(sign: int) -> Tensor:
            return lattice_rows(blocks, blocks, lambda b: (BLOCK_WIDTH * b[:, None] + local)[..., None] + sign * pair)

        rows, patches = corners(1), corners(-1)
        inside = torch.nn.functional.pad(free, (0, 1))[rows]
        patches = torch.where(free[:, None] & (patches < len(free)), patches, -1)
        share = torch.where(free, (patches >= 0).sum(1).clamp_min(1).to(x).rsqrt(), 0)
        self.rows, self.patches = torch.where(inside, rows, -1).int(), patches.int()
        # The entry between corners a < b of a patch is that of a and its neighbour at b − a.
        number = torch.arange(2**dim, device=device)
        corner, digits = unravel(number, (2,) * dim), 3 ** torch.arange(dim - 1, -1, -1, device=device)
        first = torch.minimum(number[:, None], number)
        which = ((corner[None] - corner[:, None]) * digits).sum(-1).abs()
        stencil = torch.ops.torch_mpm.heat_stencil(x, conductance, *blocks.packed)
        stencil[0] += weight
        matrix = torch.nn.functional.pad(stencil, (0, 1))[which, rows[:, first]]
        matrix = torch.where(inside[:, :, None] & inside[:, None, :], matrix, 0)
        # More than the rounding of a singular matrix, such as that of an isolated particle.
        rounding = 64 * torch.finfo(x.dtype).eps * matrix.diagonal(dim1=1, dim2=2)
        matrix = matrix + torch.diag_embed(torch.where(inside, rounding, 1))
        share = torch.nn.functional.pad(share, (0, 1))[rows]
        self.inverse = (share[:, :, None] * torch.linalg.inv_ex(matrix)[0] * share[:, None, :]).contiguous()

    def __call__(self, r: Tensor) -> Tensor:
        return torch.ops.torch_mpm.heat_patches(self.inverse, self.rows, self.patches, r)


def lattice_rows(source: Topology, target: Topology, nodes: Callable[[Tensor], Tensor]) -> Tensor:
    """Rows in `target` of the lattice nodes of each block of `source`; one past the last where inactive.

    `nodes` maps the block's coordinate along an axis [S] to node coordinates [S, 4] or [S, 4, K] along it.

    Returns:
        [S, 4^D] or [S 4^D, K^D].
    """
    grid = target.grid
    table, dim = source.block.clamp_min(0).long(), grid.dim
    per_scene = math.prod(source.grid.blocks)
    index = local = inside = torch.empty(0)
    for axis, coordinate in enumerate(unravel(table, source.grid.blocks).unbind(1)):
        node = nodes(coordinate)
        shape = [1] * (1 + dim * (node.dim() - 1))
        shape[0], shape[1 + axis] = node.shape[0], node.shape[1]
        if node.dim() == 3:
            shape[1 + dim + axis] = node.shape[2]
        node = node.reshape(shape)
        block, extent = node // BLOCK_WIDTH, grid.blocks[axis]
        valid = (block >= 0) & (block < extent)
        if axis == 0:
            index = (table // per_scene).reshape([-1] + [1] * (len(shape) - 1))
            local, inside = torch.zeros_like(index), source.block.reshape(index.shape) >= 0
        index = index * extent + block.clamp(0, extent - 1)
        local, inside = local * BLOCK_WIDTH + node % BLOCK_WIDTH, inside & valid
    slot = target.table[index].long()
    rows = torch.where(inside & (slot >= 0), slot * grid.nodes_per_block + local, target.node_count)
    each = grid.nodes_per_block
    return rows.reshape(-1, each) if rows.dim() == 1 + dim else rows.reshape(rows.shape[0] * each, -1)


# ---- fake kernels; neither op has a gradient


@torch.library.register_fake("torch_mpm::heat_stencil")
def _stencil_fake(x: Tensor, conductance: Tensor, *topology: Any) -> Tensor:
    dim = sizes(x, "x", 2)[1]
    return x.new_empty((3**dim + 1) // 2, Topology.unpack(*topology).node_count)


@torch.library.register_fake("torch_mpm::heat_patches")
def _patches_fake(inverse: Tensor, rows: Tensor, patches: Tensor, r: Tensor) -> Tensor:
    return torch.empty_like(r)


def _no_gradient(ctx: Any, grad: Tensor) -> None:
    raise NotImplementedError("heat_stencil and heat_patches are not differentiable")


for _name in ("heat_stencil", "heat_patches"):
    register_autograd(_name, _no_gradient)
    refuse_vmap(_name)
