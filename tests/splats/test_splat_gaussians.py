"""Gaussians: covariances and their factors, harmonics and their rotation, placement, deformation."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_objects import random_gaussians, random_rotations

import torch_mpm as mpm
from torch_mpm import splats
from torch_mpm.splats.gaussians import quaternion_of, rotation_of


def turned_directions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=1)


def test_rotations_of_quaternions_are_those_of_scipy():
    q = torch.randn(200, 4, dtype=torch.float64)
    q[:4] = torch.eye(4)  # Half-turns, and no turn.
    expected = Rotation.from_quat(q[:, [1, 2, 3, 0]].numpy()).as_matrix()
    np.testing.assert_allclose(rotation_of(q).numpy(), expected, atol=1e-14)
    back = quaternion_of(rotation_of(q))
    unit = q / q.norm(dim=1, keepdim=True)
    torch.testing.assert_close((back * unit).sum(1).abs(), torch.ones(200, dtype=torch.float64))
    assert bool((back[:, 0] >= 0).all())


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-13)])
def test_factors_give_the_covariance_back(dtype, tolerance):
    """Also a deviation of 1e-6 of the largest one, whose square a covariance in float32 does not resolve."""
    scale = torch.tensor([[1.0, 1e-3, 1e-6], [2.0, 2.0, 2.0], [1.0, 1.0, 1e-5]], dtype=dtype)
    x, half = torch.zeros(3, 3, dtype=dtype), torch.full((3,), 0.5, dtype=dtype)
    quaternion, harmonics = torch.randn(3, 4, dtype=dtype), torch.zeros(3, 1, 3, dtype=dtype)
    made = splats.Gaussians.from_factors(x, scale, quaternion, half, harmonics)
    found, quaternion = made.factors()
    smallest = 1e-7 if dtype == torch.float32 else 1e-15  # Absolute error of singular values, of the largest one.
    torch.testing.assert_close(found, scale, rtol=1e-5, atol=smallest)
    again = rotation_of(quaternion) * found[:, None]
    torch.testing.assert_close(again @ again.mT, made.covariance, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_are_those_of_scipy(degree):
    """Y_l^m by associated Legendre functions with the phase (−1)^m (Condon-Shortley)."""
    from scipy.special import sph_harm_y

    d = turned_directions(100)
    theta, phi = np.arccos(d[:, 2].numpy()), np.arctan2(d[:, 1].numpy(), d[:, 0].numpy())
    expected = []
    for l in range(degree + 1):  # noqa: E741
        for m in range(-l, l + 1):
            y = sph_harm_y(l, abs(m), theta, phi)
            part = y.real if m == 0 else math.sqrt(2) * (y.real if m > 0 else y.imag)
            expected.append(part)
    np.testing.assert_allclose(splats.basis(d, degree).numpy(), np.stack(expected, 1), atol=1e-13)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 5e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_harmonics_are_the_rotated_function(degree, dtype, tolerance):
    """f'(R d) = f(d) in other directions than those by which the rotation is computed."""
    N = 100
    harmonics = torch.randn(N, (degree + 1) ** 2, 3, dtype=dtype)
    R, d = random_rotations(N, dtype), turned_directions(N).to(dtype)
    before = (splats.basis(d, degree)[:, :, None] * harmonics).sum(1)
    after = (splats.basis((R @ d[:, :, None])[:, :, 0], degree)[:, :, None] * splats.rotated(harmonics, R)).sum(1)
    torch.testing.assert_close(after, before, rtol=tolerance, atol=tolerance)
    together = splats.rotated(harmonics, R[0])
    torch.testing.assert_close(together[0], splats.rotated(harmonics, R)[0], rtol=tolerance, atol=tolerance)
    twice = splats.rotated(splats.rotated(harmonics, R), R.flip(0))
    torch.testing.assert_close(twice, splats.rotated(harmonics, R.flip(0) @ R), rtol=tolerance, atol=4 * tolerance)


def test_gradients_of_rotated_harmonics():
    harmonics = torch.randn(2, 16, 3, dtype=torch.float64, requires_grad=True)
    R = random_rotations(2).requires_grad_()
    assert torch.autograd.gradcheck(splats.rotated, (harmonics, R))


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
@pytest.mark.parametrize("world_up", ["+y", "-z"])
def test_an_object_is_turned_scaled_and_moved_as_a_whole(up, world_up):
    """As by the deformation gradient s R, with which colours in turned directions are the same."""
    before = random_gaussians(30)
    after = splats.placed(before, up, 0.3, (1.0, 2.0, 3.0), world_up=world_up)
    low, high = after.x.amin(0), after.x.amax(0)
    assert float((high - low).max()) == pytest.approx(0.3)
    torch.testing.assert_close(0.5 * (low + high), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    with_ones = torch.cat([before.x, torch.ones(30, 1, dtype=torch.float64)], 1)
    F = torch.linalg.lstsq(with_ones, after.x).solution[:3].T
    assert float(torch.linalg.det(F)) > 0
    sign = {"+": 1.0, "-": -1.0}
    a, b = (torch.eye(3, dtype=torch.float64)["xyz".index(n[1])] * sign[n[0]] for n in (up, world_up))
    torch.testing.assert_close(torch.nn.functional.normalize(F @ a, dim=0), b)
    expected = splats.deformed(before, after.x, F.expand(30, 3, 3))
    torch.testing.assert_close(after.covariance, expected.covariance)
    torch.testing.assert_close(after.harmonics, expected.harmonics)


def test_a_rigid_motion_shows_the_same_colours_from_the_turned_side():
    before, R = random_gaussians(20), random_rotations(1)[0]
    after = splats.deformed(before, before.x @ R.T, R.expand(20, 3, 3))
    d = turned_directions(20)
    torch.testing.assert_close(splats.colors(after.harmonics, d @ R.T), splats.colors(before.harmonics, d))
    torch.testing.assert_close(after.covariance, R @ before.covariance @ R.T)


def test_gaussians_follow_their_particles_in_any_order():
    before = random_gaussians(10, degree=1)
    P = 14
    x, F = (
        torch.rand(P, 3, dtype=torch.float64),
        torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(P, 3, 3, dtype=torch.float64),
    )
    ones = torch.ones(P, dtype=torch.float64)
    state = mpm.State(x=x, v=torch.zeros_like(x), mass=ones, volume=ones, F=F)
    expected = splats.deformed(before, x[2:12], F[2:12])
    order = torch.randperm(P)
    mixed = state.replace(x=x[order], F=F[order], ids=order)
    for now in (state, mixed):
        found = splats.moved(before, now, first=2)
        torch.testing.assert_close(found.x, expected.x)
        torch.testing.assert_close(found.covariance, expected.covariance)
        torch.testing.assert_close(found.harmonics, expected.harmonics)
    fluid = splats.moved(before, state.replace(F=None, J=8 * ones))
    torch.testing.assert_close(fluid.covariance, 4 * before.covariance)
    torch.testing.assert_close(fluid.harmonics, before.harmonics)
    for ids in (order + 1, torch.zeros_like(order)):
        with pytest.raises(ValueError, match="ids of the state must be 0 to 13 in some order"):
            splats.moved(before, mixed.replace(ids=ids))
    with pytest.raises(ValueError, match="state must have a particle for each Gaussian, 15, got 14"):
        splats.moved(before, state, first=5)


def test_objects_of_other_degrees_are_joined():
    a, b = random_gaussians(3, degree=3), random_gaussians(4, degree=0)
    both = splats.concatenate([a, b])
    d = turned_directions(7)
    expected = torch.cat([splats.colors(a.harmonics, d[:3]), splats.colors(b.harmonics, d[3:])])
    assert both.degree == 3
    torch.testing.assert_close(splats.colors(both.harmonics, d), expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": torch.zeros(4, 2)}, r"x must have shape \[N, 3\], got \[4, 2\]"),
        ({"axes": torch.zeros(4, 3)}, r"axes must have shape \[N, 3, 3\] = \[4, 3, 3\]|axes must have shape"),
        ({"opacity_logit": torch.zeros(5)}, "opacity_logit must have shape"),
        (
            {"harmonics": torch.zeros(4, 5, 3)},
            r"harmonics must have shape \[N, K, 3\] with K = 1, 4, 9 or 16, got \[4, 5, 3\]",
        ),
        ({"harmonics": torch.zeros(3, 4, 3)}, "harmonics must have shape"),
    ],
)
def test_wrong_shapes_are_named(changes, message):
    words = {"x": torch.zeros(4, 3), "axes": torch.zeros(4, 3, 3), "opacity_logit": torch.zeros(4)}
    with pytest.raises(ValueError, match=message):
        splats.Gaussians(**{**words, "harmonics": torch.zeros(4, 4, 3), **changes})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"up": "y"}, "up must be one of"),
        ({"extent": 0.0}, "extent must be positive"),
        ({"center": (0.0, 1.0)}, "center must"),
    ],
)
def test_wrong_placements_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        splats.placed(random_gaussians(3), **options)


@pytest.mark.parametrize(("far", "message"), [(0.0, "got 0 m"), (3e38, "got inf m")])
def test_centres_without_an_extent_are_an_error(far, message):
    made = random_gaussians(2, 0, torch.float32)
    made = made.replace(x=torch.tensor([[0.0, -far, 0.0], [0.0, far, 0.0]]))
    with pytest.raises(
        ValueError, match="extent of the centres of the Gaussians must be positive and finite, " + message
    ):
        splats.placed(made, extent=1.0)


def test_the_gradient_of_a_placement_includes_the_extent():
    made = random_gaussians(4, 1)

    def place(x, axes):
        placed = splats.placed(made.replace(x=x, axes=axes), up="-z", extent=0.3, center=(0.1, 0.2, 0.3))
        return placed.x, placed.axes

    assert torch.autograd.gradcheck(place, (made.x.clone().requires_grad_(), made.axes.clone().requires_grad_()))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"quaternion": torch.eye(4)[:3] - torch.eye(4)[:1] * torch.tensor([1.0, 0, 0, 0])},
            "quaternion must not be zero",
        ),
        ({"opacity": torch.tensor([0.5, 1.0, 0.5])}, "opacity must be above 0 and below 1, which Gaussian 1 violates"),
        ({"opacity": torch.tensor([0.5, 0.5, math.nan])}, "Gaussian 2 violates"),
        ({"opacity": torch.zeros(2)}, "opacity must have shape"),
        ({"opacity": None}, "opacity must have shape"),
        ({"scale": None}, "scale must have shape"),
        ({"x": None}, "x must have shape"),
        ({"harmonics": torch.zeros(3, 4, 2)}, "harmonics must have shape"),
    ],
)
def test_wrong_factors_are_named(changes, message):
    words = {"x": torch.zeros(3, 3), "scale": torch.ones(3, 3), "quaternion": torch.ones(3, 4)}
    with pytest.raises(ValueError, match=message):
        splats.Gaussians.from_factors(
            **{**words, "opacity": torch.full((3,), 0.5), "harmonics": torch.zeros(3, 1, 3), **changes}
        )


@pytest.mark.parametrize(
    "call",
    [
        lambda g: splats.concatenate([random_gaussians(2), g]),
        lambda g: splats.deformed(g, torch.zeros(1, 3), torch.zeros(1, 3, 3)),
        lambda g: splats.moved(g, None),
        lambda g: splats.particles(g, 0.1),
        lambda g: splats.placed(g),
        lambda g: splats.render(g, None),
        lambda g: splats.visible(g),
        lambda g: splats.write("none.ply", g),
    ],
)
def test_other_types_are_named(call):
    with pytest.raises(TypeError, match="must be Gaussians, got int"):
        call(3)


def test_wrong_directions_and_rotations_are_named():
    made = random_gaussians(3)
    for call, message in (
        (
            lambda: splats.colors(made.harmonics, torch.zeros(2, 3)),
            r"direction must have shape \[N, 3\] = \[3, 3\], got",
        ),
        (lambda: splats.colors(torch.zeros(3, 5, 3), torch.zeros(3, 3)), "harmonics must have shape"),
        (lambda: splats.basis([0.0, 0.0, 1.0], 1), "direction must have shape"),
        (lambda: splats.basis(torch.zeros(3), 1.0), "degree must be 0, 1, 2 or 3, got 1.0"),
        (lambda: splats.rotated(made.harmonics, [1.0]), "rotation must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
