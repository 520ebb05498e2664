"""Node momentum to node velocity with gravity and walls: Python wrapper, fake kernels and autograd."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..boundaries import Face, Walls
from ..errors import FLOATING, check_like, shape_of
from ..grid.grid import Blocks, check_blocks
from ..grid.topology import Topology
from .arguments import differentiate, refuse_vmap, sizes, split_dt
from .autograd import dispatch, register_autograd, save_with_topology, saved_with_topology
from .grid_update_composed import composed_grid_update

CONTACT_KINDS = {"open": 0, "sticky": 1, "slip": 2, "separate": 3, "mirror": 4}  # csrc/grid/friction.h
CONTACT_NAMES = list(CONTACT_KINDS)


def grid_update(
    blocks: Blocks,
    nodes: Tensor,
    gravity: Tensor | None = None,
    dt: float | Tensor | None = None,
    walls: Walls | None = None,
) -> Tensor:
    """Velocity of the nodes at the end of a step: v_i = (mv)_i / m_i + dt g, then the walls of the domain.

    Args:
        blocks: active blocks.
        nodes: mass and momentum [N, 1 + D] [kg, kg m/s], as `p2g` returns them.
        gravity: [D] or [B, D] [m/s²], or None.
        dt: time step [s]: a number, or a tensor of shape [], [1] or [B]; needed with gravity.
        walls: see `torch_mpm.Walls`; None for open faces.

    Returns:
        Velocity [N, D] [m/s], a view of rows [mass, velocity] with stride 1 + D. Zero for nodes without mass (also in
        their mirror images), on which neither gravity nor walls act, and for rows of unused blocks.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes, devices, or dt ≤ 0.

    Differentiable with respect to nodes, gravity and dt, twice in eager mode.
    """
    check_nodes(blocks, nodes)
    arguments = update_arguments(blocks, nodes, gravity, dt, walls)
    updated = dispatch(torch.ops.torch_mpm.grid_update, nodes, *arguments, *blocks.packed)
    return updated[:, 1:]


def check_nodes(blocks: Blocks, nodes: Tensor) -> None:
    check_blocks(blocks)
    expected = [blocks.node_count, 1 + blocks.grid.dim]
    if not isinstance(nodes, Tensor) or list(nodes.shape) != expected:
        raise ValueError(f"nodes must have shape [N, 1 + D] = {expected}, got {shape_of(nodes)}")
    if nodes.dtype not in FLOATING:
        raise TypeError(f"nodes must be float32 or float64, got {nodes.dtype}")
    if nodes.device != blocks.block.device:
        raise ValueError(f"nodes must be on the device of blocks, {blocks.block.device}, got {nodes.device}")


def update_arguments(
    blocks: Blocks, nodes: Tensor, gravity: Tensor | None, dt: float | Tensor | None, walls: Walls | None
) -> tuple[Any, ...]:
    """Gravity, dt and walls as the arguments of ops after the nodes."""
    grid, number, scene_dt = blocks.grid, 0.0, None
    if gravity is not None:
        if dt is None:
            raise ValueError("gravity needs dt")
        number, scene_dt = split_dt(dt, grid.scenes, nodes)
        gravity = per_scene(gravity, nodes, grid.scenes, grid.dim)
    scene_dt = None if scene_dt is None else scene_dt.contiguous()
    return gravity, scene_dt, number, *wall_arguments(walls, grid)


def wall_arguments(walls: Walls | None, grid: Any) -> tuple[list[int], list[float], list[float]]:
    """Kind, plane [m] and friction of each face, as arguments of ops."""
    if walls is not None and not isinstance(walls, Walls):
        raise TypeError(f"walls must be Walls or None, got {type(walls).__name__}")
    faces = () if walls is None else walls.faces(grid)
    return [CONTACT_KINDS[f.kind] for f in faces], [f.plane for f in faces], [f.friction for f in faces]


def per_scene(gravity: Tensor, nodes: Tensor, scenes: int, dim: int) -> Tensor:
    """Gravity as [B, D]."""
    if not isinstance(gravity, Tensor) or tuple(gravity.shape) not in ((dim,), (scenes, dim)):
        raise ValueError(f"gravity must have shape [D] or [B, D] = [{scenes}, {dim}], got {shape_of(gravity)}")
    check_like("gravity", gravity, nodes, tuple(gravity.shape), "")
    return gravity if gravity.dim() == 2 and gravity.is_contiguous() else gravity.expand(scenes, dim).contiguous()


# ---- fake kernels: shapes and strides only


@torch.library.register_fake("torch_mpm::grid_update")
def _fake(nodes, *arguments):
    return nodes.new_empty(nodes.shape)


# ---- autograd of ops with these arguments


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    nodes, gravity, scene_dt, dt, kind, plane, friction, *topology = inputs
    save_with_topology(ctx, (nodes, gravity, scene_dt), topology, dt=dt, walls=(kind, plane, friction))


def _backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    grad, wants_change, nodes, gravity, scene_dt, dt, kind, plane, friction, *topology = inputs
    options = {"wants_change": wants_change, "dt": dt, "walls": (kind, plane, friction)}
    save_with_topology(ctx, (grad, nodes, gravity, scene_dt), topology, **options)


def sum_by_scene_of_blocks(change: Tensor, blocks: Topology, scenes: int) -> Tensor:
    """Sum of slot values [max_blocks, ...] over the slots of each scene, [B, ...]."""
    if scenes < 2:
        return change.sum(0, keepdim=True)[:scenes]
    scene = blocks.block_scene().clamp_min(0)
    return change.new_zeros(scenes, *change.shape[1:]).index_add(0, scene, change)


def register_update(name: str, composed: Callable[..., Tensor]) -> None:
    """Register first and second derivatives of an op with the arguments of `grid_update`, and the fake kernel of the
    first.

    Args:
        name: name of the op; its adjoint is NAME_backward.
        composed: the op made of torch operations, as `composed_grid_update`.
    """
    adjoint_op = getattr(torch.ops.torch_mpm, f"{name}_backward")

    def fake(grad, wants_change, nodes, *arguments):
        slots = sizes(Topology.unpack(*arguments[-3:]).block, "block", 1)[0] if wants_change else 0
        return nodes.new_empty(nodes.shape), nodes.new_empty(slots, sizes(nodes, "nodes", 2)[1] - 1)

    def backward(ctx, grad):
        (nodes, gravity, scene_dt), topology = saved_with_topology(ctx)
        need_nodes, need_gravity, need_dt, *_ = ctx.needs_input_grad
        grad_nodes, change = dispatch(
            adjoint_op,
            *(grad.contiguous(), need_gravity or need_dt, nodes, gravity, scene_dt, ctx.dt, *ctx.walls, *topology),
        )
        grad_gravity = grad_dt = None
        if need_gravity or need_dt:
            change = sum_by_scene_of_blocks(change, Topology.unpack(*topology), gravity.shape[0])
            if need_gravity:
                grad_gravity = ctx.dt * (change if scene_dt is None else scene_dt[:, None] * change)
            if need_dt:
                grad_dt = ctx.dt * (gravity * change).sum(1)
        return (grad_nodes if need_nodes else None, grad_gravity, grad_dt) + (None,) * 7

    def double_backward(ctx, grad_grad_nodes, grad_change):
        tensors, topology = saved_with_topology(ctx)
        blocks = Topology.unpack(*topology)
        faces = [Face(CONTACT_NAMES[kind], plane, friction) for kind, plane, friction in zip(*ctx.walls, strict=True)]

        def adjoint(grad, nodes, gravity, scene_dt):
            def update(nodes, change):
                mass, momentum = nodes.split([1, nodes.shape[1] - 1], 1)
                rows = torch.cat([mass, momentum + mass * change.repeat_interleave(blocks.grid.nodes_per_block, 0)], 1)
                dt = ctx.dt if scene_dt is None else ctx.dt * scene_dt
                return composed(blocks, rows, gravity, dt, faces)

            change = nodes.new_zeros(blocks.block.shape[0], nodes.shape[1] - 1)
            both = differentiate(update, (nodes, change), [grad])
            return tuple(both) if ctx.wants_change else both[0]

        given = [grad_grad_nodes, grad_change] if ctx.wants_change else [grad_grad_nodes]
        grad, nodes, gravity, scene_dt = differentiate(adjoint, tensors, given)
        return (grad, None, nodes, gravity, scene_dt) + (None,) * 7

    torch.library.register_fake(f"torch_mpm::{name}_backward")(fake)
    register_autograd(name, backward, _setup)
    register_autograd(f"{name}_backward", double_backward, _backward_setup)
    refuse_vmap(name)
    refuse_vmap(f"{name}_backward")


register_update("grid_update", composed_grid_update)
