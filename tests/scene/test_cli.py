"""The command line, as a user calls it."""

import io
import json
import shutil
import signal
import subprocess
import sys

import pytest
from helpers import FILE, command

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

from torch_mpm import Trajectory
from torch_mpm.cli import main
from torch_mpm.data.whole_files import write_record


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(duration=0.04))
    return path


def test_run_prints_where_things_are_and_what_it_took(scene, tmp_path, capsys):
    assert main(["run", str(scene), "-o", str(tmp_path / "out"), "--set", "precision=float64"]) == 0
    printed = capsys.readouterr()
    for text in ("3 frames", "simulation", "writing", "mass drift", "largest CFL number", "particles lost  none"):
        assert text in printed.out
    assert str(tmp_path / "out" / "trajectory.h5") in printed.out
    assert "substeps" in printed.err and "kinetic" in printed.err and "elastic" in printed.err  # the progress bar
    with Trajectory(tmp_path / "out") as read:
        assert read.complete and read["position"].dtype == "float64"
        assert read.attributes["scene"] == scene.read_text()
    summary = json.loads((tmp_path / "out" / "run.json").read_text())["summary"]
    assert summary["frames"] == 2 and summary["particles_lost"] == 0


@pytest.mark.parametrize(
    ("encoding", "shown"), [("ascii", r"Gr\xf6\xdfe \u6f22"), ("latin-1", r"Größe \u6f22"), ("utf-8", "Größe 漢")]
)
def test_letters_that_the_encoding_of_stdout_lacks(scene, monkeypatch, encoding, shown):
    stdout = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stdout)
    assert main(["info", str(scene), "--set", "title=Größe 漢"]) == 0
    stdout.flush()
    assert f"title  {shown}\n" in stdout.buffer.getvalue().decode(encoding) and stdout.errors == "strict"


def test_outputs_that_the_scene_names(scene, tmp_path, capsys):
    pytest.importorskip("meshio")
    arguments = ["--set", "output.vtk=true", "--set", "output.ply=true", "--quiet"]
    assert main(["run", str(scene), "-o", str(tmp_path / "out"), *arguments]) == 0
    assert len(list((tmp_path / "out" / "vtk").glob("*.vtu"))) == 3
    assert len(list((tmp_path / "out" / "ply").glob("*.ply"))) == 3
    capsys.readouterr()
    assert main(["export", str(tmp_path / "out"), "--ply"]) == 0
    assert capsys.readouterr().out.strip().endswith("ply")


def test_pictures_and_video(scene, tmp_path, capsys):
    for package in ("matplotlib", "PIL", "imageio_ffmpeg"):
        pytest.importorskip(package)
    from torch_mpm.render import read_png

    run = ["run", str(scene), "-o", str(tmp_path / "out"), "--set", "render.resolution=[320, 240]", "--quiet"]
    assert main(run) == 0
    pictures = sorted((tmp_path / "out" / "frames").glob("*.png"))
    assert [p.name for p in pictures] == ["00000.png", "00001.png", "00002.png"]
    assert (read_png(pictures[0]) != read_png(pictures[2])).any()
    assert (tmp_path / "out" / "video.mp4").read_bytes()[4:8] == b"ftyp"
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    for name, place in {"trajectory": "trajectory.h5", "pictures": "frames", "video": "video.mp4"}.items():
        assert [name, str(tmp_path / "out" / place)] in printed
    before = [path.read_bytes() for path in pictures]
    assert main(["render", str(tmp_path / "out"), "--set", "render.color_by=material"]) == 0
    assert capsys.readouterr().out.strip().endswith("video.mp4")
    assert not any(path.read_bytes() == old for path, old in zip(pictures, before, strict=True))


def test_pictures_of_a_drawing_that_was_killed_are_those_of_one_that_was_not(tmp_path):
    """Particles are as large in a picture, whichever is drawn first; here their spacing changes with time."""
    for package in ("matplotlib", "PIL", "imageio_ffmpeg"):
        pytest.importorskip(package)
    jet = "[[emitter]]\ncenter = [0.7, 0.8]\nradius = 0.06\nvelocity = [-1.0, 0.0]\nmaterial = 'jelly'\n"
    path, out = tmp_path / "scene.toml", tmp_path / "out"
    path.write_text(FILE.format(duration=0.04) + jet + "[render]\nresolution = [320, 240]\n")
    assert main(["run", str(path), "-o", str(out), "--quiet"]) == 0
    pictures = sorted((out / "frames").glob("*.png"))
    before = {path.name: path.read_bytes() for path in pictures}
    times = pictures[0].stat().st_mtime_ns
    for picture in pictures[1:]:
        picture.unlink()
    assert main(["render", str(out)]) == 0
    assert {path.name: path.read_bytes() for path in pictures} == before and pictures[0].stat().st_mtime_ns == times


def test_a_complete_run_is_resumed(scene, tmp_path, capsys):
    """Files missing after a kill are written; the next resume prints a line and writes nothing."""
    pytest.importorskip("meshio")
    out = tmp_path / "out"
    run = ["run", str(scene), "-o", str(out), "--set", "output.vtk=true", "--quiet", "--resume"]
    assert main(run) == 0
    assert (out / "vtk" / "run.pvd").exists() and "particles lost" in capsys.readouterr().out
    files = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file() and p.name != "run.lock"}
    assert main(run) == 0
    assert capsys.readouterr().out == f"{out} holds the complete run of this scene\n"
    assert {p: p.stat().st_mtime_ns for p in files} == files
    record = {name: value for name, value in json.loads((out / "run.json").read_text()).items() if name != "checksum"}
    record["summary"]["seconds"].pop("VTK")  # a kill before the end of the outputs
    write_record(out / "run.json", record)
    for _ in range(2):  # and files that were removed
        shutil.rmtree(out / "vtk")
        assert main(run) == 0 and (out / "vtk" / "run.pvd").exists()
    write_record(out / "run.json", {name: value for name, value in record.items() if name != "summary"})
    assert main(run) == 0 and "whose summary was lost by a kill" in capsys.readouterr().out
    assert main(run[:-1]) == 1 and "holds the complete run of this scene" in capsys.readouterr().err


def test_check_tells_good_from_bad(scene, capsys):
    assert main(["check", str(scene)]) == 0
    assert "scene.toml: good, " in capsys.readouterr().out
    assert main(["check", str(scene), "--set", "grid.dxx=3", "--set", "body[0].material=1"]) == 1
    printed = capsys.readouterr().err.splitlines()
    assert len(printed) == 2 and printed[0].startswith("torch-mpm: ")
    assert any("scene.toml: grid.dxx: unknown key; did you mean 'dx'?" in line for line in printed)
    assert any("scene.toml: body[0].material: should be a valid string, got 1" in line for line in printed)


def test_info_lists_what_the_scene_uses(scene, capsys):
    assert main(["info", str(scene)]) == 0
    printed = dict(line.split("  ", 1) for line in map(str.strip, capsys.readouterr().out.splitlines()))
    assert printed["fields"].strip() == "x 8, v 8, mass 4, volume 4, C 16, F 16, ids 8"
    assert printed["bytes per particle"].strip() == "64"
    assert float(printed["time step [s]"]) > 0 and float(printed["estimated run time [s]"]) > 0
    assert printed["plan"].strip() == "all steps in one op (executor fused, schedule sorted_cpu)"
    assert {"not loop", "not replay", "not graph", "not per_step", "not persistent"} < printed.keys()
    assert main(["info"]) == 0
    assert "torch:" in capsys.readouterr().out


def test_schema_is_json(capsys):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out)["properties"]["grid"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "nowhere.toml", "-o", "x"], "scene file nowhere.toml does not exist"),
        (["render", "nowhere"], "there is no run in nowhere"),
        (["export", "nowhere"], "there is no trajectory at nowhere"),
    ],
)
def test_missing_files(arguments, message, capsys):
    assert main(arguments) == 1
    assert capsys.readouterr().err == f"torch-mpm: {message}\n"


@pytest.mark.parametrize(
    ("package", "override", "extra"),
    [("h5py", "seed=0", "data"), ("meshio", "output.vtk=true", "data"), ("matplotlib", "render.every=1", "render")],
)
def test_a_missing_package_is_noticed_before_the_run(scene, tmp_path, monkeypatch, capsys, package, override, extra):
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["run", str(scene), "-o", str(tmp_path / "out"), "--set", override, "--quiet"]) == 1
    assert f"pip install torch-mpm[{extra}]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_without_pydantic_the_extra_is_named(scene):
    code = "import sys; sys.modules['pydantic'] = None; from torch_mpm.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run([sys.executable, "-c", code, "check", str(scene)], capture_output=True, text=True)
    assert done.returncode == 1 and "pip install torch-mpm[scene]" in done.stderr


@pytest.mark.thorough
def test_ctrl_c_ends_after_a_whole_frame(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(duration=600))
    process = command("run", path, "-o", tmp_path / "out", "--quiet")
    while process.poll() is None:
        try:
            with Trajectory(tmp_path / "out") as read:
                if len(read) > 2:
                    break
        except OSError:
            pass
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 130 and "add --resume to continue" in errors
    with Trajectory(tmp_path / "out") as read:
        assert 2 < len(read) < 30001 and f"stopped after frame {len(read) - 1} of 30000" in errors
