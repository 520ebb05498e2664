"""Damping of all nodes, as a boundary."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from ..errors import check_number, shape_of
from ..laws.parameters import TensorModule, has_hooks


class Damping(TensorModule):
    """Multiplies the velocity of all nodes in every step by a share.

    A rate c [1/s] is the share exp(−c dt). At the begin of the list of boundaries a share that is a number stays in the
    fused op. After obstacles that move it also damps the velocity that these give.

    Args:
        share: number from 0 to 1, or a floating-point tensor [] that may require grad; above 1 a tensor counts as 1.

    Raises:
        TypeError, ValueError: for other shares.
    """

    reads_time = False

    def __init__(self, share: float | Tensor) -> None:
        if not isinstance(share, Tensor):
            check_number("share", share, "between 0 and 1", lambda v: 0 <= v <= 1)
        elif share.dim() or not share.is_floating_point():
            raise ValueError(f"share must be a number or a floating-point tensor [], got {shape_of(share)}")
        self.share = share

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        return (self.share.clamp(max=1) if isinstance(self.share, Tensor) else self.share) * velocity


def split_damping(boundaries: Sequence[Any]) -> tuple[float, Sequence[Any]]:
    """The share of node velocities that damping by numbers leaves at the begin of a list, and the rest of the list."""
    share = 1.0
    for k, boundary in enumerate(boundaries):
        if type(boundary) is not Damping or isinstance(boundary.share, Tensor) or has_hooks(boundary):
            return share, boundaries[k:]
        share *= boundary.share
    return share, boundaries[len(boundaries) :]
