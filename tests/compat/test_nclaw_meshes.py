"""Particles in the meshes of NCLaw's environments, against positions that are known for an octahedron."""

import itertools

import numpy as np
import pytest

from torch_mpm.compat.nclaw import sim

EDGES = np.array([4.0, 2.0, 2.0])
MIDDLE = np.array([7.0, 1.0, -1.0])
SHAPE = {"type": "mesh", "name": "gem", "center": [0.5, 0.4, 0.5], "size": [0.6, 0.3, 0.6], "resolution": 8,
         "mode": "uniform", "sort": 1}  # fmt: skip


@pytest.fixture
def assets(tmp_path, monkeypatch):
    """A folder with an octahedron of edges 4, 2 and 2."""
    corners = np.concatenate([sign * np.diag(EDGES / 2) for sign in (1, -1)]) + MIDDLE
    faces = []
    for signs in itertools.product((0, 3), repeat=3):
        face = [axis + sign for axis, sign in enumerate(signs)]
        faces.append(face if sum(signs) % 2 == 0 else face[::-1])
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    (tmp_path / "gem.obj").write_text("\n".join(lines))
    monkeypatch.setattr(sim.MPMInitData, "assets", tmp_path)
    return tmp_path


def body(**changes):
    return sim.MPMInitData.get({"rho": 1e3, "clip_bound": 0.5, "span": [0, 10], "shape": SHAPE | changes})


def test_a_lattice_in_a_mesh(assets):
    """Its points, sorted from high to low, and volumes that are shares of the bounding box, as in NCLaw."""
    pytest.importorskip("trimesh")
    found = body()
    axis = np.linspace(-1, 1, 8)
    expected = [p for p in itertools.product(axis, repeat=3) if np.abs(p).sum() < 1 - 1e-9]
    unit = (found.pos - SHAPE["center"]) / SHAPE["size"] * 4 / (EDGES / 2)
    on_face = np.abs(np.abs(unit).sum(1) - 1) < 1e-9  # Inside or outside by rounding.
    assert {tuple(p) for p in np.round(unit[~on_face], 9) + 0.0} == {tuple(p) for p in np.round(expected, 9) + 0.0}
    assert len(expected) > 20 and (~on_face).sum() == len(expected) and (np.diff(found.pos[:, 1]) <= 1e-12).all()
    assert found.vol == pytest.approx(np.prod(SHAPE["size"]) / 6 / len(found.pos))
    assert found.num_particles == len(found.pos)
    np.testing.assert_array_equal(found.center, SHAPE["center"])
    found.set_lin_vel([1.0, 2.0, 3.0])
    found.set_ang_vel([0.0, 0.0, 1.0])
    assert np.abs(found.velocity()).max() > 1
    found.zero_lin_vel()
    found.zero_ang_vel()
    assert not found.velocity().any()


def test_points_of_the_sampling_program(assets):
    """Those of the file that NCLaw stores, scaled and moved."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 3))
    np.savez(assets / "gem_8_sampling.npz", p_x=points, vol=0.25 / 9)
    found = body(mode="sampling", sort=None)
    np.testing.assert_allclose(found.pos, points * SHAPE["size"] + SHAPE["center"])
    assert found.vol == pytest.approx(0.25 / 9 * np.prod(SHAPE["size"]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"p_x": np.zeros((4, 3))}, r"must hold p_x \[P, 3\] and vol \[\], got {'p_x': \[4, 3\]}"),
        ({"p_x": np.zeros((4, 2)), "vol": 1.0}, r"must hold p_x \[P, 3\] and vol"),
        ({"p_x": np.full((4, 3), np.nan), "vol": 1.0}, "finite positions and a positive volume"),
        ({"p_x": np.zeros((4, 3)), "vol": 0.0}, "finite positions and a positive volume"),
        ({"p_x": np.array([[{}] * 3], dtype=object), "vol": 1.0}, "cannot be read: it must hold numbers"),
        (None, "cannot be read: File is not a zip file"),
    ],
)
def test_damaged_points(assets, content, message):
    file = assets / "gem_8_texture.npz"
    file.write_bytes(b"PK no") if content is None else np.savez(file, **content)
    with pytest.raises(ValueError, match=message):
        body(mode="texture")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"mode": "sampling"}, ValueError, "must be 'uniform', got 'sampling' without the file .*gem_8_sampling.npz"),
        ({"mode": "random"}, ValueError, "mode of a mesh must be one of uniform, sampling, texture, got 'random'"),
        ({"name": "../gem"}, ValueError, "name of a mesh must have letters, digits, _ and - alone, got '../gem'"),
        ({"name": "bunny"}, OSError, "mesh file .*bunny.obj does not exist"),
        ({"resolution": 1}, ValueError, "resolution must be"),
        ({"resolution": 5000}, ValueError, "resolution must be at most 1000, got 5000"),
        ({"resolution": 2}, ValueError, "holds no point at resolution 2"),
    ],
)
def test_what_has_no_particles(assets, changes, error, message):
    pytest.importorskip("trimesh")
    with pytest.raises(error, match=message):
        body(**changes)


def test_the_folder_is_needed():
    with pytest.raises(ValueError, match="assets must be the folder nclaw/assets"):
        body()
