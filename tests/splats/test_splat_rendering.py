"""Pictures of Gaussians against a program without tiles, gradients, and calls of gsplat."""

import math
import sys
import types

import numpy as np
import pytest
import torch
from splat_objects import random_gaussians, unit_cube_camera

import torch_mpm as mpm
from torch_mpm import splats
from torch_mpm.splats import gsplat_renderer, picture


def reference(gaussians: splats.Gaussians, camera, background: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One Gaussian after the other over the whole picture, in NumPy."""
    width, height = camera.resolution
    focal = 0.5 * height / math.tan(math.radians(camera.view_angle) / 2)
    turn = np.stack([camera.right, -camera.up, camera.forward])
    local = (gaussians.x.numpy() - camera.position) @ turn.T
    towards = gaussians.x - torch.from_numpy(camera.position)
    colors = splats.colors(gaussians.harmonics, towards / towards.norm(dim=1, keepdim=True)).numpy()
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    image, light = np.zeros((height, width, 3)), np.ones((height, width))
    for k in np.argsort(local[:, 2]):
        x, y, z = local[k]
        if z <= 0.01:
            continue
        u, v = np.clip([x / z, y / z], *(1.3 * s * np.array([width, height]) / (2 * focal) for s in (-1, 1)))
        J = focal / z * np.array([[1, 0, -u], [0, 1, -v]])
        conic = np.linalg.inv(J @ turn @ gaussians.covariance[k].numpy() @ turn.T @ J.T + 0.3 * np.eye(2))
        dx, dy = column - (0.5 * width + focal * x / z), row - (0.5 * height + focal * y / z)
        power = conic[0, 0] * dx * dx + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy * dy
        alpha = np.minimum(0.99, float(gaussians.opacity[k]) * np.exp(-0.5 * power))
        alpha[alpha < 1 / 255] = 0
        image += (light * alpha)[..., None] * colors[k]
        light *= 1 - alpha
    return image + light[..., None] * background, 1 - light


@pytest.mark.parametrize(
    ("count", "size", "resolution"), [(50, 0.05, (40, 24)), (600, 0.02, (70, 50)), (9, 0.9, (24, 24))]
)
def test_pictures_are_those_of_a_program_without_tiles(count, size, resolution):
    """Within the light behind an opaque pixel that is left out, 1e-4, and exact where none is opaque."""
    gaussians, camera = random_gaussians(count, size=size), unit_cube_camera(*resolution)
    background = torch.rand(resolution[1], resolution[0], 3, dtype=torch.float64)
    found = splats.render(gaussians, camera, background)
    color, opacity = reference(gaussians, camera, background.numpy())
    exact = opacity.max() < 1 - 1e-4
    np.testing.assert_allclose(found.color.numpy(), color, atol=1e-12 if exact else 3e-4)
    np.testing.assert_allclose(found.opacity.numpy(), opacity, atol=1e-12 if exact else 1e-4)
    assert exact or count > 50


def test_gaussians_beside_and_behind_the_camera():
    """Also those in the plane of the camera, where the projection is infinite."""
    camera = unit_cube_camera(30, 20)
    gaussians = random_gaussians(40, size=0.3)
    start = torch.from_numpy(camera.position)
    x = start + 1.5 * (gaussians.x - 0.5)
    x[:3] = start + torch.tensor([[0.0], [0.2], [-0.3]]) * torch.from_numpy(camera.right)
    gaussians = gaussians.replace(x=x)
    color, _ = reference(gaussians, camera, np.ones(3))
    np.testing.assert_allclose(splats.render(gaussians, camera).color.numpy(), color, atol=3e-4)


def test_long_and_thin_gaussians_in_single_precision():
    """Needles of 1e5 deviations of their width, and of 1e4 m, in float32."""
    made = random_gaussians(60, degree=0)
    scale = torch.tensor([[1e-5, 1e-5, 1.0], [1e-4, 1.0, 1e4]], dtype=torch.float64).repeat(30, 1)
    turn = torch.randn(60, 4, dtype=torch.float64)
    needles = splats.Gaussians.from_factors(made.x, scale, turn, 0.2 * made.opacity, made.harmonics)
    camera = unit_cube_camera(40, 30)
    expected, _ = reference(needles, camera, np.ones(3))
    found = splats.render(needles.to(dtype=torch.float32), camera).color
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-3)
    assert np.ptp(expected) > 0.1


def test_no_gaussians_are_the_background():
    nothing = random_gaussians(3)[:0]
    found = splats.render(nothing, unit_cube_camera(20, 17), (0.1, 0.2, 0.3))
    assert found.color.shape == (17, 20, 3) and not bool(found.opacity.any())
    torch.testing.assert_close(found.color[5, 3], torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))


def test_gradients_of_a_picture():
    """By all attributes, against finite differences."""
    made = random_gaussians(6, degree=1, size=0.15)
    camera = unit_cube_camera(9, 8)

    def draw(*values: torch.Tensor) -> torch.Tensor:
        return splats.render(splats.Gaussians(*values), camera).color

    values = [t.requires_grad_() for t in (made.x, made.axes, made.opacity_logit, made.harmonics)]
    assert torch.autograd.gradcheck(draw, values, eps=1e-7, atol=1e-5, rtol=1e-4)


def test_gradients_of_pictures_pass_through_a_rollout():
    """Derivatives of the difference of two pictures by stiffness and velocity, against finite differences."""
    grid = mpm.Grid(0.125, (0, 0, 0), (1, 1, 1))
    made = random_gaussians(50, degree=1, size=0.04)
    made = splats.placed(made, extent=0.4, center=(0.5, 0.4, 0.5))
    points = splats.particles(made, grid, per_cell=4, dtype=torch.float64)
    start = mpm.State.at_rest(points, 1000.0, dtype=torch.float64)
    twisted = torch.eye(3, dtype=torch.float64).repeat(len(start), 1, 1)
    twisted[:, 0, 1] = 0.3  # Sheared at the start, so that the stiffness matters.
    start = start.replace(F=twisted)
    camera = unit_cube_camera(24, 24)
    with torch.no_grad():
        target = splats.render(made, camera).color

    def loss(E: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        step = mpm.Step(grid, mpm.NeoHookean(E=1e4 * E, nu=0.3), gravity=(0, -9.8, 0))
        end = mpm.rollout(step, start.replace(v=start.v + velocity), 6, 2e-3)
        return 1e3 * (splats.render(splats.moved(made, end), camera).color - target).square().mean()

    E = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    velocity = torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64, requires_grad=True)
    by_E, by_velocity = torch.autograd.grad(loss(E, velocity), (E, velocity))
    found = torch.cat([by_E[None], by_velocity])
    eps, expected = 1e-5, []
    with torch.no_grad():
        for k in range(4):
            ends = []
            for sign in (1, -1):
                change = torch.zeros(4, dtype=torch.float64)
                change[k] = sign * eps
                ends.append(loss(E + change[0], velocity + change[1:]))
            expected.append((ends[0] - ends[1]) / (2 * eps))
    torch.testing.assert_close(found, torch.stack(expected), rtol=1e-4, atol=1e-6)
    assert float(found.abs().min()) > 1e-3


# ---- gsplat


def fake_gsplat(calls: list[dict]) -> types.SimpleNamespace:
    """`rasterization` with the names, defaults and shapes of gsplat 1.5, which projects the centres."""

    def rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, far_plane=1e10,
        radius_clip=0.0, eps2d=0.3, sh_degree=None, packed=True, tile_size=16, backgrounds=None, render_mode="RGB",
        sparse_grad=False, absgrad=False, rasterize_mode="classic", channel_chunk=32, distributed=False,
        camera_model="pinhole", segmented=False, covars=None,
    ):  # fmt: skip
        N, C = len(means), len(viewmats)
        assert covars.shape == (N, 3, 3) and quats is None and scales is None
        assert opacities.shape == (N,) and viewmats.shape == (C, 4, 4) and Ks.shape == (C, 3, 3)
        assert colors.shape == (N, (sh_degree + 1) ** 2, 3)
        local = means @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
        pixels = local @ Ks[0].T
        calls.append(
            {"pixels": pixels[:, :2] / pixels[:, 2:], "depth": local[:, 2], "eps2d": eps2d, "near": near_plane}
        )
        return torch.full((C, height, width, 3), 0.25), torch.full((C, height, width, 1), 0.5), {}

    return types.SimpleNamespace(rasterization=rasterization)


@pytest.mark.parametrize("degree", [0, 3])
def test_gsplat_gets_the_same_camera(degree):
    gaussians, camera, calls = random_gaussians(20, degree, torch.float32), unit_cube_camera(40, 24), []
    color, opacity = gsplat_renderer.draw(fake_gsplat(calls), gaussians, camera)
    assert color.shape == (24, 40, 3) and opacity.shape == (24, 40)
    expected = torch.from_numpy(camera.project(gaussians.x.numpy())).float()
    torch.testing.assert_close(calls[0]["pixels"], expected[:, :2], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(calls[0]["depth"], expected[:, 2], rtol=1e-5, atol=1e-5)
    assert calls[0]["eps2d"] == 0.3 and calls[0]["near"] == 0.01


def test_the_background_is_behind_a_picture_by_gsplat(monkeypatch):
    gaussians, camera, calls = random_gaussians(20, 1, torch.float32), unit_cube_camera(40, 24), []
    monkeypatch.setattr(
        picture.gsplat_renderer, "rasterise", lambda *given: gsplat_renderer.draw(fake_gsplat(calls), *given)
    )
    found = splats.render(gaussians, camera, (1.0, 0.0, 0.5), backend="gsplat")
    torch.testing.assert_close(found.color[3, 4], torch.tensor([0.75, 0.25, 0.5]))
    assert len(calls) == 1


def test_gsplat_is_missing_or_cannot_draw(monkeypatch):
    gaussians, camera = random_gaussians(2), unit_cube_camera(20, 20)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match=r"the renderer gsplat: the package gsplat is"):
        splats.render(gaussians, camera, backend="gsplat")
    monkeypatch.setitem(sys.modules, "gsplat", fake_gsplat([]))
    with pytest.raises(ValueError, match="gsplat draws Gaussians in float32 on a GPU, got float64 on cpu"):
        splats.render(gaussians, camera, backend="gsplat")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backend": "vulkan"}, "backend must be one of auto, software, gsplat, got 'vulkan'"),
        ({"background": torch.ones(3, 3)}, r"background must have shape \[3\] or \[20, 20, 3\], got \[3, 3\]"),
        ({"background": (1.0, 0.0)}, "background must"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        splats.render(random_gaussians(2), unit_cube_camera(20, 20), **options)
