"""The axis-aligned manufactured solution of a neo-Hookean block that oscillates between slip walls.

u_i(X, t) = A sin(π X_i) sin(π (φ_i + c t)) with φ = 0, 2/3, 4/3 and c = √(E/ρ), so that F is diagonal and no point
leaves the unit box (after Wallstedt and Guilkey, J. Comput. Phys. 227 (2008) 9628). The body force that makes it a
solution:

    b_i = π² u_i [μ/ρ − c² − (λ (ln J − 1) − μ)/(ρ F_ii²)].
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torch_mpm as mpm

AMPLITUDE = 0.05
E, NU, DENSITY = 1e4, 0.3, 1.0
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
SPEED = math.sqrt(E / DENSITY)
PERIOD = 2 / SPEED
WAVE_SPEED = math.sqrt((LAM + 2 * MU) / DENSITY)


class Solution:
    """The exact motion of material points X [P, D] [m]."""

    def __init__(self, X: Tensor) -> None:
        self.X = X
        self._shape, self._slope = (math.pi * X).sin(), math.pi * (math.pi * X).cos()
        self._phase = torch.tensor([0, 2 / 3, 4 / 3], dtype=X.dtype, device=X.device)[: X.shape[1]]

    def _time(self, t: float) -> tuple[Tensor, Tensor]:
        """Factor of the displacement and its derivative, [D]."""
        angle = math.pi * (self._phase + SPEED * t)
        return AMPLITUDE * angle.sin(), AMPLITUDE * math.pi * SPEED * angle.cos()

    def displacement(self, t: float) -> Tensor:
        return self._shape * self._time(t)[0]

    def velocity(self, t: float) -> Tensor:
        return self._shape * self._time(t)[1]

    def stretch(self, t: float) -> Tensor:
        """The diagonal of F."""
        return 1 + self._slope * self._time(t)[0]

    def velocity_gradient(self, t: float, at: float) -> Tensor:
        """∂v/∂x of the velocity of time t over positions of time `at`, its diagonal."""
        return self._slope * self._time(t)[1] / self.stretch(at)

    def body_force(self, t: float) -> Tensor:
        """b [m/s²]."""
        stretch = self.stretch(t)
        log_J = stretch.log().sum(1, keepdim=True)
        brackets = MU / DENSITY - SPEED**2 - (LAM * (log_J - 1) - MU) / (DENSITY * stretch.square())
        return math.pi**2 * self.displacement(t) * brackets


def lattice(n: int, dim: int, per_axis: int, dtype: torch.dtype) -> Tensor:
    """Material points [P, D] of the unit box: `per_axis` along each axis of each of n cells."""
    line = (torch.arange(n * per_axis, dtype=torch.float64) + 0.5) / (n * per_axis)
    return torch.stack(torch.meshgrid(*[line] * dim, indexing="ij"), -1).reshape(-1, dim).to(dtype)


def initial_state(solution: Solution, velocity_time: float) -> mpm.State:
    """Exact x and F at time 0, exact v and C at `velocity_time`."""
    X = solution.X
    P = X.shape[0]
    volume = torch.full((P,), 1 / P, dtype=X.dtype)
    return mpm.State(
        x=X + solution.displacement(0),
        v=solution.velocity(velocity_time),
        mass=DENSITY * volume,
        volume=volume,
        C=torch.diag_embed(solution.velocity_gradient(velocity_time, 0)),
        F=torch.diag_embed(solution.stretch(0)),
    )
