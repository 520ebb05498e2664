"""Lattice of nodes and its active blocks, as arguments of the ops."""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..errors import default_dtype, shape_of

PADDING = 3
"""Nodes beyond `lower` and `upper`, so that a particle on the boundary has its support (csrc/grid/geometry.h)."""
BLOCK_WIDTH = 4

PackedLattice = tuple[list[float], list[int]]
PackedTopology = tuple[list[Tensor], list[float], list[int]]
"""Trailing arguments of an op: `Tensor[] topology, float[] lattice, int[] layout` (csrc/grid/topology.op.h)."""


class Status(enum.IntEnum):
    """Columns of the status of activations, int32 [1 + B, 8]: row 0 is that of all scenes (csrc/grid/status.h)."""

    BLOCKS_WANTED = 0
    OUTSIDE_COUNT = 1
    OUTSIDE_FIRST = 2
    NON_FINITE_COUNT = 3
    NON_FINITE_FIRST = 4
    ACTIVATIONS = 5
    PROBLEM_ACTIVATION = 6
    BLOCKS_NOW = 7


class SceneStatus(enum.IntEnum):
    """Columns that have another meaning in the rows of scenes."""

    OUTSIDE_ID = 0
    NON_FINITE_ID = 7


COUNTS_OF_PROBLEMS = (Status.OUTSIDE_COUNT, Status.NON_FINITE_COUNT)
FIRST_PROBLEMS = (Status.OUTSIDE_FIRST, Status.NON_FINITE_FIRST, Status.PROBLEM_ACTIVATION)
"""Columns that are -1 where there is no problem."""


class Lattice:
    """Nodes at `lower + (i - PADDING) dx` along each axis, in blocks of 4^D: the part of a `Grid` that the ops need.

    Args:
        dx: node distance [m].
        lower: lower corner of the domain [m], D numbers.
        blocks: number of blocks along each axis.
        order: order of the B-spline, 2 or 3.
        deterministic: whether sums over particles are bit-identical from run to run on CUDA too.
    """

    def __init__(
        self, dx: float, lower: Sequence[float], blocks: Sequence[int], order: int, deterministic: bool
    ) -> None:
        self.dx, self.lower, self.blocks = dx, tuple(lower), tuple(blocks)
        self.order, self.deterministic = order, deterministic
        self.dim = len(self.lower)
        self.nodes_per_block = BLOCK_WIDTH**self.dim
        self.packed: PackedLattice = [dx, *self.lower], [order, int(deterministic), *self.blocks]

    @property
    def inverse_inertia(self) -> float:
        """D⁻¹ = 4/dx² (quadratic) or 3/dx² (cubic) [1/m²] of the APIC affine field (Jiang et al. 2015)."""
        return (4.0 if self.order == 2 else 3.0) / self.dx**2


@dataclasses.dataclass(eq=False)
class Topology:
    """Active blocks of a lattice, and the particles in each.

    A node tensor has N = max_blocks * 4^D rows; rows of unused blocks stay zero.

    Attributes:
        grid: the lattice.
        table: slot of every block of every scene, int32 [B * blocks], -1 where inactive.
        block: table index of every slot, int32 [max_blocks], -1 where unused.
        offsets, index: int32; particles `index[offsets[s]:offsets[s + 1]]` have their base node in the block of slot s.
        schedule: order of work of the kernels.
        scene: scene of each particle, int32 [P], or None for one scene.
    """

    grid: Lattice
    table: Tensor
    block: Tensor
    offsets: Tensor
    index: Tensor
    schedule: Tensor
    scene: Tensor | None

    def __post_init__(self) -> None:
        tensors = [self.table, self.block, self.offsets, self.index, self.schedule]
        self.packed: PackedTopology = (tensors if self.scene is None else [*tensors, self.scene], *self.grid.packed)

    @classmethod
    def unpack(cls, topology: Sequence[Tensor], lattice: Sequence[float], layout: Sequence[int]) -> Topology:
        """Inverse of `packed`.

        Raises:
            ValueError: for lists of a wrong length.
        """
        if len(topology) not in (5, 6):
            raise ValueError(f"topology must have 5 tensors and perhaps scene, got {len(topology)}")
        dim = len(lattice) - 1
        if dim < 1 or len(layout) != 2 + dim or min(layout[2:]) < 1:
            raise ValueError(
                "lattice must be [dx, *lower], and layout [order, deterministic, *blocks] with positive blocks, "
                f"got {list(lattice)} and {list(layout)}"
            )
        grid = Lattice(lattice[0], lattice[1:], layout[2:], layout[0], bool(layout[1]))
        table, block, offsets, index, schedule, *scene = topology
        return Topology(grid, table, block, offsets, index, schedule, scene[0] if scene else None)

    @property
    def scenes(self) -> int:
        """Number of scenes B."""
        if self.table.dim() != 1:
            raise ValueError(f"table must have 1 dimension, got shape {shape_of(self.table)}")
        return self.table.shape[0] // math.prod(self.grid.blocks)

    @property
    def node_count(self) -> int:
        """Rows N of a node tensor."""
        if self.block.dim() != 1:
            raise ValueError(f"block must have 1 dimension, got shape {shape_of(self.block)}")
        return self.block.shape[0] * self.grid.nodes_per_block

    def particle_scene(self) -> Tensor | None:
        """`scene` clamped to valid ids. Particles of unknown scenes are not transferred, so any id will do."""
        return None if self.scene is None else self.scene.clamp(0, self.scenes - 1)

    def transferred(self) -> Tensor:
        """Whether each particle is transferred, bool [P]: none of unknown scenes, outside the grid or not finite."""
        first = torch.arange(self.index.shape[0], device=self.index.device) < self.offsets[-1]
        return torch.zeros_like(first).scatter(0, self.index.long(), first)

    def active_nodes(self) -> Tensor:
        """Whether node rows belong to an active block, bool [N]."""
        return (self.block >= 0).repeat_interleave(self.grid.nodes_per_block)

    def block_scene(self) -> Tensor:
        """Scene of each slot, int32 [max_blocks]; -1 for unused ones."""
        return torch.where(self.block >= 0, self.block // math.prod(self.grid.blocks), -1)

    def node_scene(self) -> Tensor:
        """Scene of each node, int32 [N]; -1 for unused rows."""
        return self.block_scene().repeat_interleave(self.grid.nodes_per_block)

    def node_indices(self) -> Tensor:
        """Lattice indices of each node, int64 [N, D]; those of block 0 for unused rows."""
        grid = self.grid
        corner = unravel(self.block.clamp_min(0).long(), grid.blocks) * BLOCK_WIDTH
        inside = torch.arange(grid.nodes_per_block, device=corner.device)
        offset = unravel(inside, (BLOCK_WIDTH,) * grid.dim)
        return (corner[:, None] + offset).reshape(-1, grid.dim)

    def rows_at(self, node: Tensor, scene: Tensor | None) -> Tensor:
        """Rows of lattice nodes.

        Args:
            node: lattice indices, int64 [..., D].
            scene: int32 or int64, with the shape of the first axes of `node`; None for the first scene.

        Returns:
            int64 [...], -1 where no block is active.
        """
        shape = node.shape[:-1]
        index = torch.zeros(shape, dtype=torch.int64, device=node.device)
        if scene is not None:
            index = index + scene.reshape(*scene.shape, *[1] * (len(shape) - scene.dim()))
        local, inside = torch.zeros_like(index), torch.ones_like(index, dtype=torch.bool)
        for axis, count in enumerate(self.grid.blocks):
            at = node[..., axis]
            inside = inside & (at >= 0) & (at < count * BLOCK_WIDTH)
            at = at.clamp(0, count * BLOCK_WIDTH - 1)
            index, local = index * count + at // BLOCK_WIDTH, local * BLOCK_WIDTH + at % BLOCK_WIDTH
        slot = self.table[index].long()
        return torch.where(inside & (slot >= 0), slot * self.grid.nodes_per_block + local, -1)

    def node_positions(self, dtype: torch.dtype | None = None) -> Tensor:
        """Position of each node [m], [N, D]."""
        columns = (self.node_indices() - PADDING).double().unbind(1)
        positions = [a + column * self.grid.dx for a, column in zip(self.grid.lower, columns, strict=True)]
        return torch.stack(positions, 1).to(dtype or default_dtype())

    def to_dense(self, nodes: Tensor) -> Tensor:
        """Node rows [N, K] as a dense tensor [B, X, Y, (Z), K] of the lattice, zero where inactive; differentiable."""
        grid, scenes = self.grid, self.scenes
        blocks = nodes.reshape(self.block.shape[0], *(BLOCK_WIDTH,) * grid.dim, nodes.shape[-1])
        blocks = torch.cat([blocks, blocks.new_zeros(1, *blocks.shape[1:])])
        dense = blocks[self.table.long()].reshape(scenes, *grid.blocks, *blocks.shape[1:])
        return dense.permute(*_interleaved(grid.dim)).reshape(
            scenes, *(b * BLOCK_WIDTH for b in grid.blocks), nodes.shape[-1]
        )

    def from_dense(self, dense: Tensor) -> Tensor:
        """The inverse of `to_dense` on the active blocks; differentiable."""
        grid = self.grid
        split = [size for b in grid.blocks for size in (b, BLOCK_WIDTH)]
        blocks = dense.reshape(self.scenes, *split, dense.shape[-1])
        order = _interleaved(grid.dim)
        blocks = blocks.permute(*sorted(range(len(order)), key=order.__getitem__))
        blocks = blocks.reshape(-1, grid.nodes_per_block, dense.shape[-1])
        rows = blocks[self.block.clamp_min(0).long()]
        return torch.where((self.block >= 0)[:, None, None], rows, 0).reshape(-1, dense.shape[-1])


def unravel(index: Tensor, shape: Sequence[int]) -> Tensor:
    """Coordinates [..., D] of indices modulo the size of an array; `torch.unravel_index` copies from the host."""
    coordinates = []
    for size in reversed(shape):
        coordinates.append(index % size)
        index = index // size
    return torch.stack(coordinates[::-1], -1)


def _interleaved(dim: int) -> list[int]:
    """Axes that take [B, blocks..., width..., K] to [B, (block, width)..., K]."""
    return [0] + [axis for i in range(dim) for axis in (1 + i, 1 + dim + i)] + [1 + 2 * dim]
