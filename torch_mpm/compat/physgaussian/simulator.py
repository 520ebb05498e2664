"""PhysGaussian's simulator (Xie et al. 2024): its class, on a `Step` of torch_mpm."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ...boundaries import Obstacle
from ...errors import check_count, check_like, check_number, shape_of
from ...grid.grid import Grid
from ...laws import Material
from ...rollouts import rollout
from ...state.state import State, identity_deformation
from ...step.particle_operations import Hold, Operations, Push, Timed
from ...step.step import Step
from ..gradients import Numbers, check_fixed, vector
from ..keys import check_keys, check_needed, checked_list
from ..node_conditions import FreezeOutside, NodeDamping, moving_cuboid, outer_planes, stopping_plane, surface_margin
from ..selections import Rotation, in_box, in_cylinder
from .exchange import Exchange
from .materials import law_of
from .parameters import BOX, BOX_UNSUPPORTED, KNOWN, UNSUPPORTED, WITHOUT_EFFECT, checked
from .particles import DampedAffine, WithoutAffine, release_times
from .surfaces import Cut

PADDING = 3
"""Nodes at each face of the domain on which a bounding box acts."""
RESET_STEPS = 15
"""Number of steps for which a cuboid with `reset` holds all nodes after its end."""
FOREVER = 999.0


class MPM_Simulator_WARP(Exchange):
    """Explicit MPM on the cube [0, grid_lim]³ with forces by the gradient of quadratic B-splines and APIC.

    Substeps requested by `p2g2p` are computed together when something is read or changed, in one op where possible.
    Gradients pass from the exports to the given tensors: positions, velocities, parameters, forces and velocities of
    conditions. An argument that has no gradient, such as the size of a box, must not require grad. Tensors keep their
    dtype, float32 or float64, and their device.

    Args:
        n_particles: not used before data are loaded.
        n_grid: cells along each axis.
        grid_lim: edge of the domain [m].
        device: None for that of the data.
    """

    def __init__(
        self, n_particles: int, n_grid: int = 100, grid_lim: float = 1.0, device: torch.device | str | None = None
    ) -> None:
        check_count("n_particles", n_particles)
        self.initialize(n_particles, n_grid, grid_lim, device)

    def initialize(
        self, n_particles: int, n_grid: int = 100, grid_lim: float = 1.0, device: torch.device | str | None = None
    ) -> None:
        """Discard everything except the size of the grid."""
        self.n_particles = n_particles
        size = {"n_grid": n_grid, "grid_lim": grid_lim}
        self.parameters: dict[str, Any] = {name: checked(name, value, torch.empty(0)) for name, value in size.items()}
        self._state: State | None = None
        self._step: Step | None = None
        self._law: Material | None = None
        self._moduli: dict[str, Any] | None = None  # E and nu of the last finalize_mu_lam.
        self._covariance: Tensor | None = None
        self._damping: NodeDamping | None = None
        self._nodes: list[Any] = []
        self._acting: list[Any] = []
        self._pushes: list[Any] = []
        self._holds: list[Any] = []
        self._queue: list[Any] = [0, 0.0, True]  # Substeps, dt, whether gradients are needed.

    # ---- data

    def load_initial_data_from_torch(
        self,
        tensor_x: Tensor,
        tensor_volume: Tensor,
        tensor_cov: Tensor | None = None,
        n_grid: int = 100,
        grid_lim: float = 1.0,
        device: torch.device | str | None = None,
    ) -> None:
        """Particles at rest, and a new simulation.

        Args:
            tensor_x: positions [P, 3] [m] in [0, grid_lim].
            tensor_volume: [P] [m³].
            tensor_cov: covariance of a Gaussian on each particle, six numbers xx xy xz yy yz zz: [P, 6] or [6 P].
            n_grid, grid_lim, device: as for the class.
        """
        if not isinstance(tensor_x, Tensor) or tensor_x.dim() != 2 or tensor_x.shape[1] != 3:
            raise ValueError(f"tensor_x must have shape [P, 3], got {shape_of(tensor_x)}")
        self.initialize(len(tensor_x), n_grid, grid_lim)
        x = tensor_x.to(device=device)
        volume = tensor_volume.to(x)
        check_like("tensor_volume", volume, x, (len(x),), "[P]")
        motion = torch.zeros(len(x), 3, 3, dtype=x.dtype, device=x.device)
        self._state = State(
            x=x, v=torch.zeros_like(x), mass=0 * volume, volume=volume, C=motion, F=identity_deformation(x)
        )
        if tensor_cov is not None:
            self._covariance = tensor_cov.to(x).reshape(-1, 6)
            check_like("tensor_cov", self._covariance, x, (len(x), 6), "[P, 6]")

    def load_from_sampling(
        self, sampling_h5: str, n_grid: int = 100, grid_lim: float = 1.0, device: torch.device | str | None = None
    ) -> None:
        """Particles at rest of an HDF5 file with x [3, P] and particle_volume [1, P] (needs h5py)."""
        import h5py

        with h5py.File(sampling_h5, "r") as file:
            x, volume = (torch.as_tensor(file[name][()], dtype=torch.float32) for name in ("x", "particle_volume"))
        self.load_initial_data_from_torch(x.T.contiguous(), volume.reshape(-1), None, n_grid, grid_lim, device)

    def set_parameters(self, device: torch.device | str | None = None, **kwargs: Any) -> None:
        """`set_parameters_dict` of keywords."""
        self.set_parameters_dict(kwargs)

    def set_parameters_dict(
        self, kwargs: Mapping[str, Any] | None = None, device: torch.device | str | None = None
    ) -> None:
        """Set material and numbers of the simulation; others are unchanged.

        Args:
            kwargs: material ("jelly", "metal", "sand", "foam", "plasticine", or a `torch_mpm.Material`), E [Pa], nu,
                density [kg/m³], yield_stress [Pa], xi, friction_angle [degrees], softening [Pa] and plastic_viscosity
                [Pa s] (numbers, or tensors [] or [P]), rpic_damping and grid_v_damping_scale (numbers, or tensors []),
                g (three numbers or a tensor [3] [m/s²]), hardening (1 for on), n_grid, grid_lim, and
                additional_material_params: boxes with point, size, E, nu and density. All tensors but n_grid, grid_lim,
                hardening, point and size may require grad. pic_damping and opacity_threshold have no effect.

        E and nu act from the next `finalize_mu_lam` on.

        Raises:
            TypeError, ValueError: for an unknown key, a value of a wrong type, shape or range, or a gradient that a
                value cannot have.
        """
        given = dict(kwargs or {})
        state = self._flushed()
        check_keys("set_parameters_dict", given, (*KNOWN, *WITHOUT_EFFECT), UNSUPPORTED)
        extra = checked_list("additional_material_params", given.pop("additional_material_params", []))
        self.parameters |= {name: checked(name, value, state.x) for name, value in given.items()}
        for box in extra:
            self._set_in_box(state, box)
        if extra or "density" in given:
            self._state = state.replace(mass=self._of_particles("density", state) * state.volume)
        if "yield_stress" in given and "yield_stress" in state.extra:
            limit = self._of_particles("yield_stress", state)
            self._state = self._loaded().replace(extra={**state.extra, "yield_stress": limit})
        scale = self.parameters.get("grid_v_damping_scale", 1.0)
        damps = isinstance(scale, Tensor) or scale < 1
        self._damping, self._law, self._step = NodeDamping(scale) if damps else None, None, None

    def _set_in_box(self, state: State, box: Mapping[str, Any]) -> None:
        """E, nu and density of the particles in a box."""
        what = "a box of additional_material_params"
        check_keys(what, box, BOX, BOX_UNSUPPORTED)
        check_needed(what, box, BOX)
        check_fixed("it selects particles", point=box["point"], size=box["size"])
        inside = in_box(state.x, box["point"], box["size"])
        for name in ("E", "nu", "density"):
            value = torch.as_tensor(checked(name, box[name], state.x), dtype=state.x.dtype, device=state.x.device)
            self.parameters[name] = torch.where(inside, value, self._of_particles(name, state))

    def _of_particles(self, name: str, state: State) -> Tensor:
        """A parameter [P]."""
        if name not in self.parameters:
            raise ValueError(f"{name} of all particles must be given before that of particles in a box")
        value = torch.as_tensor(self.parameters[name], dtype=state.x.dtype, device=state.x.device)
        return value.expand(len(state))

    def finalize_mu_lam(self, device: torch.device | str | None = None) -> None:
        """Create the material with the present E and nu.

        Raises:
            TypeError, ValueError: for a material that is unknown, or that lacks a parameter.
        """
        self._flushed()
        self._moduli = {name: self.parameters[name] for name in ("E", "nu") if name in self.parameters}
        self._law, self._step = law_of(self.parameters), None

    def reset_densities_and_update_masses(
        self, all_particle_densities: Tensor, device: torch.device | str | None = None
    ) -> None:
        """Density of each particle [P] [kg/m³]."""
        self.set_parameters_dict({"density": all_particle_densities})

    # ---- what acts on nodes and particles

    def add_surface_collider(
        self,
        point: Numbers,
        normal: Numbers,
        surface: str = "sticky",
        friction: float = 0.0,
        start_time: float = 0.0,
        end_time: float = FOREVER,
    ) -> None:
        """Stop the nodes behind a plane, for any `surface`, as the original simulator does.

        A surface that slips, separates or has friction is `add_boundary(torch_mpm.Plane(...))`. "cut" is specific to
        that simulator, with fixed heights.
        """
        check_fixed("it selects nodes", point=point, normal=normal, start_time=start_time, end_time=end_time)
        check_fixed("it has no effect", friction=friction)
        if surface == "sticky" and friction != 0:
            raise ValueError(f"friction must be 0 on sticky surfaces, got {friction}")
        if surface == "cut":
            self.add_boundary(Cut(point, normal, self._margin, start_time, end_time))
            return
        if surface != "sticky":
            warnings.warn(
                f"a surface collider stops the nodes behind it, as in PhysGaussian, also with surface={surface!r}: for "
                "one that slips or separates call add_boundary(torch_mpm.Plane(point, normal, kind, friction))",
                stacklevel=2,
            )
        self.add_boundary(stopping_plane(point, normal, self._margin, start_time, end_time))

    def set_velocity_on_cuboid(
        self,
        point: Numbers,
        size: Numbers,
        velocity: Numbers,
        start_time: float = 0.0,
        end_time: float = FOREVER,
        reset: int = 0,
    ) -> None:
        """Velocity of the nodes in a box of half edges `size`, which moves with it from `start_time` on.

        With `reset` 1 all nodes of the grid are at rest before `start_time`, and for 15 steps after `end_time`.
        """
        check_fixed("it selects nodes", point=point, size=size, start_time=start_time, end_time=end_time)
        moving = vector("velocity", velocity, self._flushed().x)
        self.add_boundary(moving_cuboid(point, size, moving, self._margin, start_time, end_time))
        if reset == 1:
            self.add_boundary(FreezeOutside(start_time, end_time, RESET_STEPS))

    def add_bounding_box(self, start_time: float = 0.0, end_time: float = FOREVER) -> None:
        """Close the domain: no node within 3 of a face moves outwards."""
        check_fixed("it selects nodes", start_time=start_time, end_time=end_time)
        n, dx = self.parameters["n_grid"], self._dx
        for plane in outer_planes((PADDING - 1) * dx, (n - PADDING) * dx, 3, start_time, end_time):
            self.add_boundary(plane)

    def add_boundary(self, boundary: Any) -> None:
        """Append an object with the interface of `torch_mpm.boundaries`."""
        self._flush()
        self._nodes.append(boundary)

    def add_impulse_on_particles(
        self,
        force: Numbers,
        dt: float,
        point: Numbers = (1, 1, 1),
        size: Numbers = (1, 1, 1),
        num_dt: int = 1,
        start_time: float = 0.0,
        device: torch.device | str | None = None,
    ) -> None:
        """A force [N] on each particle that is now in a box of half edges `size`, for num_dt steps of dt."""
        check_fixed("it selects particles", dt=dt, point=point, size=size, num_dt=num_dt, start_time=start_time)
        x = self._flushed().x
        inside = in_box(x, point, size)
        self._pushes.append(Push(vector("force", force, x), start_time, start_time + dt * num_dt, inside))
        self._step = None

    def enforce_particle_velocity_translation(
        self,
        point: Numbers,
        size: Numbers,
        velocity: Numbers,
        start_time: float,
        end_time: float,
        device: torch.device | str | None = None,
    ) -> None:
        """Velocity of the particles that are now in a box of half edges `size`."""
        check_fixed("it selects particles", point=point, size=size, start_time=start_time, end_time=end_time)
        x = self._flushed().x
        self._hold(Hold(vector("velocity", velocity, x), start_time, end_time, in_box(x, point, size)))

    def enforce_particle_velocity_rotation(
        self,
        point: Numbers,
        normal: Numbers,
        half_height_and_radius: Numbers,
        rotation_scale: float,
        translation_scale: float,
        start_time: float,
        end_time: float,
        device: torch.device | str | None = None,
    ) -> None:
        """Rotate the particles that are now in a cylinder about its axis, at −rotation_scale [rad/s] about `normal`,
        and move them along it at translation_scale [m/s].
        """
        selecting = {"half_height_and_radius": half_height_and_radius, "start_time": start_time, "end_time": end_time}
        check_fixed("it selects particles", **selecting)
        x = self._flushed().x
        point, normal = vector("point", point, x), vector("normal", normal, x)
        inside = in_cylinder(x, point, normal, half_height_and_radius)
        self._hold(Rotation(point, normal, rotation_scale, translation_scale, start_time, end_time, inside))

    def release_particles_sequentially(
        self,
        normal: Numbers,
        start_position: float,
        end_position: float,
        num_layers: int,
        start_time: float,
        end_time: float,
    ) -> None:
        """Hold the particles between two positions on an axis at rest, and release them layer by layer, those at
        `end_position` last. There are 50 layers, for any num_layers, as in the original simulator.
        """
        times = {"start_time": start_time, "end_time": end_time, "num_layers": num_layers}
        check_fixed(
            "it selects particles", normal=normal, start_position=start_position, end_position=end_position, **times
        )
        x = self._flushed().x
        self._hold(Hold((0.0, 0.0, 0.0), start_time, release_times(x, normal, start_position, end_position, end_time)))

    def _hold(self, operation: Any) -> None:
        self._holds.append(operation)
        self._step = None

    # ---- time

    @property
    def time(self) -> float:
        """[s]"""
        steps, dt, _ = self._queue
        return self._start_time + steps * dt

    @property
    def _start_time(self) -> float:
        return 0.0 if self._state is None else float(self._state.time)

    def p2g2p(self, step: int, dt: float, device: torch.device | str | None = None) -> None:
        """A substep of dt [s]; `step` is not used."""
        check_number("dt", dt, "positive", lambda v: v > 0)
        grad = torch.is_grad_enabled()
        if self._queue[1:] != [dt, grad]:
            self._flush()
            self._check_ready()
            self._queue[1:] = [dt, grad]
        self._queue[0] += 1

    def _check_ready(self) -> None:
        self._loaded()
        if self._moduli is None:
            raise ValueError("the material is not known: call set_parameters_dict and finalize_mu_lam before p2g2p")
        if self._law is None:
            self._law = law_of(self.parameters | self._moduli)
        if "density" not in self.parameters:
            raise ValueError("the particles have no mass: give density in set_parameters_dict")

    def _flush(self) -> None:
        """Compute the pending substeps."""
        (steps, dt, grad), self._queue = self._queue, [0, 0.0, True]
        if steps == 0:
            return
        with torch.set_grad_enabled(grad):
            first = self._start_time
            step = self._ready_step(first, first + (steps - 1) * dt, dt)
            self._state = rollout(step, self._loaded(), steps, dt)

    @property
    def step(self) -> Step:
        """Step of torch_mpm of the substeps; `simulator.step.check()` reports errors."""
        self._flushed()
        self._check_ready()
        return self._ready_step(self._start_time, math.inf, 0.0)

    def _ready_step(self, first: float, last: float, dt: float) -> Step:
        """Step with the conditions that are active at times from `first` to `last`."""
        acting = [b for b in self._nodes if _acts(b, first, last, dt)]
        if self._damping is not None:
            acting.insert(0, self._damping)
        if self._step is None:
            self._step, self._acting = self._made_step(), []
        if acting != self._acting:
            self._step.boundaries = self._acting = acting  # type: ignore[assignment]
        return self._step

    def _made_step(self) -> Step:
        assert self._law is not None
        operations = [*self._pushes, *self._holds, *_affine(self.parameters.get("rpic_damping", 0.0))]
        return Step(
            Grid(self._dx, (0.0,) * 3, (float(self.parameters["grid_lim"]),) * 3),
            self._law,
            gravity=self.parameters.get("g"),
            stress_form="gradient",
            on_particles=Operations(operations) if operations else None,
        )

    @property
    def _margin(self) -> float:
        return surface_margin(self._loaded().x.dtype, float(self.parameters["grid_lim"]))

    @property
    def _dx(self) -> float:
        return float(self.parameters["grid_lim"]) / int(self.parameters["n_grid"])


def _affine(damping: float | Tensor) -> list[Timed]:
    """Operation of `rpic_damping` on C."""
    if isinstance(damping, Tensor) and damping.requires_grad:
        return [DampedAffine(damping)]
    share = float(damping)
    return [] if share == 0 else [WithoutAffine() if share < 0 else DampedAffine(share)]


def _acts(boundary: Any, first: float, last: float, dt: float) -> bool:
    """Whether a condition on the nodes is active at a time from `first` to `last`."""
    if isinstance(boundary, Obstacle):
        return boundary.start <= last and first < boundary.end
    return boundary.acts_within(first, last, dt) if isinstance(boundary, FreezeOutside) else True
