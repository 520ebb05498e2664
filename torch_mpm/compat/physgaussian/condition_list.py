"""Conditions of PhysGaussian's simulator and of its descendants on nodes and particles, and when they act."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...boundaries import Obstacle
from ...step.particle_operations import Hold, Push, Timed
from ..gradients import Numbers, check_fixed, vector
from ..node_conditions import (
    FreezeOutside,
    NodeMask,
    StrictRegion,
    moving_cuboid,
    outer_planes,
    stopping_plane,
    strict_cuboid,
    strict_plane,
    surface_margin,
)
from ..selections import Rotation, chosen, in_box, in_cylinder
from .particles import Acceleration, release_times
from .surfaces import Cut

PADDING = 3
"""Nodes at each face of the domain on which a bounding box acts."""
RESET_STEPS = 15
"""Number of steps for which a cuboid with `reset` holds all nodes after its end."""
FOREVER = 999.0
AT_REST = (0.0, 0.0, 0.0)


class Nodes(NamedTuple):
    """Sizes of a grid on which conditions are created."""

    dx: float
    cells: tuple[int, int, int]
    like: Tensor
    """A tensor in the dtype and on the device of the particles."""
    strict: bool = False
    """Whether nodes are compared with faces in float32, as in the other simulators."""

    @property
    def margin(self) -> float:
        """Displacement [m] of surfaces; see `surface_margin`."""
        return surface_margin(self.like.dtype, self.dx * max(self.cells))


class ConditionList:
    """Conditions in the order in which they were added; those on nodes are created once the grid is known.

    Methods without leading underscore are those of both `MPM_Simulator_WARP` and `MPMWARPDiff`.
    """

    def _clear_conditions(self) -> None:
        self._on_nodes: list[Callable[[Nodes], list[Any]]] = []
        self._pushes: list[Any] = []
        self._holds: list[Any] = []
        self._created: tuple[Nodes, list[Any]] | None = None

    def _before_change(self) -> None:
        """Compute the pending substeps, before a condition is added."""
        raise NotImplementedError

    # ---- on nodes

    def add_surface_collider(
        self,
        point: Numbers,
        normal: Numbers,
        surface: str = "sticky",
        friction: float = 0.0,
        start_time: float = 0.0,
        end_time: float = FOREVER,
    ) -> None:
        """Stop the nodes behind a plane, for any `surface`, as the original simulator does.

        A surface that slips, separates or has friction is `add_boundary(torch_mpm.Plane(...))`. "cut" is specific to
        that simulator, with fixed heights.
        """
        check_fixed("it selects nodes", point=point, normal=normal, start_time=start_time, end_time=end_time)
        check_fixed("it has no effect", friction=friction)
        if surface == "sticky" and friction != 0:
            raise ValueError(f"friction must be 0 on sticky surfaces, got {friction}")
        if surface not in ("sticky", "cut"):
            warnings.warn(
                f"a surface collider stops the nodes behind it, as in PhysGaussian, also with surface={surface!r}: for "
                "one that slips or separates call add_boundary(torch_mpm.Plane(point, normal, kind, friction))",
                stacklevel=2,
            )
        stopping_plane(point, normal, 0.0, start_time, end_time)  # Checks the normal.

        def create(nodes: Nodes) -> list[Any]:
            if surface == "cut":
                return [Cut(point, normal, nodes.margin, start_time, end_time)]
            if nodes.strict:
                return [strict_plane(point, normal, nodes.dx, start_time, end_time, nodes.like)]
            return [stopping_plane(point, normal, nodes.margin, start_time, end_time)]

        self._on_grid(create)

    def set_velocity_on_cuboid(
        self,
        point: Numbers,
        size: Numbers,
        velocity: Numbers,
        start_time: float = 0.0,
        end_time: float = FOREVER,
        reset: int = 0,
    ) -> None:
        """Velocity of the nodes in a box of half edges `size`, which moves with it from `start_time` on.

        With `reset` 1 all nodes of the grid are at rest before `start_time`, and for 15 steps after `end_time`.
        """
        check_fixed("it selects nodes", point=point, size=size, start_time=start_time, end_time=end_time)
        vector("velocity", velocity, torch.empty(0))

        def create(nodes: Nodes) -> list[Any]:
            moving = vector("velocity", velocity, nodes.like)
            if nodes.strict:
                box: Any = strict_cuboid(point, size, _as_tensor(moving, nodes.like), nodes.dx, start_time, end_time)
            else:
                box = moving_cuboid(point, size, moving, nodes.margin, start_time, end_time)
            return [box, FreezeOutside(start_time, end_time, RESET_STEPS)] if reset == 1 else [box]

        self._on_grid(create)

    def add_bounding_box(self, start_time: float = 0.0, end_time: float = FOREVER) -> None:
        """Close the domain: no node within 3 of a face moves outwards."""
        check_fixed("it selects nodes", start_time=start_time, end_time=end_time)
        self._on_grid(lambda nodes: outer_planes(nodes.dx, nodes.cells, PADDING, start_time, end_time))

    def enforce_grid_velocity_by_mask(self, selection_mask: Tensor) -> None:
        """Hold nodes at rest.

        Args:
            selection_mask: integers or bool [n, n, n], one for each node of the grid; not zero where it is held.

        Raises:
            TypeError, ValueError: for another shape or dtype.
        """
        mask = NodeMask.checked(selection_mask)
        self._on_grid(lambda nodes: [NodeMask(mask.to(nodes.like.device), nodes.dx, nodes.cells)])

    def add_boundary(self, boundary: Any) -> None:
        """Append an object with the interface of `torch_mpm.boundaries`."""
        self._on_grid(lambda nodes: [boundary])

    def _on_grid(self, create: Callable[[Nodes], list[Any]]) -> None:
        self._before_change()
        self._on_nodes.append(create)
        self._created = None

    def _boundaries(self, nodes: Nodes) -> list[Any]:
        """Conditions on the nodes of a grid, in their order."""
        if self._created is None or self._created[0][:2] != nodes[:2]:
            self._created = nodes, [made for create in self._on_nodes for made in create(nodes)]
        return self._created[1]

    # ---- on particles

    def _impulse(
        self, x: Tensor, force: Numbers, dt: float, point: Numbers, size: Numbers, num_dt: int, start_time: float
    ) -> None:
        check_fixed("it selects particles", dt=dt, point=point, size=size, num_dt=num_dt, start_time=start_time)
        self._push(Push(vector("force", force, x), start_time, start_time + dt * num_dt, in_box(x, point, size)))

    def _acceleration(self, x: Tensor, force: Numbers, mask: Tensor, start_time: float, end_time: float) -> None:
        check_fixed("it selects particles", start_time=start_time, end_time=end_time)
        given = _as_tensor(vector("force", force, x), x)
        self._push(Acceleration(given, start_time, end_time, chosen("particle_mask", mask, x)))

    def _translation(
        self, x: Tensor, point: Numbers, size: Numbers, velocity: Numbers, start_time: float, end_time: float
    ) -> None:
        check_fixed("it selects particles", point=point, size=size, start_time=start_time, end_time=end_time)
        self._hold(Hold(vector("velocity", velocity, x), start_time, end_time, in_box(x, point, size)))

    def _translation_of(
        self, name: str, mask: Tensor, x: Tensor, velocity: Numbers, start_time: float, end_time: float
    ) -> None:
        check_fixed("it selects particles", start_time=start_time, end_time=end_time)
        self._hold(Hold(vector("velocity", velocity, x), start_time, end_time, chosen(name, mask, x)))

    def _rotation(
        self,
        x: Tensor,
        point: Numbers,
        normal: Numbers,
        half_height_and_radius: Numbers,
        scales: tuple[Any, Any],
        start_time: float,
        end_time: float,
    ) -> None:
        selecting = {"half_height_and_radius": half_height_and_radius, "start_time": start_time, "end_time": end_time}
        check_fixed("it selects particles", **selecting)
        point, normal = vector("point", point, x), vector("normal", normal, x)
        inside = in_cylinder(x, point, normal, half_height_and_radius)
        self._hold(Rotation(point, normal, *scales, start_time, end_time, inside))

    def _release(
        self,
        x: Tensor,
        normal: Numbers,
        places: tuple[float, float],
        layers: tuple[int, int],
        start_time: float,
        end_time: float,
    ) -> None:
        """Sequential release: `places` are start and end [m], `layers` those given and those used."""
        times = {"start_time": start_time, "end_time": end_time, "num_layers": layers[0]}
        start, end = places
        check_fixed("it selects particles", normal=normal, start_position=start, end_position=end, **times)
        self._hold(Hold(AT_REST, start_time, release_times(x, normal, start, end, end_time, int(layers[1]))))

    def _push(self, operation: Any) -> None:
        self._before_change()
        self._pushes.append(operation)

    def _hold(self, operation: Any) -> None:
        self._before_change()
        self._holds.append(operation)


def _as_tensor(value: Any, like: Tensor) -> Tensor:
    """Numbers as a tensor in the dtype and on the device of another one."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device)


def acts(condition: Any, first: float, last: float, dt: float) -> bool:
    """Whether a condition may be active at a time from `first` to `last`, with half a step of dt for rounding."""
    first, last = first - dt / 2, last + dt / 2
    start, end = _times(condition)
    if isinstance(condition, FreezeOutside):
        return first < start or (last >= end and first < end + RESET_STEPS * dt)
    return start <= last and first < end


def changes(conditions: Iterable[Any], first: float, steps: int, dt: float) -> list[int]:
    """Numbers of steps from `first` on at which a condition that acts by torch operations may begin or end, in order,
    with `steps` as the last. Obstacles begin and end within a rollout in one op.
    """
    found = {steps}
    for condition in conditions:
        if isinstance(condition, Obstacle):
            continue
        start, end = _times(condition)
        times = [(start, -0.5), (end, 0.5)]
        if isinstance(condition, FreezeOutside):
            times = [(start, 0.5), (end, -0.5), (end + RESET_STEPS * dt, 0.5)]
        for time, shift in times:
            k = (time - first) / dt + shift
            if 0 < k < steps:
                found.add(math.ceil(k))
    return sorted(found)


def _times(condition: Any) -> tuple[float, float]:
    """First and last time of a condition [s]; the latest where particles have their own; all times where unknown."""
    if not isinstance(condition, (Obstacle, Timed, Cut, FreezeOutside, StrictRegion)):
        return -math.inf, math.inf
    start, end = condition.start, condition.end
    if isinstance(start, Tensor):
        start = float(start.min()) if start.numel() else math.inf
    if isinstance(end, Tensor):
        end = float(end.max()) if end.numel() else -math.inf
    return float(start), float(end)
