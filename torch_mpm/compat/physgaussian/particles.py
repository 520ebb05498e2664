"""Operations on particles specific to PhysGaussian's simulator."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...state.state import State
from ...step.particle_operations import Timed, of_particles
from ..gradients import Numbers, requires_grad
from ..selections import in_box

PIC_BELOW = -0.001
"""Value of `rpic_damping` below which particles have no C, as in warp-mpm."""


class WithoutAffine(Timed):
    """PIC: no C."""

    def forward(self, state: State, dt: float | Tensor) -> State:
        assert state.C is not None
        return state.replace(C=torch.zeros_like(state.C))


class DampedAffine(Timed):
    """C becomes (1 − a) C + a/2 (C − Cᵀ), so that its symmetric part loses a share a: 0 is APIC, 1 is RPIC (Jiang et
    al. 2015, "The affine particle-in-cell method"). The blend is that of warp-mpm, from which PhysGaussian derives.

    Args:
        share: a: a number, or a tensor [] that may require grad.
    """

    def __init__(self, share: float | Tensor) -> None:
        super().__init__()
        self.share = share

    def forward(self, state: State, dt: float | Tensor) -> State:
        assert state.C is not None
        return state.replace(C=state.C - self.share / 2 * (state.C + state.C.mT))


class Acceleration(Timed):
    """v ← v + dt a of some particles.

    Args:
        acceleration: [m/s²], a tensor [3] that may require grad.
        start, end, particles: see `Timed`.
    """

    def __init__(self, acceleration: Tensor, start: float, end: float, particles: Tensor) -> None:
        super().__init__(start, end, particles)
        self.acceleration = acceleration

    def forward(self, state: State, dt: float | Tensor) -> State:
        acting = self.acting(state)
        if acting is False:
            return state
        change = dt * self.acceleration.to(state.v)
        return state.replace(v=torch.where(acting[:, None], state.v + change, state.v))  # type: ignore[index]


class Enabled(Timed):
    """Particles of a mask [P] take part in the steps; others stay as they are."""

    def forward(self, state: State, dt: float | Tensor) -> tuple[State, Tensor]:
        assert self.particles is not None
        return state, of_particles("particle_selection", self.particles, state, (len(state),))


class Anchored(Timed):
    """Keeps the positions, velocities and deformations that the particles of a mask [P] have in a state, without C."""

    def __init__(self, state: State, particles: Tensor) -> None:
        super().__init__(particles=particles)
        assert state.F is not None
        self.x, self.v, self.F = state.x.detach(), state.v.detach(), state.F.detach()

    def forward(self, state: State, dt: float | Tensor) -> State:
        assert self.particles is not None and state.C is not None and state.F is not None
        held = of_particles("particles", self.particles, state, (len(state),))
        x, v, F = (of_particles(k, t, state, tuple(t.shape)) for k, t in (("x", self.x), ("v", self.v), ("F", self.F)))
        row, matrix = held[:, None], held[:, None, None]
        return state.replace(
            x=torch.where(row, x, state.x),
            v=torch.where(row, v, state.v),
            C=torch.where(matrix, 0, state.C),
            F=torch.where(matrix, F, state.F),
        )


def release_times(x: Tensor, normal: Numbers, start: float, end: float, end_time: float, layers: int) -> Tensor:
    """Release time of each particle [P] [s]; immediate where it is in no layer.

    Layer k of n holds the particles nearer to `end` than (n − k)/n of the way from `start` until (k + 1)/n of the time,
    and on the axes without a normal those within 1 m of 1 m.
    """
    point, size, axis = [1.0] * 3, [1.0] * 3, -1
    for i in range(3):
        if normal[i] != 0:
            axis, point[i], size[i] = i, end, 0.0
    times = torch.full_like(x[:, 0], -math.inf, dtype=torch.float64)
    for k in range(layers):
        size[axis] = abs(start - end) / layers * (layers - k)
        times = torch.where(in_box(x, point, size), end_time / layers * (k + 1), times)
    return times


def release_times_in_boxes(
    x: Tensor, normal: Numbers, start: float, end: float, layers: int, end_time: float, point: Numbers, size: Numbers
) -> Tensor:
    """Release time of each particle [P] [s], as `release_times`: layer k holds the particles nearer to `start` than
    k/n of the distance to `end`, and in a box about a point on the axes without a normal.
    """
    centre, half, axis = list(point), list(size), -1
    for i in range(3):
        if normal[i] != 0:
            axis, centre[i] = i, start
    times = torch.full_like(x[:, 0], -math.inf, dtype=torch.float64)
    for k in range(layers):
        half[axis] = abs(start - end) / layers * k
        times = torch.where(in_box(x, centre, half), end_time / layers * (k + 1), times)
    return times


def is_pic(damping: float | Tensor) -> bool:
    """Whether `rpic_damping` means PIC."""
    return not requires_grad(damping) and float(damping) < PIC_BELOW


def affine_operations(damping: float | Tensor) -> list[Timed]:
    """Operation of `rpic_damping` on C."""
    if requires_grad(damping):
        return [DampedAffine(damping)]
    share = float(damping)
    return [] if share == 0 else [WithoutAffine() if is_pic(share) else DampedAffine(share)]


def enabled_operations(selection: Tensor | None) -> list[Timed]:
    """Operation of `particle_selection`: particles that are not 0 stay as they are."""
    return [] if selection is None or not bool((selection != 0).any()) else [Enabled(particles=selection == 0)]
