"""Placement of an object of Gaussians: which way is up, how large it is, and where it is."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..boundaries.motion import rotation_matrix
from ..errors import check_number, check_vector
from .gaussians import Gaussians, check_gaussians
from .harmonics import rotated

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Signed axes."""


def placed(
    gaussians: Gaussians,
    up: str = "+y",
    extent: float | None = None,
    center: Sequence[float] | Tensor | None = None,
    *,
    world_up: str = "+y",
) -> Gaussians:
    """Turned, scaled and moved Gaussians. Exact: covariances and harmonics turn and scale with the centres. Gradients
    pass to the Gaussians.

    Args:
        gaussians: the object in the coordinates of its file.
        up: signed axis of the file that points up, such as "-y" where cameras come from COLMAP.
        extent: longest edge of the box around the centres [m], after the rotation; None leaves the scale of the file.
        center: middle of this box [m], 3 numbers; None leaves the object about the zero of its coordinates.
        world_up: signed axis of the result that points up.

    Raises:
        ValueError, TypeError: for another axis, extent or center, or no Gaussians.
    """
    check_gaussians(gaussians)
    x = gaussians.x
    if len(x) == 0:
        raise ValueError("an object needs at least one Gaussian, got none")
    rotation = turn(up, world_up).to(x)
    x, axes = x @ rotation.T, rotation @ gaussians.axes
    if extent is not None:
        longest = (x.amax(0) - x.amin(0)).max().double()
        if not 0 < (found := float(longest.detach())) < math.inf:
            raise ValueError(f"the extent of the centres of the Gaussians must be positive and finite, got {found:g} m")
        factor = (check_number("extent", extent, "positive", lambda v: 0 < v < math.inf) / longest).to(x)
        x, axes = factor * x, factor * axes
    if center is not None:
        middle = x.new_tensor(check_vector("center", center, 3))
        x = x - 0.5 * (x.amax(0) + x.amin(0)) + middle
    return gaussians.replace(x=x, axes=axes, harmonics=rotated(gaussians.harmonics, rotation))


def turn(up: str, world_up: str) -> Tensor:
    """Rotation [3, 3], float64, of a signed axis onto another one about the axis normal to both; a half-turn about the
    next axis where they are opposite.
    """
    a, b = axis(up, "up"), axis(world_up, "world_up")
    normal = torch.linalg.cross(a, b)
    if bool((a == -b).all()):
        normal = 2 * a.roll(1).abs()  # Twice a quarter.
    return rotation_matrix(0.5 * math.pi * normal, 3).round()


def axis(text: str, name: str = "axis") -> Tensor:
    """Unit vector [3], float64, of a signed axis; ValueError with a name for another text."""
    if text not in AXES:
        raise ValueError(f"{name} must be one of {', '.join(AXES)}, got {text!r}")
    vector = torch.zeros(3, dtype=torch.float64, device="cpu")
    vector["xyz".index(text[1])] = -1.0 if text[0] == "-" else 1.0
    return vector
