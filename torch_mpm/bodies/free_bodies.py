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

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..boundaries.control import Poses, restored
from ..boundaries.thickness import warn_of_thin_walls
from ..cuda_graphs.capture import DeviceConstantCache, is_readable
from ..errors import FLOATING, SimulationError, check_count, check_number, check_vector, shape_of
from ..geometry.values import filled
from ..grid.grid import Blocks
from ..ops.autograd import is_tracked
from ..ops.contact import MAX_OBSTACLES, fusible, walls_beside
from ..ops.free_bodies import BodyTables, body_tables
from ..ops.obstacle_tables import values_without_motion
from ..rollouts.budget import EVERYTHING, within_budget
from ..rollouts.checkpoints import Checkpoints, as_checkpoints, from_python, offloading
from ..rollouts.facts import wants_gradient
from ..rollouts.reasons import why_not_fused
from ..rollouts.run import computed
from ..rollouts.steps import MovingBodies, Steps
from ..state.state import State, check_state
from ..step.status import aside
from ..step.step import Step
from . import solution
from .body import Body, Driven, Joint
from .exchange import POSE, VELOCITY, Frames, assign, check_bodies, motion_of
from .solution import TOLERANCE, Solution


class BodyReport(NamedTuple):
    """Solutions of the latest call of `advance`.

    Attributes:
        iterations: the largest number of iterations of a step [B], float64.
        residual: largest residual of a step [B, K], relative to the velocities and to what their rounding to the dtype
            of the nodes changes.
        converged: whether all residuals are within the tolerance, bool [B, K].
    """

    iterations: Tensor
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
        self._tables = DeviceConstantCache()

    def __len__(self) -> int:
        return len(self.bodies)

    def advance(
        self,
        state: State,
        bodies: Tensor,
        n: int,
        dt: float,
        wrenches: Tensor | None = None,
        checkpoint: int | Checkpoints | None = None,
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
            checkpoint: states to store for the backward pass, which recomputes the steps in between: a number, for the
                state of every `checkpoint` steps, or `Checkpoints`, as in `torch_mpm.rollout`. None: all steps are
                stored. Without effect where no gradient is wanted.

        Returns:
            The state, and poses and velocities as `bodies`, float64. What the material loses the bodies gain, to
            rounding: linear and, with APIC, angular momentum. Differentiable in the state, `bodies`,
            `wrenches`, and tensors of the bodies and the step.

        Raises:
            TypeError, ValueError: for wrong arguments.
        """
        check_count("n", n, 1)
        check_state(state)
        check_bodies(bodies, state, self.step.grid, len(self))
        check_number("dt", dt, "positive and finite", lambda v: 0 < v < math.inf)
        self._check_wrenches(wrenches, bodies)
        if torch._C._are_functorch_transforms_active():
            raise NotImplementedError(
                "free bodies have no transforms of torch.func: use torch.autograd in place of them"
            )
        if self.step.on_grid is not None:
            raise ValueError("a step with bodies must have no on_grid of its own")
        rows = bodies.double()
        self._check_joints(rows)
        steps = Steps(self.step, n, dt, as_checkpoints(checkpoint))
        state, rows, report = self._advanced(steps, state, rows, wrenches)
        residual = report[:, 1:]
        self.report = BodyReport(report[:, 0], residual, residual <= TOLERANCE[state.x.dtype])
        assign(self.obstacles, self.frames.motion(motion_of(rows.detach(), self.step.grid.dim)), 0.0)
        return state, rows

    def _advanced(
        self, steps: Steps, state: State, rows: Tensor, wrenches: Tensor | None
    ) -> tuple[State, Tensor, Tensor]:
        """The state, rows and report after steps: by the fused op, or step by step."""
        moving = self._in_one_op(steps, state, rows, wrenches)
        with steps.call(state) as end_call, steps.control(state) as end_motion:
            if moving is not None:
                state = end_call(end_motion(computed(steps._replace(bodies=moving, checkpoints=None), state)))
                return state, moving.rows, moving.report
            state, rows, report = self._step_by_step(steps, state, rows, wrenches)
            return end_call(end_motion(state)), rows, report

    def _step_by_step(self, steps: Steps, state: State, rows: Tensor, wrenches: Tensor | None) -> _Moved:
        """The state, rows and report after steps from Python, with the stored states that the gradient wants."""

        def advance(now: _Moved, count: int, first: int) -> _Moved:
            with restored(self.obstacles):  # The backward pass calls this again, when they are elsewhere.
                for _ in range(count):
                    now = self._stepped(now, steps.dt, wrenches)
            return now

        def alone(given: State, dt: Any) -> State:
            with aside(self.step, given.x):
                return advance(start._replace(state=given), 1, 0).state

        # The backward pass reads them again, when the caller may have written other ones to their memory.
        wrenches = wrenches.clone() if wrenches is not None and steps.checkpoints is not None else wrenches
        start = _Moved(state, rows, rows.new_zeros(len(rows), 1 + len(self)))
        checkpoints = None
        if steps.checkpoints is not None and torch.is_grad_enabled():
            start = start._replace(state=self.step.prepare(self.step.with_residual(state, steps.dt)))
            checkpoints = within_budget(steps._replace(step=alone), start.state, fused=False)
        if checkpoints is None or checkpoints is EVERYTHING:
            return advance(start, steps.n, 0)
        with offloading(checkpoints, start.state):
            return from_python(advance, start, steps.n, checkpoints, self.step)

    def _stepped(self, now: _Moved, dt: Any, wrenches: Tensor | None) -> _Moved:
        """The material and the bodies a step later."""
        hook = _Hook(self, now.rows, dt, wrenches)
        self.step.on_grid = hook
        try:
            state = self.step(now.state, dt)
        finally:
            self.step.on_grid = None
        return _Moved(state, hook.rows, torch.maximum(now.report, hook.report))

    def _in_one_op(self, steps: Steps, state: State, rows: Tensor, wrenches: Tensor | None) -> MovingBodies | None:
        """The bodies of steps that the fused op computes; None where it does not."""
        if self.differentiates(rows, wrenches) or wants_gradient(steps, state):
            return None
        if why_not_fused(self.step, state, steps.n, steps.dt) is not None:
            return None
        (now, *tensors), *others = self.given(state.x, rows, wrenches)
        return MovingBodies(now, now.new_zeros(len(now), 1 + len(self)), (tensors, tuple(others)))

    def _check_joints(self, rows: Tensor) -> None:
        """Raise ValueError for velocities that a joint does not allow, where they can be read."""
        if not is_readable(rows):
            return
        dim, values = self.step.grid.dim, rows.detach()
        for k, body in enumerate(self.bodies):
            if type(body.joint) in (Joint, Driven):
                continue
            if not body.moves_as_its_joint(values[:, k, :dim], values[:, k, POSE[dim] :]):
                kind = type(body.joint).__name__.lower()
                raise ValueError(f"bodies must have velocities that their joints allow, and body {k} is on a {kind}")

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
        """Raise where a solution of the latest call has not converged, and warn of thin walls of the bodies.

        Raises:
            SimulationError: it names the scene and the body. Momentum is conserved even so.

        Warns:
            ThinWallWarning: as `Step.check`; obstacles are numbered through all bodies.
        """
        warn_of_thin_walls(self.obstacles, self.step.grid.dx)
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

    def differentiates(self, *tensors: Tensor | None) -> bool:
        """Whether a gradient by one of the tensors, gravity, masses, or a parameter of the obstacles is wanted."""
        values = [value for obstacle in self.obstacles for value in values_without_motion(obstacle)]
        values += [value for body in self.bodies for value in (body.mass, body.inertia)]
        return is_tracked(*[value for value in (*tensors, self.step.gravity, *values) if isinstance(value, Tensor)])

    def tables(self, like: Tensor) -> BodyTables:
        """Tables of the ops for nodes of the dtype and device of `like`, which are cached while nothing changes."""
        values = [value for obstacle in self.obstacles for value in values_without_motion(obstacle)]
        of_bodies = [(b.mass, b.inertia, b.joint.name, *vars(b.joint).values()) for b in self.bodies]
        kinds = [obstacle.kind for obstacle in self.obstacles]
        key = (like.dtype, like.device, like.shape[1], *kinds, *of_bodies, *values)
        scenes, frames = self.step.grid.scenes, self.frames
        with torch.no_grad():
            made: BodyTables = self._tables.get(
                key, lambda: body_tables(self.bodies, frames.owner.tolist(), frames.flat(), like, scenes), like
            )
        return made

    def given(self, like: Tensor, rows: Tensor, wrenches: Tensor | None) -> tuple[Any, ...]:
        """The bodies as the ops take them, for particles or nodes of the dtype and device of `like`."""
        (table, data, constants, parts, lists), gravity = self.tables(like), self.gravity_like(rows)
        force = [] if wrenches is None else [wrenches.double()]
        tensors = [rows, table, data, constants, parts, gravity.reshape(-1, self.step.grid.dim), *force]
        limits = solution.MAX_ITERATIONS, TOLERANCE[like.dtype]
        return ([t.detach().contiguous() for t in tensors], *lists, *limits)


class _Moved(NamedTuple):
    """Material and bodies after some steps: the pytree that checkpoints store."""

    state: State
    rows: Tensor
    report: Tensor

    @property
    def x(self) -> Tensor:
        return self.state.x

    @property
    def poses(self) -> Poses:
        return self.state.poses

    def with_poses(self, poses: Poses) -> _Moved:
        return self._replace(state=self.state.with_poses(poses))


class _Hook:
    """One step of the bodies, as `on_grid` of the step of the material: by the op, or with gradients by `Solution`."""

    def __init__(self, bodies: FreeBodies, rows: Tensor, dt: Any, wrenches: Tensor | None) -> None:
        self.of, self.rows, self.dt, self.wrenches = bodies, rows, dt, wrenches
        self.report = rows

    def __call__(self, blocks: Blocks, velocity: Tensor, mass: Tensor, dt: Any) -> Tensor:
        """Node velocities after contact with the bodies, whose rows at the end of the step are then known."""
        if self.of.differentiates(velocity, mass, self.rows, self.wrenches):
            solution = Solution(self.of, self.rows, self.dt, self.wrenches)
            after = solution(blocks, velocity, mass, dt)
            self.rows, self.report = solution.rows, solution.report
            return after
        given = self.of.given(velocity, self.rows, self.wrenches)
        place = *blocks.packed, *walls_beside(self.of.step.walls, blocks.grid)
        op = torch.ops.torch_mpm.free_bodies
        after, self.rows, self.report, *_ = op(velocity, mass, *given, self.dt, False, *place)
        return after


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
