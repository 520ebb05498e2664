"""The materials of taichi_elements as laws of torch_mpm."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...geometry.vectors import determinant
from ...laws import FixedCorotated, Material, Mixture, QuarticSand, Snow
from ...ops.sand import friction_alpha
from ..constitutive import lame

WATER, ELASTIC, SNOW, SAND, STATIONARY = range(5)
NAMES = {"WATER": WATER, "ELASTIC": ELASTIC, "SNOW": SNOW, "SAND": SAND, "STATIONARY": STATIONARY}
POISSON = 0.2
JELLY_FACTOR = 0.3
"""Stiffness of "elastic" over that of the other materials."""
FRICTION = math.radians(45)
SNOW_BOUNDS = {"critical_compression": 2.5e-2, "critical_stretch": 4.5e-3, "hardening": 10.0}


def law_of(material: int, E: float, dim: int, plastic: bool = True) -> Material:
    """Law of a material.

    Args:
        material: its number.
        E: Young's modulus [Pa].
        dim: 2 or 3.
        plastic: whether snow and sand are supported.

    Raises:
        ValueError: for an unknown number, or a plastic material that is not supported.
    """
    if material not in NAMES.values():
        raise ValueError(f"material must be one of {sorted(NAMES.values())}, got {material!r}")
    if material in (SNOW, SAND) and not plastic:
        raise ValueError("material snow and sand need support_plasticity=True")
    mu, lam = lame(E, POISSON)
    if material == WATER:  # τ = λ J (J − 1) with J = det F; see `shapeless`.
        return FixedCorotated(mu=0.0, lam=lam)
    if material == SNOW:
        return Snow(mu=mu, lam=lam, **SNOW_BOUNDS)
    if material == SAND:
        angle = FRICTION if dim == 3 else _plane_angle(FRICTION)
        return QuarticSand(mu=mu, lam=lam, friction_angle=angle, energy="hencky", volume_correction=True)
    return FixedCorotated(mu=JELLY_FACTOR * mu, lam=JELLY_FACTOR * lam)


def _plane_angle(angle: float) -> float:
    """Friction angle in 2-D with the slope that a friction angle has in 3-D, which taichi_elements uses in both."""
    slope = friction_alpha(torch.tensor(angle, dtype=torch.float64), 3)
    return math.asin(math.sqrt(2) * float(slope))


def mixture_of(materials: Sequence[int], E: float, dim: int, plastic: bool) -> Material:
    """Law of several materials, in the order of their numbers."""
    laws = [law_of(m, E, dim, plastic) for m in materials]
    return laws[0] if len(laws) == 1 else Mixture(laws)


def law_indices(material: Tensor) -> tuple[list[int], Tensor]:
    """Materials that occur, and the index of the law of each particle, int32 [P]."""
    present = material.unique()
    return present.tolist(), torch.searchsorted(present, material).to(torch.int32)


def shapeless(F: Tensor, of: Tensor) -> Tensor:
    """F [P, D, D] with J^(1/D) 1 for the particles of a mask [P]: water remembers its volume alone."""
    D = F.shape[1]
    J = determinant(F).clamp_min(0)
    spheres = J.pow(1 / D)[:, None, None] * torch.eye(D, dtype=F.dtype, device=F.device)
    return torch.where(of[:, None, None], spheres, F)
