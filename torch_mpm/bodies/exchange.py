"""Rigid bodies of other simulators as obstacles of a step: poses and velocities in, wrenches out.

    bodies = RigidBodies(step, [hand, [Part(jaw, (0.0, 0.1, 0.0)), Part(grip, (0.0, -0.1, 0.0))]])
    for _ in range(intervals):
        state, wrenches = bodies.advance(state, poses, n, dt)  # of n steps
        poses = simulator(wrenches, n * dt)

Two tensors pass between the simulators (docs/bodies.md), for B scenes of K bodies:

| | 3-D | 2-D |
|---|---|---|
| poses and velocities | [B, K, 13] | [B, K, 6] |
| wrenches | [B, K, 6] | [B, K, 3] |

A pose is a position [m] and a unit quaternion w, x, y, z, or an angle [rad] in 2-D. A velocity [m/s] and an angular
velocity [rad/s] follow. A wrench is a force [N], and a torque about the position of the body [N m].

All are in the frame of the world. The position is any point that is fixed to the body; the centre of mass, where the
simulator integrates about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..boundaries.motion import rotation_matrix
from ..boundaries.obstacles import Obstacle
from ..cuda_graphs.capture import is_readable
from ..errors import FLOATING, check_count, check_number, check_vector, shape_of
from ..geometry.values import filled
from ..geometry.vectors import composed, quaternion, rotation_vector
from ..grid.grid import Grid
from ..rollouts import rollout
from ..state.state import State, check_state
from ..step.step import Step

NOT_UNIT = 1e-3
"""Largest deviation of the length of a quaternion from 1."""
POSE = {2: 3, 3: 7}
"""Numbers of a pose by dimension."""
VELOCITY = {2: 3, 3: 6}
"""Numbers of a velocity and an angular velocity, or of a wrench, by dimension."""


class Part:
    """An obstacle that is fixed to a body.

    Args:
        obstacle: a boundary of the step.
        position: its centre in the frame of the body [m], D numbers; None for the origin.
        rotation: its orientation there [rad], an angle (2-D) or a rotation vector of 3 numbers; None for none.

    Raises:
        TypeError, ValueError: for anything but an `Obstacle`, one on a path, or numbers that are not finite.
    """

    def __init__(
        self,
        obstacle: Obstacle,
        position: Sequence[float] | None = None,
        rotation: float | Sequence[float] | None = None,
    ) -> None:
        if not isinstance(obstacle, Obstacle):
            raise TypeError(f"obstacle must be an Obstacle, got {shape_of(obstacle)}")
        if obstacle.follows_path:
            raise ValueError("obstacle must have numbers as position, got a function of time")
        self.obstacle = obstacle
        self.position = None if position is None else check_vector("position", position)
        self.rotation: float | tuple[float, ...] | None = None
        if isinstance(rotation, Sequence):
            self.rotation = check_vector("rotation", rotation, 3)
        elif rotation is not None:
            self.rotation = float(check_number("rotation", rotation))

    def check_dimension(self, dim: int) -> None:
        """Raise ValueError for a pose of another dimension than D."""
        if self.position is not None and len(self.position) != dim:
            raise ValueError(f"position of a part must have {dim} numbers, got {self.position}")
        if self.rotation is not None and isinstance(self.rotation, tuple) != (dim == 3):
            expected = "an angle in 2-D" if dim == 2 else "a rotation vector of 3 numbers in 3-D"
            raise ValueError(f"rotation of a part must be {expected}, got {self.rotation}")


class Motion(NamedTuple):
    """Poses and velocities of K bodies in B scenes; rotations are angles (2-D) or rotation vectors (3-D)."""

    position: Tensor  # [B, K, D] [m]
    rotation: Tensor  # [B, K] or [B, K, 3] [rad]
    velocity: Tensor  # [B, K, D] [m/s]
    angular_velocity: Tensor  # [B, K] or [B, K, 3] [rad/s]


class RigidBodies:
    """Obstacles of a step that move as rigid bodies of another simulator.

    Args:
        step: the step, whose boundaries contain the obstacles.
        bodies: for each of K bodies an obstacle, a `Part`, or a list of these. An obstacle alone has the pose of the
            body. Their position, rotation, velocity and angular velocity are assigned by `move`.

    Raises:
        TypeError, ValueError: for anything else, a body without an obstacle, an obstacle that is not among the
            boundaries of the step or belongs to two bodies.
    """

    def __init__(self, step: Step, bodies: Sequence[Obstacle | Part | Sequence[Obstacle | Part]]) -> None:
        if not isinstance(step, Step):
            raise TypeError(f"step must be a Step, got {shape_of(step)}")
        if not isinstance(bodies, Sequence):
            raise TypeError(f"bodies must be a list of obstacles, parts and lists of them, got {shape_of(bodies)}")
        self.step = step
        self.parts = [parts_of(k, body) for k, body in enumerate(bodies)]
        known = {id(boundary) for boundary in step.boundaries}
        for k, parts in enumerate(self.parts):
            for part in parts:
                part.check_dimension(step.grid.dim)
                if id(part.obstacle) not in known:
                    raise ValueError(
                        f"obstacles of body {k} must be boundaries of the step, and those of no other body"
                    )
                known.remove(id(part.obstacle))
        self._frames = Frames.of(self.parts, step.grid.dim)

    def __len__(self) -> int:
        return len(self.parts)

    def move(self, bodies: Tensor, state: State) -> None:
        """Put the bodies at poses, from which they move with constant velocities in the steps from a state on.

        They are there at once, and push nothing on their way there.

        Args:
            bodies: poses and velocities [B, K, 13] (3-D) or [B, K, 6] (2-D), see `torch_mpm.bodies.exchange`; float32
                or float64. Differentiable.
            state: the state at the beginning of the steps.

        Raises:
            TypeError, ValueError: for another shape, dtype or device, and on the CPU for numbers that are not finite
                and quaternions whose length differs from 1 by more than a thousandth.
        """
        check_state(state)
        check_bodies(bodies, state, self.step.grid, len(self))
        of_obstacles = self._frames.motion(motion_of(bodies.double(), self.step.grid.dim))
        assign([part.obstacle for parts in self.parts for part in parts], of_obstacles, state.time)

    def impulses(self, before: State, after: State, about: Tensor | None = None) -> Tensor:
        """Impulses of the material on the bodies between two states.

        Args:
            before, after: states that count impulses (`Step.with_impulses`).
            about: points of the moments [B, K, D] or more columns, such as poses [m]; None for the origin.

        Returns:
            [B, K, 6] (3-D) or [B, K, 3] (2-D), float64: linear [N s] and angular [N m s].

        Raises:
            ValueError: for states that count no impulses, or points of another shape.
        """
        check_state(before)
        check_state(after)
        on = self.step.impulses(after) - self.step.impulses(before)
        rows, dim, scenes = [], self.step.grid.dim, self.step.grid.scenes
        if about is not None and (about.dim() != 3 or about.shape[:2] != (scenes, len(self)) or about.shape[2] < dim):
            raise ValueError(f"about must have shape [B, K, D] = {[scenes, len(self), dim]}, got {shape_of(about)}")
        for k, parts in enumerate(self.parts):
            point = about[:, k, :dim].double() if about is not None else None
            parts_on = [on[part.obstacle] for part in parts]
            linear = torch.stack([i.linear for i in parts_on]).sum(0)
            angular = torch.stack([i.angular if point is None else i.about(point) for i in parts_on]).sum(0)
            rows.append(torch.cat([linear, angular.reshape(len(linear), -1)], 1))
        return torch.stack(rows, 1)

    def advance(self, state: State, bodies: Tensor, n: int, dt: float | Tensor) -> tuple[State, Tensor]:
        """The state n steps later, and the mean wrenches of the material on the bodies in these steps.

        Args:
            state: counts impulses from here on if it does not yet.
            bodies: poses at the beginning, and velocities during the steps; see `move`.
            n, dt: number of steps, at least 1, and time step [s]; see `rollout`.

        Returns:
            The state, and [B, K, 6] (3-D) or [B, K, 3] (2-D), float64: forces [N] and torques [N m] about the positions
            in `bodies`. They are impulses divided by n dt, zero in scenes that are paused.

        Raises:
            TypeError, ValueError: as `move` and `rollout`.
        """
        check_count("n", n, 1)
        check_state(state)
        if state.impulse is None:
            state = self.step.with_impulses(state)
        self.move(bodies, state)
        after = rollout(self.step, state, n, dt)
        impulses = self.impulses(state, after, bodies)
        if not isinstance(dt, Tensor):
            return after, impulses / (n * dt)
        seconds = n * dt.to(impulses).reshape(-1, 1, 1)
        return after, torch.where(seconds > 0, impulses / torch.where(seconds > 0, seconds, 1.0), 0.0)


def check_bodies(bodies: Any, state: State, grid: Grid, count: int) -> None:
    """Check poses and velocities [B, K, 13] (3-D) or [B, K, 6] (2-D) of a number of bodies.

    Raises:
        TypeError, ValueError: for another shape, dtype or device, and on the CPU for numbers that are not finite and
            quaternions whose length differs from 1 by more than a thousandth.
    """
    columns = POSE[grid.dim] + VELOCITY[grid.dim]
    shape = grid.scenes, count, columns
    if not isinstance(bodies, Tensor) or bodies.shape != shape:
        raise ValueError(f"bodies must have shape [B, K, {columns}] = {list(shape)}, got {shape_of(bodies)}")
    if bodies.dtype not in FLOATING:
        raise TypeError(f"bodies must be float32 or float64, got {bodies.dtype}")
    if bodies.device != state.x.device:
        raise ValueError(f"bodies must be on the device of the state, {state.x.device}, got {bodies.device}")
    if not is_readable(bodies):
        return
    values = bodies.detach()
    _check_rows(~values.isfinite().all(2), "bodies must be finite, got NaN or infinity")
    if grid.dim == 3:
        wrong = (values[..., 3:7].norm(dim=2) - 1).abs() > NOT_UNIT
        _check_rows(wrong, "bodies must have unit quaternions w, x, y, z in columns 3 to 6, got another length")


def motion_of(bodies: Tensor, dim: int) -> Motion:
    """Poses and velocities [B, K, 13] (3-D) or [B, K, 6] (2-D) by their parts."""
    spin = bodies[..., POSE[dim] + dim :]
    return Motion(
        bodies[..., :dim],
        rotation_of(bodies, dim),
        bodies[..., POSE[dim] : POSE[dim] + dim],
        spin[..., 0] if dim == 2 else spin,
    )


def rotation_of(poses: Tensor, dim: int) -> Tensor:
    """Rotations of poses [..., 3 or 7], with or without further columns: angles [...] or rotation vectors [..., 3]."""
    return poses[..., 2] if dim == 2 else rotation_vector(poses[..., 3:4], poses[..., 4:7])


def with_velocities(poses: Tensor, later: Tensor, seconds: float) -> Tensor:
    """Poses with the constant velocities that lead from them to later poses.

    Args:
        poses, later: [B, K, 7] (3-D) or [B, K, 3] (2-D), or with further columns, which are ignored.
        seconds: the time in between [s], positive.

    Returns:
        [B, K, 13] (3-D) or [B, K, 6] (2-D); rotations by the smallest angle.

    Raises:
        TypeError, ValueError: for another time or shape.
    """
    check_number("seconds", seconds, "positive and finite", lambda v: 0 < v < math.inf)
    dim = _dim_of("poses", poses, 0, 1)
    if _dim_of("later", later, 0, 1) != dim:
        raise ValueError(f"later must have the dimension of poses, {dim}, got {shape_of(later)}")
    pose = poses[..., : POSE[dim]]
    if dim == 2:
        change = later[..., :3] - pose
        turn = torch.remainder(change[..., 2:] + math.pi, 2 * math.pi) - math.pi
        return torch.cat([pose, change[..., :2] / seconds, turn / seconds], -1)
    begin, end = (rotation_vector(p[..., 3:4], p[..., 4:7]) for p in (pose, later))
    return torch.cat([pose, (later[..., :3] - pose[..., :3]) / seconds, composed(end, -begin) / seconds], -1)


def moved(bodies: Tensor, seconds: float) -> Tensor:
    """Poses to which constant velocities lead; differentiable.

    Args:
        bodies: poses and velocities [B, K, 13] (3-D) or [B, K, 6] (2-D).
        seconds: the time in between [s].

    Returns:
        [B, K, 7] (3-D) or [B, K, 3] (2-D).

    Raises:
        TypeError, ValueError: for another time or shape.
    """
    check_number("seconds", seconds)
    dim = _dim_of("bodies", bodies, 1)
    if dim == 2:
        return bodies[..., :3] + seconds * bodies[..., 3:]
    motion = motion_of(bodies, dim)
    turned = quaternion(composed(seconds * motion.angular_velocity, motion.rotation))
    return torch.cat([motion.position + seconds * motion.velocity, *turned], -1)


def _dim_of(name: str, bodies: Tensor, *velocities: int) -> int:
    """Dimension of poses without (0) or with (1) velocities."""
    columns = {POSE[dim] + more * VELOCITY[dim]: dim for dim in POSE for more in velocities}
    if not isinstance(bodies, Tensor) or bodies.dim() != 3 or bodies.shape[2] not in columns:
        three_d = " or ".join(f"[B, K, {n}]" for n, dim in columns.items() if dim == 3)
        two_d = " or ".join(str(n) for n, dim in columns.items() if dim == 2)
        raise ValueError(f"{name} must have shape {three_d}, or {two_d} in 2-D, got {shape_of(bodies)}")
    return columns[bodies.shape[2]]


def parts_of(k: int, body: Obstacle | Part | Sequence[Obstacle | Part]) -> list[Part]:
    """The parts of body k."""
    given = list(body) if isinstance(body, Sequence) else [body]
    if not given:
        raise ValueError(f"body {k} must have an obstacle, got none")
    return [part if isinstance(part, Part) else Part(part) for part in given]


class Frames(NamedTuple):
    """Where the O obstacles of bodies are in the frames of these."""

    owner: Tensor  # [O], number of the body
    position: Tensor  # [O, D] [m]
    rotation: Tensor  # [O] or [O, 3] [rad]

    @staticmethod
    def of(parts: Sequence[Sequence[Part]], dim: int) -> Frames:
        flat = [part for own in parts for part in own]
        zero = 0.0 if dim == 2 else (0.0,) * 3
        owner = torch.tensor([k for k, own in enumerate(parts) for _ in own], dtype=torch.int64)
        position = torch.tensor([part.position or (0.0,) * dim for part in flat], dtype=torch.float64)
        turn = torch.tensor([zero if part.rotation is None else part.rotation for part in flat], dtype=torch.float64)
        return Frames(owner, position.reshape(-1, dim), turn.reshape(-1, *(3,) * (dim - 2)))

    def flat(self) -> Tensor:
        """Positions and rotations side by side [O, D + 1 or 3]."""
        return torch.cat([self.position, self.rotation.reshape(len(self.owner), -1)], 1)

    def to(self, device: torch.device) -> Frames:
        """The same on a device."""
        return Frames(*(values.to(device, non_blocking=True) for values in self))

    def arms(self, rotation: Tensor) -> Tensor:
        """Vectors from the positions of the bodies to the centres of the obstacles [B, O, D] [m], by the rotations of
        the bodies [B, K] or [B, K, 3]."""
        turn = rotation_matrix(rotation[:, self.owner], self.position.shape[1])
        return (turn @ self.position[..., None])[..., 0]

    def motion(self, of_bodies: Motion) -> Motion:
        """Motion of the obstacles [B, O, ...] by that of their bodies [B, K, ...]."""
        frames = self.to(of_bodies.position.device)
        motion, arm = Motion(*(values[:, frames.owner] for values in of_bodies)), frames.arms(of_bodies.rotation)
        return Motion(
            motion.position + arm,
            _turned(motion.rotation, frames.rotation.expand_as(motion.rotation)),
            motion.velocity + swirl(motion.angular_velocity, arm),
            motion.angular_velocity,
        )


def assign(obstacles: Sequence[Obstacle], motion: Motion, time: float | Tensor) -> None:
    """Place O obstacles with a motion [B, O, ...] from a time [s], [] or [B]."""
    like = motion.position
    starts = filled([obstacle.start for obstacle in obstacles], like)
    now = time.to(like) if isinstance(time, Tensor) else filled(time, like)
    elapsed = now.reshape(-1, 1) - starts
    column = elapsed[..., None]
    # A pose beside a velocity is that at `start`.
    centre = motion.position - motion.velocity * column
    spin = motion.angular_velocity
    rotation = _turned(-spin * (elapsed if spin.dim() == 2 else column), motion.rotation)
    for k, obstacle in enumerate(obstacles):
        obstacle.velocity, obstacle.angular_velocity = motion.velocity[:, k], spin[:, k]
        obstacle.place(centre[:, k], rotation[:, k])


def swirl(spin: Tensor, arm: Tensor) -> Tensor:
    """Velocities by rotation, of points away from the position [..., D]."""
    if arm.shape[-1] == 3:
        return torch.linalg.cross(spin, arm)
    return spin[..., None] * torch.stack([-arm[..., 1], arm[..., 0]], -1)


def _turned(turn: Tensor, rotation: Tensor) -> Tensor:
    """A rotation followed by a turn: angles [B, O] or rotation vectors [B, O, 3]."""
    return turn + rotation if rotation.dim() == 2 else composed(turn, rotation)


def _check_rows(wrong: Tensor, sentence: str) -> None:
    """Raise ValueError that names the first of the bodies that are wrong, bool [B, K]."""
    if bool(wrong.any()):
        scene, body = wrong.nonzero()[0].tolist()
        raise ValueError(f"{sentence} for body {body} of scene {scene}")
