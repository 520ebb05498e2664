"""The boundary conditions of MPM-PyTorch."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from ...boundaries import Plane
from ...laws.parameters import TensorModule
from ...state.state import State
from ...step.particle_operations import Hold, Push, Timed
from ..gradients import Numbers, check_fixed, vector
from ..keys import check_keys, checked_list
from ..node_conditions import stopping_plane, surface_margin
from ..selections import Rotation, in_box, in_cylinder
from .mpm_solver import RESET_STEPS, MPMSolver

CUBOID_END, FOREVER = 1e3, 999.0


def set_boundary_conditions(model: MPMSolver, bc_params: Iterable[Mapping[str, Any]] | None) -> None:
    """Add boundary conditions to a solver: a list of mappings, each with a `type` and the arguments of its function.

    Types are cuboid, particle_impulse, enforce_particle_translation, enforce_particle_velocity_rotation,
    surface_collider and sdf_collider.

    Raises:
        TypeError: for an unknown type, or a missing argument.
        ValueError: for an unknown key, or a gradient that an argument cannot have.
    """
    for condition in checked_list("bc_params", bc_params or ()):
        given = dict(condition)
        kind = given.pop("type", None)
        if kind not in CONDITIONS:
            raise TypeError(f"type of a boundary condition must be one of {sorted(CONDITIONS)}, got {kind!r}")
        keys = list(inspect.signature(CONDITIONS[kind]).parameters)[1:]
        check_keys(f"a boundary condition {kind}", given, [key for key in keys if key != "dt"])
        if kind == "particle_impulse":
            given["dt"] = model.dt
        if kind == "cuboid":
            given.setdefault("end_time", CUBOID_END)
        CONDITIONS[kind](model, **given)


def set_velocity_on_cuboid(
    model: MPMSolver,
    point: Numbers,
    size: Numbers,
    velocity: Numbers,
    start_time: float = 0.0,
    end_time: float = FOREVER,
    reset: bool = False,
) -> None:
    """Velocity of the nodes in a box at rest of half edges `size`, while start ≤ time ≤ end.

    With `reset` they are at rest before, and for 15 steps after that.
    """
    check_fixed("it selects nodes", point=point, size=size, start_time=start_time, end_time=end_time)
    velocity = vector("velocity", velocity, model.init_pos)
    model.post_grid_process.append(NodeVelocity(point, size, velocity, start_time, end_time, reset))


def add_surface_collider(
    model: MPMSolver,
    point: Numbers,
    normal: Numbers,
    surface: str = "sticky",
    friction: float = 0.0,
    start_time: float = 0.0,
    end_time: float = FOREVER,
) -> None:
    """Nodes behind a plane stop ("sticky"), lose their normal velocity ("slip") or reverse it ("collide").

    `friction` is not used, as in MPM-PyTorch.
    """
    if surface not in ("sticky", "slip", "collide"):
        raise TypeError(f"surface must be 'sticky', 'slip' or 'collide', got {surface!r}")
    check_fixed("it selects nodes", point=point, normal=normal, start_time=start_time, end_time=end_time)
    check_fixed("it has no effect", friction=friction)
    margin = surface_margin(model.init_pos.dtype, 1.0)
    kind = "sticky" if surface == "sticky" else "slip"
    plane = stopping_plane(point, normal, margin, start_time, end_time, kind)
    model.post_grid_process.append(Reflection(plane) if surface == "collide" else plane)


def add_sdf_collider(
    model: MPMSolver, bound: float, dim: int, start_time: float = 0.0, end_time: float = FOREVER
) -> None:
    """Before P2G, move particles on axis `dim` between `bound` and 1 − `bound` [m], and add the displacement over dt to
    their velocity.
    """
    if dim not in (0, 1, 2):
        raise ValueError(f"dim must be 0, 1 or 2, got {dim}")
    check_fixed("it is a number of the condition", bound=bound, start_time=start_time, end_time=end_time)
    model.pre_particle_process.append(Projection(model, bound, dim, start_time, end_time))


def add_impulse_on_particles(
    model: MPMSolver,
    force: Numbers,
    dt: float,
    point: Numbers = (1, 1, 1),
    size: Numbers = (1, 1, 1),
    num_dt: int = 1,
    start_time: float = 0.0,
) -> None:
    """A force [N] on each particle that starts in a box of half edges `size`, for num_dt steps."""
    check_fixed("it selects particles", dt=dt, point=point, size=size, num_dt=num_dt, start_time=start_time)
    inside = in_box(model.init_pos, point, size)
    given, share = vector("force", force, model.init_pos), dt / model.dt  # v changes by `dt` of the argument.
    scaled = given * share if isinstance(given, Tensor) else [f * share for f in given]
    model.pre_particle_process.append(Push(scaled, start_time, start_time + num_dt * model.dt, inside))


def enforce_particle_velocity_translation(
    model: MPMSolver, point: Numbers, size: Numbers, velocity: Numbers, start_time: float, end_time: float
) -> None:
    """Velocity of the particles that start in a box of half edges `size`."""
    check_fixed("it selects particles", point=point, size=size, start_time=start_time, end_time=end_time)
    inside = in_box(model.init_pos, point, size)
    moving = vector("velocity", velocity, model.init_pos)
    model.pre_particle_process.append(Hold(moving, start_time, end_time, inside))


def enforce_particle_velocity_rotation(
    model: MPMSolver,
    point: Numbers,
    normal: Numbers,
    half_height_and_radius: Numbers,
    rotation_scale: float,
    translation_scale: float,
    start_time: float,
    end_time: float,
) -> None:
    """Rotate the particles that start in a cylinder about its axis, at −rotation_scale [rad/s] about `normal`, and move
    them along it at translation_scale [m/s]. (The original function of MPM-PyTorch raises an error when it is called.)
    """
    selecting = {"half_height_and_radius": half_height_and_radius, "start_time": start_time, "end_time": end_time}
    check_fixed("it selects particles", **selecting)
    point, normal = vector("point", point, model.init_pos), vector("normal", normal, model.init_pos)
    inside = in_cylinder(model.init_pos, point, normal, half_height_and_radius)
    turning = Rotation(point, normal, rotation_scale, translation_scale, start_time, end_time, inside)
    model.pre_particle_process.append(turning)


CONDITIONS: dict[str, Callable[..., None]] = {
    "cuboid": set_velocity_on_cuboid,
    "enforce_particle_translation": enforce_particle_velocity_translation,
    "enforce_particle_velocity_rotation": enforce_particle_velocity_rotation,
    "particle_impulse": add_impulse_on_particles,
    "sdf_collider": add_sdf_collider,
    "surface_collider": add_surface_collider,
}


class Projection(Timed):
    """Condition of `add_sdf_collider`; the solver moves particles by its `displacement` at the end of the step."""

    def __init__(self, solver: MPMSolver, bound: float, dim: int, start: float, end: float) -> None:
        super().__init__(start, end)
        self.solver, self.bound, self.dim = solver, bound, dim

    def forward(self, state: State, dt: float | Tensor) -> State:
        if not self.acting(state):
            return state
        before = self.solver.displacement
        x = state.x if before is None else state.x + before
        axis = torch.arange(3, device=x.device) == self.dim
        shift = torch.where(axis, x.clamp(self.bound, 1 - self.bound) - x, 0)
        self.solver.displacement = shift if before is None else before + shift
        return state.replace(v=state.v + shift / dt)


class NodeVelocity(TensorModule):
    """Condition of `set_velocity_on_cuboid`."""

    def __init__(self, point: Numbers, size: Numbers, velocity: Numbers, start: float, end: float, reset: bool) -> None:
        self.point, self.size = ([float(a) for a in v] for v in (point, size))
        self.velocity = velocity
        self.start, self.end, self.reset = start, end, reset

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        acts = self.start <= time <= self.end
        if not acts and not (self.reset and time < self.end + RESET_STEPS * dt):
            return velocity
        margin = surface_margin(velocity.dtype, 1.0)
        inside = torch.ones_like(positions[:, 0], dtype=torch.bool)
        for x, centre, half in zip(positions.unbind(1), self.point, self.size, strict=True):
            inside = inside & ((x - centre).abs() < half - margin)
        given = self.velocity if acts else (0.0, 0.0, 0.0)
        columns = zip(velocity.unbind(1), given, strict=True)
        return torch.stack([torch.where(inside, new, old) for old, new in columns], 1)


class Reflection(nn.Module):
    """Reverses the normal velocity of the nodes behind a "slip" plane, which has removed half of that change."""

    def __init__(self, plane: Plane) -> None:
        super().__init__()
        self.plane = plane

    def forward(self, velocity: Tensor, positions: Tensor, scene: Tensor | None, time: float, dt: float) -> Tensor:
        return 2 * self.plane(velocity, positions, scene, time, dt) - velocity
