"""Laws with the stress μ J^(−2/3) dev(F Fᵀ): PhysFlow's Newtonian fluid and PhysDreamer's neo-Hookean solid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...geometry.vectors import determinant
from ...laws import Material, isotropic
from ...laws.parameters import evaluate, store
from .stretches import StretchPlasticity

if TYPE_CHECKING:
    from ...state.state import State


class DistortionalFluid(Material):
    """τ = K/2 (J² − 1) I + μ J^(−2/3) dev(F Fᵀ), which PhysFlow and MotionPhysics call "newtonian".

    Args:
        mu: μ [Pa]: a number, or a tensor [] or [P].
        bulk: K [Pa], likewise.
    """

    mu: Any
    bulk: Any

    def __init__(self, mu: Any, bulk: Any) -> None:
        super().__init__()
        store(self, "mu", mu)
        store(self, "bulk", bulk)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        mu, bulk = (_matrix(evaluate(name, getattr(self, name), state)) for name in ("mu", "bulk"))
        J = determinant(state.F)[:, None, None]
        return {}, bulk / 2 * (J * J - 1) * _identity(state.F) + mu * _distortion(state.F, J)

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        J = determinant(state.F)
        return ~((J > 0) & J.isfinite())


class StretchedNeoHookean(StretchPlasticity):
    """Principal stresses σ (μ J^(−2/3) dev σ² + λ/2 (J² − 1)), those of a neo-Hookean solid times the stretches σ.

    PhysDreamer calls it "neo-hookean".

    Args:
        E, nu: [Pa] and -: numbers or tensors [] or [P].
    """

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        assert state.F is not None
        mu, lam = self._moduli(state)

        def stress(sigma: Tensor) -> Tensor:
            return principal_stress(sigma, mu, lam) * sigma

        return {}, isotropic(state.F, stress)

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        return ~(determinant(state.F) > 0)


def principal_stress(sigma: Tensor, mu: Any, bulk: Any) -> Tensor:
    """μ J^(−2/3) dev σ² + K/2 (J² − 1) of stretches σ [P, 3]."""
    J, square = sigma.prod(1, keepdim=True), sigma.square()
    deviator = square - square.mean(1, keepdim=True)
    return mu * J.pow(-2 / 3) * deviator + bulk / 2 * (J * J - 1)


def _distortion(F: Tensor, J: Tensor) -> Tensor:
    """J^(−2/3) dev(F Fᵀ)"""
    b = F @ F.mT
    trace = b.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    return J.pow(-2 / 3) * (b - trace / 3 * _identity(F))


def _identity(F: Tensor) -> Tensor:
    return torch.eye(3, dtype=F.dtype, device=F.device)


def _matrix(value: Any) -> Any:
    """[] or [P] as a factor of matrices."""
    return value[:, None, None] if isinstance(value, Tensor) and value.dim() else value
