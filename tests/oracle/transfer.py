"""P2G, G2P and their building blocks in plain torch, on the same node rows as the ops."""

from __future__ import annotations

import dataclasses
import itertools
import math

import torch
from torch import Tensor

from torch_mpm.grid.topology import BLOCK_WIDTH, PADDING, Topology


def bspline(distance: Tensor, order: int) -> Tensor:
    """Centred B-spline of the distance from a node, in cells, by the recursion of Cox and de Boor (de Boor 1972)."""
    if order == 0:
        return ((distance > -0.5) & (distance <= 0.5)).to(distance)
    half = (order + 1) / 2
    left, right = bspline(distance + 0.5, order - 1), bspline(distance - 0.5, order - 1)
    return ((distance + half) * left + (half - distance) * right) / order


def bspline_derivative(distance: Tensor, order: int) -> Tensor:
    return bspline(distance + 0.5, order - 1) - bspline(distance - 0.5, order - 1)


@dataclasses.dataclass
class Support:
    """The S = (order + 1)^D nodes of each particle: rows of a node tensor and weights [P, S], x_i - x_p [P, S, D]."""

    rows: Tensor
    weight: Tensor
    distance: Tensor
    weight_gradient: Tensor  # [P, S, D]


def support(blocks: Topology, x: Tensor) -> Support:
    """Found by a search over all nodes of each axis; weights are zero for particles without their whole support."""
    grid = blocks.grid
    lower = torch.tensor(grid.lower, dtype=x.dtype, device=x.device)
    cells = torch.where(x.isfinite().all(1, keepdim=True), (x - lower) / grid.dx + PADDING, -10)
    extent = [BLOCK_WIDTH * n for n in grid.blocks]
    half, count = (grid.order + 1) / 2, grid.order + 1
    nodes, near = [], torch.ones(x.shape[0], dtype=torch.bool, device=x.device)
    for axis, size in enumerate(extent):
        index = torch.arange(size, device=x.device)
        distance = index - cells.detach()[:, axis : axis + 1]
        within = (distance > -half) & (distance <= half)
        near = near & (within.sum(1) == count)
        nodes.append(torch.where(within, index, size).sort(1).values[:, :count].clamp_max(size - 1))
    choices = itertools.product(range(count), repeat=grid.dim)
    node = torch.stack([torch.stack([nodes[a][:, k] for a, k in enumerate(choice)], 1) for choice in choices], 1)
    scene = torch.zeros_like(node[:, 0, 0]) if blocks.scene is None else blocks.scene.long()
    near = near & (scene >= 0) & (scene < blocks.scenes)
    where = scene.clamp(0, max(blocks.scenes - 1, 0))[:, None], *node.unbind(-1)
    rows = _row_map(blocks)[where]
    inside = (near[:, None] & (rows >= 0)).all(1)
    r = torch.where(inside[:, None, None], node - cells[:, None], 0.25)  # in cells
    n, slopes = bspline(r, grid.order), bspline_derivative(r, grid.order)
    weight = torch.where(inside[:, None], n.prod(-1), 0)
    # r is node minus particle, so the gradient with respect to the particle changes sign
    gradient = torch.stack(
        [-slopes[..., a] * torch.cat([n[..., :a], n[..., a + 1 :]], -1).prod(-1) / grid.dx for a in range(grid.dim)], -1
    )
    rows = torch.where(inside[:, None], rows, 0)
    return Support(rows, weight, r * grid.dx, torch.where(inside[:, None, None], gradient, 0))


def _row_map(blocks: Topology) -> Tensor:
    """The row of every node of the lattice of every scene, int64 [B, X, Y, (Z)], -1 where there is none."""
    rows = torch.nonzero(blocks.active_nodes())[:, 0]
    where = blocks.node_scene().long()[rows], *blocks.node_indices()[rows].unbind(1)
    shape = blocks.scenes, *(BLOCK_WIDTH * n for n in blocks.grid.blocks)
    return torch.full(shape, -1, device=rows.device).index_put(where, rows)


def scatter(
    blocks: Topology, x: Tensor, value: Tensor, moment: Tensor | None, gradient: Tensor | None, moment_scale: float
) -> Tensor:
    """nodes_i = Σ_p N_i (value_p + scale moment_p (x_i − x_p)) + gradient_p ∇N_i; see `torch_mpm.ops.scatter`."""
    s = support(blocks, x)
    given = s.weight[..., None] * value[:, None]
    if moment is not None:
        given = given + moment_scale * torch.einsum("ps,pkd,psd->psk", s.weight, moment, s.distance)
    if gradient is not None:
        given = given + torch.einsum("pkd,psd->psk", gradient, s.weight_gradient)
    nodes = value.new_zeros(blocks.node_count, value.shape[1])
    return nodes.index_add(0, s.rows.reshape(-1), given.reshape(-1, value.shape[1]))


def gather(blocks: Topology, x: Tensor, nodes: Tensor, moment_scale: float) -> tuple[Tensor, Tensor, Tensor]:
    """The adjoint of `scatter`: value, moment, gradient; see `torch_mpm.ops.gather`."""
    s = support(blocks, x)
    g = nodes[s.rows]
    value = torch.einsum("ps,psk->pk", s.weight, g)
    moment = moment_scale * torch.einsum("ps,psk,psd->pkd", s.weight, g, s.distance)
    return value, moment, torch.einsum("psd,psk->pkd", s.weight_gradient, g)


def position_gradient(
    blocks: Topology,
    x: Tensor,
    value: Tensor,
    moment: Tensor | None,
    gradient: Tensor | None,
    nodes: Tensor,
    moment_scale: float,
) -> Tensor:
    """∂Φ/∂x of Φ = Σ_i nodes_i · scatter(…)_i, by autograd; see `torch_mpm.ops.position_gradient`."""
    with torch.enable_grad():
        x = x if x.requires_grad else x.detach().requires_grad_()
        form = (nodes * scatter(blocks, x, value, moment, gradient, moment_scale)).sum()
        return torch.autograd.grad(form, x, create_graph=True)[0]


def p2g(
    blocks: Topology,
    x: Tensor,
    mass: Tensor,
    v: Tensor,
    C: Tensor | None = None,
    stress: Tensor | None = None,
    volume: Tensor | None = None,
    dt: Tensor | float = 0.0,
    stress_form: str = "mls",
) -> Tensor:
    """Mass and momentum of the nodes; `dt` is a number or one value per particle. See `torch_mpm.ops.p2g`."""
    dim = x.shape[1]
    value = torch.cat([mass[:, None], mass[:, None] * v], 1)
    moment = x.new_zeros(*value.shape, dim) if C is not None or stress is not None else None
    gradient = None
    if C is not None:
        moment = torch.nn.functional.pad(mass[:, None, None] * C, (0, 0, 1, 0))
    if stress is not None:
        assert volume is not None and moment is not None
        impulse = torch.nn.functional.pad((-dt * volume)[:, None, None] * stress, (0, 0, 1, 0))
        if stress_form == "mls":
            moment = moment + blocks.grid.inverse_inertia * impulse
        else:
            gradient = impulse
    return scatter(blocks, x, value, moment, gradient, 1.0)


def g2p(blocks: Topology, x: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """v, C = D⁻¹ Σ N_i v_i (x_i − x_p)ᵀ and ∇v of each particle; see `torch_mpm.ops.g2p`."""
    lost = torch.where(x.isfinite().all(1), 0.0, torch.nan)
    v, C, gradient = gather(blocks, x, velocity, blocks.grid.inverse_inertia)
    return v + lost[:, None], C + lost[:, None, None], gradient + lost[:, None, None]


def dense_blocks(blocks: Topology) -> Topology:
    """The same lattice with every block active: an activation-independent topology for checks."""
    grid = blocks.grid
    count = blocks.scenes * math.prod(grid.blocks)
    table = torch.arange(count, dtype=torch.int32, device=blocks.table.device)
    return dataclasses.replace(blocks, table=table, block=table)
