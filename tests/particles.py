"""Random particles that several tests use."""

import dataclasses

import torch
from torch import Tensor

import torch_mpm as mpm


@dataclasses.dataclass
class Particles:
    grid: mpm.Grid
    x: Tensor
    mass: Tensor
    v: Tensor
    C: Tensor
    stress: Tensor
    volume: Tensor
    scene: Tensor | None

    def blocks(self) -> mpm.Blocks:
        return self.grid.activate(self.x, self.scene)

    def to(self, device: str, dtype: torch.dtype) -> "Particles":
        def move(t: Tensor | None) -> Tensor | None:
            return None if t is None else t.to(device=device, dtype=dtype if t.is_floating_point() else None)

        tensors = {f.name: move(getattr(self, f.name)) for f in dataclasses.fields(self) if f.name != "grid"}
        return Particles(grid=self.grid, **tensors)


def random_particles(
    dim: int,
    kernel: str = "quadratic",
    sizes: tuple[int, ...] = (11, 0, 6),
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
    dx: float = 0.1,
    extent: float = 1.0,
    shuffled: bool = True,
    **grid_options: object,
) -> Particles:
    """Ragged scenes (one may be empty) with values of order one, positions anywhere inside the domain."""
    generator = torch.Generator().manual_seed(7)
    lower, upper = (-0.2,) * dim, (-0.2 + extent,) * dim
    grid = mpm.Grid(dx=dx, lower=lower, upper=upper, scenes=len(sizes), kernel=kernel, **grid_options)
    P = sum(sizes)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x = torch.tensor(lower) + extent * torch.rand(P, dim, generator=generator, dtype=torch.float64)
    scene = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes)).int()
    if shuffled:
        scene = scene[torch.randperm(P, generator=generator)]
    particles = Particles(
        grid=grid,
        x=x,
        mass=0.5 + torch.rand(P, generator=generator, dtype=torch.float64),
        v=normal(P, dim),
        C=normal(P, dim, dim),
        stress=normal(P, dim, dim),
        volume=0.5 + torch.rand(P, generator=generator, dtype=torch.float64),
        scene=None if len(sizes) == 1 else scene,
    )
    return particles.to(device, dtype)


def relative_error(value: Tensor, reference: Tensor) -> float:
    value, reference = value.detach().cpu().double(), reference.detach().cpu().double()
    return float((value - reference).norm() / reference.norm().clamp_min(1e-300))
