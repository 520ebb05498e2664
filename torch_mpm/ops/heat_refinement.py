"""Heat step of float32 data to float64 accuracy: solves in float32, residuals in float64."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..grid.grid import Blocks

REFINEMENTS = 3
REDUCTION = 1e-4
"""Reduction of the residual by one solve in float32."""


def refine(
    blocks: Blocks,
    x: Tensor,
    conductance: Tensor,
    heat_capacity: Tensor,
    theta: Tensor,
    dt: Tensor,
    source: Tensor | None,
    exchange: Tensor | None,
    fixed: Tensor | None,
    tolerance: Tensor,
    solve: Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor]],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Iterative refinement (Wilkinson 1963), with dt and tolerance per scene [B].

    `solve(r)` returns the increment of a right side in float32. Autograd tracks only the last correction: its right
    side is zero to rounding, but depends on every input as the residual does, so that one adjoint solve remains.

    Returns:
        increment in float64 [N], iterations, residual and converged [B].
    """
    position, conduction = x.double(), conductance.double()
    wide = blocks.grid.activate(position.detach(), blocks.scene)
    scene, scenes = wide.node_scene().long(), blocks.grid.scenes
    node_scene = scene.clamp_min(0)
    steps = torch.where(dt > 0, dt.double(), 1)
    mass, temperature = (_move(t.double(), blocks, wide) for t in (heat_capacity, theta))
    free = (scene >= 0) & ~(mass <= 0)
    if fixed is not None:
        free &= ~_move(fixed, blocks, wide)
    outflow = None if exchange is None else _move(exchange.double(), blocks, wide)
    given = torch.zeros_like(mass) if source is None else _move(source.double(), blocks, wide)

    def residual(d: Tensor) -> Tensor:
        after = temperature + d
        flux = torch.ops.torch_mpm.heat_operator(position, conduction, after, *wide.packed)
        r = given - flux - mass / steps[node_scene] * d
        return torch.where(free, r if outflow is None else r - outflow * after, 0)

    d = torch.zeros_like(mass)
    iterations = torch.zeros(scenes, dtype=torch.int32, device=x.device)
    with torch.no_grad():
        for _ in range(REFINEMENTS):
            correction, count, _, _ = solve(_move(residual(d), wide, blocks).to(x.dtype))
            d = d + _move(correction.double(), blocks, wide)
            iterations = iterations + count
    r = residual(d)
    correction, count, _, _ = solve(_move(r, wide, blocks).to(x.dtype))
    d = d + _move(correction.double(), blocks, wide)
    with torch.no_grad():
        r = residual(d)
        weight = torch.where(free, mass, 1)
        squares = torch.stack([torch.where(free, r * (r / weight), 0), torch.where(free, mass, 0)], 1)
        squares, total = r.new_zeros(scenes, 2).index_add(0, node_scene, squares).unbind(1)
        left = torch.where(dt > 0, steps * (squares / torch.where(total == 0, 1, total)).sqrt(), torch.nan)
    return _move(d, wide, blocks), iterations + count, left.to(x.dtype), left <= tolerance


def _move(nodes: Tensor, source: Blocks, target: Blocks) -> Tensor:
    """Node values [N] on the rows of another activation of the same grid; zero where the block was inactive."""
    slot = source.table[target.block.clamp_min(0).long()]
    rows = nodes.reshape(-1, source.grid.nodes_per_block)[slot.clamp_min(0).long()]
    known = ((slot >= 0) & (target.block >= 0))[:, None]
    return torch.where(known, rows, torch.zeros_like(rows)).reshape(-1)
