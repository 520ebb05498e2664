"""Materials that an implicit step integrates explicitly, and the remaining nodes of its solve.

The stress of explicit materials at the start of a step acts on the momentum of the nodes, to which they add their mass.
The solve includes the particles of the other materials, their active blocks, and the nodes with a weight for one of
them; all other nodes move as in an explicit step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import check_count, shape_of
from ..grid.grid import Blocks, Grid
from ..laws.material import Material
from ..laws.mixture import Mixture
from ..ops import scatter


def checked_materials(explicit: Any) -> tuple[int, ...]:
    """Numbers of materials in order.

    Raises:
        TypeError, ValueError: unless it is a list of distinct numbers.
    """
    if isinstance(explicit, str) or not isinstance(explicit, Sequence):
        raise TypeError(f"explicit must be a list of materials, numbers of laws of a Mixture, got {shape_of(explicit)}")
    materials = sorted(int(check_count("a material in explicit", k)) for k in explicit)
    if len(set(materials)) < len(materials):
        raise ValueError(f"explicit must name each material once, got {list(explicit)}")
    return tuple(materials)


def solved_materials(law: Material, explicit: Sequence[int]) -> list[int]:
    """The materials of a law that are not explicit.

    Raises:
        ValueError: for a law that is not a Mixture, that lacks an explicit material, or that has no other.
    """
    if not isinstance(law, Mixture):
        raise ValueError(f"explicit names laws of a Mixture, got {list(explicit)} for a {type(law).__name__}")
    count = len(law.laws)
    if explicit[-1] >= count:
        raise ValueError(f"explicit must be among the laws 0 .. {count - 1} of the Mixture, got {list(explicit)}")
    if len(explicit) == count:
        raise ValueError(
            f"explicit names all {count} laws of the Mixture, which leaves none to solve for: use integrator='explicit'"
        )
    return [k for k in range(count) if k not in explicit]


@dataclasses.dataclass
class SolvedNodes:
    """Nodes of the solve, among those of a step.

    Attributes:
        blocks: active blocks of the particles of the solve, in a separate pool.
        rows: nodes with a weight for one of these particles, in node tensors of the solve, int64 [K].
        rows_in_step: the same nodes in node tensors of the step, int64 [K].
        chosen: mask of these nodes among those of the step, bool [N].
    """

    blocks: Blocks
    rows: Tensor
    rows_in_step: Tensor
    chosen: Tensor

    def taken(self, values: Tensor) -> Tensor:
        """Values of the nodes of the step as a node tensor of the solve, zero for nodes outside the solve."""
        result = values.new_zeros(self.blocks.node_count, *values.shape[1:])
        return result.index_copy(0, self.rows, values.index_select(0, self.rows_in_step))

    def placed(self, solution: Tensor, others: Tensor) -> Tensor:
        """Node tensor of the step: the solution, and the values of the other nodes."""
        return others.index_copy(0, self.rows_in_step, solution.index_select(0, self.rows))


def solved_nodes(blocks: Blocks, particles: Any) -> SolvedNodes:
    """Nodes of a part of the particles of a step, whose active blocks are given."""
    step_grid = blocks.grid
    grid = Grid(
        *(step_grid.dx, step_grid.lower, step_grid.upper, step_grid.scenes, step_grid.kernel),
        deterministic=step_grid.deterministic,
    )
    own = grid.activate(particles.x, particles.scene)
    slots = torch.where(own.block >= 0, blocks.table[own.block.clamp_min(0).long()], -1)
    weights = scatter(own, particles.x.detach(), particles.mass.detach()[:, None])[:, 0]
    in_block = torch.arange(grid.nodes_per_block, device=slots.device)
    rows = ((weights > 0).view(len(slots), -1) & (slots >= 0)[:, None]).flatten().nonzero().squeeze(1)
    rows_in_step = (slots[:, None].long() * grid.nodes_per_block + in_block).flatten().index_select(0, rows)
    chosen = torch.zeros(blocks.node_count, dtype=torch.bool, device=slots.device).index_fill(0, rows_in_step, True)
    return SolvedNodes(own, rows, rows_in_step, chosen)
