"""`MPMDifferentiableSimulation` of warp_mpm and its variants: several steps as one function of tensors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...errors import check_count
from ..physgaussian.exchange import moved_covariance
from .mpm_data_structure import MPMModelStruct, MPMStateStruct
from .mpm_solver_diff import MPMWARPDiff

Particles = tuple[Tensor, Tensor, Tensor, Tensor]


class MPMDifferentiableSimulationWCheckpoint:
    """n steps as one rollout, which stores some states for the backward pass and recomputes the steps in between."""

    @staticmethod
    def apply(
        mpm_solver: MPMWARPDiff,
        mpm_state: MPMStateStruct,
        mpm_model: MPMModelStruct,
        substep_size: float,
        num_substeps: int,
        particle_x: Tensor,
        particle_v: Tensor,
        particle_F: Tensor,
        particle_C: Tensor,
        E: Tensor,
        nu: Tensor,
        particle_density: Tensor | None = None,
        query_mask: Tensor | None = None,
        device: Any = None,
        requires_grad: bool = True,
        extra_no_grad_steps: int = 0,
    ) -> Particles:
        """Particles after extra_no_grad_steps without gradients and num_substeps with them.

        Args:
            mpm_solver, mpm_state, mpm_model: written to: the state has the first step with gradients.
            substep_size: dt [s].
            num_substeps: number of steps with gradients.
            particle_x, particle_v: [P, 3] [m, m/s].
            particle_F, particle_C: [P, 3, 3] or [P, 9].
            E, nu: [], [1] or [P] [Pa].
            particle_density: [] or [P] [kg/m³]; None for that of the state.
            query_mask: particles [P] whose density changes; None for all.
            extra_no_grad_steps: number of steps before.

        Returns:
            x, v [P, 3], F and C [P, 3, 3], with gradients to all given tensors.
        """
        check_count("num_substeps", num_substeps)
        mpm_state.continue_from_torch(particle_x, particle_v, particle_F, particle_C, device)
        mpm_solver.set_E_nu(mpm_model, E, nu)
        mpm_solver.prepare_mu_lam(mpm_model, mpm_state)
        if particle_density is not None:
            mpm_state.reset_density(particle_density, query_mask, device, update_mass=True)
        if extra_no_grad_steps:
            with torch.no_grad():
                mpm_solver.rollout(mpm_model, mpm_state, mpm_state, extra_no_grad_steps, substep_size)
        last = mpm_state.partial_clone()
        mpm_solver.rollout(mpm_model, mpm_state, last, num_substeps, substep_size)
        return last.particle_x, last.particle_v, last.particle_F_trial, last.particle_C


class MPMDifferentiableSimulationClean:
    """As `MPMDifferentiableSimulationWCheckpoint`, with the covariances F Σ Fᵀ [P, 6] as a fifth result, of those in
    `particle_cov` of the state.
    """

    @staticmethod
    def apply(mpm_solver: MPMWARPDiff, mpm_state: MPMStateStruct, *arguments: Any, **keywords: Any) -> tuple[Any, ...]:
        """x, v [P, 3], F and C [P, 3, 3] and covariances [P, 6]; see `MPMDifferentiableSimulationWCheckpoint.apply`."""
        apply = MPMDifferentiableSimulationWCheckpoint.apply
        x, v, F, C = apply(mpm_solver, mpm_state, *arguments, **keywords)
        return x, v, F, C, moved_covariance(F, mpm_state.particle_cov.reshape(-1, 6)).reshape(-1, 6)


class MPMDifferentiableSimulation:
    """n steps from particles at rest in shape, as one rollout."""

    @staticmethod
    def apply(
        mpm_solver: MPMWARPDiff,
        mpm_state: MPMStateStruct,
        mpm_model: MPMModelStruct,
        substep: int,
        substep_size: float,
        num_substeps: int,
        init_pos: Tensor,
        init_velocity: Tensor,
        E: Tensor,
        nu: Tensor,
        particle_density: Tensor | None = None,
        density_change_mask: Tensor | None = None,
        static_pos: Tensor | None = None,
        device: Any = None,
        requires_grad: bool = True,
        extra_no_grad_steps: int = 0,
    ) -> Tensor:
        """Positions [P, 3] [m] after extra_no_grad_steps without gradients and num_substeps with them.

        Args:
            mpm_solver, mpm_state, mpm_model: written to.
            substep: not used.
            substep_size: dt [s].
            num_substeps: number of steps with gradients.
            init_pos, init_velocity: [P, 3] [m, m/s].
            E, nu: [], [1] or [P] [Pa].
            particle_density: [] or [P] [kg/m³]; None for that of the state.
            density_change_mask: particles [P] whose density changes; None for all.
            static_pos: positions [P, 3] [m] without deformation; None for init_pos.
            extra_no_grad_steps: number of steps before.
        """
        mpm_state.reset_state(init_pos if static_pos is None else static_pos, None, init_velocity, device=device)
        if static_pos is not None:
            mpm_solver.restart_and_compute_F_C(mpm_model, mpm_state, init_pos, device)
        result = MPMDifferentiableSimulationWCheckpoint.apply(
            *(mpm_solver, mpm_state, mpm_model, substep_size, num_substeps, mpm_state.particle_x),
            *(mpm_state.particle_v, mpm_state.particle_F_trial, mpm_state.particle_C, E, nu),
            *(particle_density, density_change_mask, device, requires_grad, extra_no_grad_steps),
        )
        return result[0]
