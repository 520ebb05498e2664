"""Positions far from zero: what a dtype does not resolve is reported, and exact relative to an origin."""

import warnings

import numpy as np
import pytest
import torch

import torch_mpm as mpm

FLOAT, DOUBLE = torch.float32, torch.float64
UTM = (500e3, 5000e3, 400.0)
"""Easting, northing and height [m]."""


def places(offset, dim):
    """(point relative to the offset) -> list of D coordinates."""
    zero = torch.tensor(offset[:dim], dtype=DOUBLE)
    return lambda *point: (zero + torch.tensor(point[:dim], dtype=DOUBLE)).tolist()


def ball(offset, dim, dtype, origin=None, device="cpu", **options):
    """A grid of cells of 1/20 m, and a ball in it."""
    zero = offset if origin is None else (0.0,) * 3
    near, far = places(zero, dim), places(offset, dim)
    grid = mpm.Grid(0.05, near(0, 0, 0), near(1, 1, 1))
    points = mpm.seed.sphere(far(0.5, 0.6, 0.5), 0.2, grid, per_cell=2**dim, origin=origin, device=device)
    return grid, mpm.State.at_rest(points, 1000.0, dtype=dtype, **options)


# ---- points


@pytest.mark.parametrize("given", [None, FLOAT, DOUBLE])
@pytest.mark.parametrize("method", ["lattice", "jittered", "poisson"])
def test_a_state_in_float64_has_points_that_are_not_rounded(given, method, device, dim, tmp_path):
    """The points of seed, of any dtype, and those of a file."""
    region = mpm.seed.Box((0.1,) * dim, (0.7,) * dim)
    expected = mpm.seed.fill(region, 0.1, 2, method=method, dtype=DOUBLE)
    points = mpm.seed.fill(region, 0.1, 2, method=method, dtype=given, device=device)
    state = mpm.State.at_rest(points, 1000.0, dtype=DOUBLE)
    assert points.x.dtype == (given or FLOAT) and state.x.device.type == device
    assert torch.equal(state.x.cpu(), expected.x) and torch.equal(state.volume.cpu(), expected.volume)
    assert torch.equal(state.mass.cpu(), 1000 * expected.volume)
    assert mpm.State.at_rest(points).x.dtype == FLOAT
    np.savez(tmp_path / "points.npz", x=expected.x.numpy(), volume=expected.volume.numpy())
    read = mpm.State.at_rest(mpm.seed.file(tmp_path / "points.npz", dtype=given), dtype=DOUBLE)
    assert torch.equal(read.x, expected.x) and torch.equal(read.volume, expected.volume)


def test_points_that_were_changed_are_taken_as_they_are():
    """In place, by another selection, or one of them: what `exact` holds is no longer theirs."""
    points = mpm.seed.box((0.1, 0.1), (0.5, 0.5), 0.1)
    exact = points.exact[0]
    points.x[3] += 0.25
    state = mpm.State.at_rest(points, dtype=DOUBLE)
    assert torch.equal(state.x[3], points.x[3].double())
    assert torch.equal(state.x[4:], exact[4:]) and not torch.equal(exact, points.x.double())
    few = mpm.seed.Points(points.x[:5], points.volume[:5], exact=points.exact)
    assert torch.equal(mpm.State.at_rest(few, dtype=DOUBLE).x, points.x[:5].double())


@pytest.mark.parametrize("dtype", [FLOAT, DOUBLE])
def test_points_relative_to_an_origin_are_those_at_zero(dtype, dim, tmp_path):
    """All shapes, a mesh and a file in map coordinates, up to their rounding in float64."""
    near, far = places((0, 0, 0), dim), places(UTM, dim)
    origin = torch.tensor(UTM[:dim], dtype=DOUBLE)
    options = {"grid": 0.1, "per_cell": 2**dim, "dtype": dtype}
    pairs = []
    for place, more in ((near, {}), (far, {"origin": UTM[:dim]})):
        made = [
            mpm.seed.box(place(0.1, 0.2, 0.3), place(0.5, 0.7, 0.5), **options, **more),
            mpm.seed.sphere(place(0.5, 0.5, 0.5), 0.3, **options, **more),
            mpm.seed.capsule(place(0.3, 0.3, 0.3), place(0.6, 0.7, 0.3), 0.2, **options, **more),
        ]
        np.save(tmp_path / "points.npy", np.array([place(0.1, 0.2, 0.3), place(0.4, 0.5, 0.6)]))
        made.append(mpm.seed.file(tmp_path / "points.npy", 1.0, dtype=dtype, **more))
        if dim == 3:
            trimesh = pytest.importorskip("trimesh")
            cube = trimesh.creation.box((0.4, 0.4, 0.4))
            cube.vertices += np.array(place(0.51, 0.51, 0.51))
            made.append(mpm.seed.mesh(cube, **options, **more))
        pairs.append(made)
    for a, b in zip(*pairs, strict=True):
        assert a.x.shape == b.x.shape and b.x.dtype == dtype
        assert float((a.x - b.x).abs().max()) < (2e-7 if dtype == FLOAT else 5e-9)
    with pytest.raises(ValueError, match=f"origin must have {dim} numbers"):
        mpm.seed.sphere(origin.tolist(), 0.2, 0.1, origin=(1.0,) * (dim + 1))


# ---- grids


@pytest.mark.parametrize("act", ["activate", "step", "rollout", "rollout_to", "frames", "stable_dt", "implicit"])
def test_what_float32_does_not_resolve_is_refused(act, device, dim):
    grid, state = ball((0, 5e6, 0), dim, FLOAT, device=device)
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), integrator="implicit" if act == "implicit" else "explicit")
    calls = {
        "activate": lambda: grid.activate(state.x),
        "step": lambda: step(state, 1e-3),
        "implicit": lambda: step(state, 1e-3),
        "rollout": lambda: mpm.rollout(step, state, 20, 1e-3),
        "rollout_to": lambda: mpm.rollout_to(step, state, 0.01),
        "frames": lambda: mpm.frames(step, state, 2, 1e-3, every=2),
        "stable_dt": lambda: mpm.stable_dt(grid, step.law, step.prepare(state)),
    }
    expected = r"too far from the zero .* coordinates up to 5e\+06 m are rounded by up to 0.25 m in float32.*`origin`"
    with pytest.raises(ValueError, match=expected):
        calls[act]()


@pytest.mark.parametrize(
    ("offset", "dtype", "reported"),
    [(0, FLOAT, False), (500, FLOAT, False), (2e4, FLOAT, True), (5e6, DOUBLE, False), (1e12, DOUBLE, True)],
)
def test_a_grid_warns_where_rounding_reaches_a_thousandth_of_a_cell(offset, dtype, reported, device, dim):
    """Once for each dtype, and in `check`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        grid, state = ball((offset,) * 3, dim, dtype, device=device)
        step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3))
        state = mpm.rollout(step, state, 3, 1e-4)
        state = step(state, 1e-4)
    assert [w.category for w in caught] == [mpm.PrecisionWarning] * reported
    if reported:
        with pytest.warns(mpm.PrecisionWarning, match="does not resolve dx = 0.05 m to 0.001"):
            step.check(state)
    else:
        step.check(state)


def test_a_grid_that_no_dtype_resolves_is_refused():
    with pytest.raises(ValueError, match=r"in float64.* relative to an origin near the bodies"):
        mpm.Grid(1.0, (1e17, 0.0), (1e17 + 64, 64.0))
