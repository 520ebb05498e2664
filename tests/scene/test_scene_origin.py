"""Scenes in coordinates of maps: positions are relative to an origin, and files and outputs keep their coordinates."""

import numpy as np
import pytest
import torch

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from torch_mpm import Trajectory
from torch_mpm.cli import main
from torch_mpm.scene import Scene, places, schema
from torch_mpm.scene.diagnose import SceneFailure
from torch_mpm.scene.explain import SceneError

UTM = (500e3, 5000e3, 400.0)
"""Easting, northing and height [m]."""


def words(offset, dim, **changes):
    """A domain of 1 m at an offset, with one of each thing that has a place."""

    def at(*place):
        return [round(a + b, 6) for a, b in zip(offset, place[:dim], strict=False)]

    def direction(*v):
        return v[:dim]

    jelly = {"law": "neo_hookean", "E": 1e4, "conductivity": 1.0, "specific_heat": 1000.0}
    body = {"material": "jelly", "per_cell": 2**dim}
    obstacle = {"temperature": 10.0}
    bodies = [
        {"shape": "box", "lower": at(0.2, 0.3, 0.2), "upper": at(0.4, 0.5, 0.4), "velocity": direction(3, 0, 0)},
        {"shape": "sphere", "center": at(0.7, 0.75, 0.7), "radius": 0.12},
        {"shape": "capsule", "a": at(0.2, 0.7, 0.7), "b": at(0.3, 0.8, 0.7), "radius": 0.1},
    ]
    obstacles = [
        {"shape": "plane", "center": at(0, 0.1, 0), "normal": direction(0, 1, 0)},
        {"shape": "sphere", "center": at(0.4, 0.15, 0.4), "radius": 0.12},
        {"shape": "box", "center": at(0.75, 0.15, 0.5), "size": direction(0.2, 0.1, 0.2), "velocity": [0.0] * dim},
        {"shape": "capsule", "a": at(0.9, 0.3, 0.1), "b": at(0.9, 0.5, 0.1), "radius": 0.05},
        {"shape": "revolved", "outline": [(0, 0), (0.1, 0), (0, 0.2)], "center": at(0.1, 0.1, 0.5)},
    ]
    face = {"lower": at(0.2, 0.3, 0.2), "upper": at(0.4, 0.3, 0.4), "flux": 10.0}
    return {
        "grid": {"lower": at(0, 0, 0), "upper": at(1, 1, 1), "dx": 0.1},
        "gravity": direction(0, -10, 0),
        "duration": 0.04,
        "fps": 50,
        "device": "cpu",
        "material": {"jelly": jelly},
        "body": [body | b for b in bodies],
        "obstacle": [obstacle | o for o in obstacles],
        "emitter": [{"center": at(0.6, 0.5, 0.5), "radius": 0.1, "velocity": direction(0, -1, 0), "material": "jelly"}],
        "heat": {"face": [face]},
        **changes,
    }


def simulated(folder, **scene):
    Scene(**scene).run(folder)
    with Trajectory(folder) as read:
        return {name: read[name] for name in read.file}, read.attributes


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_scene_on_a_map_is_that_at_zero(precision, dim, tmp_path):
    """To the last bit, and its positions are those of the map in float64."""
    origin = UTM[:dim]
    near, _ = simulated(tmp_path / "near", **words((0.0,) * dim, dim, precision=precision))
    far, attributes = simulated(tmp_path / "far", **words(UTM, dim, precision=precision, origin=origin))
    assert near["position"].dtype == precision and far["position"].dtype == "float64"
    assert tuple(attributes["origin"]) == origin
    assert np.nanmax(near["position"][-1] - near["position"][0]) > 0.01
    np.testing.assert_array_equal(far.pop("position"), near.pop("position").astype(float) + np.array(origin))
    assert far.keys() == near.keys()
    for name in set(near) - {"checksum"}:
        np.testing.assert_array_equal(far[name], near[name], err_msg=name)


def test_every_place_of_a_scene_file_is_relative_to_its_origin():
    """A new key of a place must be named, or is one of a direction, a size or a speed."""
    others = {"velocity", "normal", "size", "axis", "gravity", "spin", "rotation", "origin"}
    found = set()
    for model in vars(schema).values():
        if isinstance(model, type) and issubclass(model, schema.Model):
            vectors = {k for k, f in model.model_fields.items() if "tuple[float, ...]" in str(f.annotation)}
            found |= vectors
    assert found == {*places.PLACES} | (others & found), "name it in PLACES"
    assert "dam" in schema.Ritter.model_fields
    scene = Scene(**words(UTM, 2, origin=UTM[:2], render={"view": ((5e5, 5e6), (5e5 + 1, 5e6 + 1))}))
    scene.render.ritter = schema.Ritter(dam=5e5 + 0.5, depth=1.0)
    moved = scene.relative()
    assert moved.render.view == ((0.0, 0.0), (1.0, 1.0)) and moved.render.ritter.dam == 0.5
    assert moved.relative() is moved and scene.grid.upper == (500001.0, 5000001.0)


@pytest.mark.parametrize("kind", ["mesh", "points"])
def test_files_in_coordinates_of_a_map(kind, tmp_path):
    """Read in float64 and shifted before they are rounded."""
    trimesh = pytest.importorskip("trimesh")
    offset = np.array(UTM)
    if kind == "mesh":
        cube = trimesh.creation.box((0.4, 0.4, 0.4))
        cube.vertices += offset + 0.5
        (tmp_path / "cube.obj").write_text(trimesh.exchange.obj.export_obj(cube, digits=10))
        body = {"shape": "mesh", "file": "cube.obj"}
    else:
        axis = np.arange(8) / 20 + 0.325
        x = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3) + offset
        np.savez(tmp_path / "cube.npz", x=x, volume=np.full(512, 0.05**3))
        body = {"shape": "points", "file": "cube.npz"}
    scene = words(UTM, 3, origin=UTM, obstacle=[], emitter=[], body=[body | {"material": "jelly"}])
    state = Scene.from_words(scene, folder=tmp_path).build().state
    lower, upper = state.x.aminmax(dim=0)
    assert len(state) == 512 and state.x.dtype == torch.float32
    torch.testing.assert_close(lower, torch.full((3,), 0.325), rtol=0, atol=1e-6)
    torch.testing.assert_close(upper, torch.full((3,), 0.675), rtol=0, atol=1e-6)
    scene["body"][0]["offset" if kind == "mesh" else "file"] = (0.0, 1.0, 0.0) if kind == "mesh" else "far.npz"
    np.savez(tmp_path / "far.npz", x=np.array([offset + [0.5, 1.7, 0.5]]), volume=np.ones(1))
    with pytest.raises(SceneError, match=r"5000001\.\d+, 400\.\d+\], outside the domain \[500000, 5000000, 400\]"):
        Scene.from_words(scene, folder=tmp_path).build()


def test_a_scene_on_a_map_without_an_origin_is_refused(tmp_path, capsys):
    """The message has the remedy; also from the command line."""
    scene = words(UTM, 2)
    with pytest.raises(SceneError, match=r"grid: coordinates up to 5e\+06 m .* float32.*`origin`.*float64"):
        Scene(**scene).build()
    assert Scene(**words(UTM, 2, precision="float64")).build().state.x.dtype == torch.float64
    (tmp_path / "far.toml").write_text(
        "duration = 0.01\n"
        "grid = { lower = [2e4, 0], upper = [20001, 1], dx = 0.05 }\n"
        'material.a = { law = "neo_hookean", E = 1e4 }\n'
        'body = [{ shape = "sphere", center = [20000.5, 0.5], radius = 0.2, material = "a" }]\n'
    )
    assert main(["check", str(tmp_path / "far.toml")]) == 0
    out, err = capsys.readouterr()
    assert "good" in out
    assert "warning: grid: coordinates up to 2e+04 m are rounded by up to 0.00098 m in float32" in err
    assert main(["check", str(tmp_path / "far.toml"), "--set", "origin=[2e4, 0.0, 0.0]"]) == 1
    assert "origin: must have 2 numbers like grid.lower" in capsys.readouterr().err
    assert main(["check", str(tmp_path / "far.toml"), "--set", "origin=[2e4, 0.0]"]) == 0
    assert "warning" not in capsys.readouterr().err


def test_messages_of_a_run_have_coordinates_of_the_map(tmp_path):
    """A particle that leaves the domain through an open wall."""
    scene = words(UTM, 2, origin=UTM[:2], obstacle=[], emitter=[], gravity=None, duration=1.0)
    scene["grid"]["walls"] = "open"
    with pytest.raises(SceneFailure, match=r"left the domain, at \[50000\d\.\d+, 5000000\.\d+\] m"):
        Scene(**scene).run(tmp_path / "out")


def test_what_reads_a_run_on_a_map(tmp_path):
    """VTK and PLY have the coordinates of the map; the viewer shows positions relative to the origin."""
    meshio = pytest.importorskip("meshio")
    from torch_mpm.data.clips import Source
    from torch_mpm.data.export import export_ply, export_vtk

    data, _ = simulated(tmp_path, **words(UTM, 2, origin=UTM[:2]))
    there = data["position"][0][np.isfinite(data["position"][0]).all(1)]
    vtk = meshio.read(export_vtk(tmp_path).parent / "frame_00000.vtu").points
    ply = meshio.read(export_ply(tmp_path) / "frame_00000.ply").points
    for points in (vtk, ply):
        np.testing.assert_array_equal(points[:, :2], there)
    source = Source(tmp_path)
    position = source.clip("run").position
    np.testing.assert_array_equal(position, data["position"] - np.array(UTM[:2]))
    assert np.nanmax(np.abs(position)) < 1 and np.max(np.abs(source.bounds)) < 1


@pytest.mark.parametrize("dim", [2, 3])
def test_pictures_of_a_run_on_a_map(dim, tmp_path):
    """Particles are drawn relative to the origin, and the axes of 2-D have the numbers of the map."""
    pytest.importorskip("matplotlib")
    from torch_mpm.scene.pictures import _Artist

    scene = Scene(**words(UTM, dim, origin=UTM[:dim], render={"video": False, "resolution": (160, 120)}))
    scene.run(tmp_path)
    with Trajectory(tmp_path) as read:
        artist = _Artist(scene, scene.render, read)
        picture = artist.picture(read.frame(0))
    lower, upper = artist.renderers[0].bounds
    assert lower.tolist() == [0.0] * dim and upper.tolist() == [1.0] * dim
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    if dim == 2:
        axes = artist.renderers[0].scene.axes
        assert [t.get_text() for t in axes.get_yticklabels()][::5] == ["5000000", "5000001"]
    artist.close()
