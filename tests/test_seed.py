"""Seeding: exact volumes, points where they belong, samples that depend on the seed alone."""

import math

import numpy as np
import pytest
import torch

from torch_mpm.geometry import seed

DOUBLE = {"dtype": torch.float64}


def test_box_of_whole_cells_has_per_cell_points_in_each_cell():
    points = seed.box((0.1, 0.2, 0.3), (0.5, 0.4, 0.6), 0.1, per_cell=8, **DOUBLE)
    cells = ((points.x - torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)) / 0.1).floor().long()
    _, counts = cells.unique(dim=0, return_counts=True)
    assert len(points) == 4 * 2 * 3 * 8
    assert counts.tolist() == [8] * 24
    torch.testing.assert_close(points.volume, torch.full((192,), 0.1**3 / 8, **DOUBLE), rtol=1e-13, atol=0)


SHAPES = {
    "box": (lambda **k: seed.box((0.0, 0.1), (0.33, 0.57), 0.02, **k), 0.33 * 0.47),
    "disc": (lambda **k: seed.sphere((0.3, 0.2), 0.21, 0.02, **k), math.pi * 0.21**2),
    "stadium": (lambda **k: seed.capsule((0, 0), (0.3, 0.4), 0.1, 0.02, **k), math.pi * 0.01 + 0.5 * 0.2),
    "ball": (lambda **k: seed.sphere((0.3, 0.2, 0.1), 0.2, 0.05, **k), 4 / 3 * math.pi * 0.2**3),
    "cylinder": (lambda **k: seed.cylinder((0, 0, 0), (0.1, 0.2, 0.2), 0.1, 0.03, **k), math.pi * 0.01 * 0.3),
    "capsule": (
        lambda **k: seed.capsule((0, 0, 0), (0.1, 0.2, 0.2), 0.1, 0.03, **k),
        math.pi * 0.01 * 0.3 + 4 / 3 * math.pi * 1e-3,
    ),
}


@pytest.mark.parametrize("method", ["lattice", "poisson"])
@pytest.mark.parametrize("name", SHAPES)
def test_volumes_add_up_to_the_volume_of_the_shape(name, method):
    make, volume = SHAPES[name]
    points = make(method=method, **DOUBLE)
    assert float(points.volume.sum()) == pytest.approx(volume, rel=1e-13)
    # Without the exact volume the number of points would give it to a few per cent.
    dx = {"box": 0.02, "disc": 0.02, "stadium": 0.02, "ball": 0.05}.get(name, 0.03)
    assert len(points) * dx ** points.x.shape[1] / 8 == pytest.approx(volume, rel=0.06)


def test_ball_has_the_centre_and_inertia_of_a_ball():
    points = seed.sphere((0.3, 0.2, 0.1), 0.2, 0.02, **DOUBLE)
    r = points.x - torch.tensor([0.3, 0.2, 0.1], **DOUBLE)
    assert float(r.norm(dim=1).max()) <= 0.2
    torch.testing.assert_close(r.mean(0), torch.zeros(3, **DOUBLE), rtol=0, atol=1e-12)
    assert float(r.square().sum(1).mean()) == pytest.approx(3 / 5 * 0.2**2, rel=5e-3)


def test_points_of_a_capsule_are_near_its_segment():
    a, b = torch.tensor([0.0, 0.0, 0.0], **DOUBLE), torch.tensor([0.1, 0.2, 0.2], **DOUBLE)
    points = seed.capsule(a, b, 0.1, 0.03, **DOUBLE)
    along = torch.linspace(0, 1, 2001, **DOUBLE)[:, None]
    distance = torch.cdist(points.x, a + along * (b - a)).amin(1)
    assert float(distance.max()) <= 0.1 + 1e-4


@pytest.mark.parametrize("dim", [2, 3])
def test_poisson_disk_sample_keeps_its_distance_and_density(dim):
    dx, per_cell = (0.05, 4) if dim == 2 else (0.2, 8)
    points = seed.box((0.0,) * dim, (1.0,) * dim, dx, per_cell, method="poisson", seed=3, **DOUBLE)
    distance = torch.cdist(points.x, points.x).fill_diagonal_(math.inf).amin(1)
    spacing = dx / per_cell ** (1 / dim)
    assert float(distance.min()) >= spacing / 1.25
    assert float(distance.median()) < 1.05 * spacing  # and no large holes
    inner = ((points.x > 0.1) & (points.x < 0.9)).all(1)
    assert int(inner.sum()) == pytest.approx(per_cell * (0.8 / dx) ** dim, rel=0.06)


def test_poisson_disk_sample_depends_on_the_seed_alone():
    one, same, other = (seed.box((0, 0), (1, 1), 0.1, method="poisson", seed=s) for s in (1, 1, 2))
    assert torch.equal(one.x, same.x)
    assert one.x.shape != other.x.shape or not torch.equal(one.x, other.x)


@pytest.fixture
def trimesh():
    return pytest.importorskip("trimesh")


def test_mesh_is_filled_inside(trimesh):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    points = seed.mesh(ball, 0.08, scale=2.0, offset=(1, 2, 3), **DOUBLE)
    r = (points.x - torch.tensor([1, 2, 3], **DOUBLE)).norm(dim=1)
    assert float(points.volume.sum()) == pytest.approx(ball.volume * 8, rel=1e-12)
    assert float(r.max()) <= 0.4
    assert len(points) == pytest.approx(ball.volume * 8 * 8 / 0.08**3, rel=0.05)


def test_mesh_with_a_cavity_stays_hollow(trimesh):
    outer, inner = trimesh.creation.icosphere(2, 0.4), trimesh.creation.icosphere(2, 0.2)
    inner.invert()
    hollow = trimesh.util.concatenate([outer, inner])
    points = seed.mesh(hollow, 0.1, **DOUBLE)
    assert float(points.x.norm(dim=1).min()) >= 0.19


def test_open_mesh_is_refused(trimesh, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export(tmp_path / "open.ply")
    with pytest.raises(ValueError, match=r"open.ply is not closed: 3 of its edges .* close the holes"):
        seed.mesh(tmp_path / "open.ply", 0.1)


def test_mesh_without_trimesh_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"pip install torch-mpm\[mesh\]"):
        seed.mesh("some.ply", 0.1)


def test_points_files(tmp_path):
    x, volume = np.random.default_rng(0).random((7, 3)), np.linspace(1, 2, 7)
    np.save(tmp_path / "a.npy", x)
    np.savez(tmp_path / "a.npz", x=x, volume=volume)
    table = np.column_stack([x, volume])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="x,y,z,volume", comments="", fmt="%.17g")
    shared = seed.file(tmp_path / "a.npy", volume=14.0, **DOUBLE)
    np.testing.assert_array_equal(shared.x, x)
    assert shared.volume.tolist() == [2.0] * 7
    for name in ("a.npz", "a.csv"):
        points = seed.file(tmp_path / name, **DOUBLE)
        np.testing.assert_array_equal(points.x, x)
        np.testing.assert_array_equal(points.volume, volume)


def test_points_files_that_are_wrong(tmp_path):
    np.save(tmp_path / "flat.npy", np.zeros(4))
    np.save(tmp_path / "nan.npy", np.full((3, 2), np.nan))
    np.save(tmp_path / "good.npy", np.zeros((3, 2)))
    np.save(tmp_path / "object.npy", np.array([[1, None]], dtype=object), allow_pickle=True)
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    for name, message in {
        "flat.npy": r"must have shape \[P, 2\] or \[P, 3\] with P > 0, got \[4\]",
        "nan.npy": "must be finite",
        "good.txt": "does not exist",
        "bad.csv": r"columns x, y, \(z,\) \(volume\), got \['a', 'b'\]",
        "object.npy": "must hold numbers, got an array of object",
    }.items():
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            seed.file(tmp_path / name, volume=1.0)
    with pytest.raises(ValueError, match="give the total volume"):
        seed.file(tmp_path / "good.npy")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: seed.box((0, 0), (1, 0), 0.1),
            r"lower must be below upper on every axis, got \[0.0, 0.0\] and \[1.0, 0.0\]",
        ),
        (lambda: seed.box((0, 0), (1, 1, 1), 0.1), r"upper must have 2 numbers"),
        (lambda: seed.box((0, 0), (1, 1), -0.1), "dx must be positive, got -0.1"),
        (lambda: seed.box((0, 0), (1, 1), 0.1, per_cell=0), "per_cell must be positive, got 0"),
        (
            lambda: seed.box((0, 0), (1, 1), 0.1, method="random"),
            'method must be "lattice", "jittered" or "poisson", got \'random\'',
        ),
        (lambda: seed.sphere((0, 0), math.inf, 0.1), "radius must be positive, got inf"),
        (lambda: seed.sphere((0, math.nan), 1, 0.1), "center must be finite"),
        (lambda: seed.cylinder((0, 0), (1, 1), 1, 0.1), "a cylinder needs three dimensions"),
        (lambda: seed.capsule((0, 0), (0, 0), 1, 0.1), "the distance from a to b must be positive"),
    ],
)
def test_wrong_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_mesh_file_that_is_not_there_is_named():
    pytest.importorskip("trimesh")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.obj does not exist"):
        seed.mesh("nowhere.obj", 0.1)


def test_a_shape_without_points_is_refused():
    class Nowhere(seed.Box):
        def inside(self, x):
            return torch.zeros(len(x), dtype=torch.bool)

    with pytest.raises(ValueError, match=r"too small for its particles: spacing 0\.05 m; use a finer grid"):
        seed.fill(Nowhere((0, 0), (1, 1)), 0.1, 4)


@pytest.mark.parametrize("method", ["lattice", "poisson"])
@pytest.mark.parametrize(
    "shape",
    [seed.Box([0.0] * 3, [1e30] * 3), seed.Sphere([0.0] * 2, 1e200), seed.Capsule([0.0] * 3, [1.0] * 3, 1e60)],
    ids=["box", "sphere", "capsule"],
)
def test_more_points_than_memory_holds_are_refused_at_once(shape, method):
    with pytest.raises(ValueError, match=r"points at a spacing of .*; make the shape smaller, dx larger"):
        seed.fill(shape, 0.1, method=method)
    with pytest.raises(ValueError, match=r"points at a spacing of .*; make the shape smaller, dx larger"):
        seed.fill(seed.Box([0.0] * 2, [1.0] * 2), 0.1, 1e9, method=method)


def test_jittered_points_stay_in_their_cells_and_depend_on_the_seed():
    box = seed.Box((0.0, 0.0), (1.0, 2.0))
    lattice = seed.fill(box, 0.1, 4, dtype=torch.float64)
    a, b = (seed.fill(box, 0.1, 4, method="jittered", seed=k, dtype=torch.float64) for k in (1, 2))
    offsets = (a.x - lattice.x) / 0.05
    assert offsets.abs().max() <= 0.5 and not torch.equal(a.x, b.x)
    assert torch.equal(a.x, seed.fill(box, 0.1, 4, method="jittered", seed=1, dtype=torch.float64).x)
    # uniform in [-1/2, 1/2]: mean 0 and variance 1/12, with the errors of 2 x 800 numbers
    assert abs(offsets.mean()) < 4 * (1 / 12 / 1600) ** 0.5 and abs(offsets.var() * 12 - 1) < 0.15


@pytest.mark.parametrize("method", ["lattice", "jittered", "poisson"])
@pytest.mark.parametrize("shape", [seed.Sphere((0.0, 0.0, 0.0), 1.0), seed.Box((0.0, 0.0), (1.0, 0.3))])
def test_an_exact_number_of_points(method, shape):
    for count in (1, 7, 200):
        points = seed.fill(shape, 0.1, count=count, method=method, seed=3, dtype=torch.float64)
        assert len(points) == count and bool(shape.inside(points.x).all())
        assert abs(float(points.volume.sum()) / shape.volume - 1) < 1e-12
    with pytest.raises(ValueError, match="count must be at least 1"):
        seed.fill(shape, 0.1, count=0)


@pytest.mark.parametrize("method", ["lattice", "jittered", "poisson"])
@pytest.mark.parametrize("shape", [seed.Sphere((0.3, 0.2, 0.1), 0.2), seed.Box((0.1, 0.2), (0.4, 0.9))])
def test_an_exact_number_is_a_choice_from_the_widest_spacing_that_has_as_many(shape, method):
    for count in (37, 150):
        spacing, every = (shape.volume / count) ** (1 / len(shape.lower)), torch.empty(0)
        while len(every) < count:
            every = seed.fill(shape, spacing, 1, method=method, seed=5, **DOUBLE).x
            spacing *= seed.CLOSER
        chosen = seed.fill(shape, 1.0, count=count, method=method, seed=5, **DOUBLE).x
        assert torch.equal(every[(every[:, None] == chosen).all(2).any(1)], chosen)  # in the same order, too


def test_a_shape_that_is_smaller_than_its_volume_says():
    box = seed.Box((0.0, 0.0), (1.0, 1.0))
    box.volume = 1e6
    with pytest.raises(ValueError, match=r"has space for fewer than 200 points.*is its volume correct"):
        seed.fill(box, 0.1, count=200)


def test_progress_of_filling(monkeypatch):
    monkeypatch.setattr(seed, "CHUNK", 100)
    reports = []
    points = seed.box((0, 0), (1, 1), 0.1, per_cell=2.25, progress=lambda done, count: reports.append((done, count)))
    assert reports == [(100, 225), (200, 225), (225, 225)] and len(points) == 225
