"""Damping of all nodes, as a boundary."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from ..errors import check_number, shape_of
from ..laws.parameters import TensorModule, has_hooks


class Damping(TensorModule):
    """Multiplies the velocity of all nodes in every step by a share.

    A rate c [1/s] is the share exp(−c dt). At the beginning of the list of boundaries a share that is a number stays in
    the fused op, unless the state counts impulses. After obstacles that move it also damps the velocity that these
    give.

    Args:
        share: number from 0 to 1, or a floating-point tensor [] that may require grad, whose value is limited to this
            range. It may be assigned.

    Raises:
        TypeError, ValueError: for other shares.
    """

    reads_time = False

    def __init__(self, share: float | Tensor) -> None:
        self.share = share

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, _checked(value) if name == "share" else value)

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        return (self.share.clamp(0, 1) if isinstance(self.share, Tensor) else self.share) * velocity


def _checked(share: Any) -> float | Tensor:
    if not isinstance(share, Tensor):
        return float(check_number("share", share, "between 0 and 1", lambda v: 0 <= v <= 1))
    if share.dim() or not share.is_floating_point():
        raise ValueError(f"share must be a number or a floating-point tensor [], got {shape_of(share)}")
    return share


def split_damping(boundaries: Sequence[Any]) -> tuple[float, Sequence[Any]]:
    """The share that damping by numbers at the beginning of a list leaves of node velocities, and the other entries."""
    share = 1.0
    for k, boundary in enumerate(boundaries):
        if type(boundary) is not Damping or isinstance(boundary.share, Tensor) or has_hooks(boundary):
            return share, boundaries[k:]
        share *= boundary.share
    return share, boundaries[len(boundaries) :]
