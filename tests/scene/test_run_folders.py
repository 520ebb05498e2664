"""Folders of runs: full disks, damaged and forged files, two processes in one folder, outputs that cannot be."""

import json
import os
import resource
import shutil
import signal

import numpy as np
import pytest
from helpers import FILE, command, disc

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

import h5py

from torch_mpm import Trajectory
from torch_mpm.cli import main
from torch_mpm.data.whole_files import write_record
from torch_mpm.scene import Scene
from torch_mpm.scene.folder import read_run
from torch_mpm.scene.run import Interrupted
from torch_mpm.state import state_file
from torch_mpm.state.state import tensors_of

FILES = ("run.json", "checkpoint.h5", "trajectory.partial.h5")
DAMAGE = {
    "zeroed": lambda data: bytes(len(data)),
    "cut off": lambda data: data[: len(data) // 2],
    "garbage": lambda data: np.random.default_rng(0).bytes(len(data)),
    "empty": lambda data: b"",
    "JSON": lambda data: b"[]",
    "a bit": lambda data: data[:100] + bytes([data[100] ^ 4]) + data[101:],
}


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(duration=0.08))
    return path


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A folder with a run that was stopped after frame 2 of 4."""
    folder = tmp_path_factory.mktemp("stopped")
    (folder / "scene.toml").write_text(FILE.format(duration=0.08))

    def interrupt(figures):
        if figures["frame"] == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):
        Scene.load(folder / "scene.toml").run(folder / "out", progress=interrupt)
    return folder / "out"


@pytest.fixture
def unfinished(stopped, tmp_path):
    """A copy of that folder."""
    return shutil.copytree(stopped, tmp_path / "out")


def printed(capsys, *arguments):
    """Error output of a failing command."""
    assert main([str(a) for a in arguments]) == 1
    return capsys.readouterr().err


# ---- full disks


@pytest.mark.thorough(size=500)
@pytest.mark.parametrize("size", [500, 20_000])
def test_a_full_disk_ends_with_its_message(scene, tmp_path, size):
    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    process = command("run", scene, "-o", tmp_path / "out", "--quiet", preexec_fn=small_disk)
    _, errors = process.communicate()
    assert process.returncode == 1
    assert errors.startswith("torch-mpm: no room on the disk of ") and len(errors.splitlines()) == 1
    assert main(["run", str(scene), "-o", str(tmp_path / "out"), "--quiet", "--resume"]) == 0


def test_a_checkpoint_that_does_not_fit_leaves_the_one_before(tmp_path):
    path = tmp_path / "checkpoint.h5"
    state = Scene(**disc()).build("cpu").state
    state_file.save(path, tensors_of(state), {"time": 1.0})
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            state_file.save(path, tensors_of(state), {"time": 2.0})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == [path.name]


# ---- damaged files


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("damage", sorted(DAMAGE))
def test_a_damaged_file_is_named_with_what_to_do(scene, unfinished, capsys, name, damage):
    path = unfinished / name
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    errors = printed(capsys, "run", scene, "-o", unfinished, "--resume", "--quiet")
    assert errors.startswith(f"torch-mpm: {path}: ") and "remove" in errors
    if name == "trajectory.partial.h5":
        assert str(path) in printed(capsys, "export", unfinished, "--ply")
        assert str(path) in printed(capsys, "render", unfinished)
    if name == "run.json":
        assert str(path) in printed(capsys, "render", unfinished)


def test_a_damaged_file_can_be_removed_to_start_again(scene, unfinished):
    for name in ("checkpoint.h5", "trajectory.partial.h5"):
        (unfinished / name).unlink()
        break
    assert main(["run", str(scene), "-o", str(unfinished), "--resume", "--quiet"]) == 0
    Scene.load(scene).run(unfinished.parent / "whole")
    with Trajectory(unfinished) as a, Trajectory(unfinished.parent / "whole") as b:
        np.testing.assert_array_equal(a["position"], b["position"])


def test_a_bit_of_a_frame_that_changes_is_found(scene, unfinished, capsys):
    path = unfinished / "trajectory.partial.h5"
    with h5py.File(path, "r") as file:
        offset = file["velocity"].id.get_offset() + 17
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.write_bytes(data)
    for arguments in (("run", scene, "-o", unfinished, "--resume", "--quiet"), ("export", unfinished, "--ply")):
        assert "velocity of frame 0 is damaged" in printed(capsys, *arguments)


# ---- forged files: the seal is right


def forge(path, change):
    """Change an HDF5 file and seal it again."""
    from torch_mpm.data.hdf5 import FOOTER, seal

    data = path.read_bytes()
    length, _, _ = FOOTER.unpack(data[-FOOTER.size :])
    path.write_bytes(data[: -FOOTER.size - length])
    with h5py.File(path, "r+") as file:
        change(file)
    with open(path, "r+b") as handle:
        seal(handle, [(0, path.stat().st_size)])


def record(**changes):
    return lambda file: file.attrs.update(record=json.dumps({**json.loads(file.attrs["record"]), **changes}))


def fill(name, value):
    def change(file):
        file[name][...] = value

    return change


def exchange(name, make):
    def change(file):
        shape = file[name].shape
        del file[name]
        make(file, name, shape)

    return change


def external(file, name, shape):
    file.create_dataset(name, shape, "f4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def link(file, name, shape):
    file[name] = h5py.ExternalLink("/etc/other.h5", "/x")


def soft_link(file, name, shape):
    file[name] = h5py.SoftLink("/mass")


def huge(file, name, shape):
    file.create_dataset(name, (2**50, *shape[1:]), "f4", chunks=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (record(frame=10**6), "is of frame 1000000, which does not fit"),
        (record(frame=True), "is of frame True"),
        (record(frame=4, time=0.08), "is of frame 4, which does not fit the 3 frames"),
        (record(emitted=0), "particles of this run"),
        (record(emitted="all"), "has all layers"),
        (record(totals=[1]), "has a record that is not of this run"),
        (record(fingerprint="0" * 16), "is the checkpoint of another scene"),
        (fill("ids", 7), "has ids that are not 0, 1, 2"),
        (fill("mass", 2.0), "has another mass of particles"),
        (fill("x", float("nan")), "not finite"),
        (fill("F", -1.0), "not meaningful"),
        (exchange("x", external), "'x' is not stored as a plain array in the file"),
        (exchange("v", link), "'v' is a link"),
        (exchange("volume", soft_link), "'volume' is a link"),
        (exchange("x", huge), "'x' is not stored as a plain array"),
        (lambda file: file.create_group("notes"), "'notes' is no array of numbers"),
        (lambda file: file.create_dataset("notes", data=1.0), "does not hold the state of a run"),
        (lambda file: file.attrs.update(record="[1]"), "does not hold the state of a run"),
    ],
)  # fmt: skip
def test_a_forged_checkpoint_is_refused(scene, unfinished, capsys, change, message):
    forge(unfinished / "checkpoint.h5", change)
    errors = printed(capsys, "run", scene, "-o", unfinished, "--resume", "--quiet")
    assert (
        f"{unfinished / 'checkpoint.h5'}: " in errors and message in errors and "remove it and add --resume" in errors
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (fill("frames_written", 10**6), "states that 1000000 of its 5 frames are written"),
        (fill("material", 9), "material has a number that stands for nothing"),
        (fill("mass", -1.0), "mass has a number that is not positive"),
        (exchange("velocity", external), "'velocity' is not stored as a plain array in the file"),
        (exchange("velocity", link), "'velocity' is a link"),
        (exchange("velocity", huge), "'velocity' is not stored as a plain array"),
        (lambda file: file.attrs.update(fingerprint="0" * 16), "is the trajectory of another scene"),
        (lambda file: file.attrs.update(format=1), "is no trajectory of this version"),
        (lambda file: file.__delitem__("mass"), "it lacks mass"),
    ],
)  # fmt: skip
def test_a_forged_trajectory_is_refused(scene, unfinished, capsys, change, message):
    forge(unfinished / "trajectory.partial.h5", change)
    assert message in printed(capsys, "run", scene, "-o", unfinished, "--resume", "--quiet")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scene": 3}, "has scene = 3"),
        ({"folder": {}}, "has folder = {}"),
        ({"fingerprint": 1.5}, "has fingerprint = 1.5"),
        ({"summary": []}, "has summary = []"),
        ({"summary": {}}, "has a summary that is none"),
        ({"summary": {"frames": "x"}}, "has a summary that is none"),
        ({"summary": {"seconds": {"total": 10**400}}}, "has a summary that is none"),
    ],
)
@pytest.mark.parametrize("name", ["render", "run"])
def test_a_forged_record_is_refused(scene, unfinished, capsys, name, change, message):
    write_record(unfinished / "run.json", {**read_run(unfinished), **change})
    words = {"render": ["render", unfinished], "run": ["run", scene, "-o", unfinished, "--resume", "--quiet"]}
    assert message in printed(capsys, *words[name])


# ---- one process in a folder


def test_two_processes_in_one_folder(scene, unfinished, capsys):
    from torch_mpm.scene.folder import locked

    with locked(unfinished):
        errors = printed(capsys, "run", scene, "-o", unfinished, "--resume", "--quiet")
    assert f"another process is working in {unfinished}" in errors
    assert main(["run", str(scene), "-o", str(unfinished), "--resume", "--quiet"]) == 0


def test_a_lock_alone_does_not_make_a_folder_somebody_elses(scene, tmp_path):
    from torch_mpm.scene.folder import locked

    with locked(tmp_path / "out"):
        pass
    assert main(["run", str(scene), "-o", str(tmp_path / "out"), "--quiet"]) == 0


# ---- outputs that cannot be


def test_an_output_in_a_file_is_refused(scene, capsys):
    assert "scene.toml" in printed(capsys, "run", scene, "-o", scene / "x", "--quiet")
    assert "is a file" in printed(capsys, "run", scene, "-o", scene, "--quiet")
    assert "/proc/torch_mpm" in printed(capsys, "run", scene, "-o", "/proc/torch_mpm", "--quiet")


def test_pictures_that_a_trajectory_cannot_give(scene, unfinished, capsys):
    pytest.importorskip("matplotlib")
    errors = printed(capsys, "render", unfinished, "--set", "render={color_by='stress'}")
    assert "render.color_by: the trajectory has no 'stress'" in errors
    errors = printed(capsys, "render", unfinished, "--set", "render={resolution=[0, 5]}")
    assert "run.json: render.resolution: takes a width and a height of 16 to 16384 pixels, got (0, 5)" in errors


FINISHED = {
    **{
        name: lambda path, damage=damage: path.write_bytes(damage(path.read_bytes())) for name, damage in DAMAGE.items()
    },
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "a broken link": lambda path: (path.unlink(), path.symlink_to(path.parent / "none.h5")),
}


@pytest.mark.parametrize("damage", FINISHED)
def test_a_finished_run_with_a_damaged_trajectory_is_not_reported_as_complete(damage, unfinished, scene, capsys):
    resume = ["run", str(scene), "-o", str(unfinished), "--resume", "--quiet"]
    assert main(resume) == 0 and main(resume) == 0
    assert "holds the complete run of this scene" in capsys.readouterr().out
    FINISHED[damage](unfinished / "trajectory.h5")
    assert "trajectory.h5" in printed(capsys, *resume)


def test_the_trajectory_of_another_finished_run(unfinished, scene, tmp_path, capsys):
    resume = ["run", str(scene), "-o", str(unfinished), "--resume", "--quiet"]
    other = ["run", str(scene), "-o", str(tmp_path / "other"), "--quiet", "--set", "gravity=[0.0, -5.0]"]
    assert main(resume) == 0 and main(other) == 0
    shutil.copy(tmp_path / "other" / "trajectory.h5", unfinished / "trajectory.h5")
    assert "is not the trajectory of the run in run.json" in printed(capsys, *resume)
