"""Energy of an implicit step in plain torch; its derivatives are computed by autograd."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_mpm.grid.topology import Topology

from . import transfer


def velocity_gradient(blocks: Topology, x: Tensor, v: Tensor, stress_form: str) -> Tensor:
    """L_p = D⁻¹ Σ N_i v_i (x_i − x_p)ᵀ ("mls") or Σ v_i ∇N_iᵀ ("gradient") [P, D, D]."""
    _, moment, gradient = transfer.gather(blocks, x, v, blocks.grid.inverse_inertia)
    return moment if stress_form == "mls" else gradient


def energy(
    blocks: Topology,
    x: Tensor,
    v: Tensor,
    start: Tensor,
    mass: Tensor,
    F: Tensor,
    volume: Tensor,
    dt: float,
    density: Callable[[Tensor], Tensor],
    stress_form: str = "mls",
) -> Tensor:
    """½ Σ m |v − v*|² + Σ V ψ((I + dt L) F) of all scenes [J], with ψ(F) of a function [P, D, D] -> [P]."""
    trial = F + dt * velocity_gradient(blocks, x, v, stress_form) @ F
    return (mass[:, None] * (v - start).square()).sum() / 2 + (volume * density(trial)).sum()


def hessian(function: Callable[[Tensor], Tensor], v: Tensor, along: Sequence[Tensor]) -> list[Tensor]:
    """Products of the Hessian of a scalar function with directions, by torch.func."""
    gradient = torch.func.grad(function)
    return [torch.func.jvp(gradient, (v,), (direction,))[1] for direction in along]
