"""Particles of obstacles in the scenes of data sets, as input of learned simulators: a layer below the surface.

They move with the obstacle, and have the particle type ``BOUNDARY``, no mass and no material (-1).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Obstacle
from ..boundaries.motion import to_body
from ..scene.places import obstacle
from .frame_transfer import Array
from .statistics import BOUNDARY

LAYER = 1.5
"""Thickness of the layer, in distances of particles."""
NEUTRAL = {"F": 1.0, "J": 1.0}
"""Fields of undeformed particles: identity, and one; the others are zero."""


def add(arrays: Mapping[str, Array], words: Any, times: Array, spacing: float) -> dict[str, Array]:
    """Arrays of a scene, which may have no particles yet, followed by the particles of its obstacles.

    Obstacles at rest have no particles outside the domain.

    Args:
        arrays: arrays of particles in the form of a shard.
        words: words of the scene with the obstacles.
        times: times of the frames [T] [s].
        spacing: distance of the particles [m].
    """
    found, grid = dict(arrays), words.grid
    for item in words.obstacle:
        body = obstacle(item, None)
        points = _layer(body, spacing, grid.lower, grid.upper)
        if points is None or not len(points):
            continue
        fields = _motion(body, points, times)
        warm = item.temperature if item.temperature is not None else words.heat.reference if words.heat else 0.0
        found = {name: _joined(name, value, fields, len(points), spacing, warm) for name, value in found.items()}
    return found


def _layer(body: Obstacle, spacing: float, lower: Any, upper: Any) -> Tensor | None:
    """Points [n, D] of the layer in coordinates of the body; None for an infinite body that moves."""
    a, b = (torch.tensor(v, dtype=torch.float64) for v in (lower, upper))
    first, last = body.shape.bounds(len(a))
    still = not body.moves
    if still:  # Only the visible part.
        pose = body.pose(0.0)
        corners = to_body(pose.rotation, torch.cartesian_prod(*torch.stack([a, b], 1)) - pose.centre)
        first, last = torch.maximum(first, corners.amin(0)), torch.minimum(last, corners.amax(0))
    if not bool((first.isfinite() & last.isfinite()).all()) or not bool((first < last).all()):
        return None
    axes = [
        lo + (torch.arange(n, dtype=torch.float64) + 0.5) * (hi - lo) / n
        for lo, hi in zip(first.tolist(), last.tolist(), strict=True)
        for n in [max(1, round((hi - lo) / spacing))]
    ]
    points = torch.cartesian_prod(*axes)
    distance = body.shape.signed_distance(points)
    points = points[(distance <= 0) & (distance >= -LAYER * spacing)]
    if still:
        x = points @ pose.rotation.mT + pose.centre
        points = points[((x >= a) & (x <= b)).all(1)]
    return points


def _motion(body: Obstacle, points: Tensor, times: Array) -> dict[str, Array]:
    """Positions and velocities [T, n, D]."""
    x, v = [], []
    for time in times.tolist():
        pose = body.pose(time)
        arm = points @ pose.rotation.mT
        velocity = body.velocity_at(arm, None, time)
        x.append(arm + pose.centre)
        v.append(torch.zeros_like(arm) if velocity is None else velocity.expand_as(arm))
    return {"position": torch.stack(x).numpy(), "velocity": torch.stack(v).numpy()}


def _joined(name: str, values: Array, motion: Mapping[str, Array], count: int, spacing: float, warm: float) -> Array:
    """An array with rows for ``count`` more particles."""
    if values.ndim == 1:
        one = {"particle_type": BOUNDARY, "material": -1, "volume": spacing ** motion["position"].shape[2]}.get(name, 0)
        rows = np.full(count, one, values.dtype)
    elif name in motion:
        rows = motion[name].astype(values.dtype)
    else:
        rows = np.full((len(values), count, *values.shape[2:]), warm if name == "temperature" else 0.0, values.dtype)
        if name in NEUTRAL:
            rows[...] = np.eye(values.shape[-1]) if name == "F" else 1.0
    return np.concatenate([values, rows], axis=min(values.ndim - 1, 1))
