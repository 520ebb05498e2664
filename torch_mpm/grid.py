"""The node lattice of a simulation, and its blocks that particles touch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .capture import is_captured, is_traced, outside_transforms, remember, without_transforms
from .errors import (
    GridOverflowError,
    check_count,
    check_flag,
    check_index,
    check_number,
    check_positions,
    check_vector,
    default_dtype,
    shape_of,
)
from .failures import Problem, problems_of_status, refused_steps

PADDING = 3
"""Nodes beyond `lower` and `upper`, so that a particle on the boundary has its support (csrc/grid/geometry.h)."""
BLOCK_WIDTH = 4
INT32_MAX = 2**31 - 1
NO_PROBLEM = (0, 0, -1, 0, -1, 0, -1, 0)
"""A row of the status before the first activation (csrc/grid/status.h)."""

KERNEL_ORDERS = {"quadratic": 2, "cubic": 3}


def inverse_inertia(order: int, dx: float) -> float:
    """D⁻¹ [1/m²] of a kernel order and node distance; `BSpline::inverse_inertia` of csrc/common/bspline.h."""
    return (4.0 if order == 2 else 3.0) / dx**2


class Grid:
    """A regular lattice with node i of an axis at `lower + (i - 3) dx`, shared by all scenes of a batch.

    Memory is taken only for blocks of 4^D nodes that particles touch, from a pool of `capacity` blocks.

    Args:
        dx: node distance [m].
        lower, upper: corners of the domain [m], 2 or 3 numbers. Particles between them have their whole support; a
            particle more than a cell outside is left out of the transfers and reported.
        scenes: number of scenes B in a batch; each has the whole lattice to itself.
        kernel: "quadratic" or "cubic" B-spline.
        capacity: blocks in the pool. None measures it from the positions of the first activation, and lets it grow with
            the scene: at once on the CPU; on CUDA, without synchronising, when less than a quarter is left.
        deterministic: bit-identical results from run to run on CUDA too (the CPU always is).

    Raises:
        TypeError, ValueError: for a wrong argument, or a lattice of 2^31 blocks or more.
    """

    def __init__(
        self,
        dx: float,
        lower: Sequence[float],
        upper: Sequence[float],
        scenes: int = 1,
        kernel: str = "quadratic",
        capacity: int | None = None,
        deterministic: bool = False,
    ) -> None:
        square = "a positive number, with a square that is positive and finite"
        self.dx = float(check_number("dx", dx, square, lambda v: v > 0 and 0 < float(v) * float(v) < math.inf))
        self.lower = check_vector("lower", lower)
        self.upper = check_vector("upper", upper, len(self.lower))
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"upper must be above lower on every axis, got lower {lower} and upper {upper}")
        check_count("scenes", scenes)
        if kernel not in tuple(KERNEL_ORDERS):
            raise ValueError(f"kernel must be one of {sorted(KERNEL_ORDERS)}, got {kernel!r}")
        self.scenes = int(scenes)
        self.kernel = kernel
        self.order = KERNEL_ORDERS[kernel]
        self.dim = len(self.lower)
        self.deterministic = check_flag("deterministic", deterministic)
        # A node on `upper` exists even when the extent is a multiple of dx only up to rounding.
        cells = [math.ceil((b - a) / self.dx - 1e-6) for a, b in zip(self.lower, self.upper, strict=True)]
        self.nodes = tuple(n + 1 + 2 * PADDING for n in cells)
        self.blocks = tuple(-(-n // BLOCK_WIDTH) for n in self.nodes)
        self.block_count = max(self.scenes, 1) * math.prod(self.blocks)
        if self.block_count > INT32_MAX:
            raise ValueError(
                f"the grid has {self.block_count} blocks over {self.scenes} scenes; fewer than 2^31 are possible: "
                "enlarge dx or split the domain or the batch"
            )
        self.nodes_per_block = BLOCK_WIDTH**self.dim
        self._max_capacity = min(self.block_count, INT32_MAX // self.nodes_per_block)
        if capacity is not None and check_count("capacity", capacity) > self._max_capacity:
            raise ValueError(f"capacity must be between 0 and {self._max_capacity} blocks, got {capacity}")
        self.capacity = capacity
        self._grows = capacity is None
        self._pending: torch.cuda.Event | None = None
        self._on_host: Tensor | None = None

    def __getstate__(self) -> dict[str, Any]:
        """For copies: without what is on its way from the device, which neither copies nor pickles."""
        return {**self.__dict__, "_pending": None, "_on_host": None}

    def __repr__(self) -> str:
        return (
            f"Grid(dx={self.dx}, lower={self.lower}, upper={self.upper}, scenes={self.scenes}, kernel={self.kernel!r}, "
            f"capacity={self.capacity})"
        )

    @property
    def inverse_inertia(self) -> float:
        """D⁻¹ = 4/dx² (quadratic) or 3/dx² (cubic) [1/m²] of the APIC affine field (Jiang et al. 2015)."""
        return inverse_inertia(self.order, self.dx)

    def activate(
        self, x: Tensor, scene: Tensor | None = None, previous: Tensor | None = None, ids: Tensor | None = None
    ) -> Blocks:
        """Find the blocks that particles touch.

        Args:
            x: positions [P, D] [m], float32 or float64.
            scene: scene of each particle, int32 [P]; None where the grid has one scene.
            previous: status of the activation before, to be carried on.
            ids: identity of each particle, int64 [P], for the status; None for its index.

        Returns:
            The active blocks. On CUDA nothing is synchronised, except at the very first call without a `capacity`.

        Raises:
            ValueError, TypeError: for wrong shapes, dtypes or devices.
            GridOverflowError: on the CPU, where a fixed capacity is too small. On CUDA the status tells (`Step.check`).
        """
        check_positions(x, self.dim, scene, self.scenes)
        check_index("ids", ids, x, torch.int64)
        if self._grows:
            self._grow(x, scene)
        assert self.capacity is not None
        blocks = self._activate(x, scene, previous, self.capacity, ids)
        if x.device.type == "cpu" and not is_traced(x):
            wanted = blocks.wanted
            if wanted > self.capacity:
                if not self._grows:
                    raise GridOverflowError(
                        f"{wanted} blocks are active but the grid has a capacity of {self.capacity}: "
                        f"pass capacity={_with_headroom(wanted)} or more, or None to let it grow"
                    )
                self.capacity = min(_with_headroom(wanted), self._max_capacity)
                blocks = self._activate(x, scene, previous, self.capacity, ids)
        return blocks

    def _activate(
        self, x: Tensor, scene: Tensor | None, previous: Tensor | None, capacity: int, ids: Tensor | None = None
    ) -> Blocks:
        table, block, offsets, index, schedule, status = torch.ops.torch_mpm.activate(
            x.detach() if x.requires_grad else x, scene, previous, self.scenes, self.dx, self.lower, self.blocks,
            self.order, capacity, self.deterministic, ids,
        )  # fmt: skip
        return Blocks(self, table, block, offsets, index, schedule, status, scene)

    def _grow(self, x: Tensor, scene: Tensor | None) -> None:
        """Keep the capacity ahead of the blocks wanted; reads the device only at the first call."""
        if self.capacity is None:
            if is_traced(x):
                raise ValueError(
                    "a grid used under torch.compile needs a capacity: pass capacity= or activate it once before"
                )
            wanted = self._activate(x, scene, None, 0).wanted
            self.capacity = min(_with_headroom(wanted), self._max_capacity)
        elif (
            self._pending is not None
            and not torch.compiler.is_compiling()
            and not is_captured(x)  # a query would break the capture
            and self._pending.query()
        ):
            assert self._on_host is not None
            wanted = self._on_host.tolist()[7]
            if wanted * 4 > self.capacity * 3:
                self.capacity = min(_with_headroom(wanted), self._max_capacity)
            self._pending = None

    def watch(self, status: Tensor) -> None:
        """Let the capacity follow `status`, an activation's, without waiting for the device."""
        if not self._grows or self._pending is not None or status.device.type != "cuda":
            return
        if is_traced(status) or is_captured(status):
            return
        if self._on_host is None:
            with torch.inference_mode(False):  # such that a later step may write to it
                shape = status.shape[1:]
                self._on_host = torch.empty(shape, dtype=status.dtype, device="cpu", pin_memory=True)
        with outside_transforms():
            self._on_host.copy_(status[0], non_blocking=True)
        self._pending = torch.cuda.Event()
        self._pending.record()


class ActivationRecord:
    """The status of all activations of one user of a grid, also of those that CUDA graphs replay.

    A replay reads and writes the tensors of the capture. So captured activations go on in the tensor that they found,
    which is kept; the first activation of all should not be a captured one, or each replay forgets those before.

    Attributes:
        status: int32 [1 + B, 8], see csrc/grid/status.h; None before the first activation.
        refused: steps of each scene whose entry of a tensor dt could not be taken, int32 [B]; None before the first
            tensor dt.
    """

    def __init__(self) -> None:
        self.status: Tensor | None = None
        self.refused: Tensor | None = None
        self._replayed: list[Tensor] = []

    def activate(self, grid: Grid, x: Tensor, scene: Tensor | None, ids: Tensor | None = None) -> Blocks:
        """As `Grid.activate`; the capacity of the grid follows."""
        before = self.status
        blocks = grid.activate(x, scene, before, ids)
        status = without_transforms(blocks.status)
        grid.watch(status)
        if before is None or not is_captured(x):
            self.status = status
            return blocks
        with torch.inference_mode(), outside_transforms():  # in which any tensor may be written to
            before.copy_(status)
        remember(self._replayed, before)
        return blocks

    def all(self) -> list[Tensor]:
        """The latest status, and those that graphs go on with."""
        latest = [] if self.status is None else [self.status]
        return latest + [kept for kept in self._replayed if kept is not self.status]

    def problems(self, grid: Grid) -> dict[str, Problem]:
        """What these steps tell about scenes, without synchronising."""
        problems = problems_of_status(self.all(), grid)
        if self.refused is not None:
            problems["dt"] = refused_steps(self.refused)
        return problems

    @torch.no_grad()
    def refuse(self, entries: Tensor, scenes: int) -> None:
        """Count entries of a tensor dt that could not be taken: bool of shape [], [1] or [B]."""
        refused = self.counts(scenes, entries.device)
        with outside_transforms():
            refused += without_transforms(entries)

    def counts(self, scenes: int, device: torch.device) -> Tensor:
        """`refused`, made at the first tensor dt."""
        if self.refused is None or self.refused.device != device:
            with outside_transforms(), torch.inference_mode(False):
                self.refused = torch.zeros(scenes, dtype=torch.int32, device=device)
        return self.refused

    def reset(self) -> None:
        self.status = None
        if self.refused is not None:  # and CUDA graphs may write to it
            self.refused.zero_()
        with torch.inference_mode():
            for kept in self._replayed:
                kept.copy_(torch.tensor(NO_PROBLEM, dtype=torch.int32, device="cpu"))


def check_grid(grid: Any) -> None:
    if not isinstance(grid, Grid):
        raise TypeError(f"grid must be a Grid, got {shape_of(grid)}")


def check_blocks(blocks: Any) -> None:
    if not isinstance(blocks, Blocks):
        raise TypeError(f"blocks must be the active blocks that Grid.activate returns, got {type(blocks).__name__}")


def _with_headroom(blocks: int) -> int:
    return blocks + blocks // 2 + 16


@dataclasses.dataclass(eq=False)
class Blocks:
    """The active blocks of one activation: N = capacity * 4^D node rows, of which those of unused blocks stay zero.

    Attributes:
        table: slot of every block of every scene, int32 [B * blocks], -1 where inactive.
        block: table index of every slot, int32 [capacity], -1 where unused.
        offsets, index: particles `index[offsets[s]:offsets[s + 1]]` have their base node in the block of slot s, int32.
        schedule: order of work of the kernels.
        status: int32 [1 + B, 8], see csrc/grid/status.h; `Step.check` and `Step.failures` read it.
        scene: the scene of each particle, or None.
    """

    grid: Grid
    table: Tensor
    block: Tensor
    offsets: Tensor
    index: Tensor
    schedule: Tensor
    status: Tensor
    scene: Tensor | None

    @property
    def topology(self) -> tuple[Any, ...]:
        """The trailing arguments of every transfer op."""
        grid = self.grid
        return (
            *(self.table, self.block, self.offsets, self.index, self.schedule),
            *(grid.dx, grid.lower, grid.blocks, grid.order, grid.deterministic),
        )  # fmt: skip

    @property
    def wanted(self) -> int:
        """Active blocks that this activation wanted, which may be more than it got; synchronises."""
        return int(self.status[0, 7])

    @property
    def node_count(self) -> int:
        """Rows N of a node tensor."""
        return self.block.shape[0] * self.grid.nodes_per_block

    def active_nodes(self) -> Tensor:
        """Which node rows belong to an active block, bool [N]."""
        return (self.block >= 0).repeat_interleave(self.grid.nodes_per_block)

    def node_scene(self) -> Tensor:
        """Scene of each node, int32 [N]; -1 for unused rows."""
        scene = torch.where(self.block >= 0, self.block // math.prod(self.grid.blocks), -1)
        return scene.repeat_interleave(self.grid.nodes_per_block)

    def node_indices(self) -> Tensor:
        """Lattice indices of each node, int64 [N, D]; those of block 0 for unused rows."""
        grid = self.grid
        corner = _unravel(self.block.clamp_min(0).long(), grid.blocks) * BLOCK_WIDTH
        inside = torch.arange(grid.nodes_per_block, device=corner.device)
        offset = _unravel(inside, (BLOCK_WIDTH,) * grid.dim)
        return (corner[:, None] + offset).reshape(-1, grid.dim)

    def node_positions(self, dtype: torch.dtype | None = None) -> Tensor:
        """Position of each node [m], [N, D]."""
        columns = (self.node_indices() - PADDING).double().unbind(1)
        positions = [a + column * self.grid.dx for a, column in zip(self.grid.lower, columns, strict=True)]
        return torch.stack(positions, 1).to(dtype or default_dtype())

    def to_dense(self, nodes: Tensor) -> Tensor:
        """Node rows [N, K] as a dense tensor [B, X, Y, (Z), K] of the lattice, zero where inactive; differentiable."""
        grid = self.grid
        blocks = nodes.reshape(self.block.shape[0], *(BLOCK_WIDTH,) * grid.dim, nodes.shape[-1])
        blocks = torch.cat([blocks, blocks.new_zeros(1, *blocks.shape[1:])])
        dense = blocks[self.table.long()].reshape(grid.scenes, *grid.blocks, *blocks.shape[1:])
        return dense.permute(*_interleaved(grid.dim)).reshape(
            grid.scenes, *(b * BLOCK_WIDTH for b in grid.blocks), nodes.shape[-1]
        )

    def from_dense(self, dense: Tensor) -> Tensor:
        """The inverse of `to_dense` on the active blocks; differentiable."""
        grid = self.grid
        split = [size for b in grid.blocks for size in (b, BLOCK_WIDTH)]
        blocks = dense.reshape(grid.scenes, *split, dense.shape[-1])
        order = _interleaved(grid.dim)
        blocks = blocks.permute(*sorted(range(len(order)), key=order.__getitem__))
        blocks = blocks.reshape(-1, grid.nodes_per_block, dense.shape[-1])
        rows = blocks[self.block.clamp_min(0).long()]
        return torch.where((self.block >= 0)[:, None, None], rows, 0).reshape(-1, dense.shape[-1])


def _unravel(index: Tensor, shape: Sequence[int]) -> Tensor:
    """Coordinates [..., D] of indices modulo the size of an array; `torch.unravel_index` copies from the host."""
    coordinates = []
    for size in reversed(shape):
        coordinates.append(index % size)
        index = index // size
    return torch.stack(coordinates[::-1], -1)


def _interleaved(dim: int) -> list[int]:
    """Axes that take [B, blocks..., width..., K] to [B, (block, width)..., K]."""
    return [0] + [axis for i in range(dim) for axis in (1 + i, 1 + dim + i)] + [1 + 2 * dim]
