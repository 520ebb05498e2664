"""Outputs in folders from elsewhere and on full disks: they stay in the folder, and failed writes name a file."""

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("h5py")

import small_dataset as datasets
from helpers import scene_command

from torch_mpm.cli import main

IN_DATA_SETS = {
    "gns": ["export", "--format", "gns"],
    "lagrangebench": ["export", "--format", "lagrangebench"],
    "neuralmpm": ["export", "--format", "neuralmpm"],
    "tfrecord": ["export", "--format", "tfrecord"],
    "well": ["export", "--format", "well"],
    "vtk": ["export", "--format", "vtk"],
    "ply": ["export", "--format", "ply"],
    "pictures": ["render", "--no-video"],
    "statistics.png": ["stats"],
}
IN_RUNS = {"vtk": ["export"], "ply": ["export", "--format", "ply"], "frames": ["render"], "video.mp4": ["render"]}


def required(name):
    packages = {"vtk": ["meshio"], "ply": ["meshio"], "tfrecord": ["google_crc32c"]}
    drawn = ("pictures", "statistics.png", "frames", "video.mp4")
    for package in packages.get(name, ["matplotlib", "PIL"] if name in drawn else []):
        pytest.importorskip(package)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return datasets.make_dataset(tmp_path_factory.mktemp("data") / "set", shards=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    pytest.importorskip("pydantic")
    out = tmp_path_factory.mktemp("run")
    assert main(scene_command(out, "run", "seed=1")) == 0
    return out / "out"


def check_link(folder, name, words, outside, capsys):
    link = folder / name
    link.symlink_to(outside)
    try:
        assert main([words[0], str(folder), *words[1:]]) == 1
    finally:
        link.unlink()
    assert f"{link}: is a link to a place outside of {folder}" in capsys.readouterr().err


@pytest.mark.parametrize("dangling", [False, True])
@pytest.mark.parametrize("name", IN_DATA_SETS)
def test_no_default_output_of_a_data_set_leads_out_of_its_folder(source, tmp_path, name, dangling, capsys):
    required(name)
    outside = tmp_path / "outside"
    if not dangling:
        outside.mkdir()
    check_link(source, name, IN_DATA_SETS[name], outside, capsys)
    assert not list(tmp_path.rglob("outside/*")) and outside.exists() != dangling


@pytest.mark.parametrize("name", IN_RUNS)
def test_no_default_output_of_a_run_leads_out_of_its_folder(run, tmp_path, name, capsys):
    required(name)
    check_link(run, name, IN_RUNS[name], tmp_path, capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["frame_00000.vtu", "run.pvd"])
def test_links_in_place_of_exported_files_are_replaced(run, tmp_path, name):
    pytest.importorskip("meshio")
    outside, folder = tmp_path / "outside", tmp_path / "vtk"
    outside.write_text("as before")
    folder.mkdir()
    (folder / name).symlink_to(outside)
    assert main(["export", str(run), "-o", str(folder)]) == 0
    assert outside.read_text() == "as before" and not (folder / name).is_symlink()


# ---- full disks

LIMITED = """
import contextlib, io, json, resource, sys
from torch_mpm.cli import main
found = []
for words, sizes in json.loads(sys.argv[1]):
    for size in sizes:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        with contextlib.redirect_stderr(io.StringIO()) as printed:
            status = main(words)
        found.append([status, printed.getvalue().splitlines()[-1:]])
print(json.dumps(found))
"""
LARGEST = {
    "gns": "train.npz",
    "lagrangebench": "train.h5",
    "neuralmpm": "train/sim_0.h5",
    "tfrecord": "train.tfrecord",
    "well": "data/train/numbers.hdf5",
    "vtk": "scene_0000000/frame_00000.vtu",
    "ply": "scene_0000000/frame_00000.ply",
    "pictures": "sheet.png",
    "statistics.png": "x.png",
}
"""File of an output that a small disk cannot hold."""


@pytest.mark.thorough
def test_a_disk_that_is_full_anywhere_is_one_line_with_the_file(source, tmp_path):
    """In a process of its own, since HDF5 can crash now or at its end."""
    calls, expected = [], []
    for name, words in IN_DATA_SETS.items():
        required(name)
        file = tmp_path / name / LARGEST[name]
        out = file if words[0] == "stats" else tmp_path / name
        sizes = [1, 600, *(range(1000, 7000, 1500) if "h" in file.suffix else ())]
        calls.append([[words[0], str(source), *words[1:], "-o", str(out)], sizes])
        expected += [[1, [f"torch-mpm: {file}: File too large"]]] * len(sizes)
    words = [sys.executable, "-c", LIMITED, json.dumps(calls)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == expected
    assert list(tmp_path.iterdir()) == []
