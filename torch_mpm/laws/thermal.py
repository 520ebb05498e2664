"""Materials that know their temperature: melting and freezing, thermal expansion."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import check_number
from ..parameters import Overlay, Value, evaluate, needed_temperature, store
from ..vectors import determinant
from .compiled import check_value
from .custom import as_law
from .material import Material

if TYPE_CHECKING:
    from ..state import State

__all__ = ["Melting", "ThermalExpansion"]

LIQUID = "liquid"
"""Key of `State.extra` under which `Heat` keeps the liquid mass fraction [P] of a material that melts."""


class ThermalExpansion(Material):
    """A law in a body that expands isotropically with its temperature: F = F_e (1 + α θ), and the law sees F_e.

    The energy is that of F_e per rest volume. In 2-D the expansion is in the plane; a body in plane strain that expands
    in three directions has α (1 + ν) here (Timoshenko and Goodier 1970, section 150).

    Args:
        law: any law; its volume ratio J is divided by (1 + α θ)^D.
        coefficient: linear expansion α over θ, the temperature above the reference [1/K]; a `Value`.

    Raises:
        ValueError: for a coefficient that is not finite; in use for a state without temperature.
    """

    coefficient: Any

    def __init__(self, law: Material, coefficient: Value) -> None:
        super().__init__()
        self.law = law = as_law("law", law)
        self.state_fields, self.extra_fields = law.state_fields, law.extra_fields
        self.viscous = law.viscous
        store(self, "coefficient", check_value("coefficient", coefficient, "finite", lambda v: v == v))

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        stretch = self._stretch(state)
        fields, stress = self.law(self._elastic(state, stretch))
        changes = dict(fields)
        if "F" in fields:
            changes["F"] = fields["F"] * stretch[:, None, None]
        if "J" in fields:
            changes["J"] = fields["J"] * stretch ** state.x.shape[1]
        return changes, stress

    def initial(self, name: str, state: State) -> Tensor:
        return self.law.initial(name, state)

    def energy_density(self, state: State) -> Tensor:
        return self.law.energy_density(self._elastic(state))

    def stiffness(self, state: State) -> Tensor:
        return self.law.stiffness(self._elastic(state))

    def wave_modulus(self, state: State) -> Tensor:
        return self.law.wave_modulus(self._elastic(state))

    def viscosity(self, state: State) -> Tensor | None:
        return self.law.viscosity(self._elastic(state)) if self.viscous else None

    def invalid(self, state: State) -> Tensor:
        return self.law.invalid(self._elastic(state))

    def _stretch(self, state: State) -> Tensor:
        return 1 + evaluate("coefficient", self.coefficient, state) * needed_temperature(state)

    def _elastic(self, state: State, stretch: Tensor | None = None) -> Any:
        stretch = self._stretch(state) if stretch is None else stretch
        changes = {}
        if "F" in self.state_fields and state.F is not None:
            changes["F"] = state.F / stretch[:, None, None]
        if "J" in self.state_fields and state.J is not None:
            changes["J"] = state.J / stretch ** state.x.shape[1]
        return Overlay(state, **changes)


class Melting(Material):
    """One law of a material that is solid and liquid: `Heat` tells the liquid fraction f of each particle.

    The stress is (1 − f) τ_solid(F) + f τ_liquid(J) while the solid is coherent, and τ_liquid from a fraction
    `coherency` on, where the solid forgets its shear, F ← J^(1/D) 1. What freezes is a solid without shear at the
    volume that it has. Continuous but for that collapse, which takes (1 − coherency) of the solid's stress.

    Args:
        solid: law of F, which may be plastic.
        liquid: law of J.
        coherency: liquid fraction in (0, 1] at which the solid skeleton falls apart.

    Raises:
        ValueError: for other laws or a coherency outside its range; in use for a state without a liquid fraction.
    """

    state_fields = ("F", "J")

    def __init__(self, solid: Material, liquid: Material, coherency: float = 0.8) -> None:
        super().__init__()
        solid, liquid = as_law("solid", solid), as_law("liquid", liquid)
        if tuple(solid.state_fields) != ("F",) or tuple(liquid.state_fields) != ("J",):
            raise ValueError(
                "Melting needs a solid with the field F and a liquid with the field J, "
                f"got {solid.state_fields} and {liquid.state_fields}"
            )
        check_number("coherency", coherency, "in (0, 1]", lambda v: 0 < v <= 1)
        self.solid, self.liquid, self.coherency = solid, liquid, float(coherency)
        self.extra_fields = solid.extra_fields
        self.viscous = solid.viscous or liquid.viscous

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        fraction, flows = self._phases(state)
        part = self._consistent(state, flows)
        fields, solid = self.solid(part)
        _, liquid = self.liquid(part)
        changes = {**fields, "F": fields.get("F", part.F), "J": part.J}
        if "dissipated" in fields:
            changes["dissipated"] = torch.where(flows, 0, fields["dissipated"])
        weight = fraction[:, None, None]
        return changes, torch.where(flows[:, None, None], liquid, torch.lerp(solid, liquid, weight))

    def initial(self, name: str, state: State) -> Tensor:
        return self.solid.initial(name, state)

    def energy_density(self, state: State) -> Tensor:
        return self._mixed(state, lambda law, part: law.energy_density(part))

    def stiffness(self, state: State) -> Tensor:
        return self._mixed(state, lambda law, part: law.stiffness(part))

    def wave_modulus(self, state: State) -> Tensor:
        return self._mixed(state, lambda law, part: law.wave_modulus(part))

    def viscosity(self, state: State) -> Tensor | None:
        if not self.viscous:
            return None

        def viscosity(law: Material, part: Any) -> Tensor:
            value = law.viscosity(part)
            return torch.zeros_like(part.mass) if value is None else value

        return self._mixed(state, viscosity)

    def invalid(self, state: State) -> Tensor:
        _, flows = self._phases(state)
        part = self._consistent(state, flows)
        return torch.where(flows, self.liquid.invalid(part), self.solid.invalid(part))

    def _mixed(self, state: State, function: Callable[[Material, Any], Tensor]) -> Tensor:
        """A scalar of the two laws, mixed as the stress is."""
        fraction, flows = self._phases(state)
        part = self._consistent(state, flows)
        solid, liquid = function(self.solid, part), function(self.liquid, part)
        return torch.where(flows, liquid, (1 - fraction) * solid + torch.where(fraction > 0, fraction * liquid, 0))

    def _phases(self, state: State) -> tuple[Tensor, Tensor]:
        """Liquid fraction [P], and which particles flow, bool [P]."""
        fraction = state.extra.get(LIQUID)
        if fraction is None:
            raise ValueError(f'Melting needs state.extra["{LIQUID}"], which a step keeps with Heat(latent_heat=...)')
        return fraction, fraction >= self.coherency

    def _consistent(self, state: State, flows: Tensor) -> Any:
        """F and J of one volume: that of J where the particle flows, that of F elsewhere."""
        F, J = state.F, state.J
        assert F is not None and J is not None
        dim = F.shape[1]
        root = J.where(flows & (J > 0), 1) ** (1 / dim)
        isotropic = torch.diag_embed(root[:, None].expand(-1, dim))
        return Overlay(
            state, F=torch.where(flows[:, None, None], isotropic, F), J=torch.where(flows, J, determinant(F))
        )
