"""Contact of the grid with rigid obstacles, all of them in one op: Python face, fake kernels and autograd.

The kernel knows the shapes that have a `number`. The obstacles of a call are rows of a table [1 or B, K, width], one
for all scenes or one per scene, of the nodes' dtype:

    friction, position [D], velocity [D], rotation [A], angular_velocity [A], vector [D], radius

with A = 1 angle in 2-D and a vector of A = 3 in 3-D. What an obstacle does not have is zero. Shapes of many numbers
have them one after another in a second tensor: the corners of a revolved shape (distance from the axis, position along
it), the samples of a sampled one (lower corner, spacing, numbers along the axes, values). `obstacle_tables` makes both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..boundaries import Face, Obstacle, Walls
from ..boundaries.solid import SolidNodes, after_contact
from ..errors import FLOATING, NUMBER_OR_TENSOR, check_like, check_number, shape_of
from ..geometry import shapes
from ..grid.grid import Blocks, check_blocks
from ..grid.topology import Topology
from ..laws.parameters import has_hooks
from ..step.clocks import StepTimes
from .arguments import check_list, differentiate, refuse_vmap, sizes
from .autograd import dispatch, register_autograd, save_with_topology, saved_with_topology
from .grid_update import CONTACT_KINDS, CONTACT_NAMES, sum_by_scene_of_blocks, wall_arguments
from .obstacle_tables import tables, tables_over

MAX_OBSTACLES = 64  # of one call, csrc/grid/obstacle.h
KERNEL_SHAPES = {shape.number: shape for shape in shapes.SHAPES if shape.number is not None}
"""Shapes of the kernel by their numbers."""


def is_solid(boundary: Any) -> bool:
    """Whether a boundary is an obstacle that acts with its neighbours as one solid: one without hooks, and without a
    `forward` or an `apply` of its own."""
    kind = type(boundary)
    if not isinstance(boundary, Obstacle) or kind.forward is not Obstacle.forward or kind.apply is not Obstacle.apply:
        return False
    return not has_hooks(boundary)


def fusible(obstacle: Any, time: float | Tensor, paths: bool = False) -> bool:
    """Whether `contact` takes an obstacle: a shape that the kernel knows, moving at constant rates, without hooks.

    A position as a function of time, and a time that requires grad, need `Obstacle.apply`; so does any subclass with a
    `forward` or an `apply` of its own. With `paths`, whether `substeps` does, where such a position may be, too.
    """
    return is_solid(obstacle) and is_of_kernel(obstacle, time, paths)


def is_of_kernel(obstacle: Obstacle, time: float | Tensor, paths: bool = False) -> bool:
    """`fusible` for an obstacle for which `is_solid` holds."""
    if obstacle.shape.number is None or (not paths and obstacle.follows_path):
        return False
    return not (isinstance(time, Tensor) and time.requires_grad)


def contact(
    blocks: Blocks,
    velocity: Tensor,
    obstacles: Sequence[Obstacle],
    time: float | Tensor,
    walls: Walls | None = None,
    mass: Tensor | None = None,
) -> Tensor:
    """Node velocities after contact with obstacles as one solid, see csrc/grid/solid.h.

    Args:
        blocks: active blocks.
        velocity: node velocities [N, D] [m/s].
        obstacles: those for which `fusible` holds.
        time: [s], a number or a tensor [] or [B].
        walls: of the domain, which the obstacles may reach; the grid update has applied them. None for open faces.
        mass: of the nodes [N] [kg]; those without mass keep their velocity. None where all have mass.

    Groups of `MAX_OBSTACLES` obstacles act one after another.

    Returns:
        Velocity [N, D] [m/s], a view of rows with stride 1 + D.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Differentiable, twice in eager mode, with respect to velocity and, as `Obstacle.apply`, to the position, velocity,
    rotation, angular_velocity and friction of the obstacles and the normal, half_axis and axis of their shapes.
    """
    check_contact(blocks, velocity, obstacles)
    check_like("mass", mass, velocity, (blocks.node_count,), "[N]")
    scene_time, number = time_arguments(time, velocity, blocks.grid.scenes)
    obstacles = present(obstacles, scene_time, number)
    for first in range(0, len(obstacles), MAX_OBSTACLES):
        group = obstacles[first : first + MAX_OBSTACLES]
        rows = dispatch(
            torch.ops.torch_mpm.contact,
            packed_rows(velocity),
            *obstacle_arguments(group, velocity, blocks.grid.scenes),
            scene_time,
            number,
            *blocks.packed,
            *walls_beside(walls, blocks.grid),
            None if mass is None else mass.detach(),
        )
        velocity = rows[:, 1:]
    return velocity


def check_contact(blocks: Blocks, velocity: Tensor, obstacles: Sequence[Obstacle]) -> None:
    check_blocks(blocks)
    nodes = [blocks.node_count, blocks.grid.dim]
    if not isinstance(velocity, Tensor) or list(velocity.shape) != nodes:
        raise ValueError(f"velocity must have shape [N, D] = {nodes}, got {shape_of(velocity)}")
    if velocity.dtype not in FLOATING:
        raise TypeError(f"velocity must be float32 or float64, got {velocity.dtype}")
    for k, obstacle in enumerate(check_list("obstacles", obstacles)):
        if not isinstance(obstacle, Obstacle) or obstacle.shape.number is None:
            expected = ", ".join(KERNEL_SHAPES[number].name for number in sorted(KERNEL_SHAPES))
            raise TypeError(f"obstacles[{k}] must be an obstacle of one of {expected}, got {type(obstacle).__name__}")


def present(obstacles: Sequence[Obstacle], scene_time: Tensor | None, number: float) -> Sequence[Obstacle]:
    """Those that are there at a time as `time_arguments` gives it; all where it is a tensor, which only ops read."""
    return obstacles if scene_time is not None else [o for o in obstacles if o.start <= number < o.end]


def obstacle_arguments(
    group: Sequence[Obstacle], like: Tensor, scenes: int, times: StepTimes | None = None
) -> tuple[Any, ...]:
    """Up to `MAX_OBSTACLES` obstacles as the ops take them; their tables are None where there are none.

    With times the parameters are those at each of these, and some may follow a path.
    """
    if not group:
        return None, None, [], [], [], [], [], []
    table = tables(group, like, scenes) if times is None else tables_over(group, like, scenes, times)
    forms = [o.shape for o in group]
    return (
        *table,
        [shape.number for shape in forms],
        [shape.data_count() for shape in forms],
        [CONTACT_KINDS[o.kind] for o in group],
        [-1 if o.scene is None else o.scene for o in group],
        [o.start for o in group],
        [o.end for o in group],
    )


def time_arguments(time: float | Tensor, like: Tensor, scenes: int) -> tuple[Tensor | None, float]:
    """A time [s] as the ops take it: a tensor [1 or B] in float64, or a number."""
    if not isinstance(time, Tensor):
        return None, float(check_number("time", time, kinds=NUMBER_OR_TENSOR))
    if time.dim() > 1 or time.numel() not in (1, scenes):
        raise ValueError(f"time must be a number or have shape [] or [B] = [{scenes}], got {shape_of(time)}")
    scene_time = time.detach().reshape(-1).double().contiguous()
    if scene_time.device != like.device:
        raise ValueError(f"time must be on {like.device}, got {scene_time.device}")
    return scene_time, 0.0


def walls_beside(walls: Walls | None, grid: Any) -> tuple[list[int], list[float]]:
    """Kind and plane [m] of each face, as the ops take them beside obstacles."""
    return wall_arguments(walls, grid)[:2]


def packed_rows(velocity: Tensor) -> Tensor:
    return velocity if velocity.stride(1) == 1 else velocity.contiguous()


# ---- fake kernels and autograd


@torch.library.register_fake("torch_mpm::contact")
def _fake(velocity, *arguments):
    N, D = sizes(velocity, "velocity", 2)
    return velocity.new_empty(N, 1 + D)


@torch.library.register_fake("torch_mpm::contact_backward")
def _backward_fake(grad, wants_rows, velocity, obstacles, *arguments):
    N, D = sizes(velocity, "velocity", 2)
    _, count, width = sizes(obstacles, "obstacles", 3)
    slots = N // 4**D if wants_rows else 0
    return velocity.new_empty(N, 1 + D), velocity.new_empty(slots, count, width)


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    velocity, obstacles, data, *kinds, scene_time, time = inputs[:-6]
    options = {"kinds": kinds, "time": time, "walls": inputs[-3:-1]}
    save_with_topology(ctx, (velocity, obstacles, data, scene_time, inputs[-1]), inputs[-6:-3], **options)


def _backward(ctx, grad):
    (velocity, obstacles, data, scene_time, mass), topology = saved_with_topology(ctx)
    wants_rows = ctx.needs_input_grad[1]
    grad_velocity, rows = dispatch(
        torch.ops.torch_mpm.contact_backward,
        *(packed_rows(grad[:, 1:]), wants_rows, velocity, obstacles, data, *ctx.kinds, scene_time, ctx.time),
        *(*topology, *ctx.walls, mass),
    )
    rows = sum_by_scene_of_blocks(rows, Topology.unpack(*topology), obstacles.shape[0]) if wants_rows else None
    return (grad_velocity[:, 1:], rows) + (None,) * 15


def _backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    grad, wants_rows, velocity, obstacles, data, *kinds, scene_time, time = inputs[:-6]
    options = {"wants_rows": wants_rows, "kinds": kinds, "time": time, "walls": inputs[-3:-1]}
    save_with_topology(ctx, (grad, velocity, obstacles, data, scene_time, inputs[-1]), inputs[-6:-3], **options)


def _double_backward(ctx, grad_velocity, grad_rows):
    (grad, velocity, obstacles, data, scene_time, mass), topology = saved_with_topology(ctx)
    blocks = Topology.unpack(*topology)

    def adjoint(grad: Tensor, velocity: Tensor, obstacles: Tensor) -> Any:
        def after(velocity: Tensor, rows: Tensor) -> Tensor:
            table = (rows, data, ctx.kinds, scene_time, ctx.time, ctx.walls)
            return composed_contact(blocks, velocity, *table, mass)[0]

        rows = rows_of_slots(obstacles, blocks)
        both = differentiate(after, [velocity, rows], [grad])
        adjoints = [torch.zeros_like(t) if g is None else g for g, t in zip(both, (velocity, rows), strict=True)]
        return tuple(adjoints) if ctx.wants_rows else adjoints[0]

    given = [grad_velocity[:, 1:], grad_rows] if ctx.wants_rows else [grad_velocity[:, 1:]]
    grads = differentiate(adjoint, [grad, velocity, obstacles], given)
    return (grads[0], None, *grads[1:]) + (None,) * 15


# ---- the same in torch operations, for second derivatives


def rows_of_slots(obstacles: Tensor, blocks: Topology) -> Tensor:
    """A table [1 or B, K, width] as one of each slot [slots, K, width]."""
    if obstacles.shape[0] == 1:
        return obstacles.expand(blocks.block.shape[0], *obstacles.shape[1:])
    return obstacles.index_select(0, blocks.block_scene().clamp(0, obstacles.shape[0] - 1))


def composed_contact(
    blocks: Topology,
    velocity: Tensor,
    rows: Tensor,
    data: Tensor,
    kinds: Sequence[Any],
    scene_time: Tensor | None,
    time: float,
    walls: tuple[Sequence[int], Sequence[float]],
    mass: Tensor | None,
) -> tuple[Tensor, list[Tensor]]:
    """Node velocities [N, D] after contact with obstacles whose parameters are those of each slot [slots, K, width],
    and the changes by each obstacle."""
    now: float | Tensor = time
    if scene_time is not None:
        now = scene_time[0] if len(scene_time) == 1 else scene_time[blocks.block_scene().clamp_min(0)]
    positions, node_scene, active = blocks.node_positions(velocity.dtype), blocks.node_scene(), blocks.active_nodes()
    active = active if mass is None else active & (mass != 0)
    slot = torch.arange(rows.shape[0], device=rows.device).repeat_interleave(blocks.grid.nodes_per_block)
    obstacles, acts, first = [], [], 0
    for k, (shape, size, kind, scene, start, end) in enumerate(zip(*kinds, strict=True)):
        parameters = _parameters(rows[:, k], velocity.shape[1])
        row = parameters.pop("vector"), parameters.pop("radius"), data[first : first + size]
        form = KERNEL_SHAPES[shape].from_row(*row)
        obstacles.append(Obstacle(form, kind=CONTACT_NAMES[kind], start=start, end=end, **parameters))
        acts.append(active if scene < 0 else active & (node_scene == scene))
        first += size
    faces = [Face(CONTACT_NAMES[kind], plane, 0.0) for kind, plane in zip(*walls, strict=True)]
    return after_contact(velocity, SolidNodes(obstacles, acts, positions, slot, now, blocks.grid.dx, faces))


def _parameters(row: Tensor, dim: int) -> dict[str, Any]:
    """The columns of a table [slots, width] by their names."""
    turn = 1 if dim == 2 else 3
    names = ("friction", "position", "velocity", "rotation", "angular_velocity", "vector", "radius")
    values = dict(zip(names, row.split([1, dim, dim, turn, turn, dim, 1], 1), strict=True))
    scalars = ("friction", "radius", *(("rotation", "angular_velocity") if dim == 2 else ()))
    return {name: value[:, 0] if name in scalars else value for name, value in values.items()}


register_autograd("contact", _backward, _setup)
register_autograd("contact_backward", _double_backward, _backward_setup)
refuse_vmap("contact")
refuse_vmap("contact_backward")
