"""Contact with obstacles in plain torch: `Obstacle.apply` of every row of a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ..boundaries import Box, Capsule, Obstacle, Plane, Sphere

if TYPE_CHECKING:
    from ..topology import Topology

KINDS = (None, "sticky", "slip", "separate")


def contact(
    blocks: Topology,
    velocity: Tensor,
    obstacles: Tensor,
    shape: Sequence[int],
    kind: Sequence[int],
    scene: Sequence[int],
    start: Sequence[float],
    end: Sequence[float],
    scene_time: Tensor | None,
    time: float,
) -> Tensor:
    """Node velocities [N, D] after contact; arguments as of `torch.ops.torch_mpm.contact`.

    Differentiable with respect to velocity and the motion, normal, half axis and friction in the table, to any order.
    """
    positions, node_scene = blocks.node_positions(velocity.dtype), blocks.node_scene()
    now = time if scene_time is None else scene_time if len(scene_time) > 1 else scene_time[0]
    for k, number in enumerate(shape):
        options = {
            "kind": KINDS[kind[k]],
            "start": start[k],
            "end": end[k],
            "scene": None if scene[k] < 0 else scene[k],
        }
        velocity = _obstacle(obstacles[:, k], velocity.shape[1], number, options).apply(
            velocity, positions, node_scene, now, 0.0
        )
    return velocity


def _obstacle(row: Tensor, dim: int, shape: int, options: dict[str, Any]) -> Obstacle:
    turn = 1 if dim == 2 else 3
    friction, position, velocity, rotation, rate, extent, radius = row.split([1, dim, dim, turn, turn, dim, 1], 1)
    if dim == 2:
        rotation, rate = rotation[:, 0], rate[:, 0]
    options = {
        **options, "friction": friction[:, 0], "velocity": velocity, "rotation": rotation, "angular_velocity": rate,
    }  # fmt: skip
    if shape == 0:
        return Plane(position, extent, **options)
    if shape == 1:
        return Sphere(position, radius[:, 0].detach(), **options)
    if shape == 2:
        return Box(position, extent.detach(), **options)
    return Capsule(position, extent, radius[:, 0].detach(), **options)
