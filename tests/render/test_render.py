"""Pictures: objects appear at their projection, in the colour of the scale; files are complete or absent."""

from __future__ import annotations

import ctypes.util
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("vtkmodules")
iio = pytest.importorskip("imageio_ffmpeg")

import torch_mpm as mpm  # noqa: E402
from torch_mpm import render  # noqa: E402
from torch_mpm.render import cloud, colors, requires, scene3d, shapes  # noqa: E402
from torch_mpm.surfaces import Surface  # noqa: E402

UNIT = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
SMALL = (480, 270)


def lattice(lower, upper, spacing):
    axes = [np.arange(a + spacing / 2, b, spacing) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(lower))


def centroid(image, empty):
    """Centre (column, row) of the pixels that differ clearly between two pictures."""
    changed = np.abs(image.astype(int) - empty.astype(int)).max(axis=2) > 60
    rows, columns = np.nonzero(changed)
    assert len(rows) > 20
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


def need_opengl():
    """Skip where nothing is installed that VTK could draw with; where something is, VTK must find it."""
    vendors = [*Path("/usr/share/glvnd/egl_vendor.d").glob("*.json"), *Path("/etc/glvnd/egl_vendor.d").glob("*.json")]
    egl = ctypes.util.find_library("EGL") and vendors
    if not egl and not ctypes.util.find_library("OSMesa") and "DISPLAY" not in os.environ:
        pytest.skip("no driver for EGL, no OSMesa and no screen")


@pytest.fixture(scope="module", params=["vtk", "software"])
def backend(request):
    if request.param == "vtk":
        need_opengl()
    return request.param


@pytest.fixture(scope="module")
def plain(backend):
    with render.Renderer(UNIT, SMALL, color_by=None, radius=0.05, ground=False, backend=backend) as renderer:
        yield renderer


@pytest.mark.parametrize("at", [(0.2, 0.3, 0.8), (0.9, 0.8, 0.1), (0.5, 0.05, 0.5)])
def test_particle_appears_where_it_projects(plain, at):
    image = plain.frame(np.array([at]))
    assert image.shape == (270, 480, 3) and image.dtype == np.uint8
    expected = plain.project([at])[0]
    assert np.abs(centroid(image, plain.frame(np.zeros((0, 3)))) - expected).max() < 1.5


def test_projected_size_follows_the_pinhole(plain):
    """A sphere of radius r at depth d covers about pi (f r / d)^2 pixels."""
    at, radius = np.array([[0.5, 0.5, 0.5]]), 0.05
    changed = np.abs(plain.frame(at).astype(int) - plain.frame(np.zeros((0, 3))).astype(int)).max(axis=2) > 25
    camera = plain.scene.camera
    depth = float(((at - camera.position) @ camera.forward)[0])
    focal = 0.5 * camera.resolution[1] / np.tan(np.radians(camera.view_angle) / 2)
    assert changed.sum() == pytest.approx(np.pi * (focal * radius / depth) ** 2, rel=0.08)


def test_nearer_particle_hides_farther(backend):
    with render.Renderer(UNIT, SMALL, color_by="material", radius=0.08, ground=False, backend=backend) as renderer:
        camera = renderer.scene.camera
        near = np.array([0.5, 0.5, 0.5]) - 0.3 * camera.forward
        far = np.array([0.5, 0.5, 0.5]) + 0.3 * camera.forward
        for order in ([0, 1], [1, 0]):
            image = renderer.frame(np.stack([near, far])[order], np.array([0, 1])[order])
            column, row = renderer.project([near])[0].astype(int)
            red, _, blue = image[row, column].astype(int)
            assert blue > red + 40  # material 0 is blue, material 1 orange


@pytest.mark.parametrize("gravity", [(0, -9.8, 0), (0, 0, -9.8), (9.8, 0, 0), None, (0, 0, 0)])
def test_camera_frames_the_domain_with_up_against_gravity(gravity):
    renderer = render.Renderer(((-1, 0, 2), (3, 1, 2.5)), SMALL, gravity=gravity, backend="software")
    corners = np.array([[(-1, 3)[i & 1], (0, 1)[i >> 1 & 1], (2, 2.5)[i >> 2]] for i in range(8)])
    pixels = renderer.project(corners)
    assert np.all((pixels > 0) & (pixels < SMALL))
    assert np.ptp(pixels[:, 0]) > 0.6 * SMALL[0] or np.ptp(pixels[:, 1]) > 0.6 * SMALL[1]
    up = np.array([0, 1.0, 0]) if not np.any(gravity) else -np.array(gravity) / 9.8
    middle = np.array([1.0, 0.5, 2.25])
    low, high = renderer.project([middle, middle + 0.1 * up])
    assert high[1] < low[1] and abs(high[0] - low[0]) < 1


def test_obstacles_appear_at_their_pose(backend):
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    bar = shapes.box((0.5, 0.5, 0.5), (0.8, 0.1, 0.1), color=(0.1, 0.1, 0.1))
    with render.Renderer(UNIT, SMALL, color_by=None, ground=False, backend=backend) as renderer:
        empty = renderer.frame(np.zeros((0, 3)))
        moved = renderer.frame(np.zeros((0, 3)), obstacles=[bar.posed((0.3, 0.5, 0.5), quarter)])
        expected = renderer.project([(0.3, 0.5, 0.5)])[0]
        assert np.abs(centroid(moved, empty) - expected).max() < 4
        rows, columns = np.nonzero(np.abs(moved.astype(int) - empty.astype(int)).max(axis=2) > 60)
        assert np.ptp(rows) > 2.5 * np.ptp(columns)  # the bar stands upright


def test_pose_turns_counterclockwise():
    """The body's x axis, turned by a quarter about z, points along y."""
    arm = shapes.mesh([[1.0, 0.0], [2.0, 0.0], [1.0, 0.1]]).posed((5, 5), np.pi / 2)
    assert np.allclose(arm.world()[:2], [[5, 6], [5, 7]])
    solid = shapes.mesh([[1.0, 0, 0], [2, 0, 0], [1, 0.1, 0]], [[0, 1, 2]])
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(solid.posed((5, 5, 0), quarter).world()[:2], [[5, 6, 0], [5, 7, 0]])
    ball = shapes.sphere((1, 0, 0), 0.5).moved((0, 3, 0), quarter)
    assert np.allclose(ball.world().mean(axis=0), [0, 4, 0])


@pytest.mark.parametrize(
    ("shape", "distance"),
    [
        (shapes.sphere((1, 2, 3), 0.5), lambda p: np.linalg.norm(p - [1, 2, 3], axis=1) - 0.5),
        (shapes.capsule((0, 0, 0), (3, 0, 0), 0.5), lambda p: distance_to_segment(p, 3.0) - 0.5),
        (
            shapes.cylinder((0, 0, 0), (3, 0, 0), 0.5),
            lambda p: np.maximum(np.hypot(p[:, 1], p[:, 2]) - 0.5, np.abs(p[:, 0] - 1.5) - 1.5),
        ),
        (shapes.box((0, 0, 0), (2, 4, 6)), lambda p: np.max(np.abs(p) - [1, 2, 3], axis=1)),
        (shapes.plane((0, 1, 0), (0, 1, 0), 2.0), lambda p: p[:, 1] - 1),
    ],
)
def test_shapes_lie_on_their_surface(shape, distance):
    samples = shapes.surface_samples(shape, 500)
    assert np.abs(distance(samples.points)).max() < 0.005
    assert len(samples.points) * np.square(samples.radius) == pytest.approx(area_of(shape))


@pytest.mark.parametrize("dim", [2, 3])
def test_obstacles_of_a_simulation_are_drawn_where_they_act(dim):
    """Every drawn vertex lies on the surface that the simulation uses, of a body that moves and turns."""
    bounds = (np.zeros(dim), np.ones(dim))
    centre, axis = (0.5, 0.4, 0.6)[:dim], (0.1, 0.05, -0.05)[:dim]
    motion = {
        "velocity": (0.1, -0.05, 0.02)[:dim],
        "rotation": (0.2, 0.7, -0.4) if dim == 3 else 0.7,
        "angular_velocity": (1.0, 0.3, 2.0) if dim == 3 else 2.0,
    }
    bodies = [
        mpm.boundaries.Sphere(centre, 0.2, **motion),
        mpm.boundaries.Box(centre, (0.4, 0.2, 0.3)[:dim], **motion),
        mpm.boundaries.Capsule(centre, axis, 0.1, **motion),
        mpm.boundaries.Plane(centre, (0.3, 1.0, 0.2)[:dim], **motion),
        mpm.boundaries.Revolved(centre, ((0.1, 0.0), (0.3, 0.0), (0.2, 0.4)), axis, **motion),
        mpm.Obstacle(mpm.shapes.Torus(axis, 0.1), centre, **motion),
        mpm.boundaries.SDF(lambda p: p.abs().sum(1) - 0.3, centre, **motion),
    ]
    time = 0.7
    for body in bodies:
        drawn = render.obstacle_shapes(body, time, bounds)
        assert len(drawn) == (2 if body.shape.name in ("revolved", "torus") and dim == 2 else 1)
        pose = body.pose(time)
        local = (torch.as_tensor(np.concatenate([s.world() for s in drawn])) - pose.centre) @ pose.rotation
        distance, _ = body.shape.surface(local)
        if body.shape.name == "plane" and dim == 2:
            local, distance = local[2:], distance[2:]  # the plate has a thickness behind its surface
        assert distance.abs().max() < (0.006 if body.shape.name == "sdf" else 1e-9)


def test_obstacles_that_do_not_act_are_not_drawn():
    body = mpm.boundaries.Sphere((0.5, 0.5), 0.1, start=1.0, end=2.0, scene=3)
    bounds = ((0, 0), (1, 1))
    assert [len(render.obstacle_shapes(body, t, bounds, scene=3)) for t in (0.5, 1.0, 1.9, 2.0)] == [0, 1, 1, 0]
    assert render.obstacle_shapes(body, 1.5, bounds, scene=0) == []


def distance_to_segment(p, length):
    nearest = np.clip(p[:, 0], 0, length)
    return np.linalg.norm(p - nearest[:, None] * [1, 0, 0], axis=1)


def area_of(shape):
    a, b, c = (shape.world()[shape.faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def test_software_and_vtk_agree():
    need_opengl()
    x = lattice((0.3, 0, 0.3), (0.7, 0.5, 0.7), 0.04)
    pictures = []
    for backend in ("vtk", "software"):
        with render.Renderer(UNIT, SMALL, color_by=None, radius=0.024, backend=backend) as renderer:
            assert renderer.backend == backend
            pictures.append(renderer.frame(x, obstacles=[shapes.sphere((0.2, 0.8, 0.5), 0.1)]).astype(int))
    difference = np.abs(pictures[0] - pictures[1]).mean(axis=2)
    assert difference.mean() < 4 and (difference > 60).mean() < 0.02


def test_ground_shows_shadow_and_zero_particles_show_the_ground(backend):
    with render.Renderer(UNIT, SMALL, color_by=None, radius=0.08, backend=backend) as renderer:
        ground = renderer.frame(np.zeros((0, 3)))
        assert len(np.unique(ground.reshape(-1, 3), axis=0)) > 20
        scene = renderer.scene
        body = np.array([[0.5, 0.3, 0.5]])
        shadow_at = body[0] + 0.3 / -scene.ground.light[1] * scene.ground.light
        column, row = renderer.project([shadow_at])[0].astype(int)
        assert renderer.frame(body)[row, column].mean() < ground[row, column].mean() - 10


def test_not_finite_particles_are_left_out_and_reported(plain, caplog):
    x = np.array([[0.5, 0.5, 0.5], [np.nan, 0.2, 0.2], [0.2, np.inf, 0.2]])
    with caplog.at_level("WARNING"):
        image = plain.frame(x)
    assert "2 of 3 particles" in caplog.text
    assert np.array_equal(image, plain.frame(x[:1]))
    assert np.array_equal(plain.frame(np.full((3, 3), np.nan)), plain.frame(np.zeros((0, 3))))


def test_torch_tensors_with_any_strides_and_gradients(plain):
    x = torch.rand(3, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float32).T.requires_grad_()
    assert np.array_equal(plain.frame(x), plain.frame(x.detach().numpy().copy()))


def test_surface_is_closed_and_at_the_particles():
    """A ball of particles has the area of a sphere, normals outward, and leaves a lone drop to the spheres."""
    s = 0.05
    ball = lattice((-1, -1, -1), (1, 1, 1), s)
    ball = ball[np.linalg.norm(ball, axis=1) < 0.8]
    x = np.concatenate([ball, [[1.5, 0, 0]]])
    skin, loose = cloud.surface(x, np.full((len(x), 3), 90, np.uint8), s)
    radius = np.linalg.norm(skin.vertices, axis=1)
    assert np.abs(radius - 0.8).max() < s
    assert np.all(np.sum(skin.normals * skin.vertices, axis=1) > 0)
    corners = skin.vertices[skin.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(4 * np.pi * 0.8**2, rel=0.05)
    assert np.sum(normal * corners[:, 0]) / 6 == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.05)  # divergence theorem
    assert loose[-1] and loose[:-1].mean() < 0.01


def test_surface_style_draws(backend):
    x = lattice((0.3, 0.1, 0.3), (0.7, 0.5, 0.7), 0.04)
    with render.Renderer(UNIT, SMALL, color_by=None, ground=False, style="surface", backend=backend) as renderer:
        seen = centroid(renderer.frame(x), renderer.frame(np.zeros((0, 3))))
        assert np.abs(seen - renderer.project([x.mean(axis=0)])[0]).max() < 8


def test_surfaces_are_drawn_beside_particles(backend):
    """At their place, in the colour of their vertices, smooth, and in front of what they hide."""
    ball = shapes.sphere((0, 0, 0), 0.15)
    at = np.array([0.3, 0.5, 0.5])
    mesh = Surface(ball.vertices + at, ball.faces, (ball.vertices / 0.15).astype(np.float32))
    with render.Renderer(UNIT, SMALL, color_by="material", radius=0.05, ground=False, backend=backend) as renderer:
        beside = np.array([[0.8, 0.5, 0.5]])
        behind = at[None] + 0.4 * renderer.scene.camera.forward
        values = np.ones(len(mesh.vertices))
        empty = renderer.frame(np.zeros((0, 3)), np.zeros(0))
        image = renderer.frame(np.zeros((0, 3)), np.zeros(0), surfaces=[(mesh, values)])
        assert np.abs(centroid(image, empty) - renderer.project([at])[0]).max() < 3
        column, row = renderer.project([at])[0].astype(int)
        both = renderer.frame(np.concatenate([beside, behind]), np.zeros(2), surfaces=[(mesh, values)])
        assert both[row, column, 0] > both[row, column, 2] + 60  # orange, material 1
        column, row = renderer.project(beside)[0].astype(int)
        assert both[row, column, 2] > both[row, column, 0] + 40  # blue, material 0
        nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
        assert np.array_equal(renderer.frame(np.zeros((0, 3)), np.zeros(0), surfaces=[(nothing, np.zeros(0))]), empty)
        with pytest.raises(ValueError, match=r"scalars must have shape \[P\]"):
            renderer.frame(beside, np.zeros(1), surfaces=[(mesh, np.zeros(3))])


def test_surfaces_in_two_dimensions_are_refused():
    mesh = Surface(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.float32))
    with pytest.raises(ValueError, match="surfaces need three dimensions, and the bounds have two"):
        render.Renderer(((0, 0), (1, 1)), SMALL).frame(np.zeros((1, 2)), np.zeros(1), surfaces=[(mesh, np.zeros(3))])


@pytest.mark.parametrize("dim", [2, 3])
def test_rest_spacing(dim):
    x = lattice((0,) * dim, (1.0, 0.5, 0.7)[:dim], 0.02)
    assert cloud.rest_spacing(x) == pytest.approx(0.02, rel=0.1)
    shuffled = np.random.default_rng(0).permutation(x) + 5
    assert cloud.rest_spacing(shuffled) == pytest.approx(0.02, rel=0.1)
    assert cloud.rest_spacing(x[:1]) == 0 and cloud.rest_spacing(np.zeros((4, dim))) == 0


def test_only_enclosed_particles_are_culled():
    x = lattice((0, 0, 0), (1, 1, 1), 0.025)
    hidden = ~cloud.visible(x, 0.025)
    assert hidden.sum() > 0.3 * len(x)
    assert np.abs(x[hidden] - 0.5).max() < 0.5 - 2 * 0.025  # two layers stay


def test_colour_scale_ends_and_clipping():
    import matplotlib

    ends = [np.round(np.array(matplotlib.colormaps["viridis"](v)[:3]) * 255) for v in (0.0, 1.0)]
    rgb = colors.map_colors(np.array([2.0, 5.0, -9.0, 99.0, np.nan, np.inf]), (2.0, 5.0), "viridis")
    assert np.array_equal(rgb[0], ends[0]) and np.array_equal(rgb[1], ends[1])
    assert np.array_equal(rgb[2], ends[0]) and np.array_equal(rgb[3], ends[1]) and np.array_equal(rgb[5], ends[1])
    assert np.array_equal(rgb[4], [128, 128, 128])


def test_range_of_a_frame():
    values = np.append(np.linspace(100, 200, 1001), [np.nan, np.inf])
    assert colors.value_range(values, from_zero=False) == pytest.approx((101, 199))
    assert colors.value_range(values, from_zero=True) == pytest.approx((0, 199))
    assert colors.value_range(np.zeros(5), from_zero=True) == (0, 1)
    assert colors.value_range(np.full(5, 300.0), from_zero=False) == pytest.approx((300, 300.3))
    assert colors.value_range(np.array([np.nan]), from_zero=False) == (0, 1)


def test_scalars_of_vectors_and_tensors():
    v = np.array([[3.0, 4.0, 0.0]])
    assert colors.scalar_of("speed", v, 1) == pytest.approx([5.0])
    uniaxial = np.diag([7.0, 0, 0])[None]
    assert colors.von_mises(uniaxial) == pytest.approx([7.0])
    assert colors.von_mises(np.eye(3)[None] * 5) == pytest.approx([0.0], abs=1e-12)
    shear = np.array([[[0.0, 2.0], [2.0, 0.0]]])
    assert colors.von_mises(shear) == pytest.approx([2 * np.sqrt(3)])
    with pytest.raises(ValueError, match=r"scalars must have shape \[P\] or \[P, D\] with P = 4 for speed, got \[3\]"):
        colors.scalar_of("speed", np.zeros(3), 4)


def test_two_dimensional_picture():
    with render.Renderer(((0, 0), (2, 1)), SMALL, color_by="speed", range=(0, 1), cmap="gray") as renderer:
        assert renderer.backend == "matplotlib"
        x = np.array([[0.5, 0.5]])
        renderer.radius = 0.1
        image = renderer.frame(x, np.array([0.0]), time=0.5, title="one")
        column, row = renderer.project(x)[0].astype(int)
        assert image[row, column].max() < 10  # the low end of the scale is black
        assert renderer.frame(x, np.array([1.0]))[row, column].min() > 245
        line = renderer.frame(x, np.array([1.0]), overlays=[(np.array([[0, 0.5], [2, 0.5]]), "red", "front")])
        assert line[row, column, 0] > 200 and line[row, column, 1] < 60
        wall = renderer.frame(
            x[:0], np.zeros(0), obstacles=[shapes.capsule((0.5, 0.3), (0.5, 0.7), 0.1, color=(0, 1, 0))]
        )
        assert tuple(wall[row, column]) == (0, 255, 0)


def test_heights_can_be_exaggerated():
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 0.5]])
    for factor in (1.0, 3.0):
        with render.Renderer(((0, 0), (4, 0.5)), SMALL, exaggeration=factor) as renderer:
            at, right, up = renderer.project(corners)
            assert at[1] - up[1] == pytest.approx(factor * (right[0] - at[0]) / 8)


def test_scale_and_legend_are_drawn():
    x = np.array([[0.5, 0.5, 0.5]])
    for kind, names in (("speed", ()), ("material", ("water", "jelly"))):
        renderer = render.Renderer(UNIT, color_by=kind, range=(0, 1), materials=names, radius=0.02, backend="software")
        bare = renderer.scene.draw(x, np.full((1, 3), 9, np.uint8), 0.02, "particles", [])
        marked = renderer.frame(x, np.zeros(1), time=1.0)
        difference = np.abs(marked.astype(int) - bare.astype(int)).max(axis=2) > 40
        assert difference[100:620, 1120:].sum() > 150  # scale or legend on the right
        assert difference[650:, :300].sum() > 100  # time stamp


def test_line_over_a_three_dimensional_picture(plain):
    ends = np.array([[0.1, 0.5, 0.5], [0.9, 0.5, 0.5]])
    image = plain.frame(np.zeros((0, 3)), overlays=[(ends, "red", "")])
    column, row = plain.project(ends.mean(axis=0)[None])[0].astype(int)
    assert tuple(image[row, column]) == (255, 0, 0)


def test_wrong_arguments_are_named():
    for arguments, message in [
        ({"bounds": ((0, 0), (1, 0))}, "bounds must be .lower, upper. with lower < upper"),
        ({"bounds": UNIT, "style": "mist"}, "style must be"),
        ({"bounds": ((0, 0), (1, 1)), "style": "surface"}, "style must be"),
        ({"bounds": UNIT, "range": (1, 1)}, "range must be"),
        ({"bounds": ((0, 0), (1, 1)), "exaggeration": 0.0}, "exaggeration must be positive, and 1 in 3-D, got 0.0"),
        ({"bounds": UNIT, "exaggeration": 2.0}, "exaggeration must be positive, and 1 in 3-D, got 2.0"),
        ({"bounds": UNIT, "backend": "paint"}, "backend must be"),
    ]:
        with pytest.raises(ValueError, match=message):
            render.Renderer(**arguments)
    renderer = render.Renderer(UNIT, SMALL, backend="software")
    with pytest.raises(ValueError, match=r"x must have shape \[P, 3\], got \[4, 2\]"):
        renderer.frame(np.zeros((4, 2)), np.zeros(4))
    with pytest.raises(ValueError, match="scalars must be given"):
        renderer.frame(np.zeros((4, 3)))
    with pytest.raises(ValueError, match="faces must have shape"):
        shapes.mesh(np.zeros((4, 3)))


def test_no_opengl_is_said_and_drawn_in_software(monkeypatch, caplog):
    failed = subprocess.CompletedProcess([], -11)
    monkeypatch.setattr(scene3d.subprocess, "run", lambda *a, **k: failed)
    scene3d.window_class.cache_clear()
    try:
        with pytest.raises(render.RenderError, match="apt-get install"):
            render.Renderer(UNIT, SMALL, backend="vtk")
        with caplog.at_level("WARNING"):
            assert render.Renderer(UNIT, SMALL).backend == "software"
        assert "apt-get install" in caplog.text
    finally:
        scene3d.window_class.cache_clear()


def test_missing_package_names_the_extra():
    with pytest.raises(ImportError, match=r"no_such_package.*pip install torch-mpm\[render\]"):
        requires.require("no_such_package.part")


def test_png_round_trip_and_atomicity(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (31, 47, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    render.write_png(path, image)
    assert np.array_equal(render.read_png(path), image)
    render.write_png(tmp_path / "small.png", np.full((40, 60, 3), 77, np.uint8), width=30)
    assert np.array_equal(render.read_png(tmp_path / "small.png"), np.full((20, 30, 3), 77))
    (tmp_path / "small.png").unlink()
    with pytest.raises(ValueError, match=r"image must be uint8 \[H, W, 3\], got float64"):
        render.write_png(path, image / 255)

    def broken(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("PIL.Image.Image.save", broken)
        with pytest.raises(OSError, match="No space left"):
            render.write_png(path, np.zeros_like(image))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert np.array_equal(render.read_png(path), image)


def frames_of(path):
    """Frames uint8 [H, W, 3] of a video, and its frames per second."""
    reader = iio.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    return [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader], about["fps"]


def test_video_from_pngs_reads_back(tmp_path):
    grey = (20, 120, 220)
    paths = [tmp_path / f"{i}.png" for i in range(3)]
    for path, value in zip(paths, grey, strict=True):
        render.write_png(path, np.full((45, 63, 3), value, np.uint8))  # odd sizes, which H.264 with 4:2:0 refuses
    render.assemble_video(paths, tmp_path / "out.mp4", fps=10)
    frames, fps = frames_of(tmp_path / "out.mp4")
    assert fps == 10
    assert [f.shape for f in frames] == [(46, 64, 3)] * 3
    assert [abs(float(f.mean()) - g) < 4 for f, g in zip(frames, grey, strict=True)] == [True] * 3


def test_failed_video_leaves_the_old_one_whole(tmp_path):
    path = tmp_path / "out.mp4"
    path.write_bytes(b"old")
    frame = np.zeros((32, 32, 3), np.uint8)
    with pytest.raises(RuntimeError, match="stop"), render.VideoWriter(path, 10) as video:
        video.append(frame)
        raise RuntimeError("stop")
    with pytest.raises(ValueError, match="like the first"), render.VideoWriter(path, 10) as video:
        video.append(frame)
        video.append(frame[:16])
    with pytest.raises(render.RenderError, match="at least one frame"), render.VideoWriter(path, 10):
        pass
    assert path.read_bytes() == b"old" and [p.name for p in tmp_path.iterdir()] == ["out.mp4"]


def test_a_video_that_is_interrupted_at_its_end_leaves_nothing(tmp_path, monkeypatch):
    waited = []

    def interrupted(process, timeout=None):
        waited.append(process)
        monkeypatch.undo()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), render.VideoWriter(tmp_path / "out.mp4", 10) as video:
        video.append(np.zeros((32, 32, 3), np.uint8))
        monkeypatch.setattr(subprocess.Popen, "wait", interrupted)
    assert list(tmp_path.iterdir()) == [] and waited[0].poll() is not None


def test_a_video_that_is_interrupted_at_its_begin_leaves_nothing(tmp_path, monkeypatch):
    """The same while its encoder starts, before the writer can end it."""
    started = []

    class Interrupted(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt), render.VideoWriter(tmp_path / "out.mp4", 10) as video:
        video.append(np.zeros((32, 32, 3), np.uint8))
    assert list(tmp_path.iterdir()) == [] and started[0].poll() is not None


def test_killed_video_has_no_file_under_its_name(tmp_path):
    code = (
        "import os, signal, sys, numpy as np\n"
        "from torch_mpm.render import VideoWriter\n"
        "video = VideoWriter(sys.argv[1], 10)\n"
        "for _ in range(30): video.append(np.zeros((64, 64, 3), np.uint8))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "out.mp4")], check=False)
    assert done.returncode == -9
    assert not (tmp_path / "out.mp4").exists()


def test_contact_sheet_places_frames_in_rows():
    frames = [np.full((90, 160, 3), v, np.uint8) for v in (0, 60, 120, 180, 240)]
    sheet = render.contact_sheet(frames, columns=3, width=308)
    assert sheet.shape == (2 * 56 + 4, 308, 3)
    assert [int(sheet[28, 50 + 104 * i, 0]) for i in range(3)] == [0, 60, 120]
    assert [int(sheet[88, 50 + 104 * i, 0]) for i in range(3)] == [180, 240, 255]
    with pytest.raises(ValueError, match="at least one picture"):
        render.contact_sheet([], 2)


@pytest.mark.parametrize("scenes", [1, 4, 9, 25])
def test_labels_are_inside_the_pictures_of_a_batch(scenes):
    """Axis labels, tick labels, title and colour bar, for the smallest pictures of a sheet too."""
    columns = math.isqrt(scenes)
    renderer = render.Renderer(((0.0, 0.0), (1.0, 1.0)), (1280 // columns, 720 // columns), "speed", (0.0, 1.0))
    image = renderer.frame(torch.rand(10, 2), torch.rand(10, 2), time=1.0, title="one")
    scene = renderer.scene
    texts = [scene.axes.xaxis.label, scene.axes.yaxis.label, scene.title, scene.stamp, scene.bar.yaxis.label]
    texts += [*scene.axes.get_xticklabels(), *scene.axes.get_yticklabels(), *scene.bar.get_yticklabels()]
    for text in texts:
        box = text.get_window_extent()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= image.shape[1] and box.y1 <= image.shape[0], text


@pytest.mark.parametrize("origin", [None, (500000.0, 4e6)])
@pytest.mark.parametrize("resolution", [(16, 16), (64, 64), (16, 400), (400, 16), (100, 64)])
def test_pictures_without_room_for_their_text(resolution, origin):
    """The axes keep a share of the picture, so that particles are drawn."""
    renderer = render.Renderer(((0.0, 0.0), (1.0, 1.0)), resolution, "speed", (0.0, 1.0), origin=origin)
    image = renderer.frame(torch.rand(10, 2), torch.rand(10, 2), time=1.0, title="one")
    assert image.shape == (resolution[1], resolution[0], 3)
    box = renderer.scene.axes.get_position()
    assert box.width > 0 and box.height > 0 and 0 <= box.x0 < 0.95 and 0 <= box.y0 < 0.95
