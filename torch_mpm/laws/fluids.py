"""Fluids: laws of the volume ratio."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ..ops.arguments import per_parameter
from ..ops.registry import LAWS
from .compiled import CompiledLaw, Range
from .parameters import Value

if TYPE_CHECKING:
    from ..state.state import State

__all__ = ["WeaklyCompressible"]


class WeaklyCompressible(CompiledLaw):
    """Fluid with Tait-Murnaghan pressure (Monaghan 1994): p = K/γ (J^−γ − 1), τ = −J p I + 2 J η dev(sym C).

    It stores J instead of F. γ = 1 is the linear law τ = K (J − 1) I. At rest the speed of sound is √(K/ρ).

    Args:
        bulk_modulus: K [Pa], not negative.
        gamma: γ, positive; 7 for water.
        viscosity: η [Pa s], not negative. 0 (the number) costs nothing.

    Raises:
        ValueError: for a value outside its range.
    """

    name = "weakly_compressible"
    bulk_modulus: Any
    gamma: Any
    eta: Any

    def __init__(self, bulk_modulus: Value, gamma: Value = 7.0, viscosity: Value = 0.0) -> None:
        super().__init__()
        self._add("bulk_modulus", bulk_modulus)
        self._add("gamma", gamma)
        self._add("eta", viscosity)
        self._choose_law()

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "viscosity":
            raise AttributeError("viscosity is a function of a state: assign the parameter as eta")
        super().__setattr__(name, value)
        if name == "eta":
            self._choose_law()

    def _choose_law(self) -> None:
        """Call the viscous law from the first viscosity on that may be positive."""
        if isinstance(self.eta, Tensor) or callable(self.eta) or self.eta > 0:
            self.name = "viscous_fluid"
            self._describe(self)

    def _range(self, name: str) -> Range | None:
        if name != "eta":
            return super()._range(name)
        quantity = LAWS["viscous_fluid"].parameter("viscosity")
        return quantity.expected, quantity.holds

    def values(self) -> Sequence[Value]:
        """K [Pa], γ and, of a viscous fluid, η [Pa s]."""
        elastic = (self.bulk_modulus, self.gamma)
        return (*elastic, self.eta) if self.viscous else elastic

    def viscosity(self, state: State) -> Tensor | None:
        if not self.viscous:
            return None
        J, (_, _, eta) = self._arguments(state)
        return J * per_parameter(eta, state.scene, J.shape[0])
