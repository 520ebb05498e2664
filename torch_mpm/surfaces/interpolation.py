"""Quantities of particles at the vertices of their surface."""

from __future__ import annotations

import numpy as np

from .. import optional
from .reconstruction import Array

NEIGHBOURS = 16
"""Number of nearest particles whose quantities a point takes: about those of a half ball of two spacings."""
REGULAR = 1e-4
"""Smallest spread of the neighbours that counts as a direction, relative to the square of their reach."""


class Interpolation:
    """Weights of the nearest particles at some points.

    Args:
        x: positions of particles [P, 3] [m], P > 0, in float32 or float64, which is the dtype of the weights.
        points: [V, 3] [m].
        reach: distance at which the weight of a particle vanishes [m]; farther particles count where none is nearer.

    Raises:
        ImportError: when scipy is missing (extra ``surface``).
    """

    def __init__(self, x: Array, points: Array, reach: float) -> None:
        tree = optional.load("scipy.spatial", "surfaces", "surface").cKDTree(x)
        count = min(NEIGHBOURS, len(x))
        distance, index = tree.query(points, k=count, workers=-1)
        self.index = index.reshape(len(points), count)
        distance = distance.reshape(self.index.shape)
        limit = np.maximum(reach, 1.01 * distance[:, :1] + 1e-300)
        weight = np.square(np.clip(1 - np.square(distance / limit), 0, None))
        self.weight = (weight / weight.sum(1, keepdims=True)).astype(x.dtype)
        self._offset = x[self.index] - points[:, None]
        self._floor = (REGULAR * np.square(limit)).astype(x.dtype)

    def nearest(self, values: Array) -> Array:
        """Values [P, ...] of the nearest particle, [V, ...]."""
        return values[self.index[:, 0]]

    def mean(self, values: Array) -> Array:
        """Weighted mean of values [P, ...], [V, ...]: in the range of the neighbours, of first order in the spacing."""
        near = values.reshape(len(values), -1)[self.index]
        out: Array = (self.weight[:, None] @ near).reshape(len(near), *values.shape[1:])
        return out

    def linear(self, values: Array) -> Array:
        """Weighted least-squares fit of a linear function to values [P, C], [V, C]: exact for linear fields.

        In directions in which the neighbours do not spread, it is the weighted mean.
        """
        near, weight = values[self.index], self.weight[:, None]
        mean, centre = weight @ near, weight @ self._offset
        spread = self._offset - centre
        weighted = (self.weight[..., None] * spread).swapaxes(1, 2)
        moment = weighted @ spread + self._floor[..., None] * np.eye(3, dtype=spread.dtype)
        gradient = np.linalg.solve(moment, weighted @ (near - mean))
        out: Array = (mean - centre @ gradient)[:, 0]
        return out.astype(values.dtype)
