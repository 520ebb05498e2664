"""Particles of objects of Gaussians: volumes, and the filled inside of shells."""

import math

import pytest
import torch
from splat_objects import random_gaussians

import torch_mpm as mpm
from benchmarks.catalogue.splats import sphere, torus
from torch_mpm import splats

DX = 1 / 32


@pytest.mark.parametrize(("method", "dx"), [("lattice", DX), ("jittered", DX), ("poisson", 2 * DX)])
def test_the_inside_of_a_sphere_is_filled(method, dx):
    """Volumes add up to that of the ball with at most a layer of cells, and nothing is outside."""
    radius, center = 0.2, (0.5, 0.4, 0.6)
    ball = sphere(radius, center, 4000)
    points = splats.particles(ball, mpm.Grid(dx, (0, 0, 0), (1, 1, 1)), per_cell=8, method=method, dtype=torch.float64)
    number = points.fields["gaussian"]
    assert number[:4000].tolist() == list(range(4000)) and bool((number[4000:] == -1).all())
    torch.testing.assert_close(points.x[:4000], ball.x)
    distance = (points.x - torch.tensor(center, dtype=torch.float64)).norm(dim=1)
    h = dx / 2
    assert float(distance.max()) < radius + (0.5 if method == "lattice" else 1.0) * h
    assert len(points) - 4000 == pytest.approx(4 / 3 * math.pi * (radius - 0.5 * h) ** 3 / h**3, rel=0.2)
    low, high = (4 / 3 * math.pi * r**3 for r in (radius, radius + h))
    assert low < float(points.volume.sum()) < high


def test_the_hole_of_a_torus_stays_empty():
    ring = torus(0.2, 0.07, 5000)
    points = splats.particles(ring, DX, per_cell=8, dtype=torch.float64)
    x = points.x[5000:]
    assert len(x) > 1000
    from_ring = ((x[:, [0, 2]].norm(dim=1) - 0.2).square() + x[:, 1].square()).sqrt()
    assert float(from_ring.max()) < 0.07 + DX / 4
    volume = 2 * math.pi**2 * 0.2 * 0.07**2
    assert volume < float(points.volume.sum()) < 1.5 * volume


def test_a_cup_is_not_filled():
    """A sphere without its top: rays leave it through the opening, if not those to the rim."""
    ball = sphere(0.2, (0.0, 0.0, 0.0), 6000)
    cup = ball[ball.x[:, 1] < 0.1]
    filled = splats.particles(cup, DX, per_cell=8)
    assert len(filled) == len(cup) or float(filled.x[len(cup) :, :].norm(dim=1).min()) > 0.1
    assert len(splats.particles(ball, DX, per_cell=8)) > len(ball) + 500


def test_gaussians_share_the_cells_that_they_are_in():
    made = random_gaussians(500)
    points = splats.particles(made, 0.25, per_cell=1, fill=False, dtype=torch.float64)
    assert len(points) == 500
    lattice = splats.Lattice(made.x, 0.25)
    cells = {tuple(c) for c in lattice.cells(made.x).tolist()}
    assert float(points.volume.sum()) == pytest.approx(len(cells) * 0.25**3)


def test_faint_gaussians_are_left_out():
    made = random_gaussians(4).replace(opacity_logit=torch.tensor([-9.0, 0.0, -9.0, 3.0], dtype=torch.float64))
    assert splats.visible(made).tolist() == [1, 3]
    assert splats.visible(made, 0.0).tolist() == [0, 1, 2, 3]


def test_the_opacity_field_is_the_sum_over_all_gaussians():
    """Cell by cell without boxes, within what lies beyond three deviations."""
    made = random_gaussians(40, size=0.1)
    lattice = splats.Lattice(made.x, 0.11)
    found = splats.opacity_field(made, lattice)
    centers = lattice.lower + 0.11 * (torch.cartesian_prod(*(torch.arange(n) for n in lattice.shape)) + 0.5)
    d = centers[:, None] - made.x
    precision = torch.linalg.inv(made.covariance + 0.055**2 * torch.eye(3))
    distance = (d[:, :, None] @ precision @ d[..., None])[..., 0, 0]
    expected = (made.opacity * torch.exp(-0.5 * distance)).sum(1).reshape(found.shape)
    near = (made.opacity * torch.exp(-0.5 * distance) * (distance <= 9)).sum(1).reshape(found.shape)
    assert bool((found <= expected.float() + 1e-5).all()) and bool((found >= near.float() - 1e-5).all())


def test_enclosed_cells():
    opaque = torch.zeros(5, 5, 5, dtype=torch.bool)
    opaque[1:4, 1:4, 1:4] = True
    opaque[2, 2, 2] = False
    assert splats.enclosed(opaque).nonzero().tolist() == [[2, 2, 2]]
    opaque[3, 2, 2] = False
    assert not bool(splats.enclosed(opaque).any())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grid": 1e-7}, "cells of 5e-08 m, which take .* are free; remove distant Gaussians"),
        ({"grid": 0.0}, "the grid's dx must be positive"),
        ({"grid": mpm.Grid(DX, (0, 0), (1, 1))}, "grid must have 3 dimensions for Gaussians, got 2"),
        ({"per_cell": -1}, "per_cell must be positive"),
        ({"method": "random"}, "method must be"),
    ],
)
def test_wrong_arguments_are_named(options, message):
    words = {"grid": DX, **options}
    with pytest.raises(ValueError, match=message):
        splats.particles(sphere(0.2, (0.0, 0.0, 0.0), 3000), **words)


def test_too_many_large_gaussians_are_refused():
    """The time would be that of the overlaps."""
    large = random_gaussians(3000, size=3.0)
    with pytest.raises(ValueError, match=r"the 3000 Gaussians overlap .* remove large Gaussians"):
        splats.particles(large, 0.015)


def test_gaussians_larger_than_all_numbers_of_cells():
    """One of 1e8 m reaches over the whole lattice, whose cells it makes opaque."""
    ball = sphere(0.2, (0.0, 0.0, 0.0), 3000)
    huge = random_gaussians(1, 0).replace(x=ball.x[:1], axes=1e8 * torch.eye(3, dtype=torch.float64)[None])
    huge = huge.replace(opacity_logit=torch.tensor([3.0], dtype=torch.float64))
    both = splats.concatenate([ball, huge])
    lattice = splats.Lattice(both.x, DX / 2)
    assert float(splats.opacity_field(both, lattice).min()) > 0.9


def test_no_gaussians_are_an_error():
    nothing = random_gaussians(3)[:0]
    for call in (lambda: splats.particles(nothing, DX), lambda: splats.placed(nothing)):
        with pytest.raises(ValueError, match="an object needs at least one Gaussian, got none"):
            call()


@pytest.mark.parametrize("name", ["x", "axes"])
def test_numbers_that_are_not_finite_are_an_error(name):
    made = random_gaussians(3)
    value = getattr(made, name).clone()
    value[1] = math.nan
    with pytest.raises(ValueError, match="the Gaussians must be finite, which Gaussian 1 violates"):
        splats.particles(made.replace(**{name: value}), DX)


def test_centres_that_require_a_gradient_are_an_error():
    made = random_gaussians(3)
    leaf = made.replace(x=made.x.clone().requires_grad_())
    with pytest.raises(ValueError, match="x of the Gaussians must not require grad"):
        splats.particles(leaf, DX)
    with torch.no_grad():
        assert torch.equal(splats.particles(leaf, DX).x, splats.particles(made, DX).x)
