"""Energy of an implicit step as a function of the node velocities, and its derivatives.

    E(v) = ½ Σ_i m_i |v_i − v*_i|² + Σ_p V_p ψ((I + dt L_p(v)) F_p),

with v* the velocities after gravity. Its gradient is the residual of backward Euler: the scatter of an explicit step,
with the stress of the trial deformation. The ops are differentiable, so that the residual is too, by all of its inputs.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..grid.grid import Blocks
from ..laws.material import Material
from ..laws.parameters import Overlay
from ..ops import advance, gather, implicit_apply, implicit_node_blocks, scatter
from ..ops.arguments import per_particle, sum_by_scene
from .mirrors import Mirrors

READ = ("x", "mass", "volume", "F", "J", "scene", "ids", "material", "temperature", "time", "dt", "particles", "scenes")
"""Fields of a state that laws may read: velocities are those of the nodes."""


@dataclasses.dataclass
class ImplicitSystem:
    """Energy and residual of a step.

    Attributes:
        blocks: the active blocks.
        law: the material.
        state: particles after the return map.
        mass: mass of the nodes [N] [kg].
        start: v* [N, D] [m/s].
        dt: [s], a number or a tensor [], [1] or [B].
        stress_form: "mls" or "gradient".
        flows: whether the stress is that after the return map of the trial deformation; it is not the derivative of an
            energy then.
        before_gravity: velocities of the nodes before gravity [N, D] [m/s], None without gravity: a candidate for the
            start.
        mirrors: mirrors whose symmetric velocities are the unknowns, None without mirrors.
        reference: node velocities whose kinetic term is subtracted from `energy` [N, D] [m/s], v* by default. It avoids
            cancellation where v* is far away, as in a static load in one long step.
        volume: volume of the particles that have an energy, zero for the others [P] [m³].
    """

    blocks: Blocks
    law: Material
    state: Any
    mass: Tensor
    start: Tensor
    dt: float | Tensor
    stress_form: str
    flows: bool = False
    before_gravity: Tensor | None = None
    mirrors: Mirrors | None = None
    reference: Tensor | None = None
    _trial: tuple[Tensor, Any] | None = None

    def __post_init__(self) -> None:
        scene, P = self.blocks.particle_scene(), self.state.x.shape[0]
        dt = self.dt
        if isinstance(dt, Tensor):
            dt = per_particle(dt.to(self.state.x.dtype).reshape(-1), scene, P)
        self.step = dt
        meant = self.law.trial_energy(Overlay(self.state, C=None), self.state).detach().isfinite()
        self.volume = torch.where(meant, self.state.volume, 0)
        self.impulse_weight = self.volume * dt
        self.tangent_weight = (self.impulse_weight * dt).detach()
        slots = self.blocks.block_scene()
        self.slot_scene = slots.clamp_min(0).long()

    def forget(self) -> None:
        """Release tensors that only the search for the minimum reads."""
        self._trial = self.before_gravity = self.reference = None
        self.__dict__.pop("stiffness", None)

    @functools.cached_property
    def stiffness(self) -> Tensor:
        """V times an upper bound of the moduli at the start, float64 [P] [J]."""
        with torch.no_grad():
            return torch.where(self.volume > 0, self.volume * self.law.stiffness(self.state), 0).double()

    def detached(self) -> ImplicitSystem:
        """Copy without gradients, with only the fields of the state that laws may read."""

        def still(value: Any) -> Any:  # Other objects stay the same: a mixture caches the materials of their tensors.
            return value.detach() if isinstance(value, Tensor) and value.requires_grad else value

        fields = {name: still(getattr(self.state, name)) for name in READ if hasattr(self.state, name)}
        extra = {name: still(value) for name, value in self.state.extra.items()}
        return ImplicitSystem(
            *(self.blocks, self.law, Overlay(None, **fields, extra=extra), still(self.mass), still(self.start)),
            *(still(self.dt), self.stress_form, self.flows, self.before_gravity, self.mirrors),
        )

    def trial(self, v: Tensor) -> Any:
        """Particles with the trial deformation of node velocities."""
        if self._trial is not None and self._trial[0] is v:
            return self._trial[1]
        state, grid = self.state, self.blocks.grid
        value, motion = self._motion(v)
        _, F, J = advance(state.x, value, self.dt, motion, state.F, state.J, self.blocks.particle_scene(), grid.scenes)
        trial = Overlay(state, F=F, J=J, C=motion, step=self.step)
        if not v.requires_grad and not torch.is_grad_enabled():
            self._trial = v, trial
        return trial

    def energy(self, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """E of each scene minus the kinetic term of `reference`, float64 [B] [J], infinite where a particle has none;
        and two magnitudes, float64 [B] [J].

        The first is the energy of the motion: kinetic, stored, and the work of the momenta. The rounding error of E is
        a few units in the last place of the second: these energies, and the work of stresses V √(2 K ψ) and momenta on
        rounded strains and velocities.
        """
        stored = self.law.trial_energy(self.trial(v), self.state)
        stored = torch.where(self.volume > 0, self.volume * stored, 0).double()
        strained = (2 * self.stiffness * stored.abs()).sqrt()
        mass, new, start = self.mass[:, None].double(), v.double(), self.start.double()
        change, moved = new - start, self.node_sum(mass * (new - start).abs() * new.abs())
        reference = start if self.reference is None else self.reference.double()
        kinetic = 0.5 * mass * (new - reference) * (change + (reference - start))
        parts = torch.stack([stored, stored.abs(), strained], 1)
        total, size, rounded = self.particle_sum(parts).unbind(1)
        size = size + moved + 0.5 * self.node_sum(mass * new * new)
        return self.node_sum(kinetic) + total, size, size + rounded + self.node_sum(kinetic.abs())

    def unrotated(self, v: Tensor) -> Tensor:
        """Σ V K |dt L(v)|², float64 [B] [J]: upper bound of twice the elastic energy of the displacement of a step,
        reached if none of its gradient were rotation.
        """
        gradient = self.trial(v).C.double() * (self.step[:, None, None] if isinstance(self.step, Tensor) else self.step)
        return self.particle_sum((self.stiffness * gradient.square().sum((1, 2)))[:, None])[:, 0]

    def squared_stretch(self, state: Any) -> Tensor:
        """|F|² of the particles of a state [P], infinite for laws without a deformation gradient and particles without
        energy.
        """
        if state.F is None:
            return torch.full_like(self.volume, torch.inf)
        return torch.where(self.volume > 0, state.F.square().sum((1, 2)), torch.inf)

    def exceeds(self, v: Tensor, most: Tensor) -> Tensor:
        """Scenes in which the trial |F|² of a particle exceeds a limit [P], bool [B]."""
        exceeding = self.squared_stretch(self.trial(v)) > most
        return self.particle_sum(exceeding.double()[:, None])[:, 0] > 0

    def gain(self, v: Tensor, residual: Tensor, trial: Tensor, change: Tensor) -> Tensor:
        """Change of E in a step from v, whose residual is given, to a trial, float64 [B] [J]; with plastic flow, which
        leaves no energy, the work of the residuals along the step by the trapezoidal rule.
        """
        if not self.flows:
            return change
        work = self.node_sum(0.5 * (residual + self.residual(trial)) * (trial - v))
        return torch.where(change.isfinite(), work, torch.inf)

    def residual(self, v: Tensor) -> Tensor:
        """∂E/∂v [N, D] [kg m/s]; differentiable by everything."""
        stress = self.law.trial_stress(self.trial(v), self.state, self.flows)
        meant = (self.volume > 0)[:, None, None]  # The stress of others may be NaN.
        impulse = torch.where(meant, self.impulse_weight[:, None, None] * torch.where(meant, stress, 0), 0)
        return self.symmetric(self.mass[:, None] * (v - self.start) + self._scattered(impulse))

    def symmetric(self, values: Tensor) -> Tensor:
        """Vectors or matrices of nodes, projected as mirrors require."""
        return values if self.mirrors is None else self.mirrors.symmetric(values)

    def _motion(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Velocities of the particles [P, D] and their gradients [P, D, D]."""
        mls, scale = self.stress_form == "mls", self.blocks.grid.inverse_inertia
        value, moment, gradient = gather(self.blocks, self.state.x, v, moment=mls, gradient=not mls, moment_scale=scale)
        motion = moment if mls else gradient
        assert motion is not None
        return value, motion

    def _scattered(self, impulse: Tensor) -> Tensor:
        """Node forces [N, D] of stresses times volume and time step [P, D, D]."""
        mls, x = self.stress_form == "mls", self.state.x
        nothing, scale = x.new_zeros(()).expand(x.shape), self.blocks.grid.inverse_inertia
        return scatter(self.blocks, x, nothing, impulse if mls else None, None if mls else impulse, scale)

    def tangent(self, v: Tensor, projected: bool = True) -> Tensor:
        """Tangents of the particles with their weights, as arguments of the ops of the Hessian [P, n]."""
        return self.law.trial_tangent(self.trial(v), self.state, self.tangent_weight, projected, self.flows)

    def skew(self, v: Tensor) -> Tensor:
        """Contribution of flows that are not associated to the tangents: skew matrices in their axes [P, D, D]."""
        return self.law.trial_skew(self.trial(v), self.tangent_weight)

    def derivative(self, tangent: Tensor, skew: Tensor | None) -> Callable[[Tensor], Tensor]:
        """Derivative of the residual as a function of node velocities [N, D] -> [N, D]; with −skew it is the
        transpose.
        """
        dim = self.state.x.shape[1]
        U, B = (tangent[:, k * dim * dim : (k + 1) * dim * dim].unflatten(1, (dim, dim)) for k in (0, 1))

        def product(direction: Tensor) -> Tensor:
            result = implicit_apply(self.blocks, self.state.x, direction, tangent, self.mass, self.stress_form)
            if skew is None:
                return self.symmetric(result)
            along = (U.mT @ self._motion(direction)[1] @ B).diagonal(dim1=1, dim2=2)
            turned = (skew @ along[:, :, None]) * B.mT
            return self.symmetric(result + self._scattered(U @ turned))

        return product

    def diagonal(self, tangent: Tensor) -> Tensor:
        """The node blocks of the Hessian [N, D, D] [kg]."""
        blocks = implicit_node_blocks(self.blocks, self.state.x, tangent, self.stress_form)
        return self.symmetric(blocks + torch.diag_embed(self.mass[:, None].expand(-1, blocks.shape[1])))

    @property
    def images(self) -> Tensor | None:
        """Node values as arguments of `implicit_cg`."""
        return None if self.mirrors is None else self.mirrors.groups

    # -- sums over scenes

    def node_sum(self, value: Tensor) -> Tensor:
        """Sum of a node tensor [N, ...] over each scene, float64 [B]."""
        by_slot = value.double().reshape(len(self.slot_scene), -1).sum(1)
        return by_slot.new_zeros(self.blocks.grid.scenes).index_add_(0, self.slot_scene, by_slot)

    def particle_sum(self, value: Tensor) -> Tensor:
        """Sum of a particle tensor [P, K] over each scene [B, K]."""
        scene, scenes = self.blocks.scene, self.blocks.grid.scenes
        return sum_by_scene(value, None if scene is None else scene.clamp_max(scenes - 1), scenes)

    def of_nodes(self, value: Tensor) -> Tensor:
        """A tensor [B] as one value per node [N, 1]."""
        return value[self.slot_scene].repeat_interleave(self.blocks.grid.nodes_per_block)[:, None]

    def of_particles(self, value: Tensor) -> Tensor:
        """A tensor [B] as one value per particle [P, 1]."""
        return per_particle(value, self.blocks.particle_scene(), self.state.x.shape[0])[:, None]
