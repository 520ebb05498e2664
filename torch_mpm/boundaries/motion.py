"""Rigid motion: pose of a body at a time, and velocity of its matter."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from ..cuda_graphs.capture import is_readable
from ..geometry.per_scene import SceneParameters, per_node
from ..geometry.timed import Path, at_each, tried, vector_at
from ..geometry.values import Value, finite, shape_of_value
from ..geometry.vectors import norm, transform
from ..ops.autograd import graph_at_once
from .waypoints import Waypoints

PACE = 1e-4
"""Time over which a path without a derivative is differenced, unless a step sets it [s]."""


class Pose(NamedTuple):
    """Pose of a body: world = centre + rotation @ body."""

    centre: Tensor  # [D] or [B, D]
    rotation: Tensor  # [D, D] or [B, D, D]


def _checked_position(name: str, value: Any) -> Any:
    if value is None:
        raise TypeError(f"{name} must be numbers, a tensor or a function of time, got None")
    return value if callable(value) else finite(name, value)


class RigidMotion(SceneParameters):
    """A body that moves and turns at constant rates from time `start` on, or along a path.

    During a call of a step another motion, `control`, may replace it; see `boundaries.control`.

    Args:
        position: of its centre at time `start` [m]: [D] or [B, D] in any form of `geometry.values.Value`, or a function
            of the time that returns one of these, see `geometry.timed.vector_at`.
        velocity: of its centre [m/s], [D] or [B, D]; None where position is a function.
        rotation: orientation at time `start` [rad]: an angle (2-D) or a rotation vector (3-D), about the centre.
        angular_velocity: [rad/s], in the same forms.
        start: [s]

    Raises:
        TypeError, ValueError: for a value of another form or that is not finite, also where it is assigned; values of
            tensors on other devices than the CPU are not read.
    """

    RANKS: ClassVar = {"position": 1, "velocity": 1, "rotation": None, "angular_velocity": None}
    CHECKS: ClassVar = {
        "position": _checked_position,
        "velocity": finite,
        "rotation": finite,
        "angular_velocity": finite,
    }

    def __init__(
        self,
        position: Value | Path,
        velocity: Value | None,
        rotation: Value | None,
        angular_velocity: Value | None,
        start: float,
    ) -> None:
        if callable(position) and velocity is not None:
            raise ValueError("velocity must be None where position is a function of time: it is its derivative")
        self.position, self.velocity = position, velocity
        self.rotation, self.angular_velocity = rotation, angular_velocity
        self.start = float(start)
        self.end = math.inf
        self.pace: float | Tensor = PACE
        """Length of the steps [s], over which a path is differenced, up to `end`."""

    @property
    def motion(self) -> RigidMotion:
        """Current motion: that of `control` during a control step, otherwise that of the attributes."""
        control = self._modules.get("control")
        return self if control is None else control  # type: ignore[return-value]

    @property
    def follows_path(self) -> bool:
        """Whether the position is a function of time."""
        position = self.motion.position
        return not isinstance(position, Tensor) and callable(position)

    @property
    def moves(self) -> bool:
        """Whether its surface ever has a velocity."""
        motion = self.motion
        return self.follows_path or motion.velocity is not None or motion.angular_velocity is not None

    def pose(self, time: float | Tensor, like: Tensor | None = None) -> Pose:
        """Centre and rotation at a time [s], a number or a tensor [] or [B]; with the dtype and device of `like`."""
        like = torch.empty(0, dtype=torch.float64, device="cpu") if like is None else like
        centre = self.centre_at(time, like)
        dim = centre.shape[-1]
        rotation = self.rotation_at(time, like, dim)
        return Pose(centre, torch.eye(dim, dtype=like.dtype, device=like.device) if rotation is None else rotation)

    def centre_at(self, time: float | Tensor, like: Tensor) -> Tensor:
        """Centre at a time, [D] or [B, D]."""
        motion = self.motion
        if self.follows_path:
            now = _as_time(time, like)
            return motion._checked_path(now, motion.at(now), like).to(like.dtype)
        position = motion.parameter("position", like, shape_of_value(motion.value_of("position"))[-1:] or (1,))
        if motion.velocity is None:
            return position
        velocity = motion.parameter("velocity", like, position.shape[-1:])
        return position + velocity * _column(self._elapsed(time, like), 1)

    def rotation_at(self, time: float | Tensor, like: Tensor, dim: int) -> Tensor | None:
        """Rotation at a time, [D, D] or [B, D, D]; None for a body that never turns."""
        shape = () if dim == 2 else (3,)
        rotation, motion = None, self.motion
        if motion.rotation is not None:
            rotation = rotation_matrix(motion.parameter("rotation", like, shape), dim)
        if motion.angular_velocity is not None:
            rate = motion.parameter("angular_velocity", like, shape)
            turn = rotation_matrix(rate * _column(self._elapsed(time, like), len(shape)), dim)
            rotation = turn if rotation is None else turn @ rotation
        return rotation

    def velocity_at(self, arm: Tensor, scene: Tensor | None, time: float | Tensor) -> Tensor | None:
        """Velocity of the body's matter [N, D] at points `arm` [N, D] away from the centre; None at rest."""
        result, motion = None, self.motion
        if self.follows_path:
            result = per_node(motion._path(time, arm)[1], 1, scene)
        elif motion.velocity is not None:
            result = motion.at_nodes("velocity", arm, arm.shape[1:], scene)
        if motion.angular_velocity is None:
            return result
        if arm.shape[1] == 2:
            rate = motion.at_nodes("angular_velocity", arm, (), scene)[..., None]
            swirl = rate * torch.stack([-arm[:, 1], arm[:, 0]], 1)
        else:
            rate = motion.at_nodes("angular_velocity", arm, (3,), scene)
            swirl = torch.linalg.cross(rate.expand_as(arm), arm)
        return swirl if result is None else result + swirl

    def _path(self, time: float | Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Centre and its velocity, for a position that is a function of time."""
        now = _as_time(time, like)
        centre, velocity = self._moved(now)
        return self._checked_path(now, centre, like).to(like.dtype), velocity.to(like.dtype)

    def path_over(self, times: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Centre and its velocity at many times [n] or [n, B]: [n, 1 or B, D], with the dtype of `like`.

        A function of time is called for all times at once if torch.vmap can map it, otherwise for one after another. It
        is called for its value, its derivative and its difference, and once more to check a derivative that differs.
        """
        centre = self._checked_path(times, at_each(self.at, times), like)
        shape = len(times), -1, like.shape[1]
        rates = self._differenced(lambda t: at_each(self.at, t), times, centre, self._rates(times, centre))
        return centre.to(like.dtype).reshape(shape), rates.to(like.dtype).reshape(shape)

    def at(self, time: Tensor) -> Tensor:
        """The position that a function of time returns, as a tensor; see `geometry.timed.vector_at`."""
        assert callable(self.motion.position)
        return vector_at("position", self.motion.position, time)

    def _checked_path(self, times: Tensor, centre: Tensor, like: Tensor) -> Tensor:
        """Result of a function of time. NaN is an error where it can be read: such a body would touch nothing."""
        if like.dim() == 2 and centre.shape[-1] != like.shape[1]:
            expected = f"[{like.shape[1]}] or [B, {like.shape[1]}]"
            raise ValueError(f"position must return {expected} at a time, got {list(centre.shape[times.dim() :])}")
        if is_readable(centre):
            there = (times >= self.start) & (times < self.end)
            finite = centre.detach().isfinite().all(-1)
            if not bool((finite | ~there.reshape(there.shape + (1,) * (finite.dim() - there.dim()))).all()):
                raise ValueError("position must return finite numbers at a time, got NaN or infinity")
        return centre

    def _rates(self, times: Tensor, centre: Tensor) -> Tensor:
        """Derivatives of centres by their times, zero without one. In reverse mode for one centre per time, since
        forward mode imports compilers, which takes a second."""
        if centre.dim() > times.dim() + 1:
            return torch.stack([self._derivative(time)[1] for time in times.unbind()])
        trained = centre.requires_grad
        with torch.inference_mode(False), torch.enable_grad(), graph_at_once():
            leaf = times.detach().clone().requires_grad_()
            again, _ = tried(lambda: at_each(self.at, leaf))
            if again is None:  # as of functions of NumPy, which have no derivative
                return torch.zeros_like(centre)
            rates = [torch.zeros_like(leaf) for _ in again.unbind(-1)]
            for k, part in enumerate(again.unbind(-1)):
                if part.requires_grad:
                    (rate,) = torch.autograd.grad(part.sum(), leaf, None, True, trained, allow_unused=True)
                    rates[k] = rates[k] if rate is None else rate
        return torch.stack(rates, -1)

    def _moved(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Position on the path and its velocity."""
        centre, rate = self._derivative(time)
        return centre, self._differenced(self.at, time, centre, rate)

    def _derivative(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Position on the path and its derivative, zero without one."""
        both, _ = tried(lambda: torch.func.jvp(self.at, (time,), (torch.ones_like(time),)))
        if both is not None:
            return both[0], both[1]
        centre = self.at(time)  # as of functions of NumPy. One that is wrong raises again.
        return centre, torch.zeros_like(centre)

    def _differenced(self, path: Callable[[Tensor], Tensor], times: Tensor, centre: Tensor, rate: Tensor) -> Tensor:
        """The derivative of a path, or its difference over a step if that is zero: a path of numbers has none.
        Both are zero for a path at rest. A path that is partly of numbers has a derivative of the rest alone: it
        differs from the differences over both halves of the step, which agree, unlike those of a path that jumps."""
        if isinstance(self.position, Waypoints):  # whose derivative is exact
            return rate
        resolution = 4 * torch.finfo(times.dtype).eps * times.abs()
        later = torch.maximum(times + self.pace, times + resolution).clamp(max=self.end)
        there = later > times
        seconds, there = (
            t.reshape(*t.shape, *(1,) * (centre.dim() - times.dim()))
            for t in (torch.where(there, later - times, 1), there)
        )
        end = path(later)
        difference = (end - centre) / seconds
        wrong, absent = (difference - rate).detach().abs(), rate == 0
        rounding = 32 * torch.finfo(centre.dtype).eps * centre.detach().abs() / seconds
        other = there & ~absent & (wrong > 0.1 * difference.detach().abs() + rounding)
        if not is_readable(other) or bool(other.any()):
            middle = path(times + 0.5 * (later - times))
            change = 2 * (end - 2 * middle + centre).detach().abs() / seconds  # About `wrong` for a smooth path.
            absent = absent | (other & (change < 0.25 * wrong))
        return torch.where(absent & difference.isfinite(), difference, rate)

    def _elapsed(self, time: float | Tensor, like: Tensor) -> float | Tensor:
        """Time since `start`, [] or [B]."""
        return (time - self.start).to(like.dtype) if isinstance(time, Tensor) else time - self.start


def to_body(rotation: Tensor | None, arm: Tensor) -> Tensor:
    """Vectors [N, D] of the world in coordinates of a body with a rotation [D, D] or [N, D, D]; None for no turn."""
    return arm if rotation is None else transform(rotation.mT, arm)


def rotation_matrix(angle: Tensor, dim: int) -> Tensor:
    """Rotation by an angle [...] (2-D) or a rotation vector [..., 3] (3-D) [rad], as matrices [..., D, D].

    3-D by the formula of Rodrigues; twice differentiable, also at the zero vector.
    """
    if dim == 2:
        c, s = angle.cos(), angle.sin()
        return torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    half = 0.5 * norm(angle)[..., None, None]
    x, y, z = angle.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    cross = torch.stack(rows, -2)
    turned = torch.where(half > 0, half, 1)
    s = torch.where(half > 0, turned.sin() / turned, 1)
    first, second = s * half.cos(), 0.5 * s * s
    return torch.eye(3, dtype=angle.dtype, device=angle.device) + first * cross + second * (cross @ cross)


def _as_time(time: float | Tensor, like: Tensor) -> Tensor:
    """A time [] or [B] with the dtype of `like`."""
    if isinstance(time, Tensor):
        return time.to(like.dtype)
    return torch.full((), time, dtype=like.dtype, device=like.device)


def _column(time: float | Tensor, rank: int) -> float | Tensor:
    """Times [] or [B] as factors of values [...] or [B, ...] of `rank` dimensions."""
    return time.reshape(time.shape + (1,) * rank) if isinstance(time, Tensor) and time.dim() else time
