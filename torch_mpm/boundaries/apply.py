"""What the boundaries of a step do to the nodes, in turn, and the impulses that they take."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..grid.grid import Blocks, Grid
from ..ops import contact, contact_impulses
from ..ops.contact import MAX_OBSTACLES, is_of_kernel, is_solid
from ..ops.impulses import impulse_of_nodes
from ..ops.precision import from_half, full_precision
from ..state.state import State
from ..step.clocks import time_like
from . import Obstacle, Walls, call_boundary
from .solid import SolidNodes, after_contact, moved_to_surface

FUSED, SOLID, OTHER = "fused", "solid", "other"
"""Runs of boundaries: obstacles in one op, obstacles in torch operations, one of another kind."""


def after_boundaries(
    blocks: Blocks,
    velocity: Tensor,
    mass: Tensor,
    boundaries: Sequence[Any],
    state: State,
    dt: float | Tensor,
    walls: Walls | None = None,
    *,
    impulses: bool = False,
) -> tuple[Tensor, list[Tensor]]:
    """Node velocities after the boundaries. Obstacles that are neighbours in the list act as one solid.

    Args:
        mass: of the nodes [N] [kg]. Obstacles leave nodes without mass alone.
        walls: of the domain, which the grid update has applied.
        impulses: whether to compute the impulses on the boundaries.

    Returns:
        Velocities [N, D] [m/s], and the impulses on all boundaries in turn, tensors [B, k, D + 1 or 3].
    """
    time = state.time
    if isinstance(time, Tensor) and time.dim() == 0:
        time = time.to(velocity.device)  # a number of a compiled step
    nodes: tuple[Tensor, Tensor | None] | None = None
    found: list[Tensor] = []
    for kind, group in _neighbours(boundaries, time):
        if kind == FUSED:
            if impulses:
                found.append(contact_impulses(blocks, velocity, mass, group, time, walls))
            velocity = contact(blocks, velocity, group, time, walls, mass)
            continue
        if nodes is None:
            scene = None if state.scene is None else blocks.node_scene()
            nodes = (blocks.node_positions(state.x.dtype), scene)
        before = velocity
        if kind == SOLID:
            for obstacle in group:
                obstacle.check_scenes(blocks.grid.dim, blocks.grid.scenes)
            velocity, changes = _after_solid(blocks, before, mass, group, nodes, time, walls)
        else:
            velocity = from_half(call_boundary(group[0], before, *nodes, time_like(time, velocity), dt), nodes[0])
            changes = [velocity - before]
        if impulses:
            # Where there is no mass a boundary of the user's may give any velocity.
            momenta = [mass[:, None] * torch.where(mass[:, None] != 0, -change, 0) for change in changes]
            found.append(torch.stack([impulse_of_nodes(blocks, momentum) for momentum in momenta], 1))
    return velocity, found


def project(boundaries: Sequence[Any], walls: Walls | None, grid: Grid, state: State) -> tuple[Tensor, Tensor]:
    """Positions of particles [P, D] [m], those inside obstacles moved to the nearest point of free space, and which of
    them have moved, bool [P]."""
    obstacles = [boundary for boundary in boundaries if is_solid(boundary)]
    x = state.x.detach()
    if not obstacles or len(x) == 0:
        return x, torch.zeros_like(x[:, 0], dtype=torch.bool)
    faces = () if walls is None else walls.faces(grid)
    with full_precision(x):
        return moved_to_surface(
            SolidNodes(obstacles, [None] * len(obstacles), x, state.scene, state.time, grid.dx, faces)
        )


def _after_solid(
    blocks: Blocks,
    velocity: Tensor,
    mass: Tensor,
    obstacles: list[Obstacle],
    nodes: tuple[Tensor, Tensor | None],
    time: float | Tensor,
    walls: Walls | None,
) -> tuple[Tensor, list[Tensor]]:
    """Node velocities after obstacles in torch operations, and the changes by each."""
    positions, scene = nodes
    active = blocks.active_nodes() & (mass != 0)
    faces = () if walls is None else walls.faces(blocks.grid)
    with full_precision(velocity):
        solid = SolidNodes(obstacles, [active] * len(obstacles), positions, scene, time, blocks.grid.dx, faces)
        return after_contact(from_half(velocity, positions), solid)


def _neighbours(boundaries: Sequence[Any], time: float | Tensor) -> list[tuple[str, list[Any]]]:
    """Runs of obstacles that act as one solid, in one op where that takes them all, and single other boundaries;
    `itertools.groupby` can't be compiled."""
    runs: list[tuple[str, list[Any]]] = []
    for boundary in boundaries:
        kind = SOLID if is_solid(boundary) else OTHER
        most = MAX_OBSTACLES
        if kind == OTHER or not (runs and runs[-1][0] == SOLID and len(runs[-1][1]) < most):
            runs.append((kind, []))
        runs[-1][1].append(boundary)
    return [
        (FUSED if kind == SOLID and all([is_of_kernel(boundary, time) for boundary in run]) else kind, run)
        for kind, run in runs
    ]
