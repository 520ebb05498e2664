"""Contact of the grid with rigid obstacles, all of them in one op: Python face, fake kernels and autograd."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..boundaries import Box, Capsule, Obstacle, Plane, Sphere
from ..errors import NUMBER_OR_TENSOR, check_like, check_real, shape_of
from ..grid import Blocks, check_blocks
from ..reference.obstacles import contact as reference
from ..topology import Topology
from .arguments import check_list, differentiate, refuse_vmap, sizes
from .autograd import dispatch, register_autograd, save_with_topology, saved_with_topology
from .grid_update import CONTACT_KINDS

MAX_OBSTACLES = 16  # of one call, csrc/grid/obstacle.h
SHAPES: dict[type, int] = {Plane: 0, Sphere: 1, Box: 2, Capsule: 3}


def fusible(obstacle: Any, time: float | Tensor) -> bool:
    """Whether `contact` takes an obstacle: a built-in shape without hooks and without anything that requires grad.

    An `SDF`, a position as a function of time, a parameter or a time that requires grad need `Obstacle.apply`.
    """
    if type(obstacle) not in SHAPES or (callable(obstacle.position) and not isinstance(obstacle.position, Tensor)):
        return False
    if (
        obstacle._forward_hooks
        or obstacle._forward_pre_hooks
        or obstacle._backward_hooks
        or obstacle._backward_pre_hooks
    ):
        return False
    return not any(isinstance(value, Tensor) and value.requires_grad for value in (time, *_values(obstacle)))


def contact(blocks: Blocks, velocity: Tensor, obstacles: Sequence[Obstacle], time: float | Tensor) -> Tensor:
    """Node velocities after contact with obstacles, one after another: `Obstacle.apply` of each, in one kernel.

    Args:
        blocks: active blocks.
        velocity: node velocities [N, D] [m/s].
        obstacles: those for which `fusible` holds.
        time: [s], a number or a tensor [] or [B].

    Returns:
        Velocity [N, D] [m/s], a view of rows with stride 1 + D.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Differentiable with respect to velocity, twice in eager mode.
    """
    check_blocks(blocks)
    grid = blocks.grid
    if not isinstance(velocity, Tensor) or velocity.shape != (blocks.node_count, grid.dim):
        raise ValueError(f"velocity must have shape [N, D] = {[blocks.node_count, grid.dim]}, got {shape_of(velocity)}")
    for k, obstacle in enumerate(check_list("obstacles", obstacles)):
        if type(obstacle) not in SHAPES:
            expected = ", ".join(shape.__name__ for shape in SHAPES)
            raise TypeError(f"obstacles[{k}] must be one of {expected}, got {type(obstacle).__name__}")
    scene_time, number = None, 0.0
    if isinstance(time, Tensor):
        if time.dim() > 1 or time.numel() not in (1, grid.scenes):
            raise ValueError(f"time must be a number or have shape [] or [B] = [{grid.scenes}], got {shape_of(time)}")
        scene_time = time.detach().reshape(-1).to(velocity.dtype).contiguous()
        check_like("time", scene_time, velocity, tuple(scene_time.shape), "")
    else:
        number = float(check_real("time", time, NUMBER_OR_TENSOR))
        obstacles = [o for o in obstacles if o.start <= number < o.end]
    for first in range(0, len(obstacles), MAX_OBSTACLES):
        group = obstacles[first : first + MAX_OBSTACLES]
        rows = dispatch(
            torch.ops.torch_mpm.contact,
            _packed(velocity),
            _table(group, velocity, grid.scenes),
            [SHAPES[type(o)] for o in group],
            [CONTACT_KINDS[o.kind] for o in group],
            [-1 if o.scene is None else o.scene for o in group],
            [o.start for o in group],
            [o.end for o in group],
            scene_time,
            number,
            *blocks.packed,
        )
        velocity = rows[:, 1:]
    return velocity


def _packed(velocity: Tensor) -> Tensor:
    return velocity if velocity.stride(1) == 1 else velocity.contiguous()


# ---- the table of parameters


def _values(obstacle: Obstacle) -> tuple[Any, ...]:
    """The numbers and tensors of an obstacle that go into the table."""
    motion = (obstacle.friction, obstacle.position, obstacle.velocity, obstacle.rotation, obstacle.angular_velocity)
    return (*motion, *obstacle.extents().values())


def _table(obstacles: Sequence[Obstacle], like: Tensor, scenes: int) -> Tensor:
    """Parameters [1 or B, K, width] of the nodes' dtype, rows as `ObstacleRow`; kept while nothing has changed."""
    if torch.compiler.is_compiling() or type(like) not in (Tensor, torch.nn.Parameter):
        return _build(obstacles, like, scenes)
    key: list[Any] = [like.dtype, like.device, scenes]
    for value in (v for o in obstacles for v in (o, *_values(o))):
        key += [value, value._version if isinstance(value, Tensor) else None]
    return obstacles[0].kept_table.get(tuple(key), lambda: _build(obstacles, like, scenes), like)


def _build(obstacles: Sequence[Obstacle], like: Tensor, scenes: int) -> Tensor:
    rows = [_row(o, like) for o in obstacles]
    count = max(row.shape[0] for row in rows)
    if count not in (1, scenes) or any(row.shape[0] not in (1, count) for row in rows):
        raise ValueError(f"parameters of obstacles must be given once or per scene, B = {scenes}, got {count} of them")
    return torch.stack([row.expand(count, -1) for row in rows], 1).contiguous()


def _row(obstacle: Obstacle, like: Tensor) -> Tensor:
    """[1 or B, width]; what an obstacle does not have is zero."""
    vector = (like.shape[1],)
    turn = () if like.shape[1] == 2 else (3,)
    shapes: dict[str, tuple[int, ...]] = {
        "friction": (), "position": vector, "velocity": vector, "rotation": turn, "angular_velocity": turn,
    }  # fmt: skip
    extent = next((name for name in ("normal", "size", "half_axis") if hasattr(obstacle, name)), None)
    parts = [_part(obstacle, name, like, shape) for name, shape in shapes.items()]
    parts += [_part(obstacle, extent, like, vector), _part(obstacle, "radius", like, ())]
    count = max(part.shape[0] for part in parts)
    return torch.cat([part.expand(count, -1) for part in parts], 1)


def _part(obstacle: Obstacle, name: str | None, like: Tensor, shape: tuple[int, ...]) -> Tensor:
    """A parameter [1 or B, n]."""
    if name is None or getattr(obstacle, name, None) is None:
        return like.new_zeros(1, math.prod(shape))
    value = obstacle.parameter(name, like, shape)
    return value.reshape(1 if value.dim() == len(shape) else value.shape[0], -1)


# ---- fake kernels and autograd


@torch.library.register_fake("torch_mpm::contact")
def _fake(velocity, *arguments):
    N, D = sizes(velocity, "velocity", 2)
    return velocity.new_empty(N, 1 + D)


@torch.library.register_fake("torch_mpm::contact_backward")
def _backward_fake(grad, velocity, *arguments):
    N, D = sizes(velocity, "velocity", 2)
    return velocity.new_empty(N, 1 + D)


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    velocity, obstacles, *kinds, scene_time, time = inputs[:-3]
    save_with_topology(ctx, (velocity, obstacles, scene_time), inputs[-3:], kinds=kinds, time=time)


def _backward(ctx, grad):
    (velocity, obstacles, scene_time), topology = saved_with_topology(ctx)
    rows = dispatch(
        torch.ops.torch_mpm.contact_backward,
        *(_packed(grad[:, 1:]), velocity, obstacles, *ctx.kinds, scene_time, ctx.time, *topology),
    )
    return (rows[:, 1:],) + (None,) * 11


def _backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    grad, velocity, obstacles, *kinds, scene_time, time = inputs[:-3]
    save_with_topology(ctx, (grad, velocity, obstacles, scene_time), inputs[-3:], kinds=kinds, time=time)


def _double_backward(ctx, grad_rows):
    (grad, velocity, obstacles, scene_time), topology = saved_with_topology(ctx)
    blocks = Topology.unpack(*topology)
    shape, kind, scene, start, end = ctx.kinds

    def adjoint(grad: Tensor, velocity: Tensor) -> Any:
        def after(velocity: Tensor) -> Tensor:
            return reference(blocks, velocity, obstacles, shape, kind, scene, start, end, scene_time, ctx.time)

        return differentiate(after, [velocity], [grad])[0]

    grads = differentiate(adjoint, [grad, velocity], [grad_rows[:, 1:]])
    return (*grads,) + (None,) * 11


register_autograd("contact", _backward, _setup)
register_autograd("contact_backward", _double_backward, _backward_setup)
refuse_vmap("contact")
refuse_vmap("contact_backward")
