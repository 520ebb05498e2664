"""torch's default device and dtype are the user's: they change nothing in a simulation whose tensors have their own.

A tensor made without a device lands on a foreign default device, "meta" here, where the first use of it fails.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from helpers import disc
from torch import Tensor

import torch_mpm as mpm
from benchmarks.catalogue.laws import named
from torch_mpm import heat_boundaries

DEFAULTS = ["meta", "context", pytest.param("cuda", marks=pytest.mark.cuda), "float64", "float16"]


@contextlib.contextmanager
def defaults(name: str) -> Iterator[None]:
    """A default device or dtype, or a device as context."""
    dtype = torch.get_default_dtype()
    try:
        if name == "context":
            with torch.device("meta"):
                yield
        elif name.startswith("float"):
            torch.set_default_dtype(getattr(torch, name))
            yield
        else:
            torch.set_default_device(name)
            yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(dtype)


@pytest.fixture(params=DEFAULTS)
def default(request: pytest.FixtureRequest) -> str:
    return request.param


def obstacles(dim: int, device: str) -> list:
    centre, up = (0.5, 0.2, 0.5)[:dim], (0.0, 1.0, 0.0)[:dim]
    where = {"device": device, "dtype": torch.float32}
    friction = torch.tensor(0.3, requires_grad=True, **where)
    return [
        mpm.Plane((0.0, 0.22, 0.0)[:dim], up, friction=0.3),
        mpm.Sphere(centre, 0.1, velocity=(0.1, 0.0, 0.0)[:dim], friction=friction),
        mpm.Box(centre, (0.1, 0.2, 0.1)[:dim], rotation=0.3 if dim == 2 else (0.1, 0.2, 0.3)),
        mpm.Capsule(centre, up, 0.05, "sticky", angular_velocity=1.0 if dim == 2 else (0.0, 0.0, 1.0)),
        mpm.SDF(
            lambda x: x.norm(dim=1) - 0.1, lambda t: torch.stack([t, *[t + 0.2] * (dim - 1)], -1), normal=lambda x: x
        ),
        mpm.boundaries.Revolved(centre, ((0.0, 0.0), (0.2, 0.0), (0.0, 0.1))),
    ]


def laws() -> list[mpm.Material]:
    names = ("neo_hookean", "fluid", "sand_hardening", "von_mises", "herschel_bulkley", "custom", "custom_principal")
    return [law() for law in named(*names).values()]


def simulate(dim: int, device: str) -> list[Tensor]:
    """All laws in two scenes of a batch, between all boundaries, with gradients and sorting."""
    grid = mpm.Grid(0.1, (0,) * dim, (1,) * dim, scenes=2, deterministic=True)
    parts = [
        mpm.seed.fill(mpm.seed.Sphere((0.5,) * dim, 0.2), grid, 4, method=method, dtype=torch.float32, device=device)
        for method in ("lattice", "poisson")
    ]
    velocity = (0.5, -1.0, 0.2)[:dim]
    state = mpm.State.concatenate([mpm.State.at_rest(p, 900.0, velocity, torch.float32) for p in parts], scene=True)
    count = len(laws())
    state = state.replace(material=(torch.arange(len(state), device=device) % count).int())
    step = mpm.Step(
        grid,
        mpm.Mixture(laws()),
        (0.0, -9.8, 0.0)[:dim],
        mpm.Walls("separate", friction=0.2),
        obstacles(dim, device),
        flip=0.5,
    )
    limit = step.stable_dt(step.prepare(state))
    state = state.sorted(grid)
    mpm.rollout(step, state.replace(v=state.v.requires_grad_()), 2, 1e-4).x.sum().backward()
    end = mpm.rollout(step, state.detach(), 1, torch.full((2,), 1e-4, dtype=torch.float32, device=device))
    step.check(end)
    step.reset()
    end = end.restored()
    grads = [state.v.grad, step.boundaries[1].friction.grad]
    return [limit, *grads, end.x.detach(), end.v.detach(), end.F.detach(), end.time, *end.extra.values()]


def conduct(dim: int, device: str) -> list[Tensor]:
    grid = mpm.Grid(0.1, (0,) * dim, (1,) * dim, deterministic=True)
    points = mpm.seed.box((0.2,) * dim, (0.8,) * dim, grid, 4, dtype=torch.float32, device=device)
    state = mpm.State.at_rest(points, 900.0, dtype=torch.float32)
    state = state.replace(temperature=300 + 50 * state.x[:, 0])
    wall = mpm.Plane((0.3,) * dim, (1.0, 0.0, 0.0)[:dim])
    surface = heat_boundaries.FreeSurface()
    terms = [
        heat_boundaries.Fixed(wall, 333.3),
        heat_boundaries.Flux(surface, 10.0),
        heat_boundaries.Convection(surface, 5.0, 280.1),
        heat_boundaries.Source(3.0),
    ]
    heat = mpm.Heat(grid, 10.0, 1000.0, terms, reference=273.15, melting_point=350.0, latent_heat=1e4)
    end = mpm.rollout(mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), heat=heat), state, 3, 1e-3)
    return [end.temperature, *end.extra.values()]


@functools.cache
def usual(program: Callable[[int, str], list[Tensor]], dim: int, device: str) -> list[Tensor]:
    return program(dim, device)


@pytest.mark.thorough(dim=3, default="context", program=simulate)
@pytest.mark.thorough(dim=3, default="float16", program=simulate)
@pytest.mark.parametrize("program", [simulate, conduct])
def test_simulation(default, device, dim, program):
    expected = usual(program, dim, device)
    with defaults(default):
        found = program(dim, device)
    for a, b in zip(expected, found, strict=True):
        assert b.device.type == device
        torch.testing.assert_close(b, a, rtol=0 if device == "cpu" else 1e-4, atol=0 if device == "cpu" else 1e-5)


def test_scene_run(default, tmp_path):
    pytest.importorskip("pydantic")
    pytest.importorskip("h5py")
    from torch_mpm.scene import Scene

    nozzle = {"center": (0.8, 0.7), "radius": 0.1, "velocity": (-1.0, 0.5), "material": "jelly", "end": 0.04}
    obstacle = {"shape": "sphere", "center": (0.5, 0.1), "radius": 0.1}
    words = disc(device="cpu", duration=0.04, emitter=[nozzle], obstacle=[obstacle], body__0__spin=2.0, grid__dx=0.1)
    expected = Scene(**words).run(tmp_path / "usual")
    with defaults(default):
        found = Scene(**words).run(tmp_path / "foreign")
    with mpm.Trajectory(tmp_path / "usual") as a, mpm.Trajectory(tmp_path / "foreign") as b:
        assert set(a.file) == set(b.file)
        for name in ("position", "velocity", "mass"):
            np.testing.assert_array_equal(a[name], b[name])  # NaN before an emitter has brought a particle
    assert found["particles"] == expected["particles"]


def test_results_go_to_the_default_device_and_dtype():
    """Points without a device go where torch's tensors go; a half, in which positions mean nothing, is not taken."""
    with defaults("meta"):
        points = mpm.seed.box((0, 0), (1, 1), 0.1)
        assert points.x.is_meta and points.volume.is_meta
        assert mpm.State.at_rest(points).v.is_meta
    with defaults("float64"):
        assert mpm.State.at_rest(mpm.seed.box((0, 0), (1, 1), 0.1)).x.dtype == torch.float64
    with defaults("float16"):
        state = mpm.State.at_rest(mpm.seed.box((0, 0), (1, 1), 0.1))
        assert state.x.dtype == torch.float32
        assert float(state.volume.sum()) == pytest.approx(1, rel=1e-5)
