"""PhysGaussian's simulator (Xie et al. 2024): its class, on a `Step` of torch_mpm."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ...boundaries import Damping
from ...errors import check_count, check_flag, check_like, shape_of
from ...laws import Material
from ...state.state import State, identity_deformation
from ..clipping import ClippedRollout
from ..constitutive import lame
from ..gradients import Numbers, check_fixed, refuse_grad, vector
from ..keys import check_needed, checked_list
from ..selections import in_box
from .dialects import (
    PHYSGAUSSIAN,
    WITHOUT_EFFECT,
    Dialect,
    check_parameter_keys,
    code_of,
    dialect_of,
    recognised,
    report,
    warn_of_soft_solid,
)
from .law_choice import chosen_law
from .parameters import BOX, check_box, checked
from .substeps import Pending
from .views import ModelView, ParticleView, Viewed


class MPM_Simulator_WARP(Viewed):
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
        dialect: project whose units, keys, materials and defaults hold, see `DIALECTS`; None for PhysGaussian's, or
            those of the first parameters that only another project has.
        strict: whether nodes on the face of a surface or cuboid are compared in float32, as in PhysGaussian, so that
            rounding decides; otherwise they are outside.
    """

    def __init__(
        self,
        n_particles: int,
        n_grid: int = 100,
        grid_lim: float = 1.0,
        device: torch.device | str | None = None,
        *,
        dialect: str | None = None,
        strict: bool = False,
    ) -> None:
        check_count("n_particles", n_particles)
        if dialect is not None:
            _refuse_batches(dialect_of(dialect))
        self._prepare(dialect, strict)
        self.initialize(n_particles, n_grid, grid_lim, device)

    def _prepare(self, dialect: str | None, strict: bool) -> None:
        """Set everything that `initialize` keeps."""
        self._dialect: Dialect | None = None if dialect is None else dialect_of(dialect)
        if self._dialect is not None:
            report(self._dialect)
        self.strict = check_flag("strict", strict)
        self.time_profile: dict[str, list[float]] = {}
        self.mpm_state, self.mpm_model = ParticleView(self), ModelView(self)

    @property
    def dialect(self) -> Dialect:  # type: ignore[override]
        """Dialect of the parameters."""
        return PHYSGAUSSIAN if self._dialect is None else self._dialect

    def initialize(
        self, n_particles: int, n_grid: int = 100, grid_lim: float = 1.0, device: torch.device | str | None = None
    ) -> None:
        """Discard everything except the size of the grid and the dialect."""
        self.n_particles = n_particles
        size = {"n_grid": n_grid, "grid_lim": grid_lim}
        self.parameters: dict[str, Any] = {name: checked(name, value, torch.empty(0)) for name, value in size.items()}
        self._state: State | None = None
        self._step: ClippedRollout | None = None
        self._law: Material | None = None
        self._anchored = None
        self._moduli: dict[str, Any] | None = None  # E and nu of the last finalize_mu_lam.
        self._codes: Tensor | None = None
        self._selections: dict[str, Tensor] = {}
        self._covariance: Tensor | None = None
        self._exports: dict[str, Any] = {}
        self._damping: Damping | None = None
        self._clear_conditions()
        self._pending, self._versions = Pending(), {}

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
            tensor_x: positions [P, 3] [m] in [0, grid_lim], copied.
            tensor_volume: [P] [m³], copied.
            tensor_cov: covariance of a Gaussian on each particle, six numbers xx xy xz yy yz zz: [P, 6] or [6 P].
            n_grid, grid_lim, device: as for the class.

        Raises:
            ValueError: for other shapes, positions that are not finite, and volumes that are not positive and finite.
        """
        if not isinstance(tensor_x, Tensor) or tensor_x.dim() != 2 or tensor_x.shape[1] != 3:
            raise ValueError(f"tensor_x must have shape [P, 3], got {shape_of(tensor_x)}")
        self.initialize(len(tensor_x), n_grid, grid_lim)
        self._place(tensor_x.to(device=device, copy=True), tensor_volume, tensor_cov)

    def _place(self, x: Tensor, volume: Tensor, cov: Tensor | None) -> None:
        """Particles at rest at positions [P, 3] [m], with volumes [P] [m³]."""
        volume = volume.to(x, copy=True)
        check_like("tensor_volume", volume, x, (len(x),), "[P]")
        for name, given, good, expected in (
            ("tensor_x", x, x.detach().isfinite().all(1), "finite"),
            ("tensor_volume", volume, (volume.detach() > 0) & volume.detach().isfinite(), "positive and finite"),
        ):
            if not bool(good.all()):
                row = int((~good).nonzero()[0])
                raise ValueError(f"{name} must be {expected}, got {given[row].tolist()} in row {row}")
        motion = torch.zeros(len(x), 3, 3, dtype=x.dtype, device=x.device)
        self._state = State(
            x=x, v=torch.zeros_like(x), mass=0 * volume, volume=volume, C=motion, F=identity_deformation(x)
        )
        if cov is not None:
            self.assign_covariance(cov)

    def load_from_sampling(
        self, sampling_h5: str, n_grid: int = 100, grid_lim: float = 1.0, device: torch.device | str | None = None
    ) -> None:
        """Particles at rest of an HDF5 file with x [3, P] and particle_volume [1, P] (needs h5py)."""
        self.load_initial_data_from_torch(*sampled(sampling_h5), None, n_grid, grid_lim, device)

    # ---- parameters

    def set_parameters(self, device: torch.device | str | None = None, **kwargs: Any) -> None:
        """`set_parameters_dict` of keywords."""
        self.set_parameters_dict(kwargs)

    def set_parameters_dict(
        self, kwargs: Mapping[str, Any] | None = None, device: torch.device | str | None = None
    ) -> None:
        """Set material and numbers of the simulation; others are unchanged.

        Args:
            kwargs: material ("jelly", "metal", "sand", "foam", "plasticine", another one of the dialect, or a
                `torch_mpm.Material`), E [Pa], nu, density [kg/m³], yield_stress [Pa], xi, friction_angle [degrees],
                softening [Pa] and plastic_viscosity [Pa s] (numbers, or tensors [] or [P]), rpic_damping and
                grid_v_damping_scale (numbers, or tensors []), g (three numbers or a tensor [3] [m/s²]), hardening (1
                for on), n_grid, grid_lim, and additional_material_params: boxes with point, size, E, nu and density.
                Other keys and units are those of the dialect. All tensors but n_grid, grid_lim, hardening, point and
                size may require grad. pic_damping and opacity_threshold have no effect.

        E and nu act from the next `finalize_mu_lam` on.

        Raises:
            TypeError, ValueError: for an unknown key, a value of a wrong type, shape or range, a gradient that a value
                cannot have, or keys of several dialects.
        """
        given = dict(kwargs or {})
        state = self._flushed()
        extra = checked_list("additional_material_params", given.pop("additional_material_params", []))
        self._recognise(given, extra, getattr(kwargs, "dialect", None))
        check_parameter_keys(self.dialect, given)
        unused = {name: given.pop(name) for name in (*self.dialect.without_effect, *WITHOUT_EFFECT) if name in given}
        refuse_grad("it has no effect", **unused)
        offset = given.pop("spawn_offset", None)
        values = {name: checked(name, value, state.x) for name, value in given.items()}
        for name, value in values.items():
            warn_of_soft_solid(self.dialect, name, value)
        if "material" in values:
            self._codes, self._state = None, state.replace(material=None)
        self.parameters |= values
        for box in extra:
            self._set_in_box(self._loaded(), box)
        self._set_fields({*given, *(["density"] if extra else [])})
        if offset is not None:
            shift = vector("spawn_offset", offset, state.x)
            self._state = self._loaded().replace(x=state.x + torch.as_tensor(shift).to(state.x))
        scale = self.parameters.get("grid_v_damping_scale", 1.0)
        damps = isinstance(scale, Tensor) or scale < 1
        self._damping, self._law, self._step = Damping(scale) if damps else None, None, None

    def _recognise(self, given: Mapping[str, Any], boxes: list[Any], of_configuration: Dialect | None) -> None:
        """Choose the dialect by the first keys that PhysGaussian does not have, and report it."""
        if of_configuration is not None and self._dialect not in (None, of_configuration):
            raise ValueError(
                f"dialect must be that of the configuration, {of_configuration.name!r}, got {self.dialect.name!r}"
            )
        found = of_configuration
        if found is None and self._dialect is None:
            found = recognised(given, given.get("material"), boxes={key for box in boxes for key in box})
        if found is None or found is self._dialect:
            return
        _refuse_batches(found)
        before = [name for name in found.units if name in self.parameters]
        if before:
            raise ValueError(
                f"dialect must be given: {', '.join(before)} had been given in SI units, before keys of {found.project}"
            )
        signs = [key for key in given if key not in PHYSGAUSSIAN.known] or ["the configuration or material"]
        self._dialect = found
        report(found, signs)

    def _set_fields(self, names: set[str]) -> None:
        """Fields of the particles that follow from parameters."""
        state = self._loaded()
        if "density" in names:
            self._state = state = state.replace(mass=self._of_particles("density", state) * state.volume)
        history = {"yield_stress": "yield_stress", "alpha_0": "log_plastic_volume"}
        for name, field in history.items():
            if name in names and field in state.extra:
                value = self.dialect.effective(name, self._of_particles(name, state))
                self._state = state = state.replace(extra={**state.extra, field: value})

    def _set_in_box(self, state: State, box: Mapping[str, Any]) -> None:
        """E, nu, density and the material of the particles in a box."""
        what = "a box of additional_material_params"
        check_box(what, box, self.dialect)
        check_needed(what, box, BOX)
        check_fixed("it selects particles", point=box["point"], size=box["size"])
        inside = in_box(state.x, box["point"], box["size"])
        for name in ("E", "nu", "density"):
            value = torch.as_tensor(checked(name, box[name], state.x), dtype=state.x.dtype, device=state.x.device)
            self.parameters[name] = torch.where(inside, value, self._of_particles(name, state))
        if "material" in box:
            given = box["material"]
            if isinstance(given, str) and given not in self.dialect.materials:
                raise ValueError(f"material of a box must be one of {sorted(self.dialect.materials)}, got {given!r}")
            code = code_of(self.dialect, given) if isinstance(given, str) else int(given)
            self.assign_material_codes(torch.where(inside, code, self.material_codes()))

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
        self._law = self._step = None
        chosen_law(self.dialect, self.parameters | self._moduli, self._codes)

    def finalize_mu_lam_bulk(self, device: torch.device | str | None = None) -> None:
        """`finalize_mu_lam`, and the bulk modulus of fluids from E and nu, in place of `bulk_modulus`.

        Raises:
            TypeError, ValueError: as `finalize_mu_lam`.
        """
        self._flushed()
        if "bulk_modulus" in self.parameters and not self._bulk_follows:
            warnings.warn(
                "finalize_mu_lam_bulk sets the bulk modulus by E and nu, as in warp-mpm: bulk_modulus has no effect",
                stacklevel=2,
            )
        self._bulk_follows = True
        missing = [name for name in ("E", "nu") if name not in self.parameters]
        if missing:
            raise ValueError(f"finalize_mu_lam_bulk needs E and nu: give {missing[0]} in set_parameters_dict")
        mu, lam = lame(self.dialect.si("E", self.parameters["E"]), self.parameters["nu"])
        self.parameters["bulk_modulus"] = lam + 2 / 3 * mu
        self.finalize_mu_lam()

    _bulk_follows = False

    def set_E_nu(self, E: float | Tensor, nu: float | Tensor, device: torch.device | str | None = None) -> None:
        """E in units of the dialect, and nu: numbers, or tensors [] or [P], from the next `finalize_mu_lam` on."""
        self.set_parameters_dict({"E": E, "nu": nu})

    set_E_nu_from_torch = set_E_nu

    def reset_densities_and_update_masses(
        self, all_particle_densities: Tensor, device: torch.device | str | None = None
    ) -> None:
        """Density of each particle [P] [kg/m³]."""
        self.set_parameters_dict({"density": all_particle_densities})

    # ---- conditions on particles, selected by their present positions

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
        self._impulse(self._flushed().x, force, dt, point, size, num_dt, start_time)

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
        self._translation(self._flushed().x, point, size, velocity, start_time, end_time)

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
        scales = rotation_scale, translation_scale
        self._rotation(self._flushed().x, point, normal, half_height_and_radius, scales, start_time, end_time)

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
        `end_position` last. There are 50 layers, for any num_layers, as in the original simulator; in PhysFlow and
        MotionPhysics num_layers.
        """
        layers = num_layers, num_layers if self.dialect.layers is None else self.dialect.layers
        self._release(self._flushed().x, normal, (start_position, end_position), layers, start_time, end_time)


def _refuse_batches(dialect: Dialect) -> None:
    """Refuse the dialect whose simulator has batches."""
    if dialect.name == "kywind":
        raise ValueError("dialect must not be 'kywind', whose dx and batches need BatchedSimulator(batch_size=, dx=)")


def sampled(file_h5: str) -> tuple[Tensor, Tensor]:
    """Positions [P, 3] [m] and volumes [P] [m³] of an HDF5 file, float32."""
    import h5py

    with h5py.File(file_h5, "r") as file:
        x, volume = (torch.as_tensor(file[name][()], dtype=torch.float32) for name in ("x", "particle_volume"))
    return x.T.contiguous(), volume.reshape(-1)
