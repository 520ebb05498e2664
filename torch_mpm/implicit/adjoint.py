"""Gradients of an implicit step, by the implicit function theorem.

At the solution the free components of the residual vanish, g(v, θ) = 0, so that for any θ

    v̄ · dv = −λ · ∂g/∂θ dθ   with   H λ = v̄,

where H is the Hessian itself, not its projection: one linear solve, and one vector-Jacobian product of the residual.
The memory does not depend on the iterations, and all of it is in the care of autograd.
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
from .saved import joined, separated
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
    # Start is nothing that the Hessian depends on.
    parts = (fixed.blocks, fixed.state, fixed.mass, fixed.dt, bounds, minimum.free)
    parts, tensors = separated(parts)
    result: Tensor = _Solution.apply(residual, minimum.v, owner, (fixed.law, fixed.stress_form, parts), *tensors)
    return result


class _Solution(torch.autograd.Function):
    """v as a function of the residual that it makes zero. What the Hessian needs is saved, and the Hessian is not."""

    @staticmethod
    def forward(ctx, residual, v, owner, rest, *tensors):
        ctx.owner, ctx.rest = owner, rest
        ctx.save_for_backward(v, *tensors)
        return v.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        v, *tensors = ctx.saved_tensors
        law, stress_form, parts = ctx.rest
        blocks, state, mass, dt, bounds, free = joined(parts, tensors)
        system = ImplicitSystem(blocks, law, state, mass, v, dt, stress_form)
        adjoint = _solve(ctx.owner, system, bounds, free, v, grad)
        return -adjoint, None, None, None, *(None for _ in tensors)


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
    converged = solve.state == CONVERGED
    owner.record_adjoint(converged)
    return torch.where(system.of_nodes(converged), solve.solution, torch.nan)
