"""Stresses and return maps common to NCLaw and MPM-PyTorch, by compiled laws where available.

Arguments are F [P, 3, 3] and moduli μ, λ [Pa] as tensors [1] or [P]; gradients pass to all of them, also at equal
stretches.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..ops.law import law_update
from ..ops.sand import friction_alpha


def lame(E: Any, nu: Any) -> tuple[Any, Any]:
    """μ and λ [Pa] of Young's modulus [Pa] and Poisson's ratio, numbers or tensors."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def engineering(mu: Any, lam: Any) -> tuple[Any, Any]:
    """Young's modulus [Pa] and Poisson's ratio of μ and λ [Pa], numbers or tensors."""
    return mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))


def corotated(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """2 μ (F − R) Fᵀ + λ J (J − 1)"""
    return law_update("fixed_corotated", F, [mu.to(F), lam.to(F)]).stress


def hencky(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """U (2 μ ε + λ tr ε) Uᵀ with ε = ln σ"""
    return law_update("hencky", F, [mu.to(F), lam.to(F)]).stress


def stvk(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """μ F (Fᵀ F − 1) + λ J (J − 1), which is not symmetric: the first term lacks a factor Fᵀ in both simulators."""
    return matrix(mu, F) * F @ (F.mT @ F - identity(F)) + volume(F, lam)


def volume(F: Tensor, lam: Tensor) -> Tensor:
    """λ J (J − 1)"""
    J = torch.linalg.det(F)[:, None, None]
    return matrix(lam, F) * J * (J - 1) * identity(F)


def equation_of_state(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """K (J − 1/J) with K = λ + 2 μ/3"""
    J = torch.linalg.det(F)[:, None, None]
    return matrix(lam + 2 / 3 * mu, F) * (J - 1 / J) * identity(F)


def von_mises(F: Tensor, mu: Tensor, limit: Tensor) -> Tensor:
    """F with |dev 2 μ ε| ≤ limit [Pa]."""
    mu = mu.to(F)
    parameters = [mu, torch.zeros_like(mu), math.sqrt(1.5) * limit.to(F), torch.zeros_like(mu)]
    return law_update("von_mises", F, parameters, [torch.zeros_like(F[:, 0, 0])]).state


def drucker_prager(F: Tensor, mu: Tensor, lam: Tensor, friction_angle: Tensor, cohesion: Tensor) -> Tensor:
    """F on the cone of a friction angle [degrees], with its apex at the strain `cohesion` along every axis."""
    slope = friction_alpha(torch.deg2rad(friction_angle.to(F)), 3)
    parameters = [mu.to(F), lam.to(F), slope, cohesion.to(F), *[torch.zeros_like(slope)] * 4]
    return law_update("sand_hencky", F, parameters).state


def isochoric_reset(F: Tensor, lowest: float = 0.0, highest: float = math.inf) -> Tensor:
    """J^(1/3) 1 with J between two bounds: F of a fluid after flow."""
    J = torch.linalg.det(F).clamp(lowest, highest)
    return J.pow(1 / 3)[:, None, None] * identity(F)


def identity(F: Tensor) -> Tensor:
    return torch.eye(3, dtype=F.dtype, device=F.device)


def matrix(value: Tensor, F: Tensor) -> Tensor:
    """[1] or [P] as a factor of matrices."""
    return value.to(F).reshape(-1, 1, 1)
