"""`MPMWARPDiff` of warp_mpm, on a `Step` of torch_mpm."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ...boundaries import Damping
from ...cuda_graphs.capture import version
from ...errors import check_count, check_flag, check_number, shape_of
from ...grid.grid import Grid
from ...state.state import State
from ...step.clocks import time_after
from ..clipping import ClippedRollout
from ..keys import check_keys
from ..pending import Versions, check_versions, versions
from ..physgaussian.condition_list import Nodes, acts, changes
from ..physgaussian.dialects import BASE_KEYS, DIALECTS, code_of, material_of
from ..physgaussian.law_choice import chosen_law
from ..physgaussian.parameters import checked
from ..physgaussian.particles import affine_operations, enabled_operations
from .conditions import ParticleConditions
from .mpm_data_structure import MPMModelStruct, MPMStateStruct

DIALECT = DIALECTS["warp_mpm"]
OF_THE_MODEL = {"E": "call set_E_nu", "nu": "call set_E_nu", "n_grid": "call init_other_params of the model"}
OF_THE_MODEL |= {"grid_lim": OF_THE_MODEL["n_grid"]}
OF_THE_MODEL |= dict.fromkeys(("gamma", "kappa"), "the law of MPMAvatar's cloth does not exist here")
KEYS = [key for key in BASE_KEYS if key not in (*OF_THE_MODEL, "additional_material_params")]
MARGIN = 2.0
"""Distance of positions from the faces of the domain after each step, in cells."""


class MPMWARPDiff(ParticleConditions):
    """Explicit MPM on the cube [0, grid_lim]³, whose particles and material are in structs of the caller.

        next_state = state.partial_clone()
        solver.p2g2p_differentiable(model, state, next_state, dt)

    Steps are those of `MPM_Simulator_WARP`, with positions that stay 2 cells away from the faces. Gradients pass from
    each state to the one before, and to E, nu, densities and velocities of conditions.

    Args:
        n_particles: P.
        n_grid, grid_lim, device: not used: `MPMModelStruct.init_other_params` sets the grid.
        strict: as for `MPM_Simulator_WARP`.
    """

    def __init__(
        self, n_particles: int, n_grid: int = 100, grid_lim: float = 1.0, device: Any = None, *, strict: bool = False
    ) -> None:
        self.strict = check_flag("strict", strict)
        self.time_profile: dict[str, list[float]] = {}
        self.initialize(n_particles, n_grid, grid_lim, device)

    def initialize(self, n_particles: int, n_grid: int = 100, grid_lim: float = 1.0, device: Any = None) -> None:
        """Discard conditions, and set the time to zero."""
        self.n_particles = check_count("n_particles", n_particles)
        self._time = 0.0
        self._clear_conditions()
        self._queue: tuple[MPMModelStruct, MPMStateStruct, int, float, bool] | None = None
        self._made: tuple[Any, ClippedRollout, list[Any]] | None = None

    # ---- parameters

    def set_parameters_dict(
        self,
        mpm_model: MPMModelStruct,
        mpm_state: MPMStateStruct,
        kwargs: Mapping[str, Any] | None = None,
        device: Any = None,
    ) -> None:
        """Set material and numbers.

        Args:
            mpm_model, mpm_state: written to.
            kwargs: material ("jelly", "metal", "sand", "foam", "plasticine", "neo-hookean"), density [kg/m³],
                yield_stress [Pa], hardening, xi, friction_angle [degrees], g [m/s²], rpic_damping, plastic_viscosity
                [Pa s], softening [Pa] and grid_v_damping_scale.

        Raises:
            TypeError, ValueError: for an unknown key or a wrong value.
        """
        given = dict(kwargs or {})
        check_keys("set_parameters_dict", given, KEYS, OF_THE_MODEL)
        x = mpm_state.particle_x
        values = {name: checked(name, value, x) for name, value in given.items()}
        for name, value in values.items():
            if name == "material":
                if not isinstance(value, str) or value not in DIALECT.materials:
                    raise TypeError(f"material must be one of {sorted(DIALECT.materials)}, got {value!r}")
                mpm_model.material = code_of(DIALECT, value)
            elif name == "density":
                mpm_state.reset_density(torch.as_tensor(value, dtype=x.dtype, device=x.device), update_mass=True)
            elif name == "g":
                mpm_model.gravitational_accelaration = value
            elif name == "yield_stress":
                mpm_model.yield_stress = torch.as_tensor(value, dtype=x.dtype, device=x.device).expand(len(x))
                mpm_state.history = {k: v for k, v in mpm_state.history.items() if k != "yield_stress"}
            else:
                setattr(mpm_model, name, value)

    def set_E_nu(self, mpm_model: MPMModelStruct, E: float | Tensor, nu: float | Tensor, device: Any = None) -> None:
        """E [Pa] and nu of the model: numbers, or tensors [] or [P]; `prepare_mu_lam` applies them."""
        for name, value in (("E", E), ("nu", nu)):
            like = getattr(mpm_model, name)
            if isinstance(value, Tensor) and value.is_floating_point():
                like = like.to(value.dtype)
            given = torch.as_tensor(checked(name, value, like), dtype=like.dtype, device=like.device)
            setattr(mpm_model, name, given.reshape(-1).expand(self.n_particles))

    def set_E_nu_from_torch(
        self,
        mpm_model: MPMModelStruct,
        E: Tensor,
        nu: Tensor,
        gamma: Tensor | None = None,
        kappa: Tensor | None = None,
        device: Any = None,
    ) -> None:
        """As `set_E_nu`, for tensors.

        Raises:
            NotImplementedError: for gamma and kappa, parameters of the cloth of MPMAvatar, which has no law here.
        """
        if isinstance(gamma, (str, torch.device)):  # The device, without gamma and kappa.
            gamma = None
        if gamma is not None or kappa is not None:
            raise NotImplementedError(
                "gamma and kappa are those of MPMAvatar's cloth, which has no law here: available are "
                f"{sorted(DIALECT.materials)}"
            )
        self.set_E_nu(mpm_model, E, nu)

    def prepare_mu_lam(self, mpm_model: MPMModelStruct, mpm_state: MPMStateStruct, device: Any = None) -> None:
        """mu and lam of the model from its E and nu."""
        mpm_model.finalize_mu_lam()

    # ---- steps

    @property
    def time(self) -> float:
        """[s]"""
        if self._queue is None:
            return self._time
        _, _, n, dt, _ = self._queue
        return float(time_after(self._time, dt, n))

    @time.setter
    def time(self, value: float) -> None:
        self._before_change()
        self._time = float(check_number("time", value))

    def p2g2p_differentiable(
        self,
        mpm_model: MPMModelStruct,
        mpm_state: MPMStateStruct,
        next_state: MPMStateStruct,
        dt: float,
        device: Any = None,
    ) -> None:
        """A step of dt [s] from a state to the next; gradients pass between their tensors."""
        self.rollout(mpm_model, mpm_state, next_state, 1, dt)

    def rollout(
        self,
        mpm_model: MPMModelStruct,
        mpm_state: MPMStateStruct,
        next_state: MPMStateStruct,
        n: int,
        dt: float,
        checkpoint: Any = None,
    ) -> None:
        """n steps of dt [s] from a state to the next, computed together.

        Args:
            mpm_model: the material.
            mpm_state: the first state.
            next_state: the last one, which may be the first one.
            n: number of steps.
            dt: [s]
            checkpoint: states to store for the backward pass, see `torch_mpm.rollout`.
        """
        _check_structs(mpm_model, mpm_state=mpm_state, next_state=next_state)
        check_count("n", n)
        dt = float(check_number("dt", dt, "positive", lambda v: v > 0))
        self._before_change()
        began = time.perf_counter()
        state, (roll, lasting) = self._state_of(mpm_state), self._roll_of(mpm_model, mpm_state.particle_selection)
        nodes = self._nodes(mpm_model, state.x)
        first, done = self._time, 0
        for end in changes([*self._boundaries(nodes), *self._pushes, *self._holds], first, n, dt) if n else ():
            span = first + done * dt, first + (end - 1) * dt, dt
            on_nodes, on_particles = self._active(mpm_model, nodes, *span)
            state = roll.run(state, end - done, dt, on_nodes, [*on_particles, *lasting], checkpoint=checkpoint)
            done = end
        self._time = float(state.time)
        self.time_profile.setdefault("substeps", []).append(1e3 * (time.perf_counter() - began))
        next_state.particle_x, next_state.particle_v, next_state.history = state.x, state.v, dict(state.extra)
        for name, value in (("particle_C", state.C), ("particle_F_trial", state.F)):
            setattr(next_state, name, value)

    def p2g2p(
        self, mpm_model: MPMModelStruct, mpm_state: MPMStateStruct, step: int, dt: float, device: Any = None
    ) -> None:
        """A step of dt [s] of a state in place; `step` is not used. Steps are computed together when something is read
        or changed.
        """
        _check_structs(mpm_model, mpm_state=mpm_state)
        check_number("dt", dt, "positive", lambda v: v > 0)
        if self._queue is not None:
            model, state, n, before, grad = self._queue
            same = model is mpm_model and state is mpm_state and before == dt and grad == torch.is_grad_enabled()
            if same:
                self._queue = model, state, n + 1, dt, grad
                return
        self._before_change()
        mpm_model.settle()
        mpm_state.settle()
        self._queue = mpm_model, mpm_state, 1, dt, torch.is_grad_enabled()
        self._versions = _versions_of(mpm_model, mpm_state)
        for struct in (mpm_model, mpm_state):
            struct.wait_for(self._before_change)

    def _before_change(self) -> None:
        """Compute the pending steps."""
        if self._queue is None:
            return
        (model, state, n, dt, grad), self._queue = self._queue, None
        for struct in (model, state):
            struct.wait_for(None)
        check_versions(self._versions, _versions_of(model, state), n)
        with torch.set_grad_enabled(grad):
            self.rollout(model, state, state, n, dt)

    def print_time_profile(self) -> None:
        """Print the time of the steps so far [ms]."""
        print("MPM Time profile:")
        for name, times in self.time_profile.items():
            print(name, sum(times))

    def _state_of(self, struct: MPMStateStruct) -> State:
        if len(struct.particle_x) != self.n_particles:
            raise ValueError(f"the state must have {self.n_particles} particles, got {len(struct.particle_x)}")
        mass, volume = struct.particle_mass, struct.particle_vol
        if not bool((volume.detach() > 0).all()):
            raise ValueError("the volumes of the particles must be positive: give them in from_torch")
        if not bool((mass.detach() > 0).all()):
            raise ValueError("the particles have no mass: give density in set_parameters_dict, or call reset_density")
        x, v, C, F = (getattr(struct, name) for name in ("particle_x", "particle_v", "particle_C", "particle_F_trial"))
        return State(x=x, v=v, C=C, F=F, mass=mass, volume=volume, extra=dict(struct.history), time=self._time)

    def _roll_of(self, model: MPMModelStruct, selection: Tensor) -> tuple[ClippedRollout, list[Any]]:
        """Rollout of the model, and operations that always act; created again where the model has changed."""
        key = model, selection, (model.marks(), version(selection), torch.is_grad_enabled())
        if self._made is not None and not model.requires_grad():
            before, roll, operations = self._made
            if before[0] is model and before[1] is selection and before[2] == key[2]:
                return roll, operations
        self._made = key, *self._create(model, selection)
        return self._made[1:]

    def _create(self, model: MPMModelStruct, selection: Tensor) -> tuple[ClippedRollout, list[Any]]:
        names = ("yield_stress", "hardening", "xi", "plastic_viscosity", "softening", "friction_angle")
        E, nu = model.engineering()
        parameters = {"E": E, "nu": nu, "material": material_of(DIALECT, model.material)}
        parameters |= {name: getattr(model, name) for name in names}
        bounds = MARGIN * model.dx, model.grid_lim - MARGIN * model.dx
        law = chosen_law(DIALECT, parameters, None)
        grid = Grid(model.dx, (0.0,) * 3, (model.grid_lim,) * 3)
        roll = ClippedRollout(law, model.gravitational_accelaration, grid, bounds)
        return roll, [*affine_operations(model.rpic_damping), *enabled_operations(selection)]

    def _active(
        self, model: MPMModelStruct, grid: Nodes, first: float, last: float, dt: float
    ) -> tuple[list[Any], list[Any]]:
        """Conditions that are active at times from `first` to `last`, on nodes and on particles."""
        damping = model.grid_v_damping_scale
        nodes = [b for b in self._boundaries(grid) if acts(b, first, last, dt)]
        nodes = [Damping(damping), *nodes] if isinstance(damping, Tensor) or damping < 1 else nodes
        return nodes, [o for o in (*self._pushes, *self._holds) if acts(o, first, last, dt)]

    def _nodes(self, model: MPMModelStruct, x: Tensor) -> Nodes:
        return Nodes(model.dx, (model.n_grid,) * 3, x[:0], self.strict)


def _versions_of(model: MPMModelStruct, state: MPMStateStruct) -> Versions:
    """Versions of the tensors of structs."""
    return versions({f"mpm_model.{k}": v for k, v in model.values()} | {f"mpm_state.{k}": v for k, v in state.values()})


def _check_structs(model: MPMModelStruct, **states: MPMStateStruct) -> None:
    """Raise TypeError for other structs."""
    if not isinstance(model, MPMModelStruct):
        raise TypeError(f"mpm_model must be an MPMModelStruct, got {shape_of(model)}")
    for name, state in states.items():
        if not isinstance(state, MPMStateStruct):
            raise TypeError(f"{name} must be an MPMStateStruct, got {shape_of(state)}")
