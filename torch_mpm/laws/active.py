"""Muscles: a material that contracts along fibres, by an active stress."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import check_vector, shape_of
from ..geometry.values import finite
from ..ops.law import law_energy, law_stiffness, law_update, law_wave_modulus
from ..step.particle_operations import of_particles
from .custom import as_law
from .material import Material

if TYPE_CHECKING:
    from ..state.state import State

__all__ = ["Active"]

ACTIVE_STRESS = "activation"
"""Key of `State.extra` with the active stress of each particle [P] [Pa]."""
FIBRE = "fibre"
"""Name of the compiled law, csrc/laws/fibre.h."""


class Active(Material):
    """A law with an active stress along fibres: τ + a (F d) (F d)ᵀ.

    That is the stress of the energy a (|F d|² − 1)/2 per rest volume, a spring along the fibre, for a constant a; the
    actuation F A Fᵀ of ChainQueen (Hu et al. 2019) with A = a d dᵀ.

    The muscle activation a [P] [Pa] is `state.extra["activation"]`, zero by default; a > 0 contracts. A controller sets
    it in `Step(on_particles=)` for each step, or a hook of `rollout` every n steps; gradients pass to it. Steps between
    two hooks are computed in one op where the law is compiled.

    Args:
        law: any law of F, also a function or module F -> Kirchhoff stress.
        direction: direction of the fibres at rest, unit vectors d, or zero where there are none: D numbers, or a tensor
            [D], [1, D] or [P, D], in the order of `state.ids` where particles were reordered; it may require grad.

    Raises:
        TypeError, ValueError: for a law without F, or a direction of another shape.
    """

    direction: Any

    def __init__(self, law: Any, direction: Any) -> None:
        super().__init__()
        self.law = law = as_law("law", law)
        if "F" not in law.state_fields:
            raise ValueError(f"law must update F, which gives fibres their direction, got {type(law).__name__}")
        self._everywhere = not isinstance(direction, Tensor)  # Numbers are valid on any device.
        if not isinstance(direction, Tensor):
            direction = torch.tensor(check_vector("direction", direction), dtype=torch.float64, device="cpu")
        finite("direction", direction)
        if direction.dim() not in (1, 2) or direction.shape[-1] not in (2, 3) or not direction.is_floating_point():
            raise ValueError(f"direction must be a floating tensor of shape [D] or [P, D], got {shape_of(direction)}")
        self.state_fields, self.extra_fields = law.state_fields, (*law.extra_fields, ACTIVE_STRESS)
        self.viscous = law.viscous
        if isinstance(direction, torch.nn.Parameter):
            self.direction = direction
        else:
            self.register_buffer("direction", direction)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        fields, stress = self.law(state)
        F = fields.get("F", state.F)
        return fields, stress + law_update(FIBRE, F, self.fibre_parameters(state)).stress

    def out_of_plane_stress(self, state: State) -> Tensor:
        return self.law.out_of_plane_stress(state)  # Fibres are in the plane.

    def volume_ratio(self, state: State) -> Tensor:
        return self.law.volume_ratio(state)

    def check_parameters(self, particles: int, scenes: int | None) -> None:
        self.law.check_parameters(particles, scenes)
        if self.direction.dim() != 1 and (self.direction.dim() != 2 or len(self.direction) not in (1, particles)):
            found = shape_of(self.direction)
            raise ValueError(f"direction must have shape [D] or [P, D] with P = {particles}, got {found}")

    def initial(self, name: str, state: State) -> Tensor:
        return torch.zeros_like(state.mass) if name == ACTIVE_STRESS else self.law.initial(name, state)

    def energy_density(self, state: State) -> Tensor:
        return self.law.energy_density(state) + law_energy(*self._fibre(state))

    def stiffness(self, state: State) -> Tensor:
        return self.law.stiffness(state) + law_stiffness(*self._fibre(state))

    def wave_modulus(self, state: State) -> Tensor:
        return self.law.wave_modulus(state) + law_wave_modulus(*self._fibre(state))

    def viscosity(self, state: State) -> Tensor | None:
        return self.law.viscosity(state)

    def invalid(self, state: State) -> Tensor:
        return self.law.invalid(state)

    def fibre_parameters(self, state: State) -> list[Tensor]:
        """Parameters of the compiled law `FIBRE`: the active stress, and three entries of the direction, [] or [P]."""
        if self._everywhere and self.direction.device != state.x.device:
            self.direction = self.direction.to(state.x.device)
        active_stress, x = self._active_stress(state), state.x
        direction = self.direction[0] if self.direction.shape[:-1] == (1,) else self.direction
        direction = of_particles("direction", direction, state, tuple(x.shape)).to(x.dtype)
        entries = list(direction.unbind(-1))
        return [active_stress, *entries, *(x.new_zeros(()) for _ in range(3 - len(entries)))]

    def _fibre(self, state: State) -> tuple[str, Tensor, list[Tensor]]:
        """Arguments of the ops of a law."""
        assert state.F is not None
        return FIBRE, state.F, self.fibre_parameters(state)

    def _active_stress(self, state: State) -> Tensor:
        if ACTIVE_STRESS not in state.extra:
            return torch.zeros_like(state.mass)
        a = state.extra[ACTIVE_STRESS]
        if a.shape != state.mass.shape or a.dtype != state.mass.dtype:
            kind = f"{str(state.mass.dtype).removeprefix('torch.')} [P] = [{len(state.mass)}]"
            raise ValueError(f"state.extra['activation'] must be {kind}, got {a.dtype} {shape_of(a)}")
        return a
