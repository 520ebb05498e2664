"""Laws of the principal stretches with parameters of PhysGaussian's simulator, in torch operations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...laws import Material
from ...laws.parameters import evaluate, store
from ..constitutive import lame

if TYPE_CHECKING:
    from ...state.state import State

LEAST_STRETCH = 0.01
"""Lower bound of a stretch in logarithms."""


class StretchPlasticity(Material):
    """Return map in the logarithms of the stretches, with parameters as numbers or tensors [] or [P].

    Args:
        E, nu: Young's modulus [Pa] and Poisson's ratio.
        others: further parameters by name.
    """

    def __init__(self, E: Any, nu: Any, **others: Any) -> None:
        super().__init__()
        self._named = ("E", "nu", *others)
        for name, value in {"E": E, "nu": nu, **others}.items():
            store(self, name, value)

    def initial(self, name: str, state: State) -> Tensor:
        """History begins with the parameter of its name; without one, with one."""
        start = evaluate(name, getattr(self, name), state) if name in self._named else 1.0
        return torch.zeros_like(state.mass) + start

    def _column(self, name: str, state: State) -> Any:
        """A parameter that broadcasts with [P, D]."""
        value = evaluate(name, getattr(self, name), state)
        return value[:, None] if isinstance(value, Tensor) and value.dim() else value

    def _moduli(self, state: State) -> tuple[Any, Any]:
        return lame(self._column("E", state), self._column("nu", state))

    def invalid(self, state: State) -> Tensor:
        assert state.F is not None
        return ~state.F.isfinite().all((1, 2))


def strain_deviator(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Stretches bounded from below [P, D], and the mean [P, 1] and the deviator [P, D] of their logarithms."""
    clamped = sigma.clamp_min(LEAST_STRETCH)
    strain = clamped.log()
    mean = strain.mean(1, keepdim=True)
    return clamped, mean, strain - mean


def stretched_hencky(sigma: Tensor, mu: Any, lam: Any) -> Tensor:
    """The simulator's stress of metal and foam: (2 μ ε + λ tr ε) σ, the Kirchhoff stress of Hencky's law times σ."""
    strain = sigma.clamp_min(LEAST_STRETCH).log()
    return (2 * mu * strain + lam * strain.sum(1, keepdim=True)) * sigma
