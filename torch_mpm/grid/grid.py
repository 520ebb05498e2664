"""Node lattice of a simulation, and its active blocks."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import is_captured, is_traced, outside_transforms
from ..errors import (
    FLOATING,
    GridOverflowError,
    check_count,
    check_flag,
    check_index,
    check_number,
    check_positions,
    check_vector,
    shape_of,
)
from . import resolution
from .topology import BLOCK_WIDTH, PADDING, Lattice, Status, Topology

INT32_MAX = 2**31 - 1
MOST_NODES = 2**33
"""Number of nodes along an axis beyond which no grid can have fewer than 2^31 blocks."""
STATUS_SIZE = 8
"""Numbers per row of a status, csrc/grid/status.h."""
KERNEL_ORDERS = {"quadratic": 2, "cubic": 3}


class _Pools(threading.local):
    """Per thread: sizes of pools that `same_pools` replays, the lists that it writes, and previous sizes of grids."""

    def __init__(self) -> None:
        self.replayed: Iterator[int] | None = None
        self.before: dict[Grid, int | None] = {}
        self.lists: list[list[int]] = []


_POOLS = _Pools()


class Grid(Lattice):
    """A regular lattice with node i of an axis at `lower + (i - 3) dx`, shared by all scenes of a batch.

    Memory is allocated only for active blocks of 4^D nodes, from a pool of `max_blocks` blocks.

    Args:
        dx: node distance [m].
        lower, upper: corners of the domain [m], 2 or 3 numbers. Particles between them have their whole support; a
            particle more than a cell outside is excluded from the transfers and reported. Far from zero, choose an
            origin near the bodies (`torch_mpm.seed`) and give all coordinates relative to it.
        scenes: number of scenes B in a batch; each has a separate lattice.
        kernel: "quadratic" or "cubic" B-spline.
        max_blocks: blocks in the pool; rollouts also allocate memory for surrounding blocks, half as many again on CUDA
            and twice as many on the CPU. None measures it from the positions of the first activation, and grows with
            the scene: at once on the CPU; on CUDA, without synchronising, when less than a quarter is left.
        deterministic: bit-identical results from run to run on CUDA too (the CPU always is). A pool that has grown with
            a scene affects later runs: give each run a separate grid.

    The first use with positions of a dtype warns (`PrecisionWarning`) where their rounding exceeds dx / 1000, and
    raises ValueError where it exceeds dx / 16.

    Attributes:
        reach: largest absolute coordinate of the domain [m].
        extent: length of its longest side [m].

    Raises:
        TypeError, ValueError: for a wrong argument, a lattice of 2^31 blocks or more, or a domain so far from zero that
            even float64 does not resolve dx.
    """

    def __init__(
        self,
        dx: float,
        lower: Sequence[float],
        upper: Sequence[float],
        scenes: int = 1,
        kernel: str = "quadratic",
        max_blocks: int | None = None,
        deterministic: bool = False,
    ) -> None:
        square = "a positive number, with a square that is positive and finite"
        dx = float(check_number("dx", dx, square, lambda v: v > 0 and 0 < float(v) * float(v) < math.inf))
        corner = check_vector("lower", lower)
        self.upper = check_vector("upper", upper, len(corner))
        if not all(a < b for a, b in zip(corner, self.upper, strict=True)):
            raise ValueError(f"upper must be above lower on every axis, got lower {lower} and upper {upper}")
        check_count("scenes", scenes)
        if kernel not in tuple(KERNEL_ORDERS):
            raise ValueError(f"kernel must be one of {sorted(KERNEL_ORDERS)}, got {kernel!r}")
        self.scenes = int(scenes)
        self.kernel = kernel
        deterministic = check_flag("deterministic", deterministic)
        # A node on `upper` exists even when the extent is a multiple of dx only up to rounding.
        cells = [math.ceil((b - a) / dx - 1e-6) for a, b in zip(corner, self.upper, strict=True)]
        self.nodes = tuple(n + 1 + 2 * PADDING for n in cells)
        blocks = tuple(-(-n // BLOCK_WIDTH) for n in self.nodes)
        super().__init__(dx, corner, blocks, KERNEL_ORDERS[kernel], deterministic)
        self.block_count = max(self.scenes, 1) * math.prod(self.blocks)
        if self.block_count > INT32_MAX:
            raise ValueError(
                f"the grid has {self.block_count} blocks over {self.scenes} scenes; fewer than 2^31 are possible: "
                "enlarge dx or split the domain or the batch"
            )
        self._most_blocks = min(self.block_count, INT32_MAX // self.nodes_per_block)
        if max_blocks is not None and check_count("max_blocks", max_blocks) > self._most_blocks:
            raise ValueError(f"max_blocks must be between 0 and {self._most_blocks} blocks, got {max_blocks}")
        self.max_blocks = max_blocks
        self._grows = max_blocks is None
        self.reach = max(map(abs, (*corner, *self.upper)))
        self.extent = max(b - a for a, b in zip(corner, self.upper, strict=True))
        self._rounding = {dtype: resolution.rounding(self.reach, dtype) for dtype in FLOATING}
        self._resolved: set[torch.dtype] = set()
        self.check_resolution(torch.float64)
        self._pending: torch.cuda.Event | None = None
        self._on_host: Tensor | None = None

    def __getstate__(self) -> dict[str, Any]:
        """State for copies, without pending transfers from the device, which can be neither copied nor pickled."""
        return {**self.__dict__, "_pending": None, "_on_host": None}

    def __repr__(self) -> str:
        return (
            f"Grid(dx={self.dx}, lower={self.lower}, upper={self.upper}, scenes={self.scenes}, kernel={self.kernel!r}, "
            f"max_blocks={self.max_blocks})"
        )

    def activate(
        self, x: Tensor, scene: Tensor | None = None, previous: Tensor | None = None, ids: Tensor | None = None
    ) -> Blocks:
        """Find the active blocks.

        Args:
            x: positions [P, D] [m], float32 or float64.
            scene: scene of each particle, int32 [P]; None where the grid has one scene.
            previous: status of the previous activation, to be continued.
            ids: identity of each particle, int64 [P], for the status; None for its index.

        Returns:
            The active blocks. On CUDA there is no synchronisation, except in the first call without `max_blocks`.

        Raises:
            ValueError, TypeError: for wrong shapes, dtypes or devices.
            ValueError: where positions of this dtype do not resolve the cells (`check_resolution`).
            GridOverflowError: on the CPU, where a fixed `max_blocks` is too small. On CUDA the status reports it
                (`Step.check`).
        """
        check_positions(x, self.dim, scene, self.scenes)
        check_index("ids", ids, x, torch.int64)
        if previous is not None:
            _check_status(previous, self.scenes)
        max_blocks = self.pool(x, scene)
        blocks = self._activate(x, scene, previous, max_blocks, ids)
        if x.device.type == "cpu" and not is_traced(x):
            wanted = blocks.wanted
            if wanted > max_blocks:
                blocks = self._activate(x, scene, previous, self.follow(wanted), ids)
        return blocks

    def rounding(self, dtype: torch.dtype) -> float:
        """Largest rounding error of positions of a dtype in the domain [m]."""
        return self._rounding[dtype]

    def check_resolution(self, dtype: torch.dtype) -> None:
        """Report a domain whose cells positions of a dtype do not resolve, once for each dtype.

        Warns:
            PrecisionWarning: where positions are rounded by more than dx / 1000.

        Raises:
            ValueError: where they are rounded by more than dx / 16.
        """
        if dtype not in self._resolved:
            resolution.check(self, dtype)
            self._resolved.add(dtype)

    @property
    def grows(self) -> bool:
        """Whether `max_blocks` adapts to the scene."""
        return self._grows

    def pool(self, x: Tensor, scene: Tensor | None) -> int:
        """Number of blocks in the pool of the next activation."""
        compiling = torch.compiler.is_compiling()
        if not compiling:
            self.check_resolution(x.dtype)
        if not compiling and _POOLS.replayed is not None:
            _POOLS.before.setdefault(self, self.max_blocks)
            self.max_blocks = next(_POOLS.replayed, self.max_blocks)
        elif self._grows:
            self._grow(x, scene)
        assert self.max_blocks is not None
        if not compiling:
            for sizes in _POOLS.lists:
                sizes.append(self.max_blocks)
        return self.max_blocks

    def follow(self, wanted: int) -> int:
        """Number of blocks of a pool large enough for an activation on the CPU.

        Raises:
            GridOverflowError: where `max_blocks` is fixed and too small.
        """
        assert self.max_blocks is not None
        if wanted > self.max_blocks:
            if not self._grows:
                raise GridOverflowError(
                    f"{wanted} blocks are active but the grid has max_blocks={self.max_blocks}: "
                    f"pass max_blocks={_with_headroom(wanted)} or more, or None to let it grow"
                )
            self.max_blocks = min(_with_headroom(wanted), self._most_blocks)
        return self.max_blocks

    def _activate(
        self, x: Tensor, scene: Tensor | None, previous: Tensor | None, max_blocks: int, ids: Tensor | None = None
    ) -> Blocks:
        table, block, offsets, index, schedule, status = torch.ops.torch_mpm.activate(
            x.detach() if x.requires_grad else x, scene, ids, previous, self.scenes, max_blocks, *self.packed
        )
        return Blocks(self, table, block, offsets, index, schedule, scene, status)

    def status_at(self, x: Tensor, scene: Tensor | None, previous: Tensor | None, ids: Tensor | None) -> Tensor:
        """Status that an activation would have after a previous one; arguments as in `activate`."""
        return self._activate(x, scene, previous, 0, ids).status

    def _grow(self, x: Tensor, scene: Tensor | None) -> None:
        """Increase `max_blocks` ahead of the required blocks; reads the device only in the first call."""
        if self.max_blocks is None:
            if is_traced(x):
                raise ValueError(
                    "a grid used under torch.compile needs max_blocks: pass it, or activate the grid once before"
                )
            self.max_blocks = self.measured_pool(x, scene)
        elif (
            # This comes first: a compiled step would hold a reference to a temporary event.
            not torch.compiler.is_compiling()
            and self._pending is not None
            and not is_captured(x)  # A query would break the capture.
            and self._pending.query()
        ):
            assert self._on_host is not None
            wanted = self._on_host.tolist()[Status.BLOCKS_NOW]
            if wanted * 4 > self.max_blocks * 3:
                self.max_blocks = min(_with_headroom(wanted), self._most_blocks)
            self._pending = None

    def measured_pool(self, x: Tensor, scene: Tensor | None) -> int:
        """Number of blocks of a pool for these particles; waits for the device."""
        return min(_with_headroom(self._activate(x, scene, None, 0).wanted), self._most_blocks)

    def watch(self, status: Tensor) -> None:
        """Adapt `max_blocks` to the `status` of an activation, without waiting for the device."""
        if not status.is_cuda:
            return
        # As in `_grow`, a compiled step must not access the event.
        if is_traced(status) or not self._grows or self._pending is not None:
            return
        if is_captured(status):
            return
        if self._on_host is None:
            with torch.inference_mode(False):  # A later step may then write to it.
                shape = status.shape[1:]
                self._on_host = torch.empty(shape, dtype=status.dtype, device="cpu", pin_memory=True)
        with outside_transforms():
            self._on_host.copy_(status[0], non_blocking=True)
        self._pending = torch.cuda.Event()
        self._pending.record(torch.cuda.current_stream(status.device))

    @property
    def watches(self) -> bool:
        """Whether a block count requested by `watch` is still pending."""
        return self._pending is not None

    def wait(self) -> None:
        """Wait for the block count requested by `watch`, so that the next activation has enough blocks."""
        if self._pending is not None:
            self._pending.synchronize()


@contextlib.contextmanager
def same_pools(sizes: list[int]) -> Iterator[None]:
    """Context in which the pools of all activations get the sizes in a list, or are appended to it where it is empty.

    Recomputed steps of the backward pass thus find pools of the original size.
    """
    if not sizes:
        _POOLS.lists.append(sizes)
        try:
            yield
        finally:
            _POOLS.lists.pop()
        return
    outer, before = _POOLS.replayed, _POOLS.before
    _POOLS.replayed, _POOLS.before = iter(sizes), {}
    try:
        yield
    finally:
        for grid, latest in _POOLS.before.items():
            grid.max_blocks = max(grid.max_blocks or 0, latest or 0)
        _POOLS.replayed, _POOLS.before = outer, before


@contextlib.contextmanager
def own_pools() -> Iterator[None]:
    """Context in which an enclosing `same_pools` neither stores nor sets the sizes of pools."""
    replayed, lists = _POOLS.replayed, _POOLS.lists
    _POOLS.replayed, _POOLS.lists = None, []
    try:
        yield
    finally:
        _POOLS.replayed, _POOLS.lists = replayed, lists


def _check_status(status: Any, scenes: int) -> None:
    if not isinstance(status, Tensor) or status.shape != (1 + scenes, STATUS_SIZE):
        expected = f"[1 + B, {STATUS_SIZE}] = [{1 + scenes}, {STATUS_SIZE}]"
        raise ValueError(f"previous must have shape {expected}, got {shape_of(status)}")
    if status.dtype != torch.int32:
        raise TypeError(f"previous must be int32, got {status.dtype}")


def check_grid(grid: Any) -> None:
    if not isinstance(grid, Grid):
        raise TypeError(f"grid must be a Grid, got {shape_of(grid)}")


def check_blocks(blocks: Any) -> None:
    if not isinstance(blocks, Blocks):
        raise TypeError(f"blocks must be the active blocks that Grid.activate returns, got {type(blocks).__name__}")


def _with_headroom(blocks: int) -> int:
    return blocks + blocks // 2 + 16


@dataclasses.dataclass(eq=False)
class Blocks(Topology):
    """Active blocks of one activation: N = max_blocks * 4^D node rows; rows of unused blocks stay zero.

    Attributes:
        grid: the grid that was activated.
        table: slot of every block of every scene, int32 [B * blocks], -1 where inactive.
        block: table index of every slot, int32 [max_blocks], -1 where unused.
        offsets, index: int32; particles `index[offsets[s]:offsets[s + 1]]` have their base node in the block of slot s.
        schedule: order of work of the kernels.
        scene: the scene of each particle, or None.
        status: int32 [1 + B, 8], see csrc/grid/status.h; `Step.check` and `Step.failures` read it.
    """

    grid: Grid
    status: Tensor

    @property
    def wanted(self) -> int:
        """Number of active blocks that this activation needed, which may exceed the pool; synchronises."""
        now: int = self.status[0].tolist()[Status.BLOCKS_NOW]
        return now
