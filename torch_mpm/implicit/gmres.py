"""Linear solves of plastic flows that are not associated, whose Hessian is not symmetric."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .system import ImplicitSystem

DIRECTIONS = 40
"""Iterations between two restarts: as many pairs of node tensors are kept."""


def gmres(
    system: ImplicitSystem,
    product: Callable[[Tensor], Tensor],
    inverse: Tensor,
    right: Tensor,
    relative: Tensor,
    most: int,
) -> tuple[Tensor, Tensor]:
    """Solves J d = right by the restarted generalised minimal residual method (Saad and Schultz 1986), scenes apart.

    The residual r is least as √(r · B⁻¹ r), the norm of Newton's method, which preconditions too. The host waits for
    the device once per iteration.

    Args:
        system: whose nodes they are.
        product: J times node velocities.
        inverse: B⁻¹ of the free components of the nodes [N, D, D] [1/kg]; the solution stays in its range.
        right: [N, D] [kg m/s].
        relative: share of the residual that may be left, [B].
        most: iterations.

    Returns:
        d [N, D] [m/s], and the iterations of each scene, int32 [B].
    """
    solution, left = torch.zeros_like(right), right
    iterations = torch.zeros(len(relative), dtype=torch.int32, device=right.device)
    target: Tensor | None = None
    for start in range(0, most, DIRECTIONS):
        cycle = _Cycle(system, inverse, left)
        target = relative * cycle.first if target is None else target
        solving = cycle.first > target
        if not bool(solving.any()):
            break
        for _ in range(min(DIRECTIONS, most - start)):
            iterations += solving.int()
            solving = solving & (cycle.add(product(cycle.directions[-1])) > target)
            if not bool(solving.any()):
                break
        solution = solution + cycle.solution()
        left = right - product(solution)
    return solution, iterations


class _Cycle:
    """The iterations from one start: Arnoldi's method in the inner product of B⁻¹.

    Attributes:
        first: residual at the start, float64 [B].
        directions: B⁻¹ times an orthonormal basis of residuals.
    """

    def __init__(self, system: ImplicitSystem, inverse: Tensor, left: Tensor) -> None:
        self._system, self._inverse = system, inverse
        q, z, self.first = self._unit(left)
        self._basis, self.directions = [q], [z]
        self._H = torch.zeros(len(self.first), DIRECTIONS + 1, DIRECTIONS, dtype=torch.float64, device=left.device)
        self._goal = torch.zeros_like(self._H[:, :, 0])
        self._goal[:, 0] = self.first
        self._weights = self._goal[:, :0]

    def add(self, w: Tensor) -> Tensor:
        """Take in the product of the last direction; the residual that is left [B]."""
        H, system, k = self._H, self._system, len(self.directions) - 1
        for j in range(k + 1):
            H[:, j, k] = system.node_sum(w * self.directions[j])
            w = w - system.of_nodes(H[:, j, k]).to(w.dtype) * self._basis[j]
        q, z, H[:, k + 1, k] = self._unit(w)
        self._basis.append(q)
        self.directions.append(z)
        # Scenes that are done have columns of zeros, which the pseudo-inverse bears.
        part, goal = H[:, : k + 2, : k + 1], self._goal[:, : k + 2, None]
        self._weights = (torch.linalg.pinv(part) @ goal)[:, :, 0]
        return (part @ self._weights[:, :, None] - goal)[:, :, 0].norm(dim=1)

    def solution(self) -> Tensor:
        pairs = zip(self._weights.unbind(1), self.directions, strict=False)
        return torch.stack([self._system.of_nodes(y).to(z.dtype) * z for y, z in pairs]).sum(0)

    def _unit(self, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A residual of length one, B⁻¹ times it, and its length before."""
        z = (self._inverse * r[:, None, :]).sum(-1)
        size = self._system.node_sum(r * z).clamp_min(0).sqrt()
        scale = self._system.of_nodes(torch.where(size > 0, 1 / torch.where(size > 0, size, 1), 0)).to(r.dtype)
        return r * scale, z * scale, size
