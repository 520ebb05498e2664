"""Mirrored walls against the symmetric problem that they stand for."""

import math

import pytest
import torch
from pairs import in_pairs
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.implicit import Implicit

DX = 0.125
INTEGRATORS = {"explicit": ("explicit", 1e-12), "implicit": (Implicit(1e-12), 1e-9)}
"""Integrators, and how well they solve the motion."""


def particles(dim: int, at: float, device: str, spin: float = 1.0, count: int = 60) -> mpm.State:
    """Random particles above the plane y = `at`, many of them close to it, with velocities, affine fields, strain."""
    generator = torch.Generator().manual_seed(4)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    x = 0.3 + 0.5 * random(count, dim)
    x[:, 1] = at + 3 * DX * random(count) ** 2
    F = torch.eye(dim, dtype=torch.float64) + 0.1 * (random(count, dim, dim) - 0.5)
    state = mpm.State(
        x=x, v=random(count, dim) - 0.5, mass=0.5 + random(count), volume=1e-3 * (0.5 + random(count)),
        C=spin * (random(count, dim, dim) - 0.5), F=F,
    )  # fmt: skip
    return state.to(device)


def reflected(state: mpm.State, at: float) -> mpm.State:
    """The images of particles in the plane y = `at`."""
    assert state.C is not None and state.F is not None
    R = torch.ones(state.x.shape[1], dtype=state.x.dtype, device=state.x.device)
    R[1] = -1
    shift = torch.zeros_like(R)
    shift[1] = 2 * at
    both = R[:, None] * R
    return state.replace(x=shift + R * state.x, v=R * state.v, C=both * state.C, F=both * state.F)


@pytest.mark.parametrize("at", [0.5, 0.5625], ids=["on a node", "between two nodes"])
@pytest.mark.parametrize(
    *in_pairs(
        {("stress_form", "integrator"): [("mls", "explicit"), ("gradient", "implicit")]},
        transfer=["apic", "flip"],
        dim=[2, 3],
        kernel=["quadratic", "cubic"],
    )
)
def test_a_mirror_is_half_of_a_symmetric_problem(device, dim, kernel, at, transfer, stress_form, integrator):
    """The same particles with their images on a lattice without walls move alike, step after step."""
    grid = mpm.Grid(DX, (0.0,) * dim, (1.0,) * dim, kernel=kernel)
    options = {"transfer": transfer, "flip": 0.9 if transfer == "apic" else 0.0, "stress_form": stress_form}
    options["integrator"], near = INTEGRATORS[integrator]
    law = mpm.NeoHookean(E=1e4, nu=0.3)
    below, above = (0.0, at, 0.0)[:dim], (1.0,) * dim
    walls = mpm.Walls([("open", "open"), ("mirror", "open"), ("open", "open")][:dim], below, above)
    half, whole = particles(dim, at, device), particles(dim, at, device)
    gravity = torch.zeros(dim, dtype=torch.float64, device=device)
    gravity[0] = -1.0
    whole = mpm.State.concatenate([whole, reflected(whole, at)])
    mirrored = mpm.Step(grid, law, gravity=gravity, walls=walls, **options)
    symmetric = mpm.Step(grid, law, gravity=gravity, **options)
    for _ in range(5):
        half, whole = mirrored(half, 0.01), symmetric(whole, 0.01)
    n = len(half)
    for name in ("x", "v", "F"):
        torch.testing.assert_close(getattr(half, name), getattr(whole, name)[:n], rtol=0, atol=near)
    assert float((half.v - particles(dim, at, device).v).abs().max()) > 0.1


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_a_corner_of_mirrors_is_part_of_a_symmetric_problem(device, kernel, integrator):
    """Two planes at right angles: three images."""
    grid = mpm.Grid(DX, (0.0, 0.0), (1.0, 1.0), kernel=kernel)
    state = particles(2, 0.5, device)
    state = state.replace(x=torch.stack([0.5625 + (state.x[:, 0] - 0.3) ** 2, state.x[:, 1]], 1))
    turned = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64, device=device)

    def in_x(state: mpm.State) -> mpm.State:
        swapped = state.replace(
            x=state.x @ turned, v=state.v @ turned, C=turned @ state.C @ turned, F=turned @ state.F @ turned
        )
        image = reflected(swapped, 0.5625)
        return image.replace(
            x=image.x @ turned, v=image.v @ turned, C=turned @ image.C @ turned, F=turned @ image.F @ turned
        )

    right = mpm.State.concatenate([state, in_x(state)])
    whole = mpm.State.concatenate([right, reflected(right, 0.5)])
    law = mpm.NeoHookean(E=1e4, nu=0.3)
    walls = mpm.Walls([("mirror", "open")] * 2, (0.5625, 0.5), (1.0, 1.0))
    integrator, near = INTEGRATORS[integrator]
    mirrored, symmetric = (
        mpm.Step(grid, law, walls=walls, integrator=integrator),
        mpm.Step(grid, law, integrator=integrator),
    )
    for _ in range(5):
        state, whole = mirrored(state, 0.01), symmetric(whole, 0.01)
    torch.testing.assert_close(state.x, whole.x[: len(state)], rtol=0, atol=near)
    torch.testing.assert_close(state.v, whole.v[: len(state)], rtol=0, atol=near)


def momentum(state: mpm.State) -> Tensor:
    return (state.mass[:, None] * state.v).sum(0)


def test_momentum_along_a_mirror_stays(device, dim, kernel):
    grid = mpm.Grid(DX, (0.0,) * dim, (1.0,) * dim, kernel=kernel)
    step = mpm.Step(grid, mpm.NeoHookean(E=10.0, nu=0.3), walls=mpm.Walls(["open", ("mirror", "open"), "open"][:dim]))
    state = particles(dim, 0.0, device)
    before = momentum(state)
    for _ in range(20):
        state = step(state, 0.01)
    change = momentum(state) - before
    along = [axis for axis in range(dim) if axis != 1]
    assert float(change[along].abs().max()) < 1e-13
    assert float(change[1].abs()) > 0.1  # the wall pushed


@pytest.mark.parametrize("transfer", ["apic", "pic", "flip"])
def test_uniform_sliding_is_exact(device, dim, kernel, transfer):
    """Between two mirrors, in every scene of a batch."""
    B = 2
    grid = mpm.Grid(DX, (0.0,) * dim, (1.0, 0.75, 0.75)[:dim], scenes=B, kernel=kernel)
    points = mpm.seed.box((0.1, 0.0, 0.0)[:dim], (0.5, 0.75, 0.75)[:dim], grid, per_cell=2**dim)
    states = [mpm.State.at_rest(points, 1.0, ((1.0 + b), *(0.0,) * (dim - 1)), torch.float64) for b in range(B)]
    state = mpm.State.concatenate(states, scene=True).to(device)
    walls = mpm.Walls(["open", "mirror", "mirror"][:dim])
    step = mpm.Step(grid, mpm.NeoHookean(E=10.0, nu=0.3), walls=walls, transfer=transfer)
    x, v = state.x, state.v
    for _ in range(10):
        state = step(state, 0.01)
    torch.testing.assert_close(state.v, v, rtol=0, atol=1e-13)
    torch.testing.assert_close(state.x, x + 0.1 * v, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("walls", "least", "most"), [("mirror", 0.0, 0.002), ("slip", 0.1, 0.7)])
def test_the_pressure_at_the_floor_of_a_still_column(device, dim, kernel, walls, least, most):
    """Water in equilibrium under gravity stays so at a mirror; a slip wall loses some of the pressure at once."""
    height, bulk, density, g = 0.75, 2e5, 1000.0, 9.81
    width = 0.3125
    grid = mpm.Grid(1 / 16, (0.0,) * dim, (width, 1.0, width)[:dim], kernel=kernel)
    points = mpm.seed.box((0.0,) * dim, (width, height, width)[:dim], grid, per_cell=2**dim)
    state = mpm.State.at_rest(points, density, dtype=torch.float64).to(device)
    weight = density * g * (height - state.x[:, 1])
    state = state.replace(J=1 - weight / bulk)  # τ = K (J − 1)
    step = mpm.Step(grid, mpm.WeaklyCompressible(bulk, gamma=1.0), gravity=(0.0, -g, 0.0)[:dim], walls=walls)
    dt = float(step.stable_dt(state, 0.5))
    for _ in range(math.ceil(0.5 * height / math.sqrt(bulk / density) / dt)):  # until sound from the surface comes
        state = step(state, dt)
    error = (bulk * (1 - state.J) - weight).abs() / (density * g * height)
    assert least < float(error[state.x[:, 1] < 1 / 16].max()) < most
