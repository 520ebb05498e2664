"""The operator of heat as a dense matrix, and arguments of its solver."""

import dataclasses

import torch
from helpers import Particles, random_particles
from oracle import heat as reference
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.ops import heat_operator, scatter


@dataclasses.dataclass
class Heat:
    """Random particles with everything that a heat step takes."""

    blocks: mpm.Blocks
    x: Tensor
    conductance: Tensor
    heat_capacity: Tensor
    theta: Tensor
    source: Tensor
    exchange: Tensor
    fixed: Tensor
    dt: Tensor

    def solve(self, boundaries: bool = True, **options: object) -> mpm.HeatSolve:
        values: dict = {"theta": self.theta, "dt": self.dt, "source": self.source, "tolerance": 0.0}
        if boundaries:
            values |= {"exchange": self.exchange, "fixed": self.fixed}
        values |= options
        return mpm.heat_cg(self.blocks, self.x, self.conductance, self.heat_capacity, **values)

    def scenes(self, nodes: Tensor) -> Tensor:
        """Sums over the nodes of each scene."""
        scene = self.blocks.node_scene().long()
        sums = nodes.new_zeros(self.blocks.grid.scenes + 1)
        return sums.index_add(0, torch.where(scene < 0, self.blocks.grid.scenes, scene), nodes)[:-1]


def heat(
    dim: int,
    kernel: str = "quadratic",
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
    far: bool = False,
    **options: object,
) -> Heat:
    """`far`: the first particle of every scene lies far away from the others."""
    p = random_particles(dim, kernel, device=device, **({"sizes": (60, 0, 40), "dx": 0.25} | options))
    if far:
        p = far_apart(p)
    blocks, P = p.blocks(), p.x.shape[0]
    generator = torch.Generator().manual_seed(11)

    def uniform(count: int) -> Tensor:
        return torch.rand(count, generator=generator, dtype=torch.float64).to(device)

    N = blocks.node_count
    order = blocks.grid.scenes
    values = Heat(
        blocks,
        p.x,
        conductance=0.02 * (0.1 + uniform(P)),
        heat_capacity=scatter(blocks, p.x, p.mass[:, None])[:, 0],
        theta=uniform(N) - 0.5,
        source=uniform(N) - 0.5,
        exchange=torch.where(uniform(N) < 0.3, 0.3 * uniform(N), 0),
        fixed=uniform(N) < 0.1,
        dt=0.5 + uniform(order),
    )
    values.source = torch.where(values.heat_capacity > 0, values.source, 0)
    tensors = {f.name: getattr(values, f.name) for f in dataclasses.fields(values) if f.name != "blocks"}
    cast = {k: t.to(dtype) if t.is_floating_point() else t for k, t in tensors.items()}
    return Heat(blocks=p.grid.activate(cast["x"], p.scene), **cast)


def far_apart(p: Particles) -> Particles:
    """With the first particle of every scene at the end of a wider domain, its nodes all in one block."""
    grid, dx = p.grid, p.grid.dx
    cells = 200 if grid.dim == 2 else 44
    corner = torch.tensor(grid.lower) + (cells - 3 + (grid.order - 1) / 2 + 0.25) * dx
    number = torch.zeros(p.x.shape[0], dtype=torch.long) if p.scene is None else p.scene.long().cpu()
    order = torch.argsort(number, stable=True)
    first = order[torch.diff(number[order], prepend=torch.tensor([-1])) > 0]
    x = p.x.clone()
    x[first.to(x.device)] = corner.to(x)
    upper = tuple(low + (cells + 4) * dx for low in grid.lower)
    wide = mpm.Grid(
        dx=dx, lower=grid.lower, upper=upper, scenes=grid.scenes, kernel=grid.kernel, deterministic=grid.deterministic
    )
    return dataclasses.replace(p, grid=wide, x=x)


def dense_operator(h: Heat) -> Tensor:
    """H as a matrix, one column after another, through the op."""
    N = h.blocks.node_count
    columns = torch.eye(N, dtype=h.x.dtype, device=h.x.device)
    return torch.stack([heat_operator(h.blocks, h.x, h.conductance, c) for c in columns], 1)


def dense_increment(h: Heat, boundaries: bool = True) -> Tensor:
    """The increment by a dense solve with H from the reference, in float64 on the CPU."""
    grid, N = h.blocks.grid, h.blocks.node_count
    tensors = {f.name: getattr(h.blocks, f.name) for f in dataclasses.fields(h.blocks)[1:]}
    blocks = mpm.Blocks(grid, **{name: None if t is None else t.cpu() for name, t in tensors.items()})
    x, conductance, heat_capacity, theta, source, exchange, dt = (
        t.cpu().double() for t in (h.x, h.conductance, h.heat_capacity, h.theta, h.source, h.exchange, h.dt)
    )
    operator = reference.HeatOperator.at(blocks, x, conductance)
    H = torch.stack([operator.apply(c) for c in torch.eye(N, dtype=torch.float64)], 1)
    if not boundaries:
        exchange = torch.zeros_like(exchange)
    free = heat_capacity > 0
    if boundaries:
        free &= ~h.fixed.cpu()
    A = torch.diag(heat_capacity / dt[blocks.node_scene().clamp_min(0).long()] + exchange) + H
    b = source - H @ theta - exchange * theta
    d = torch.zeros(N, dtype=torch.float64)
    d[free] = torch.linalg.solve(A[free][:, free], b[free])
    return d


def check_replay(h: Heat) -> None:
    """A solve that a CUDA graph replays is that of the current contents of its inputs."""
    h.solve(tolerance=1e-6)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        solve = h.solve(tolerance=1e-6)
    for factor in (1.0, 0.25):
        h.theta.mul_(factor)
        graph.replay()
        expected = h.solve(tolerance=1e-6)
        torch.testing.assert_close(solve.increment, expected.increment, rtol=1e-4, atol=1e-6)


def op_arguments(h: Heat) -> list:
    return [
        h.x, h.conductance, h.heat_capacity, h.theta, h.source, h.exchange, h.fixed, h.dt, 0.5, None, 1e-8, 0.0, None,
        50, 0, 1e-8, *h.blocks.packed,
    ]  # fmt: skip
