"""Values that no simulation can hold, and options of the command line that would have no effect, are errors."""

import shlex

import pytest
from helpers import FILE, scene_command

pytest.importorskip("pydantic")
pytest.importorskip("h5py")

import small_dataset as datasets

from torch_mpm.cli import main


@pytest.mark.parametrize("command", ["check", "info", "run"])
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("material.jelly.E=1e300", "material.jelly.E: must be at most 3.4e+38, the largest number in float32"),
        ("gravity=[0.0,-1e300]", "gravity: must be at most"),
        ("body[0].velocity=[1e300,0.0]", "body[0].velocity: must be at most"),
        ("body[0].spin=1e300", "body[0].spin: must be at most"),
        ("body[0].velocity=[1e30,0.0]", "particles start with up to 1e+30 m/s"),
        ("seed=99999999999999999999999999", "seed must be a whole number of at most 64 bits"),
        ('title="a\\u0000b"', "title: has letters that no file can hold"),
        ('device="mps"', "device: takes"),
        ('device="meta"', "device: takes"),
        ('device="toaster"', "device: takes"),
    ],
)
def test_values_that_no_simulation_can_hold(tmp_path, capsys, command, override, message):
    """In `check` as in `run`."""
    assert main(scene_command(tmp_path, command, override)) == 1
    printed = capsys.readouterr().err
    assert message in printed and len(printed.splitlines()) <= 3, printed
    assert not (tmp_path / "out").exists()


@pytest.fixture
def folders(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(FILE.format(duration=0.04))
    assert main(["run", str(scene), "-o", str(tmp_path / "run"), "--quiet"]) == 0
    datasets.make_dataset(tmp_path / "set")
    return tmp_path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("export set --format gns --dx 0.1", "--dx is for --format well, got gns"),
        (
            "export set --format well --fields velocity",
            "--fields is for --format lagrangebench or neuralmpm or tfrecord",
        ),
        ("export set --format gns --context", "--context is for --format tfrecord"),
        ("export set --format gns --scenes 0", "--scenes is for --format vtk or ply"),
        ("export run --dx 0.1", "--dx is for data sets, and this is a run"),
        ("export run --scenes 0", "--scenes is for data sets"),
        ("render run -o pictures", "-o is for data sets"),
        ("render run --no-video", "--no-video is for data sets"),
        ("render run --color-by mass", "--color-by is for data sets"),
        ("export set --format well --dx nan", "dx must be positive and finite, got nan"),
        ("export set --format well --dx 1e300", "dx must be at most 1, the shortest side of the domain, got 1e+300"),
        ("run scene.toml -o ''", "argument -o/--out: takes a path, got ''"),
        ("generate scene.toml -o ' '", "argument -o/--out: takes a path, got ' '"),
        ("export run --vtk -o ''", "argument -o/--out: takes a path, got ''"),
        ("export set --format gns -o ''", "argument -o/--out: takes a path, got ''"),
        ("render set --no-video -o ''", "argument -o/--out: takes a path, got ''"),
        ("stats set -o ''", "argument -o/--out: takes a path, got ''"),
        ("render ''", "argument run: takes a path, got ''"),
        ("verify ''", "argument folder: takes a path, got ''"),
        ("check ''", "argument scene: takes a path, got ''"),
        ("export run --vtk -o scene.toml", "argument -o/--out: takes a folder, and scene.toml is a file"),
        ("render set --no-video -o scene.toml", "argument -o/--out: takes a folder, and scene.toml is a file"),
        ("render set --color-by ''", "color_by must be"),
        ("export set --format vtk --scenes ''", "argument --scenes: takes numbers of scenes such as 0,5,7, got ''"),
        ("verify set --most-failed x", "takes a share within 0 and 1, got 'x'"),
    ],
)
def test_options_without_effect(folders, capsys, monkeypatch, words, message):
    monkeypatch.chdir(folders)
    before = sorted(folders.rglob("*"))
    try:
        status = main(shlex.split(words))
    except SystemExit as end:
        status = end.code
    assert status and message in capsys.readouterr().err
    assert sorted(folders.rglob("*")) == before


CONFIGURATION = """
gravity = [0.0, -9.8]
dataset = { splits = { train = 3 }, frames = 3, interval = 0.005 }
grid = { lower = [0.0, 0.0], upper = [1.0, 1.0], dx = 0.1 }
material.jelly = { law = "neo_hookean", E = 1e4 }
[[body]]
shape = "box"
center = [0.5, 0.5]
size = [0.2, 0.2]
material = "jelly"
"""


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("body[0].size={uniform=[0.1,0.2]}", "body[0].size: takes a number or distribution for each axis"),
        ("body[0].center=0.5", "body[0].center: takes a number or distribution for each axis"),
        ("body[0].size={choose=[[0.1,0.1]]}", "did you mean 'choice'?"),
        ("dataset.splits.train=999999999999", "dataset.splits: 62500000000 shards would be made"),
    ],
)
def test_one_line_for_each_mistake_of_a_configuration(tmp_path, capsys, override, message):
    (tmp_path / "set.toml").write_text(CONFIGURATION)
    words = ["generate", str(tmp_path / "set.toml"), "-o", str(tmp_path / "out"), "--quiet"]
    assert main([*words, "--set", override]) == 1
    printed = capsys.readouterr().err
    assert message in printed and len(printed.splitlines()) == 1, printed
