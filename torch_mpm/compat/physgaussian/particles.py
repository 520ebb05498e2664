"""Operations on particles specific to PhysGaussian's simulator."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...state.state import State
from ...step.particle_operations import Timed
from ..gradients import Numbers
from ..selections import in_box

LAYERS = 50
"""Number of layers of a sequential release."""


class WithoutAffine(Timed):
    """PIC: no C."""

    def forward(self, state: State, dt: float | Tensor) -> State:
        assert state.C is not None
        return state.replace(C=torch.zeros_like(state.C))


class DampedAffine(Timed):
    """RPIC: the symmetric part of C minus a share, a number or a tensor [] that may require grad."""

    def __init__(self, share: float | Tensor) -> None:
        super().__init__()
        self.share = share

    def forward(self, state: State, dt: float | Tensor) -> State:
        assert state.C is not None
        return state.replace(C=state.C - self.share / 2 * (state.C + state.C.mT))


def release_times(x: Tensor, normal: Numbers, start: float, end: float, end_time: float) -> Tensor:
    """Release time of each particle [P] [s]; immediate where it is in no layer.

    Layer k of n holds the particles nearer to `end` than (n − k)/n of the way from `start` until (k + 1)/n of the time,
    and on the axes without a normal those within 1 m of 1 m.
    """
    point, size, axis = [1.0] * 3, [1.0] * 3, -1
    for i in range(3):
        if normal[i] != 0:
            axis, point[i], size[i] = i, end, 0.0
    times = torch.full_like(x[:, 0], -math.inf, dtype=torch.float64)
    for k in range(LAYERS):
        size[axis] = abs(start - end) / LAYERS * (LAYERS - k)
        times = torch.where(in_box(x, point, size), end_time / LAYERS * (k + 1), times)
    return times
