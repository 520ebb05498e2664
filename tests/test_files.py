"""Paths that are no regular file, or too large a one, are refused by every reader before a byte is read."""

import os
import socket

import pytest

from torch_mpm.errors import DamagedFileError
from torch_mpm.files import LARGEST, LARGEST_TEXT, VARIABLE, check_file, read_text
from torch_mpm.geometry import seed

KINDS = {
    "pipe": "is a pipe, not a regular file",
    "device": "is a device, not a regular file",
    "socket": "is a socket, not a regular file",
    "folder": "is a folder",
    "missing": "does not exist",
    "empty": "is empty",
    "large": "is too large: .* bytes, where .* are allowed; .*TORCH_MPM_LARGEST_FILE raises the limit",
}


def make(kind, path):
    """A path of a kind; links to a pipe and to an endless device."""
    if kind == "pipe":
        os.mkfifo(path.parent / "pipe")
        path.symlink_to("pipe")
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(str(path))
    elif kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.touch()
    elif kind == "large":
        with path.open("wb") as handle:
            handle.truncate(2**40)


def _scene(path):
    from torch_mpm.scene import Scene

    Scene.load(path)


def _body(path):
    """Body of a mesh or of points; its file is read for the fingerprint of a run."""
    from torch_mpm.scene import Scene

    body = {"shape": "mesh" if path.suffix == ".obj" else "points", "file": path.name, "material": "m"}
    words = {
        "grid": {"lower": (0, 0, 0), "upper": (1, 1, 1), "dx": 0.2},
        "duration": 1.0,
        "material": {"m": {"law": "neo_hookean", "E": 1e4, "nu": 0.3, "density": 1e3}},
        "body": [body],
    }
    Scene.from_words(words, folder=path.parent).fingerprint()


def _configuration(path):
    from torch_mpm.data.configuration import Configuration

    Configuration.load(path)


def _physgaussian(path):
    from torch_mpm.compat.physgaussian.configuration import decode_param_json

    decode_param_json(path)


def _mesh(path):
    pytest.importorskip("trimesh")
    seed.mesh(path, 0.1)


def _sealed(path):
    pytest.importorskip("h5py")
    from torch_mpm.data.hdf5 import open_sealed

    open_sealed(path, "")


def _run(path):
    from torch_mpm.scene.folder import read_run

    read_run(path.parent)


def _shard_record(path):
    from torch_mpm.data.shard import ShardRecord

    ShardRecord.read(path)


READERS = {
    "points.npy": seed.file,
    "points.npz": seed.file,
    "points.csv": seed.file,
    "points.ply": seed.file,
    "body.obj": _mesh,
    "body.stl": _mesh,
    "fingerprint.obj": _body,
    "fingerprint.csv": _body,
    "scene.toml": _scene,
    "set.toml": _configuration,
    "gaussians.json": _physgaussian,
    "trajectory.h5": _sealed,
    "run.json": _run,
    "shard-00000.json": _shard_record,
}


RECORDS = ("trajectory.h5", "run.json", "shard-00000.json")


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_that_is_empty_is_damaged(name, tmp_path):
    pytest.importorskip("pydantic")
    (tmp_path / name).touch()
    with pytest.raises(DamagedFileError, match=name):
        READERS[name](tmp_path / name)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_path_that_is_no_file_is_named(kind, name, tmp_path, monkeypatch):
    if kind == "large" and name.endswith("h5"):
        pytest.skip("trajectories have any size")
    if kind == "empty" and name in RECORDS:
        pytest.skip("records that are empty are damaged")
    if name.endswith("toml") or name.startswith(("fingerprint", "run")):
        pytest.importorskip("pydantic")
    monkeypatch.chdir(tmp_path)  # the path of a socket is short
    path = (tmp_path / name).relative_to(tmp_path) if kind == "socket" else tmp_path / name
    make(kind, path)
    with pytest.raises((OSError, ValueError), match=rf"file .*{name} {KINDS[kind]}"):
        READERS[name](path)


def test_the_limit_of_size_is_raised_by_the_environment(tmp_path, monkeypatch):
    path = tmp_path / "points.npy"
    with path.open("wb") as handle:
        handle.truncate(LARGEST + 1)
    with pytest.raises(OSError, match=f"{LARGEST + 1} bytes, where {LARGEST} are allowed"):
        check_file(path, "points")
    monkeypatch.setenv(VARIABLE, str(LARGEST + 1))
    check_file(path, "points")
    with pytest.raises(OSError, match=r"points\.npy is too large"):
        monkeypatch.setenv(VARIABLE, "1")  # a lower one does not count
        check_file(path, "points")
    monkeypatch.setenv(VARIABLE, "4 GB")
    with pytest.raises(ValueError, match="TORCH_MPM_LARGEST_FILE must be a number of bytes, got '4 GB'"):
        check_file(path, "points")


def test_text_is_read_to_its_own_limit(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("title = 'ψ'", encoding="utf-8")
    assert read_text(path, "scene") == "title = 'ψ'"
    os.truncate(path, LARGEST_TEXT + 1)
    with pytest.raises(OSError, match=r"scene\.toml is too large"):
        read_text(path, "scene")
