"""NCLaw's simulator: MLS-MPM on the unit cube with a given stress, on a `Step` of torch_mpm."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from ...boundaries import Walls
from ...errors import check_count, check_number, shape_of
from ...geometry.values import filled
from ...grid.grid import Blocks, Grid
from ...laws.parameters import TensorModule
from ...state.state import State
from ...step.step import Step
from ..given_stress import GivenStress, GivenStressSteps, Particles, clamped
from ..gradients import Numbers, check_fixed, refuse_grad, vector
from ..settings import setting
from .particles import MPMInitData, MPMState, MPMStateInitializer, MPMStatics, MPMStaticsInitializer

__all__ = [
    "MPMCacheDiffSim",
    "MPMDiffSim",
    "MPMExtraSim",
    "MPMForwardSim",
    "MPMInitData",
    "MPMModel",
    "MPMModelBuilder",
    "MPMState",
    "MPMStateInitializer",
    "MPMStatics",
    "MPMStaticsInitializer",
]


class MPMModel:
    """Parameters of a simulation, created by `MPMModelBuilder`.

    Args:
        num_grids: cells along each axis of the unit cube.
        dt: time step [s].
        bound: nodes with an index below it, or above num_grids − bound, have no velocity out of the cube.
        gravity: acceleration [m/s²]: three numbers, or a tensor [3] that may require grad.
        eps: added to the mass of a node [kg], which slows down light nodes.
        device: device of new particles.
    """

    def __init__(
        self,
        num_grids: int,
        dt: float,
        bound: int,
        gravity: Numbers,
        eps: float = 0.0,
        device: torch.device | str | None = None,
    ) -> None:
        self.num_grids = check_count("num_grids", num_grids, 1)
        self.dt = float(check_number("dt", dt, "positive and finite", lambda v: 0 < v < math.inf))
        self.bound, self.dx, self.device = check_count("bound", bound), 1 / num_grids, device
        check_fixed("it is a number of the model", eps=eps)
        self.gravity, self.eps = vector("gravity", gravity, torch.empty(0, device=device)), float(eps)
        lower, upper = (bound - 1) * self.dx, (num_grids - bound + 1) * self.dx
        step = Step(Grid(self.dx, (0.0,) * 3, (1.0,) * 3), GivenStress(), on_particles=self._present)
        if eps == 0:
            step.gravity = self.gravity
            step.walls = Walls("separate", (lower,) * 3, (upper,) * 3) if bound > 0 else None
        else:
            step.on_grid = HeavyNodes(eps, self.gravity, lower, upper)
        self.step, self._steps = step, GivenStressSteps(step)
        self._statics: MPMStatics | None = None

    def _present(self, state: State, dt: float | Tensor) -> tuple[State, Tensor]:
        assert self._statics is not None
        return state, self._statics.enabled.to(state.x.device) != 0

    def advance(self, statics: MPMStatics, x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor) -> Particles:
        """Particles a time step later. Particles that are not enabled are unchanged."""
        if not isinstance(statics, MPMStatics):
            raise TypeError(f"statics must be an MPMStatics, got {shape_of(statics)}")
        self._statics = statics
        read = (statics.vol, statics.rho, statics.enabled, statics.clip_bound) if self._is_plain() else None
        return self._steps((x, v, C, F), stress, self._constants, 0.0, self.dt, self._ended, read)

    def _constants(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mass [kg] and volume [m³] of each particle."""
        assert self._statics is not None
        volume = self._statics.vol.to(x)
        return self._statics.rho.to(x) * volume, volume

    def _is_plain(self) -> bool:
        """Whether nothing acts that the model has not set."""
        step = self.step
        own = step.on_particles == self._present and (step.on_grid is None or type(step.on_grid) is HeavyNodes)
        return own and not step.boundaries.entries

    def _ended(self, state: State) -> Particles:
        """Particles after a step, with positions clamped except those of particles that are not enabled."""
        assert self._statics is not None and state.C is not None and state.F is not None
        margin = self._statics.clip_bound.to(state.x)[:, None] * self.dx
        _, enabled = self._present(state, self.dt)
        after = torch.where(enabled[:, None], clamped(state.x, margin, 1 - margin), state.x)
        return after, state.v, state.C, state.F

    def state(self, shape: int, requires_grad: bool | None = None) -> MPMState:
        """Particles at rest in the origin."""
        return MPMState(shape, self.device)

    def statics(self, shape: int) -> MPMStatics:
        """Statics of particles without volume."""
        return MPMStatics(shape, self.device)


class HeavyNodes(TensorModule):
    """Node velocities of NCLaw's grid step, from those of a step without gravity and walls.

    Args:
        eps: [kg], see `MPMModel`.
        gravity: [m/s²]: three numbers, or a tensor [3] that may require grad.
        lower, upper: planes beyond which no node moves outwards [m].
    """

    def __init__(self, eps: float, gravity: Numbers, lower: float, upper: float) -> None:
        self.eps, self.gravity, self.lower, self.upper = eps, gravity, lower, upper

    def forward(self, blocks: Blocks, velocity: Tensor, mass: Tensor, dt: float) -> Tensor:
        gravity = self.gravity.to(velocity) if isinstance(self.gravity, Tensor) else filled(self.gravity, velocity)
        x, rounding = blocks.node_positions(velocity.dtype), 1e-6 * blocks.grid.dx
        v = (mass / (mass + self.eps))[:, None] * velocity + gravity * dt
        out = ((x <= self.lower + rounding) & (v < 0)) | ((x >= self.upper - rounding) & (v > 0))
        return torch.where(out, 0, v)


class MPMModelBuilder:
    """Creates a model of a configuration: `MPMModelBuilder().parse_cfg(cfg).finalize(device, requires_grad=True)`."""

    def __init__(self) -> None:
        self.config: dict[str, Any] = {}

    def parse_cfg(self, cfg: Any) -> MPMModelBuilder:
        """Read num_grids, dt, bound, gravity, eps and bc, of an object or a mapping.

        Raises:
            ValueError: for a missing value, or another bc than "freeslip".
        """
        boundary = setting(cfg, "bc", "freeslip")
        if boundary != "freeslip":
            raise ValueError(
                f"bc must be 'freeslip', got {boundary!r}: in NCLaw 'noslip' sets no velocity at all, so that nothing "
                "moves"
            )
        names = ("num_grids", "dt", "bound", "gravity", "eps")
        self.config = {name: setting(cfg, name) for name in names}
        return self

    def finalize(self, device: Any = None, requires_grad: bool = False) -> MPMModel:
        """Model of the configuration. Gradients pass wherever a tensor requires them, for any `requires_grad`."""
        if not self.config:
            raise ValueError("there is no configuration: call parse_cfg first")
        return MPMModel(**self.config, device=None if device is None else str(device))


class MPMSim(nn.Module):
    """Common base of the simulators.

    Args:
        model: see `MPMModelBuilder`.
    """

    def __init__(self, model: MPMModel) -> None:
        super().__init__()
        self.model = model

    def state(
        self, x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor, state: MPMState | None = None
    ) -> MPMState:
        """The tensors as a state."""
        state = self.model.state(len(x)) if state is None else state
        state.from_torch(x, v, C, F, stress)
        return state


class MPMDiffSim(MPMSim):
    """`x, v, C, F = sim(statics, x, v, C, F, stress)`, differentiable by all five tensors."""

    def forward(self, statics: MPMStatics, x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor) -> Particles:
        return self.model.advance(statics, x, v, C, F, stress)


class MPMCacheDiffSim(MPMSim):
    """`x, v, C, F = sim(statics, step, x, v, C, F, stress)`; no call depends on an earlier one, for any num_steps.

    Args:
        model: see `MPMModelBuilder`.
        num_steps: not used.
    """

    def __init__(self, model: MPMModel, num_steps: int) -> None:
        super().__init__(model)
        check_count("num_steps", num_steps)

    def forward(
        self, statics: MPMStatics, step: int, x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor
    ) -> Particles:
        return self.model.advance(statics, x, v, C, F, stress)


class MPMForwardSim(MPMSim):
    """`x, v, C, F = sim(statics, state)`, also stored in the state, without gradients.

    Raises:
        ValueError: for a tensor that requires grad, where gradients are enabled.
    """

    def forward(self, statics: MPMStatics, state: MPMState) -> Particles:
        if torch.is_grad_enabled():
            given = {**vars(state.particle), "vol": statics.vol, "rho": statics.rho, "clip_bound": statics.clip_bound}
            refuse_grad("MPMForwardSim has no gradients; use MPMDiffSim, or torch.no_grad()", **given)
        with torch.no_grad():
            return self._forward(statics, state)

    def _forward(self, statics: MPMStatics, state: MPMState) -> Particles:
        after = self.model.advance(statics, *state.to_torch())
        state.from_torch(*after)
        return after


class MPMExtraSim(MPMSim):
    """Simulation of further particles that the velocities of nodes move, which is not available.

    Raises:
        NotImplementedError: always.
    """

    def __init__(self, model: MPMModel) -> None:
        raise NotImplementedError(
            "MPMExtraSim moves particles without mass through a grid that is not stored here: add them as a body of "
            "low density, or call torch_mpm.ops.g2p with the nodes of torch_mpm.ops.p2g"
        )
