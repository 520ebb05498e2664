"""Rigid bodies that the material pushes: their velocities are solved for together with the contact of the nodes.

A body with the velocity U* at the end of a step, but for the material, takes the impulses p of the nodes that it meets,
which depend on its velocity U at the end of the step:

    U = U* + W p(U),

with its mobility W, the inverse of mass and inertia, as far as a joint leaves the body free. The impulses are those of
`torch_mpm.ops.contact_impulses`. Newton's method solves these 3 (2-D) or 6 (3-D) equations; −dp/dU is the mass of the
nodes that follow the body, so that light bodies are stable at the time step of the material.
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
from ..grid.grid import Blocks
from ..ops.autograd import dispatch, graph_at_once
from ..ops.contact import MAX_OBSTACLES, is_of_kernel, obstacle_arguments, packed_rows, walls_beside
from ..state.state import State, check_state
from ..step.step import Step
from .body import Body, mobility
from .exchange import POSE, VELOCITY, Frames, Motion, assign, check_bodies, motion_of, moved, swirl

MOST_ITERATIONS = 20
"""Iterations of Newton's method where the host reads the residual."""
ITERATIONS_UNREAD = 6
"""Iterations where it does not, on CUDA: most steps need 1 to 4."""
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}
"""Residual of velocities, relative to those of the bodies and by the impulses, by the dtype of the nodes."""


class BodyReport(NamedTuple):
    """Solutions of the latest call of `advance`.

    Attributes:
        iterations: the largest number of iterations of a step.
        residual: largest residual of a step, relative to the velocities [B, K].
        converged: whether all residuals are within the tolerance, bool [B, K].
    """

    iterations: int
    residual: Tensor
    converged: Tensor


class FreeBodies:
    """Rigid bodies that move each other and the material, in every scene of a batch.

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
        if self.step.on_grid is not None:
            raise ValueError("a step with bodies must have no on_grid of its own")
        now = bodies.double()
        worst = now.new_zeros(now.shape[:2])
        most = 0
        for _ in range(n):
            solution = _Solution(self, now, dt, wrenches)
            self.step.on_grid = solution
            try:
                state = self.step(state, dt)
            finally:
                self.step.on_grid = None
            now = solution.rows
            worst, most = torch.maximum(worst, solution.residual), max(most, solution.iterations)
        self.report = BodyReport(most, worst, worst <= TOLERANCE[state.x.dtype])
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
                f"residual is {residual:.1e} of the velocities; use a smaller dt"
            )

    def gravity_like(self, rows: Tensor) -> Tensor:
        """Gravity in the dtype of rows, [D] or [B, 1, D]."""
        dim = self.step.grid.dim
        if self.gravity is not None:
            return rows.new_tensor(self.gravity)
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
        """Velocities at the end of the step but for the material [B, K, n]."""
        velocity = self.begin[..., POSE[self.dim] :]
        force = torch.zeros_like(velocity)
        masses = force.new_tensor([body.mass for body in self.of.bodies])
        force[..., : self.dim] = masses[:, None] * self.of.gravity_like(self.begin)
        if wrenches is not None:
            force = force + wrenches.double()
        return velocity + self.dt * (self.mobility @ force[..., None])[..., 0]

    def __call__(self, blocks: Blocks, velocity: Tensor, mass: Tensor, dt: Any) -> Tensor:
        """Node velocities after contact with the bodies, whose rows at the end of the step are then known."""
        contact = _BodyContact(self.of, self.motion, blocks, velocity, mass)
        with torch.no_grad():
            U, jacobian = self._solve(contact.detached())
        if torch.is_grad_enabled():
            # One more iteration with a graph has the gradient of the solution, by the implicit function theorem.
            gap = U - self.predicted - self._applied(contact.impulses(U))
            U = U - torch.linalg.solve(jacobian(), gap)
        self.rows = self._end(self.predicted + self._applied(contact.impulses(U)))
        return contact.velocity_after(U)

    # -- the equations

    def _applied(self, impulses: Tensor) -> Tensor:
        return (self.mobility @ impulses[..., None])[..., 0]

    def _residual(self, contact: _BodyContact, U: Tensor) -> tuple[Tensor, Callable[[], Tensor]]:
        """Residuals [B, K, n] of velocities U, and a function that computes their derivatives by these [B, K, n, n]."""
        with torch.enable_grad(), graph_at_once():
            leaf = U.detach().requires_grad_()
            p = contact.impulses(leaf)

        def derivative() -> Tensor:
            with torch.enable_grad():
                sums = p.sum((0, 1)).unbind()
            columns = [torch.autograd.grad(total, leaf, retain_graph=True)[0] for total in sums]
            eye = torch.eye(p.shape[2], dtype=p.dtype, device=p.device)
            return eye - self.mobility.detach() @ torch.stack(columns, 2)

        return U - self.predicted.detach() - self._applied(p.detach()).detach(), derivative

    def _size(self, velocities: Tensor) -> Tensor:
        """Speeds [B, K] of velocities [B, K, n]; of rotation that at the radius of gyration."""
        inertia = self.mass.diagonal(dim1=2, dim2=3)[..., self.dim :].mean(2)
        squared = velocities[..., : self.dim].square().sum(2)
        spin = velocities[..., self.dim :].square().sum(2)
        return (squared + spin * inertia / self.mass[..., 0, 0]).sqrt()

    def _solve(self, contact: _BodyContact) -> tuple[Tensor, Callable[[], Tensor]]:
        """Velocities [B, K, n] at the end of the step, and the derivative of the residual there."""
        U = self.predicted.detach()
        residual, derivative = self._residual(contact, U)
        size = self._size(residual)
        scale = self._size(self.predicted) + size + torch.finfo(U.dtype).tiny
        dtype = contact.velocity.dtype
        tolerance, reads, share = 0.1 * TOLERANCE[dtype], is_readable(U), torch.ones_like(scale)
        for _ in range(MOST_ITERATIONS if reads else ITERATIONS_UNREAD):
            if reads and bool((size <= tolerance * scale).all()):
                break
            self.iterations += 1
            trial = U - share[..., None] * torch.linalg.solve(derivative(), residual)
            found, of_trial = self._residual(contact, trial)
            better = self._size(found) < size
            share = torch.where(better, 1.0, 0.5 * share)
            if reads and bool(better.all()):
                U, residual, derivative = trial, found, of_trial
            else:
                U = torch.where(better[..., None], trial, U)
                residual, derivative = self._residual(contact, U)
            size = self._size(residual)
        self.residual = size / scale
        return U, derivative

    # -- the end of the step

    def _end(self, U: Tensor) -> Tensor:
        """Rows [B, K, 13] or [B, K, 6] at the end of a step with velocities U."""
        pose = moved(torch.cat([self.begin[..., : POSE[self.dim]], U], 2), self.dt)
        turn = rotation_matrix(motion_of(torch.cat([pose, U], 2), self.dim).rotation, self.dim)
        ends = []
        for k, body in enumerate(self.of.bodies):
            place, own = pose[:, k], U[:, k]
            arm = body.joint.arm(self.motion.position[:, k])
            if arm is not None:  # on the circle about the fixed point
                way = (turn[:, k] @ self.turn[:, k].mT @ arm[..., None])[..., 0]
                place = torch.cat([self.motion.position[:, k] - arm + way, place[:, self.dim :]], 1)
                spin = own[:, self.dim] if self.dim == 2 else own[:, self.dim :]
                own = torch.cat([swirl(spin, way), own[:, self.dim :]], 1)
            elif self.dim == 3 and body.joint.directions(place[:, :3]) is None:  # keeps its angular momentum
                momentum = self.mass[:, k, 3:, 3:] @ own[:, 3:, None]
                spin = torch.linalg.solve(body.mass_matrix(turn[:, k])[:, 3:, 3:], momentum)[..., 0]
                own = torch.cat([own[:, :3], spin], 1)
            ends.append(torch.cat([place, own], 1))
        return torch.stack(ends, 1)


class _BodyContact:
    """Contact of the nodes with the obstacles of bodies, whose poses are known, by the velocities of the bodies."""

    def __init__(self, bodies: FreeBodies, motion: Motion, blocks: Blocks, velocity: Tensor, mass: Tensor) -> None:
        self.bodies, self.motion, self.velocity, self.mass = bodies, motion, packed_rows(velocity), mass
        grid, self.dim = blocks.grid, blocks.grid.dim
        still = motion._replace(
            velocity=torch.zeros_like(motion.velocity), angular_velocity=torch.zeros_like(motion.angular_velocity)
        )
        assign(bodies.obstacles, bodies.frames.motion(still), 0.0)
        table, *self.kinds = obstacle_arguments(bodies.obstacles, self.velocity, grid.scenes)
        self.table = table.expand(grid.scenes, -1, -1)
        self.place = (None, 0.0, *blocks.packed, *walls_beside(bodies.step.walls, grid))

    def detached(self) -> _BodyContact:
        """The same without gradients."""
        other = copy.copy(self)
        other.motion = Motion(*(value.detach() for value in self.motion))
        other.velocity, other.mass, other.table = self.velocity.detach(), self.mass.detach(), self.table.detach()
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
        owner = self.bodies.frames.owner.to(on.device)
        on = on.new_zeros(on.shape[0], len(self.bodies), on.shape[2]).index_add(1, owner, on)
        linear, angular = on[..., : self.dim], on[..., self.dim :]
        return torch.cat([linear, angular - _moment(self.motion.position, linear)], 2)

    def _rows(self, U: Tensor) -> Tensor:
        """The table of the obstacles with their velocities."""
        D, turning = self.dim, U[..., 2] if self.dim == 2 else U[..., 3:]
        moves = self.bodies.frames.motion(self.motion._replace(velocity=U[..., :D], angular_velocity=turning))
        spin = moves.angular_velocity.reshape(*moves.velocity.shape[:2], -1)
        velocity, spin = (value.to(self.table.dtype) for value in (moves.velocity, spin))
        place, _, rotation, _, rest = self.table.split(
            [1 + D, D, spin.shape[2], spin.shape[2], self.table.shape[2] - 1 - 2 * D - 2 * spin.shape[2]], 2
        )
        return torch.cat([place, velocity, rotation, spin, rest], 2)


def _moment(arm: Tensor, force: Tensor) -> Tensor:
    """Moments [B, K, 1 or 3] of forces at the end of arms [B, K, D]."""
    if arm.shape[-1] == 3:
        return torch.linalg.cross(arm, force)
    return (arm[..., 0] * force[..., 1] - arm[..., 1] * force[..., 0])[..., None]


def _check_obstacle(k: int, obstacle: Any, known: set[int]) -> None:
    """Check an obstacle of body k, which becomes known."""
    if id(obstacle) in known:
        raise ValueError(f"obstacles of body {k} must be no boundaries of the step, nor those of another body")
    known.add(id(obstacle))
    if obstacle.start != 0 or obstacle.end != math.inf or obstacle.scene is not None:
        raise ValueError(f"obstacles of body {k} must act at all times and in all scenes")
    if not is_of_kernel(obstacle, 0.0):
        raise ValueError(
            f"obstacles of body {k} must have shapes that the kernel of contact knows, got a {obstacle.shape.name}: "
            "convert it by torch_mpm.shapes.Sampled.of"
        )
