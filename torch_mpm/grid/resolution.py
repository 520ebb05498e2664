"""Rounding of stored positions against the node distance of a grid, and against the motion of a step.

A floating-point number x is stored to half a unit in its last place: up to 3e-8 m at 1 m and 0.25 m at 5000 km in
float32. Near the nodes that is an error of the weights of the transfers, which an origin near the bodies avoids.

In each step it is an error of the motion x + dt v, too: motion slower than half a unit over dt vanishes (0.3 m/s in
steps of 1e-7 s, 1 m from zero), and motion ten times as fast may be wrong by a tenth. Compensated positions carry the
rounding of a step on to the next one (`State.x_residual`).
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

import torch

from ..errors import PrecisionWarning

if TYPE_CHECKING:
    from .grid import Grid

RESOLVED = 1e-3
"""Rounding of positions [dx] above which a grid is reported."""
REFUSED = 1 / 16
"""Rounding [dx] above which a grid is refused: fewer than 8 stored positions per cell."""
CARRIED = 1e-3
"""Relative error of the motion of a step from which on positions are compensated."""
DIGITS = {torch.float32: 24, torch.float64: 53}
"""Binary digits of a number."""


def rounding(size: float, dtype: torch.dtype) -> float:
    """Largest error of a stored number up to `size`: half a unit in the last place."""
    return math.ldexp(0.5, math.frexp(size)[1] - DIGITS[dtype])


def loses_motion(grid: Grid, dtype: torch.dtype, dt: float) -> bool:
    """Whether rounding changes the motion in steps of dt [s] by more than a thousandth, at a speed of 1 m/s or, where
    that is less, of the length of the domain in a second.

    The speed is a choice: without reading the particles only the lattice, the dtype and dt are known.
    """
    return grid.rounding(dtype) > CARRIED * min(1.0, grid.extent) * dt


def problem(grid: Grid, dtype: torch.dtype) -> str:
    """A sentence about a grid whose cells positions of a dtype do not resolve; "" where they do."""
    error = grid.rounding(dtype)
    if error <= RESOLVED * grid.dx:
        return ""
    name = str(dtype).removeprefix("torch.")
    wider = "" if dtype == torch.float64 else ", or use float64"
    return (
        f"coordinates up to {grid.reach:.3g} m are rounded by up to {error:.2g} m in {name}, which does not resolve "
        f"dx = {grid.dx:g} m to {RESOLVED:g}: store positions relative to an origin near the bodies (`origin` of "
        f"torch_mpm.seed and of scene files), with all other coordinates relative to it{wider}"
    )


def refused(grid: Grid, dtype: torch.dtype) -> str:
    """Sentence about a grid with fewer than 8 positions per cell; "" where there are more."""
    return problem(grid, dtype) if grid.rounding(dtype) > REFUSED * grid.dx else ""


def check(grid: Grid, dtype: torch.dtype) -> None:
    """Warn of a grid that positions of a dtype do not resolve.

    Raises:
        ValueError: where a cell has fewer than 8 positions.
    """
    if found := refused(grid, dtype):
        raise ValueError(f"the grid is too far from the zero of its coordinates: {found}")
    if found := problem(grid, dtype):
        warnings.warn(found, PrecisionWarning, stacklevel=2)
