"""Clocks of scenes with time steps of their own: Python wrapper and fake kernel."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .arguments import refuse_vmap
from .autograd import dispatch, register_autograd

ALL_LEFT = -1
"""Number of substeps of a segment that takes all scenes to their ends (csrc/rollout/segment_clock.h)."""


class SegmentClock(NamedTuple):
    """Columns of a table of clocks, float64 [B]; numbers of substeps are whole."""

    now: Tensor
    """Time [s]."""
    end: Tensor
    """Final time [s]."""
    latest: Tensor
    """dt of the latest choice [s], zero without one."""
    step: Tensor
    """The same, or slightly less, so that equal substeps end at the final time [s]."""
    left: Tensor
    """Number of substeps until the final time, at most the number that is allowed."""
    substeps: Tensor
    """Number of substeps so far."""
    largest_cfl: Tensor
    """Largest ratio of dt to the stability limit."""
    segment_step: Tensor
    """dt of the substeps of the latest segment [s], zero for a scene that paused."""


def segment_clock(
    table: Tensor, rate: Tensor | None, cfl: float, longest: float, most: int, choose: bool, substeps: int
) -> Tensor:
    """Clocks after a choice of dt and a segment of substeps; not differentiable.

    Args:
        table: clocks, float64 [B, 8] with the columns of `SegmentClock`.
        rate: 1/dt of the stability limit [B] [1/s], float64; None to choose nothing.
        cfl: dt is at most `cfl` / `rate`. A latest dt between half of this share and the whole is kept.
        longest: upper bound of dt [s].
        most: largest number of substeps of a scene.
        choose: whether to choose dt; otherwise `rate` counts for the largest CFL number only.
        substeps: substeps of the segment, for scenes with more substeps left; or `ALL_LEFT`.

    Raises:
        RuntimeError: for wrong shapes, dtypes or devices.
    """
    return dispatch(torch.ops.torch_mpm.segment_clock, table, rate, cfl, longest, most, choose, substeps)


@torch.library.register_fake("torch_mpm::segment_clock")
def _fake(table: Tensor, *arguments: Any) -> Tensor:
    return torch.empty_like(table)


def _no_backward(ctx: Any, *grads: Tensor) -> None:
    raise NotImplementedError("clocks are not differentiable: call segment_clock under torch.no_grad()")


register_autograd("segment_clock", _no_backward)
refuse_vmap("segment_clock")
