"""Bodies below and above height surfaces: volumes by hand, seeding, and obstacles that hold what falls on them."""

import numpy as np
import pytest
import torch

import torch_mpm as mpm
from torch_mpm.boundaries import Obstacle
from torch_mpm.geometry import shapes

trimesh = pytest.importorskip("trimesh")
from torch_mpm.meshes import terrain  # noqa: E402

LOWER, SPACING, COUNTS = (-0.4, 0.2), 0.1, (9, 7)


def height(x, y):
    """Linear along each axis in each cell, so that triangles of either diagonal have its mean volume where it is
    a plane.
    """
    return 0.1 + 0.25 * x - 0.125 * y


def lattice():
    x, y = (a + SPACING * np.arange(n) for a, n in zip(LOWER, COUNTS, strict=True))
    return height(x[:, None], y[None])


def placed(axis, level, kind):
    if kind == "heights":
        return shapes.Terrain(lattice(), level, LOWER, SPACING, axis)
    vertices, faces = terrain.on_lattice(lattice(), LOWER, SPACING, axis)
    faces[::3] = faces[::3, ::-1]  # triangles of a scan may be turned against each other
    return shapes.Terrain(trimesh.Trimesh(vertices, faces, process=False), level, axis=axis)


@pytest.mark.parametrize("kind", ["heights", "mesh"])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("level", [-0.5, 0.75])
def test_volume_places_and_distance(kind, axis, level):
    """Sloping plane: the expected volume is area times mean height above the level."""
    body = placed(axis, level, kind)
    area, middle = 0.8 * 0.6, height(0.0, 0.5)
    assert body.volume(3) == pytest.approx(area * abs(middle - level), rel=1e-12)
    x = torch.rand(8000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.6
    flat = [x[:, k] for k in range(3) if k != axis]
    up = x[:, axis] - height(*flat)
    between = (up < 0) & (x[:, axis] > level) if level < 0 else (up > 0) & (x[:, axis] < level)
    within = (flat[0].abs() < 0.4) & (flat[1] > 0.2) & (flat[1] < 0.8)
    assert torch.equal(body.contains(x), between & within) and between.any()
    near = within & (up.abs() < 0.03) & (flat[0].abs() < 0.35) & ((flat[1] - 0.5).abs() < 0.25)
    slope = (1 + 0.25**2 + 0.125**2) ** 0.5
    distance, normal = body.surface(x[near])
    side = 1 if level < 0 else -1
    torch.testing.assert_close(distance, side * up[near] / slope, rtol=0, atol=1e-12)
    assert near.sum() > 3 and (normal[:, axis] * side > 0.9).all()


def test_seeding_below_a_surface():
    body = placed(2, -0.5, "heights")
    points = mpm.seed.fill(mpm.seed.Region(body, (1.0, 2.0, 3.0)), 0.05, dtype=torch.float64)
    x = points.x - torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    assert (x[:, 2] < height(x[:, 0], x[:, 1])).all() and float(x[:, 2].min()) > -0.5
    assert float(points.volume.sum()) == pytest.approx(body.volume(3), rel=1e-12)
    assert len(points) * 0.05**3 / 8 == pytest.approx(body.volume(3), rel=0.03)


def test_a_body_lies_on_sampled_terrain(device):
    """It falls on a hollow, acts in the kernel, and no particle goes below the surface by more than a cell."""
    axis = np.arange(-0.2, 1.21, 0.1)
    heights = 0.2 + 0.3 * ((axis[:, None] - 0.5) ** 2 + (axis[None] - 0.5) ** 2)
    ground = shapes.Terrain(heights, -0.2, (-0.2, -0.2), 0.1)
    sampled = shapes.Sampled.of(ground, (-0.3, -0.3, -0.3), (1.3, 1.3, 0.7), 0.05)
    grid = mpm.Grid(dx=0.1, lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0))
    step = mpm.Step(grid, mpm.NeoHookean(E=1e4, nu=0.3), (0.0, 0.0, -9.8), boundaries=[Obstacle(sampled, (0, 0, 0))])
    points = mpm.seed.box((0.3, 0.3, 0.4), (0.7, 0.7, 0.6), grid, dtype=torch.float64)
    state = mpm.State.at_rest(points, velocity=(0, 0, -1.0), dtype=torch.float64, device=device)
    assert step.explain(state).startswith("all steps in one op")
    with torch.no_grad():
        end = mpm.rollout(step, state, 150, 2e-3)
    above = end.x[:, 2].cpu() - (0.2 + 0.3 * (end.x[:, :2].cpu() - 0.5).square().sum(1))
    assert float(above.min()) > -0.1 and float(above.mean()) < 0.2


def test_what_is_no_terrain():
    heights, rest = lattice(), {"lower": LOWER, "spacing": SPACING}
    vertices, faces = terrain.on_lattice(heights, LOWER, SPACING, 2)
    cliff, fold = vertices.copy(), vertices.copy()
    cliff[9:16, 0] = cliff[2:9, 0] = 0.0
    fold[14:21, 0] -= 0.15
    twice = np.concatenate([vertices, vertices + [0.05, 0, 0.3]]), np.concatenate([faces, faces + len(vertices)])
    mesh = lambda v, f=faces: trimesh.Trimesh(v, f, process=False)  # noqa: E731
    for source, level, options, message in (
        (heights, 0.1, rest, "level must be below the terrain or above it, whose heights are"),
        (heights, np.inf, rest, "level must be finite"),
        (heights, -1.0, {}, "heights need the first node of their lattice, lower, and its spacing"),
        (heights[0], -1.0, rest, r"heights must be finite numbers \[X, Y\], 2 or more each, got \[7\]"),
        (heights * np.nan, -1.0, rest, "heights must be finite numbers"),
        (heights, -1.0, rest | {"axis": 3}, "axis must be 0, 1 or 2, got 3"),
        (mesh(vertices), -1.0, rest, "belong to heights on a lattice"),
        (mesh(cliff), -1.0, {}, "triangles of terrain .* are vertical, near"),
        (mesh(fold), -1.0, {}, "has several heights over a place: it folds over itself at"),
        (mesh(*twice), -1.0, {}, "has several heights over a place: parts of it lie above each other"),
    ):
        with pytest.raises(ValueError, match=message):
            shapes.Terrain(source, level, **options)
