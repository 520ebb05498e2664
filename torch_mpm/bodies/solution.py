"""Steps of free bodies from Python, with gradients by the implicit function theorem.

The op `torch_mpm::free_bodies` computes the same where no gradient is wanted.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..boundaries.motion import rotation_matrix
from ..cuda_graphs.capture import is_readable
from ..geometry.values import filled
from ..grid.grid import Blocks
from ..ops.autograd import dispatch, graph_at_once
from ..ops.contact import obstacle_arguments, packed_rows, walls_beside
from ..ops.impulses import with_moment
from .body import Body, mobility
from .exchange import POSE, Motion, assign, motion_of, moved, rotation_of, swirl

if TYPE_CHECKING:
    from .free_bodies import FreeBodies

MAX_ITERATIONS = 20
"""Iterations of Newton's method, but for steps from Python on CUDA."""
ITERATIONS_ON_CUDA = 8
"""Iterations of steps from Python where the host does not read the residual: most steps need 1 to 4."""
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}
"""Residual of velocities, relative to those of the bodies and by the impulses, by the dtype of the nodes."""


class Solution:
    """One step of the bodies, as `on_grid` of the step of the material."""

    def __init__(self, bodies: FreeBodies, rows: Tensor, dt: float, wrenches: Tensor | None) -> None:
        self.of, self.dt, self.dim = bodies, dt, bodies.step.grid.dim
        self.begin = rows
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
        self.predicted = self._predicted(wrenches)
        self.rows, self.residual, self.iterations = rows, rows.new_zeros(rows.shape[:2]), 0

    @property
    def report(self) -> Tensor:
        """Number of iterations, and the residual of each body, [B, 1 + K]."""
        count = torch.full_like(self.residual[:, :1], float(self.iterations))
        return torch.cat([count, self.residual], 1)

    def _predicted(self, wrenches: Tensor | None) -> Tensor:
        """Velocities at the end of the step without the material [B, K, n]."""
        velocity = self.begin[..., POSE[self.dim] :]
        force = torch.zeros_like(velocity)
        masses = filled([body.mass for body in self.of.bodies], force)
        force[..., : self.dim] = masses[:, None] * self.of.gravity_like(self.begin)
        if wrenches is not None:
            force = force + wrenches.double()
        return velocity + self.dt * self._applied(force)

    def __call__(self, blocks: Blocks, velocity: Tensor, mass: Tensor, dt: Any) -> Tensor:
        """Node velocities after contact with the bodies, whose rows at the end of the step are then known."""
        contact = _BodyContact(self.of, self.motion, blocks, velocity, mass)
        with torch.no_grad():
            U, jacobian = self._solve(contact.detached())
        if torch.is_grad_enabled():
            # One more iteration with a graph has the gradient of the solution, by the implicit function theorem.
            gap = U - self.predicted - self._applied(contact.impulses(U))
            U = U - _SolvedOnce.apply(jacobian(), gap)
        self.rows = self._end(self.predicted + self._applied(contact.impulses(U)))
        return contact.velocity_after(U)

    # -- the equations

    def _applied(self, impulses: Tensor) -> Tensor:
        return (self.mobility @ impulses[..., None])[..., 0]

    def _residual(self, contact: _BodyContact, U: Tensor) -> tuple[Tensor, Callable[[], Tensor]]:
        """Residuals [B, K, n] of velocities U, and a function that computes their derivatives by these
        [B, K n, K n]."""
        with torch.enable_grad(), graph_at_once():
            leaf = U.detach().requires_grad_()
            p = contact.impulses(leaf)

        def derivative() -> Tensor:
            with torch.enable_grad():
                sums = p.sum(0).flatten().unbind()
            rows = [torch.autograd.grad(total, leaf, retain_graph=True)[0].flatten(1) for total in sums]
            by_body = torch.stack(rows, 1).unflatten(1, p.shape[1:])
            applied = (self.mobility.detach() @ by_body).flatten(1, 2)
            return torch.eye(applied.shape[1], dtype=p.dtype, device=p.device) - applied

        return U - self.predicted - self._applied(p), derivative

    def size_of(self, velocities: Tensor) -> Tensor:
        """Speeds [B, K] of velocities [B, K, n]; of rotation that at the radius of gyration."""
        inertia = self.mass.diagonal(dim1=2, dim2=3)[..., self.dim :].mean(2)
        squared = velocities[..., : self.dim].square().sum(2)
        spin = velocities[..., self.dim :].square().sum(2)
        return (squared + spin * inertia / self.mass[..., 0, 0]).sqrt()

    def _solve(self, contact: _BodyContact) -> tuple[Tensor, Callable[[], Tensor]]:
        """Velocities [B, K, n] at the end of the step, and the derivative of the residual there."""
        U, dtype = self.predicted.detach(), contact.velocity.dtype
        residual, derivative = self._residual(contact, U)
        size = self.size_of(residual)
        scale = self.size_of(self.predicted) + size + torch.finfo(U.dtype).tiny
        reads, share = is_readable(U), torch.ones_like(scale[:, 0])
        for _ in range(MAX_ITERATIONS if reads else ITERATIONS_ON_CUDA):
            if reads and bool((size <= 0.1 * TOLERANCE[dtype] * scale).all()):
                break
            self.iterations += 1
            jacobian = derivative()
            # Velocities are rounded to the dtype of the nodes, whose impulses change accordingly.
            eye = torch.eye(jacobian.shape[1], dtype=U.dtype, device=U.device)
            rounded = torch.finfo(dtype).eps * (jacobian - eye).norm(dim=(1, 2))
            scale = torch.maximum(scale, (rounded[:, None] * self.size_of(U)) / TOLERANCE[dtype])
            step = torch.linalg.solve_ex(jacobian, residual.flatten(1))[0].view_as(U)
            trial = U - share[:, None, None] * step
            found, of_trial = self._residual(contact, trial)
            better = self.size_of(found).norm(dim=1) < size.norm(dim=1)
            share = torch.where(better, 1.0, 0.5 * share)
            if reads and bool(better.all()):
                U, residual, derivative = trial, found, of_trial
            else:
                U = torch.where(better[:, None, None], trial, U)
                residual, derivative = self._residual(contact, U)
            size = self.size_of(residual)
        self.residual = size / scale
        return U, derivative

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


class _BodyContact:
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

    def detached(self) -> _BodyContact:
        """The same without gradients."""
        other = copy.copy(self)
        for name in ("velocity", "mass", "table", "arm", "centre"):
            setattr(other, name, getattr(self, name).detach())
        return other

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
