"""Gradients of an implicit step, by the implicit function theorem.

At the solution the free components of the residual vanish, g(v, θ) = 0, so that for any θ

    v̄ · dv = −λ · ∂g/∂θ dθ   with   Jᵀ λ = v̄,   J = ∂g/∂v,

where J is not projected: one linear solve, and one vector-Jacobian product of the residual. Without friction and flow
inside the solve J is the Hessian of the energy. Held components have the velocity b(θ) of their surface: their residual
is v − b, and their λ is v̄ minus Jᵀ applied to the λ of the free components. The memory does not depend on the number
of iterations, and autograd saves all of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..ops import implicit_cg
from ..ops.implicit import CONVERGED, ImplicitSolve
from .bounds import NodeBounds
from .contact import contact_at
from .gmres import gmres
from .newton import Minimum, skewed
from .preconditioner import inverse_blocks, times
from .saved import joined, separated
from .system import ImplicitSystem

if TYPE_CHECKING:
    from .implicit import Implicit

INNER = 1e-2
"""Relative tolerance of the conjugate gradients that precondition GMRES."""


def differentiable(
    owner: Implicit, system: ImplicitSystem, fixed: ImplicitSystem, bounds: NodeBounds | None, minimum: Minimum
) -> Tensor:
    """Velocities of a minimum, with the derivatives defined by the residual."""
    v = minimum.v.detach()
    gradient = system.residual(v)
    contact = contact_at(system, bounds, v, gradient)
    residual = contact.gradient
    holds = None
    if bounds is not None and bounds.moves():
        residual, holds = residual + contact.missed(system, bounds, v), contact.holds(system)
    if not residual.requires_grad:
        return minimum.v
    # The derivative does not depend on start; friction depends on the gradient.
    pressing = None if contact.friction is None else gradient.detach()
    still = None if bounds is None else bounds.detached()
    parts = (fixed.blocks, fixed.state, fixed.mass, fixed.dt, fixed.mirrors, still, contact.free, pressing, holds)
    parts, tensors = separated(parts)
    rest = fixed.law, fixed.stress_form, fixed.flows, parts
    result: Tensor = _Solution.apply(residual, minimum.v, owner, rest, *tensors)
    return result


class _Solution(torch.autograd.Function):
    """v as a function of the residual that it makes zero. The inputs of the derivative J are saved, but not J."""

    @staticmethod
    def forward(ctx, residual, v, owner, rest, *tensors):
        ctx.owner, ctx.rest = owner, rest
        ctx.save_for_backward(v, *tensors)
        return v.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        v, *tensors = ctx.saved_tensors
        law, stress_form, flows, parts = ctx.rest
        blocks, state, mass, dt, mirrors, bounds, free, gradient, holds = joined(parts, tensors)
        system = ImplicitSystem(blocks, law, state, mass, v, dt, stress_form, flows, mirrors=mirrors)
        solve = _Adjoint(ctx.owner, system, bounds, free, gradient, v)
        adjoint, converged = solve.solve(grad)
        if holds is not None:
            adjoint = adjoint + solve.held(grad, adjoint, holds)
        ctx.owner.store_adjoint(converged)
        adjoint = torch.where(system.of_nodes(converged), adjoint, torch.nan)
        return -adjoint, None, None, None, *(None for _ in tensors)


class _Adjoint:
    """The linear solve Jᵀ λ = v̄ at a solution v, with the derivative J of the residual.

    J is symmetric, and conjugate gradients solve it, except for flows that are not associated, and for the dependence
    of friction on velocities through the normal forces. GMRES solves for those scenes, preconditioned by conjugate
    gradients with the projected tangents, so that its iterations are few and do not grow with the stiffness.

    Args:
        owner: integrator with the tolerance and limit of iterations.
        system: system at the solution.
        bounds, free: bounds and free components of the nodes.
        gradient: gradient of the energy [N, D] [kg m/s], where there is friction.
        v: the solution [N, D] [m/s].
    """

    def __init__(
        self,
        owner: Implicit,
        system: ImplicitSystem,
        bounds: NodeBounds | None,
        free: Tensor,
        gradient: Tensor | None,
        v: Tensor,
    ) -> None:
        self._system, self._bounds, self._free = system, bounds, free
        self._most = 4 * owner.options.max_cg_iterations
        self._relative = v.new_full((system.blocks.grid.scenes,), owner.adjoint_tolerance)
        if v.dtype == torch.float32:
            self._relative = self._relative.clamp_min(1e-5)
        self._tangent, self._convex = system.tangent(v, projected=False), system.tangent(v)
        self._skew = system.skew(v) if system.flows else None
        self._friction = None if gradient is None else contact_at(system, bounds, v, gradient).friction
        self._across = self._coupling = None
        if self._friction is not None and gradient is not None:
            self._across, self._coupling = self._friction.curvature(), self._friction.coupling(gradient)
        self._normals = None if bounds is None else bounds.held_normals(free)
        blocks = system.diagonal(self._convex)
        self._inverse = inverse_blocks(bounds, blocks if self._across is None else blocks + self._across, free)

    def solve(self, grad: Tensor) -> tuple[Tensor, Tensor]:
        """λ of the free components [N, D], and convergence of the solve per scene, bool [B]."""
        right = self._kept(self._system.symmetric(grad))
        whole = self._system.of_nodes(self._not_symmetric())
        solve = self._symmetric(torch.where(whole, 0, right), self._tangent, self._relative)
        adjoint, converged = solve.solution, solve.state == CONVERGED
        if bool(whole.any()):
            right = torch.where(whole, right, 0)
            rest = gmres(
                *(self._system, self._transposed, self._inverse, right, self._relative, self._most),
                lambda r: self._symmetric(r, self._convex, torch.full_like(self._relative, INNER)).solution,
            )
            adjoint, converged = adjoint + rest.solution, converged & rest.converged
        return adjoint, converged

    def held(self, grad: Tensor, adjoint: Tensor, holds: Tensor) -> Tensor:
        """λ of the components that surfaces hold, bool [N, D], from that of the free ones [N, D]."""
        assert self._bounds is not None
        return self._bounds.kept(self._system.symmetric(grad) - self._product(adjoint), holds)

    def _not_symmetric(self) -> Tensor:
        """Mask of scenes, bool [B]."""
        result = torch.zeros_like(self._relative, dtype=torch.bool)
        if self._skew is not None:
            result = result | skewed(self._system, self._skew, self._tangent, self._relative)
        if self._coupling is not None:
            result = result | (self._system.node_sum(self._coupling.abs()) > 0)
        return result

    def _symmetric(self, right: Tensor, tangent: Tensor, relative: Tensor) -> ImplicitSolve:
        """Solve with the symmetric part of J, for given tangents."""
        system = self._system
        return implicit_cg(
            *(system.blocks, system.state.x, right, system.mass, self._inverse, tangent, relative, self._most),
            *(system.stress_form, self._across, system.images, self._normals),
        )

    def _transposed(self, given: Tensor) -> Tensor:
        """Free components of Jᵀ times free components."""
        return self._kept(self._product(given))

    def _product(self, given: Tensor) -> Tensor:
        """Jᵀ times free components. With friction c(g) d of the gradient g of the energy, J is (1 + d ∂c/∂g) ∂g/∂v and
        the derivative of friction by its direction."""
        derivative = self._system.derivative(self._tangent, None if self._skew is None else -self._skew)
        if self._friction is None or self._coupling is None:
            return derivative(given)
        direction = self._friction.bounds.turned(self._friction.direction)
        result = derivative(given + self._coupling * (direction * given).sum(1, keepdim=True))
        return result if self._across is None else result + times(self._across, given)

    def _kept(self, vectors: Tensor) -> Tensor:
        return vectors if self._bounds is None else self._bounds.kept(vectors, self._free)
