"""The implicit heat solve of MLS-MPM in plain torch, on the same node rows as the op."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from torch_mpm.grid.grid import Blocks

from .transfer import Support, support


@dataclasses.dataclass
class HeatOperator:
    """H_ij = Σ_p κ_p V_p ∇Φ_i · ∇Φ_j with ∇Φ_i = D⁻¹ N_i (x_i − x_p), equation 10 of Gao et al. 2018 (supplement)."""

    support: Support
    gradient: Tensor  # ∇Φ [P, S, D] [1/m]
    conductance: Tensor  # κ V [P]

    @classmethod
    def at(cls, blocks: Blocks, x: Tensor, conductance: Tensor) -> HeatOperator:
        s = support(blocks, x)
        return cls(s, blocks.grid.inverse_inertia * s.weight[..., None] * s.distance, conductance)

    def particle_gradient(self, nodes: Tensor) -> Tensor:
        """Σ_i ∇Φ_i u_i of node values u [N], [P, D]."""
        return torch.einsum("psd,ps->pd", self.gradient, nodes[self.support.rows])

    def apply(self, nodes: Tensor) -> Tensor:
        """H u [N] of node values u [N]."""
        flux = self.conductance[:, None] * self.particle_gradient(nodes)
        given = torch.einsum("psd,pd->ps", self.gradient, flux)
        return torch.zeros_like(nodes).index_add(0, self.support.rows.reshape(-1), given.reshape(-1))

    def diagonal(self, node_count: int) -> Tensor:
        """H_ii [N]."""
        given = self.conductance[:, None] * self.gradient.square().sum(-1)
        return given.new_zeros(node_count).index_add(0, self.support.rows.reshape(-1), given.reshape(-1))

    def bound(self, grid_scale: float, node_count: int) -> Tensor:
        """K_i = D⁻¹ Σ_p κ_p V_p N_i [N], for which u · H u ≤ Σ_i K_i u_i² (Cauchy-Schwarz, Σ N_i r rᵀ = D)."""
        given = grid_scale * self.conductance[:, None] * self.support.weight
        return given.new_zeros(node_count).index_add(0, self.support.rows.reshape(-1), given.reshape(-1))


def heat_cg(
    blocks: Blocks,
    x: Tensor,
    conductance: Tensor,
    heat_capacity: Tensor,
    theta: Tensor | None,
    dt: Tensor,
    source: Tensor | None = None,
    exchange: Tensor | None = None,
    fixed: Tensor | None = None,
    tolerance: Tensor | float = 1e-5,
    relative_tolerance: float = 0.0,
    max_iterations: Tensor | int = 200,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Jacobi-preconditioned conjugate gradients for the increment; dt, tolerance and limit per scene [B].

    See `torch_mpm.ops.heat_cg`; here `theta` may be absent (zero), and a scene also stops at the relative tolerance.
    """
    operator = HeatOperator.at(blocks, x, conductance)
    scenes, scene = blocks.grid.scenes, blocks.node_scene().long()
    zero = torch.zeros_like(heat_capacity)
    source = zero if source is None else source
    exchange = zero if exchange is None else exchange
    held = torch.zeros_like(scene, dtype=torch.bool) if fixed is None else fixed
    free = (scene >= 0) & ~(heat_capacity <= 0) & ~held
    scene = scene.clamp_min(0)

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(scenes).index_add(0, scene, torch.where(free, values, 0))

    valid = dt > 0
    node_dt = torch.where(valid, dt, 1)[scene]
    mass = torch.where(free, heat_capacity, 1)
    diagonal = mass / node_dt + operator.diagonal(len(heat_capacity)) + exchange

    def apply(u: Tensor) -> Tensor:
        return torch.where(free, mass / node_dt * u + operator.apply(u) + exchange * u, 0)

    def norm(r: Tensor) -> Tensor:
        value = dt * (total(r * r / mass) / total(mass)).sqrt()
        return torch.where(total(torch.ones_like(mass)) > 0, value, 0)

    r = torch.where(free, source, 0)
    if theta is not None:
        r = torch.where(free, r - operator.apply(theta) - exchange * theta, 0)
    residual = torch.where(valid, norm(r), torch.nan)
    limit = torch.maximum(torch.as_tensor(tolerance, dtype=x.dtype, device=x.device), relative_tolerance * residual)
    most = torch.as_tensor(max_iterations, device=x.device).expand(scenes)
    iterations = torch.zeros(scenes, dtype=torch.int32, device=x.device)
    running = (residual > limit) & (most > 0)
    d, p, before = zero.clone(), zero.clone(), torch.ones_like(dt)
    while bool(running.any()):
        z = r / diagonal
        rz = total(r * z)
        p = torch.where(running[scene], z + (torch.where(iterations > 0, rz / before, 0))[scene] * p, 0)
        Ap = apply(p)
        curvature = total(p * Ap)
        running = running & (curvature > 0)
        alpha = torch.where(running, rz / curvature, 0)[scene]
        d, r, before = d + alpha * p, r - alpha * Ap, rz
        residual = torch.where(running, norm(r), residual)
        iterations = iterations + running.int()
        running = running & (residual > limit) & (iterations < most)
    # A closed scene conserves its energy: Σ M d = dt Σ h, for any remaining residual.
    holding = held & ~(heat_capacity <= 0) & (blocks.node_scene() >= 0)
    open_to_outside = total((exchange != 0).to(x.dtype)) + zero.new_zeros(scenes).index_add(
        0, scene, holding.to(x.dtype)
    )
    missing = (dt * total(source) - total(mass * d)) / total(mass)
    shift = torch.where((open_to_outside == 0) & (iterations > 0), missing, 0)
    d = torch.where(free, d + shift[scene], 0)
    return d, iterations, residual, residual <= limit
