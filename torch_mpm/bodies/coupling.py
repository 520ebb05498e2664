"""Bodies of a MuJoCo model as obstacles of a step, coupled in both directions (`pip install torch-mpm[mujoco]`).

    coupling = mpm.couple(model, step, bodies=["left finger", "right finger"])
    for k in range(500):
        coupling.data[0].ctrl[:] = control(k)
        state = coupling.advance(state)               # one step of MuJoCo, some steps of the material

The scheme and its accuracy are described in docs/bodies.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import SimulationError, check_count, check_number, shape_of
from ..ops.impulses import with_moment
from ..rollouts import rollout
from ..state.state import State, check_state
from ..step.step import Step
from .exchange import RigidBodies, with_velocities
from .fixed_point import FixedPoint
from .geoms import body_number, colliding_geoms, geom_name, load_mujoco, part_of_geom
from .mujoco_scenes import MujocoScenes

SAMPLES_PER_CELL = 2
"""Samples of a mesh per cell of the grid along each axis."""
MOST_SUBSTEPS = 100_000
"""Largest number of substeps that is chosen; more are those of a material that is unstable."""


def couple(
    model: Any,
    step: Step,
    bodies: Sequence[str],
    *,
    geoms: Sequence[str] | None = None,
    kind: str = "separate",
    friction: float | None = None,
    substeps: int | None = None,
    exchanges: int = 1,
    data: Any = None,
    threads: int | None = None,
) -> MujocoCoupling:
    """Couple bodies of a MuJoCo model with the material of a step.

    Their geoms become obstacles, which are added to `step.boundaries`: planes, spheres, capsules, cylinders, boxes, and
    closed meshes, which are sampled. Geoms that collide with nothing in MuJoCo (contype and conaffinity zero) are left
    out. The wrenches of the material act as `xfrc_applied`, which the coupling assigns for these bodies.

    Args:
        model: MjModel, in the coordinates of the grid, which must be 3-D.
        step: the step of the material, with its own gravity.
        bodies: names of bodies; "world" for geoms that do not move.
        geoms: names of the only geoms that become obstacles; None for all of the bodies.
        kind, friction: of the obstacles; None for the sliding friction of each geom.
        substeps: steps of the material in each step of MuJoCo; None for the least number of at most half of the stable
            time step of the material, computed in each `advance`.
        exchanges: solutions of each step of MuJoCo with the material. With 1 the wrench of a step acts in the next one.
            With more, both sides are solved several times from the same states, so that the wrench of a step acts
            in it, as bodies need that are lighter than the material that they move.
        data: MjData, or a list of one for each scene of the grid; None for new ones.
        threads: number of threads that compute the steps of MuJoCo, each with a part of the scenes; 1 for the calling
            thread. None for those of torch where the scenes have at least 500 degrees of freedom and MuJoCo has
            threads for the model. The last solution of each `advance` is always that of the calling thread, which
            computes contacts and sensors in `data` too. Results do not depend on the number, bit by bit.

    Returns:
        The coupling, whose `advance` takes the place of `mj_step` and `rollout`. As after a rollout, `step.check`
        reports particles that left the grid.

    Raises:
        ImportError: without mujoco, and for threads without `mujoco.batch`, which version 3.17 has.
        TypeError, ValueError: for a wrong argument, an unknown body or geom, a geom of another type, a body without an
            obstacle; for threads where MuJoCo has none: models with plugins or sleeping bodies, and Python callbacks.
    """
    return MujocoCoupling(model, step, bodies, geoms, kind, friction, substeps, exchanges, data, threads)


class MujocoCoupling:
    """Bodies of a MuJoCo model and the material of a step; see `couple`.

    Attributes:
        data: list of MjData, one for each scene of the grid.
        obstacles: obstacles by name of their geom, "geom 3" for one without a name; their kind and friction may be
            assigned.
        wrenches: mean force [N] and torque about the centre of mass [N m] of the material on each body in the latest
            step of MuJoCo [B, K, 6], float64 on the CPU.
        pending: impulses of the material that have not acted on the bodies yet [B, K, 6], linear [N s] and angular
            about the origin [N m s]. The momentum of the material, of the bodies and of these is conserved.
    """

    def __init__(
        self,
        model: Any,
        step: Step,
        bodies: Sequence[str],
        geoms: Sequence[str] | None,
        kind: str,
        friction: float | None,
        substeps: int | None,
        exchanges: int,
        data: Any,
        threads: int | None,
    ) -> None:
        self._mujoco = load_mujoco()
        _check_model_and_step(self._mujoco, model, step)
        for name, names in (("bodies", bodies), ("geoms", geoms)):
            if names is not None and (isinstance(names, str) or not isinstance(names, Sequence)):
                raise TypeError(f"{name} must be a list of names, got {shape_of(names)}")
        if len(bodies) == 0:
            raise ValueError("bodies must have at least one name, got none")
        if len(set(bodies)) < len(bodies):
            raise ValueError(f"bodies must be different, got {list(bodies)}")
        self.substeps = None if substeps is None else check_count("substeps", substeps, 1)
        self.exchanges = check_count("exchanges", exchanges, 1)
        threads = None if threads is None else check_count("threads", threads, 1)
        self.model, self.step = model, step
        self.data = _data_of(self._mujoco, model, data, step.grid.scenes)
        numbers = [body_number(model, name) for name in bodies]
        self._scenes = MujocoScenes(model, self.data, numbers, threads)
        chosen = _chosen_geoms(model, numbers, geoms)
        spacing = step.grid.dx / SAMPLES_PER_CELL
        parts = [[part_of_geom(model, g, kind, friction, spacing) for g in own] for own in chosen]
        self.obstacles = {
            geom_name(model, g): part.obstacle
            for own, made in zip(chosen, parts, strict=True)
            for g, part in zip(own, made, strict=True)
        }
        step.boundaries.extend(self.obstacles.values())
        self.bodies = RigidBodies(step, parts)
        self._scale = _scales(model, numbers)
        self._unscale = torch.where(self._scale > 0, 1 / self._scale, 0.0)
        shape = len(self.data), len(numbers), 6
        self.pending, self._found, self.wrenches = (torch.zeros(shape, dtype=torch.float64) for _ in range(3))
        self._fixed_point = FixedPoint(len(self.data), 6 * len(numbers))

    def advance(self, state: State, n: int = 1, *, seconds: float | None = None) -> State:
        """The state n steps of MuJoCo later; the data are advanced too.

        Args:
            state: the material, which counts impulses from here on.
            n: number of steps of MuJoCo, whose length is `model.opt.timestep`.
            seconds: their duration [s] in place of their number; a multiple of the time step.

        Raises:
            TypeError, ValueError: for a wrong number of steps, or a duration that is no multiple of the time step.
            NotImplementedError: where the state or the step requires grad: gradients do not pass through MuJoCo.
            SimulationError: for wrenches that are not finite, data that MuJoCo reports as unstable, and a material that
                needs more than 100 000 substeps.
        """
        n = check_count("n", n) if seconds is None else self._steps_in(seconds)
        check_state(state)
        _refuse_gradients(self.step, state)
        if state.impulse is None:
            state = self.step.with_impulses(state)
        substeps = self._substeps(state)
        self._scenes.begin()
        poses = self._poses()
        for k in range(n):
            state, poses = self._solve(state, poses, substeps, last=k == n - 1)
        return state

    def reset(self, scenes: Sequence[int] | None = None) -> None:
        """Set the data of scenes, all by default, to the initial state of the model, without pending impulses.

        Replace the material of these scenes too (`State.concatenate`, `Environments.reset`).
        """
        for b in range(len(self.data)) if scenes is None else scenes:
            if not 0 <= check_count("scenes", b) < len(self.data):
                raise ValueError(f"scenes must be from 0 to {len(self.data) - 1}, got {b}")
            self._mujoco.mj_resetData(self.model, self.data[b])
            for values in (self.pending, self._found, self.wrenches):
                values[b] = 0.0

    # ---- one step of MuJoCo

    def _solve(self, state: State, begin: Tensor, substeps: int, last: bool) -> tuple[State, Tensor]:
        """The state and the poses [B, K, 7] one step of MuJoCo later, which is the last one of `advance` or not.

        Impulses here are [B, K, 6], with moments about the centres of mass at the beginning, where wrenches act.
        """
        pending = _moved(self.pending, begin, -1)
        applied = pending if self.exchanges == 1 else pending + self._found
        saved = None if self.exchanges == 1 else self._scenes.states()
        self._fixed_point.begin()
        for k in range(self.exchanges):
            if saved is not None and k > 0:
                self._scenes.restore(saved)
                applied = applied + self._fixed_point.correction().reshape(applied.shape) * self._unscale
            wrenches = (applied / self.model.opt.timestep).numpy()
            self._scenes.step(wrenches, derived=last and k == self.exchanges - 1)
            end = self._poses()
            after = self._step_material(state, begin, end, substeps)
            found = self.bodies.impulses(state, after, begin.to(state.x.device)).cpu()
            _check_finite(found)
            residual = pending + found - applied
            self._fixed_point.observe(*((values * self._scale).flatten(1) for values in (applied, residual)))
        self.pending, self._found = _moved(residual, begin, 1), found
        self.wrenches = found / self.model.opt.timestep
        return after, end

    def _step_material(self, state: State, begin: Tensor, end: Tensor, substeps: int) -> State:
        seconds = self.model.opt.timestep
        self.bodies.move(with_velocities(begin, end, seconds).to(state.x.device), state)
        return rollout(self.step, state, substeps, seconds / substeps)

    def _poses(self) -> Tensor:
        """Centres of mass and orientations of the bodies by the present data [B, K, 7]."""
        return torch.from_numpy(self._scenes.poses())

    # ---- settings

    def _substeps(self, state: State) -> int:
        if self.substeps is not None:
            return self.substeps
        shortest = float(self.step.stable_dt(state).min())
        timestep = self.model.opt.timestep
        if not shortest * MOST_SUBSTEPS > timestep:
            raise SimulationError(
                f"the material needs time steps of {shortest:.3g} s, and MuJoCo takes {timestep} s: step.check(state) "
                "names particles that are in a bad state; otherwise give substeps"
            )
        return max(1, math.ceil(timestep / shortest))

    def _steps_in(self, seconds: float) -> int:
        check_number("seconds", seconds, "not negative and finite", lambda v: 0 <= v < math.inf)
        n = round(seconds / self.model.opt.timestep)
        if abs(n * self.model.opt.timestep - seconds) > 1e-6 * self.model.opt.timestep:
            raise ValueError(f"seconds must be a multiple of the time step {self.model.opt.timestep} s, got {seconds}")
        return n


def _moved(impulses: Tensor, poses: Tensor, sign: int) -> Tensor:
    """Impulses [B, K, 6] with moments about the origin in place of points of poses [B, K, 7], or for a sign of -1 the
    reverse."""
    linear = impulses[..., :3]
    moment = with_moment(poses[..., :3], linear)[..., 3:]
    return torch.cat([linear, impulses[..., 3:] + sign * moment], -1)


def _check_finite(impulses: Tensor) -> None:
    wrong = ~impulses.isfinite().all(2)
    if bool(wrong.any()):
        scene, body = wrong.nonzero()[0].tolist()
        raise SimulationError(
            f"the wrench on body {body} of scene {scene} is not finite: use more substeps; step.check(state) names "
            "the particles"
        )


def _check_model_and_step(mujoco: Any, model: Any, step: Step) -> None:
    if not isinstance(model, mujoco.MjModel):
        raise TypeError(f"model must be a mujoco.MjModel, got {shape_of(model)}")
    if not isinstance(step, Step):
        raise TypeError(f"step must be a Step, got {shape_of(step)}")
    if step.grid.dim != 3:
        raise ValueError(f"step must have a grid of 3 dimensions, got {step.grid.dim}")


def _data_of(mujoco: Any, model: Any, data: Any, scenes: int) -> list[Any]:
    """One MjData for each scene."""
    if data is None:
        return [mujoco.MjData(model) for _ in range(scenes)]
    given = list(data) if isinstance(data, Sequence) else [data]
    for one in given:
        if not isinstance(one, mujoco.MjData):
            raise TypeError(f"data must be a mujoco.MjData or a list of them, got {shape_of(one)}")
        if one.model is not model:
            raise ValueError("data must be of the model, got MjData of another one")
    if len(given) != scenes or len(set(map(id, given))) != scenes:
        raise ValueError(f"data must be one MjData for each of {scenes} scenes, got {len(set(map(id, given)))}")
    return given


def _chosen_geoms(model: Any, bodies: Sequence[int], names: Sequence[str] | None) -> list[list[int]]:
    """Geoms of each body that become obstacles."""
    geoms = [colliding_geoms(model, body) for body in bodies]
    if names is not None:
        known = {geom_name(model, g) for own in geoms for g in own}
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(f"geoms must be colliding geoms of the bodies, {sorted(known)}, got {unknown[0]!r}")
        geoms = [[g for g in own if geom_name(model, g) in names] for own in geoms]
    for body, own in zip(bodies, geoms, strict=True):
        if not own:
            raise ValueError(f"bodies must have a colliding geom each, got {model.body(body).name!r} without one")
    return geoms


def _scales(model: Any, bodies: Sequence[int]) -> Tensor:
    """Weights of residuals [K, 6]: moments by the radius of gyration, and zero for bodies that no impulse moves."""
    rows = []
    for body in bodies:
        mass, inertia = model.body_mass[body], model.body_inertia[body].mean()
        moves = model.body_weldid[body] != 0 and mass > 0 and inertia > 0
        rows.append([1.0] * 3 + [float(np.sqrt(mass / inertia))] * 3 if moves else [0.0] * 6)
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 6)


def _refuse_gradients(step: Step, state: State) -> None:
    if not torch.is_grad_enabled():
        return
    fields = {name: value for name, value in vars(state).items() if isinstance(value, Tensor)} | state.extra
    named = [(f"state.{name}", value) for name, value in fields.items()]
    named += [(f"step.{name}", value) for name, value in (*step.named_parameters(), *step.named_buffers())]
    for name, value in named:
        if value.requires_grad:
            raise NotImplementedError(
                f"{name} requires grad, and gradients do not pass through MuJoCo: detach it, or use torch.no_grad()"
            )
