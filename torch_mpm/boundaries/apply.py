"""What the boundaries of a step do to the nodes, in turn, and the impulses that they take."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..grid.grid import Blocks
from ..ops import contact, contact_impulses, fusible
from ..ops.contact import MAX_OBSTACLES
from ..ops.impulses import impulse_of_nodes
from ..precision import from_half, full_precision
from ..state.state import State
from ..step.clocks import time_like
from . import Obstacle, call_boundary


def after_boundaries(
    blocks: Blocks,
    velocity: Tensor,
    boundaries: Sequence[Any],
    state: State,
    dt: float | Tensor,
    mass: Tensor | None = None,
) -> tuple[Tensor, list[Tensor]]:
    """Node velocities after the boundaries; neighbours in the list that one op can take together.

    Args:
        mass: of the nodes [N] [kg], where their impulses are asked for.

    Returns:
        Velocities [N, D] [m/s], and the impulses on all boundaries in turn, tensors [B, k, D + 1 or 3].
    """
    time = state.time
    if isinstance(time, Tensor) and time.dim() == 0:
        time = time.to(velocity.device)  # a number of a compiled step
    nodes: tuple[Tensor, Tensor | None] | None = None
    impulses: list[Tensor] = []
    for together, group in _neighbours(boundaries, time):
        if together:
            if mass is not None:
                impulses.append(contact_impulses(blocks, velocity, mass, group, time))
            velocity = contact(blocks, velocity, group, time)
            continue
        if nodes is None:
            scene = None if state.scene is None else blocks.node_scene()
            nodes = (blocks.node_positions(state.x.dtype), scene)
        before, boundary = velocity, group[0]
        own = isinstance(boundary, Obstacle)
        if isinstance(boundary, Obstacle):
            boundary.check_scenes(blocks.grid.dim, blocks.grid.scenes)
        now = time if own else time_like(time, velocity)
        with full_precision(before) if own else contextlib.nullcontext():
            velocity = from_half(call_boundary(boundary, before, *nodes, now, dt), nodes[0])
        if mass is not None:
            # Where there is no mass a boundary of the user's may give any velocity.
            momentum = mass[:, None] * torch.where(mass[:, None] != 0, before - velocity, 0)
            impulses.append(impulse_of_nodes(blocks, momentum)[:, None])
    return velocity, impulses


def _neighbours(boundaries: Sequence[Any], time: float | Tensor) -> list[tuple[bool, list[Any]]]:
    """Runs of boundaries that `contact` takes in one op, or one that it does not; `itertools.groupby` can't be
    compiled."""
    runs: list[tuple[bool, list[Any]]] = []
    for boundary in boundaries:
        together = fusible(boundary, time)
        if not (together and runs and runs[-1][0] and len(runs[-1][1]) < MAX_OBSTACLES):
            runs.append((together, []))
        runs[-1][1].append(boundary)
    return runs
