"""Motion and deformation of Gaussians with the particles that carry them."""

from __future__ import annotations

import torch
from torch import Tensor

from ..errors import check_count, check_like
from ..ops.svd import polar
from ..state.state import State, check_state
from .gaussians import Gaussians, check_gaussians
from .harmonics import rotated


def deformed(gaussians: Gaussians, x: Tensor, F: Tensor) -> Gaussians:
    """Gaussians at new centres, with Σ' = F Σ Fᵀ and harmonics turned by the rotation R of F = R S (Xie et al. 2024).

    Args:
        gaussians: N Gaussians at rest.
        x: new centres [N, 3] [m].
        F: deformation gradients [N, 3, 3].

    Gradients pass to all arguments.

    Raises:
        ValueError, TypeError: for another shape, dtype or device.
    """
    check_gaussians(gaussians)
    like, N = gaussians.x, len(gaussians)
    check_like("new x", x, like, (N, 3), "[N, 3]", needed=True)
    check_like("F", F, like, (N, 3, 3), "[N, 3, 3]", needed=True)
    harmonics = gaussians.harmonics
    if gaussians.degree > 0:
        harmonics = rotated(harmonics, polar(F).R)
    return gaussians.replace(x=x, axes=F @ gaussians.axes, harmonics=harmonics)


def moved(gaussians: Gaussians, state: State, first: int = 0) -> Gaussians:
    """Gaussians of the particles `first` to `first` + N − 1 of a state, by their ids; see `deformed`.

    Args:
        gaussians: N Gaussians at rest, as given to `torch_mpm.splats.particles`.
        state: particles in 3-D in any order, with F, or for a fluid with J, for which F is J^(1/3) 1; with both, F is
            used. Without F and J nothing is deformed.
        first: number of the particle of the first Gaussian.

    Gradients pass to the state.

    Raises:
        ValueError, TypeError: for a state of fewer particles or with other ids than 0 to P − 1, or of another dtype or
            device.
    """
    check_gaussians(gaussians)
    check_state(state)
    check_count("first", first)
    N, P = len(gaussians), len(state)
    if P < first + N:
        raise ValueError(f"state must have a particle for each Gaussian, {first + N}, got {P}")
    rows: Tensor | slice = slice(first, first + N)
    if state.ids is not None:
        order = state.ids.argsort()
        if not torch.equal(state.ids[order], torch.arange(P, device=order.device)):
            raise ValueError(f"ids of the state must be 0 to {P - 1} in some order")
        rows = order[rows]
    x = state.x[rows]
    F = deformation(x, None if state.F is None else state.F[rows], None if state.J is None else state.J[rows])
    return deformed(gaussians, x, F)


def deformation(x: Tensor, F: Tensor | None, J: Tensor | None) -> Tensor:
    """F [N, 3, 3]: the given one, or J^(1/3) 1 of volume ratios J [N], or else 1."""
    if F is not None:
        return F
    stretch = x.new_ones(len(x)) if J is None else J.pow(1 / 3)
    return torch.diag_embed(stretch[:, None].expand(-1, 3))
