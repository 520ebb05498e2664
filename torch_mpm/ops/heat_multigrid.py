"""Conjugate gradients with a multigrid V-cycle as preconditioner for the implicit heat step: `heat_multigrid`.

It has the arguments and results of `heat_cg`, and consists of ops. A coarse level is a lattice of twice the node
distance, with the nodes i of the finer one as particles, with conductance Σ_p N_i κ_p V_p and heat capacity M_i. So
every level has the same operator, at an eighth (a quarter in 2-D) of the cost of a level above with as many nodes as
cells. Splines of a coarse level are sums of those of the finer one (two-scale relation), by which values are prolonged,
and restricted by the transpose. Smoothers are Chebyshev iterations of the fourth kind (Lottes 2023), of `Patches` on
the finest level and of the diagonal on the others; the coarsest is solved by conjugate gradients.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import is_captured
from ..errors import check_like, shape_of
from ..grid.bspline import bspline
from ..grid.grid import INT32_MAX, Grid
from ..grid.topology import BLOCK_WIDTH, PADDING, Topology
from .heat_patches import Patches, lattice_rows

DEGREE, COARSE_DEGREE = 4, 2
"""Degrees of the smoother's polynomial, on the finest level and on the others."""
COARSEST = 3
"""Blocks along the longest side of the domain at which coarsening ends: five cells."""
COARSE_REDUCTION, COARSE_ITERATIONS = 1e-2, 40
"""Relative tolerance and maximum number of iterations of conjugate gradients on the coarsest level."""
POWER_ITERATIONS, MARGIN = 8, 1.1
"""Number of power iterations for the largest eigenvalue of each level, and its margin; the smoother of degree 4 still
converges a tenth beyond.
"""


class Scenes:
    """Sums over the nodes of each scene, and values of scenes at their nodes."""

    def __init__(self, blocks: Topology) -> None:
        self.blocks, self.count = blocks, blocks.scenes
        self.node = None if self.count == 1 else blocks.node_scene().long().clamp_min(0)

    def sum(self, nodes: Tensor) -> Tensor:
        """[N] to [B] in float64, in a fixed order."""
        slots = nodes.reshape(-1, self.blocks.grid.nodes_per_block).sum(1, dtype=torch.float64)
        if self.count == 1:
            return slots.sum(0, keepdim=True)
        return torch.nn.functional.pad(slots, (0, 1))[self.blocks.table.long()].reshape(self.count, -1).sum(1)

    def spread(self, values: Tensor, dtype: torch.dtype) -> Tensor:
        """[B] to [N], or [1] where there is one scene."""
        values = values.to(dtype)
        return values if self.node is None else values[self.node]


class Transfer:
    """Prolongation from a coarse level to a fine one, and its transpose.

    The values at the 4^D nodes of a fine block b depend on the 4^D coarse nodes 2 b + 1 ... 2 b + 4, with the same
    weights in each.
    """

    def __init__(self, fine: Topology, coarse: Topology, like: Tensor) -> None:
        dim, device = fine.grid.dim, like.device
        local = torch.arange(BLOCK_WIDTH, device=device)
        # From the first: a coarse spline's share in its fine ones is the spline of one order less at their distance.
        shift = 3.5 if fine.grid.order == 2 else 3.0
        distance = ((1 + local).to(like) - (local[:, None].to(like) + shift) / 2).abs()
        line = (1 - distance).clamp_min(0) if fine.grid.order == 2 else bspline(distance, 2)
        self.weight = line
        for _ in range(dim - 1):
            self.weight = torch.kron(self.weight, line)
        self.patch = lattice_rows(fine, coarse, lambda b: 2 * b[:, None] + 1 + local)

        def patch_of(block: Tensor) -> Tensor:
            """Nodes of the patches, as 4 b + j, that hold the nodes of a coarse block: two along each axis."""
            before = BLOCK_WIDTH * block[:, None] + local - 1
            return torch.stack([4 * (before // 2 - c) + before % 2 + 2 * c for c in (0, 1)], -1)

        self.sources = lattice_rows(coarse, fine, patch_of)

    def prolong(self, coarse: Tensor) -> Tensor:
        patch = torch.nn.functional.pad(coarse, (0, 1))[self.patch]
        return (patch @ self.weight.T).reshape(-1)

    def restrict(self, fine: Tensor) -> Tensor:
        patch = fine.reshape(-1, self.weight.shape[0]) @ self.weight
        return torch.nn.functional.pad(patch.reshape(-1), (0, 1))[self.sources].sum(1)


@dataclasses.dataclass
class Level:
    """A lattice with A = weight + H on its free nodes.

    Attributes:
        x, conductance: quadrature points [P, D] [m] and their κ V [P].
        weight: M/dt + X [N].
        free: mask of the unknown nodes, as 0 or 1 [N].
        inverse: inverse of the diagonal times the largest eigenvalue of diag(A)⁻¹ A, zero on the other nodes [N].
        patches: smoother instead of the diagonal, with `inverse` one over the largest eigenvalue; or None.
        transfer: transfer from the next level; None on the coarsest.
    """

    blocks: Topology
    x: Tensor
    conductance: Tensor
    weight: Tensor
    free: Tensor
    inverse: Tensor
    patches: Patches | None = None
    transfer: Transfer | None = None

    def product(self, u: Tensor) -> Tensor:
        """H u."""
        return torch.ops.torch_mpm.heat_operator(self.x, self.conductance, u, *self.blocks.packed)

    def apply(self, u: Tensor) -> Tensor:
        """A u on the free nodes, for u that is zero on the others; undefined there."""
        return torch.addcmul(self.product(u), self.weight, u)

    def precondition(self, r: Tensor) -> Tensor:
        return self.inverse * (r if self.patches is None else self.patches(r))

    def smooth(self, r: Tensor, d: Tensor | None = None) -> Tensor:
        """d after Chebyshev iteration from it, with residual r."""
        step = (4 / 3) * self.precondition(r)
        d = step if d is None else d + step
        for i in range(1, DEGREE if self.patches else COARSE_DEGREE):
            r = r - self.apply(step)
            step = (2 * i - 1) / (2 * i + 3) * step + (8 * i + 4) / (2 * i + 3) * self.precondition(r)
            d = d + step
        return d


def _level(
    blocks: Topology,
    x: Tensor,
    conductance: Tensor,
    weight: Tensor,
    free: Tensor,
    diagonal: Tensor,
    patches: bool = False,
) -> Level:
    """A level, with its largest eigenvalue by the power method."""
    scenes = Scenes(blocks)
    inverse = free if patches else torch.where(free > 0, free / torch.where(free > 0, weight + diagonal, 1), 0)
    level = Level(blocks, x, conductance, weight, free, inverse)
    if patches:
        level.patches = Patches(blocks, x, conductance, weight, free > 0)
    v = torch.sin(torch.arange(len(free), device=x.device).to(x) % 8191) * free
    largest = torch.ones(scenes.count, dtype=torch.float64, device=x.device)
    for _ in range(POWER_ITERATIONS):
        size = scenes.sum(v * v).sqrt()
        v = level.precondition(level.apply(v / scenes.spread(torch.where(size > 0, size, 1), x.dtype)))
        largest = scenes.sum(v * v).sqrt()
    largest = torch.where(largest > 0, MARGIN * largest, 1)
    level.inverse = inverse / scenes.spread(largest, x.dtype)
    return level


def _coarse_grid(fine: Topology) -> Grid:
    """Grid of twice the node distance, whose splines are sums of those of `fine`."""
    grid = fine.grid
    shift = 0.5 if grid.order == 2 else 0.0
    lower = [a - shift * grid.dx for a in grid.lower]
    upper = [a + (BLOCK_WIDTH * n - 1 - 2 * PADDING) * grid.dx for a, n in zip(grid.lower, grid.blocks, strict=True)]
    kernel = "quadratic" if grid.order == 2 else "cubic"
    return Grid(2 * grid.dx, lower, upper, fine.scenes, kernel, deterministic=grid.deterministic)


def _coarsen(level: Level, weight: Tensor) -> Level:
    """Next level; `weight` includes M/dt + X, and a substitute for held nodes."""
    fine, given = level.blocks, level.conductance[:, None]
    conductance = torch.ops.torch_mpm.scatter(level.x, given, None, None, 1.0, *fine.packed)[:, 0].contiguous()
    # Nodes without conductance are placed outside, and excluded from the activation.
    x = torch.where((conductance.abs() > 0)[:, None], fine.node_positions(level.x.dtype), torch.nan).T.contiguous().T
    grid = _coarse_grid(fine)
    scene = None if grid.scenes == 1 else fine.node_scene().clamp_min(0).int()
    blocks = grid._activate(x, scene, None, min(grid.block_count, fine.block.shape[0]))
    level.transfer = Transfer(fine, blocks, x)
    weight = torch.ops.torch_mpm.scatter(x, weight[:, None], None, None, 1.0, *blocks.packed)[:, 0].contiguous()
    diagonal = torch.ops.torch_mpm.heat_operator(x, conductance, None, *blocks.packed)
    return _level(blocks, x, conductance, weight, (weight > 0).to(x), diagonal)


def _levels(
    blocks: Topology, x: Tensor, conductance: Tensor, weight: Tensor, free: Tensor, held: Tensor, diagonal: Tensor
) -> list[Level]:
    """Levels from the finest to the coarsest; `diagonal` is that of the operator on the finest."""
    several = max(blocks.grid.blocks) > COARSEST
    levels = [_level(blocks, x, conductance, weight, free, diagonal, patches=several)]
    # Coarse levels have no held nodes: there, held nodes have the weight of conduction.
    weight = torch.where(held, diagonal, weight)
    while max(levels[-1].blocks.grid.blocks) > COARSEST:
        levels.append(_coarsen(levels[-1], weight))
        weight = levels[-1].weight
    return levels


def _cycle(levels: list[Level], depth: int, r: Tensor) -> Tensor:
    """A V-cycle, symmetric in r."""
    level = levels[depth]
    if level.transfer is None:
        return torch.ops.torch_mpm.heat_cg(
            level.x, level.conductance, level.weight, None, r, None, None, None, 1.0, None, 0.0, COARSE_REDUCTION,
            None, COARSE_ITERATIONS, 0, 0.5, *level.blocks.packed,
        )[0]  # fmt: skip
    d = level.smooth(r)
    coarse = level.transfer.restrict(level.free * (r - level.apply(d)))
    d = d + level.free * level.transfer.prolong(_cycle(levels, depth + 1, coarse))
    return level.smooth(r - level.apply(d), d)


def _check_exact(name: str, value: Tensor | None, dtype: torch.dtype, shape: tuple[int, ...], x: Tensor) -> None:
    if value is not None and (value.dtype != dtype or value.shape != shape or value.device != x.device):
        raise ValueError(
            f"{name} must have shape {list(shape)} and be {dtype} on {x.device}, "
            f"got {shape_of(value)}, {value.dtype} on {value.device}"
        )


def heat_multigrid(
    x: Tensor,
    conductance: Tensor,
    heat_capacity: Tensor,
    theta: Tensor | None,
    source: Tensor | None,
    exchange: Tensor | None,
    fixed: Tensor | None,
    scene_dt: Tensor | None,
    dt: float,
    scene_tolerance: Tensor | None,
    tolerance: float,
    relative_tolerance: float,
    scene_limit: Tensor | None,
    max_iterations: int,
    method: int,
    adjoint_tolerance: float,
    *topology: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Arguments and results of the op `heat_cg` (csrc/heat/solve.h)."""
    diagonal = torch.ops.torch_mpm.heat_operator(x, conductance, None, *topology)  # Checks its arguments.
    blocks = Topology.unpack(*topology)
    count = blocks.scenes
    for name, value in (("heat_capacity", heat_capacity), ("theta", theta), ("source", source), ("exchange", exchange)):
        check_like(name, value, x, (blocks.node_count,), "[N]")
    for name, value in (("scene_dt", scene_dt), ("scene_tolerance", scene_tolerance)):
        check_like(name, value, x, (count,), "[B]")
    _check_exact("fixed", fixed, torch.bool, (blocks.node_count,), x)
    _check_exact("scene_max_iterations", scene_limit, torch.int32, (count,), x)
    if not 0 <= max_iterations <= INT32_MAX:
        raise ValueError(f"max_iterations must be 0 to 2^31 - 1, got {max_iterations}")
    scenes = Scenes(blocks)
    step = x.new_full((count,), dt, dtype=torch.float64) if scene_dt is None else dt * scene_dt.double()
    used, zero = blocks.active_nodes(), torch.zeros_like(heat_capacity, memory_format=torch.contiguous_format)
    material = used & ~(heat_capacity <= 0)
    held = torch.zeros_like(used) if fixed is None else material & fixed
    is_free = material & ~held
    free, mass = is_free.to(x), torch.where(is_free, heat_capacity, 1)
    outflow = zero if exchange is None else torch.where(used, exchange, 0)
    given = zero if source is None else torch.where(is_free, source, 0)
    weight = torch.where(is_free, mass / scenes.spread(torch.where(step > 0, step, 1), x.dtype) + outflow, 0)
    r = given
    if theta is not None:
        r = r - torch.ops.torch_mpm.heat_operator(x, conductance, theta, *topology) - outflow * theta
    r = torch.where(is_free, r, 0)
    total = scenes.sum(torch.where(is_free, heat_capacity, 0))
    inverse_mass = free / mass

    def in_kelvin(r: Tensor) -> Tensor:
        return torch.where(total == 0, 0, step * (scenes.sum(r * (r * inverse_mass)) / total).sqrt())

    residual = torch.where(step > 0, in_kelvin(r), torch.nan)
    valid = residual < torch.inf
    least = torch.full_like(step, tolerance) if scene_tolerance is None else scene_tolerance.double()
    limit = torch.maximum(least, relative_tolerance * residual)
    most = torch.full_like(step, max_iterations) if scene_limit is None else scene_limit
    running = valid & (residual > limit) & (most > 0)
    capturing = is_captured(x)

    def unfinished() -> bool:
        """A captured graph cannot query this; converged scenes are then unchanged."""
        return capturing or bool(running.any())

    d = p = before = zero
    product = torch.ones_like(step)
    iterations = torch.zeros(count, dtype=torch.int32, device=x.device)
    levels = _levels(blocks, x, conductance, weight, free, held, diagonal) if unfinished() else []
    if scene_limit is not None and levels:
        max_iterations = int(scene_limit.max())
    for k in range(max_iterations):
        if not unfinished():
            break
        z = _cycle(levels, 0, r)
        # Polak and Ribière's formula: the conjugate gradients of the coarsest level make the cycle depend on r a
        # little.
        beta = torch.where(running, scenes.sum(z * (r - before)) / product, 0)
        product = scenes.sum(r * z)
        p = z if k == 0 else torch.addcmul(z, scenes.spread(beta, x.dtype), p)
        Ap = levels[0].apply(p)
        curvature = scenes.sum(p * Ap)
        running = running & (curvature > 0) & (product != 0)  # zero where sums underflow
        alpha = scenes.spread(torch.where(running, product / curvature, 0), x.dtype)
        before, r = r, torch.addcmul(r, alpha, Ap, value=-1)
        d = torch.addcmul(d, alpha, p)
        residual = torch.where(running, in_kelvin(r), residual)
        iterations = iterations + running.int()
        running = running & (residual > limit) & (iterations < most)
    outside = scenes.sum((held | (is_free & (outflow != 0))).to(x))
    missing = (step * scenes.sum(given) - scenes.sum(d * torch.where(is_free, mass, 0))) / total
    shift = scenes.spread(torch.where((outside == 0) & (iterations > 0), missing, 0), x.dtype)
    solved = is_free & scenes.spread(valid, torch.bool)
    return torch.where(solved, d + shift, 0), iterations, residual.to(x.dtype), residual <= limit
