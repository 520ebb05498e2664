"""Sand: Drucker-Prager plasticity with the quartic energies of Gao et al. 2018 or that of Klár et al. 2016."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .materials import SolidLaw, Value, _check_value, _same
from .ops.sand import ReturnMap, quartic_energy, quartic_return_map, quartic_stiffness
from .reference.sand import ENERGIES, friction_alpha

if TYPE_CHECKING:
    from .state import State


class QuarticSand(SolidLaw):
    """Dry sand: each step returns F to a Drucker-Prager cone in the space of Hencky strains; see `quartic_return_map`.

    Args:
        E: Young's modulus [Pa], not negative, with nu; or
        nu: Poisson's ratio in (−1, 0.5).
        mu, lam: Lamé parameters [Pa]. The quartic energies equal the quadratic one at a strain of 0.4 and are softer
            below.
        friction_angle: [rad], in [0, π/2).
        energy: "unilateral", "full", "hencky" or "mixed".
        apex: "zero" or, with the unilateral energy, "keep".
        smallest_strain: strain that the stiffness, and so `Step.stable_dt`, counts on at least. The quartic energies
            have no stiffness at rest, so that without it the time step of sand at rest would be unlimited.

    The radial flow mobilises less friction in plane strain than the exact flow rule: at a friction angle of 30° and
    ν = 0.3 a Mohr-Coulomb angle of 32° (full), 31° (unilateral) or 29° (mixed), against 44°.

    Raises:
        ValueError: for a value outside its range or an unknown option. Values are checked here, and not again when a
            tensor is changed or trained.
    """

    friction_angle: Any  # number, buffer or nn.Parameter

    def __init__(
        self,
        E: Value | None = None,
        nu: Value | None = None,
        mu: Value | None = None,
        lam: Value | None = None,
        friction_angle: Value = math.pi / 6,
        energy: str = "unilateral",
        apex: str = "zero",
        smallest_strain: float = 0.05,
    ) -> None:
        super().__init__(E, nu, mu, lam)
        if energy not in ENERGIES:
            raise ValueError(f"energy must be one of {sorted(ENERGIES)}, got {energy!r}")
        if apex not in ("zero", "keep") or (apex == "keep" and energy != "unilateral"):
            raise ValueError(f"apex must be 'zero' or, with energy='unilateral', 'keep', got {apex!r} with {energy!r}")
        if not smallest_strain >= 0:
            raise ValueError(f"smallest_strain must not be negative, got {smallest_strain}")
        angle = _check_value("friction_angle", friction_angle, "in [0, π/2)", lambda v: (v >= 0) & (v < math.pi / 2))
        self._store("friction_angle", angle)
        self.energy_form, self.apex, self.smallest_strain = energy, apex, float(smallest_strain)
        self._slopes: tuple[tuple[Tensor, int, int], Tensor] | None = None

    def values(self) -> Sequence[Value]:
        """μ and λ [Pa], and the friction angle [rad]."""
        return *super().values(), self.friction_angle

    def return_map(self, state: State, details: bool = False) -> ReturnMap:
        """The whole result of the return map: branches, convergence and, with details, multiplier and dissipation."""
        F, (mu, lam, angle) = self._arguments(state)
        return quartic_return_map(
            F,
            mu,
            lam,
            alpha=self._slope(angle, F.shape[1]),
            scene=state.scene,
            energy=self.energy_form,
            apex=self.apex,
            details=details,
        )

    def _slope(self, angle: Tensor, dim: int) -> Tensor:
        """α of the friction angle, kept from call to call while that has not changed and requires no gradient."""
        if torch.compiler.is_compiling() or angle.requires_grad:
            return friction_alpha(angle, dim)
        key = (angle, angle._version, dim)
        if self._slopes is None or not _same(self._slopes[0], key):
            self._slopes = key, friction_alpha(angle, dim)
        return self._slopes[1]

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        result = self.return_map(state)
        return {"F": result.F}, result.stress

    def energy_density(self, state: State) -> Tensor:
        """Elastic energy per rest volume [P] [J/m³] of the projected F."""
        _, (mu, lam, _) = self._arguments(state)
        return quartic_energy(self.return_map(state).F, mu, lam, state.scene, self.energy_form)

    def stiffness(self, state: State) -> Tensor:
        """Upper bound of the elastic tangent modulus [P] [Pa]."""
        F, (mu, lam, _) = self._arguments(state)
        return quartic_stiffness(F, mu, lam, state.scene, self.energy_form, self.smallest_strain)

    def wave_modulus(self, state: State) -> Tensor:
        """Upper bound of rest density times squared wave speed [P] [Pa]: `stiffness`."""
        return self.stiffness(state)
