"""One step of free bodies in contact with the nodes, without gradients: tables of the bodies and fake kernels.

    torch.ops.torch_mpm.free_bodies(velocity, mass, bodies, body_shape, body_sizes, body_contact, body_owner,
        body_joint, max_iterations, tolerance, dt, wants_solution, topology, lattice, layout, wall_kind=[],
        wall_plane=[]) -> (velocity, rows, report, motion, slopes)

`bodies` are tensors: rows [B, K, 13] or [B, K, 6] of the bodies at the beginning of the step (torch_mpm.bodies), the
table of their obstacles [1 or B, O, width] and the data of the shapes as in `contact` (the op reads friction and shape
only); constants [K, ...]: mass, moments of inertia (one in 2-D, three in 3-D), a point on the hinge [D] and the axis of
the joint [D]; poses of the obstacles in the frames of their bodies [O, D + 1 or 3], positions and rotations; gravity
[1 or B, D] of the bodies, and wrenches [B, K, 3 or 6], which may be left out. All but the table and the data are
float64. `body_owner` are the bodies of the obstacles, `body_joint` the numbers of `JOINTS`.

The results are the velocities of the nodes after contact, the rows at the end of the step, and the report [B, 1 + K]:
the number of iterations, and the residual of each body relative to its velocities. If `wants_solution`, also the
velocities U [B, K, n] that solve the equations, and the derivatives [B, K n, K n] of the impulses by these; else None.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..geometry.values import filled
from .arguments import refuse_vmap, sizes
from .autograd import register_autograd
from .grid_update import CONTACT_KINDS
from .impulses import impulse_size
from .obstacle_tables import tables_without_motion

if TYPE_CHECKING:
    from ..bodies.body import Body

JOINTS = ("free", "hinge", "slider", "driven")
"""Joints in the order of csrc/bodies/free_body.h."""


class BodyTables(NamedTuple):
    """Bodies as the ops take them, but for rows, gravity and wrenches."""

    obstacles: Tensor  # [1 or B, O, width]
    data: Tensor  # [n]
    constants: Tensor  # [K, ...]
    parts: Tensor  # [O, ...]
    lists: tuple[list[Any], ...]  # shape, sizes, contact, owner, joint


def body_tables(bodies: Sequence[Body], owner: Sequence[int], parts: Tensor, like: Tensor, scenes: int) -> BodyTables:
    """Tables of bodies for nodes of the dtype and device of `like`; `parts` [O, ...] are on the host."""
    dim = like.shape[1]
    obstacles = [part.obstacle for body in bodies for part in body.parts]
    forms = [obstacle.shape for obstacle in obstacles]
    rows = [
        torch.cat([body.mass_like(like)[None], body.moments_like(like, dim), _of_joint(body, "anchor", like)])
        for body in bodies
    ]
    axes = [_of_joint(body, "axis", like) for body in bodies]
    return BodyTables(
        *tables_without_motion(obstacles, like, scenes),
        torch.cat([torch.stack(rows), torch.stack(axes)], 1),
        parts.to(like.device, non_blocking=True),
        (
            [form.number for form in forms],
            [form.data_count() for form in forms],
            [CONTACT_KINDS[obstacle.kind] for obstacle in obstacles],
            list(owner),
            [JOINTS.index(body.joint.name) for body in bodies],
        ),
    )


def _of_joint(body: Body, name: str, like: Tensor) -> Tensor:
    """Numbers of a joint [D]; zeros where it has none."""
    return filled(getattr(body.joint, name, None) or (0.0,) * like.shape[1], like, torch.float64)


@torch.library.register_fake("torch_mpm::free_bodies")
def _fake(
    velocity, mass, bodies, shape, form_sizes, contact, owner, joint, most, tolerance, dt, wants_solution, *others
):
    N, D = sizes(velocity, "velocity", 2)
    rows, report = fake_bodies(bodies)
    if not wants_solution:
        return velocity.new_empty(N, D), rows, report, None, None
    scenes, count, n = rows.shape[0], rows.shape[1], impulse_size(D)
    solution = rows.new_empty(scenes, count, n), rows.new_empty(scenes, count * n, count * n)
    return velocity.new_empty(N, D), rows, report, *solution


def fake_bodies(bodies: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Rows and report by shape."""
    scenes, count, columns = sizes(bodies[0], "rows of bodies", 3)
    return bodies[0].new_empty(scenes, count, columns), bodies[0].new_empty(scenes, 1 + count)


def _no_derivative(ctx: Any, *grads: Any) -> None:
    raise NotImplementedError(
        "torch_mpm::free_bodies has no derivative: torch_mpm.bodies.FreeBodies differentiates its solution"
    )


register_autograd("free_bodies", _no_derivative)
refuse_vmap("free_bodies")
