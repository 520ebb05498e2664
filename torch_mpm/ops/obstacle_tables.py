"""Obstacles as arguments of ops: tables of their parameters, once or at each of many times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from ..boundaries.obstacles import Obstacle
from ..geometry.per_scene import SceneParameters
from ..step.clocks import StepTimes


def tables(obstacles: Sequence[Obstacle], like: Tensor, scenes: int) -> tuple[Tensor, Tensor]:
    """Parameters [1 or B, K, width] and data [n] of the shapes; cached while nothing has changed."""
    if torch.compiler.is_compiling() or type(like) not in (Tensor, torch.nn.Parameter):
        return _build(obstacles, like, scenes)
    values = [v for o in obstacles for v in _values(o)]
    if torch.is_grad_enabled() and any(isinstance(v, Tensor) and v.requires_grad for v in values):
        return _build(obstacles, like, scenes)
    key = like.dtype, like.device, scenes, *values
    kept: tuple[Tensor, Tensor] = obstacles[0].kept_table.get(key, lambda: _build(obstacles, like, scenes), like)
    return kept


def tables_without_motion(obstacles: Sequence[Obstacle], like: Tensor, scenes: int) -> tuple[Tensor, Tensor]:
    """`tables` whose columns of poses and velocities are zero, for ops that compute these; not cached."""
    _check_scenes(obstacles, like, scenes)
    rows = [_joined(_parts(o, like, moves=False)) for o in obstacles]
    count = _count([row.shape[0] for row in rows], scenes)
    table = torch.stack([row.expand(count, -1) for row in rows], 1).contiguous()
    return table, torch.cat([o.shape.data(like) for o in obstacles])


def tables_over(obstacles: Sequence[Obstacle], like: Tensor, scenes: int, times: StepTimes) -> tuple[Tensor, Tensor]:
    """Parameters at many times, with the positions at each, [n, 1 or B, K, width]; and data as in `tables`."""
    _check_scenes(obstacles, like, scenes)
    rows = [_row_over(o, like, times) for o in obstacles]
    count = _count([row.shape[1] for row in rows], scenes)
    table = torch.stack([row.expand(-1, count, -1) for row in rows], 2).contiguous()
    return table, torch.cat([o.shape.data(like) for o in obstacles])


def _values(obstacle: Obstacle) -> tuple[Any, ...]:
    """An obstacle, its shape, and the numbers and tensors of both that enter the tables."""
    moved = obstacle.motion
    return (
        *values_without_motion(obstacle),
        *(moved.position, moved.velocity, moved.rotation, moved.angular_velocity),
    )


def values_without_motion(obstacle: Obstacle) -> tuple[Any, ...]:
    """An obstacle, its shape, and the numbers and tensors of both that enter `tables_without_motion`."""
    shape = obstacle.shape
    return (obstacle, shape, obstacle.friction, *[getattr(shape, name) for name in shape.arguments])


def _build(obstacles: Sequence[Obstacle], like: Tensor, scenes: int) -> tuple[Tensor, Tensor]:
    _check_scenes(obstacles, like, scenes)
    rows = [_joined(_parts(o, like)) for o in obstacles]
    count = _count([row.shape[0] for row in rows], scenes)
    table = torch.stack([row.expand(count, -1) for row in rows], 1).contiguous()
    return table, torch.cat([o.shape.data(like) for o in obstacles])


def _check_scenes(obstacles: Sequence[Obstacle], like: Tensor, scenes: int) -> None:
    for obstacle in obstacles:
        obstacle.check_scenes(like.shape[1], scenes)


def _count(counts: Sequence[int], scenes: int) -> int:
    """Rows of a table, with the given number of rows per obstacle."""
    count = max(counts)
    if count not in (1, scenes) or any(own not in (1, count) for own in counts):
        raise ValueError(f"parameters of obstacles must be given once or per scene, B = {scenes}, got {count} of them")
    return count


def _parts(obstacle: Obstacle, like: Tensor, moves: bool = True) -> dict[str, Tensor]:
    """Columns of its row by name, [1 or B, n] each; zero where it has none, or where a path gives its position, and
    those of its motion unless it moves."""
    vector, shape = (like.shape[1],), obstacle.shape
    turn = () if like.shape[1] == 2 else (3,)
    motion = {"position": vector, "velocity": vector, "rotation": turn, "angular_velocity": turn}
    absent = {"position"} if obstacle.follows_path else set()
    absent |= {name for name in motion if not moves or getattr(obstacle.motion, name) is None}
    parts = {"friction": _part(obstacle, "friction", like, ())}
    for name, size in motion.items():
        parts[name] = _part(obstacle.motion, None if name in absent else name, like, size)
    parts["vector"] = _part(shape, shape.vector, like, vector)
    return parts | {"radius": _part(shape, "radius" if "radius" in shape.RANKS else None, like, ())}


def _part(owner: SceneParameters, name: str | None, like: Tensor, shape: tuple[int, ...]) -> Tensor:
    """A parameter [1 or B, n]; zero where there is none."""
    if name is None:
        return like.new_zeros(1, math.prod(shape))
    value = owner.parameter(name, like, shape)
    return value.reshape(1 if value.dim() == len(shape) else value.shape[0], -1)


def _joined(parts: dict[str, Tensor]) -> Tensor:
    """Columns [..., 1 or B, n] as one row [..., 1 or B, width]."""
    # By hand: torch.broadcast_shapes imports sympy, which takes two seconds.
    shape = [max(sizes) for sizes in zip(*(part.shape[:-1] for part in parts.values()), strict=True)]
    return torch.cat([part.expand(*shape, -1) for part in parts.values()], -1)


def _row_over(obstacle: Obstacle, like: Tensor, times: StepTimes) -> Tensor:
    """[n, 1 or B, width]."""
    parts = {name: part[None] for name, part in _parts(obstacle, like).items()}
    if obstacle.follows_path:
        parts["position"], parts["velocity"] = _path_over(obstacle, like, times)
    else:
        elapsed = (times.tensor - obstacle.start).to(like.dtype)
        parts["position"] = parts["position"] + parts["velocity"] * elapsed.reshape(len(elapsed), -1, 1)
    return _joined(parts)


def _path_over(obstacle: Obstacle, like: Tensor, times: StepTimes) -> tuple[Tensor, Tensor]:
    """Positions and velocities [n, 1 or B, D]. If the times are numbers on the host, a function is evaluated at the
    times at which the obstacle is present, as in single steps; zero at others.
    """
    n, there = len(times.tensor), times.within(obstacle.start, obstacle.end)
    moments = times.tensor[there].to(like.dtype)
    if len(moments) == 0:
        return like.new_zeros(n, 1, like.shape[1]), like.new_zeros(n, 1, like.shape[1])
    centre, velocity = obstacle.motion.path_over(moments, like)
    around = (0, 0, 0, 0, there.start, n - there.stop)
    return F.pad(centre, around), F.pad(velocity, around)


def path_requires_grad(obstacle: Obstacle, like: Tensor, times: StepTimes) -> bool:
    """Whether the first or the last of the positions on a path requires grad."""
    there = times.tensor[times.within(obstacle.start, obstacle.end)].to(like.dtype)
    return any(obstacle.at(time).requires_grad for time in (*there[:1], *there[-1:]))


def numbers_of_a_step(obstacles: Sequence[Obstacle], like: Tensor, least_rows: int) -> int:
    """Number of entries of a table with `least_rows` rows per obstacle, or as many as its parameters have."""
    shapes_of_rows = [_joined(_parts(o, like)).shape for o in obstacles]
    return sum(width for _, width in shapes_of_rows) * max(least_rows, *(rows for rows, _ in shapes_of_rows))
