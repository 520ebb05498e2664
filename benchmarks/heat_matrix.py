"""Gradients of the shape functions in the heat matrix H_ij = Σ_p κ_p V_p ∇Φ_i · ∇Φ_j, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.grid.bspline import base_node, bspline
from torch_mpm.grid.topology import PADDING


def node_gradients(blocks: mpm.Blocks, x: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes of each particle and their gradients ∇Φ_i = D⁻¹ N_i (x_i − x_p), Gao et al. 2018 (supplement, eq. 10).

    Args:
        x: positions [P, D] [m], inside the domain; the particles of `blocks`, or some of them where there is one scene.

    Returns:
        rows of node tensors, int64 [P, S], and gradients [P, S, D] [1/m]; the last axis of the lattice varies fastest.
    """
    grid = blocks.grid
    cells = (x - torch.tensor(grid.lower, dtype=x.dtype, device=x.device)) / grid.dx + PADDING
    width = torch.arange(grid.order + 1, device=x.device)
    node = base_node(cells, grid.order)[:, None] + torch.cartesian_prod(*[width] * grid.dim)
    distance = node - cells[:, None]
    weight = bspline(distance, grid.order).prod(-1, keepdim=True)
    return blocks.rows_at(node, blocks.scene), grid.inverse_inertia * grid.dx * weight * distance
