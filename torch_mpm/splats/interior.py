"""The inside of an object of Gaussians: its opaque cells on a lattice, and the cells that they enclose."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..data import host_memory
from .gaussians import Gaussians

REACH = 3.0
"""Number of deviations up to which a Gaussian contributes to the opacity of cells."""
OPAQUE = 0.5
"""Sum of opacities from which a cell is opaque."""
MARGIN = 2
"""Empty cells around the centres."""
CHUNK = 2**21
"""Number of pairs of a Gaussian and a cell that are computed together."""
CELL_BYTES, PAIR_BYTES = 40, 200
"""Memory per cell of the lattice, and per pair of a chunk."""
MOST_PAIRS = 2**32


class Lattice:
    """Cubes of edge `spacing` [m] around the centres of Gaussians [N, 3], with a margin.

    Attributes:
        lower, upper: corners [3] [m], float64.
        shape: number of cells along each axis.

    Raises:
        ValueError: for more cells than fit in memory.
    """

    def __init__(self, x: Tensor, spacing: float) -> None:
        low, high = x.double().amin(0), x.double().amax(0)
        counts = ((high - low) / spacing).ceil() + 2 * MARGIN
        cells, free = math.prod(counts.tolist()), host_memory.available()
        if cells * CELL_BYTES > free:
            raise ValueError(
                f"the lattice around the Gaussians has {cells:.3g} cells of {spacing:.3g} m, which take "
                f"{host_memory.in_words(cells * CELL_BYTES)}, and {host_memory.in_words(free)} are free; remove "
                "distant Gaussians, make the object smaller, dx larger or per_cell smaller"
            )
        self.spacing, self.shape = spacing, tuple(int(n) for n in counts.tolist())
        self.lower = 0.5 * (low + high - counts * spacing)
        self.upper = self.lower + counts * spacing

    def cells(self, x: Tensor) -> Tensor:
        """Cells [N, 3], int64, of points [N, 3] in the box; those beyond it count as the outermost cells."""
        index = ((x.double() - self.lower) / self.spacing).floor().clamp(min=0)
        return index.minimum(torch.tensor(self.shape, dtype=index.dtype) - 1).long()

    def numbers(self, cells: Tensor) -> Tensor:
        """Numbers [N] of cells [N, 3] in arrays of the shape of the lattice."""
        _, ny, nz = self.shape
        return (cells[:, 0] * ny + cells[:, 1]) * nz + cells[:, 2]


def opacity_field(gaussians: Gaussians, lattice: Lattice) -> Tensor:
    """Sum over the Gaussians of σ exp(−½ dᵀ (Σ + (h/2)² 1)⁻¹ d) at the centres of the cells, [X, Y, Z], float32.

    The opacity-weighted field of PhysGaussian (Xie et al. 2024), smoothed by half a cell h/2 so that no flat Gaussian
    is missed between two centres. Contributions beyond `REACH` deviations are left out.

    Raises:
        ValueError: where the Gaussians reach over more pairs of Gaussian and cell than `MOST_PAIRS`.
    """
    h = lattice.spacing
    smoothed = gaussians.covariance.double() + (0.5 * h) ** 2 * torch.eye(3, dtype=torch.float64)
    reach = REACH * smoothed.diagonal(dim1=1, dim2=2).sqrt()
    x = gaussians.x.double()
    first = lattice.cells(x - reach)
    width = lattice.cells(x + reach) - first + 1
    ends = width.prod(1).cumsum(0)
    if len(x) and int(ends[-1]) > MOST_PAIRS:
        raise ValueError(
            f"the {len(x)} Gaussians overlap {int(ends[-1]):.3g} cells of {h:.3g} m; remove large Gaussians, or make "
            "dx larger or per_cell smaller"
        )
    precision = torch.linalg.inv(smoothed).float()
    local = ((x - lattice.lower) / h - 0.5).float()  # In cells, from the centre of the first one.
    field = torch.zeros(math.prod(lattice.shape))
    begin = 0
    while begin < len(x):
        reached = int(ends[begin - 1]) if begin else 0
        end = max(begin + 1, int(torch.searchsorted(ends, reached + CHUNK)))
        part = slice(begin, end)
        owner, cells = _pairs(first[part], width[part])
        d = h * (cells - local[part][owner])
        exponent = -0.5 * (d[:, None, :] @ precision[part][owner] @ d[:, :, None])[:, 0, 0]
        field.index_add_(0, lattice.numbers(cells), gaussians.opacity[part].float()[owner] * exponent.exp())
        begin = end
    return field.reshape(lattice.shape)


def _pairs(first: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """All cells [M, 3] of boxes of cells that begin at `first` [n, 3] and are `width` [n, 3] wide, and their boxes
    [M].
    """
    counts = width.prod(1)
    owner = torch.repeat_interleave(torch.arange(len(counts)), counts)
    rank = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    wide = width[owner]
    layer = wide[:, 1] * wide[:, 2]
    inner = torch.stack([rank // layer, rank % layer // wide[:, 2], rank % wide[:, 2]], 1)
    return owner, first[owner] + inner


def enclosed(opaque: Tensor) -> Tensor:
    """Cells [X, Y, Z] from which the rays along all six directions of the axes meet another opaque cell.

    The rays of PhysGaussian (Xie et al. 2024) without the parity of their crossings, which noise would change. The
    outermost layer of opaque cells is not enclosed. A cavity is, unless a ray leaves it through its opening.
    """
    inside = torch.ones_like(opaque)
    for axis in range(3):
        for turned in (False, True):
            seen = opaque.flip(axis) if turned else opaque
            before = seen.cumsum(axis, dtype=torch.int32) > seen.int()
            inside &= before.flip(axis) if turned else before
    return inside


def skin(opaque: Tensor, inside: Tensor) -> Tensor:
    """Opaque cells [X, Y, Z] that touch a cell outside, one that is neither opaque nor enclosed, by a face, edge or
    corner.
    """
    outside = ~(opaque | inside)
    near = torch.nn.functional.max_pool3d(outside[None].float(), 3, 1, 1)[0] > 0
    return opaque & near


class Interior:
    """Enclosed cells without the centre of a Gaussian and without the skin, as a region for `torch_mpm.seed.fill`.

    Attributes:
        lower, upper: corners [3] [m] of the box around the cells, float64.
        volume: [m³].
    """

    def __init__(self, gaussians: Gaussians, lattice: Lattice) -> None:
        self.lattice = lattice
        opaque = opacity_field(gaussians, lattice) >= OPAQUE
        inside = enclosed(opaque)
        free = (inside & ~skin(opaque, inside)).flatten()
        free[lattice.numbers(lattice.cells(gaussians.x))] = False
        self._free = free
        self.lower, self.upper = lattice.lower, lattice.upper
        self.volume = float(free.sum()) * lattice.spacing**3

    def inside(self, x: Tensor) -> Tensor:
        """Whether points [N, 3] [m] are in the region, bool [N]."""
        return self._free[self.lattice.numbers(self.lattice.cells(x))]
