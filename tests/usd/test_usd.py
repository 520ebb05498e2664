"""USD files of runs, read back by pxr: particles, surfaces, obstacles on their paths, camera, units, wrong inputs."""

import importlib.util
import json
import os
import resource
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from cases.small_run import small_run
from helpers import FILE, command

for package in ("pxr", "h5py", "pydantic"):
    pytest.importorskip(package)

from pxr import Usd, UsdGeom, UsdValidation  # noqa: E402

from torch_mpm import Trajectory, usd  # noqa: E402
from torch_mpm.cli import main  # noqa: E402
from torch_mpm.render.camera import framing  # noqa: E402
from torch_mpm.scene.folder import load_run  # noqa: E402
from torch_mpm.scene.places import obstacle  # noqa: E402
from torch_mpm.surfaces import SurfaceOptions  # noqa: E402
from torch_mpm.usd import prims, stage  # noqa: E402

FRAMES = 3


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return small_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def opened(run, tmp_path_factory):
    """Stages of a run by the options of their export."""
    folder = tmp_path_factory.mktemp("usd")
    stages = {}

    def stage_of(**options):
        name = "_".join(sorted(options)) or "points"
        if name not in stages:
            if "surface" in options:
                pytest.importorskip("pysplashsurf")
            stages[name] = Usd.Stage.Open(str(usd.export_usd(run, folder / f"{name}.usdc", **options)))
        return stages[name]

    return stage_of


@pytest.fixture(scope="module")
def frames(run):
    with Trajectory(run) as trajectory:
        return list(trajectory)


def world(prim, points, frame):
    """Points [N, 3] of a prim in world coordinates."""
    pose = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(frame))
    return np.asarray(points, np.float64) @ pose[:3, :3] + pose[3, :3]


def validation_errors(opened_stage):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(opened_stage)]


# ---- content


@pytest.mark.parametrize("options", [{}, {"grains": True}, {"surface": True}, {"surface": True, "grains": True}])
def test_files_are_valid_and_have_units(opened, options):
    found = opened(**options)
    assert validation_errors(found) == []
    assert UsdGeom.GetStageMetersPerUnit(found) == 1 and UsdGeom.GetStageUpAxis(found) == "Y"
    assert found.GetTimeCodesPerSecond() == found.GetFramesPerSecond() == 100
    assert (found.GetStartTimeCode(), found.GetEndTimeCode()) == (0, FRAMES - 1)
    assert found.GetDefaultPrim().GetPath() == "/run"
    kinds = {str(prim.GetPath()).rpartition("/")[2]: prim.GetTypeName() for prim in found.Traverse()}
    particles = "PointInstancer" if "grains" in options else "Points"
    assert kinds["material_1_sand"] == particles
    assert kinds["material_0_rubber"] == ("Mesh" if "surface" in options else particles)


@pytest.mark.parametrize("grains", [False, True])
@pytest.mark.parametrize(("material", "name"), [(0, "rubber"), (1, "sand")])
def test_particles(opened, frames, grains, material, name):
    """The same numbers as in the trajectory, with ids by which emitted particles are new ones."""
    found = opened(**({"grains": True} if grains else {}))
    prim = found.GetPrimAtPath(f"/run/material_{material}_{name}")
    kind = UsdGeom.PointInstancer(prim) if grains else UsdGeom.Points(prim)
    positions = kind.GetPositionsAttr() if grains else kind.GetPointsAttr()
    assert positions.GetTimeSamples() == list(range(FRAMES))
    counts = []
    for k, frame in enumerate(frames):
        rows = frame["material"] == material
        np.testing.assert_array_equal(positions.Get(k), frame["position"][rows])
        np.testing.assert_array_equal(kind.GetVelocitiesAttr().Get(k), frame["velocity"][rows])
        np.testing.assert_array_equal(kind.GetIdsAttr().Get(k), np.flatnonzero(rows))
        extent = np.array(kind.GetExtentAttr().Get(k))
        assert (extent[0] < frame["position"][rows].min(0)).all() and (extent[1] > frame["position"][rows].max(0)).all()
        counts.append(int(rows.sum()))
    assert (counts[0] < counts[-1]) == (name == "rubber")  # the jet
    if grains:
        assert list(kind.GetProtoIndicesAttr().Get(2)) == [0] * counts[2]
        sphere = UsdGeom.Sphere(found.GetPrimAtPath(kind.GetPrototypesRel().GetTargets()[0]))
        assert sphere.GetRadiusAttr().Get() == pytest.approx(0.0125, rel=0.02)
        assert len(kind.ComputeInstanceTransformsAtTime(2, 2)) == counts[2]
    else:
        assert list(kind.GetWidthsAttr().Get()) == pytest.approx([0.025], rel=0.02)
        assert kind.GetDisplayColorAttr().Get()[0] != (0, 0, 0)


def test_surfaces(opened, frames):
    trimesh = pytest.importorskip("trimesh")
    mesh = UsdGeom.Mesh(opened(surface=True).GetPrimAtPath("/run/material_0_rubber"))
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    for k in range(FRAMES):
        points = np.array(mesh.GetPointsAttr().Get(k))
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(k)).reshape(-1, 3)
        assert list(mesh.GetFaceVertexCountsAttr().Get(k)) == [3] * len(faces)
        solid = trimesh.Trimesh(points, faces, process=False)
        rows = frames[k]["material"] == 0
        assert solid.is_watertight and solid.volume == pytest.approx(frames[k]["volume"][rows].sum(), rel=0.05)
        assert (solid.vertex_normals * np.array(mesh.GetNormalsAttr().Get(k))).sum(1).min() > 0.5
        assert np.array(mesh.GetVelocitiesAttr().Get(k)).shape == points.shape
    velocity, points = np.array(mesh.GetVelocitiesAttr().Get(0)), np.array(mesh.GetPointsAttr().Get(0))
    np.testing.assert_allclose(velocity, np.cross([0, 2, 1], points - [0.4, 0.5, 0.4]), atol=0.01)


def test_obstacles_move_as_in_the_simulation(opened, run):
    """Also between frames: translation and rotation are interpolated separately, so that the box stays rigid."""
    scene, found = load_run(run), opened()
    mesh = UsdGeom.Mesh(found.GetPrimAtPath("/run/obstacles/obstacle_0_box"))
    corners = torch.tensor(np.array(mesh.GetPointsAttr().Get()), dtype=torch.float64)
    moving = obstacle(scene.obstacle[0], None)
    for frame in (0.0, 0.5, 1.0):
        pose = moving.pose(frame / 100)
        expected = pose.centre + corners @ pose.rotation.mT
        np.testing.assert_allclose(world(mesh.GetPrim(), corners, frame), expected, atol=1e-6)
    assert [mesh.ComputeVisibility(k) for k in range(FRAMES)] == ["inherited", "inherited", "invisible"]
    still = UsdGeom.Mesh(found.GetPrimAtPath("/run/obstacles/obstacle_1_plane"))
    assert still.GetPointsAttr().GetTimeSamples() == [] and still.ComputeVisibility(2) == "inherited"
    np.testing.assert_allclose(world(still.GetPrim(), still.GetPointsAttr().Get(), 0)[:, 1], 0.02, atol=1e-6)


def test_a_plane_that_moves_stays_in_the_domain(tmp_path):
    """It is clipped to the domain at every time, so its corners have samples."""
    more = '[[obstacle]]\nshape = "plane"\ncenter = [0.05, 0.0, 0.0]\n'
    more += "normal = [1.0, 0.2, 0.0]\nvelocity = [1.0, 0.0, 0.0]\n"
    found = Usd.Stage.Open(str(usd.export_usd(small_run(tmp_path, more=more))))
    mesh = UsdGeom.Mesh(found.GetPrimAtPath("/run/obstacles/obstacle_2_plane"))
    for k in range(FRAMES):
        corners = world(mesh.GetPrim(), mesh.GetPointsAttr().Get(k), k) - [0.05 + 0.01 * k, 0, 0]
        np.testing.assert_allclose(corners @ [1.0, 0.2, 0.0], 0, atol=1e-6)


@pytest.mark.parametrize(
    ("gravity", "axis"),
    [("[0.0, -9.8, 0.0]", "Y"), ("[0.0, 0.0, -9.8]", "Z"), ("[-9.8, 0.0, 0.0]", "Y"), ("[3.0, -4.0, 1.0]", "Y")],
)
def test_up_is_against_gravity(tmp_path, gravity, axis):
    """In the world of the file, after the transform of its root."""
    run = small_run(tmp_path, gravity)
    found = Usd.Stage.Open(str(usd.export_usd(run)))
    assert UsdGeom.GetStageUpAxis(found) == axis
    down = np.array([float(part) for part in gravity.strip("[]").split(",")])
    root = found.GetPrimAtPath("/run")
    turned = world(root, [-down / np.linalg.norm(down)], 0) - world(root, [np.zeros(3)], 0)
    np.testing.assert_allclose(turned, [np.eye(3)["XYZ".index(axis)]], atol=1e-9)
    camera = UsdGeom.Camera(found.GetPrimAtPath("/run/camera")).GetCamera(0)
    top = np.array(camera.transform)[1, :3]
    assert top @ np.eye(3)["XYZ".index(axis)] > 0.9


def test_the_camera_is_that_of_pictures(opened):
    """A point has the same place in the image of both."""
    camera = UsdGeom.Camera(opened().GetPrimAtPath("/run/camera")).GetCamera(0)
    drawn = framing(np.zeros(3), np.ones(3), np.eye(3)[1], (1280, 720), 28.0, 18.0, fill=(0.92, 0.86))
    points = np.array([[0, 0, 0], [1, 0, 0], [0.3, 1.0, 0.2], [1, 1, 1.0]])
    project = np.array(camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix())
    image = np.c_[points, np.ones(4)] @ project
    image = image[:, :2] / image[:, 3:]
    expected = drawn.project(points)[:, :2] / [1280, 720] * 2 - 1
    np.testing.assert_allclose(image, expected * [1, -1], atol=1e-5)


def test_map_coordinates_are_in_the_transform_of_the_root(tmp_path):
    """So that float32 resolves the points."""
    text = "origin = [500000.0, 4000000.0, 100.0]\n"
    run = moved_run(tmp_path, text)
    found = Usd.Stage.Open(str(usd.export_usd(run)))
    prim = found.GetPrimAtPath("/run/material_0_rubber")
    points = UsdGeom.Points(prim).GetPointsAttr().Get(0)
    with Trajectory(run) as trajectory:
        frame = trajectory.frame(0)
    expected = frame["position"][frame["material"] == 0]
    assert np.abs(points).max() < 10
    np.testing.assert_allclose(world(prim, points, 0), expected, rtol=0, atol=1e-6)


def moved_run(folder, text):
    """A ball far from zero."""
    import torch_mpm as mpm

    at = np.array([500000.0, 4000000.0, 100.0])
    scene = mpm.Scene(
        origin=tuple(at),
        grid={"lower": tuple(at), "upper": tuple(at + 1), "dx": 0.1},
        duration=0.01,
        fps=100,
        device="cpu",
        material={"rubber": {"law": "neo_hookean", "E": 1e4}},
        body=[{"shape": "sphere", "center": tuple(at + 0.5), "radius": 0.3, "material": "rubber"}],
    )
    scene.run(folder / "out")
    return folder / "out"


def test_scenes_of_a_batch_stand_side_by_side(tmp_path):
    run = small_run(tmp_path, more='[[scene]]\nname = "a"\n[[scene]]\nname = "b"\n')
    found = Usd.Stage.Open(str(usd.export_usd(run)))
    assert validation_errors(found) == []
    boxes = UsdGeom.BBoxCache(0, ["default"])
    ranges = [boxes.ComputeWorldBound(found.GetPrimAtPath(f"/run/scene_{k}")).ComputeAlignedRange() for k in range(2)]
    with Trajectory(run) as trajectory:
        frame = trajectory.frame(0)
        number = trajectory.statics["material"][trajectory.statics["scene"] == 1].min()
    prim = found.GetPrimAtPath(f"/run/scene_1/material_{number}_rubber")
    rows = (frame["scene"] == 1) & (frame["material"] == number)
    np.testing.assert_array_equal(UsdGeom.Points(prim).GetPointsAttr().Get(0), frame["position"][rows])
    assert ranges[1].GetMin()[0] - ranges[0].GetMin()[0] == pytest.approx(1.25)


def test_colours_are_linear():
    """Ends and a value of the table of IEC 61966-2-1."""
    np.testing.assert_allclose(prims.linear(np.array([0.0, 0.5, 1.0])), [0, 0.21404114, 1], atol=1e-7)


# ---- files


def test_a_file_is_as_large_as_its_numbers(run, tmp_path, monkeypatch):
    """Also where frames are moved to the disk one by one: 24 bytes a particle and frame, and a constant part."""
    monkeypatch.setattr(stage, "SAVED_BYTES", 1)
    in_parts = usd.export_usd(run, tmp_path / "parts.usdc")
    monkeypatch.undo()
    whole = usd.export_usd(run, tmp_path / "whole.usdc")
    with Trajectory(run) as trajectory:
        numbers = 24 * int(trajectory["particles"].sum())
    assert numbers < whole.stat().st_size < 1.1 * numbers + 20_000
    stages = [Usd.Stage.Open(str(p)) for p in (in_parts, whole)]
    points = [UsdGeom.Points(s.GetPrimAtPath("/run/material_0_rubber")).GetPointsAttr().Get(1) for s in stages]
    np.testing.assert_array_equal(*points)


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usd"])
def test_formats(run, tmp_path, capsys, suffix):
    path = tmp_path / "new" / f"a [1]@{suffix}"
    assert main(["usd", str(run), "-o", str(path), "--every", "2"]) == 0
    assert capsys.readouterr().out.strip() == str(path)
    assert path.read_bytes().startswith(b"#usda" if suffix == ".usda" else b"PXR-USDC")
    found = Usd.Stage.Open(str(path))
    assert UsdGeom.Points(found.GetPrimAtPath("/run/material_1_sand")).GetPointsAttr().GetTimeSamples() == [0, 2]


def test_the_default_is_a_file_in_the_folder_and_is_replaced(run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    assert main(["usd", str(folder), "--quiet"]) == main(["usd", str(folder), "--quiet", "--grains"]) == 0
    found = Usd.Stage.Open(str(folder / "run.usdc"))
    assert found.GetPrimAtPath("/run/material_1_sand").GetTypeName() == "PointInstancer"


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_interrupted_file_leaves_nothing(run, tmp_path, monkeypatch, error):
    write = prims.Points.write

    def interrupted(self, frame, *rest):
        write(self, frame, *rest)
        if frame == 1:
            raise error

    monkeypatch.setattr(prims.Points, "write", interrupted)
    monkeypatch.setattr(stage, "SAVED_BYTES", 1)
    with pytest.raises(type(error) if isinstance(error, OSError) else error):
        usd.export_usd(run, tmp_path / "a.usdc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_a_full_disk_is_reported_in_one_line(run, tmp_path):
    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    process = command("usd", run, "-o", tmp_path / "a.usdc", "--quiet", preexec_fn=small_disk)
    _, errors = process.communicate()
    assert process.returncode == 1 and list(tmp_path.iterdir()) == [], errors
    assert errors == f"torch-mpm: {tmp_path / 'a.usdc'}: USD cannot write the file: File too large\n"


@pytest.mark.parametrize("suffix", stage.SUFFIXES)
def test_a_file_that_cannot_be_created_is_reported_in_one_line(run, capsys, suffix):
    if not os.path.isdir("/proc/self"):
        pytest.skip("there is no /proc, where no file can be created")
    assert main(["usd", str(run), "-o", f"/proc/a{suffix}", "--quiet"]) == 1
    expected = f"torch-mpm: /proc/a{suffix}: USD cannot write the file: No such file or directory\n"
    assert capsys.readouterr().err == expected


# ---- wrong inputs


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-o {}/a.obj", "the USD file must end with .usdc, .usda, .usd, got"),
        ("--cube-size 0.02", "--cube-size is for --surface"),
        ("--material rubber", "--material is for --surface"),
        ("--surface --cube-size -1", "--cube-size must be positive and finite, got -1.0"),
        ("--surface --material snow", "materials are rubber, sand, got 'snow'"),
    ],
)
def test_wrong_options(run, tmp_path, capsys, words, message):
    before = sorted(os.listdir(run))
    if "snow" in words:
        pytest.importorskip("pysplashsurf")
    assert main(["usd", str(run), *words.format(tmp_path).split()]) == 1
    printed = capsys.readouterr().err
    assert message in printed and len(printed.splitlines()) == 1
    assert sorted(os.listdir(run)) == before and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        ({"materials": ["rubber"]}, ValueError, "surface must be True where options or materials are given"),
        ({"options": SurfaceOptions(smoothing=5)}, ValueError, "surface must be True where options or materials"),
        ({"surface": True, "materials": "rubber"}, TypeError, "materials must be a list of names, got str 'rubber'"),
        ({"grains": "no"}, TypeError, "grains must be True or False, got str"),
    ],
)
def test_wrong_arguments_of_an_export(run, tmp_path, words, error, message):
    with pytest.raises(error, match=message):
        usd.export_usd(run, tmp_path / "a.usdc", **words)
    assert list(tmp_path.iterdir()) == []


def test_a_run_in_two_dimensions_is_refused(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(FILE.format(duration=0.02))
    assert main(["run", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    assert main(["usd", str(tmp_path / "out")]) == 1
    assert "a USD file needs three dimensions; this run has 2" in capsys.readouterr().err


def test_a_missing_package_is_named(run, tmp_path, monkeypatch, capsys):
    for module in [name for name in sys.modules if name.partition(".")[0] == "pxr"]:
        monkeypatch.setitem(sys.modules, module, None)
    assert main(["usd", str(run), "-o", str(tmp_path / "a.usdc")]) == 1
    assert "pip install torch-mpm[usd]" in capsys.readouterr().err and list(tmp_path.iterdir()) == []


def test_hostile_folders(run, tmp_path, capsys):
    """A link out of the folder in place of the output, and no run at all."""
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "run.usdc").symlink_to(tmp_path / "elsewhere.usdc")
    assert main(["usd", str(folder)]) == 1
    assert "is a link to a place outside of" in capsys.readouterr().err and not (tmp_path / "elsewhere.usdc").exists()
    assert main(["usd", str(tmp_path / "nowhere")]) == 1
    assert "there is no run in" in capsys.readouterr().err


BLENDER = """
import json, sys
import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=sys.argv[1])
bpy.context.scene.frame_set(1)
objects = {o.name: [o.type, list(o.matrix_world.translation)] for o in bpy.data.objects}
print(json.dumps(objects | {"vertices": len(bpy.data.objects["material_0_rubber"].data.vertices)}))
"""


def test_blender_imports_it(run, tmp_path):
    """In a process of its own, since bpy has its own USD. Blender turns Y upwards to Z."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("the package bpy is not installed")
    pytest.importorskip("pysplashsurf")
    path = usd.export_usd(run, tmp_path / "a.usdc", surface=True)
    done = subprocess.run([sys.executable, "-c", BLENDER, str(path)], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    kinds = {name: found[name][0] for name in ("material_0_rubber", "material_1_sand", "camera")}
    assert kinds == {"material_0_rubber": "MESH", "material_1_sand": "POINTCLOUD", "camera": "CAMERA"}
    np.testing.assert_allclose(found["obstacle_0_box"][1], [0.71, -0.32, 0.7], atol=1e-6)
    assert found["vertices"] > 100
