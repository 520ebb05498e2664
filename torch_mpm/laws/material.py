"""Interface of a constitutive law."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ..geometry.vectors import determinant
from .tangent import differentiated_stiffness

if TYPE_CHECKING:
    from ..state.state import State


class Material(nn.Module):
    """A constitutive law. A subclass sets `state_fields` and defines `update`; the other methods where it can.

    Attributes:
        state_fields: fields of the state that a step moves for the law: "F" or "J".
        extra_fields: tensors of state.extra that the law keeps from step to step, its history; see `initial`.
        viscous: whether the stress reads state.C, so that a step has to keep it.
        rate_dependent: whether `update` reads state.dt, the time step [s], which a step then adds to the state.
        dissipation: whether `update` should return "dissipated", which takes time. A step with plastic
            heating sets it on its law and on those inside.
    """

    state_fields: tuple[str, ...] = ("F",)
    extra_fields: tuple[str, ...] = ()
    viscous: bool = False
    rate_dependent: bool = False
    dissipation: bool = False

    def forward(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        """`update`, as a step calls it, with the hooks of the module."""
        return self.update(state)

    def update(self, state: State) -> tuple[dict[str, Tensor], Tensor]:
        """Fields that the law changes (plastic laws: F at the yield surface), and Kirchhoff stress [P, D, D] [Pa].

        `extra_fields` are among the fields, under their own names.
        A law that dissipates adds "dissipated" to the fields where `dissipation` is set: the energy that this step's
        plastic flow turned into heat, per rest volume [P] [J/m³].
        """
        raise NotImplementedError

    def initial(self, name: str, state: State) -> Tensor:
        """Initial value of one of `extra_fields`: zero, [P] unless the law defines another."""
        return torch.zeros_like(state.mass)

    def check_parameters(self, particles: int, scenes: int | None) -> None:
        """Check the tensors of the law, and of the laws inside it, for a state of P particles and B scenes.

        A step calls it before the law. The base class checks nothing.

        Raises:
            ValueError: for a tensor whose shape is not [], [1], [B] or [P], or another valid shape of its argument.
        """

    def stress(self, state: State) -> Tensor:
        """Kirchhoff stress τ [P, D, D] [Pa]."""
        return self.update(state)[1]

    def out_of_plane_stress(self, state: State) -> Tensor:
        """τ_zz [P] [Pa] of a 2-D state in plane strain (F_zz = 1), after the return map, as `stress`.

        Raises:
            NotImplementedError: for a law that defines only the in-plane stress.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no out-of-plane stress, which pressure and von Mises stress need in 2-D: "
            "define out_of_plane_stress(state)"
        )

    def volume_ratio(self, state: State) -> Tensor:
        """Volume over rest volume [P], the ratio of Kirchhoff and Cauchy stress: J, or det F."""
        if self.state_fields == ("J",):
            assert state.J is not None
            return state.J
        assert state.F is not None
        return determinant(state.F)

    def energy_density(self, state: State) -> Tensor:
        """Elastic energy per rest volume [P] [J/m³]; infinite where the law has no meaning."""
        raise NotImplementedError(f"{type(self).__name__} has no energy")

    def trial_energy(self, state: Any, before: Any) -> Tensor:
        """Energy per rest volume [P] [J/m³] that an implicit step minimises, for a trial state without flow.

        Args:
            state: with the trial F or J, and, of a viscous law, the velocity gradient of the step as C and dt of each
                particle as `step` [s].
            before: the state at the start of the step, after the return map.
        """
        raise _not_implicit(self)

    def trial_stress(self, state: Any, before: Any, flows: bool = False) -> Tensor:
        """dP F₀ᵀ: derivative of `trial_energy` by velocity gradients that change the deformation by dF = L F₀ or dJ =
        J₀ tr L from that of `before` [P, D, D] [Pa]. It equals the Kirchhoff stress where both states are the same.
        With `flows`, P is the stress after the return map of the trial state, which need not be the derivative of an
        energy.
        """
        raise _not_implicit(self)

    def trial_tangent(self, state: Any, before: Any, weight: Tensor, projected: bool, flows: bool = False) -> Tensor:
        """Derivative of `trial_stress` in the form of `torch_mpm.ops.law_tangent`, times a weight [P]."""
        raise _not_implicit(self)

    def trial_skew(self, state: Any, weight: Tensor) -> Tensor:
        """Nonsymmetric part of the derivative of `trial_stress` where the trial flows: the skew part of the block
        between the stretches, in the axes of the tangent, times a weight [P, D, D].
        """
        return state.x.new_zeros(state.x.shape[0], *(state.x.shape[1],) * 2)

    def energy(self, state: State) -> Tensor:
        """Elastic energy of each particle [P] [J]."""
        return self.energy_density(state) * state.volume

    def stiffness(self, state: State) -> Tensor:
        """Upper bound of the tangent modulus over all velocity gradients of unit norm [P] [Pa]; limits the step.

        The base class uses automatic differentiation of `update`: D² backward passes, for laws in which the stress of a
        particle depends on its own state only. Zero where it is not finite.
        """
        return differentiated_stiffness(self, state)

    def wave_modulus(self, state: State) -> Tensor:
        """Rest density times the square of the largest wave speed [P] [Pa]."""
        return self.stiffness(state)

    def wave_speed(self, state: State) -> Tensor:
        """Speed of the fastest elastic wave in the deformed material [P] [m/s]: an upper bound, at most 16% above."""
        return (self.wave_modulus(state) * state.volume / state.mass).sqrt()

    def viscosity(self, state: State) -> Tensor | None:
        """Viscosity in terms of Kirchhoff stress [P] [Pa s], or None."""
        return None

    def invalid(self, state: State) -> Tensor:
        """Particles without a meaningful state, bool [P]: not finite, overflowed, or inverted (J ≤ 0)."""
        return ~self.energy_density(state).isfinite()


def _not_implicit(law: Material) -> NotImplementedError:
    return NotImplementedError(f"{type(law).__name__} has no energy of a trial state, which an implicit step needs")
