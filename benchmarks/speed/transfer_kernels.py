"""Times of the CUDA transfer kernels: `python benchmarks/speed/transfer_kernels.py --sizes 100 200 --kernel quadratic`.

Each op is captured in a CUDA graph, so that the host is excluded, and replayed; the median is reported. Particles lie 8
per cell, float32, 3-D, in the memory order named: `lattice` and `random` positions in order of block and cell, `drift`
after a random motion of up to 0.3 cells, `shuffled` in no order at all.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable

import torch
from torch import Tensor

import torch_mpm as mpm

REPLAYS = 30


def milliseconds(run: Callable[[], object]) -> float:
    """Median time of one replay of `run`."""
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        for _ in range(3):
            run()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    times = []
    for _ in range(REPLAYS):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        graph.replay()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def particle_order(grid: mpm.Grid, x: Tensor) -> Tensor:
    """Indices that sort particles by block and by cell inside it."""
    node = torch.floor(x / grid.dx + 2.5).long()
    block, cell = node // 4, node % 4
    key = (block[:, 0] * grid.blocks[1] + block[:, 1]) * grid.blocks[2] + block[:, 2]
    return torch.argsort(key * 64 + cell[:, 0] * 16 + cell[:, 1] * 4 + cell[:, 2])


def positions(grid: mpm.Grid, side: int, order: str) -> Tensor:
    """side³ positions in the unit cube, 8 per cell, as structure of arrays."""
    generator = torch.Generator("cuda").manual_seed(0)
    n = side**3
    jitter = torch.rand(n, 3, generator=generator, device="cuda")
    if order == "lattice":
        i = torch.arange(n, device="cuda")
        x = (torch.stack([i // side**2, i // side % side, i % side], 1) + 0.1 + 0.8 * jitter) / side
    else:
        x = jitter
    if order != "shuffled":
        x = x[particle_order(grid, x)]
    if order == "drift":
        x = (x + 0.3 * grid.dx * (2 * torch.rand(n, 3, generator=generator, device="cuda") - 1)).clamp(0, 1)
    return x.T.contiguous().T


def soa(*shape: int) -> Tensor:
    """Random [P, ...] values, the particle index contiguous in memory."""
    return torch.randn(*shape[1:], shape[0], device="cuda").movedim(-1, 0)


def measure(side: int, kernel: str, order: str) -> dict[str, float]:
    dx = 2 / side
    grid = mpm.Grid(dx=dx, lower=(0, 0, 0), upper=(1, 1, 1), kernel=kernel)
    fixed = mpm.Grid(dx=dx, lower=(0, 0, 0), upper=(1, 1, 1), kernel=kernel, deterministic=True)
    x = positions(grid, side, order)
    P = x.shape[0]
    mass, v, C, stress, volume = soa(P).abs(), soa(P, 3), soa(P, 3, 3), soa(P, 3, 3), soa(P).abs()
    blocks, fixed_blocks = grid.activate(x), fixed.activate(x)
    nodes = mpm.p2g(blocks, x, mass, v, C)
    velocity = nodes[:, 1:]
    op, topology, scale = torch.ops.torch_mpm, blocks.packed, grid.inverse_inertia
    runs: dict[str, Callable[[], object]] = {
        "zero nodes": lambda: torch.zeros_like(nodes),
        "activate": lambda: grid.activate(x),
        "activate, deterministic": lambda: fixed.activate(x),
        "p2g": lambda: mpm.p2g(blocks, x, mass, v, C),
        "p2g, stress": lambda: mpm.p2g(blocks, x, mass, v, C, stress, volume, 1e-4),
        "p2g, deterministic": lambda: mpm.p2g(fixed_blocks, x, mass, v, C),
        "g2p": lambda: mpm.g2p(blocks, x, velocity),
        "p2g backward, stress": lambda: op.p2g_backward(
            nodes, x, mass, v, C, stress, volume, None, 1e-4, 0, 127, *topology
        ),
        "g2p backward, nodes": lambda: op.scatter(x, v, C, None, scale, *topology),
        "g2p backward, positions": lambda: op.position_gradient(x, v, C, None, velocity, scale, *topology),
    }
    return {name: milliseconds(run) for name, run in runs.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 200], help="particles along a side of the cube")
    parser.add_argument("--kernel", nargs="+", default=["quadratic"])
    parser.add_argument("--order", nargs="+", default=["lattice", "random", "drift", "shuffled"])
    arguments = parser.parse_args()
    print(torch.cuda.get_device_name(), torch.__version__)
    for kernel in arguments.kernel:
        for side in arguments.sizes:
            columns = {order: measure(side, kernel, order) for order in arguments.order}
            print(f"\n{kernel}, {side**3 / 1e6:g} M particles: ms (G particles/s)")
            print(f"{'':26}" + "".join(f"{order:>18}" for order in columns))
            for name in columns[arguments.order[0]]:
                cells = "".join(f"{c[name]:>10.4f} ({side**3 / c[name] * 1e-6:5.1f})" for c in columns.values())
                print(f"{name:26}{cells}")


if __name__ == "__main__":
    main()
