"""`mpm_state` and `mpm_model` of PhysGaussian's simulator, as views with torch tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...errors import shape_of
from ...ops.sand import friction_alpha
from ..constitutive import engineering, lame
from ..keys import nearest
from ..selections import chosen
from .dialects import code_of, material_of
from .exchange import ARRAYS
from .substeps import Substeps

if TYPE_CHECKING:
    from .simulator import MPM_Simulator_WARP

GRIDS = ("grid_m", "grid_v_in", "grid_v_out")


class _View:
    """Named values of a simulator.

    A tensor that requires grad and is a result of steps keeps its gradient in `.grad`.
    """

    _names: tuple[str, ...] = ()
    _simulator: MPM_Simulator_WARP

    def __init__(self, simulator: MPM_Simulator_WARP) -> None:
        object.__setattr__(self, "_simulator", simulator)

    def __dir__(self) -> list[str]:
        return sorted(self._names)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name not in self._names:
            raise AttributeError(self._unknown(name))
        value = self._read(name)
        if isinstance(value, Tensor) and value.requires_grad and not value.is_leaf:
            value.retain_grad()
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._names:
            raise AttributeError(self._unknown(name))
        self._write(name, value)

    def _unknown(self, name: str) -> str:
        if name in GRIDS:
            return f"{name} is not stored: nodes exist only within a step; use add_boundary, or a Step with on_grid"
        close = nearest(name, self._names)
        return f"{type(self).__name__} has no {name!r}, the nearest known name is {close!r}"

    def _read(self, name: str) -> Any:
        raise NotImplementedError

    def _write(self, name: str, value: Any) -> None:
        raise NotImplementedError


class ParticleView(_View):
    """Arrays of the particles, `mpm_state`.

    particle_x and particle_v [P, 3], particle_F, particle_F_trial and particle_C [P, 3, 3], particle_vol, particle_mass
    and particle_density [P], particle_init_cov [6 P], particle_Jp [P], particle_material, particle_selection and
    object_selection int32 [P]; read only are particle_cov [6 P], particle_R [P, 3, 3] (transposed, as exported) and
    particle_stress [P, 3, 3] [Pa].
    """

    _names = (
        *ARRAYS, "particle_density", "particle_init_cov", "particle_cov", "particle_R", "particle_stress",
        "particle_Jp", "particle_material", "particle_selection", "object_selection",
    )  # fmt: skip

    def _read(self, name: str) -> Any:
        one = self._simulator
        state = one.state
        if name in ARRAYS:
            return one.shaped(getattr(state, ARRAYS[name]))
        if name == "particle_density":
            return one.per_particle("density")
        if name == "particle_init_cov":
            return one.initial_covariance().reshape(-1)
        if name == "particle_Jp":
            start = one.parameter("alpha_0") if "alpha_0" in one.dialect.keys else 0.0
            return state.extra.get("log_plastic_volume", torch.zeros_like(state.mass) + start)
        if name == "particle_material":
            return one.material_codes()
        if name in ("particle_selection", "object_selection"):
            return one.selection(name)
        return one.exported(name)

    def _write(self, name: str, value: Any) -> None:
        one = self._simulator
        state = one.state
        if name in ("particle_x", "particle_v", "particle_F", "particle_C"):
            getattr(one, f"import_particle_{name[-1]}_from_torch")(value)
        elif name == "particle_F_trial":
            one.import_particle_F_from_torch(value)
        elif name in ("particle_vol", "particle_mass"):
            one.state = state.replace(**{ARRAYS[name]: _column(name, value, state.x)})
        elif name == "particle_density":
            one.reset_densities_and_update_masses(value)
        elif name == "particle_init_cov":
            one.assign_covariance(value)
        elif name == "particle_Jp":
            extra = {**state.extra, "log_plastic_volume": _column(name, value, state.x)}
            one.state = state.replace(extra=extra)
        elif name == "particle_material":
            one.assign_material_codes(value)
        elif name in ("particle_selection", "object_selection"):
            chosen(name, value, state.x)
            one.assign_selection(name, value)
        else:
            raise AttributeError(f"{name} is a result of the simulation, and cannot be assigned")


class ModelView(_View):
    """Material and numbers of the simulation, `mpm_model`.

    Parameters are in the units of the dialect. E, nu, yield_stress and others of the dialect are [P]. Those in
    `NUMBERS` are numbers unless tensors were given. mu, lam and bulk [P] [Pa] are those of the last `finalize_mu_lam`;
    an assigned one acts from then on, E and nu from the next `finalize_mu_lam`. Tensors may be written to in place, but
    for mu, lam, bulk, and a yield stress that has flowed in units that are not Pa, which have to be assigned.
    """

    NUMBERS = (
        *("friction_angle", "plastic_viscosity", "softening", "hardening", "xi", "rpic_damping"),
        "grid_v_damping_scale",
    )
    ARRAYS_OF_PARAMETERS = ("E", "nu", "yield_stress", "mu_N", "lam_N", "viscosity", "beta")
    SIZES = (
        *("n_grid", "grid_lim", "dx", "inv_dx", "grid_dim_x", "grid_dim_y", "grid_dim_z", "n_particles", "batch_size"),
        *("n_grid_x", "n_grid_y", "n_grid_z", "grid_lim_x", "grid_lim_y", "grid_lim_z"),
    )
    _names = (
        *ARRAYS_OF_PARAMETERS, *NUMBERS, *SIZES, "mu", "lam", "bulk", "kappa", "alpha", "material",
        "gravitational_accelaration", "update_cov_with_F",
    )  # fmt: skip

    def _read(self, name: str) -> Any:
        one = self._simulator
        parameters = one.parameters
        if name in self.SIZES:
            sizes = one.sizes()
            if name not in sizes:
                raise AttributeError(f"{name} must be one of {sorted(sizes)} here")
            return sizes[name]
        if name == "material":
            return one.material_number()
        if name in ("mu", "lam", "bulk", "kappa"):
            return one.modulus(name)
        if name == "gravitational_accelaration":
            return parameters.get("g", (0.0, 0.0, 0.0))
        if name == "update_cov_with_F":
            return False
        if name == "alpha":
            angle = torch.as_tensor(one.parameter("friction_angle"), dtype=torch.float64)
            return friction_alpha(torch.deg2rad(angle), 3)
        return one.per_particle(name) if name in self.ARRAYS_OF_PARAMETERS else one.parameter(name)

    def _write(self, name: str, value: Any) -> None:
        one = self._simulator
        if name in ("mu", "lam", "bulk"):
            one.assign_modulus(name, value)
        elif name == "material":
            one.assign_material_number(value)
        elif name == "gravitational_accelaration":
            one.set_parameters_dict({"g": value})
        elif name in (*self.ARRAYS_OF_PARAMETERS, *self.NUMBERS, "n_grid", "grid_lim"):
            one.set_parameters_dict({name: value})
        else:
            raise AttributeError(f"{name} follows from other values, and cannot be assigned")


class Viewed(Substeps):
    """Values of a simulator as its views read and write them."""

    def set_parameters_dict(self, kwargs: Mapping[str, Any] | None = None, device: Any = None) -> None:
        """Set material and numbers of the simulation."""
        raise NotImplementedError

    def shaped(self, rows: Any) -> Any:
        """A tensor [P, ...] as the simulator returns it."""
        return rows

    def sizes(self) -> dict[str, Any]:
        """Sizes of the grid: n_grid, grid_lim [m], dx [m] and others."""
        n, extent = self.parameters["n_grid"], self.parameters["grid_lim"]
        sizes = {"n_grid": n, "grid_lim": extent, "dx": extent / n, "inv_dx": n / extent}
        return {**sizes, **{f"grid_dim_{axis}": n for axis in "xyz"}, "n_particles": self.n_particles}

    def parameter(self, name: str) -> Any:
        """A parameter in units of the dialect, or its default."""
        defaults = {"friction_angle": 25.0, "softening": 0.1, "grid_v_damping_scale": 1.1, **self.dialect.defaults}
        return self.parameters.get(name, defaults.get(name, 0.0))

    def per_particle(self, name: str) -> Tensor:
        """A parameter in units of the dialect, [P], or the tensor that was given for it.

        A number becomes a tensor that the simulator reads from then on, so that it may be written to.
        """
        state = self.state
        if name == "yield_stress" and name in state.extra:
            unit = self.dialect.effective(name, 1.0)
            return state.extra[name] if unit == 1 else state.extra[name] / unit
        value = self.parameters.get(name, 0.0)
        if not isinstance(value, Tensor):
            value = torch.full_like(state.mass, float(value))
            if name in self.parameters:
                self.parameters[name] = value
                if self._moduli is not None and name in self._moduli:
                    self._moduli[name] = value
                self._law = self._step = None
        return value

    def modulus(self, name: str) -> Tensor:
        """mu, lam or bulk [P] [Pa]."""
        state = self.state
        own = {"bulk": "bulk" if "bulk" in self.dialect.keys else "bulk_modulus"}.get(name, name)
        if own in self.parameters:
            return self.per_particle(own)
        zero = torch.zeros_like(state.mass)
        if self._moduli is None or "E" not in self._moduli:
            return zero
        mu, lam = lame(self.dialect.si("E", self._moduli["E"]), self._moduli["nu"])
        value = {"mu": mu, "lam": lam}.get(name)
        value = lam + 2 / 3 * mu if value is None else value
        return value + zero

    def assign_modulus(self, name: str, value: Any) -> None:
        """Set mu or lam [Pa], or bulk in units of the dialect."""
        state = self.state
        own = {"bulk": "bulk" if "bulk" in self.dialect.keys else "bulk_modulus"}.get(name, name)
        if own in self.dialect.known:
            self.set_parameters_dict({own: value})
            return
        if name == "bulk":
            raise AttributeError(f"bulk follows from E and nu in {self.dialect.project}, and cannot be assigned")
        both = {"mu": self.modulus("mu"), "lam": self.modulus("lam")} | {name: _column(name, value, state.x)}
        E, nu = engineering(both["mu"], both["lam"])
        self._moduli = {"E": E / self.dialect.units.get("E", 1.0), "nu": nu}
        self._law = self._step = None

    def material_codes(self) -> Tensor:
        """Number of the material of each particle, int32 [P]."""
        if self._codes is None:
            code = code_of(self.dialect, str(self.parameters.get("material", "jelly")))
            self._codes = torch.full_like(self.state.mass, code, dtype=torch.int32)
        return self._codes

    def assign_material_codes(self, value: Any) -> None:
        """Set the material of each particle by numbers, integers [P]."""
        state = self.state
        if not isinstance(value, Tensor) or tuple(value.shape) != (len(state),) or value.is_floating_point():
            raise ValueError(f"material must be integers [P] = [{len(state)}], got {shape_of(value)}")
        for code in value.unique().tolist():
            material_of(self.dialect, code)
        self._codes = value.to(state.x.device, torch.int32)
        self._law = self._step = None

    def material_number(self) -> Any:
        """Number of the material; of each particle [P] in GaussianFluent, or where they differ."""
        given = self.parameters.get("material", "jelly")
        if self._codes is not None or self.dialect.name == "gaussianfluent":
            return self.material_codes()
        return code_of(self.dialect, given) if isinstance(given, str) else given

    def assign_material_number(self, value: Any) -> None:
        """Set the material by its number, name, law or numbers [P]."""
        if isinstance(value, Tensor) and value.dim():
            self.assign_material_codes(value)
        elif isinstance(value, int):
            self.set_parameters_dict({"material": material_of(self.dialect, value)})
            self._law = self._step = None
        else:
            self.set_parameters_dict({"material": value})

    def selection(self, name: str) -> Tensor:
        """A selection of particles, int32 [P]; zeros at the start."""
        if name not in self._selections:
            self._selections[name] = torch.zeros_like(self.state.mass, dtype=torch.int32)
        return self._selections[name]

    def assign_selection(self, name: str, value: Tensor) -> None:
        """Set a selection of particles."""
        self._selections[name] = value.to(self.state.x.device, torch.int32)
        self._step = None


def _column(name: str, value: Any, x: Tensor) -> Tensor:
    """[P] in the dtype and on the device of positions."""
    if not isinstance(value, Tensor) or tuple(value.shape) not in ((), (len(x),)):
        raise ValueError(f"{name} must have shape [P] = [{len(x)}], got {shape_of(value)}")
    return value.to(x).expand(len(x))
