"""Scenes of obstacles and walls that take impulses, and the momentum of particles."""

import torch
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.laws import named

F64 = torch.float64
DT, STEPS = 1e-3, 8
WALLS = {
    "none": None,
    "separate": mpm.Walls("separate"),
    "friction": mpm.Walls("separate", friction=0.3),
    "sticky": mpm.Walls("sticky"),
    "slip": mpm.Walls("slip"),
    "mirror": mpm.Walls("mirror"),
}
LAWS = named("neo_hookean", "sand", "fluid", "custom")
GRAVITY = (1.0, -9.8, 0.5)


def obstacles(dim: int, in_torch: bool = False) -> list:
    """Several overlapping obstacles of all kinds; some begin or end during the run."""
    at = (0.5, 0.25, 0.5)[:dim]
    turning = 3.0 if dim == 2 else (1.0, -2.0, 3.0)
    ball = mpm.Sphere(at, 0.15, friction=0.2, velocity=(0.1, 0.2, -0.1)[:dim], angular_velocity=turning)
    box = mpm.Box(at, (0.4, 0.2, 0.3)[:dim], kind="slip", start=2.5 * DT)
    plane = mpm.Plane((0.5, 0.1, 0.5)[:dim], (0.3, 1.0, 0.2)[:dim], kind="sticky", end=4.5 * DT)
    blob = mpm.SDF(lambda x: x.norm(dim=1) - 0.12, (0.3, 0.3, 0.4)[:dim], friction=0.4)
    return [ball, *([blob] if in_torch else []), box, plane]


def cloud(dim: int, device: str = "cpu", scenes: int = 1, count: int = 120, dtype: torch.dtype = F64) -> mpm.State:
    g = torch.Generator().manual_seed(4)
    P = count * scenes
    x = 0.05 + 0.9 * torch.rand(P, dim, generator=g, dtype=F64)
    v = 3 * torch.randn(P, dim, generator=g, dtype=F64)
    mass, C = 0.1 + torch.rand(P, generator=g, dtype=F64), torch.randn(P, dim, dim, generator=g, dtype=F64)
    scene = None if scenes == 1 else torch.arange(P, dtype=torch.int32) % scenes
    state = mpm.State(x=x, v=v, mass=mass, volume=torch.full((P,), 1e-3, dtype=F64), C=C, scene=scene)
    return state.to(device, dtype)


def one_by_one(step: mpm.Step, state: mpm.State, n: int = STEPS, dt: float | Tensor = DT) -> mpm.State:
    for _ in range(n):
        state = step(state, dt)
    return state


def cross(a: Tensor, b: Tensor) -> Tensor:
    if a.shape[-1] == 3:
        return torch.linalg.cross(a, b.expand_as(a))
    return (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])[..., None]


def by_scene(values: Tensor, state: mpm.State, scenes: int) -> Tensor:
    scene = torch.zeros(len(state), dtype=torch.int64) if state.scene is None else state.scene.long().cpu()
    return torch.zeros(scenes, values.shape[1], dtype=F64).index_add(0, scene, values.detach().cpu().double())


def momentum(state: mpm.State, grid: mpm.Grid) -> tuple[Tensor, Tensor]:
    """Linear and angular [B, ...], with that of the affine field (Jiang et al. 2015)."""
    m, x, v = state.mass[:, None], state.x, state.v
    C = torch.zeros(*x.shape, x.shape[1]).to(x) if state.C is None else state.C
    planes = [(0, 1)] if x.shape[1] == 2 else [(1, 2), (2, 0), (0, 1)]
    spin = torch.stack([C[:, j, i] - C[:, i, j] for i, j in planes], 1) / grid.inverse_inertia
    return by_scene(m * v, state, grid.scenes), by_scene(m * (cross(x, v) + spin), state, grid.scenes)
