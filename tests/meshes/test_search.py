"""Search trees, against a loop over all triangles: inside or outside, nearest point, distance and gradients."""

import numpy as np
import pytest
import torch
from pairs import each_once

import torch_mpm as mpm
from torch_mpm.geometry import shapes
from torch_mpm.geometry.shapes.mesh import _nearest_of_all, _winding_number
from torch_mpm.meshes import nearest, winding

trimesh = pytest.importorskip("trimesh")
from trimesh import creation  # noqa: E402


def bumpy(seed=0):
    """A ball with bumps, of triangles of many sizes."""
    ball = creation.icosphere(3, 0.3)
    rng = np.random.default_rng(seed)
    ball.vertices *= 1 + 0.3 * np.sin(ball.vertices @ rng.normal(0, 12, 3))[:, None]
    return ball


def needles():
    """A thin cylinder: each triangle of an end reaches from the middle to the border, sides are long."""
    return creation.cylinder(radius=0.2, height=0.5, sections=200)


def turned_box():
    cube = creation.box((0.5, 0.3, 0.2))
    cube.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 2, 3)))
    return cube


def parts():
    """Two that overlap, one inside out that cuts into them, and a triangle of no area."""
    joined = trimesh.util.concatenate([bumpy(1), creation.box((0.4, 0.4, 0.4)), creation.icosphere(2, 0.25)])
    faces = joined.faces.copy()
    faces[-320:] = faces[-320:, ::-1]
    return trimesh.Trimesh(joined.vertices, faces, process=False)


MESHES = {
    "box": lambda: creation.box((0.4, 0.4, 0.4)),
    "turned box": turned_box,
    "bumpy": bumpy,
    "needles": needles,
    "torus": lambda: creation.torus(0.3, 0.1),
    "parts": parts,
}


def corners(mesh):
    return torch.tensor(np.array(mesh.triangles), dtype=torch.float64)


def indexed(mesh):
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)


def anywhere(count, reach=0.5, seed=3):
    return reach * (2 * torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 1)


@pytest.mark.parametrize("name", MESHES)
def test_winding_number_is_that_of_angles(name):
    x, mesh = anywhere(1500), MESHES[name]()
    angles = torch.cat([_winding_number(part, corners(mesh)) for part in x.split(100)])
    found = winding.Columns(*indexed(mesh)).winding(x.numpy())
    np.testing.assert_allclose(found, angles, atol=1e-9)
    assert (found != 0).any()


@pytest.mark.parametrize("name", ["box", "grid of boxes"])
def test_lines_through_vertices_and_edges(name):
    """Points right above and below vertices, edges and diagonals of faces, and sides that are vertical."""
    mesh = creation.box((0.4, 0.4, 0.4))
    if name != "box":
        places = [(0.4 * i, 0.4 * j, 0.0) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        mesh = trimesh.util.concatenate(
            [creation.box((0.4,) * 3, trimesh.transformations.translation_matrix(p)) for p in places]
        )
    axis = torch.linspace(-0.8, 0.8, 33, dtype=torch.float64)
    x = torch.cartesian_prod(axis, axis, torch.linspace(-0.31, 0.33, 9, dtype=torch.float64))
    found = torch.from_numpy(winding.Columns(*indexed(mesh)).winding(x.numpy()))
    half = 0.2 if name == "box" else 0.6
    inside = (x[:, 2].abs() < 0.2) & (x[:, :2].abs() < half - 1e-9).all(1)
    outside = (x[:, 2].abs() > 0.2) | (x[:, :2].abs() > half + 1e-9).any(1)
    assert (found[inside] == 1).all() and (found[outside] == 0).all()


@pytest.mark.parametrize(*each_once(name=MESHES, dtype=[torch.float32, torch.float64]))
def test_distance_and_normal_are_those_of_all_triangles(name, dtype):
    shape, x = shapes.Mesh(MESHES[name]()) if name != "parts" else None, torch.cat([anywhere(300), anywhere(50, 5.0)])
    if shape is None:
        with pytest.warns(UserWarning, match="parts overlap"):
            shape = shapes.Mesh(MESHES[name]())
    x = x.to(dtype).requires_grad_()
    distance, normal = shape.surface(x)
    every = _nearest_of_all(x, shape._corners(x))
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    side = torch.where(shape.contains(x), -1, 1)
    atol = 1e-12 if dtype == torch.float64 else 2e-6
    torch.testing.assert_close(distance, side * (x - every).norm(dim=1), rtol=0, atol=atol)
    torch.testing.assert_close(gradient, normal, rtol=0, atol=1e-6 if dtype == torch.float64 else 1e-2)
    assert distance.dtype == normal.dtype == dtype


def test_results_do_not_depend_on_how_many_pairs_are_computed_together(monkeypatch):
    mesh, x = parts(), anywhere(400).numpy()
    expected = winding.Columns(*indexed(mesh)).winding(x), nearest.Tree(corners(mesh).numpy()).nearest(x)
    monkeypatch.setattr(winding, "PAIRS", 50)
    monkeypatch.setattr(nearest, "PAIRS", 64)
    monkeypatch.setattr(nearest, "POINTS", 16)
    columns = winding.Columns(*indexed(mesh))
    np.testing.assert_array_equal(columns.winding(x), expected[0])
    triangles = corners(mesh)[torch.from_numpy(nearest.Tree(corners(mesh).numpy()).nearest(x))]
    places = [nearest.nearest_on_triangles(torch.from_numpy(x), t) for t in (triangles, corners(mesh)[expected[1]])]
    torch.testing.assert_close(*((torch.from_numpy(x) - p).norm(dim=1) for p in places), rtol=1e-9, atol=0)


def test_triangles_without_area_have_nearest_points():
    x = torch.tensor([[0.5, 1.0, 0.0], [3.0, 0.0, 0.0], [-1.0, 0.0, 2.0]], dtype=torch.float64)
    needle = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=torch.float64)
    point = torch.zeros(3, 3, dtype=torch.float64)
    found = nearest.nearest_on_triangles(x, needle[None])
    assert found.tolist() == [[0.5, 0, 0], [2, 0, 0], [0, 0, 0]]
    assert nearest.nearest_on_triangles(x, point[None]).tolist() == [[0.0] * 3] * 3


def test_no_points():
    empty = torch.zeros(0, 3, dtype=torch.float64)
    distance, normal = shapes.Mesh(creation.box((0.4,) * 3)).surface(empty)
    assert distance.shape == (0,) and normal.shape == (0, 3)


def test_transforms_and_compilers_see_every_triangle():
    """The values of points are hidden from search trees there."""
    shape, x = shapes.Mesh(turned_box()), anywhere(20)
    expected, normal = shape.surface(x)
    values, pull_back = torch.func.vjp(shape.signed_distance, x)
    torch.testing.assert_close(values, expected)
    torch.testing.assert_close(pull_back(torch.ones_like(values))[0], normal)
    with torch._subclasses.FakeTensorMode(allow_non_fake_inputs=True) as mode:
        assert shape.contains(mode.from_tensor(x)).shape == (20,)


@pytest.mark.parametrize("method", ["lattice", "jittered", "poisson"])
def test_a_scan_is_filled_in_bounded_memory(method, monkeypatch):
    """The largest array of lines and triangles is small against all pairs of a point and a triangle, 10^8 here."""
    ball = creation.icosphere(5, 0.4)
    largest: list[int] = []
    monkeypatch.setattr(winding, "PAIRS", 2**12)
    plain = winding._expanded
    monkeypatch.setattr(winding, "_expanded", lambda *a: largest.append(len((made := plain(*a))[0])) or made)
    points = mpm.seed.mesh(ball, 0.05, per_cell=2, method=method, dtype=torch.float64)
    assert len(points) == pytest.approx(ball.volume / 0.05**3 * 2, rel=0.05)
    assert float(points.x.norm(dim=1).max()) < 0.4
    assert max(largest) < 2 * winding.PAIRS
