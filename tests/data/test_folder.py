"""The folder of a data set: finished and valid scenes only, sums of splits, files of each process its own."""

import json
import pickle
from multiprocessing import get_context

import numpy as np
import pytest

pytest.importorskip("h5py")

import small_dataset as datasets

from torch_mpm.data import folder as folders
from torch_mpm.data.folder import DatasetFolder, DatasetRecord
from torch_mpm.data.metadata import connectivity_radius, metadata
from torch_mpm.data.shard import record_path, shard_path
from torch_mpm.data.whole_files import write_record
from torch_mpm.errors import DamagedFileError


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return datasets.make_dataset(tmp_path_factory.mktemp("data") / "set")


def test_the_record_comes_back(path):
    assert DatasetRecord.read(path) == datasets.record()
    assert datasets.record().shards == 3 and datasets.record().split_of(6) == "valid"
    with pytest.raises(KeyError, match="has no scene 10"):
        datasets.record().split_of(10)


def test_valid_scenes_of_splits(path):
    data = DatasetFolder(path)
    ids = {split: [s.id for s in data.scenes(split)] for split in datasets.SPLITS}
    assert ids == {"train": [0, 1, 2, 4], "valid": [5, 6], "test": [7, 8, 9]}
    assert [s.id for s in data.attempted("train") if not s.valid] == [3]
    np.testing.assert_array_equal(data.scene(5)["position"], datasets.arrays(5)["position"])
    with pytest.raises(KeyError, match="no finished and valid scene 3"):
        data.scene(3)
    with pytest.raises(KeyError, match="one of train, valid, test"):
        data.scenes("dev")


def test_an_unfinished_shard_does_not_appear(tmp_path):
    path = datasets.make_dataset(tmp_path / "set")
    record_path(shard_path(path, 1)).unlink()
    assert [s.id for s in DatasetFolder(path).scenes()] == [0, 1, 2, 8, 9]


def test_few_files_stay_open(path, monkeypatch):
    monkeypatch.setattr(folders, "MOST_OPEN", 1)
    data = DatasetFolder(path)
    for k in (0, 9, 5, 0, 6, 9):
        np.testing.assert_array_equal(data.scene(k)["mass"], datasets.arrays(k)["mass"])
    data.close()
    assert data.scene(0).particles == 20


def test_scenes_leave_with_their_shards(path, monkeypatch):
    """Scenes of a shard are read again after others have taken its place, and those that are held stay readable."""
    monkeypatch.setattr(folders, "MOST_OPEN", 2)
    data = DatasetFolder(path)
    held = {k: data.scene(k) for k in (0, 4, 0, 1, 8, 0, 5, 4, 9, 1)}
    assert len(data._cache._shards) == 2
    for k, scene in held.items():
        np.testing.assert_array_equal(scene["position"], datasets.arrays(k)["position"])
        np.testing.assert_array_equal(data.scene(k).window("mass", 0, 5), datasets.arrays(k)["mass"][:5])
    with pytest.raises(KeyError, match="has no 'nothing'"):
        held[0]["nothing"]


def _first_mass(data):
    return float(data.scene(9)["mass"][0])


@pytest.mark.thorough(method="spawn")
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_other_processes_open_files_of_their_own(path, method):
    data = DatasetFolder(path)
    expected = _first_mass(data)
    with get_context(method).Pool(1) as process:
        assert process.apply(_first_mass, (data,)) == expected
    assert pickle.loads(pickle.dumps(data)).scene(9).particles == data.scene(9).particles


def test_metadata_is_that_of_the_training_split(path):
    words = metadata(DatasetFolder(path))
    free = [datasets.arrays(k) for k in (0, 1, 2, 4)]
    free = [a["position"][:, a["particle_type"] != 3].astype(np.float64) for a in free]
    for name, order in (("vel", 1), ("acc", 2)):
        values = np.concatenate([np.diff(x, n=order, axis=0).reshape(-1, 2) for x in free])
        np.testing.assert_allclose(words[f"{name}_mean"], values.mean(0), rtol=1e-6)
        np.testing.assert_allclose(words[f"{name}_std"], values.std(0), rtol=1e-9)
    assert words["bounds"] == [[0.0, 1.0], [0.0, 2.0]] and words["num_particles_max"] == 47
    assert words["statistics_of"] == "train"
    assert metadata(DatasetFolder(path), split="dev")["statistics_of"] == "all splits"


def test_the_radius_holds_some_neighbours(path, tmp_path):
    """Particles on a lattice of the rest volume have about 20 within it."""
    spacing = 0.05 / 2
    lattice = np.stack(np.meshgrid(*[np.arange(-5, 6) * spacing] * 2), -1).reshape(-1, 2)
    near = (np.linalg.norm(lattice, axis=1) <= connectivity_radius(DatasetFolder(path))).sum()
    assert 17 <= near <= 25


def test_nothing_yet(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no data set in .* no dataset\.json"):
        DatasetFolder(tmp_path)
    empty = DatasetFolder(datasets.make_dataset(tmp_path / "set", shards=0))
    assert empty.scenes() == []
    with pytest.raises(ValueError, match="has no valid scene yet"):
        metadata(empty)


CHANGES = [
    {"format": 9},
    {"frames": 0},
    {"lower": [0.0]},
    {"other": 1},
    {"splits": [1]},
    {"splits": {"a": [-1, 3]}},
    {"added": [["train", 3, 5]]},
    {"added": [["dev", 12, 5]]},
    {"added": [["train", 12]]},
    {"dx": 0.0},
    {"frame_interval": -0.1},
    {"frames": 10**400},
    {"upper": [0.0, 2.0]},
    {"splits": {"train": [0, 10**12]}},
    {"scenes_per_shard": 10**12},
    {"title": "\udcff"},
    {"dx": 1e-300},
    {"dx": 1e-10},
    {"dx": 1e39},
    {"frame_interval": 1e308},
    {"frame_interval": 1e38},
    {"frame_interval": 1e-39},
    {"upper": [1.0, 1e39]},
    {"lower": [-1e39, 0.0]},
]


@pytest.mark.parametrize("change", CHANGES)
def test_a_damaged_record(tmp_path, change):
    path = datasets.make_dataset(tmp_path / "set", shards=0)
    datasets.forge(path / "dataset.json", lambda words: words.update(change))
    with pytest.raises(DamagedFileError):
        DatasetFolder(path)


def test_sums_of_another_number_of_dimensions(tmp_path):
    path = datasets.make_dataset(tmp_path / "set")

    def change(words):
        for sums in words["scenes"][1]["motion"].values():
            sums.update(sum=[0.0] * 3, squares=[0.0] * 3)

    datasets.forge(record_path(shard_path(path, 0)), change)
    with pytest.raises(DamagedFileError, match=r"shard_00000\.json: has sums of another number of dimensions than 2"):
        DatasetFolder(path).motion()


@pytest.mark.parametrize(
    "name", ["../out", "/tmp/out", "a/b", "..", "", "a\0", "train\n", "..\\out", "x" * 300, "con", "LPT1", "nul "]
)
@pytest.mark.parametrize("key", ["splits", "fields"])
def test_names_that_lead_out_of_the_folder(tmp_path, name, key):
    """A split of a data set from elsewhere names the files of exports."""
    path = datasets.make_dataset(tmp_path / "set")
    value = {name: [0, 10]} if key == "splits" else ["position", name]
    datasets.forge(path / "dataset.json", lambda words: words.update({key: value}))
    with pytest.raises(DamagedFileError, match="is no name of a split or a field"):
        DatasetFolder(path)


@pytest.mark.parametrize("name", ["dataset.json", "shards", "shards/shard_00001.h5", "shards/shard_00001.json"])
def test_links_that_lead_out_of_the_folder(tmp_path, name):
    path = datasets.make_dataset(tmp_path / "set")
    inside, outside = path / name, tmp_path / "outside"
    inside.rename(outside)
    inside.symlink_to(outside)
    with pytest.raises(DamagedFileError, match="is a link to a place outside"):
        DatasetFolder(path).check()


def test_a_folder_may_be_a_link(tmp_path):
    path = datasets.make_dataset(tmp_path / "set")
    (tmp_path / "link").symlink_to(path)
    data = DatasetFolder(tmp_path / "link")
    data.check()
    np.testing.assert_array_equal(data.scene(5)["position"], datasets.arrays(5)["position"])


@pytest.mark.parametrize("record", ["dataset.json", "shards/shard_00000.json"])
def test_records_have_checksums(tmp_path, record):
    path = datasets.make_dataset(tmp_path / "set")
    text = (path / record).read_text()
    digits = [k for k, letter in enumerate(text) if letter.isdigit()]
    for k in digits[:: max(1, len(digits) // 40)]:
        other = "1" if text[k] != "1" else "2"
        changed = text[:k] + other + text[k + 1 :]
        if json.loads(changed) == json.loads(text):
            continue  # The last of 17 digits may not change the number.
        (path / record).write_text(changed)
        with pytest.raises(DamagedFileError):
            DatasetFolder(path).scenes()


@pytest.mark.parametrize("wrong", [3, "text", [1], {"a": 1}, None], ids=repr)
def test_values_of_another_type_in_a_record_are_errors_or_converted(tmp_path, wrong):
    """With a checksum that fits; the fields that are read have their types."""
    folder = datasets.make_dataset(tmp_path / "set")
    words = json.loads((folder / "dataset.json").read_text())
    del words["checksum"]
    expected = datasets.record()
    for name in words:
        write_record(folder / "dataset.json", {**words, name: wrong})
        try:
            record = DatasetRecord.read(folder)
        except DamagedFileError as error:
            assert "dataset.json" in str(error)
            continue
        for key, value in vars(expected).items():
            assert type(getattr(record, key)) is type(value), (name, key)
        assert all(isinstance(text, str) for text in (*record.versions, *record.versions.values(), *record.fields))


def test_records_of_before_are_read(tmp_path):
    """Records of older versions have no checksums."""
    path = datasets.make_dataset(tmp_path / "set")
    for record, version in [(path / "dataset.json", 1)] + [(p, 2) for p in (path / "shards").glob("*.json")]:
        words = json.loads(record.read_text())
        words.pop("checksum")
        for scene in words.get("scenes", []):
            scene.pop("digests")
        words.pop("seal", None)
        record.write_text(json.dumps({**words, "format": version}))
    data = DatasetFolder(path)
    np.testing.assert_array_equal(data.scene(5)["particle_type"], datasets.arrays(5)["particle_type"])


def test_flipped_bits_are_not_read(tmp_path):
    """Every array of a scene, compressed or not, is that which was written, or an error."""
    path = datasets.make_dataset(tmp_path / "set", shards=1)
    file, expected = shard_path(path, 0), datasets.arrays(0)
    data, found = file.read_bytes(), 0
    for place in range(len(data) // 7, len(data), len(data) // 211):
        file.write_bytes(data[:place] + bytes([data[place] ^ 16]) + data[place + 1 :])
        folder = DatasetFolder(path)
        try:
            scene = folder.scene(0)
            for name, values in expected.items():
                np.testing.assert_array_equal(scene[name], values)
        except DamagedFileError:
            found += 1
        finally:
            folder.close()
    assert found > 20
