"""`torch_mpm.ops.survey` in plain torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_mpm.grid.grid import Grid
from torch_mpm.state.state import State

LARGEST_CHANGE = 0.5
"""Maximum relative change of a stretch or of the volume of a particle in one step."""


def survey(
    grid: Grid,
    state: State,
    stress: Tensor,
    stiffness: Tensor,
    bound: float,
    kept: float,
    volumetric: bool = False,
    viscosity: Tensor | None = None,
    energy: Tensor | None = None,
    speed: Tensor | None = None,
) -> Tensor:
    """Largest rate, largest speed and number of invalid particles of each scene [B, 3]; no obstacles."""
    own = state.v.norm(dim=1)
    nearby = own if speed is None else torch.maximum(own, speed)
    inverse_inertia = bound * state.volume / state.mass
    rate = torch.maximum(
        known(oscillation_rate(stiffness * inverse_inertia, viscosity, inverse_inertia, kept) + nearby / grid.dx),
        known(deformation_rate(state, stress, inverse_inertia, math.sqrt(bound) * nearby, volumetric)),
    )
    lower, upper = (torch.tensor(a, dtype=torch.float64, device=state.x.device) for a in (grid.lower, grid.upper))
    wrong = ~(state.v.isfinite() & state.x.isfinite()).all(1)
    wrong |= ((state.x.double() < lower - grid.dx) | (state.x.double() > upper + grid.dx)).any(1)
    if energy is not None:
        wrong |= ~energy.isfinite()
    scene = torch.zeros_like(wrong, dtype=torch.long) if state.scene is None else state.scene.long()
    scene = scene.clamp(0, max(grid.scenes - 1, 0))
    zero = torch.zeros(grid.scenes, dtype=torch.float64, device=state.x.device)
    largest = [zero.scatter_reduce(0, scene, t.double(), "amax") for t in (rate, known(own))]
    return torch.stack([*largest, zero.index_add(0, scene, wrong.double())], 1)


def oscillation_rate(elastic: Tensor, viscosity: Tensor | None, inverse_inertia: Tensor, kept: float) -> Tensor:
    """1/dt [P] of the linear limit: the positive root of kept/dt² − λ_v/dt − λ_e/2."""
    if viscosity is None:
        return (elastic / (2 * kept)).sqrt()
    viscous = 2 * viscosity * inverse_inertia
    return (viscous + (viscous.square() + 2 * kept * elastic).sqrt()) / (2 * kept)


def deformation_rate(
    state: State, stress: Tensor, inverse_inertia: Tensor, gradient: Tensor, volumetric: bool
) -> Tensor:
    """1/dt [P] of the largest change c: the positive root of c/dt² − g/dt − h."""
    if state.C is not None:
        gradient = torch.hypot(gradient, state.C.norm(dim=(1, 2)))
    growth = stress.norm(dim=(1, 2)) * inverse_inertia
    if volumetric:
        gradient, growth = (math.sqrt(state.x.shape[1]) * value for value in (gradient, growth))
    return (gradient + torch.hypot(gradient, 2 * (LARGEST_CHANGE * growth).sqrt())) / (2 * LARGEST_CHANGE)


def known(rate: Tensor) -> Tensor:
    """An unknown rate imposes no limit."""
    return rate.nan_to_num(nan=0.0, posinf=torch.inf)
