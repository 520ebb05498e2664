"""Fluids: laws of the volume ratio."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ..ops.arguments import per_parameter
from ..ops.registry import LAWS
from .compiled import CompiledLaw, check_value
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
        quantity = LAWS["viscous_fluid"].parameter("viscosity")
        self._store("eta", check_value("viscosity", viscosity, quantity.expected, quantity.holds))
        if isinstance(viscosity, Tensor) or callable(viscosity) or viscosity > 0:
            self.name = "viscous_fluid"
            self._describe(self)

    def values(self) -> Sequence[Value]:
        """K [Pa], γ and, of a viscous fluid, η [Pa s]."""
        elastic = (self.bulk_modulus, self.gamma)
        return (*elastic, self.eta) if self.viscous else elastic

    def viscosity(self, state: State) -> Tensor | None:
        if not self.viscous:
            return None
        J, (_, _, eta) = self._arguments(state)
        return J * per_parameter(eta, state.scene, J.shape[0])
