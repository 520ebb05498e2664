"""Conditions and methods that descendants of PhysGaussian's simulator have in addition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ...errors import check_like
from ...state.state import State, identity_deformation
from ...step.particle_operations import Hold, Push
from ..gradients import Numbers, check_fixed, refuse_grad, vector
from .condition_list import AT_REST, ConditionList
from .dialects import Dialect, code_of
from .exchange import Exchange
from .particles import release_times_in_boxes


class DescendantMethods(ConditionList, Exchange):
    """Methods of DreamPhysics, Physics3D, PhysFlow, MotionPhysics, NeoWorld, PIXIE and GaussianFluent."""

    dialect: Dialect
    parameters: dict[str, Any]
    n_particles: int

    # ---- DreamPhysics and its descendants

    def reset_pos_from_torch(
        self, tensor_x: Tensor, tensor_volume: Tensor, tensor_cov: Tensor | None = None, device: Any = None
    ) -> None:
        """Start again at time zero with other positions [P, 3] [m] and volumes [P] [m³]: at rest, undeformed and with
        the history of the material at its start. Parameters, masses and conditions stay.

        Raises:
            ValueError: for another number of particles.
        """
        state = self._flushed()
        x = tensor_x.to(state.x)
        check_like("tensor_x", x, state.x, (len(state), 3), "[P, 3]")
        volume = tensor_volume.to(state.x)
        check_like("tensor_volume", volume, state.x, (len(state),), "[P]")
        motion = torch.zeros(len(state), 3, 3, dtype=x.dtype, device=x.device)
        self._state = State(
            x=x, v=torch.zeros_like(x), mass=state.mass, volume=volume, C=motion, F=identity_deformation(x)
        )
        if tensor_cov is not None:
            self.assign_covariance(tensor_cov)

    # ---- Physics3D, PhysFlow, MotionPhysics

    def release_particles_sequentially_size(
        self,
        normal: Numbers,
        start_position: float,
        end_position: float,
        num_layers: int,
        start_time: float,
        end_time: float,
        size: Numbers,
        point: Numbers,
    ) -> None:
        """Hold the particles about `start_position` on an axis at rest, in a box of half edges `size` about `point` on
        the other axes: layer k of num_layers, up to k/num_layers of the distance to `end_position`, until (k +
        1)/num_layers of `end_time`.
        """
        places = {"start_position": start_position, "end_position": end_position, "num_layers": num_layers}
        times = {"start_time": start_time, "end_time": end_time}
        check_fixed("it selects particles", normal=normal, point=point, size=size, **places, **times)
        x = self._flushed().x
        ends = release_times_in_boxes(x, normal, start_position, end_position, int(num_layers), end_time, point, size)
        self._hold(Hold(AT_REST, start_time, ends))

    def add_impulse_on_particles_with_mask(
        self,
        force: Numbers,
        particle_mask: Tensor,
        start_time: float,
        end_time: float,
        point: Numbers = (1, 1, 1),
        size: Numbers = (1, 1, 1),
    ) -> None:
        """An acceleration `force` [m/s²] of the particles of a mask, integers or bool [P], from start_time to end_time.

        `point` and `size` are not used, as in MotionPhysics.
        """
        check_fixed("it is not used", point=point, size=size)
        self._acceleration(self._flushed().x, force, particle_mask, start_time, end_time)

    def add_constant_force(
        self, force: Numbers, point: Numbers, radius: float, start_time: float, end_time: float
    ) -> None:
        """An acceleration `force` [m/s²] of the particles within `radius` of a point."""
        check_fixed("it selects particles", point=point, radius=radius)
        x = self._flushed().x
        centre = torch.tensor([float(p) for p in point], dtype=x.dtype, device=x.device)
        self._acceleration(x, force, (x.detach() - centre).norm(dim=1) < radius, start_time, end_time)

    # ---- NeoWorld

    def tear_object(
        self,
        force: Numbers,
        dt: float,
        num_dt: int = 1,
        bbox: Sequence[Sequence[float]] | None = None,
        axis: int | None = None,
        start_time: float = 0.0,
        device: Any = None,
    ) -> None:
        """A force [N] on each particle of the object beyond the middle of bbox[axis] on that axis, and its opposite on
        those before it, for num_dt steps of dt. The object are the particles with `mpm_state.object_selection` 0.

        Raises:
            ValueError: without bbox and axis.
        """
        refuse_grad("it selects particles", bbox=bbox, axis=axis)
        if bbox is None or axis not in (0, 1, 2):
            raise ValueError(f"axis must be 0, 1 or 2, with bbox, got {axis!r} and {bbox!r}")
        check_fixed("it selects particles", dt=dt, num_dt=num_dt, start_time=start_time)
        state = self._flushed()
        middle = (float(bbox[axis][0]) + float(bbox[axis][1])) / 2
        along, of_object = state.x.detach()[:, axis], self._object() == 0
        given, end = vector("force", force, state.x), start_time + dt * num_dt
        opposite = -given if isinstance(given, Tensor) else tuple(-f for f in given)
        self._push(Push(given, start_time, end, of_object & (along > middle)))
        self._push(Push(opposite, start_time, end, of_object & (along < middle)))

    def add_impulse_on_object(
        self,
        force: Numbers,
        dt: float,
        point: Numbers = (1, 1, 1),
        size: Numbers = (1, 1, 1),
        num_dt: int = 1,
        start_time: float = 0.0,
        device: Any = None,
    ) -> None:
        """A force [N] on each particle with `mpm_state.object_selection` 0, for num_dt steps of dt.

        `point` and `size` are not used, as in NeoWorld.
        """
        check_fixed("it selects particles", dt=dt, num_dt=num_dt, start_time=start_time, point=point, size=size)
        x = self._flushed().x
        self._push(Push(vector("force", force, x), start_time, start_time + dt * num_dt, self._object() == 0))

    def enforce_scene_velocity_translation(
        self, velocity: Numbers, start_time: float, end_time: float, device: Any = None
    ) -> None:
        """Velocity of the particles with `mpm_state.object_selection` 1."""
        x = self._flushed().x
        self._translation_of("object_selection", self._object() == 1, x, velocity, start_time, end_time)

    def _object(self) -> Tensor:
        """`mpm_state.object_selection`."""
        result: Tensor = self.selection("object_selection")  # type: ignore[attr-defined]
        return result

    # ---- PIXIE, GaussianFluent

    def debug_particle_positions(self, step_name: str = "") -> bool:
        """Whether a particle is outside the domain; prints how many, and where."""
        x, extent = self._flushed().x.detach(), float(self.parameters["grid_lim"])
        outside = ((x < 0) | (x > extent)).any(1)
        if not bool(outside.any()):
            return False
        low, high = ([round(v, 4) for v in end.tolist()] for end in (x.amin(0), x.amax(0)))
        first = int(outside.nonzero()[0])
        print(
            f"[{step_name}] {int(outside.sum())} particles are outside of [0, {extent}]^3, the first is {first} at "
            f"{x[first].tolist()}; all are in {low} to {high}"
        )
        return True

    def material_2_num(self, material: str) -> int:
        """Number of a material of the dialect.

        Raises:
            TypeError: for an unknown material.
        """
        if material not in self.dialect.codes:
            raise TypeError(f"material must be one of {sorted(self.dialect.codes)}, got {material!r}")
        return code_of(self.dialect, material)

    def set_velocity_by_index(
        self,
        point: Numbers,
        size: Numbers,
        velocity: Numbers,
        start_time: float = 0.0,
        end_time: float = 999.0,
        reset: int = 0,
    ) -> None:
        """Raises: the method of GaussianFluent, whose kernel does not fit its launch, holds no known particles.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            "set_velocity_by_index has no index: its kernel in GaussianFluent raises an error at the first substep. "
            "Call enforce_particle_velocity_translation, or set mpm_state.particle_selection"
        )
