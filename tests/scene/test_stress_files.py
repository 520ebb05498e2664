"""Stresses in files: trajectories, data sets, VTK and pictures name their measure; old files stay as they were."""

import hashlib
import json

import numpy as np
import pytest

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

import h5py
from generated import configuration
from helpers import disc

from torch_mpm import data
from torch_mpm.data import trajectory
from torch_mpm.data.configuration import FORMAT, Configuration
from torch_mpm.data.export import export_vtk
from torch_mpm.data.exports.scenes import export_scenes_vtk
from torch_mpm.data.folder import DatasetFolder
from torch_mpm.data.generate import generate
from torch_mpm.data.stress import MEASURES, drawn_stress, von_mises
from torch_mpm.data.trajectory import PARTIAL, Layout, Trajectory, TrajectoryWriter, create
from torch_mpm.scene import Scene, SceneError
from torch_mpm.scene.scene import COSMETIC

E, NU = 2e3, 0.3
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
FIELDS = ["F", *MEASURES]
JELLY = {"jelly": {"law": "neo_hookean", "E": E, "nu": NU}}
SOFT = {"material": JELLY, "body__0__center": (0.5, 0.26), "body__0__velocity": (0.3, -3.0), "device": "cpu"}


def by_hand(F):
    """The fields of a neo-Hookean solid in plane strain, from F [..., 2, 2]."""
    J = np.linalg.det(F)[..., None, None]
    tau = MU * (F @ np.swapaxes(F, -1, -2) - np.eye(2)) + LAM * np.log(J) * np.eye(2)
    sigma = np.zeros((*F.shape[:-2], 3, 3))
    sigma[..., :2, :2] = tau / J
    sigma[..., 2, 2] = (LAM * np.log(J) / J)[..., 0, 0]
    pressure = -np.trace(sigma, axis1=-2, axis2=-1) / 3
    deviator = sigma + pressure[..., None, None] * np.eye(3)
    return {
        **{"stress": tau / J, "cauchy_stress": tau / J, "kirchhoff_stress": tau, "pressure": pressure},
        **{"out_of_plane_stress": sigma[..., 2, 2], "von_mises_stress": np.sqrt(1.5 * (deviator**2).sum((-1, -2)))},
    }


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stress") / "run"
    Scene(**disc(**SOFT, precision="float64", duration=0.05, output={"fields": FIELDS})).run(folder)
    return folder


def test_a_trajectory_has_the_stresses_that_it_names(run):
    with Trajectory(run) as read:
        assert read.measures == MEASURES
        expected = by_hand(read["F"])
        assert np.abs(np.linalg.det(read["F"]) - 1).max() > 0.1
        for name, values in expected.items():
            np.testing.assert_allclose(read[name], values, rtol=1e-9, atol=1e-8, err_msg=name)
            assert read.file[name].attrs["unit"] == "Pa"
    with h5py.File(run / "trajectory.h5") as file:  # without torch_mpm
        assert file["stress"].attrs["measure"] == "Cauchy" and file["kirchhoff_stress"].attrs["measure"] == "Kirchhoff"


def test_vtk_names_the_measure_and_is_complete(run):
    meshio = pytest.importorskip("meshio")
    folder = export_vtk(run).parent
    with Trajectory(run) as read:
        frame = read.frame(len(read) - 1)
    point_data = meshio.read(sorted(folder.glob("*.vtu"))[-1]).point_data
    expected = by_hand(frame["F"])
    assert "stress" not in point_data
    sigma = point_data["cauchy_stress"].reshape(-1, 3, 3)
    np.testing.assert_allclose(sigma[:, :2, :2], expected["stress"], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(sigma[:, 2, 2], expected["out_of_plane_stress"], rtol=1e-9, atol=1e-8)
    assert (sigma[:, 2, :2] == 0).all() and np.isnan(point_data["kirchhoff_stress"].reshape(-1, 3, 3)[:, 2, 2]).all()
    assert (point_data["F"].reshape(-1, 3, 3)[:, 2] == [0, 0, 1]).all()


def test_a_scene_with_vtk_stores_what_vtk_needs():
    flat = Scene(**disc(**SOFT, output={"vtk": True}))
    assert flat.trajectory_fields == ["stress", "out_of_plane_stress"]
    named = Scene(**disc(**SOFT, output={"vtk": True, "fields": ["cauchy_stress"]}))
    assert named.trajectory_fields == ["cauchy_stress", "out_of_plane_stress"]
    assert Scene(**disc(**SOFT, render={"color_by": "stress"})).trajectory_fields == ["von_mises_stress"]
    assert Scene(**disc(**SOFT, render={"color_by": "pressure"})).trajectory_fields == ["pressure"]


def test_components_that_3d_has_anyway_are_refused():
    sphere = {"shape": "sphere", "center": [0.5] * 3, "radius": 0.2, "material": "jelly"}
    words = {"grid": {"lower": [0] * 3, "upper": [1] * 3, "dx": 0.1}, "material": JELLY, "body": [sphere]}
    with pytest.raises(SceneError, match=r"output.fields: out_of_plane_stress is for 2-D"):
        Scene(**words, duration=0.1, output={"fields": ["out_of_plane_stress"]}).build()


# ---- old files


def old_fingerprint(scene):
    digest = hashlib.sha256(scene.model_dump_json(exclude={*COSMETIC, "origin"}).encode())
    digest.update(json.dumps(scene.trajectory_fields).encode())
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("fields", [["stress"], ["F", "stress"], ["F"], []])
def test_runs_with_another_stress_have_another_fingerprint(fields):
    """A run that began with Kirchhoff stresses is not continued with others; runs without stress are."""
    scene = Scene(**disc(**SOFT, output={"fields": fields}))
    assert (scene.fingerprint() == old_fingerprint(scene)) is ("stress" not in fields)


@pytest.mark.parametrize("fields", [["velocity", "stress"], ["velocity"], None])
def test_data_sets_with_another_stress_have_another_hash(fields):
    made = configuration(**({} if fields is None else {"dataset__fields": fields}))
    kept = {key: value for key, value in made.words.items() if key not in ("title", "device")}
    old = hashlib.sha256(f"{FORMAT} {json.dumps(kept)}".encode()).hexdigest()
    assert (made.hash == old) is ("stress" not in (fields or []))
    assert isinstance(made, Configuration)


@pytest.fixture
def old(tmp_path, monkeypatch):
    """A trajectory of before stresses had a measure."""
    monkeypatch.setattr(trajectory, "MEASURES", {})
    fields = {"position": ((2,), "f4"), "velocity": ((2,), "f4"), "stress": ((2, 2), "f4")}
    statics = {"mass": np.ones(3), "volume": np.ones(3), "material": np.zeros(3, np.int32)}
    scalars = {"time": ((), "f8"), "particles": ((), "i8")}
    create(tmp_path / PARTIAL, Layout(1, 3, fields, scalars, statics, {"material": ["water"]}))
    writer = TrajectoryWriter(tmp_path / PARTIAL)
    rows = {name: np.full((3, *shape), 0.5, kind) for name, (shape, kind) in fields.items()}
    rows["stress"][:] = [[3.0, 2.0], [2.0, -1.0]]
    writer.write(0, rows | {"time": np.array(0.0), "particles": np.array(3)})
    writer.close()
    monkeypatch.undo()
    return tmp_path


def test_old_trajectories_have_the_kirchhoff_stress(old):
    with Trajectory(old) as read:
        assert read.measures == {"stress": "Kirchhoff"}
        drawn = drawn_stress(read.fields, read.measures, 2)
        assert drawn.label == "in-plane von Mises Kirchhoff stress"
        np.testing.assert_allclose(drawn.values(read.frame(0)), np.sqrt(3) * np.sqrt(8))
    meshio = pytest.importorskip("meshio")
    point_data = meshio.read(export_vtk(old).parent / "frame_00000.vtu").point_data
    assert "kirchhoff_stress" in point_data and not {"stress", "cauchy_stress"} & set(point_data)


# ---- data sets


def test_a_data_set_names_its_measures(tmp_path):
    made = configuration(dataset__fields=["velocity", *FIELDS], dataset__splits={"train": 1})
    assert generate(made, tmp_path / "set", device="cpu")["failed"] == 0
    folder = DatasetFolder(tmp_path / "set")
    scene = folder.scene(0)
    assert scene.measures == MEASURES
    J = np.linalg.det(scene["F"])[..., None, None]
    np.testing.assert_allclose(scene["stress"] * J, scene["kirchhoff_stress"], rtol=1e-3, atol=1e-2)
    np.testing.assert_array_equal(scene["stress"], scene["cauchy_stress"])
    whole = von_mises(scene["stress"].astype(float), scene["out_of_plane_stress"])
    np.testing.assert_allclose(scene["von_mises_stress"], whole, rtol=1e-3, atol=1e-2)
    with h5py.File(data.export_lagrangebench(folder, tmp_path / "graphs", fields=["stress"]) / "train.h5") as file:
        np.testing.assert_array_equal(file["00000"]["cauchy_stress"][()], scene["stress"])
    pytest.importorskip("meshio")
    made_files = export_scenes_vtk(folder, tmp_path / "vtk")
    text = (made_files / "scene_0000000" / "frame_00000.vtu").read_bytes()
    assert b'"cauchy_stress"' in text and b'"kirchhoff_stress"' in text and b'"stress"' not in text


# ---- pictures


@pytest.mark.parametrize(
    ("names", "dim", "label"),
    [
        (["F", "von_mises_stress", "stress"], 2, "von Mises stress"),
        (["stress", "out_of_plane_stress"], 2, "von Mises stress"),
        (["kirchhoff_stress", "cauchy_stress"], 3, "von Mises stress"),
        (["cauchy_stress"], 2, "in-plane von Mises stress"),
        (["kirchhoff_stress", "out_of_plane_stress"], 2, "in-plane von Mises Kirchhoff stress"),
        (["kirchhoff_stress"], 3, "von Mises Kirchhoff stress"),
        (["F", "pressure"], 3, None),
    ],
)
def test_pictures_say_which_stress_they_show(names, dim, label):
    drawn = drawn_stress(names, MEASURES, dim)
    assert (drawn and drawn.label) == label


def test_von_mises_stress_of_arrays():
    """Uniaxial stress, pressure, and shear; plane strain with and without the third component."""
    shear = np.array([[0.0, 2.0], [2.0, 0.0]])
    assert von_mises(np.diag([7.0, 0.0, 0.0])) == pytest.approx(7) and von_mises(5 * np.eye(3)) == pytest.approx(0)
    assert von_mises(shear) == pytest.approx(2 * np.sqrt(3))
    assert von_mises(np.diag([7.0, 0.0]), np.array(0.0)) == pytest.approx(7)
    assert von_mises(np.diag([7.0, 7.0]), np.array(7.0)) == pytest.approx(0)
    assert von_mises(np.diag([7.0, 7.0])) == pytest.approx(0)
