"""`MPMStateStruct` and `MPMModelStruct` of warp_mpm, with torch tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from ...cuda_graphs.capture import version
from ...errors import FLOATING, check_count, check_like, check_number, shape_of
from ..constitutive import engineering, lame
from ..keys import nearest
from ..selections import chosen


class _Struct:
    """Named values, which compute pending substeps before they are read or written."""

    _names: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.__dict__["_values"] = {}
        self.__dict__["_pending"] = None
        self.__dict__["version"] = 0

    def __getattr__(self, name: str) -> Any:
        values = self.__dict__.get("_values", {})
        if name.startswith("__") or name not in self._names:
            close = nearest(name, self._names)
            raise AttributeError(f"{type(self).__name__} has no {name!r}, the nearest known name is {close!r}")
        self.settle()
        if name not in values:
            raise AttributeError(f"{name} of {type(self).__name__} is not known before init")
        value = values[name]
        if isinstance(value, Tensor) and value.requires_grad and not value.is_leaf:
            value.retain_grad()
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._names:
            close = nearest(name, self._names)
            raise AttributeError(f"{type(self).__name__} has no {name!r}, the nearest known name is {close!r}")
        self.settle()
        self._values[name] = value
        self.__dict__["version"] += 1

    def settle(self) -> None:
        """Compute the pending substeps of the struct."""
        pending: Callable[[], None] | None = self.__dict__["_pending"]
        if pending is not None:
            pending()

    def wait_for(self, pending: Callable[[], None] | None) -> None:
        """Set the function that computes pending substeps."""
        self.__dict__["_pending"] = pending

    def values(self) -> Iterable[tuple[str, Any]]:
        """Names and values as they are, without the pending substeps."""
        values: dict[str, Any] = self._values
        return values.items()

    def known(self, name: str) -> bool:
        """Whether a value is known."""
        return name in self._values

    def _require(self, names: Sequence[str], requires_grad: bool) -> None:
        """Let tensors require grad, or detach them."""
        for name in names:
            value = getattr(self, name)
            if value.requires_grad and not requires_grad:
                setattr(self, name, value.detach())
            elif requires_grad and not value.requires_grad:
                setattr(self, name, value.detach().requires_grad_())


class MPMStateStruct(_Struct):
    """Particles: particle_x and particle_v [P, 3] [m, m/s], particle_F_trial and particle_C [P, 3, 3], particle_vol,
    particle_mass and particle_density [P], particle_selection int32 [P], 0 where a particle is simulated, and
    particle_cov [6 P].

    particle_F_trial is the deformation gradient of the positions; particle_F is the same tensor. Given tensors are not
    copied, and gradients pass to them; `requires_grad=False` detaches them.
    """

    _names = (
        *(
            "particle_x",
            "particle_v",
            "particle_F",
            "particle_F_trial",
            "particle_C",
            "particle_cov",
            "particle_stress",
        ),
        *("particle_vol", "particle_mass", "particle_density", "particle_selection"),
        *("grid_res", "history"),
    )
    history: dict[str, Tensor]
    MOVED = ("particle_x", "particle_v", "particle_F_trial", "particle_C")

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__("particle_F_trial" if name == "particle_F" else name, value)

    def __getattr__(self, name: str) -> Any:
        return super().__getattr__("particle_F_trial" if name == "particle_F" else name)

    def init(self, shape: int, device: Any = None, requires_grad: bool = False) -> None:
        """P particles with zeros in all arrays, which do not require grad; see `set_require_grad`."""
        P = check_count("shape", shape if not isinstance(shape, (tuple, list)) else shape[0])
        zeros = torch.zeros(P, device=device)
        self.particle_x, self.particle_v = zeros.new_zeros(P, 3), zeros.new_zeros(P, 3)
        self.particle_F_trial, self.particle_C = zeros.new_zeros(P, 3, 3), zeros.new_zeros(P, 3, 3)
        self.particle_stress, self.particle_cov = zeros.new_zeros(P, 3, 3), zeros.new_zeros(6 * P)
        self.particle_vol, self.particle_mass, self.particle_density = zeros, zeros.clone(), zeros.clone()
        self.particle_selection = torch.zeros(P, dtype=torch.int32, device=device)
        self.history = {}

    def init_grid(self, grid_res: int, device: Any = None, requires_grad: bool = False) -> None:
        """Store the number of cells; nodes have no arrays."""
        self.grid_res = check_count("grid_res", grid_res, 1)

    def from_torch(
        self,
        tensor_x: Tensor,
        tensor_volume: Tensor,
        tensor_cov: Tensor | None = None,
        tensor_velocity: Tensor | None = None,
        n_grid: int = 100,
        grid_lim: float = 1.0,
        device: Any = None,
        requires_grad: bool = True,
    ) -> None:
        """Positions [P, 3] [m], volumes [P] [m³], covariances [P, 6] and velocities [P, 3] [m/s], undeformed.

        Raises:
            ValueError: for a wrong shape.
        """
        self.init_grid(n_grid)
        x = _given(tensor_x, device, requires_grad)
        if x.dim() != 2 or x.shape[1] != 3:
            raise ValueError(f"tensor_x must have shape [P, 3], got {shape_of(x)}")
        if x.dtype not in FLOATING:
            raise TypeError(f"tensor_x must be float32 or float64, got {x.dtype}")
        if not self.known("particle_x") or len(self.particle_x) != len(x):
            self.init(len(x), x.device)
        self._convert(x)
        self.particle_x = x
        self.particle_vol = _column("tensor_volume", _given(tensor_volume, device, requires_grad), x)
        self._set_optional(tensor_cov, tensor_velocity, requires_grad)
        self.particle_F_trial = _identity(x)

    def reset_state(
        self,
        tensor_x: Tensor,
        tensor_cov: Tensor | None = None,
        tensor_velocity: Tensor | None = None,
        tensor_density: Tensor | None = None,
        selection_mask: Tensor | None = None,
        device: Any = None,
        requires_grad: bool = True,
    ) -> None:
        """Other positions, undeformed and without history; velocities where given, and densities [P] where the mask
        [P] is not zero. Masses stay.

        Raises:
            ValueError: for a wrong shape, or densities without a mask.
        """
        x = _given(tensor_x, device, requires_grad)
        check_like("tensor_x", x, self.particle_x.to(x), tuple(self.particle_x.shape), "[P, 3]")
        if (tensor_density is None) != (selection_mask is None):
            raise ValueError("tensor_density and selection_mask must be given together; see reset_density")
        self._convert(x)
        self.particle_x = x
        self._set_optional(tensor_cov, tensor_velocity, requires_grad)
        if tensor_density is not None:
            self.reset_density(tensor_density, selection_mask, device, requires_grad)
        self.particle_F_trial, self.particle_C = _identity(x), torch.zeros_like(self.particle_C)
        self.particle_stress, self.history = torch.zeros_like(self.particle_stress), {}

    def continue_from_torch(
        self,
        tensor_x: Tensor | None,
        tensor_velocity: Tensor | None = None,
        tensor_F: Tensor | None = None,
        tensor_C: Tensor | None = None,
        device: Any = None,
        requires_grad: bool = True,
    ) -> None:
        """Positions and velocities [P, 3], deformation gradients and affine fields, [P, 3, 3] or [P, 9]."""
        given = zip(self.MOVED, (tensor_x, tensor_velocity, tensor_F, tensor_C), strict=True)
        for name, value in given:
            if value is not None:
                new = _given(value, device, requires_grad)
                setattr(self, name, new.reshape(getattr(self, name).shape))
        self._convert(self.particle_x)

    def set_require_grad(self, requires_grad: bool = True) -> None:
        """Let positions, velocities, deformations and affine fields require grad as they are, or detach them."""
        self._require(self.MOVED, requires_grad)

    def reset_density(
        self,
        tensor_density: Tensor,
        selection_mask: Tensor | None = None,
        device: Any = None,
        requires_grad: bool = True,
        update_mass: bool = False,
    ) -> None:
        """Densities [] or [P] [kg/m³], where the mask [P] is not zero; with update_mass masses too."""
        x = self.particle_x
        density = _column("tensor_density", _given(tensor_density, device, requires_grad), x)
        if selection_mask is not None:
            density = torch.where(chosen("selection_mask", selection_mask, x), density, self.particle_density)
        self.particle_density = density
        if update_mass:
            self.particle_mass = self.particle_density * self.particle_vol

    def partial_clone(self, device: Any = None, requires_grad: bool = True) -> MPMStateStruct:
        """A state with the same volumes, densities, masses and selection, undeformed, and with zeros elsewhere."""
        new = MPMStateStruct()
        new.init(len(self.particle_x), self.particle_x.device)
        new._convert(self.particle_x)
        for name in ("particle_vol", "particle_density", "particle_mass", "particle_selection"):
            setattr(new, name, getattr(self, name))
        if self.known("grid_res"):
            new.init_grid(self.grid_res)
        new.particle_F_trial = _identity(new.particle_x)
        return new

    def _set_optional(self, cov: Tensor | None, velocity: Tensor | None, requires_grad: bool) -> None:
        x = self.particle_x
        if cov is not None:
            self.particle_cov = _given(cov, x.device, requires_grad).to(x).reshape(-1)
            check_like("tensor_cov", self.particle_cov, x, (6 * len(x),), "[6 P]")
        if velocity is not None:
            v = _given(velocity, x.device, requires_grad)
            check_like("tensor_velocity", v, x, tuple(x.shape), "[P, 3]")
            self.particle_v = v

    def _convert(self, x: Tensor) -> None:
        """Arrays in the dtype and on the device of positions."""
        for name, value in list(self._values.items()):
            if isinstance(value, Tensor) and (value.device != x.device or value.is_floating_point()):
                self._values[name] = value.to(x) if value.is_floating_point() else value.to(x.device)


class MPMModelStruct(_Struct):
    """Material and grid: E, mu, lam and yield_stress [P] [Pa], nu [P], and numbers.

    The step reads mu and lam, which `finalize_mu_lam` computes from E and nu.
    """

    _names = (
        *("E", "nu", "mu", "lam", "yield_stress", "grid_lim", "n_particles", "n_grid", "dx", "inv_dx"),
        *("grid_dim_x", "grid_dim_y", "grid_dim_z", "material", "plastic_viscosity", "softening", "friction_angle"),
        *("hardening", "xi", "rpic_damping", "grid_v_damping_scale", "gravitational_accelaration"),
        "update_cov_with_F",
    )

    def init(self, shape: int, device: Any = None, requires_grad: bool = False) -> None:
        """Arrays of zeros for P particles, which do not require grad; see `set_require_grad`."""
        P = check_count("shape", shape if not isinstance(shape, (tuple, list)) else shape[0])
        for name in ("E", "nu", "mu", "lam", "yield_stress"):
            setattr(self, name, torch.zeros(P, device=device))
        self.n_particles, self.hardening, self.xi = P, 0.0, 0.0

    def init_other_params(self, n_grid: int = 100, grid_lim: float = 1.0, device: Any = None) -> None:
        """Cells along each axis and edge of the domain [m], and the defaults of all numbers."""
        n = check_count("n_grid", n_grid, 1)
        extent = float(check_number("grid_lim", grid_lim, "positive", lambda v: v > 0))
        values: dict[str, Any] = {
            "n_grid": n,
            "grid_lim": extent,
            "dx": extent / n,
            "inv_dx": n / extent,
            "update_cov_with_F": False,
        }
        values |= {f"grid_dim_{axis}": n for axis in "xyz"}
        values |= {"material": 0, "plastic_viscosity": 0.0, "softening": 0.1, "friction_angle": 25.0}
        values |= {"rpic_damping": 0.0, "grid_v_damping_scale": 1.1, "gravitational_accelaration": (0.0, 0.0, 0.0)}
        for name, value in values.items():
            setattr(self, name, value)

    def from_torch(self, tensor_E: Tensor, tensor_nu: Tensor, device: Any = None, requires_grad: bool = False) -> None:
        """E [Pa] and nu, [] or [P], with their gradients, and mu and lam."""
        self.E, self.nu = tensor_E.to(device=device), tensor_nu.to(device=device)
        self.finalize_mu_lam()

    def finalize_mu_lam(self, n_particles: int | None = None, device: Any = None) -> None:
        """mu and lam of E and nu."""
        self.mu, self.lam = lame(self.E, self.nu)

    def set_require_grad(self, requires_grad: bool = True) -> None:
        """Let E and nu require grad as they are, or detach them; mu and lam follow from them in `finalize_mu_lam`."""
        self._require(("E", "nu"), requires_grad)

    def marks(self) -> tuple[Any, ...]:
        """A value that changes with any assignment to the model, or write to a tensor of it."""
        self.settle()
        tensors = [value for value in self._values.values() if isinstance(value, Tensor)]
        return self.version, *(version(t) for t in tensors)

    def requires_grad(self) -> bool:
        """Whether a tensor of the model requires grad."""
        return any(isinstance(value, Tensor) and value.requires_grad for value in self._values.values())

    def engineering(self) -> tuple[Tensor, Tensor]:
        """Young's modulus [Pa] and Poisson's ratio of mu and lam.

        Raises:
            ValueError: where they are not known.
        """
        mu = self.mu
        if not bool((mu.detach() > 0).all()):
            raise ValueError("mu must be positive: call set_E_nu and prepare_mu_lam, or finalize_mu_lam, before a step")
        return engineering(mu, self.lam)


def _given(value: Tensor, device: Any, requires_grad: bool) -> Tensor:
    """A tensor on a device, detached unless gradients are wanted."""
    if not isinstance(value, Tensor):
        raise TypeError(f"arguments must be tensors, got {shape_of(value)}")
    moved = value.to(device=device)
    return moved if requires_grad else moved.detach()


def _column(name: str, value: Tensor, x: Tensor) -> Tensor:
    """[P] of a tensor [], [1] or [P]."""
    if tuple(value.shape) not in ((), (1,), (len(x),)):
        raise ValueError(f"{name} must have shape [P] = [{len(x)}], got {shape_of(value)}")
    return value.to(x).expand(len(x))


def _identity(x: Tensor) -> Tensor:
    return torch.eye(3, dtype=x.dtype, device=x.device).repeat(len(x), 1, 1)
