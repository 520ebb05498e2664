"""Particles of an object of Gaussians: one for each Gaussian, and others that fill its inside."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import check_flag, check_number
from ..geometry import seed as seeding
from ..geometry.seed import Points, on_host
from .gaussians import Gaussians, check_gaussians, check_rows
from .interior import Interior, Lattice

FIELD = "gaussian"
"""Field of points with the number of their Gaussian; −1 for those without one."""
FAINT = 0.02
"""Opacity below which a Gaussian is left out (Xie et al. 2024)."""


def visible(gaussians: Gaussians, min_opacity: float = FAINT) -> Tensor:
    """Numbers [n], int64, of the Gaussians of an opacity of at least `min_opacity`, 0 to 1.

    Raises:
        ValueError: for another minimum.
    """
    check_gaussians(gaussians)
    check_number("min_opacity", min_opacity, "within 0 and 1", lambda v: 0 <= v <= 1)
    return (gaussians.opacity >= min_opacity).nonzero()[:, 0]


def particles(
    gaussians: Gaussians,
    grid: Any,
    per_cell: float = 8,
    *,
    fill: bool = True,
    method: str = "lattice",
    seed: int = 0,
    origin: Sequence[float] | Tensor | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Points:
    """One particle for each Gaussian, in their order, and after them those that fill the inside.

    On a lattice of cubes h = dx / per_cell^(1/3) around the object, cells with an opacity field of at least 0.5 are
    opaque, and cells from which all six rays along the axes meet another opaque cell are enclosed. Enclosed cells
    without the centre of a Gaussian are filled, except opaque ones that touch the outside. The n Gaussians in a cell
    share its volume, h³/n each; the filling particles share that of the filled cells.

    Args:
        gaussians: the object in the coordinates of the domain [m].
        grid: a grid in 3-D, or its node spacing dx [m].
        per_cell: mean number of filling particles in a cell of volume dx³.
        fill: False for the Gaussians alone, for thin shells.
        method, seed, origin, dtype, device: as for `torch_mpm.seed.fill`.

    Returns:
        Points, with the number of their Gaussian in `fields["gaussian"]`, int64 [P], or −1.

    Raises:
        ValueError, TypeError: for wrong arguments, no Gaussians, centres that require grad, numbers that are
            not finite, or more particles or cells than fit in memory.
    """
    check_gaussians(gaussians)
    check_flag("fill", fill)
    if len(gaussians) == 0:
        raise ValueError("an object needs at least one Gaussian, got none")
    if (dim := getattr(grid, "dim", 3)) != 3:
        raise ValueError(f"grid must have 3 dimensions for Gaussians, got {dim}")
    dx = check_number("the grid's dx", getattr(grid, "dx", grid), "positive", lambda v: 0 < v < math.inf)
    per_cell = check_number("per_cell", per_cell, "positive", lambda v: 0 < v < math.inf)
    if torch.is_grad_enabled() and gaussians.x.requires_grad:
        raise ValueError("x of the Gaussians must not require grad, which particles do not have: detach it")
    check_rows("the Gaussians must be finite", ~(gaussians.x.isfinite().all(1) & gaussians.axes.isfinite().all((1, 2))))
    with on_host(), torch.no_grad():
        host = gaussians.to("cpu")
        lattice = Lattice(host.x, float(dx / per_cell ** (1 / 3)))
        parts = [Points(host.x.double(), _shares(host.x, lattice))]
        if fill and (region := Interior(host, lattice)).volume > 0:
            options: dict[str, Any] = {"method": method, "seed": seed, "dtype": torch.float64}
            parts.append(seeding.fill(region, dx, per_cell, **options))  # type: ignore[arg-type]
        x, volume = torch.cat([part.x for part in parts]), torch.cat([part.volume for part in parts])
        number = torch.arange(len(x))
        number[len(host) :] = -1
    points = seeding._points(x, volume, origin, dtype, device)
    return dataclasses.replace(points, fields={FIELD: number.to(points.x.device)})


def _shares(x: Tensor, lattice: Lattice) -> Tensor:
    """Volumes [N] [m³] of the Gaussians at x [N, 3]: each cell is shared by those in it."""
    cells = lattice.numbers(lattice.cells(x))
    _, place, count = cells.unique(return_inverse=True, return_counts=True)
    return lattice.spacing**3 / count.double()[place]
