"""One explicit MPM step, and rollouts of many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint as run_checkpointed

from .boundaries import Walls
from .capture import Kept
from .cfl import stable_dt
from .errors import GridOverflowError, SimulationError
from .grid import ActivationRecord, Blocks, Grid
from .heat import Heat
from .materials import Material
from .ops import contact, fusible, g2p, g2p_advance, gather, grid_update, p2g
from .parameters import With
from .state import State, identity_deformation

TRANSFERS = ("apic", "pic", "flip")


class Boundary(Protocol):
    """What acts on the grid velocity [N, D] of nodes at positions [N, D]; see `torch_mpm.boundaries`."""

    def apply(
        self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float | Tensor, dt: float | Tensor
    ) -> Tensor: ...


class Step(nn.Module):
    """Symplectic Euler: stress, P2G, grid update, boundaries, G2P, positions and deformation gradients.

    Args:
        grid: the lattice.
        law: a material of `torch_mpm.materials`, or any module with its interface.
        gravity: [m/s²]; D numbers, or a tensor [D] or [B, D] that may require grad; None for none.
        walls: "slip", "sticky", "separate" or "mirror" on every face of the domain, a `Walls` that says more, or None.
        boundaries: obstacles with the interface of `torch_mpm.boundaries`, applied in order.
        transfer: "apic" (Jiang et al. 2015), "pic", or "flip".
        flip: share of FLIP in [0, 1] that "apic" or "pic" is blended with; 1 for transfer="flip".
        stress_form: "mls" (Hu et al. 2018; F moves with C) or "gradient" (force −V τ ∇N; F moves with Σ v_i ∇N_i).
        on_grid: called as `velocity = on_grid(blocks, velocity, mass, dt)` with node tensors [N, D] and [N] after the
            boundaries: a network, a controller, a field of force.
        heat: conduction of heat in the same particles, see `Heat`; the state then needs a temperature.

    A step without boundaries, walls, gravity, FLIP or heat does not pay for them.

    Differentiable in reverse mode, by torch.func.grad and vjp too. `torch.compile(step, fullgraph=True)` needs a grid
    with a capacity; it compiles again for another number dt (a tensor avoids that), and once a field is None no more.

    Raises:
        ValueError: for a wrong argument.
    """

    def __init__(
        self,
        grid: Grid,
        law: Material,
        gravity: Sequence[float] | Tensor | None = None,
        walls: str | Walls | None = None,
        boundaries: Sequence[Boundary] = (),
        transfer: str = "apic",
        flip: float = 0.0,
        stress_form: str = "mls",
        on_grid: Callable[[Blocks, Tensor, Tensor, float | Tensor], Tensor] | None = None,
        heat: Heat | None = None,
    ) -> None:
        super().__init__()
        if transfer not in TRANSFERS:
            raise ValueError(f"transfer must be one of {sorted(TRANSFERS)}, got {transfer!r}")
        if not 0 <= flip <= 1:
            raise ValueError(f"flip must be between 0 and 1, got {flip}")
        if stress_form not in ("mls", "gradient"):
            raise ValueError(f"stress_form must be 'gradient' or 'mls', got {stress_form!r}")
        self.grid = grid
        self.law = law
        self.gravity = gravity
        self.walls = Walls(walls) if isinstance(walls, str) else walls
        self.boundaries = list(boundaries)
        self.transfer = transfer
        self.flip = 1.0 if transfer == "flip" else float(flip)
        self.stress_form = stress_form
        self.on_grid = on_grid
        self.heat = heat
        self._rate_dependent = any(getattr(part, "rate_dependent", False) for part in law.modules())
        if heat is not None and heat.plastic_heating:
            for part in law.modules():
                if isinstance(part, Material):
                    part.dissipation = True
        self._activations = ActivationRecord()
        self._kept_gravity = Kept()

    def forward(self, state: State, dt: float | Tensor) -> State:
        """The state one step later.

        Args:
            state: see `State`; missing C, F or J start at zero, identity and one.
            dt: time step [s]: a number, or a tensor of shape [], [1] or [B].

        Raises:
            ValueError, TypeError: for wrong shapes, dtypes or devices, or a number dt that is not positive.
            GridOverflowError: on the CPU, where a grid of fixed capacity is full.
        """
        grid, scene = self.grid, state.scene
        state = self.prepare(state)
        blocks = self._activations.activate(grid, state.x, scene)
        form, affine = self.stress_form, state.C if self.transfer == "apic" else None
        fields, stress = self.law.update(With(state, dt=dt) if self._rate_dependent else state)  # type: ignore[arg-type]
        dissipated = fields.pop("dissipated", None)
        if self.law.extra_fields:
            history = {name: fields.pop(name) for name in self.law.extra_fields if name in fields}
            state = state.replace(extra={**state.extra, **history})
        nodes = p2g(blocks, state.x, state.mass, state.v, affine, stress, state.volume, dt, form)
        velocity = self._update_grid(blocks, nodes, state, dt)
        deformed = {name: fields.get(name, getattr(state, name)) for name in ("F", "J")}
        keeps_C = self.transfer == "apic" or self.law.viscous
        x, v, C, F, J = g2p_advance(
            blocks, state.x, velocity, dt, **deformed, affine=keeps_C or self.heat is not None, stress_form=form
        )
        if self.flip:  # positions move with the grid all the same, so that FLIP's noise does not reach them
            v = self._blend_flip(blocks, state, affine, velocity, v)
        changes: dict[str, Any] = {**fields, "F": F, "J": J}
        if self.heat is not None:
            motion = C if form == "mls" else g2p(blocks, state.x, velocity, affine=False, gradient=True)[2]
            changes |= self.heat.update(blocks, state, dt, motion, dissipated)
        return state.replace(x=x, v=v, C=C if keeps_C else None, time=state.time + dt, **changes)

    def prepare(self, state: State) -> State:
        """Give a state the fields that this step needs and that it lacks."""
        changes: dict[str, Any] = {}
        if "F" in self.law.state_fields and state.F is None:
            changes["F"] = identity_deformation(state.x)
        if "J" in self.law.state_fields and state.J is None:
            changes["J"] = torch.ones_like(state.mass)
        if missing := [name for name in self.law.extra_fields if name not in state.extra]:
            changes["extra"] = {**state.extra, **{name: torch.zeros_like(state.mass) for name in missing}}
        state = state.replace(**changes) if changes else state
        return state if self.heat is None else self.heat.prepare(state)

    def _update_grid(self, blocks: Blocks, nodes: Tensor, state: State, dt: float | Tensor) -> Tensor:
        velocity = grid_update(blocks, nodes, self._gravity(state.x), dt, self.walls)
        if self.boundaries:
            velocity = self._obstruct(blocks, velocity, state, dt)
        if self.on_grid is not None:
            velocity = self.on_grid(blocks, velocity, nodes[:, 0], dt)
        return velocity

    def _obstruct(self, blocks: Blocks, velocity: Tensor, state: State, dt: float | Tensor) -> Tensor:
        """The boundaries in turn; neighbours in the list that one op can take together."""
        time = state.time
        if isinstance(time, Tensor) and time.dim() == 0:
            time = time.to(velocity.device)  # a number of a compiled step
        nodes: tuple[Tensor, Tensor | None] | None = None
        for together, group in _neighbours(self.boundaries, time):
            if together:
                velocity = contact(blocks, velocity, group, time)
                continue
            if nodes is None:
                scene = None if state.scene is None else blocks.node_scene()
                nodes = (blocks.node_positions(state.x.dtype), scene)
            for boundary in group:
                velocity = boundary.apply(velocity, *nodes, time, dt)
        return velocity

    def _blend_flip(self, blocks: Blocks, state: State, affine: Tensor | None, velocity: Tensor, v: Tensor) -> Tensor:
        """(1 − flip) v_pic + flip (v_p + Σ N_i (v_i − v_i before the forces)) (Zhu and Bridson 2005)."""
        # P2G of the step has the impulse of the stress in it already, which is part of the change.
        mirrors = None if self.walls is None else self.walls.mirrors()
        before = grid_update(blocks, p2g(blocks, state.x, state.mass, state.v, affine), walls=mirrors)
        change, _, _ = gather(blocks, state.x, velocity - before)
        return (1 - self.flip) * v + self.flip * (state.v + change)

    def _gravity(self, x: Tensor) -> Tensor | None:
        if self.gravity is None or isinstance(self.gravity, Tensor):
            return self.gravity
        gravity = tuple(self.gravity)

        def make() -> Tensor:
            return torch.tensor(gravity, dtype=x.dtype, device=x.device).expand(self.grid.scenes, -1).contiguous()

        return self._kept_gravity.get((gravity, x.dtype, x.device), make, x)

    def stable_dt(self, state: State, cfl: float = 0.5) -> Tensor:
        """Largest stable time step of each scene [s], [B], times `cfl`; see `torch_mpm.cfl.stable_dt`."""
        transfer = "flip" if self.flip else self.transfer
        return stable_dt(self.grid, self.law, self.prepare(state), cfl, transfer, self.stress_form)

    @property
    def status(self) -> Tensor | None:
        """Status of all steps so far, int32 [8] on the device of the particles, see csrc/grid/status.h."""
        return self._activations.status

    def check(self, state: State | None = None) -> None:
        """Read the status of all steps so far, and look at a state if one is given; synchronises with the device.

        What CUDA graphs replay is among them, if the step had been taken once before it was captured.

        Raises:
            GridOverflowError: if more blocks were active than the grid has room for.
            SimulationError: if a particle left the grid or is not finite, if heat was not solved, or if the law has no
                meaning for a particle's deformation (turned inside out, J ≤ 0); such a particle has zero stress from
                then on.
        """
        for status in self._activations.all():
            check_status(status, self.grid)
        if self.heat is not None:
            self.heat.check()
        if state is not None:
            check_deformation(self.law, self.prepare(state))

    def reset(self) -> None:
        """Forget the status of the steps so far."""
        self._activations.reset()
        if self.heat is not None:
            self.heat.reset()


def _neighbours(boundaries: Sequence[Boundary], time: float | Tensor) -> list[tuple[bool, list[Any]]]:
    """Runs of boundaries that `contact` takes together, or not; `itertools.groupby` can't be compiled."""
    runs: list[tuple[bool, list[Any]]] = []
    for boundary in boundaries:
        together = fusible(boundary, time)
        if not runs or runs[-1][0] != together:
            runs.append((together, []))
        runs[-1][1].append(boundary)
    return runs


def check_status(status: Tensor, grid: Grid) -> None:
    """Raise a `SimulationError` for a status tensor of `activate` that tells of a problem."""
    peak, outside, first_outside, not_finite, first_not_finite, _, activation, _ = status.tolist()
    if not_finite > 0:
        raise SimulationError(
            f"{not_finite} particles have a position that is NaN or infinite, first at step {activation}, lowest index "
            f"{first_not_finite}: the time step was probably too large; compare dt with step.stable_dt(state)"
        )
    if outside > 0:
        raise SimulationError(
            f"{outside} particles left the grid [{grid.lower}, {grid.upper}], first at step {activation}, lowest index "
            f"{first_outside}: enlarge the domain, add walls, or reduce dt"
        )
    if grid.capacity is not None and peak > grid.capacity:
        raise GridOverflowError(
            f"{peak} blocks were active but the grid has a capacity of {grid.capacity}, first at step {activation}: "
            "pass a larger capacity, or None to let it grow"
        )


def check_deformation(law: Material, state: State) -> None:
    """Raise a `SimulationError` if the law has no meaning for the deformation of a particle."""
    invalid = law.invalid(state)
    if not bool(invalid.any()):
        return
    first = int(invalid.nonzero()[0, 0])
    scene = 0 if state.scene is None else int(state.scene[first])
    identity = first if state.ids is None else int(state.ids[first])
    raise SimulationError(
        f"{int(invalid.sum())} particles are inverted or not finite, lowest index {first} (id {identity}) in scene "
        f"{scene}: the time step was too large or the load crushed the material; compare dt with step.stable_dt(state)"
    )


def rollout(
    step: Callable[[State, float | Tensor], State],
    state: State,
    n: int,
    dt: float | Tensor,
    checkpoint: int | None = None,
) -> State:
    """The state n steps later.

    Args:
        step: a `Step`, or any function (state, dt) -> state.
        state: the initial state.
        n: number of steps.
        dt: time step [s].
        checkpoint: if given, keep for the backward pass only the state of every `checkpoint` steps and compute the
            steps between again (memory n/checkpoint + checkpoint states instead of n steps; sqrt(n) is best).

    Raises:
        ValueError: for a negative n or a checkpoint below 1.
    """
    if n < 0:
        raise ValueError(f"n must not be negative, got {n}")
    if checkpoint is not None and checkpoint < 1:
        raise ValueError(f"checkpoint must be at least 1, got {checkpoint}")

    def steps(state: State, count: int) -> State:
        for _ in range(count):
            state = step(state, dt)
        return state

    if checkpoint is None or not torch.is_grad_enabled():
        return steps(state, n)
    if isinstance(step, Step):
        state = step.prepare(state)
    done = 0
    while done < n:
        count = min(checkpoint, n - done)
        state = run_checkpointed(steps, state, count, use_reentrant=False)
        done += count
    return state
