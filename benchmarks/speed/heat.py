"""Times of the heat solve: `python -m benchmarks.speed.heat [--device cuda]`. 3-D, quadratic kernel, float32.

The cost of an iteration beside a scalar P2G and G2P; a whole solve at r = 0.01; twenty iterations (ten on the CPU)
beside conjugate gradients on the assembled matrix: on CUDA a CSR matrix times vector of torch (cuSPARSE) in a loop
without synchronisation and, where cupy is installed, `cupyx.scipy.sparse.linalg.cg`, the assembly not counted; on the
CPU scipy's `cg`, assembly counted. All with the preconditioner of Jacobi. Whole solves to 1e-6 of the first residual at
large r by conjugate gradients and multigrid, random temperatures. On CUDA also 1024 scenes of 4913 particles in one
call, beside a call for each. Eight jittered particles per cell, sorted by block.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops import gather, heat_operator, scatter

from .. import common, regressions
from ..heat_matrix import node_gradients
from ..stability.heat import assembled
from .timing import Clock

CELLS = {"cpu": 24, "cuda": 100}
SCENES, SCENE_SIDE, SCENE_CELLS = 1024, 17, 32
LARGE = (1e2, 1e4, 1e6)
CHUNK = 1_000_000
"""Number of particles whose share of the matrix is added at once."""


class Problem:
    """A block of side³ particles at two per cell and axis, in each of `scenes` scenes of cells³ cells."""

    def __init__(self, cells: int, device: str, side: int | None = None, scenes: int = 1) -> None:
        self.dx, side = 1.0 / cells, side or 2 * cells
        axis = (torch.arange(side, device=device) + 0.5) * self.dx / 2
        x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3).repeat(scenes, 1)
        x = x + 0.2 * self.dx * (torch.rand_like(x) - 0.5)
        grid = mpm.Grid(dx=self.dx, lower=(0, 0, 0), upper=(1, 1, 1), scenes=scenes)
        scene = None
        if scenes == 1:
            x = x[grid.activate(x).index.long()]
        else:
            scene = torch.arange(scenes, dtype=torch.int32, device=device).repeat_interleave(side**3)
        self.x = x.T.contiguous().T
        self.blocks = grid.activate(self.x, scene)
        self.conductance = torch.full_like(self.x[:, 0], self.dx**3 / 8)
        self.heat_capacity = scatter(self.blocks, self.x, self.conductance[:, None])[:, 0]
        self.theta = torch.rand_like(self.heat_capacity)

    def solve(self, r: float, **options: Any) -> mpm.HeatSolve:
        dt = r * self.dx**2
        return mpm.heat_cg(self.blocks, self.x, self.conductance, self.heat_capacity, self.theta, dt, **options)


def csr(p: Problem) -> Tensor:
    """The nonzeros of H on the nodes with heat capacity as a CSR matrix."""
    N, dim, width = p.blocks.node_count, 3, 5
    values = p.x.new_zeros(N * width**dim)
    offsets = list(itertools.product(range(3), repeat=dim))
    for first in range(0, len(p.x), CHUNK):
        part = slice(first, first + CHUNK)
        rows, gradient = node_gradients(p.blocks, p.x[part])
        for (i, a), (j, b) in itertools.product(enumerate(offsets), repeat=2):
            entry = 0
            for s, t in zip(a, b, strict=True):
                entry = entry * width + t - s + 2
            value = p.conductance[part] * (gradient[:, i] * gradient[:, j]).sum(1)
            values.index_add_(0, rows[:, i] * width**dim + entry, value)
    used = int((p.blocks.block >= 0).sum()) * p.blocks.grid.nodes_per_block
    row = torch.arange(N, dtype=torch.float32, device=p.x.device)[:, None] + 1
    dense = p.blocks.to_dense(row)[0, ..., 0].round().int() - 1
    padded = torch.nn.functional.pad(dense, (2,) * (2 * dim), value=-1)
    at = p.blocks.node_indices()[:used]
    columns = torch.empty(used, width**dim, dtype=torch.int32, device=p.x.device)
    for entry, shift in enumerate(itertools.product(range(width), repeat=dim)):
        columns[:, entry] = padded[tuple((at[:, k] + shift[k]) for k in range(dim))]
    some = p.heat_capacity[:used] > 0
    table = values[: used * width**dim].reshape(used, -1)
    kept = (table != 0) & (columns >= 0) & some[:, None]
    start = torch.nn.functional.pad(kept.sum(1)[some].cumsum(0), (1, 0)).int()
    number = (some.cumsum(0) - 1).int()
    size = len(start) - 1
    return torch.sparse_csr_tensor(start, number[columns[kept].long()], table[kept], (size, size))


def csr_cg(H: Tensor, weight: Tensor, diagonal: Tensor, b: Tensor, iterations: int) -> Tensor:
    """Conjugate gradients on (diag(weight) + H) d = b with the preconditioner of Jacobi, nothing synchronised."""
    d, r, inverse = torch.zeros_like(b), b.clone(), 1 / (weight + diagonal)
    p = inverse * r
    rz = r.dot(p)
    for _ in range(iterations):
        Ap = torch.addcmul(H @ p, weight, p)
        alpha = rz / p.dot(Ap)
        d, r = torch.addcmul(d, alpha, p), torch.addcmul(r, -alpha, Ap)
        z = inverse * r
        before, rz = rz, r.dot(z)
        p = torch.addcmul(z, rz / before, p)
    return d


def wall(run: Callable[[], object], clock: Clock, repeats: int = 3) -> float:
    """Least wall clock of a program that is synchronised once [ms]."""
    times = []
    for _ in range(repeats):
        clock.synchronize()
        begin = time.perf_counter()
        run()
        clock.synchronize()
        times.append((time.perf_counter() - begin) * 1e3)
    return min(times)


def one_scene(p: Problem, clock: Clock) -> dict[str, Any]:
    """Iterations and transfers of one large scene."""

    def fixed(count: int) -> float:
        return clock.op(lambda: p.solve(1.0, tolerance=0.0, max_iterations=count)).ms

    start, ten = fixed(0), fixed(10)
    mass, nodes = p.conductance[:, None], p.theta[:, None]
    return {
        "particles": len(p.x),
        "p2g": clock.op(lambda: scatter(p.blocks, p.x, mass)).ms,
        "g2p": clock.op(lambda: gather(p.blocks, p.x, nodes)).ms,
        "start": start,
        "iteration": (ten - start) / 10,
        "solve": clock.op(lambda: p.solve(0.01)).ms,
        "iterations": int(p.solve(0.01).iterations),
        "chebyshev": clock.op(lambda: p.solve(0.01, method="chebyshev")).ms,
    }


def cupy_cg(H: Tensor, weight: Tensor, diagonal: Tensor, b: Tensor) -> Callable[[int], Tensor] | None:
    """The same by cupyx for a number of iterations, or None without cupy."""
    try:
        import cupy
        from cupyx.scipy import sparse
        from cupyx.scipy.sparse.linalg import LinearOperator, cg
    except ImportError:
        return None
    values, columns, start = (cupy.asarray(t) for t in (H.values(), H.col_indices(), H.crow_indices()))
    A = (sparse.csr_matrix((values, columns, start), shape=H.shape) + sparse.diags(cupy.asarray(weight))).tocsr()
    inverse, right = 1 / cupy.asarray(weight + diagonal), cupy.asarray(b)
    M = LinearOperator(A.shape, matvec=lambda r: inverse * r, dtype=A.dtype)

    def solve(iterations: int) -> Tensor:
        with cupy.cuda.Stream.from_external(torch.cuda.current_stream()):
            return torch.as_tensor(cg(A, right, rtol=0.0, maxiter=iterations, M=M)[0], device=b.device)

    return solve


def beside_csr(p: Problem, clock: Clock, count: int) -> list[dict[str, Any]]:
    """The same number of iterations with the assembled matrix, on CUDA."""
    H = csr(p)
    some = p.heat_capacity > 0
    weight = p.heat_capacity[some] / p.dx**2
    b = -(H @ p.theta[some])
    diagonal = heat_operator(p.blocks, p.x, p.conductance, None)[some]

    def ours(count: int) -> mpm.HeatSolve:
        return p.solve(1.0, tolerance=0.0, max_iterations=count)

    ms, solution = clock.op(lambda: ours(count)).ms, ours(40).increment[some]

    def row(peer: str, ms_of_peer: float, solution_of_peer: Tensor) -> dict[str, Any]:
        difference = float((solution_of_peer - solution).norm() / solution.norm())
        return {
            "peer": peer,
            "count": count,
            "nonzeros": H.values().numel(),
            "peer_ms": ms_of_peer,
            "ms": ms,
            "difference": difference,
        }

    rows = [
        row(
            "torch CSR in a loop",
            clock.op(lambda: csr_cg(H, weight, diagonal, b, count)).ms,
            csr_cg(H, weight, diagonal, b, 40),
        )
    ]
    if solve := cupy_cg(H, weight, diagonal, b):
        rows.append(row("cupyx cg", wall(lambda: solve(count), clock), solve(40)))
    return rows


def beside_scipy(p: Problem, clock: Clock, count: int) -> dict[str, Any]:
    """The same number of iterations of scipy's cg, assembly included."""
    from scipy import sparse
    from scipy.sparse.linalg import cg

    assembly = wall(lambda: assembled(p.blocks, p.x, p.conductance), clock, 1)
    some = (p.heat_capacity > 0).numpy()
    H = assembled(p.blocks, p.x, p.conductance)[some][:, some]
    A = (H + sparse.diags(p.heat_capacity.double().numpy()[some] / p.dx**2)).tocsr().astype("float32")
    b = -(H @ p.theta.numpy()[some])
    M = sparse.diags(1 / A.diagonal())
    iterations = wall(lambda: cg(A, b, rtol=0.0, maxiter=count, M=M), clock)
    ours = clock.op(lambda: p.solve(1.0, tolerance=0.0, max_iterations=count))
    difference = (
        cg(A, b, rtol=0.0, maxiter=40, M=M)[0] - p.solve(1.0, tolerance=0.0, max_iterations=40).increment.numpy()[some]
    )
    return {
        "peer": "scipy cg",
        "count": count,
        "nonzeros": int(A.nnz),
        "peer_ms": assembly + iterations,
        "peer_without_assembly_ms": iterations,
        "ms": ours.ms,
        "difference": float((difference**2).sum() ** 0.5 / p.solve(1.0).increment.norm()),
    }


def large_steps(p: Problem, clock: Clock) -> list[dict[str, Any]]:
    """Whole solves at large diffusion numbers by both methods."""
    rows = []
    for r in LARGE:
        row: dict[str, Any] = {"r": r}
        for method in ("cg", "multigrid"):

            def solve(r: float = r, method: str = method) -> mpm.HeatSolve:
                return p.solve(r, tolerance=0.0, relative_tolerance=1e-6, max_iterations=2000, method=method)

            row[method] = wall(solve, clock, 2)
            row[f"{method} iterations"] = int(solve().iterations)
        rows.append(row)
    return rows


def many_scenes(device: str, clock: Clock, scenes: int) -> list[dict[str, Any]]:
    """A batch in one call, beside one call per scene."""
    batch, alone = (Problem(SCENE_CELLS, device, SCENE_SIDE, count) for count in (scenes, 1))
    rows = []
    for r in (0.01, 1.0):
        together = wall(lambda r=r: batch.solve(r), clock)
        loop = wall(lambda r=r: [alone.solve(r) for _ in range(scenes)], clock)
        count = batch.solve(r).iterations.float().mean()
        rows.append({"r": r, "iterations": float(count), "together": together, "loop": loop, "ratio": loop / together})
    return rows


def text(result: dict[str, Any]) -> str:
    """Tables of a result in Markdown."""
    one = result["one"]
    lines = ["# Heat solve", "", common.describe(result["environment"]), "", f"{one['particles']} particles, ms:", ""]
    header = ("scalar P2G", "scalar G2P", "before the first iteration", "iteration", "iteration / (P2G + G2P)")
    lines += [common.table(header, [(*(one[k] for k in ("p2g", "g2p", "start", "iteration")), ratio(one))]), ""]
    header = ("whole solve at r = 0.01", "iterations", "by Chebyshev")
    lines += [common.table(header, [(one["solve"], one["iterations"], one["chebyshev"])]), ""]
    header = ("peer", "iterations", "nonzeros", "peer ms", "heat_cg ms", "times faster", "relative difference")
    keys = ("peer", "count", "nonzeros", "peer_ms", "ms")
    peers = [(*(p[k] for k in keys), p["peer_ms"] / p["ms"], p["difference"]) for p in result["peers"]]
    lines += [common.table(header, peers), ""]
    lines += ["Whole solves to 1e-6 of the first residual, wall clock in ms:", ""]
    header = ("r", "cg", "iterations", "multigrid", "iterations")
    names = ("r", "cg", "cg iterations", "multigrid", "multigrid iterations")
    lines += [common.table(header, [[row[k] for k in names] for row in result["large"]]), ""]
    if result["scenes"]:
        lines += [f"{SCENES} scenes of {SCENE_SIDE**3} particles, wall clock in ms:", ""]
        header = ("r", "iterations", "one call", "a call per scene", "times faster")
        rows = [[row[k] for k in ("r", "iterations", "together", "loop", "ratio")] for row in result["scenes"]]
        lines += [common.table(header, rows)]
    return "\n".join(lines)


def ratio(one: dict[str, Any]) -> float:
    return one["iteration"] / (one["p2g"] + one["g2p"])


def timed(result: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Milliseconds of transfers, iterations and whole solves, for `regressions`."""
    one = result["one"]
    for key in ("p2g", "g2p", "iteration", "solve", "chebyshev"):
        yield f"{key}, {one['particles']} particles", one[key]
    for row in result["large"]:
        yield from ((f"{key}, r = {row['r']:g}, {one['particles']} particles", row[key]) for key in ("cg", "multigrid"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--quick", action="store_true", help="a small size, to see that it works")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    device, quick = arguments.device, arguments.quick
    if device == "cpu":
        common.use_all_cores()
    clock = Clock(device, **({"samples": 3, "budget": 0.1} if quick else {"samples": 10, "budget": 0.5}))
    with clock, torch.no_grad():
        p = Problem(8 if quick else CELLS[device], device)
        result: dict[str, Any] = {"environment": common.environment(device), "one": one_scene(p, clock)}
        result["large"] = large_steps(p, clock)
        result["scenes"] = [] if device == "cpu" else many_scenes(device, clock, 16 if quick else SCENES)
        result["peers"] = [beside_scipy(p, clock, 10)] if device == "cpu" else beside_csr(p, clock, 20)
    print(text(result))
    name = f"heat_{common.slug(result['environment']['device'])}"
    regressions.show(name, result, timed)
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
