"""The solution of a step of free bodies with gradients, by the implicit function theorem.

The op `torch_mpm::free_bodies` solves; one further iteration of Newton's method, of ops that have derivatives, has the
gradient of the solution.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..boundaries.motion import rotation_matrix
from ..grid.grid import Blocks
from ..ops.autograd import dispatch
from ..ops.contact import obstacle_arguments, packed_rows, walls_beside
from ..ops.impulses import with_moment
from .body import Body, mobility
from .exchange import POSE, Motion, assign, motion_of, moved, rotation_of, swirl

if TYPE_CHECKING:
    from .free_bodies import FreeBodies

MAX_ITERATIONS = 20
"""Iterations of Newton's method: most steps need 1 to 4."""
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}
"""Residual of velocities, relative to those of the bodies and by the impulses, by the dtype of the nodes."""


class Solution:
    """One step of the bodies, as `on_grid` of the step of the material."""

    def __init__(self, bodies: FreeBodies, rows: Tensor, dt: float, wrenches: Tensor | None) -> None:
        self.of, self.dt, self.dim = bodies, dt, bodies.step.grid.dim
        self.begin, self.wrenches = rows, wrenches
        self.motion = motion_of(rows, self.dim)
        self.turn = rotation_matrix(self.motion.rotation, self.dim)
        self.mass = torch.stack([b.mass_matrix(self.turn[:, k]) for k, b in enumerate(bodies.bodies)], 1)
        self.mobility = torch.stack(
            [
                mobility(self.mass[:, k], b.joint.directions(self.motion.position[:, k]))
                for k, b in enumerate(bodies.bodies)
            ],
            1,
        )
        self.predicted = self._predicted()
        self.rows, self.report = rows, rows.new_zeros(rows.shape[0], 1 + rows.shape[1])

    def _predicted(self) -> Tensor:
        """Velocities at the end of the step without the material [B, K, n]."""
        velocity = self.begin[..., POSE[self.dim] :]
        force = torch.zeros_like(velocity)
        masses = torch.stack([body.mass_like(force) for body in self.of.bodies])
        force[..., : self.dim] = masses[:, None] * self.of.gravity_like(self.begin)
        if self.wrenches is not None:
            force = force + self.wrenches.double()
        return velocity + self.dt * self._applied(force)

    def __call__(self, blocks: Blocks, velocity: Tensor, mass: Tensor, dt: Any) -> Tensor:
        """Node velocities after contact with the bodies, whose rows at the end of the step are then known."""
        contact = BodyContact(self.of, self.motion, blocks, velocity, mass)
        with torch.no_grad():
            U, jacobian = self._solved(blocks, contact)
        gap = U - self.predicted - self._applied(contact.impulses(U))
        U = U - _SolvedOnce.apply(jacobian, gap)
        self.rows = self._end(self.predicted + self._applied(contact.impulses(U)))
        return contact.velocity_after(U)

    def _applied(self, impulses: Tensor) -> Tensor:
        return (self.mobility @ impulses[..., None])[..., 0]

    def _solved(self, blocks: Blocks, contact: BodyContact) -> tuple[Tensor, Tensor]:
        """Velocities [B, K, n] at the end of the step, and the derivative of the residual there [B, K n, K n]."""
        velocity = contact.velocity.detach()
        given = self.of.given(velocity, self.begin, self.wrenches)
        place = *blocks.packed, *walls_beside(self.of.step.walls, blocks.grid)
        op = torch.ops.torch_mpm.free_bodies
        *_, self.report, U, slopes = op(velocity, contact.mass.detach(), *given, self.dt, True, *place)
        applied = (self.mobility.detach() @ slopes.unflatten(1, self.mobility.shape[1:3])).flatten(1, 2)
        return U, torch.eye(applied.shape[1], dtype=applied.dtype, device=applied.device) - applied

    # -- the end of the step

    def _end(self, U: Tensor) -> Tensor:
        """Rows [B, K, 13] or [B, K, 6] at the end of a step with velocities U."""
        return torch.stack([self._end_of(k, body, U[:, k]) for k, body in enumerate(self.of.bodies)], 1)

    def _end_of(self, k: int, body: Body, U: Tensor) -> Tensor:
        """Rows [B, 13] or [B, 6] of one body at the end of a step with velocities U [B, n]."""
        dim, place, old = self.dim, self.motion.position[:, k], self.turn[:, k]
        is_free = body.joint.directions(place) is None
        spin = U[:, dim:]
        if dim == 3 and is_free:  # By the spin in the middle of the step, which is of second order.
            momentum = self.mass[:, k, 3:, 3:] @ spin[..., None]
            spin = _spin(body, self._pose(k, U[:, :dim], spin, 0.5 * self.dt), momentum)
        pose = self._pose(k, U[:, :dim], spin, self.dt)
        arm = body.joint.arm(place)
        if arm is not None:  # on the circle about the fixed point
            way = (_rotations(pose, dim) @ old.mT @ arm[..., None])[..., 0]
            pose = torch.cat([place - arm + way, pose[:, dim:]], 1)
            return torch.cat([pose, swirl(spin[:, 0] if dim == 2 else spin, way), spin], 1)
        if dim == 3 and is_free:  # keeps its angular momentum
            spin = _spin(body, pose, momentum)
        return torch.cat([pose, U[:, :dim], spin], 1)

    def _pose(self, k: int, velocity: Tensor, spin: Tensor, seconds: float) -> Tensor:
        """Poses of one body [B, 7] or [B, 3] after some time with constant velocities."""
        pose = self.begin[:, k, : POSE[self.dim]]
        return moved(torch.cat([pose, velocity, spin], 1)[:, None], seconds)[:, 0]


def _rotations(pose: Tensor, dim: int) -> Tensor:
    """Rotation matrices [B, D, D] of poses [B, 7] or [B, 3]."""
    return rotation_matrix(rotation_of(pose, dim), dim)


def _spin(body: Body, pose: Tensor, momentum: Tensor) -> Tensor:
    """Angular velocity [B, 3] of a body at a pose [B, 7] by its angular momentum [B, 3, 1]."""
    return torch.linalg.solve_ex(body.mass_matrix(_rotations(pose, 3))[:, 3:, 3:], momentum)[0][..., 0]


class _SolvedOnce(torch.autograd.Function):
    """J⁻¹ r for a constant matrix J [B, m, m] and r [B, K, n].

    An iteration of Newton's method has the first derivatives of the solution, and not the second ones.
    """

    @staticmethod
    def forward(ctx: Any, jacobian: Tensor, gap: Tensor) -> Tensor:
        ctx.save_for_backward(jacobian)
        return torch.linalg.solve_ex(jacobian, gap.flatten(1))[0].view_as(gap)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        (jacobian,) = ctx.saved_tensors
        return None, _FirstDerivative.apply(torch.linalg.solve_ex(jacobian.mT, grad.flatten(1))[0].view_as(grad))


class _FirstDerivative(torch.autograd.Function):
    """A gradient that refuses to be differentiated; `once_differentiable` alone leaves such a path out in silence."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        raise NotImplementedError("free bodies have no second derivatives")


class BodyContact:
    """Contact of the nodes with the obstacles of bodies, whose poses are known, by the velocities of the bodies."""

    def __init__(self, bodies: FreeBodies, motion: Motion, blocks: Blocks, velocity: Tensor, mass: Tensor) -> None:
        self.velocity, self.mass = packed_rows(velocity), mass
        grid, self.dim = blocks.grid, blocks.grid.dim
        frames = bodies.frames.to(velocity.device)
        self.owner, self.arm, self.centre = frames.owner, frames.arms(motion.rotation), motion.position
        still = motion._replace(
            velocity=torch.zeros_like(motion.velocity), angular_velocity=torch.zeros_like(motion.angular_velocity)
        )
        assign(bodies.obstacles, frames.motion(still), 0.0)
        table, *self.kinds = obstacle_arguments(bodies.obstacles, self.velocity, grid.scenes)
        self.table = table.expand(grid.scenes, -1, -1)
        self.place = (None, 0.0, *blocks.packed, *walls_beside(bodies.step.walls, grid))

    def velocity_after(self, U: Tensor) -> Tensor:
        """Node velocities [N, D] after contact with bodies of the velocities U [B, K, n]."""
        rows = self._rows(U)
        return dispatch(torch.ops.torch_mpm.contact, self.velocity, rows, *self.kinds, *self.place, self.mass.detach())[
            :, 1:
        ]

    def impulses(self, U: Tensor) -> Tensor:
        """Impulses on the bodies about their centres of mass [B, K, n], float64."""
        on = dispatch(
            torch.ops.torch_mpm.contact_impulses, self.mass, self.velocity, self._rows(U), *self.kinds, *self.place
        )
        on = on.new_zeros(on.shape[0], U.shape[1], on.shape[2]).index_add(1, self.owner, on)
        linear, angular = on[..., : self.dim], on[..., self.dim :]
        moment = with_moment(self.centre, linear)[..., self.dim :]
        return torch.cat([linear, angular - moment], 2)

    def _rows(self, U: Tensor) -> Tensor:
        """The table of the obstacles with their velocities."""
        D, own = self.dim, U[:, self.owner]
        spin = own[..., D:]
        velocity = own[..., :D] + swirl(spin[..., 0] if D == 2 else spin, self.arm)
        velocity, spin = (value.to(self.table.dtype) for value in (velocity, spin))
        place, _, rotation, _, rest = self.table.split(
            [1 + D, D, spin.shape[2], spin.shape[2], self.table.shape[2] - 1 - 2 * D - 2 * spin.shape[2]], 2
        )
        return torch.cat([place, velocity, rotation, spin, rest], 2)
