"""Quadratic and cubic B-splines of the distance from a node, in cells (Steffen, Kirby and Berzins 2008)."""

from __future__ import annotations

import torch
from torch import Tensor


def bspline(distance: Tensor, order: int) -> Tensor:
    """The weight N of a node at a distance of any sign."""
    a = distance.abs()
    if order == 2:
        return torch.where(a < 0.5, 0.75 - a * a, torch.where(a < 1.5, 0.5 * (1.5 - a) ** 2, 0))
    return torch.where(a < 1, 2 / 3 - a * a * (1 - a / 2), torch.where(a < 2, (2 - a) ** 3 / 6, 0))


def bspline_derivative(distance: Tensor, order: int) -> Tensor:
    """Its derivative by the distance."""
    a, sign = distance.abs(), torch.sign(distance)
    if order == 2:
        return torch.where(a < 0.5, -2 * distance, torch.where(a < 1.5, distance - 1.5 * sign, 0))
    return torch.where(a < 1, distance * (1.5 * a - 2), torch.where(a < 2, -0.5 * sign * (2 - a) ** 2, 0))


def base_node(cells: Tensor, order: int) -> Tensor:
    """Index of the first node of the support, int64, for positions in cells from node 0."""
    return torch.floor(cells - (0.5 if order == 2 else 1.0)).long()
