"""Gradients of an implicit step, by the implicit function theorem.

At the solution the free components of the residual vanish, g(v, θ) = 0, so that for any θ

    v̄ · dv = −λ · ∂g/∂θ dθ   with   H λ = v̄,

where H is the Hessian itself, not its projection: one linear solve, and one vector-Jacobian product of the residual.
The memory does not depend on the iterations, and all of it is in the care of autograd.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..laws.compiled import CompiledLaw
from ..ops import implicit_apply, implicit_cg
from ..ops.implicit import CONVERGED
from ..ops.registry import LAWS
from .bounds import NodeBounds
from .contact import Friction, contact_at
from .newton import Minimum
from .preconditioner import inverse_blocks
from .saved import joined, separated
from .system import ImplicitSystem

if TYPE_CHECKING:
    from .implicit import Implicit

MOST_SOLVES = 60
"""Of an adjoint with friction."""


def differentiable(
    owner: Implicit, system: ImplicitSystem, fixed: ImplicitSystem, bounds: NodeBounds | None, minimum: Minimum
) -> Tensor:
    """The velocities of a minimum, with the derivatives that the residual gives them."""
    v = minimum.v.detach()
    gradient = system.residual(v)
    contact = contact_at(system, bounds, v, gradient)
    residual = contact.gradient
    if not residual.requires_grad:
        return minimum.v
    if system.flows:
        raise NotImplementedError(
            "an implicit step with plasticity='inside' has no gradients: use plasticity='after', or torch.no_grad()"
        )
    for part in system.law.modules():
        if isinstance(part, CompiledLaw) and not LAWS[part.name].twice_differentiable_energy:
            raise NotImplementedError(
                f"gradients of implicit steps need second derivatives of the energy, which {part.name} has not: "
                "use integrator='explicit', or torch.no_grad()"
            )
    # Start is nothing that the Hessian depends on; friction depends on the gradient.
    pressing = None if contact.friction is None else gradient.detach()
    parts = (fixed.blocks, fixed.state, fixed.mass, fixed.dt, bounds, minimum.free, pressing)
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
        blocks, state, mass, dt, bounds, free, gradient = joined(parts, tensors)
        system = ImplicitSystem(blocks, law, state, mass, v, dt, stress_form)
        adjoint = _solve(ctx.owner, system, bounds, free, gradient, v, grad)
        return -adjoint, None, None, None, *(None for _ in tensors)


def _solve(
    owner: Implicit,
    system: ImplicitSystem,
    bounds: NodeBounds | None,
    free: Tensor,
    gradient: Tensor | None,
    v: Tensor,
    grad: Tensor,
) -> Tensor:
    """λ of the free components; NaN in scenes whose solve does not converge. The gradient of the energy is given where
    there is friction."""
    tangent = system.tangent(v, projected=False)
    friction = None if gradient is None else contact_at(system, bounds, v, gradient).friction
    across = None if friction is None else friction.curvature()
    blocks = system.diagonal(system.tangent(v))
    inverse = inverse_blocks(bounds, blocks if across is None else blocks + across, free)
    relative = grad.new_full((system.blocks.grid.scenes,), owner.adjoint_tolerance)
    if grad.dtype == torch.float32:
        relative = relative.clamp_min(1e-5)

    def solved(right: Tensor) -> tuple[Tensor, Tensor]:
        right = right if bounds is None else bounds.kept(right, free)
        solve = implicit_cg(
            *(system.blocks, system.state.x, right, system.mass, inverse, tangent, relative),
            *(4 * owner.options.max_cg_iterations, system.stress_form, across),
        )
        return solve.solution, solve.state == CONVERGED

    adjoint, converged = solved(grad)
    if friction is not None and gradient is not None:
        adjoint, converged = _with_normal_forces(system, friction, tangent, gradient, grad, adjoint, relative, solved)
    owner.record_adjoint(converged)
    return torch.where(system.of_nodes(converged), adjoint, torch.nan)


def _with_normal_forces(
    system: ImplicitSystem,
    friction: Friction,
    tangent: Tensor,
    gradient: Tensor,
    grad: Tensor,
    adjoint: Tensor,
    relative: Tensor,
    solved: Callable[[Tensor], tuple[Tensor, Tensor]],
) -> tuple[Tensor, Tensor]:
    """The adjoint, and where it converged, with what velocities do to friction by way of the normal forces: the
    Hessian is not symmetric there, and the solves with its symmetric part are repeated until they agree."""
    coupling = friction.coupling(gradient)
    direction = friction.bounds.turned(friction.direction)

    def size(vectors: Tensor) -> Tensor:
        return system.node_sum(system.mass[:, None] * vectors.square()).sqrt()

    converged = torch.zeros_like(relative, dtype=torch.bool)
    for _ in range(MOST_SOLVES):
        held = coupling * (direction * adjoint).sum(1, keepdim=True)
        pulled = implicit_apply(system.blocks, system.state.x, held, tangent, system.mass, system.stress_form)
        before = adjoint
        adjoint, converged = solved(grad - pulled)
        settled = size(adjoint - before) <= 10 * relative * size(adjoint)
        converged = converged & settled
        if bool(converged.all()):
            break
    return adjoint, converged
