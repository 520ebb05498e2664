"""Scenes with objects of Gaussian splats: their particles, the files and pictures of a run, and the command."""

import errno
import json
import os

import numpy as np
import pytest
import torch
from splat_objects import random_gaussians

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from benchmarks.catalogue.splats import sphere
from torch_mpm import Trajectory, splats
from torch_mpm.cli import main
from torch_mpm.scene import Scene, splat_bodies, splat_frames

JELLY = {"law": "neo_hookean", "E": 1e4, "nu": 0.3}
BALL = {"shape": "sphere", "center": (0.15, 0.15, 0.15), "radius": 0.1, "material": "jelly"}
OBJECT = {
    "shape": "splats",
    "file": "ball.ply",
    "extent": 0.3,
    "center": (0.6, 0.4, 0.5),
    "material": "jelly",
    "velocity": (0.5, 0.0, 0.0),
}


@pytest.fixture
def folder(tmp_path):
    """Folder with ball.ply, a sphere of 600 Gaussians with a faint one far away."""
    ball = sphere(0.5, (3.0, 4.0, 5.0), 600).to(dtype=torch.float32)
    far = random_gaussians(1, 0, torch.float32)
    far = far.replace(x=torch.full((1, 3), 90.0), opacity_logit=torch.tensor([-8.0]))
    splats.write(tmp_path / "ball.ply", splats.concatenate([ball, far]))
    return tmp_path


def words(**changes):
    scene = {
        "gravity": (0, -9.8, 0),
        "duration": 0.03,
        "fps": 100,
        "grid": {"lower": (0, 0, 0), "upper": (1, 1, 1), "dx": 0.0625},
        "material": {"jelly": JELLY},
        "body": [BALL, OBJECT],
    }
    return {**scene, **changes}


def test_particles_of_an_object_among_others(folder):
    built = Scene.from_words(words(), folder=folder).build("cpu")
    number = built.statics()["gaussian"]
    assert number.dtype == torch.int32
    others = int((number == splat_bodies.NONE).sum())
    assert bool((number[:others] == splat_bodies.NONE).all())
    assert number[others : others + 600].tolist() == list(range(600))
    assert bool((number[others + 600 :] == splat_bodies.INNER).all()) and len(number) > others + 650
    x = built.state.x[others : others + 600]
    middle, extent = 0.5 * (x.amin(0) + x.amax(0)), x.amax(0) - x.amin(0)
    torch.testing.assert_close(middle, torch.tensor([0.6, 0.4, 0.5]))
    assert float(extent.max()) == pytest.approx(0.3, rel=1e-5)
    assert float(built.state.v[others, 0]) == 0.5


@pytest.mark.parametrize("material", [JELLY, {"law": "weakly_compressible", "bulk_modulus": 1e4}])
@pytest.mark.parametrize("up", ["+y", "-z"])
def test_files_of_the_frames(material, up, device, folder):
    """The first one is the object in its place; later ones move with the particles, and deform with F or J."""
    bodies = [{**BALL, "material": "soft"}, {**OBJECT, "up": up}]
    materials = {"jelly": material, "soft": JELLY}
    scene = Scene.from_words(words(body=bodies, material=materials), folder=folder)
    scene.run(folder / "out")
    shown = []
    paths = splat_frames.write_frames(folder / "out", scene, torch.device(device), lambda *number: shown.append(number))
    assert shown == [(k, 4) for k in range(4)]
    assert [path.name for path in paths] == ["00000.ply", "00001.ply", "00002.ply", "00003.ply"]
    rest = splats.read(folder / "ball.ply")
    rest = splats.placed(rest[splats.visible(rest)], up, 0.3, (0.6, 0.4, 0.5))
    first, last = splats.read(paths[0]), splats.read(paths[-1])
    torch.testing.assert_close(first.x, rest.x)
    torch.testing.assert_close(first.covariance, rest.covariance, rtol=1e-4, atol=1e-9)
    with Trajectory(folder / "out") as trajectory:
        frame = trajectory.frame(3)
        rows = np.flatnonzero(frame["gaussian"] >= 0)
        np.testing.assert_array_equal(last.x.numpy(), frame["position"][rows])
        F = frame["F"][rows] if material is JELLY else np.cbrt(frame["J"][rows])[:, None, None] * np.eye(3)
    expected = F @ rest.covariance.numpy() @ F.transpose(0, 2, 1)
    np.testing.assert_allclose(last.covariance.numpy(), expected, rtol=1e-3, atol=1e-8)


def test_coordinates_relative_to_an_origin(folder):
    """As files in float32 cannot hold coordinates of a map; the trajectory is in those of the scene file."""
    body = {key: value for key, value in OBJECT.items() if key not in ("extent", "center", "velocity")}
    grid = {"lower": (2, 3, 4), "upper": (4, 5, 6), "dx": 0.125}
    scene = Scene.from_words(words(body=[body], grid=grid, origin=(3, 4, 5)), folder=folder)
    assert float(scene.build("cpu").state.x.abs().max()) < 0.6
    scene.run(folder / "out")
    first = splats.read(splat_frames.write_frames(folder / "out", scene)[0])
    expected = splats.read(folder / "ball.ply").x[:600] - torch.tensor([3.0, 4.0, 5.0])
    torch.testing.assert_close(first.x, expected, rtol=0, atol=1e-6)
    with Trajectory(folder / "out") as trajectory:
        assert trajectory["position"].min() > 2


def test_a_full_disk_is_known_before(folder, monkeypatch):
    scene = Scene.from_words(words(), folder=folder)
    scene.run(folder / "out")
    monkeypatch.setattr(splat_frames.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000})())
    with pytest.raises(splat_frames.OutputError, match=r"the splats need .* where 1 kB are free"):
        splat_frames.write_frames(folder / "out", scene)
    assert not (folder / "out" / "splats").exists()


def test_files_continue_after_a_full_disk(folder, monkeypatch):
    """Files before the fault are complete, and are not written again."""
    scene = Scene.from_words(words(), folder=folder)
    scene.run(folder / "out")
    run, synchronise, done = folder / "out" / "splats", os.fsync, []

    def fails_once(handle):
        done.append(handle)
        if len(done) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        synchronise(handle)

    monkeypatch.setattr(os, "fsync", fails_once)
    with pytest.raises(splat_frames.OutputError, match=r"no room on the disk of .*splats: .* add --resume"):
        splat_frames.write_frames(folder / "out", scene)
    kept = {path: path.stat().st_mtime_ns for path in run.iterdir()}
    assert len(kept) < 4 and all(path.suffix == ".ply" and not path.name.startswith(".") for path in kept)
    paths = splat_frames.write_frames(folder / "out", scene)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert sorted(run.iterdir()) == paths and len({path.stat().st_size for path in paths}) == 1
    assert float(splats.read(paths[3]).x.mean()) > float(splats.read(paths[0]).x.mean())


def test_another_object_than_that_of_the_run_is_refused(folder):
    scene = Scene.from_words(words(), folder=folder)
    scene.run(folder / "out")
    ball = splats.read(folder / "ball.ply")
    splats.write(folder / "ball.ply", ball[:500])
    with pytest.raises(ValueError, match="has not the 500 Gaussians of this scene"):
        splat_frames.write_frames(folder / "out", scene)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"file": "none.ply"}, "body[0].file: splats file"),
        ({"min_opacity": 0.999}, "body[0]: no Gaussian of ball.ply has an opacity of min_opacity = 0.999 or more"),
        ({"min_opacity": 2.0}, "body[0].min_opacity: should be less than or equal to 1"),
        ({"up": "y"}, "body[0].up: takes one of '+x', '-x', '+y', '-y', '+z', '-z', got 'y'"),
        ({"extent": 3.0}, "body[0]: reaches from"),
        ({"particles": 5}, "body[0].particles: the particles of ball.ply are those of the file"),
        ({"center": (0.5, 0.5)}, "body[0].center: must have 3 numbers"),
        ({"file": "points.ply"}, "body[0]: splats file"),
    ],
)
def test_problems_are_named(change, message, folder):
    text = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {a}\n" for a in "xyz")
    (folder / "points.ply").write_text(text + "end_header\n0 0 0\n")
    with pytest.raises(ValueError) as error:
        Scene.from_words(words(body=[{**OBJECT, **change}]), folder=folder).build("cpu")
    assert any(problem.startswith(message) for problem in error.value.problems), str(error.value)


def test_splats_need_three_dimensions():
    grid = {"lower": (0, 0), "upper": (1, 1), "dx": 0.1}
    with pytest.raises(ValueError, match="splats need three dimensions; this scene has two"):
        Scene(**words(grid=grid, gravity=(0, -9), body=[{**OBJECT, "velocity": None, "center": None}])).build("cpu")


# ---- the command

TOML = """
gravity = [0, -9.8, 0]
duration = 0.03
fps = 100
grid = {{ lower = [0, 0, 0], upper = [1, 1, 1], dx = 0.0625 }}
material.jelly = {{ law = "neo_hookean", E = 1e4 }}
material.water = {{ law = "weakly_compressible", bulk_modulus = 1e4 }}
render = {{ resolution = [64, 48] }}
[[body]]
shape = "{shape}"
file = "elsewhere.ply"
extent = 0.3
center = [0.5, 0.4, 0.5]
material = "jelly"
[[body]]
shape = "sphere"
center = [0.15, 0.15, 0.15]
radius = 0.1
material = "jelly"
[[obstacle]]
shape = "sphere"
center = [0.5, 0.0, 0.5]
radius = 0.2
[[emitter]]
center = [0.2, 0.9, 0.2]
radius = 0.08
velocity = [0, -2, 0]
material = "water"
"""


@pytest.fixture
def pictures():
    for package in ("matplotlib", "PIL", "imageio_ffmpeg"):
        pytest.importorskip(package)


def test_the_command_writes_splats_pictures_and_a_video(pictures, folder, capsys):
    from torch_mpm.render import read_png

    (folder / "scene.toml").write_text(TOML.format(shape="splats"))
    command = ["splats", str(folder / "ball.ply"), "--scene", str(folder / "scene.toml"), "-o", str(folder / "out")]
    assert main([*command, "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert f"splats  {folder / 'out' / 'splats'}" in printed and "video.mp4" in printed
    assert len(list((folder / "out" / "splats").glob("*.ply"))) == 4
    image = read_png(folder / "out" / "frames" / "00003.png")
    assert image.shape == (48, 64, 3) and image.std() > 5
    summary = json.loads((folder / "out" / "run.json").read_text())["summary"]
    assert {"splats", "pictures"} <= summary["seconds"].keys()
    assert main([*command, "--resume", "--quiet"]) == 0
    assert "holds the complete run" in capsys.readouterr().out
    assert main(command) == 1
    assert "complete run of this scene" in capsys.readouterr().err


def test_the_default_scene(pictures, folder):
    options = ["--set", "duration=0.04", "--set", "grid.dx=0.0625", "--set", "render.resolution=[64,48]", "--quiet"]
    assert main(["splats", str(folder / "ball.ply"), "-o", str(folder / "out"), *options]) == 0
    assert (folder / "out" / "video.mp4").stat().st_size > 500


def test_problems_of_the_command_are_one_line(pictures, folder, capsys, monkeypatch):
    scene = folder / "scene.toml"
    for text, message in (
        (TOML.format(shape="points"), 'must have one body with shape = "splats"'),
        (TOML.format(shape="splats") + "[[scene]]\n[[scene]]\n", "splats are written for single scenes, got a batch"),
        ("gravity = 3 4", "not a TOML file"),
    ):
        scene.write_text(text)
        assert main(["splats", str(folder / "ball.ply"), "--scene", str(scene), "-o", str(folder / "out")]) == 1
        error = capsys.readouterr().err
        assert message in error and "Traceback" not in error
    assert main(["splats", str(folder / "none.ply"), "-o", str(folder / "out")]) == 1
    assert "splats file" in capsys.readouterr().err
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)
    assert main(["splats", str(folder / "ball.ply"), "-o", str(folder / "out"), "--backend", "gsplat"]) == 1
    assert "gsplat" in capsys.readouterr().err
    assert not (folder / "out").exists()
