"""P2G, G2P and their building blocks in plain torch, on the same node rows as the ops."""

from __future__ import annotations

import dataclasses
import itertools
import math

import torch
from torch import Tensor

from ..topology import BLOCK_WIDTH, PADDING, Topology


def bspline(distance: Tensor, order: int) -> Tensor:
    """Quadratic or cubic B-spline of the distance from a node, in cells (Steffen, Kirby and Berzins 2008)."""
    a = distance.abs()
    if order == 2:
        return torch.where(a < 0.5, 0.75 - a * a, torch.where(a < 1.5, 0.5 * (1.5 - a) ** 2, 0))
    return torch.where(a < 1, 2 / 3 - a * a * (1 - a / 2), torch.where(a < 2, (2 - a) ** 3 / 6, 0))


@dataclasses.dataclass
class Support:
    """The S = (order + 1)^D nodes of each particle: rows of a node tensor and weights [P, S], x_i - x_p [P, S, D]."""

    rows: Tensor
    weight: Tensor
    distance: Tensor
    weight_gradient: Tensor  # [P, S, D]


def support(blocks: Topology, x: Tensor) -> Support:
    """Weights are zero for particles whose support is not inside the active blocks."""
    grid = blocks.grid
    lower = torch.tensor(grid.lower, dtype=x.dtype, device=x.device)
    cells = (x - lower) / grid.dx + PADDING
    finite = torch.isfinite(cells).all(1)
    cells = torch.where(finite[:, None], cells, torch.full_like(cells, -10.0))
    base = torch.floor(cells.detach() - (0.5 if grid.order == 2 else 1.0)).clamp(-10, 2**30).long()
    offsets = torch.tensor(list(itertools.product(range(grid.order + 1), repeat=grid.dim)), device=x.device)
    node = base[:, None] + offsets
    extent = torch.tensor(grid.blocks, device=x.device) * BLOCK_WIDTH
    inside = ((node >= 0) & (node < extent)).all(-1).all(-1) & finite
    node = torch.where(inside[:, None, None], node, 0)
    block = node // BLOCK_WIDTH
    index = (
        torch.zeros_like(node[..., 0]) if blocks.scene is None else blocks.scene.long()[:, None].expand(node.shape[:2])
    )
    local = torch.zeros_like(index)
    for axis in range(grid.dim):
        index = index * grid.blocks[axis] + block[..., axis]
        local = local * BLOCK_WIDTH + node[..., axis] % BLOCK_WIDTH
    slot = blocks.table.long()[index]
    inside = inside & (slot >= 0).all(1)
    rows = torch.where(inside[:, None], slot * grid.nodes_per_block + local, 0)
    r = torch.where(inside[:, None, None], node - cells[:, None], 0.25)  # in cells
    n = bspline(r, grid.order)
    slopes = _bspline_derivative(r, grid.order)
    weight = torch.where(inside[:, None], n.prod(-1), 0)
    # r is node minus particle, so the gradient with respect to the particle changes sign
    gradient = torch.stack(
        [-slopes[..., a] * torch.cat([n[..., :a], n[..., a + 1 :]], -1).prod(-1) / grid.dx for a in range(grid.dim)], -1
    )
    return Support(rows, weight, r * grid.dx, torch.where(inside[:, None, None], gradient, 0))


def _bspline_derivative(r: Tensor, order: int) -> Tensor:
    a = r.abs()
    if order == 2:
        return torch.where(a < 0.5, -2 * r, torch.where(a < 1.5, r - 1.5 * torch.sign(r), 0))
    return torch.where(a < 1, r * (1.5 * a - 2), torch.where(a < 2, -0.5 * torch.sign(r) * (2 - a) ** 2, 0))


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
