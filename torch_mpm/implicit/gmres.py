"""Linear solves with nonsymmetric matrices: plastic flows that are not associated, and adjoints with friction."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .system import ImplicitSystem

DIRECTIONS = 40
"""Iterations between two restarts, and number of pairs of node tensors that are stored."""
STUCK = 0.9
"""Reduction of the residual within as many iterations below which more would take too long."""


class Solve(NamedTuple):
    """Result of `gmres`, per scene."""

    solution: Tensor
    """d [N, D] [m/s]."""
    iterations: Tensor
    """int32 [B]."""
    converged: Tensor
    """bool [B]: whether the residual reached its target, up to rounding."""


def gmres(
    system: ImplicitSystem,
    product: Callable[[Tensor], Tensor],
    inverse: Tensor,
    right: Tensor,
    relative: Tensor,
    most: int,
    precondition: Callable[[Tensor], Tensor] | None = None,
) -> Solve:
    """Solve J d = right by the restarted generalised minimal residual method (Saad and Schultz 1986), for each scene
    separately.

    The residual r is minimal in √(r · B⁻¹ r), the norm of Newton's method. The host waits for the device once per
    iteration. A scene is abandoned where it is not finite, or restarts no longer help.

    Args:
        system: the system of the nodes.
        product: J times node velocities.
        inverse: B⁻¹ of the free components of the nodes [N, D, D] [1/kg]; the solution stays in its range.
        right: [N, D] [kg m/s].
        relative: target of the residual, relative to the first, [B].
        most: maximum number of iterations.
        precondition: approximate inverse of J, times [N, D] of the free components; B⁻¹ by default. It need not be
            linear (Saad 1993).
    """
    solution, left = torch.zeros_like(right), right
    iterations = torch.zeros(len(relative), dtype=torch.int32, device=right.device)
    cycle = _Cycle(system, inverse, left, precondition)
    residual, target = cycle.first, relative * cycle.first
    solving, converged = residual > target, residual <= target
    for start in range(0, most, DIRECTIONS):
        if not bool(solving.any()):
            break
        begun = solving
        for _ in range(min(DIRECTIONS, most - start)):
            iterations += solving.int()
            residual = torch.where(solving, cycle.add(product(cycle.direction()), solving), residual)
            solving = solving & (residual > target)
            if not bool(solving.any()):
                break
        converged = torch.where(begun, residual <= target, converged)
        solution = solution + cycle.solution()
        left = right - product(solution)
        before, cycle = cycle.first, _Cycle(system, inverse, left, precondition)
        residual = cycle.first
        solving = (residual > target) & (residual < STUCK * before)
    return Solve(solution, iterations, converged)


class _Cycle:
    """Iterations from one start: Arnoldi's method in the inner product of B⁻¹.

    Attributes:
        first: residual at the start, float64 [B].
    """

    def __init__(
        self,
        system: ImplicitSystem,
        inverse: Tensor,
        left: Tensor,
        precondition: Callable[[Tensor], Tensor] | None,
    ) -> None:
        self._system, self._inverse, self._precondition = system, inverse, precondition
        q, dual, self.first = self._unit(left)
        finite = self.first.isfinite()
        self._counts = system.of_nodes(finite)
        self._basis, self._duals = [q], [dual]  # Orthonormal residuals, and B⁻¹ times these.
        self._directions: list[Tensor] = []
        self._H = torch.zeros(len(self.first), DIRECTIONS + 1, DIRECTIONS, dtype=torch.float64, device=left.device)
        self._goal = torch.zeros_like(self._H[:, :, 0])
        self._goal[:, 0] = torch.where(finite, self.first, 0)
        self._weights = self._goal[:, :0]

    def direction(self) -> Tensor:
        """Next direction, whose product is passed to `add`."""
        self._directions.append(self._duals[-1] if self._precondition is None else self._precondition(self._basis[-1]))
        return self._directions[-1]

    def add(self, w: Tensor, solving: Tensor) -> Tensor:
        """Add the product of the last direction, for active scenes, bool [B]; returns the remaining residual [B]."""
        H, system, k = self._H, self._system, len(self._directions) - 1
        w = torch.where(self._counts, w, 0)
        for j in range(k + 1):
            H[:, j, k] = system.node_sum(w * self._duals[j])
            w = w - system.of_nodes(H[:, j, k]).to(w.dtype) * self._basis[j]
        q, dual, H[:, k + 1, k] = self._unit(w)
        self._basis.append(q)
        self._duals.append(dual)
        # Scenes that are done have columns of zeros, which the pseudo-inverse allows.
        part, goal = H[:, : k + 2, : k + 1], self._goal[:, : k + 2, None]
        weights = (torch.linalg.pinv(part) @ goal)[:, :, 0]
        self._weights = torch.where(solving[:, None], weights, torch.nn.functional.pad(self._weights, (0, 1)))
        return (part @ weights[:, :, None] - goal)[:, :, 0].norm(dim=1)

    def solution(self) -> Tensor:
        pairs = zip(self._weights.unbind(1), self._directions, strict=True)
        return torch.stack([self._system.of_nodes(y).to(z.dtype) * z for y, z in pairs]).sum(0)

    def _unit(self, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A residual of length one, B⁻¹ times it, and its original length."""
        z = (self._inverse * r[:, None, :]).sum(-1)
        size = self._system.node_sum(r * z).clamp_min(0).sqrt()
        size_of_nodes = self._system.of_nodes(size).to(r.dtype)
        q, z = (torch.where(size_of_nodes > 0, t / size_of_nodes, 0) for t in (r, z))
        return q, z, size
