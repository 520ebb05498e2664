"""Gradients of an implicit step, by the implicit function theorem.

At the solution the free components of the residual vanish, g(v, θ) = 0, so that for any θ

    v̄ · dv = −λ · ∂g/∂θ dθ   with   H λ = v̄,

where H is the Hessian itself, not its projection: one linear solve, and one vector-Jacobian product of the residual.
The memory does not depend on the iterations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..laws.compiled import CompiledLaw
from ..ops import implicit_cg
from ..ops.implicit import CONVERGED
from ..ops.registry import LAWS
from .bounds import NodeBounds
from .newton import Minimum, inverse_blocks
from .system import ImplicitSystem

if TYPE_CHECKING:
    from .implicit import Implicit


def differentiable(
    owner: Implicit, system: ImplicitSystem, fixed: ImplicitSystem, bounds: NodeBounds | None, minimum: Minimum
) -> Tensor:
    """The velocities of a minimum, with the derivatives that the residual gives them."""
    residual = system.residual(minimum.v.detach())
    if not residual.requires_grad:
        return minimum.v
    for part in system.law.modules():
        if isinstance(part, CompiledLaw) and not LAWS[part.name].twice_differentiable_energy:
            raise NotImplementedError(
                f"gradients of implicit steps need second derivatives of the energy, which {part.name} has not: "
                "use integrator='explicit', or torch.no_grad()"
            )
    result: Tensor = _Solution.apply(residual, minimum.v, owner, fixed, bounds, minimum.free)
    return result


class _Solution(torch.autograd.Function):
    """v as a function of the residual that it makes zero."""

    @staticmethod
    def forward(ctx, residual, v, owner, system, bounds, free):
        ctx.owner, ctx.system, ctx.bounds, ctx.free = owner, system, bounds, free
        ctx.save_for_backward(v)
        return v.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        (v,) = ctx.saved_tensors
        adjoint = _solve(ctx.owner, ctx.system, ctx.bounds, ctx.free, v, grad)
        return -adjoint, None, None, None, None, None


def _solve(
    owner: Implicit, system: ImplicitSystem, bounds: NodeBounds | None, free: Tensor, v: Tensor, grad: Tensor
) -> Tensor:
    """λ of the free components; NaN in scenes whose solve does not converge."""
    tangent = system.tangent(v, projected=False)
    inverse = inverse_blocks(system, bounds, system.diagonal(system.tangent(v)), free)
    relative = grad.new_full((system.blocks.grid.scenes,), owner.adjoint_tolerance)
    if grad.dtype == torch.float32:
        relative = relative.clamp_min(1e-5)
    solve = implicit_cg(
        *(system.blocks, system.state.x, grad, system.mass, inverse, tangent, relative),
        *(4 * owner.options.max_cg_iterations, system.stress_form),
    )
    owner.adjoint_converged = solve.state == CONVERGED
    return torch.where(system.of_nodes(owner.adjoint_converged), solve.solution, torch.nan)
