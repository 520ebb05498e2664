"""Impulses of the material on walls and obstacles: Python wrappers, fake kernels and autograd.

An impulse is D numbers [N s], the sum over nodes of mass times the velocity that the boundary removes, followed by its
moment about the origin [N m s], one number in 2-D and a vector in 3-D. Impulses are float64 for any dtype of the
particles, since they are sums over many steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..boundaries import Face, Obstacle, Walls
from ..errors import check_like
from ..grid.grid import Blocks
from ..grid.topology import Topology
from .arguments import differentiate, refuse_vmap, sizes
from .autograd import dispatch, register_autograd, save_with_topology, saved_with_topology
from .contact import (
    check_contact,
    composed_contact,
    obstacle_arguments,
    packed_rows,
    present,
    rows_of_slots,
    time_arguments,
    walls_beside,
)
from .grid_update import check_nodes, register_update, sum_by_scene_of_blocks, update_arguments
from .grid_update_composed import composed_grid_update


def impulse_size(dim: int) -> int:
    """Numbers of an impulse: D, and 1 or 3 of its moment."""
    return dim + (1 if dim == 2 else 3)


def with_moment(position: Tensor, momentum: Tensor) -> Tensor:
    """Momentum [..., D] [N s] at positions [..., D] [m], and its moment about the origin [N m s]: [..., D + 1 or 3]."""
    if momentum.shape[-1] == 3:
        return torch.cat([momentum, torch.linalg.cross(*torch.broadcast_tensors(position, momentum))], -1)
    moment = position[..., :1] * momentum[..., 1:] - position[..., 1:] * momentum[..., :1]
    return torch.cat([momentum, moment], -1)


def impulse_of_nodes(blocks: Topology, momentum: Tensor) -> Tensor:
    """Impulse that removes a momentum [N, D] [N s] from each node: [B, D + 1 or 3] [N s, N m s], float64."""
    rows = with_moment(blocks.node_positions(torch.float64), momentum.double())
    rows = torch.where(blocks.active_nodes()[:, None], rows, 0)
    slots = rows.unflatten(0, (blocks.block.shape[0], blocks.grid.nodes_per_block)).sum(1)
    return sum_by_scene_of_blocks(slots, blocks, blocks.scenes)


def wall_impulses(
    blocks: Blocks,
    nodes: Tensor,
    gravity: Tensor | None = None,
    dt: float | Tensor | None = None,
    walls: Walls | None = None,
) -> Tensor:
    """Impulses on the faces of the domain in a `grid_update` with the same arguments.

    The impulse on a mirror is that between nodes and their images, which both have a momentum.

    Returns:
        [B, 2 D, D + 1 or 3] [N s, N m s], float64; the lower and upper face of each axis in turn.

    Raises:
        ValueError, TypeError: as `grid_update`.

    Differentiable with respect to nodes, gravity and dt, twice in eager mode.
    """
    check_nodes(blocks, nodes)
    if walls is None:
        return nodes.new_zeros(blocks.grid.scenes, 2 * blocks.grid.dim, impulse_size(blocks.grid.dim)).double()
    arguments = update_arguments(blocks, nodes, gravity, dt, walls)
    result: Tensor = dispatch(torch.ops.torch_mpm.wall_impulses, nodes, *arguments, *blocks.packed)
    return result


def contact_impulses(
    blocks: Blocks,
    velocity: Tensor,
    mass: Tensor,
    obstacles: Sequence[Obstacle],
    time: float | Tensor,
    walls: Walls | None = None,
) -> Tensor:
    """Impulses on obstacles in a `contact` with the same arguments, but at most `MAX_OBSTACLES` obstacles.

    Args:
        mass: mass of the nodes [N] [kg].

    Returns:
        [B, K, D + 1 or 3] [N s, N m s], float64; zero for obstacles that are absent at the time.

    Raises:
        ValueError, TypeError: as `contact`.

    Differentiable with respect to velocity, mass and the differentiable arguments of `contact`, twice in eager mode.
    """
    check_contact(blocks, velocity, obstacles)
    check_like("mass", mass, velocity, (velocity.shape[0],), "[N]", needed=True)
    scene_time, number = time_arguments(time, velocity, blocks.grid.scenes)
    there = present(obstacles, scene_time, number)
    shape = (blocks.grid.scenes, len(obstacles), impulse_size(blocks.grid.dim))
    if not there:
        return velocity.new_zeros(shape, dtype=torch.float64)
    impulses: Tensor = dispatch(
        torch.ops.torch_mpm.contact_impulses,
        *(mass, packed_rows(velocity)),
        *obstacle_arguments(there, velocity, blocks.grid.scenes),
        *(scene_time, number, *blocks.packed, *walls_beside(walls, blocks.grid)),
    )
    if len(there) == len(obstacles):
        return impulses
    rows = iter(impulses.unbind(1))
    absent = impulses.new_zeros(shape[0], shape[2])
    return torch.stack([next(rows) if any(o is other for other in there) else absent for o in obstacles], 1)


# ---- fake kernels


@torch.library.register_fake("torch_mpm::wall_impulses")
def _wall_fake(nodes, *arguments):
    dim = sizes(nodes, "nodes", 2)[1] - 1
    scenes = Topology.unpack(*arguments[-3:]).scenes
    return nodes.new_empty(scenes, 2 * dim, impulse_size(dim), dtype=torch.float64)


@torch.library.register_fake("torch_mpm::contact_impulses")
def _contact_fake(mass, velocity, obstacles, *arguments):
    dim, count = sizes(velocity, "velocity", 2)[1], sizes(obstacles, "obstacles", 3)[1]
    scenes = Topology.unpack(*arguments[-3:]).scenes
    return velocity.new_empty(scenes, count, impulse_size(dim), dtype=torch.float64)


@torch.library.register_fake("torch_mpm::contact_impulses_backward")
def _contact_backward_fake(grad_impulse, wants_rows, mass, velocity, obstacles, *arguments):
    N, D = sizes(velocity, "velocity", 2)
    _, count, width = sizes(obstacles, "obstacles", 3)
    return velocity.new_empty(N, 1 + D), velocity.new_empty(N // 4**D if wants_rows else 0, count, width)


# ---- autograd of the walls


def _composed_wall_impulses(
    blocks: Topology, nodes: Tensor, gravity: Tensor | None, dt: float | Tensor | None, faces: Sequence[Face]
) -> Tensor:
    """`wall_impulses` made of torch operations, for second derivatives."""
    taken = [torch.zeros_like(nodes[:, 1:])] * (2 * blocks.grid.dim)

    def see(face: int, momentum: Tensor) -> None:
        taken[face] = taken[face] + momentum

    composed_grid_update(blocks, nodes, gravity, dt, faces, see)
    return torch.stack([impulse_of_nodes(blocks, momentum) for momentum in taken], 1)


register_update("wall_impulses", _composed_wall_impulses)


# ---- autograd of obstacles


def _contact_setup(ctx: Any, inputs: Any, output: Any) -> None:
    mass, velocity, obstacles, data, *kinds, scene_time, time = inputs[:-5]
    options = {"kinds": kinds, "time": time, "walls": inputs[-2:]}
    save_with_topology(ctx, (mass, velocity, obstacles, data, scene_time), inputs[-5:-2], **options)


def _contact_backward(ctx, grad):
    (mass, velocity, obstacles, data, scene_time), topology = saved_with_topology(ctx)
    wants_rows = ctx.needs_input_grad[2]
    nodes, rows = dispatch(
        torch.ops.torch_mpm.contact_impulses_backward,
        *(grad.contiguous(), wants_rows, mass, velocity, obstacles, data, *ctx.kinds, scene_time, ctx.time),
        *(*topology, *ctx.walls),
    )
    rows = sum_by_scene_of_blocks(rows, Topology.unpack(*topology), obstacles.shape[0]) if wants_rows else None
    return (nodes[:, 0], nodes[:, 1:], rows) + (None,) * 14


def _contact_backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    grad, wants_rows, mass, velocity, obstacles, data, *kinds, scene_time, time = inputs[:-5]
    options = {"wants_rows": wants_rows, "kinds": kinds, "time": time, "walls": inputs[-2:]}
    save_with_topology(ctx, (grad, mass, velocity, obstacles, data, scene_time), inputs[-5:-2], **options)


def _contact_double_backward(ctx, grad_nodes, grad_rows):
    (grad, mass, velocity, obstacles, data, scene_time), topology = saved_with_topology(ctx)
    blocks = Topology.unpack(*topology)

    def adjoint(grad: Tensor, mass: Tensor, velocity: Tensor, obstacles: Tensor) -> Any:
        def impulses(mass: Tensor, velocity: Tensor, rows: Tensor) -> Tensor:
            _, changes = composed_contact(
                blocks, velocity, rows, data, ctx.kinds, scene_time, ctx.time, ctx.walls, mass
            )
            return torch.stack([impulse_of_nodes(blocks, -mass[:, None] * change) for change in changes], 1)

        inputs = (mass, velocity, rows_of_slots(obstacles, blocks))
        found = differentiate(impulses, inputs, [grad])
        by_mass, by_velocity, by_rows = (
            torch.zeros_like(t) if g is None else g for g, t in zip(found, inputs, strict=True)
        )
        nodes = torch.cat([by_mass[:, None], by_velocity], 1)
        return (nodes, by_rows) if ctx.wants_rows else nodes

    given = [grad_nodes, grad_rows] if ctx.wants_rows else [grad_nodes]
    grads = differentiate(adjoint, [grad, mass, velocity, obstacles], given)
    return (grads[0], None, *grads[1:]) + (None,) * 14


register_autograd("contact_impulses", _contact_backward, _contact_setup)
register_autograd("contact_impulses_backward", _contact_double_backward, _contact_backward_setup)
refuse_vmap("contact_impulses")
refuse_vmap("contact_impulses_backward")
