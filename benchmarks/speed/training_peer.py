"""A step of MPM in plain torch, as in scripts, differentiated by autograd only.

The algorithm is that of MPM-PyTorch (Lin et al. 2025): weights, gradients of weights and arms of all 27 nodes of a
particle are tensors, `index_add` scatters onto a dense grid, forces are by the gradient of quadratic B-splines, F is
updated by ∇v, positions and entries of F are clamped, and fixed corotated stress comes from a decomposition. The
decomposition is that of this library instead of Warp's, so that it costs the peer almost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import torch_mpm as mpm

Particles = tuple[Tensor, Tensor, Tensor, Tensor]
"""x, v [P, 3], C and F [P, 3, 3]."""

CLIP, LARGEST_ENTRY = 0.5, 2.0
"""Minimum distance of positions from the faces in cells, and bound of the entries of F."""


def corotated(F: Tensor, mu: float, lam: float) -> Tensor:
    """2 μ (F − R) Fᵀ + λ J (J − 1), [P, 3, 3] [Pa]."""
    J = (F[:, 0] * torch.linalg.cross(F[:, 1], F[:, 2])).sum(1)[:, None, None]
    eye = torch.eye(3, dtype=F.dtype, device=F.device)
    return 2 * mu * (F - mpm.polar(F)[0]) @ F.mT + lam * J * (J - 1) * eye


class DenseSolver:
    """Steps of particles of one mass [kg] and volume [m³] in the unit cube with n³ nodes; moduli in [Pa], dt in [s]."""

    def __init__(
        self,
        n: int,
        mass: float,
        volume: float,
        mu: float,
        lam: float,
        gravity: Sequence[float],
        dt: float,
        like: Tensor,
    ) -> None:
        self.n, self.mass, self.volume, self.mu, self.lam, self.dt = n, mass, volume, mu, lam, dt
        self.gravity = torch.tensor(gravity, dtype=like.dtype, device=like.device)
        self.offset = torch.cartesian_prod(*[torch.arange(3, device=like.device)] * 3)  # [27, 3]

    def __call__(self, x: Tensor, v: Tensor, C: Tensor, F: Tensor) -> Particles:
        n, dx, dt = self.n, 1 / self.n, self.dt
        base = (x * n - 0.5).long()
        f = x * n - base
        w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], -1)  # [P, axis, node]
        d = n * torch.stack([f - 1.5, -2 * (f - 1), f - 0.5], -1)
        weight = _products(w, w, w)[..., None]  # [P, 27, 1]
        gradient = torch.stack([_products(d, w, w), _products(w, d, w), _products(w, w, d)], -1)  # [P, 27, 3]
        arm = (self.offset - f[:, None]) * dx
        i, j, k = (base[:, None] + self.offset).unbind(-1)
        index = ((i * n + j) * n + k).flatten()

        stress = corotated(F, self.mu, self.lam)
        momentum = self.mass * weight * (v[:, None] + torch.einsum("pij,pkj->pki", C, arm))
        momentum = momentum - dt * self.volume * torch.einsum("pij,pkj->pki", stress, gradient)
        node_momentum = x.new_zeros(n**3, 3).index_add(0, index, momentum.view(-1, 3))
        node_mass = x.new_zeros(n**3, 1).index_add(0, index, self.mass * weight.view(-1, 1))
        velocity = node_momentum / node_mass.where(node_mass > 1e-15, 1) + dt * self.gravity

        u = velocity.index_select(0, index).view_as(arm)
        v = (weight * u).sum(1)
        C = (4 * n * n * weight[..., None] * torch.einsum("pki,pkj->pkij", u, arm)).sum(1)
        F = F + dt * torch.einsum("pki,pkj->pkij", u, gradient).sum(1) @ F
        x = (x + dt * v).clamp(CLIP * dx, 1 - CLIP * dx)
        return x, v, C, F.clamp(-LARGEST_ENTRY, LARGEST_ENTRY)


def _products(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Products of values [P, axis, node] along the three axes, for all 27 nodes [P, 27]."""
    return torch.einsum("pi,pj,pk->pijk", a[:, 0], b[:, 1], c[:, 2]).flatten(1)
