"""Operations on particles before P2G: impulses, prescribed velocities, particles that appear and disappear.

`Step(on_particles=...)` accepts one of these, `Operations` for several, or any function or module (state, dt) -> state:

    def wind(state, dt):
        return state.replace(v=state.v + dt * acceleration)

It may return a pair (state, enabled) with bool [P]; particles that are not enabled take no part in the step. Choose
with `torch.where` rather than a mask as index, which synchronises with the device. Tensors per particle are in the
order of `state.ids` where particles were reordered; any may require grad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ..cuda_graphs.capture import DeviceConstantCache
from ..errors import check_number, check_vector, shape_of
from ..geometry.timed import tried
from ..laws.parameters import TensorModule
from ..ops.arguments import per_particle
from ..state.state import State
from .clocks import time_like

ParticleOperation = Callable[[State, "float | Tensor"], "State | tuple[State, Tensor]"]
Time = float | Tensor
"""Time [s]: a number, or a tensor [] or [P]."""
Vector = Sequence[float] | Tensor | Callable[[float | Tensor], Tensor]
"""Vector: D numbers, a tensor [D] or [P, D], or a function of the time of the state [s] that returns one of these."""


class Timed(TensorModule):
    """Operation on some particles while start ≤ time < end.

    Args:
        start, end: times [s]: numbers, or tensors [] or [P].
        particles: bool [P], the affected particles; None for all.

    Raises:
        TypeError, ValueError: for a wrong argument; shapes of tensors are checked in use.
    """

    def __init__(self, start: Time = 0.0, end: Time = math.inf, particles: Tensor | None = None) -> None:
        for name, value in (("start", start), ("end", end)):
            if not isinstance(value, Tensor):
                check_number(name, value, "a number", lambda v: v == v, "a number or a tensor")
            _refuse_grad(name, value)
        if particles is not None and (not isinstance(particles, Tensor) or particles.dtype != torch.bool):
            found = particles.dtype if isinstance(particles, Tensor) else shape_of(particles)
            raise TypeError(f"particles must be bool [P], got {found}")
        self.start, self.end, self.particles = start, end, particles

    def acting(self, state: State) -> bool | Tensor:
        """Particles affected now: True or False for all, or bool [] or [P]."""
        now = self._now(state)
        if self.particles is None or now is False:
            return now
        return of_particles("particles", self.particles, state, (len(state),)) & now

    def _now(self, state: State) -> bool | Tensor:
        time = state.time
        if isinstance(time, Tensor) and time.numel() > 1:
            time = per_particle(time, state.scene, len(state))
        for name in ("start", "end"):
            _refuse_grad(name, getattr(self, name))
        start, end = (of_particles(name, getattr(self, name), state, (len(state),)) for name in ("start", "end"))
        if any(isinstance(t, Tensor) for t in (time, start, end)):
            return (time >= start) & (time < end)
        return start <= time < end


class Push(Timed):
    """A force on each particle: v ← v + dt f/m.

    Args:
        force: force on each particle [N]; see `Vector`.
        start, end, particles: see `Timed`.
    """

    def __init__(self, force: Vector, start: Time = 0.0, end: Time = math.inf, particles: Tensor | None = None) -> None:
        super().__init__(start, end, particles)
        self.force, self._force = _checked_vector("force", force), _Numbers()

    def forward(self, state: State, dt: float | Tensor) -> State:
        acting = self.acting(state)
        if acting is False:
            return state
        if isinstance(dt, Tensor):
            dt = per_particle(dt.reshape(-1), state.scene, len(state)).to(state.x.dtype)[:, None]
        force = self._force.at("force", self.force, state)
        return _with_velocity(state, state.v + dt * force / state.mass[:, None], acting)


class Hold(Timed):
    """Prescribed velocity. `end` as a tensor [P] releases particles one after another.

    Args:
        velocity: [m/s]; see `Vector`.
        start, end, particles: see `Timed`.
    """

    def __init__(
        self, velocity: Vector, start: Time = 0.0, end: Time = math.inf, particles: Tensor | None = None
    ) -> None:
        super().__init__(start, end, particles)
        self.velocity, self._velocity = _checked_vector("velocity", velocity), _Numbers()

    def forward(self, state: State, dt: float | Tensor) -> State:
        acting = self.acting(state)
        if acting is False:
            return state
        return _with_velocity(state, self._velocity.at("velocity", self.velocity, state).expand_as(state.v), acting)


class Present(Timed):
    """Particles that are present only while start ≤ time < end, and stay in place before and after.

    Args:
        start, end, particles: see `Timed`; particles that are not among `particles` are always present.
    """

    def forward(self, state: State, dt: float | Tensor) -> State | tuple[State, Tensor]:
        now = self._now(state)
        if now is True:
            return state
        enabled = torch.zeros_like(state.mass, dtype=torch.bool) | now
        if self.particles is not None:
            enabled = enabled | ~of_particles("particles", self.particles, state, (len(state),))
        return state, enabled


class Operations(nn.ModuleList):
    """Several operations, one after another; a particle is enabled if all of them leave it enabled.

    Args:
        operations: modules (state, dt) -> state, or (state, enabled).
    """

    def forward(self, state: State, dt: float | Tensor) -> State | tuple[State, Tensor]:
        enabled: Tensor | None = None
        for operation in self:
            state, there = operated(operation, state, dt)
            if there is not None:
                enabled = there if enabled is None else enabled & there
        return state if enabled is None else (state, enabled)


def operated(operation: ParticleOperation, state: State, dt: float | Tensor) -> tuple[State, Tensor | None]:
    """State returned by an operation on the particles, and enabled particles; None for all.

    Raises:
        TypeError, ValueError: for another result.
    """
    result = operation(state, dt)
    after, enabled = result if isinstance(result, tuple) and len(result) == 2 else (result, None)
    if not isinstance(after, State) or len(after) != len(state):
        raise TypeError(
            f"on_particles must return a State of {len(state)} particles, or a pair of it and bool [P], "
            f"got {f'one of {len(after)}' if isinstance(after, State) else shape_of(after)}"
        )
    if enabled is not None and (not isinstance(enabled, Tensor) or enabled.shape != after.mass.shape):
        raise ValueError(f"enabled must have shape [P] = [{len(state)}], got {shape_of(enabled)}")
    if enabled is not None and enabled.dtype != torch.bool:
        raise TypeError(f"enabled must be bool, got {enabled.dtype}")
    return after, enabled


def of_particles(name: str, value: Any, state: State, shape: tuple[int, ...]) -> Any:
    """A number unchanged, or a tensor [], `shape[1:]`, or `shape` = [P, ...], the last in the order of the state; for a
    part of a state in the form of the whole.

    Raises:
        ValueError: for another shape, or a tensor on another device.
    """
    if not isinstance(value, Tensor):
        return value
    if value.is_complex():
        raise TypeError(f"{name} must have a real dtype, got {value.dtype}")
    if value.device != state.x.device:
        raise ValueError(f"{name} must be on the device of the particles, {state.x.device}, got {value.device}")
    whole = (getattr(state, "particles", shape[0]), *shape[1:])
    if tuple(value.shape) == whole:
        return value if state.ids is None else value.index_select(0, state.ids)
    if tuple(value.shape) not in ((), shape[1:]):
        raise ValueError(f"{name} must have shape {list(shape[1:])} or {list(whole)}, got {shape_of(value)}")
    return value


def _refuse_grad(name: str, value: Any) -> None:
    """Raise for a tensor by which particles are selected, and whose gradient would be lost."""
    if isinstance(value, Tensor) and value.requires_grad:
        raise ValueError(f"{name} must not require grad: which particles are affected is not differentiable")


def _checked_vector(name: str, value: Any) -> Any:
    return value if isinstance(value, Tensor) or callable(value) else check_vector(name, value)


class _Numbers:
    """A `Vector` at the time of a state; numbers are copied to a device once."""

    def __init__(self) -> None:
        self._kept = DeviceConstantCache()

    def at(self, name: str, value: Any, state: State) -> Tensor:
        """[D] or [P, D], in the order of the state."""
        if not callable(value):
            return self._given(name, value, state)
        time = time_like(state.time, state.x)
        if isinstance(time, Tensor) and time.numel() > 1:
            return self._at_times(name, value, time, state)
        return self._given(name, value(time.reshape(()) if isinstance(time, Tensor) else time), state)

    def _given(self, name: str, value: Any, state: State) -> Tensor:
        x = state.x
        if not isinstance(value, Tensor):
            numbers = check_vector(name, value, x.shape[1])
            key = (numbers, x.dtype, x.device)
            return self._kept.get(key, lambda: torch.tensor(numbers, dtype=x.dtype, device=x.device), x)
        return of_particles(name, value, state, tuple(x.shape)).to(x.dtype)

    def _at_times(self, name: str, function: Callable[[Any], Any], time: Tensor, state: State) -> Tensor:
        """The value of a function where scenes have times of their own [B].

        A function that does not return [P, D] for these, since it is written for one time, is called with the time of
        each scene. So is one for as many scenes as dimensions, where a product with the times has this shape too.
        """
        whole = getattr(state, "particles", len(state)), state.x.shape[1]
        value, problem = tried(lambda: function(time))
        if isinstance(value, Tensor) and tuple(value.shape) == whole and len(time) != whole[1]:
            return self._given(name, value, state)
        rows, refusal = tried(lambda: [self._given(name, function(one), state) for one in time.unbind()])
        if rows is None:
            if refusal is not None and problem is not None:
                raise refusal from problem
            return self._given(name, value, state)  # of a function of times [B] alone
        if all(row.dim() == 1 for row in rows):
            return per_particle(torch.stack(rows), state.scene, len(state))
        return _of_own_scene([row.expand_as(state.x) for row in rows], state)


def _of_own_scene(values: Sequence[Tensor], state: State) -> Tensor:
    """Values of all particles [P, D] for each scene, as those for the scene of each particle."""
    assert state.scene is not None
    result = values[0]
    for scene, value in enumerate(values[1:], 1):
        result = torch.where(state.scene.eq(scene)[:, None], value, result)
    return result


def _with_velocity(state: State, v: Tensor, acting: bool | Tensor) -> State:
    if acting is True:
        return state.replace(v=v)
    assert isinstance(acting, Tensor)
    return state.replace(v=torch.where(acting[..., None], v, state.v))
