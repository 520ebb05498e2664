"""Temperature-dependent materials: melting and freezing, thermal expansion."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import DeviceConstantCache
from ..errors import check_number
from ..ops.pointwise import pointwise
from .compiled import check_value
from .custom import as_law
from .material import Material
from .parameters import Overlay, Value, check_length, evaluate, needed_temperature, store

if TYPE_CHECKING:
    from ..state.state import State

__all__ = ["Melting", "ThermalExpansion"]

LIQUID = "liquid"
"""Key of `State.extra` of the liquid mass fraction [P], stored by `Heat` for a material that melts."""


class ThermalExpansion(Material):
    """Law of a body that expands isotropically with its temperature: F = F_e (1 + α θ), and the law receives F_e.

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
        self._kept_table = DeviceConstantCache()
        store(self, "coefficient", check_value("coefficient", coefficient, "finite", lambda v: v == v))

    def check_parameters(self, particles: int, scenes: int | None) -> None:
        self.law.check_parameters(particles, scenes)
        check_length("coefficient", self.coefficient, particles, scenes)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        fields, stress = self.law(self._elastic(state))
        expanded = self._stretched(state, fields.get("J"), fields.get("F"), 1.0)
        return fields | expanded, stress

    def out_of_plane_stress(self, state: State) -> Tensor:
        """τ_zz [P] [Pa] of a body that expands in the plane only; a body that expands in three directions, and has α (1
        + ν) here, has E α θ less, with its linear expansion α.
        """
        return self.law.out_of_plane_stress(self._elastic(state))

    def volume_ratio(self, state: State) -> Tensor:
        elastic = self._elastic(state)
        before, after = (Material.volume_ratio(self, part) for part in (elastic, state))
        return self.law.volume_ratio(elastic) * (after / before)

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

    def _elastic(self, state: State) -> Any:
        J, F = (getattr(state, name) if name in self.state_fields else None for name in ("J", "F"))
        return Overlay(state, **self._stretched(state, J, F, 0.0))

    def _stretched(self, state: State, J: Tensor | None, F: Tensor | None, expand: float) -> dict[str, Tensor]:
        """J and F, where given, with the expansion, or without it where `expand` is zero."""
        given = {name: value for name, value in (("J", J), ("F", F)) if value is not None}
        if not given:
            return {}
        coefficient = evaluate("coefficient", self.coefficient, state)
        results = pointwise(
            "thermal_stretch", state.x.shape[1], given.get("J", 1.0), given.get("F", 1.0), coefficient,
            needed_temperature(state), expand, wanted=[("J", "F").index(name) for name in given],
        )  # fmt: skip
        return dict(zip(given, results, strict=True))


class Melting(Material):
    """Law of a material that is solid and liquid: `Heat` provides the liquid fraction f of each particle.

    The stress is (1 − f) τ_solid(F) + f τ_liquid(J) while the solid is coherent, and τ_liquid from a fraction
    `coherency` on, where the shear of the solid is reset, F ← J^(1/D) 1. Frozen material is a solid without shear at
    its present volume. Continuous except for that collapse, which removes (1 − coherency) of the solid's stress.

    Args:
        solid: law of F, which may be plastic.
        liquid: law of J.
        coherency: liquid fraction in (0, 1] at which the solid skeleton disintegrates.

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
        self._kept_table = DeviceConstantCache()

    def check_parameters(self, particles: int, scenes: int | None) -> None:
        for law in (self.solid, self.liquid):
            law.check_parameters(particles, scenes)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        part = self._consistent(state)
        fields, solid = self.solid(part)
        _, liquid = self.liquid(part)
        changes = {**fields, "F": fields.get("F", part.F), "J": part.J}
        if "dissipated" in fields:
            changes["dissipated"] = torch.where(self._flows(state), 0, fields["dissipated"])
        return changes, self._stress_of_phases(state, solid, liquid)

    def out_of_plane_stress(self, state: State) -> Tensor:
        return self._mixed(state, lambda law, part: law.out_of_plane_stress(part))

    def volume_ratio(self, state: State) -> Tensor:
        part = self._consistent(state)
        return torch.where(self._flows(state), part.J, self.solid.volume_ratio(part))

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
        part = self._consistent(state)
        return torch.where(self._flows(state), self.liquid.invalid(part), self.solid.invalid(part))

    def _mixed(self, state: State, function: Callable[[Material, Any], Tensor]) -> Tensor:
        """A scalar of the two laws, blended as the stress is."""
        part = self._consistent(state)
        return self._blended(state, function(self.solid, part), function(self.liquid, part))

    def _blended(self, state: State, solid: Tensor, liquid: Tensor) -> Tensor:
        """Scalars of the two laws [P], blended as the stress is."""
        fraction = self._fraction(state)
        mixed = (1 - fraction) * solid + torch.where(fraction > 0, fraction * liquid, 0)
        return torch.where(self._flows(state), liquid, mixed)

    def _stress_of_phases(self, state: State, solid: Tensor, liquid: Tensor) -> Tensor:
        """Stress of the material from those of its phases [P, D, D]."""
        fraction = self._fraction(state)
        (stress,) = pointwise("melting_stress", state.x.shape[1], solid, liquid, fraction, self.coherency)
        return stress

    def _fraction(self, state: State) -> Tensor:
        """Liquid fraction [P]."""
        fraction = state.extra.get(LIQUID)
        if fraction is None:
            raise ValueError(f'Melting needs state.extra["{LIQUID}"], which a step keeps with Heat(latent_heat=...)')
        return fraction

    def _flows(self, state: State) -> Tensor:
        """Whether particles flow, bool [P]."""
        return self._fraction(state) >= self.coherency

    def _consistent(self, state: State) -> Any:
        """F and J of one volume: that of J where the particle flows, that of F elsewhere."""
        assert state.F is not None and state.J is not None
        dim, fraction = state.F.shape[1], self._fraction(state)
        J, F = pointwise("melting_parts", dim, state.J, state.F, fraction, self.coherency)
        return Overlay(state, F=F, J=J)
