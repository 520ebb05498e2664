"""Preconditioners of the multigrid study, in scipy; the study defines them and the counting of their cost."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from scipy import sparse

from torch_mpm.ops import implicit_apply
from torch_mpm.ops.implicit import tangent_entries

Array = Any
Linear = Callable[[Array], Array]
LIGHT = 0.2
"""Share of the heaviest node below which one is light."""
COARSEST = {2: 60, 3: 300}
"""Number of unknowns below which a level is solved."""
COARSE_DEGREE = 2
VECTORS = 0.13
"""Cost of the vectors of an iteration with node blocks, in products (cost.py)."""
ASSEMBLY = {2: 4.0, 3: 14.0}
"""Cost of assembling a matrix from the particles, in products."""
MOST = 4000
"""Maximum number of iterations."""


@dataclasses.dataclass
class System:
    """A x = b of the free components.

    Attributes:
        A: [n, n]; b: [n].
        inverse: of the node blocks [n, n].
        node, component: of each unknown [n].
        lattice, mass: coordinates [N, D] and masses [N] of all nodes.
        product: numbers that a product reads and writes.
    """

    A: Array
    b: Array
    inverse: Array
    node: Array
    component: Array
    lattice: Array
    mass: Array
    product: float


def assembled(
    blocks: Any, x: torch.Tensor, rhs: torch.Tensor, mass: torch.Tensor, inverse: torch.Tensor, tangent: torch.Tensor
) -> System:
    """The system of a linear solve."""
    grid, dim = blocks.grid, blocks.grid.dim
    lattice = np.rint((blocks.node_positions(torch.float64).numpy() - np.array(grid.lower)) / grid.dx).astype(int) + 3
    used = np.flatnonzero(mass.numpy() > 0)
    lattice = lattice[used]
    reach = 2 * grid.order + 1
    shape = lattice.max(0) + 2 * reach
    number = np.full(shape, -1)
    number[tuple(lattice.T)] = np.arange(len(used))
    colour = np.ravel_multi_index((lattice % reach).T, (reach,) * dim)
    rows, columns, values = [], [], []
    for c, place in enumerate(itertools.product(range(reach), repeat=dim)):
        # The only node of this colour within reach of each node.
        offset = (np.array(place) - lattice + grid.order) % reach - grid.order
        other = number[tuple((lattice + offset).T)]
        near = np.flatnonzero(other >= 0)
        for k in range(dim):
            direction = torch.zeros_like(rhs)
            direction[used[colour == c], k] = 1
            column = implicit_apply(blocks, x, direction, tangent, mass)[used][near]
            rows.append((near[:, None] * dim + np.arange(dim)).ravel())
            columns.append(np.repeat(other[near] * dim + k, dim))
            values.append(column.numpy().ravel())
    size = len(used) * dim
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    A = sparse.csr_matrix(entries, shape=(size, size))
    A.eliminate_zeros()
    held = inverse.numpy()[used]
    free = np.flatnonzero(held.diagonal(axis1=1, axis2=2).ravel() > 0)
    of_blocks = sparse.bsr_matrix((held, np.arange(len(used)), np.arange(len(used) + 1))).tocsr()
    product = len(x) * (2 * dim + 2 * dim**2 + tangent_entries(dim)) + 2 * size
    return System(A[free][:, free], rhs.numpy()[used].ravel()[free], of_blocks[free][:, free],
                  free // dim, free % dim, lattice, mass.numpy()[used], product)  # fmt: skip


@dataclasses.dataclass
class Preconditioner:
    """Preconditioner of one system; cost of an iteration without its product, and of the set-up, in products."""

    apply: Linear
    cost: float
    setup: float


@dataclasses.dataclass
class Level:
    """A lattice.

    Attributes:
        A: its matrix.
        smoother: approximate inverse.
        damping: one over the largest eigenvalue of the product of these.
        nodes: number of them.
        P: interpolation to the finer lattice.
    """

    A: Array
    smoother: Linear
    damping: float
    nodes: int
    P: Array = None


def node_blocks(A: Array, node: Array, component: Array, nodes: int, dim: int) -> Array:
    """Inverses of the node blocks of A as a sparse matrix."""
    entries = A.tocoo()
    own = node[entries.row] == node[entries.col]
    place = node * dim + component
    full = np.zeros((nodes, dim, dim))
    full[node[entries.row[own]], component[entries.row[own]], component[entries.col[own]]] = entries.data[own]
    missing = np.ones(nodes * dim)
    missing[place] = 1e-10 * full.reshape(nodes * dim, dim)[place, component]
    full[:, range(dim), range(dim)] += missing.reshape(nodes, dim)
    blocks = sparse.bsr_matrix((np.linalg.inv(full), np.arange(nodes), np.arange(nodes + 1))).tocsr()
    return blocks[place][:, place]


def interpolation(lattice: Array) -> tuple[Array, Array]:
    """Linear interpolation from the lattice of even nodes; and coordinates of its nodes."""
    parts = []
    for offset in itertools.product((-1, 0, 1), repeat=lattice.shape[1]):
        near = np.flatnonzero(((lattice - offset) % 2 == 0).all(1))
        parts.append((near, (lattice[near] - offset) // 2, np.full(len(near), 0.5 ** np.abs(offset).sum())))
    rows, coarse, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    nodes, columns = np.unique(coarse, axis=0, return_inverse=True)
    return sparse.csr_matrix((values, (rows, columns.ravel())), shape=(len(lattice), len(nodes))), nodes


def damping(A: Array, smoother: Linear) -> float:
    v = np.random.default_rng(0).standard_normal(A.shape[0])
    for _ in range(12):
        v = smoother(A @ (v / np.linalg.norm(v)))
    return 1 / (1.1 * float(np.linalg.norm(v)))


def levels_of(s: System, smoother: Linear) -> list[Level]:
    dim = s.lattice.shape[1]
    levels = [Level(s.A, smoother, damping(s.A, smoother), len(s.lattice))]
    node, component, lattice = s.node, s.component, s.lattice
    while levels[-1].A.shape[0] > COARSEST[dim]:
        P, lattice = interpolation(lattice)
        P = sparse.kron(P, sparse.eye(dim), format="csr")[node * dim + component]
        used = np.flatnonzero(np.asarray(P.sum(0)).ravel())
        P, node, component = P[:, used].tocsr(), used // dim, used % dim
        A = (P.T @ (levels[-1].A @ P)).tocsr()
        blocks = node_blocks(A, node, component, len(lattice), dim)
        levels.append(Level(A, blocks.dot, damping(A, blocks.dot), len(lattice), P))
    A = levels[-1].A.toarray()
    scale = 1 / np.sqrt(A.diagonal())
    inverse = np.linalg.pinv(A * scale[:, None] * scale, 1e-9, hermitian=True)
    levels[-1].smoother = (inverse * scale[:, None] * scale).dot
    return levels


def chebyshev(level: Level, r: Array, d: Array, degree: int) -> Array:
    """d after iterations of the fourth kind (Lottes 2023) with residual r."""
    step = 4 / 3 * level.damping * level.smoother(r)
    d = d + step
    for i in range(1, degree):
        r = r - level.A @ step
        own = level.damping * level.smoother(r)
        step = (2 * i - 1) / (2 * i + 3) * step + (8 * i + 4) / (2 * i + 3) * own
        d = d + step
    return d


def cycle(levels: list[Level], r: Array, degree: int) -> Array:
    level, rest = levels[0], levels[1:]
    if not rest:
        return level.smoother(r)
    d = chebyshev(level, r, np.zeros_like(r), degree)
    d = d + rest[0].P @ cycle(rest, rest[0].P.T @ (r - level.A @ d), COARSE_DEGREE)
    return chebyshev(level, r - level.A @ d, d, degree)


def added(levels: list[Level], r: Array) -> Array:
    if len(levels) == 1:
        return levels[0].smoother(r)
    P = levels[1].P
    return levels[0].smoother(r) + P @ added(levels[1:], P.T @ r)


def patches(s: System, matrix: Array, outside: Array) -> tuple[Linear, int]:
    """Inverses of a matrix on the nodes of cells with a light node, weighted by one over the root of their number on
    each side, and `outside` for the other unknowns; and the number of cells."""
    dim = s.lattice.shape[1]
    lattice = s.lattice + 1
    number = np.full(lattice.max(0) + 3, -1)
    number[tuple(lattice.T)] = np.arange(len(lattice))
    unknown = np.full((len(lattice) + 1, dim), -1)
    unknown[s.node, s.component] = np.arange(len(s.node))
    corners = np.array(list(itertools.product((0, 1), repeat=dim)))
    light = lattice[s.mass < LIGHT * s.mass.max()]
    cells = np.unique((light[:, None] - corners).reshape(-1, dim), axis=0)
    members = unknown[number[tuple((cells[:, None] + corners).reshape(-1, dim).T)]].reshape(len(cells), -1)
    inside = members >= 0
    rows = np.where(inside, members, 0)
    count = np.bincount(members[inside], minlength=len(s.b))
    size = rows.shape[1]
    A = np.asarray(matrix[np.repeat(rows, size, 1).ravel(), np.tile(rows, (1, size)).ravel()]).reshape(-1, size, size)
    A = np.where(inside[:, :, None] & inside[:, None, :], A, 0)
    A[:, range(size), range(size)] += np.where(inside, 1e-12 * A.diagonal(axis1=1, axis2=2), 1)
    weight = np.where(inside, 1 / np.sqrt(np.maximum(count, 1))[rows], 0)
    inverse = weight[:, :, None] * np.linalg.inv(A) * weight[:, None, :]

    def apply(r: Array) -> Array:
        z = np.bincount(rows.ravel(), np.einsum("pij,pj->pi", inverse, r[rows]).ravel(), minlength=len(r))
        return np.where(count > 0, z, outside @ r)

    return apply, len(cells)


def correlation(s: System) -> Array:
    """The mean of the components of A between two nodes, for each of them, with a diagonal of one [n, n]."""
    entries = s.A.tocoo()
    same = s.component[entries.row] == s.component[entries.col]
    rows, columns = entries.row[same], entries.col[same]
    size = (len(s.lattice),) * 2
    places = s.node[rows], s.node[columns]
    mean = sparse.csr_matrix((entries.data[same], places), size)
    mean.data /= sparse.csr_matrix((np.ones(len(rows)), places), size).data
    scale = 1 / np.sqrt(np.maximum(mean.diagonal(), 1e-300))
    values = np.asarray(mean[places]).ravel() * scale[places[0]] * scale[places[1]]
    return sparse.csr_matrix((values, (rows, columns)), s.A.shape)


def root(s: System) -> Array:
    """B^(-1/2) [n, n]."""
    nodes, dim = s.lattice.shape
    entries = s.inverse.tocoo()
    full = np.zeros((nodes, dim, dim))
    full[s.node[entries.row], s.component[entries.row], s.component[entries.col]] = entries.data
    values, vectors = np.linalg.eigh(full)
    roots = vectors * np.sqrt(np.maximum(values, 0))[:, None, :] @ vectors.swapaxes(1, 2)
    place = s.node * dim + s.component
    return sparse.bsr_matrix((roots, np.arange(nodes), np.arange(nodes + 1))).tocsr()[place][:, place]


def smoother_of(s: System, name: str) -> tuple[Linear, float, float]:
    """Node blocks or patches, the numbers of the patches, and their set-up."""
    dim, matrix = s.lattice.shape[1], ASSEMBLY[s.lattice.shape[1]]
    if "scalar" in name:
        half = root(s)
        apply, cells = patches(s, correlation(s), sparse.eye(len(s.b)))
        return lambda r: half @ apply(half @ r), cells * 2**dim * (2**dim + 1) / 2, matrix / 2 / dim
    if "patches" in name:
        apply, cells = patches(s, s.A, s.inverse)
        return apply, cells * dim * 2**dim * (dim * 2**dim + 1) / 2, matrix / 2
    return s.inverse.dot, 0.0, 0.0


def preconditioner(s: System, name: str) -> Preconditioner:
    dim = s.lattice.shape[1]
    matrix = ASSEMBLY[dim]
    smoother, numbers, setup = smoother_of(s, name)
    extra = numbers / s.product
    if not name.startswith(("V", "additive")):
        return Preconditioner(smoother, VECTORS + extra, setup)
    levels = levels_of(s, smoother)
    vectors = sum(4 * level.nodes * dim for level in levels) + levels[-1].A.shape[0] ** 2
    if name.startswith("additive"):
        own = sum(level.nodes * dim * (dim + 1) / 2 for level in levels[1:])
        cost = VECTORS + extra + (vectors + own) / s.product
        return Preconditioner(lambda r: added(levels, r), cost, setup + 1.5 * (len(levels) - 1) + matrix / 2**dim)
    degree = int(name[2])
    stencils = sum(2 * COARSE_DEGREE * level.nodes * 5**dim * dim**2 for level in levels[1:-1])
    cost = 2 * degree * (1 + extra) + VECTORS * (1 + degree) + (vectors + stencils) / s.product
    return Preconditioner(lambda r: cycle(levels, r, degree), cost, setup + matrix)


def iterations(s: System, p: Preconditioner) -> Iterator[tuple[Array, float]]:
    """Conjugate gradients: the solution and √(r · B⁻¹ r), until the curvature is not positive."""
    x, r = np.zeros_like(s.b), s.b
    z = direction = p.apply(r)
    for _ in range(MOST):
        q = s.A @ direction
        curvature, square = direction @ q, r @ z
        if not curvature > 0:
            return
        x, r = x + square / curvature * direction, r - square / curvature * q
        yield x, float(np.sqrt(max(r @ (s.inverse @ r), 0)))
        z = p.apply(r)
        direction = z + (r @ z) / square * direction
