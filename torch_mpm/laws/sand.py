"""Sand: Drucker-Prager plasticity with the quartic energies of Gao et al. 2018 or that of Klár et al. 2016."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import DeviceConstantCache
from ..errors import check_flag, check_number
from ..ops.registry import LAWS
from ..ops.sand import ANGLE, ENERGIES, friction_alpha, law_name
from .compiled import Range, SolidLaw
from .parameters import Value

if TYPE_CHECKING:
    from ..state.state import State


__all__ = ["QuarticSand"]

VOLUME, HARDENING = "volume_correction", "hardening"
"""Keys of `State.extra` of v_c and q [P]."""


class QuarticSand(SolidLaw):
    """Dry sand: each step returns F to a Drucker-Prager cone in the space of Hencky strains; see `quartic_return_map`.

    Args:
        E: Young's modulus [Pa], not negative, with nu; or
        nu: Poisson's ratio in (−1, 0.5).
        mu, lam: Lamé parameters [Pa]. The quartic energies equal the quadratic one at a strain of 0.4 and are softer
            below.
        friction_angle: [rad], in [0, π/2); 30° if None.
        energy: "unilateral", "full", "hencky" or "mixed".
        apex: "zero" or, with the unilateral energy, "keep".
        smallest_strain: minimum strain for which the stiffness, and so `Step.stable_dt`, is computed. The quartic
            energies have no stiffness at rest, so that without it the time step of sand at rest would be unlimited.
        flow: "radial" or "exact". The radial flow mobilises less friction in plane strain: at a friction angle of 30°
            and ν = 0.3 a Mohr-Coulomb angle of 32° (full), 31° (unilateral) or 29° (mixed), where the exact flow
            mobilises 44°.
        cohesion: Hencky strain in extension that the sand bears along every axis, not negative. Beyond it, it flows
            under the tension of that strain, or tears with a volume correction.
        volume_correction: whether torn sand stores the lost volume, and has neither stress nor cohesion until that gap
            is closed (Tampubolon et al. 2017); in state.extra["volume_correction"] [P].
        hardening: h0, h1, h2, h3 of the friction angle φ = h0 + (h1 q − h3) exp(−h2 q), each like mu, with φ in [0,
            π/2) and h0, h1, h3 in [rad], instead of friction_angle; Klár et al. 2016 use 35°, 9°, 0.2, 10°. q is the
            sum of plastic multipliers, stored in state.extra["hardening"] [P].

    With `dissipation` set, `update` returns "dissipated", the energy that plastic flow and tearing turn into heat [P]
    [J/m³]; see `ReturnMap`. Hardening stores none.

    Raises:
        ValueError: for a value outside its range or an unknown option. Values are checked here only, not when a tensor
            is changed or trained.
    """

    name = "sand_unilateral"
    friction_angle: Any  # Numbers, buffers, nn.Parameters or functions of temperature.
    cohesion: Any

    def __init__(
        self,
        E: Value | None = None,
        nu: Value | None = None,
        mu: Value | None = None,
        lam: Value | None = None,
        friction_angle: Value | None = None,
        energy: str = "unilateral",
        apex: str = "zero",
        smallest_strain: float = 0.05,
        flow: str = "radial",
        cohesion: Value | None = None,
        volume_correction: bool = False,
        hardening: Sequence[Value] | None = None,
    ) -> None:
        super().__init__(E, nu, mu, lam)
        if energy not in ENERGIES:
            raise ValueError(f"energy must be one of {sorted(ENERGIES)}, got {energy!r}")
        if apex not in ("zero", "keep") or (apex == "keep" and energy != "unilateral"):
            raise ValueError(f"apex must be 'zero' or, with energy='unilateral', 'keep', got {apex!r} with {energy!r}")
        quantity = LAWS[self.name].parameter("smallest_strain")
        check_number("smallest_strain", smallest_strain, quantity.expected, lambda v: 0 <= v < math.inf)
        if flow not in ("radial", "exact"):
            raise ValueError(f"flow must be 'radial' or 'exact', got {flow!r}")
        self._set_friction(friction_angle, hardening)
        self.name = f"sand_{energy}"
        self._add("cohesion", 0.0 if cohesion is None else cohesion)
        self.energy_form, self.apex, self.smallest_strain = energy, apex, float(smallest_strain)
        self.flow, self.volume_correction = flow, check_flag("volume_correction", volume_correction)
        self.extra_fields = tuple(
            name for name, used in ((VOLUME, volume_correction), (HARDENING, hardening is not None)) if used
        )
        self._kept_slope = DeviceConstantCache()

    def _set_friction(self, angle: Value | None, hardening: Sequence[Value] | None) -> None:
        self._friction = ("friction_angle",) if hardening is None else ("h0", "h1", "h2", "h3")
        if hardening is None:
            values: Sequence[Value] = (math.pi / 6 if angle is None else angle,)
        elif angle is not None or len(hardening) != 4:
            raise ValueError("hardening must be h0, h1, h2 and h3, in the place of friction_angle")
        else:
            values = hardening
        for name, value in zip(self._friction, values, strict=True):
            self._add(name, value)
        first, last = values[0], values[-1]
        if isinstance(first, float) and isinstance(last, float) and last > first:
            raise ValueError(f"h3 must not be above h0 (in radians), got {last} and {first}")

    def _range(self, name: str) -> Range | None:
        if name in ("friction_angle", "h0", "h3"):
            return ANGLE, lambda v: (v >= 0) & (v < math.pi / 2)
        return ("finite and not negative", lambda v: v >= 0) if name in ("h1", "h2") else super()._range(name)

    def values(self) -> Sequence[Value]:
        """μ and λ [Pa], the friction angle or h0 [rad], cohesion, smallest strain, and h1 to h3."""
        angle, *hardening = (getattr(self, name) for name in self._friction)
        return *self._lame(), angle, self.cohesion, self.smallest_strain, *(hardening or (0.0, 0.0, 0.0))

    def _arguments(self, state: State) -> tuple[Tensor, list[Tensor]]:
        F, (mu, lam, angle, *others) = super()._arguments(state)
        return F, [mu, lam, self._slope(angle, F.shape[1]), *others]

    def _elastic_law(self, state: State, history: Sequence[Tensor]) -> tuple[str, list[Tensor], Sequence[str]]:
        return law_name(self.energy_form, "radial", 3), self._arguments(state)[1], ("elastic",)

    def _name(self, state: State) -> str:
        return law_name(self.energy_form, self.flow, state.x.shape[1])

    def _options(self) -> Sequence[str]:
        keeps, hardens = self.apex == "keep", HARDENING in self.extra_fields
        return *(("keep_apex",) if keeps else ()), *(("hardens",) if hardens else ())

    def _slope(self, angle: Tensor, dim: int) -> Tensor:
        """α of the friction angle, cached while that has not changed and requires no gradient."""
        if torch.compiler.is_compiling() or angle.requires_grad:
            return friction_alpha(angle, dim)
        return self._kept_slope.get((angle, dim), lambda: friction_alpha(angle, dim), angle)
