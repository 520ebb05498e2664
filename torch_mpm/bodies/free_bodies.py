"""Rigid bodies that the material pushes: their velocities are solved for together with the contact of the nodes.

A body has a velocity and an angular velocity U [m/s, 1/s] at the end of a step. Without the material they were U*. The
nodes that it meets give it impulses p(U) [N s, N m s], which depend on U:

    U = U* + W p(U),

with its mobility W [1/kg, 1/(kg m²)], the inverse of mass and inertia, as far as a joint leaves the body free. The
impulses are those of `torch_mpm.ops.contact_impulses`. Newton's method solves these equations, 3 (2-D) or 6 (3-D) of
each of the K bodies of a scene together; −dp/dU is the mass of the nodes that follow the bodies, so that light bodies
are stable at the time step of the material.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..boundaries.motion import rotation_matrix
from ..cuda_graphs.capture import is_readable
from ..errors import FLOATING, SimulationError, check_count, check_number, check_vector, shape_of
from ..geometry.values import filled
from ..grid.grid import Blocks
from ..ops.autograd import dispatch, graph_at_once
from ..ops.contact import MAX_OBSTACLES, fusible, obstacle_arguments, packed_rows, walls_beside
from ..ops.impulses import with_moment
from ..state.state import State, check_state
from ..step.step import Step
from .body import Body, Driven, Joint, mobility
from .exchange import POSE, VELOCITY, Frames, Motion, assign, check_bodies, motion_of, moved, rotation_of, swirl

MAX_ITERATIONS = 20
"""Iterations of Newton's method where the host reads the residual."""
ITERATIONS_ON_CUDA = 8
"""Iterations where it does not: most steps need 1 to 4."""
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}
"""Residual of velocities, relative to those of the bodies and by the impulses, by the dtype of the nodes."""
NOT_ALLOWED = 1e-5
"""Largest share of a velocity that a joint does not allow."""


class BodyReport(NamedTuple):
    """Solutions of the latest call of `advance`.

    Attributes:
        iterations: the largest number of iterations of a step.
        residual: largest residual of a step [B, K], relative to the velocities and to what their rounding to the dtype
            of the nodes changes.
        converged: whether all residuals are within the tolerance, bool [B, K].
    """

    iterations: int
    residual: Tensor
    converged: Tensor


class FreeBodies:
    """Rigid bodies and material that move each other, in every scene of a batch.

    Bodies act after the boundaries of the step, all of them as one solid. They do not collide with each other, nor with
    walls or obstacles: that is left to simulators of rigid bodies (`torch_mpm.couple`).

    Args:
        step: a step without `on_grid`.
        bodies: `Body`, K of them, whose obstacles are not among the boundaries of the step.
        gravity: of the bodies [m/s²], D numbers; None for that of the step.

    Attributes:
        report: `BodyReport` of the latest call of `advance`; None before.

    Raises:
        TypeError, ValueError: for anything else, or obstacles that act at some times or in some scenes only, or whose
            shape the kernel of contact does not know.
    """

    def __init__(self, step: Step, bodies: Sequence[Body], gravity: Sequence[float] | None = None) -> None:
        if not isinstance(step, Step):
            raise TypeError(f"step must be a Step, got {shape_of(step)}")
        if not isinstance(bodies, Sequence) or not all(isinstance(body, Body) for body in bodies) or not bodies:
            raise TypeError(f"bodies must be a list of Body, got {shape_of(bodies)}")
        self.step, self.bodies = step, list(bodies)
        self.report: BodyReport | None = None
        dim = step.grid.dim
        self.gravity = None if gravity is None else check_vector("gravity", gravity, dim)
        known = {id(boundary) for boundary in step.boundaries}
        for k, body in enumerate(bodies):
            body.check_dimension(dim)
            for part in body.parts:
                _check_obstacle(k, part.obstacle, known)
        self.obstacles = [part.obstacle for body in bodies for part in body.parts]
        if len(self.obstacles) > MAX_OBSTACLES:
            raise ValueError(f"bodies must have at most {MAX_OBSTACLES} obstacles, got {len(self.obstacles)}")
        self.frames = Frames.of([body.parts for body in bodies], dim)

    def __len__(self) -> int:
        return len(self.bodies)

    def advance(
        self, state: State, bodies: Tensor, n: int, dt: float, wrenches: Tensor | None = None
    ) -> tuple[State, Tensor]:
        """The material and the bodies n steps later.

        Args:
            state: the particles.
            bodies: poses and velocities [B, K, 13] (3-D) or [B, K, 6] (2-D), float64 or float32, see
                `torch_mpm.bodies.exchange`; positions are those of the centres of mass. Velocities of bodies with a
                joint are those that it allows.
            n, dt: number of steps, and time step [s], a number.
            wrenches: forces [N] and torques about the centres of mass [N m] on the bodies beside gravity and the
                material [B, K, 6] or [B, K, 3]; None for none.

        Returns:
            The state, and poses and velocities as `bodies`, float64. What the material loses the bodies gain, to
            rounding: linear and, with APIC, angular momentum. Differentiable in the state and `bodies`.

        Raises:
            TypeError, ValueError: for wrong arguments.
        """
        check_count("n", n, 1)
        check_state(state)
        check_bodies(bodies, state, self.step.grid, len(self))
        check_number("dt", dt, "positive and finite", lambda v: 0 < v < math.inf)
        self._check_wrenches(wrenches, bodies)
        if torch.is_inference_mode_enabled() or torch._C._are_functorch_transforms_active():
            raise NotImplementedError(
                "free bodies differentiate the contact of the nodes: use torch.no_grad() in place of inference_mode, "
                "and torch.autograd in place of torch.func"
            )
        if self.step.on_grid is not None:
            raise ValueError("a step with bodies must have no on_grid of its own")
        now = bodies.double()
        worst = now.new_zeros(now.shape[:2])
        most = 0
        for k in range(n):
            solution = _Solution(self, now, dt, wrenches)
            if k == 0:
                solution.check_joints()
            self.step.on_grid = solution
            try:
                state = self.step(state, dt)
            finally:
                self.step.on_grid = None
            now = solution.rows
            worst, most = torch.maximum(worst, solution.residual), max(most, solution.iterations)
        self.report = BodyReport(most, worst, worst <= TOLERANCE[state.x.dtype])
        assign(self.obstacles, self.frames.motion(motion_of(now.detach(), self.step.grid.dim)), 0.0)
        return state, now

    def _check_wrenches(self, wrenches: Tensor | None, bodies: Tensor) -> None:
        if wrenches is None:
            return
        expected = [*bodies.shape[:2], VELOCITY[self.step.grid.dim]]
        if not isinstance(wrenches, Tensor) or list(wrenches.shape) != expected:
            raise ValueError(f"wrenches must have shape [B, K, n] = {expected}, got {shape_of(wrenches)}")
        if wrenches.dtype not in FLOATING:
            raise TypeError(f"wrenches must be float32 or float64, got {wrenches.dtype}")
        if wrenches.device != bodies.device:
            raise ValueError(f"wrenches must be on the device of bodies, {bodies.device}, got {wrenches.device}")
        if is_readable(wrenches) and not bool(wrenches.detach().isfinite().all()):
            raise ValueError("wrenches must be finite, got NaN or infinity")

    def check(self) -> None:
        """Raise where a solution of the latest call has not converged.

        Raises:
            SimulationError: it names the scene and the body. Momentum is conserved even so.
        """
        if self.report is not None and not bool(self.report.converged.all()):
            scene, body = (~self.report.converged).nonzero()[0].tolist()
            residual = float(self.report.residual[scene, body])
            raise SimulationError(
                f"the velocity of body {body} of scene {scene} has not converged with the contact of the nodes: its "
                f"residual is {residual:.1e} of the velocities; friction of more than 2 on a light body may be the "
                "cause, or a dt that is too large"
            )

    def gravity_like(self, rows: Tensor) -> Tensor:
        """Gravity in the dtype of rows, [D] or [B, 1, D]."""
        dim = self.step.grid.dim
        if self.gravity is not None:
            return filled(self.gravity, rows)
        found = self.step.gravity_like(rows)
        if found is None:
            return rows.new_zeros(dim)
        return found if found.dim() == 1 else found[:, None]


class _Solution:
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

    def _predicted(self, wrenches: Tensor | None) -> Tensor:
        """Velocities at the end of the step without the material [B, K, n]."""
        velocity = self.begin[..., POSE[self.dim] :]
        force = torch.zeros_like(velocity)
        masses = filled([body.mass for body in self.of.bodies], force)
        force[..., : self.dim] = masses[:, None] * self.of.gravity_like(self.begin)
        if wrenches is not None:
            force = force + wrenches.double()
        return velocity + self.dt * self._applied(force)

    def check_joints(self) -> None:
        """Raise ValueError for velocities at the beginning that a joint does not allow, where they can be read."""
        bodies = self.of.bodies
        if not is_readable(self.begin) or all(type(body.joint) in (Joint, Driven) for body in bodies):
            return
        own = self.begin[..., POSE[self.dim] :].detach()
        allowed = self._applied((self.mass @ own[..., None])[..., 0])
        wrong = self.size_of(own - allowed) > NOT_ALLOWED * self.size_of(own)
        for k, body in enumerate(bodies):
            if not isinstance(body.joint, Driven) and bool(wrong[:, k].any()):
                kind = type(body.joint).__name__.lower()
                raise ValueError(f"bodies must have velocities that their joints allow, and body {k} is on a {kind}")

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


def _check_obstacle(k: int, obstacle: Any, known: set[int]) -> None:
    """Check an obstacle of body k, which becomes known."""
    if id(obstacle) in known:
        raise ValueError(f"obstacles of body {k} must be no boundaries of the step, nor those of another body")
    known.add(id(obstacle))
    if obstacle.start != 0 or obstacle.end != math.inf or obstacle.scene is not None:
        raise ValueError(f"obstacles of body {k} must act at all times and in all scenes")
    if obstacle.shape.number is None:
        raise ValueError(
            f"obstacles of body {k} must have shapes that the kernel of contact knows, got a {obstacle.shape.name}: "
            "convert it by torch_mpm.shapes.Sampled.of"
        )
    if not fusible(obstacle, 0.0):
        raise ValueError(f"obstacles of body {k} must have no hooks and no functions of their own")
