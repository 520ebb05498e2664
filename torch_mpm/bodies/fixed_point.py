"""Fixed points of two coupled simulators, for each scene of a batch, by a quasi-Newton method.

J. Degroote, K.-J. Bathe, J. Vierendeels (2009), Performance of a new partitioned procedure versus a monolithic
procedure in fluid–structure interaction (IQN-ILS), with a ridge in place of a filter of the columns.
"""

from __future__ import annotations

import torch
from torch import Tensor

FACTOR = 0.1
"""Share of the residual that corrects directions without differences."""
MOST = 8
"""Largest number of differences."""
RIDGE = 1e-8
"""Of the least squares of differences of unit length."""
NOISE = 1e-9
"""Differences of residuals that are a smaller share of x are rounding."""


class FixedPoint:
    """Corrections of x, for which residual(x) = 0 where each simulator has the results of the other one.

    A residual is the difference between the result for x and x, and the result decreases where x increases, as
    impulses on a body do that takes up momentum. Therefore a correction is not longer than the residual.

    Differences of earlier solves are used again.

    Args:
        scenes: number of scenes B.
        size: numbers of each, n.
    """

    def __init__(self, scenes: int, size: int) -> None:
        self._changes = torch.zeros(2, scenes, size, 0, dtype=torch.float64)
        """Of x and of the residual, newest last [2, B, n, m], the latter of unit length."""
        self._latest: Tensor | None = None

    def begin(self) -> None:
        """Begin another solve."""
        self._latest = None

    def observe(self, x: Tensor, residual: Tensor) -> None:
        """Store an x and its residual [B, n]."""
        latest, self._latest = self._latest, torch.stack([x, residual])
        if latest is None:
            return
        change = self._latest - latest
        size = change[1].norm(dim=1)
        matters = size > NOISE * x.norm(dim=1)
        unit = torch.where(matters, 1 / torch.where(matters, size, 1.0), 0.0)
        self._changes = torch.cat([self._changes, (unit[:, None] * change)[..., None]], 3)[..., -MOST:]

    def correction(self) -> Tensor:
        """Change of the latest x [B, n]."""
        assert self._latest is not None
        residual, (of_x, of_residual) = self._latest[1], self._changes
        found = FACTOR * residual
        if self._changes.shape[3]:
            normal = of_residual.mT @ of_residual + RIDGE * torch.eye(of_residual.shape[2], dtype=residual.dtype)
            share = torch.linalg.solve(normal, of_residual.mT @ residual[..., None])
            found = found - ((of_x + FACTOR * of_residual) @ share)[..., 0]
        size, most = found.norm(dim=1), residual.norm(dim=1)
        return found * torch.where(size > most, most / torch.where(size > 0, size, 1.0), 1.0)[:, None]
