"""Conditions on particles of `MPMWARPDiff`, which are selected by the positions of a state."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...grid.grid import Grid
from ...ops import g2p, p2g
from ..gradients import Numbers, check_fixed
from ..physgaussian.condition_list import ConditionList
from ..selections import chosen, in_box
from .mpm_data_structure import MPMModelStruct, MPMStateStruct


class ParticleConditions(ConditionList):
    """Conditions on particles, with the state as first argument."""

    def add_impulse_on_particles(
        self,
        mpm_state: MPMStateStruct,
        force: Numbers,
        dt: float,
        point: Numbers = (1, 1, 1),
        size: Numbers = (1, 1, 1),
        num_dt: int = 1,
        start_time: float = 0.0,
        device: Any = None,
    ) -> None:
        """A force [N] on each particle that is now in a box of half edges `size`, for num_dt steps of dt."""
        self._impulse(mpm_state.particle_x, force, dt, point, size, num_dt, start_time)

    def add_impulse_on_particles_with_mask(
        self,
        mpm_state: MPMStateStruct,
        force: Numbers,
        dt: float,
        particle_mask: Tensor,
        point: Numbers = (1, 1, 1),
        size: Numbers = (1, 1, 1),
        end_time: float = 1,
        start_time: float = 0.0,
        device: Any = None,
    ) -> None:
        """An acceleration `force` [m/s²] of the particles of a mask, integers or bool [P], that are now in a box of
        half edges `size`, from start_time to end_time. `dt` is not used.
        """
        check_fixed("it selects particles", dt=dt, point=point, size=size)
        x = mpm_state.particle_x
        mask = chosen("particle_mask", particle_mask, x) & in_box(x, point, size)
        self._acceleration(x, force, mask, start_time, end_time)

    def enforce_particle_velocity_translation(
        self,
        mpm_state: MPMStateStruct,
        point: Numbers,
        size: Numbers,
        velocity: Numbers,
        start_time: float,
        end_time: float,
        device: Any = None,
    ) -> None:
        """Velocity of the particles that are now in a box of half edges `size`."""
        self._translation(mpm_state.particle_x, point, size, velocity, start_time, end_time)

    def enforce_particle_velocity_rotation(
        self,
        mpm_state: MPMStateStruct,
        point: Numbers,
        normal: Numbers,
        half_height_and_radius: Numbers,
        rotation_scale: float,
        translation_scale: float,
        start_time: float,
        end_time: float,
        device: Any = None,
    ) -> None:
        """Rotate the particles that are now in a cylinder about its axis, at −rotation_scale [rad/s] about `normal`,
        and move them along it at translation_scale [m/s].
        """
        x, scales = mpm_state.particle_x, (rotation_scale, translation_scale)
        self._rotation(x, point, normal, half_height_and_radius, scales, start_time, end_time)

    def enforce_particle_velocity_by_mask(
        self,
        mpm_state: MPMStateStruct,
        selection_mask: Tensor,
        velocity: Numbers,
        start_time: float,
        end_time: float,
    ) -> None:
        """Velocity of the particles of a mask, integers or bool [P]."""
        x = mpm_state.particle_x
        self._translation_of("selection_mask", selection_mask, x, velocity, start_time, end_time)

    def release_particles_sequentially(self, *arguments: Any, **keywords: Any) -> None:
        """Raises: the method of warp_mpm passes no state on, and ends in an error there too.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            "release_particles_sequentially of warp_mpm has no state to select particles from: call "
            "enforce_particle_velocity_by_mask for each layer"
        )

    def restart_and_compute_F_C(
        self, mpm_model: MPMModelStruct, mpm_state: MPMStateStruct, target_pos: Tensor, device: Any = None
    ) -> None:
        """Move particles to other positions [P, 3] [m], with the deformation gradient 1 + ∇u of their displacements u,
        which the grid interpolates. Velocities and affine fields stay.
        """
        x, mass = mpm_state.particle_x, mpm_state.particle_mass
        target = target_pos.to(x)
        if target.shape != x.shape:
            raise ValueError(f"target_pos must have shape {list(x.shape)}, got {list(target.shape)}")
        grid = Grid(mpm_model.dx, (0.0,) * 3, (mpm_model.grid_lim,) * 3)
        blocks = grid.activate(x)
        zero = torch.zeros(len(x), 3, 3, dtype=x.dtype, device=x.device)
        nodes = p2g(blocks, x, mass, target - x, None, zero, mpm_state.particle_vol, 1.0, "gradient")
        weight = nodes[:, :1]
        u = torch.where(weight > 0, nodes[:, 1:] / torch.where(weight > 0, weight, 1), 0)
        gradient = g2p(blocks, x, u, affine=False, gradient=True)[2]
        assert gradient is not None
        mpm_state.particle_F_trial = gradient + torch.eye(3, dtype=x.dtype, device=x.device)
        mpm_state.particle_x, mpm_state.history = target, {}
