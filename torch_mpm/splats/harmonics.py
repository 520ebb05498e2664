"""Real spherical harmonics of the degrees 0 to 3, as in 3-D Gaussian splatting, and their rotation."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from ..errors import shape_of

COUNTS = (1, 4, 9, 16)
"""Number of harmonics up to each degree."""
OFFSET = 0.5
"""Added to the sum of the harmonics for the colour (Kerbl et al. 2023)."""


def check_harmonics(harmonics: Tensor) -> None:
    """Raise ValueError unless harmonics have the shape [N, K, 3] with K = 1, 4, 9 or 16."""
    fits = isinstance(harmonics, Tensor) and harmonics.dim() == 3
    if not fits or harmonics.shape[1] not in COUNTS or harmonics.shape[2] != 3:
        raise ValueError(f"harmonics must have shape [N, K, 3] with K = 1, 4, 9 or 16, got {shape_of(harmonics)}")


def basis(direction: Tensor, degree: int) -> Tensor:
    """Harmonics [..., (degree + 1)²] in unit directions [..., 3] (x, y, z).

    Orthonormal on the sphere, with the signs and the order of the PLY files of 3-D Gaussian splatting: degree by
    degree, and within a degree l by m from −l to l, with the Condon-Shortley phase (Sloan 2008).

    Raises:
        ValueError: for another shape, or a degree outside 0 .. 3.
    """
    if not isinstance(direction, Tensor) or direction.shape[-1:] != (3,):
        raise ValueError(f"direction must have shape [..., 3], got {shape_of(direction)}")
    if type(degree) is not int or degree not in range(len(COUNTS)):
        raise ValueError(f"degree must be 0, 1, 2 or 3, got {degree}")
    parts = [of_degree(direction, k) for k in range(degree + 1)]
    return torch.cat(parts, -1)


def of_degree(direction: Tensor, degree: int) -> Tensor:
    """Harmonics [..., 2 degree + 1] of one degree in unit directions [..., 3]."""
    x, y, z = direction.unbind(-1)
    if degree == 0:
        terms = [torch.full_like(x, 0.5 / math.sqrt(math.pi))]
    elif degree == 1:
        c = math.sqrt(3 / (4 * math.pi))
        terms = [-c * y, c * z, -c * x]
    elif degree == 2:
        a, b, c = (math.sqrt(value / math.pi) for value in (15 / 4, 5 / 16, 15 / 16))
        terms = [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y), -a * x * z, c * (x * x - y * y)]
    else:
        a, b, c, d = (math.sqrt(value / math.pi) for value in (35 / 32, 105 / 4, 21 / 32, 7 / 16))
        terms = [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (4 * z * z - x * x - y * y),
            d * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y),
            0.5 * b * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(terms, -1)


def colors(harmonics: Tensor, direction: Tensor) -> Tensor:
    """Colours [N, 3] (red, green, blue), not negative, of harmonics [N, K, 3] seen along unit directions [N, 3].

    Raises:
        ValueError: for another shape.
    """
    check_harmonics(harmonics)
    if shape_of(direction) != shape_of(harmonics[:, 0]):
        raise ValueError(f"direction must have shape [N, 3] = {shape_of(harmonics[:, 0])}, got {shape_of(direction)}")
    values = basis(direction, COUNTS.index(harmonics.shape[1]))
    return ((values[:, :, None] * harmonics).sum(1) + OFFSET).clamp(min=0)


def rotated(harmonics: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients [N, K, 3] of the functions f(Rᵀ d) for those of f(d), which turn with the object.

    Exact: harmonics of a degree l rotate among themselves. Their values in 2 l + 1 fixed directions determine a
    function of the degree, so that the matrix of the rotation (Wigner) is that of the values in the directions turned
    back, times the inverse of those in the fixed directions. Gradients pass to both arguments.

    Args:
        harmonics: [N, K, 3] with K = 1, 4, 9 or 16.
        rotation: R [N, 3, 3], or [3, 3] for all.

    Raises:
        ValueError: for another shape.
    """
    check_harmonics(harmonics)
    if not isinstance(rotation, Tensor) or rotation.shape not in ((3, 3), (len(harmonics), 3, 3)):
        raise ValueError(f"rotation must have shape [3, 3] or [{len(harmonics)}, 3, 3], got {shape_of(rotation)}")
    turned = rotation.expand(len(harmonics), 3, 3).permute(1, 2, 0).flatten(1)  # [3, 3 N]
    rows = harmonics.permute(1, 2, 0)  # [K, 3, N]; the longest axis is the last one, which is fastest.
    parts = [rows[:1]]
    for k in range(1, COUNTS.index(harmonics.shape[1]) + 1):
        directions, inverse = (t.to(rotation) for t in _nodes(k))
        back = (directions @ turned).unflatten(1, (3, -1)).movedim(1, -1)  # Rᵀ d, [2 k + 1, N, 3].
        values = of_degree(back, k).unbind(-1)
        own = rows[COUNTS[k - 1] : COUNTS[k]].contiguous()
        sums = sum(v[:, None] * c for v, c in zip(values, own, strict=True))  # [2 k + 1, 3, N]
        parts.append((inverse @ sums.flatten(1)).unflatten(1, (3, -1)))
    return torch.cat(parts).permute(2, 0, 1)


SPIRALS = {1: (1.97, 1.0), 2: (1.28, 0.65), 3: (1.8, 0.5)}
"""Angle between neighbours [rad] and largest height of the directions of a degree, for which the condition number of
the harmonics there is least: 1.4, 2.0 and 2.5.
"""


@functools.cache
def _nodes(degree: int) -> tuple[Tensor, Tensor]:
    """2 degree + 1 directions [2 l + 1, 3] on a spiral, and the inverse of the harmonics there, float64."""
    angle, height = SPIRALS[degree]
    k = torch.arange(2 * degree + 1, dtype=torch.float64, device="cpu")
    z = height * (k + 0.5) / len(k)
    r = (1 - z * z).sqrt()
    directions = torch.stack([r * (angle * k).cos(), r * (angle * k).sin(), z], 1)
    return directions, torch.linalg.inv(of_degree(directions, degree))
