"""Choice of the time step of each scene between two segments, in plain torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_mpm.ops.segment_clock import ALL_LEFT, SegmentClock

TOLERANCE = 1e-9  # in the number of substeps


def segment_clock(
    table: Tensor, rate: Tensor | None, cfl: float, longest: float, most: int, choose: bool, substeps: int
) -> Tensor:
    c = SegmentClock(*table.clone().unbind(1))

    def count_cfl(rate: Tensor, where: Tensor) -> Tensor:
        share = torch.nan_to_num(c.step * rate, nan=0.0, posinf=math.inf)
        return torch.where(where, torch.maximum(c.largest_cfl, share), c.largest_cfl)

    if rate is not None:
        c = c._replace(largest_cfl=count_cfl(rate, c.substeps > 0))
    if rate is not None and choose:
        limit, span = (cfl / rate).clamp(max=longest), c.end - c.now
        latest = torch.where((limit / 2 <= c.latest) & (c.latest <= limit), c.latest, limit)
        left = torch.ceil(span / latest * (1 - TOLERANCE)).clamp(min=1)
        moves = (span > 0) & span.isfinite() & (limit > 0) & (c.substeps < most)
        c = c._replace(
            latest=torch.where(moves, latest, c.latest),
            step=torch.where(moves, span / left, c.step),
            left=torch.where(moves, torch.minimum(left, most - c.substeps), 0.0),
        )
        c = c._replace(largest_cfl=count_cfl(rate, moves))
    count = c.left if substeps == ALL_LEFT else torch.where(c.left > substeps, float(substeps), 0.0)
    arrives = (count > 0) & (count * c.step >= (c.end - c.now) * (1 - TOLERANCE))
    c = c._replace(
        now=torch.where(arrives, c.end, c.now + count * c.step),
        substeps=c.substeps + count,
        segment_step=torch.where(count > 0, c.step, 0.0),
    )
    return torch.stack(c, 1)
