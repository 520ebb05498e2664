"""Trilinear form of the transfers in plain torch, for third derivatives, which the ops do not have."""

from __future__ import annotations

import torch
from torch import Tensor

from ..grid.bspline import base_node, bspline, bspline_derivative
from ..grid.topology import PADDING, Topology


def trilinear_form(
    blocks: Topology,
    x: Tensor,
    value: Tensor,
    moment: Tensor | None,
    gradient: Tensor | None,
    nodes: Tensor,
    moment_scale: float,
) -> Tensor:
    """Φ = Σ_p Σ_i g_i · [N_i(x_p) (a_p + s B_p (x_i − x_p)) + G_p ∇N_i(x_p)], differentiable to any order.

    Args:
        blocks: active blocks of x.
        x: positions [P, D] [m]; particles that are not transferred contribute nothing.
        value, moment, gradient: a [P, K], B [P, K, D] and G [P, K, D] of the particles; the last two may be None.
        nodes: g [N, K].
        moment_scale: s.
    """
    grid = blocks.grid
    cells = (x - torch.tensor(grid.lower, dtype=x.dtype, device=x.device)) / grid.dx + PADDING
    finite = cells.detach().isfinite().all(1, keepdim=True)
    cells = torch.where(finite, cells, -10)  # Beyond the lattice.
    base = base_node(cells.detach().clamp(-10, 2**30), grid.order)
    steps = torch.arange(grid.order + 1, device=x.device)
    node = base[:, None] + torch.cartesian_prod(*[steps] * grid.dim).reshape(-1, grid.dim)
    rows = blocks.rows_at(node, blocks.particle_scene())
    inside = (rows >= 0).all(1)[:, None]
    r = torch.where(inside[..., None], node - cells[:, None], 0.25)  # In cells.
    weights, slopes = bspline(r, grid.order), bspline_derivative(r, grid.order)
    weight = torch.where(inside, weights.prod(-1), 0)
    g = nodes[rows.clamp_min(0)]
    given = weight[..., None] * value[:, None]
    if moment is not None:
        given = given + moment_scale * grid.dx * torch.einsum("ps,pkd,psd->psk", weight, moment, r)
    if gradient is not None:
        # r is node minus particle: the gradient by the position of the particle has the other sign.
        others = [torch.cat([weights[..., :a], weights[..., a + 1 :]], -1).prod(-1) for a in range(grid.dim)]
        by_position = -slopes / grid.dx * torch.stack(others, -1)
        given = given + torch.einsum("pkd,psd->psk", gradient, torch.where(inside[..., None], by_position, 0))
    return (g * given).sum()


def position_gradient(
    blocks: Topology,
    x: Tensor,
    value: Tensor,
    moment: Tensor | None,
    gradient: Tensor | None,
    nodes: Tensor,
    moment_scale: float,
) -> Tensor:
    """∂Φ/∂x [P, D], the result of the op of this name, differentiable to any order."""
    with torch.enable_grad():
        x = x if x.requires_grad else x.detach().requires_grad_()
        form = trilinear_form(blocks, x, value, moment, gradient, nodes, moment_scale)
        return torch.autograd.grad(form, x, create_graph=True)[0]
