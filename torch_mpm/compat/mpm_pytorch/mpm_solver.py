"""The solver of MPM-PyTorch, on a `Step` of torch_mpm."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...boundaries import Damping
from ...boundaries.apply import after_boundaries
from ...cuda_graphs.capture import is_readable
from ...errors import check_count, check_like, check_number, shape_of
from ...grid.grid import Blocks, Grid
from ...state.state import State
from ...step.particle_operations import Operations
from ...step.step import Step
from ..given_stress import GivenStress, GivenStressSteps, Particles, clamped
from ..gradients import Numbers, check_fixed, refuse_grad, vector
from .call_times import CallTimes, is_recomputed
from .user_functions import Written, dense, replaced, writes_grid, writes_particles

LEAST_MASS = 1e-15
"""Mass of a node [kg] up to which it has no velocity of its own."""
LARGEST_ENTRY = 2.0
"""Bound to which entries of F are clamped."""
RESET_STEPS = 15
"""Number of steps for which a cuboid with `reset` stops its nodes after its end."""


class Assigned(NamedTuple):
    """Range of a number of the solver, also where it is assigned; `vol` and `p_mass` may be tensors."""

    expected: str
    holds: Callable[[float], bool]


POSITIVE = Assigned("positive and finite", lambda v: 0 < v < math.inf)
NUMBERS = {
    "damping": Assigned("between 0 and 1", lambda v: 0 <= v <= 1),
    "clip_bound": Assigned("not negative and below half of the cube", lambda v: 0 <= v < 0.5),
    **{"dt": POSITIVE, "vol": POSITIVE, "p_mass": POSITIVE},
}


class MPMSolver:
    """A step of explicit MPM on the unit cube: forces by the gradient of quadratic B-splines, APIC, positions and F
    clamped.

        x, v, C, F = solver(x, v, C, F, stress)

    Every particle has the volume prod(size)/P and the density rho. Gradients pass to all five tensors, which may be
    float32 or float64.

    The solver counts its own `time`, at which conditions act; within a call it is that at the start of the step. A call
    that `torch.utils.checkpoint` recomputes uses the time of the first call, and does not change that of the solver.
    `dt`, `damping`, `clip_bound` [m], `vol` and `p_mass` may be assigned.

    Args:
        init_pos: positions [P, 3] [m] by which boundary conditions select particles; without gradient.
        rho: density [kg/m³]: a number, or a tensor [] or [P] that may require grad.
        num_grids: cells along each axis.
        dt: time step [s].
        gravity: acceleration [m/s²]: three numbers, or a tensor [3] that may require grad.
        clip_bound: minimum distance of positions from the faces of the cube, in cells.
        damping: factor of all node velocities in each step, in [0, 1].
        center: not used.
        size: edges of the box whose volume is divided among the particles [m].
        enable_train: not used: gradients pass where a tensor requires them.
        device: None for that of init_pos.

    Raises:
        TypeError, ValueError: for a wrong argument.
    """

    def __init__(
        self,
        init_pos: Tensor,
        rho: float | Tensor = 1000.0,
        num_grids: int = 25,
        dt: float = 3e-4,
        gravity: Numbers = (0.0, 0.0, -9.8),
        clip_bound: float = 0.5,
        damping: float = 1.0,
        center: Sequence[float] = (0.5, 0.5, 0.5),
        size: Sequence[float] = (1.0, 1.0, 1.0),
        enable_train: bool = False,
        device: torch.device | str | None = None,
    ) -> None:
        if not isinstance(init_pos, Tensor) or init_pos.dim() != 2 or init_pos.shape[1] != 3:
            raise ValueError(f"init_pos must have shape [P, 3], got {shape_of(init_pos)}")
        refuse_grad("it is a number of the solver", center=center)
        check_fixed("it is a number of the solver", size=size)
        if not isinstance(rho, Tensor):
            check_number("rho", rho, "positive and finite", lambda v: 0 < v < math.inf)
        elif tuple(rho.shape) not in ((), (1,), (len(init_pos),)):
            raise ValueError(f"rho must be a number, or have shape [] or [P] = [{len(init_pos)}], got {shape_of(rho)}")
        self.init_pos = init_pos.detach().to(device=device)
        self.device = self.init_pos.device
        self.n_particles = len(init_pos)
        self.num_grids = check_count("num_grids", num_grids, 1)
        self.dt = float(check_number("dt", dt, *POSITIVE))
        self.dx, self.inv_dx = 1 / num_grids, float(num_grids)
        self.clip_bound = self.dx * check_number("clip_bound", clip_bound, "not negative", lambda v: v >= 0)
        self.damping = damping
        self.vol: Any = math.prod(float(s) for s in size) / max(self.n_particles, 1)
        self.p_mass = rho * self.vol
        self.time = 0.0
        self.pre_particle_process: list[Any] = []
        self.post_grid_process: list[Any] = []
        self.displacement: Tensor | None = None
        self._times = CallTimes()
        self.step = Step(Grid(self.dx, (0.0,) * 3, (1.0,) * 3), GivenStress(), stress_form="gradient")
        self._steps = GivenStressSteps(self.step)
        self.gravity = gravity
        self._acting: tuple[tuple[list[Any], list[Any]], float] | None = None  # Conditions and damping of the step.
        self._changes = 0  # Lengths of the lists of conditions.
        self._last: tuple[Any, ...] | None = None  # Arguments of the last call.
        self._nodes: tuple[Tensor, Tensor] | None = None  # Of the last call, where they are known.

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("vol", "p_mass") and isinstance(value, Tensor):
            if is_readable(value) and not all(map(NUMBERS[name].holds, value.detach().reshape(-1).tolist())):
                raise ValueError(f"{name} must be {NUMBERS[name].expected}, got a tensor with other values")
        elif name in NUMBERS:
            check_number(name, value, *NUMBERS[name])
        super().__setattr__(name, value)

    def reset(self) -> None:
        """Set the time to zero."""
        self.time = 0.0

    def __call__(
        self, x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor, time: float | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`p2g2p`"""
        return self.p2g2p(x, v, C, F, stress, time)

    def p2g2p(
        self, x: Tensor, v: Tensor, C: Tensor, F: Tensor, stress: Tensor, time: float | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Particles a time step later.

        Args:
            x: positions [P, 3] [m].
            v: velocities [P, 3] [m/s].
            C: affine velocity field [P, 3, 3] [1/s].
            F: deformation gradient [P, 3, 3].
            stress: Kirchhoff stress [P, 3, 3] [Pa].
            time: time at the start of the step [s]; by default that of the solver, or of the recomputed call.

        Returns:
            x, v, C and F.

        Raises:
            TypeError, ValueError: for a wrong argument.
            RuntimeError: for a call in a backward pass with an unknown time on which its conditions depend, or with
                conditions that have changed since.
        """
        check_like("x", x, x, (self.n_particles, 3), "[P, 3]")
        self._set_boundaries(self._shows)
        recomputed = is_recomputed()
        if time is None:
            time = self._recomputed_time((x, v, C, F)) if recomputed else self.time
        else:
            check_number("time", time)
        if not recomputed:
            self._times.store((x, v, C, F), (time, self._changes))
        self.displacement, self._now = None, time
        self._last, self._nodes = (x, v, C, F, stress, time), None
        with self._time_of_step(time, self.time if recomputed else time + self.dt):
            result = self._steps(
                *((x, v, C, F), stress, self._constants, time, self.dt, self._ended),
                (self.clip_bound, self.vol, self.p_mass) if self._is_plain() else None,
            )
        if recomputed:
            self._times.store(result, (time + self.dt, self._changes))
        return result

    @contextmanager
    def _time_of_step(self, start: float, after: float) -> Iterator[None]:
        """Time of the solver during and after a step; a step that fails leaves it as it was."""
        before, self.time = self.time, start
        try:
            yield
        except BaseException:
            self.time = before
            raise
        self.time = after

    def _is_plain(self) -> bool:
        """Whether nothing but damping acts on nodes and particles."""
        step = self.step
        others = [b for b in step.boundaries.entries if type(b) is not Damping]
        return not (others or step.on_particles is not None or step.on_grid is not None or self._shows)

    def _ended(self, state: State) -> Particles:
        """Particles after a step, clamped. Weights are those of the positions before they are displaced, as in
        MPM-PyTorch.
        """
        assert state.C is not None and state.F is not None
        after = state.x if self.displacement is None else state.x + self.displacement
        after = clamped(after, self.clip_bound, 1 - self.clip_bound)
        return after, state.v, state.C, clamped(state.F, -LARGEST_ENTRY, LARGEST_ENTRY)

    def _recomputed_time(self, arguments: tuple[Tensor, ...]) -> float:
        """Time of the recomputed call; that of the solver where no condition depends on it."""
        known = self._times.of(arguments)
        if known and all(changes != self._changes for _, changes in known):
            raise RuntimeError("conditions of the solver must not change before the backward pass of a checkpoint")
        found = sorted({time for time, changes in known if changes == self._changes})
        times = found or [0.0, self.time]
        first, last = min(times), max(times)
        conditions = [*self.pre_particle_process, *self.post_grid_process]
        if first < last and any(_may_change(c, first, last, self.dt) for c in conditions):
            raise RuntimeError(
                "the solver was called in a backward pass with tensors of no single earlier call, and conditions "
                f"depend on the time (found {found} s): give time=, or call reset() before each pass"
            )
        return last

    def _constants(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mass [kg] and volume [m³] of each particle."""
        return self._of_particles("p_mass", self.p_mass, x), self._of_particles("vol", self.vol, x)

    def _of_particles(self, name: str, value: Any, x: Tensor) -> Tensor:
        """A number, or a tensor [], [1] or [P], as [P] in the dtype of positions."""
        if isinstance(value, (int, float)):
            return x.new_full((self.n_particles,), value)  # A copy from the host would wait for the device.
        tensor = torch.as_tensor(value, dtype=x.dtype, device=x.device)
        if tuple(tensor.shape) not in ((), (1,), (self.n_particles,)):
            raise ValueError(
                f"{name} must be a number, or have shape [P] = [{self.n_particles}], got {shape_of(value)}"
            )
        return tensor.expand(self.n_particles)

    def _set_boundaries(self, shows: bool) -> None:
        """Add the new conditions of the lists to the step.

        Args:
            shows: whether the nodes are needed as `grid_mv`; conditions then act one after another in Python.
        """
        lists = (list(self.pre_particle_process), list(self.post_grid_process))
        on_dense_grid = shows or any(writes_grid(process) for process in lists[1])
        acting = lists, self.damping
        if self._acting == acting and (self.step.on_grid is not None) == on_dense_grid:
            return
        self._changes += self._acting is None or self._acting[0] != lists
        self._acting = acting
        operations = [Written(self, o) if writes_particles(o) else o for o in lists[0]]
        self.step.on_particles = Operations(operations) if operations else None
        damping = [Damping(self.damping)] if self.damping < 1 else []
        self.step.on_grid = self._on_dense_grid if on_dense_grid else None
        self.step.boundaries = damping if on_dense_grid else [*damping, *lists[1]]  # type: ignore[assignment]

    # ---- the dense grid

    _shows = False
    _now: float | Tensor = 0.0

    @property
    def gravity(self) -> Tensor:
        """Acceleration [3] [m/s²]; may be assigned, as three numbers or a tensor that may require grad."""
        return self._gravity

    @gravity.setter
    def gravity(self, value: Numbers) -> None:
        given = vector("gravity", value, self.init_pos)
        self._gravity = torch.as_tensor(given, dtype=self.init_pos.dtype, device=self.device)
        self.step.gravity = self._gravity

    @property
    def grid_x(self) -> Tensor:
        """Indices of the nodes [n³, 3], float32; positions are these times dx."""
        axis = torch.arange(self.num_grids, device=self.device, dtype=torch.float32)
        return torch.cartesian_prod(axis, axis, axis)

    @property
    def grid_m(self) -> Tensor:
        """Masses of the nodes [n³] [kg] in the last step. Computed again if no function of the grid has read them."""
        return self._of_nodes()[1]

    @property
    def grid_mv(self) -> Tensor:
        """Velocities of the nodes [n³, 3] [m/s] in the last step, after the conditions; within a function of
        `post_grid_process` those before it, which it may write to or assign.
        """
        return self._of_nodes()[0]

    @grid_mv.setter
    def grid_mv(self, value: Tensor) -> None:
        velocity, mass = self._of_nodes()
        check_like("grid_mv", value, velocity, tuple(velocity.shape), "[n³, 3]")
        self._nodes = value, mass

    def _of_nodes(self) -> tuple[Tensor, Tensor]:
        """`grid_mv` and `grid_m`."""
        if self._nodes is None and self._last is not None:
            self._shows, time = True, self.time
            try:
                self.p2g2p(*self._last)
            finally:
                self._shows, self.time = False, time
        if self._nodes is None:
            zero = torch.zeros(self.num_grids**3, 4, dtype=self.init_pos.dtype, device=self.device)
            self._nodes = zero[:, :3], zero[:, 3]
        return self._nodes

    def _on_dense_grid(self, blocks: Blocks, velocity: Tensor, mass: Tensor, dt: float | Tensor) -> Tensor:
        """The conditions on nodes, one after another, with functions of the dense grid among them."""
        n, state = self.num_grids, State(*(velocity[:0, :3],) * 2, mass[:0], mass[:0], time=self._now)
        rows = dense(blocks, torch.cat([velocity, mass[:, None]], 1), n)
        empty = rows[:, 3:] <= LEAST_MASS
        falling = self.damping * self.dt * self.gravity.to(rows)
        self._nodes = torch.where(empty, falling, rows[:, :3]), rows[:, 3]
        for process in self.post_grid_process:
            if writes_grid(process):
                process(self)
                velocity = replaced(blocks, velocity, self._nodes[0], n)
            else:
                velocity, _ = after_boundaries(blocks, velocity, mass, [process], state, dt)
                self._nodes = torch.where(empty, self._nodes[0], dense(blocks, velocity, n)), self._nodes[1]
        return velocity


def _may_change(condition: Any, first: float, last: float, dt: float) -> bool:
    """Whether a condition may begin or end between two times."""
    if not (hasattr(condition, "start") and hasattr(condition, "end")):
        return True  # A user function.
    ends = (condition.end, condition.end + RESET_STEPS * dt)
    return first < condition.start <= last or any(first <= end <= last for end in ends)
