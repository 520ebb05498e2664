"""Torch's default dtype and device are the caller's affair: they change nothing in a step with heat."""

import contextlib

import pytest
import torch
from cases.heat import FLOAT, block, grid_around, random_like

import torch_mpm as mpm
from torch_mpm.heat.boundaries import Convection, Fixed, FixedSurface, Flux, FreeSurface, Radiation, Source, Surface


@contextlib.contextmanager
def defaults(dtype, device):
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(dtype)
        with torch.device(device):
            yield
    finally:
        torch.set_default_dtype(before)


def step_with_everything(state, kappa, kernel, method):
    """A step of every term, with numbers that float16 and float32 do not hold."""
    points = torch.full((3, 2), 0.5, dtype=FLOAT, device="cpu")
    terms = [
        Flux(Surface(points, 0.123456789), 1e5 / 3),
        Convection(FreeSurface(), 2e5 / 3, lambda time: 1e5 / 7),
        Radiation(FreeSurface(), 1 / 3, 1e5 / 9),
        Fixed(mpm.Plane((0.0, 0.3), (0.0, 1.0)), 1e5 / 11),
        Source(1e5 / 13),
    ]
    if method == "multigrid":
        terms.append(FixedSurface(mpm.Plane((0.3, 0.0), (1.0, 0.0)), 1e5 / 17))
    heat = mpm.Heat(
        grid_around(n=8, kernel=kernel), kappa, 1 / 3, terms, method=method,
        melting_point=1e5 / 19, latent_heat=1e5 / 3, reference=300 / 7,
    )  # fmt: skip
    return heat(state, 1e-2)


@pytest.mark.parametrize("default,place", [(torch.float16, "cpu"), (torch.float32, "cpu"), (torch.float32, "meta")])
@pytest.mark.parametrize(
    "kernel,method,dtype",
    [
        ("quadratic", "cg", FLOAT),
        *((k, "multigrid", d) for k in ("quadratic", "cubic") for d in (torch.float32, FLOAT)),
    ],
)
def test_defaults_of_torch_change_nothing(kernel, method, dtype, default, place):
    """On "meta", what is made without naming its device has no values. All against the default float64 on the CPU."""
    state = block(n=8, dtype=dtype)
    state = state.replace(temperature=1e4 * random_like(state.mass))
    kappa = mpm.Table([0.0, 1e5 / 3], [1.0, 2.0])
    with defaults(FLOAT, "cpu"):
        expected = step_with_everything(state, kappa, kernel, method)
    with defaults(default, place):
        end = step_with_everything(state, kappa, kernel, method)
    assert bool(expected.temperature.isfinite().all())
    assert torch.equal(end.temperature, expected.temperature)
    assert all(torch.equal(end.extra[name], expected.extra[name]) for name in expected.extra)
