"""Scene files in data sets from elsewhere: every command that reads them names the shard and the key that is wrong."""

import contextlib
import json

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("pydantic")

import small_dataset as datasets
from generated import configuration

from torch_mpm import data
from torch_mpm.cli import main
from torch_mpm.data.exports import common
from torch_mpm.data.folder import DatasetError, DatasetFolder
from torch_mpm.data.packing import prepare_scene
from torch_mpm.data.sampling import content
from torch_mpm.data.scene_words import read_words
from torch_mpm.data.shard import shard_path
from torch_mpm.data.shard_writer import ShardWriter
from torch_mpm.errors import DamagedFileError
from torch_mpm.scene import SceneError

SAND = {"law": "quartic_sand", "E": 1e6}
BALL = {"shape": "sphere", "center": [0.5, 0.5], "radius": 0.1}
GOOD = {"gravity": [0.0, -9.8], "material": {"sand": SAND}, "obstacle": [BALL]}
WRONG = {
    "gravity: must be 2 numbers": [
        {"gravity": 3},
        {"gravity": [1, "a"]},
        {"gravity": [0.0, 0.0, -9.8]},
        {"gravity": []},
    ],
    "gravity[0]: must be finite": [{"gravity": [1e300, 0.0]}],
    "material.sand.E: must be finite": [{"material": {"sand": {**SAND, "E": 10**400}}}],
    "material.sand.E: should be greater than 0": [{"material": {"sand": {**SAND, "E": -1.0}}}],
    "material.sand.law: takes one of": [{"material": {"sand": {"law": "x"}}}],
    "material: must be tables": [{"material": [1]}, {"material": {"sand": 3}}, {"material": None}],
    "material.a\\x00b (a key): has letters that no file can hold": [{"material": {"a\0b": SAND}}],
    "material.\\ud800 (a key): has letters that no file can hold": [{"material": {"\ud800": SAND}}],
    "obstacle: must be tables": [{"obstacle": {}}, {"obstacle": ["ball"]}, {"obstacle": None}],
    "obstacle[0].shape: missing": [{"obstacle": [{}]}],
    "obstacle[0].shape: takes one of": [
        {"obstacle": [{"shape": "nope"}]},
        {"obstacle": [{"shape": "mesh", "file": "/etc/passwd"}]},
    ],
    "obstacle[1].center: must have 2 numbers": [{"obstacle": [BALL, {**BALL, "center": [0.5, 0.5, 0.5]}]}],
    "obstacle[0].radius: should be": [{"obstacle": [{**BALL, "radius": -0.1}]}],
    "obstacle[0].velocity[1]: must be finite": [{"obstacle": [{**BALL, "velocity": [0.0, -1e39]}]}],
    "a scene file is a table": [3, [1]],
}
CASES = [(words, problem) for problem, many in WRONG.items() for words in many]
COMMANDS = {
    "well": ["export", "--format", "well"],
    "tfrecord": ["export", "--format", "tfrecord", "--context"],
    "stats": ["stats"],
    "render": ["render", "--no-video"],
    "verify": ["verify"],
}


def with_text(folder, text, change=lambda arrays: arrays):
    """A data set of one shard whose second scene has a text in place of its scene file, and other arrays."""
    if not folder.exists():
        datasets.make_dataset(folder, shards=0)
    with ShardWriter(shard_path(folder, 0)) as writer:
        for k in range(4):
            scene = prepare_scene(change(datasets.arrays(k)) if k == 1 else datasets.arrays(k))
            writer.add(k, scene, {**datasets.scene_attributes(k), "scene": text if k == 1 else json.dumps(GOOD)})
        writer.finish()
    return folder


@pytest.mark.parametrize(("words", "problem"), CASES, ids=range(len(CASES)))
def test_a_wrong_scene_file_is_named_with_its_key(tmp_path, words, problem):
    path = with_text(tmp_path / "set", json.dumps(words))
    with pytest.raises(DamagedFileError) as error:
        assert DatasetFolder(path).scene(1).words
    assert str(error.value).startswith(f"{shard_path(path, 0)}: scene_0000001 has a wrong scene file: {problem}")


@pytest.mark.parametrize("text", ["{", "", "[" * 100_000, '{"gravity": [NaN, 0]}'])
def test_texts_that_are_no_scene_file(tmp_path, text):
    path = with_text(tmp_path / "set", text)
    with pytest.raises(DamagedFileError, match="scene_0000001 has a wrong scene file: "):
        assert DatasetFolder(path).scene(1).words


def test_tables_within_tables_are_read_or_refused():
    for depth in range(700, 1000, 20):
        with contextlib.suppress(ValueError):
            assert read_words('{"a":' * depth + "1" + "}" * depth, 2)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_reads_scene_files_ends_with_one_line(tmp_path, capsys, command):
    pytest.importorskip("matplotlib")
    pytest.importorskip("PIL")
    pytest.importorskip("google_crc32c")
    path, words = tmp_path / "set", COMMANDS[command]
    for wrong in ({**GOOD, "gravity": [1e300, 0.0]}, {**GOOD, "material": {"a\0b": SAND}}, {**GOOD, "obstacle": [{}]}):
        with_text(path, json.dumps(wrong))
        assert main([words[0], str(path), *words[1:]]) == 1
        printed = [line for line in capsys.readouterr().err.splitlines() if "scene file" in line]
        assert len(printed) == 1 and f"{shard_path(path, 0)}: scene_0000001 has a wrong scene file: " in printed[0]
    assert {file.name for file in path.iterdir()} == {"dataset.json", "shards"}


def test_a_scene_file_is_optional_and_scenes_are_read_without_it(tmp_path):
    path = with_text(tmp_path / "set", "{")
    np.testing.assert_array_equal(DatasetFolder(path).scene(1)["position"], datasets.arrays(1)["position"])
    assert DatasetFolder(path).scene(0).words == GOOD
    assert DatasetFolder(with_text(path, "{}")).scene(1).words == {}


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_no_data_set_is_generated_that_readers_refuse(precision):
    made = configuration(precision=precision, body__0__velocity=[1e39, 0.0])
    with pytest.raises(SceneError, match=r"body\[0\].velocity\[0\]: must be finite and at most 3.4e\+38"):
        made.scene(content(made, 0))


# ---- what exports need of a scene


@pytest.mark.parametrize(("name", "export"), [("mass", data.export_well), ("particle_type", data.export_gns)])
def test_arrays_that_an_export_needs(tmp_path, name, export):
    path = with_text(
        tmp_path / "set", "{}", lambda arrays: {key: values for key, values in arrays.items() if key != name}
    )
    with pytest.raises(DatasetError, match=f"shard_00000.h5: scene_0000001 must have {name}"):
        export(path)
    assert not [file for file in path.iterdir() if file.name not in ("dataset.json", "shards")]


@pytest.mark.parametrize("name", ["mass", "velocity"])
def test_numbers_that_float32_cannot_hold(tmp_path, name):
    path = with_text(tmp_path / "set", "{}", lambda arrays: {**arrays, name: 1e39 + arrays[name].astype("f8")})
    with pytest.raises(DatasetError, match=f"{name} of scene_0000001 has numbers that float32 cannot hold"):
        common.as_float32(DatasetFolder(path).scene(1), name)
    with pytest.raises(DatasetError, match=name):
        data.export_well(path)


def test_scalars_of_the_well_are_no_groups(tmp_path):
    import h5py

    words = {"gravity": [0.0, -9.8], "material": {"wet/sand": SAND}}
    path = datasets.make_dataset(tmp_path / "set", shards=0)
    with ShardWriter(shard_path(path, 0)) as writer:
        for k in range(4):
            attributes = {**datasets.scene_attributes(k), "scene": json.dumps(words)}
            writer.add(k, prepare_scene(datasets.arrays(k)), attributes)
        writer.finish()
    with h5py.File(data.export_well(path, dx=0.5) / "data" / "train" / "numbers.hdf5") as file:
        assert list(file["scalars"]) == ["gravity_x", "gravity_y", "wet_sand_E"]
    both = {"wet/sand": SAND, "wet_sand": SAND}
    with pytest.raises(DatasetError, match="scene 1 has two numbers that would be the scalar 'wet_sand_E'"):
        data.export_well(with_text(path, json.dumps({"material": both})), tmp_path / "out", dx=0.5)
