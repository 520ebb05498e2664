"""Flipped bits anywhere in a shard: every reader reports damage or reads what was written, and HDF5, which may hang on
damaged bytes, does not open the file; shards that are not those of the data set."""

import hashlib
import itertools
import json
import os
import pickle

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")

import small_dataset as datasets  # noqa: E402

from torch_mpm.cli import main  # noqa: E402
from torch_mpm.data import WindowDataset, WindowStream, export_scenes_ply, export_scenes_vtk, export_well  # noqa: E402
from torch_mpm.data.clips import Source  # noqa: E402
from torch_mpm.data.finish import finalize, verify  # noqa: E402
from torch_mpm.data.folder import DatasetFolder  # noqa: E402
from torch_mpm.data.hdf5 import outside  # noqa: E402
from torch_mpm.data.packing import prepare_scene  # noqa: E402
from torch_mpm.data.shard import Shard, ShardRecord, record_path, shard_path  # noqa: E402
from torch_mpm.data.shard_writer import ShardWriter  # noqa: E402
from torch_mpm.data.stress import measure_of  # noqa: E402
from torch_mpm.data.whole_files import file_hash  # noqa: E402
from torch_mpm.errors import DamagedFileError  # noqa: E402

FRAMES = 3


def without_seal(path):
    """Record of a shard as it was before shards had seals."""
    datasets.forge(record_path(path), lambda words: words.pop("seal"))


def content(scene):
    """All that a scene has, in a form that can be compared."""
    arrays = {name: scene[name].tobytes() for name in scene.names}
    windows = scene.window("position", 1, 2).tobytes()
    return arrays, windows, scene.attributes, scene.words, scene.measures


def places_of_numbers(path):
    """Places of the bytes of arrays, whose checksums are not in the seal."""
    places = set()
    with h5py.File(path) as file:
        for data in itertools.chain.from_iterable(group.values() for group in file.values()):
            if data.chunks is None:
                parts = [(data.id.get_offset(), data.nbytes)]
            else:
                chunks = map(data.id.get_chunk_info, range(data.id.get_num_chunks()))
                parts = [(chunk.byte_offset, chunk.size) for chunk in chunks]
            for offset, length in parts:
                places.update(range(offset, offset + length))
    return places


@pytest.mark.parametrize("sealed", [True, False])
def test_flipped_bits_of_a_shard(tmp_path, monkeypatch, sealed):
    path = tmp_path / "shard_00000.h5"
    arrays = {name: values[:, :7] if values.ndim > 1 else values[:7] for name, values in datasets.arrays(1).items()}
    arrays |= {"stress": np.ones((FRAMES, 7, 2, 2), np.float32)}
    with ShardWriter(path, {"shard": 0}) as writer:
        given = {name: values[:FRAMES] if values.ndim > 1 else values for name, values in arrays.items()}
        writer.add(0, prepare_scene(given), datasets.scene_attributes(0))
        writer.finish()
    if not sealed:
        without_seal(path)
    numbers = places_of_numbers(path) if sealed else set()
    with Shard(path) as shard:
        expected = content(shard.scene(0))
    data, opened, hdf5 = path.read_bytes(), [], h5py.File
    monkeypatch.setattr(h5py, "File", lambda *given: opened.append(given) or hdf5(*given))
    for place in range(0, len(data), 11):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << place % 8]) + data[place + 1 :])
        os.utime(path, ns=(place, place))  # A change within the resolution of the clock of the file system is another.
        try:
            with Shard(path) as shard:
                assert place in numbers, f"HDF5 opens a file with a flipped bit in byte {place}"
                assert content(shard.scene(0)) == expected
        except DamagedFileError as error:
            assert "shard_00000.h5" in str(error)
        assert place in numbers or not opened
        opened.clear()


def test_a_shard_of_the_same_size_in_its_place(tmp_path):
    """Its seal is right, and not that of the record."""
    paths = [tmp_path / f"shard_{k:05d}.h5" for k in range(2)]
    for k, path in enumerate(paths):
        with ShardWriter(path) as writer:
            writer.add(0, prepare_scene({}), {**datasets.scene_attributes(0, False), "seed": k})
            writer.finish()
    paths[0].write_bytes(paths[1].read_bytes())
    with pytest.raises(DamagedFileError, match=r"shard_00000\.h5: is another shard than that of its record"):
        Shard(paths[0])


def test_a_shard_is_compared_once(tmp_path, monkeypatch):
    """A shard without a seal is read as a whole before HDF5 opens it the first time, and again when it has changed."""
    path = shard_path(datasets.make_dataset(tmp_path / "set", shards=1), 0)
    without_seal(path)
    hashed = []
    monkeypatch.setattr("torch_mpm.data.shard.file_hash", lambda path: hashed.append(path) or file_hash(path))
    for _ in range(3):
        Shard(path).close()
    assert hashed == [path]
    os.utime(path, ns=(1, 1))
    Shard(path).close()
    assert hashed == [path] * 2


@pytest.mark.parametrize("size", [0, 1, 100])
def test_the_rest_of_a_file(size):
    rng = np.random.default_rng(size)
    for count in range(6):
        begins = rng.integers(0, size, count, endpoint=True)
        parts = [(int(b), int(rng.integers(0, size - b, endpoint=True))) for b in begins]
        covered = np.zeros(size, bool)
        for offset, length in parts:
            covered[offset : offset + length] = True
        rest = np.zeros(size, bool)
        for offset, length in outside(parts, size):
            assert length > 0 and not rest[offset : offset + length].any()
            rest[offset : offset + length] = True
        np.testing.assert_array_equal(rest, ~covered)


def flip_word(folder):
    """Flip a bit in an attribute of shard 0: the material "water" is "wauer"."""
    path = shard_path(folder, 0)
    data = bytearray(path.read_bytes())
    data[data.index(b"water") + 2] ^= 1
    path.write_bytes(data)


COMMANDS = {
    "finalize": ["finalize"],
    "verify": ["verify"],
    "stats": ["stats"],
    "render": ["render", "--no-video"],
    **{
        name: ["export", "--format", name]
        for name in ("gns", "lagrangebench", "neuralmpm", "tfrecord", "well", "vtk", "ply")
    },
}
PACKAGES = {"stats": "matplotlib", "render": "PIL", "tfrecord": "google_crc32c", "vtk": "meshio", "ply": "meshio"}
READERS = {
    "windows": lambda folder: WindowDataset(folder, frames=2)[0],
    "stream": lambda folder: next(iter(WindowStream(WindowDataset(folder, frames=2), 40, seed=None))),
    "workers": lambda folder: list(WindowStream(WindowDataset(folder, frames=2), 40, seed=None).loader(1)),
    "viewer": lambda folder: (lambda source: source.clip(next(iter(source.scenes))))(Source(folder)),
}


@pytest.mark.parametrize("sealed", [True, False])
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_report_a_flipped_bit_of_an_attribute(tmp_path, capsys, name, sealed):
    pytest.importorskip(PACKAGES.get(name, "h5py"))
    folder = datasets.make_dataset(tmp_path / "set")
    flip_word(folder)
    if not sealed:
        without_seal(shard_path(folder, 0))
    assert main([COMMANDS[name][0], str(folder), *COMMANDS[name][1:]]) == 1
    assert f"{shard_path(folder, 0)}: is damaged: its checksum is wrong" in capsys.readouterr().err
    assert sorted(path.name for path in folder.iterdir()) == ["dataset.json", "shards"]


@pytest.mark.thorough(name="viewer")
@pytest.mark.parametrize("name", READERS)
def test_readers_report_a_flipped_bit_of_an_attribute(tmp_path, name):
    folder = datasets.make_dataset(tmp_path / "set")
    flip_word(folder)
    with pytest.raises(DamagedFileError, match=r"shard_00000\.h5: is damaged: its checksum is wrong"):
        READERS[name](folder)


@pytest.mark.parametrize("export", [export_scenes_vtk, export_scenes_ply])
def test_exports_of_scenes_compare_the_whole_shards(tmp_path, export):
    pytest.importorskip("meshio")
    folder = datasets.make_dataset(tmp_path / "set")
    datasets.forge(record_path(shard_path(folder, 1)), lambda words: words.update(sha256="0" * 64))
    export(folder, tmp_path / "others", [0, 9])
    with pytest.raises(DamagedFileError, match=r"shard_00001\.h5: is damaged: its checksum is wrong"):
        export(folder, tmp_path / "out", [0, 5])
    assert not (tmp_path / "out").exists()


def test_the_error_passes_between_processes():
    error = DamagedFileError("shard.h5", "is damaged", "generate again")
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is DamagedFileError and str(copy) == str(error) == "shard.h5: is damaged; generate again"


# ---- measures of stresses


def test_an_unknown_measure(tmp_path):
    """With a checksum that fits."""
    path = tmp_path / "shard_00000.h5"
    with ShardWriter(path) as writer:
        stress = {"stress": np.ones((datasets.FRAMES, 23, 2, 2), np.float32)}
        writer.add(1, prepare_scene({**datasets.arrays(1), **stress}), datasets.scene_attributes(1))
        record = writer.finish()
    with h5py.File(path, "r+") as file:
        file["scene_0000001/stress"].attrs["measure"] = "Ceuchy"
    ShardRecord(path.stat().st_size, file_hash(path), record.scenes).write(record_path(path))
    with Shard(path) as shard, pytest.raises(DamagedFileError, match=r"scene_0000001/stress must have .* got 'Ceuchy'"):
        _ = shard.scene(1).measures


def test_measures_of_fields():
    assert measure_of("stress", None) == "Kirchhoff" and measure_of("stress", "Cauchy") == "Cauchy"
    assert measure_of("pressure", None) == measure_of("pressure", "Cauchy") == "Cauchy"
    for name, attribute in [("stress", "cauchy"), ("pressure", "Kirchhoff"), ("stress", 3), ("stress", np.zeros(2))]:
        with pytest.raises(ValueError, match=f"{name} must have the measure Cauchy"):
            measure_of(name, attribute)


# ---- shards that are not those of the data set


def test_shards_beyond_those_of_the_data_set_are_reported_and_not_read(tmp_path):
    folder = datasets.make_dataset(tmp_path / "set")
    for path in (shard_path(folder, 1), record_path(shard_path(folder, 1))):
        path.with_name(path.name.replace("1", "7")).write_bytes(path.read_bytes())
    with open(shard_path(folder, 7), "r+b") as file:
        file.write(b"garbage")
    assert list(verify(folder)) == [
        f"{shard_path(folder, 7)}: is beyond the 3 shards of the data set; remove it and its .json"
    ]
    data = DatasetFolder(folder)
    data.check()
    for scene_id in (4, 5, 6, 7):
        np.testing.assert_array_equal(data.scene(scene_id)["position"], datasets.arrays(scene_id)["position"])
    with pytest.raises(DamagedFileError, match="is beyond the 3 shards"):
        finalize(folder)


@pytest.mark.parametrize("change", [lambda ids: ids[0], lambda ids: 9 + ids[0], lambda ids: ids[1]])
def test_scenes_of_another_shard_are_refused(tmp_path, change):
    """A record with a checksum that fits; the same scene in two shards, one of no shard, and one twice."""
    folder = datasets.make_dataset(tmp_path / "set")
    ids = [scene.id for scene in ShardRecord.read(record_path(shard_path(folder, 0))).scenes]
    datasets.forge(record_path(shard_path(folder, 1)), lambda words: words["scenes"][0].update(id=change([ids[0], 5])))
    with pytest.raises(DamagedFileError, match=r"shard_00001\.json: has other scenes than those of its number"):
        DatasetFolder(folder)


def test_a_pipe_as_a_shard(tmp_path):
    """With a record that fits: a read would never end."""
    folder = datasets.make_dataset(tmp_path / "set")
    path = shard_path(folder, 0)
    path.unlink()
    os.mkfifo(path)
    nothing = hashlib.sha256(hashlib.sha256(b"").digest()).hexdigest()
    datasets.forge(record_path(path), lambda words: words.update(bytes=0, sha256=nothing, seal=""))
    assert list(verify(folder)) == [f"shard file {path} is a pipe, not a regular file"]
    for read in (finalize, DatasetFolder.check, READERS["windows"]):
        with pytest.raises((OSError, DamagedFileError), match=r"shard_00000\.h5"):
            read(DatasetFolder(folder) if read is DatasetFolder.check else folder)


# ---- numbers of the data set


def test_a_grid_that_is_too_large_for_the_memory(tmp_path):
    folder = datasets.make_dataset(tmp_path / "set")
    with pytest.raises(MemoryError, match=r"a scene in 2e\+600|a scene in inf cells of 1e-300 m takes about"):
        export_well(folder, tmp_path / "out", dx=1e-300)
    datasets.forge(folder / "dataset.json", lambda words: words.update(dx=1e-9))
    with pytest.raises(MemoryError, match=r"a scene in 5e\+17 cells of 2e-09 m takes about"):
        export_well(folder, tmp_path / "out")
    assert list(tmp_path.iterdir()) == [folder]
    assert json.loads((folder / "dataset.json").read_text())["dx"] == 1e-9
