"""Shards: what is written is read, by plain h5py too; windows read no more than their frames; damage is noticed."""

import errno
import hashlib
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")

from small_dataset import forge, write_shard  # noqa: E402

from torch_mpm.data import whole_files  # noqa: E402
from torch_mpm.data.packing import content_hash, prepare_scene  # noqa: E402
from torch_mpm.data.shard import Shard, ShardRecord, record_path, scene_name, shard_path  # noqa: E402
from torch_mpm.data.shard_writer import ShardWriter  # noqa: E402
from torch_mpm.data.statistics import motion_sums  # noqa: E402
from torch_mpm.errors import DamagedFileError  # noqa: E402

FRAMES, PARTICLES = 40, 500
VALID = {"valid": 1, "attempts": 1, "failure": "", "seed": 7, "scene": "{}", "dt": 1e-3}
FAILED = {"valid": 0, "attempts": 3, "failure": "scene 1 left the domain"}


def arrays(seed, dim=2, particles=PARTICLES, frames=FRAMES):
    rng = np.random.default_rng(seed)
    walk = 1e-3 * rng.standard_normal((frames, particles, dim))
    return {
        "position": (0.5 + walk.cumsum(0)).astype(np.float32),
        "stress": rng.standard_normal((frames, particles, dim, dim)).astype(np.float32),
        "particle_type": rng.choice(np.array([3, 5, 6], np.int8), particles),
        "mass": rng.random(particles, np.float32),
    }


@pytest.fixture
def path(tmp_path):
    (tmp_path / "shards").mkdir()
    return shard_path(tmp_path, 2)


@pytest.fixture
def written(path):
    """Scenes 3, 4 (failed), 5 (no particles) and 6."""
    with ThreadPoolExecutor(2) as executor:
        prepared = executor.map(prepare_scene, [arrays(6, dim=3), arrays(3), {}, arrays(5, particles=0)])
    with ShardWriter(path, {"version": "1"}) as writer:
        for number, scene, attributes in zip([6, 3, 4, 5], prepared, [VALID, VALID, FAILED, VALID], strict=True):
            writer.add(number, scene, attributes)
        assert not path.exists()
        writer.finish()
    return path


def test_what_is_written_is_read(written):
    with Shard(written, check=True) as read:
        assert read.ids == [3, 4, 5, 6]
        for number, given in ((3, arrays(3)), (5, arrays(5, particles=0)), (6, arrays(6, dim=3))):
            scene = read.scene(number)
            assert sorted(scene.names) == sorted(given)
            assert (scene.frames, scene.particles, scene.dim) == given["position"].shape
            assert scene.attributes == {"id": number, **VALID}
            for name, values in given.items():
                np.testing.assert_array_equal(scene[name], values)
                assert scene[name].dtype == values.dtype
        assert read.scene(4).names == [] and read.scene(4).attributes["failure"] == FAILED["failure"]
        with pytest.raises(KeyError, match="has no scene 7"):
            read.scene(7)


def test_plain_h5py_reads_it(written):
    with h5py.File(written) as file:
        data = file["scene_0000003/position"]
        np.testing.assert_array_equal(data[:], arrays(3)["position"])
        assert data.compression == "gzip" and data.shuffle and file.attrs["version"] == "1"


def test_a_window_is_read_without_the_rest(written, monkeypatch):
    given = arrays(3)
    with Shard(written) as read:
        scene = read.scene(3)
        for first, frames in ((0, 7), (13, 7), (33, 7), (5, 0), (0, FRAMES)):
            for name in ("position", "stress"):
                np.testing.assert_array_equal(scene.window(name, first, frames), given[name][first : first + frames])
        for first, frames in ((34, 7), (-1, 3), (3, -1)):
            with pytest.raises(IndexError, match="within 0 and 40"):
                scene.window("position", first, frames)
    with h5py.File(written) as file:  # damage the last chunk: only windows that touch it notice
        chunk = file["scene_0000003/position"].id.get_chunk_info(1)
    with open(written, "r+b") as handle:
        handle.seek(chunk.byte_offset + chunk.size // 2)
        handle.write(b"\0" * 64)
    with Shard(written) as read:
        scene = read.scene(3)
        np.testing.assert_array_equal(scene.window("position", 0, 32), given["position"][:32])
        with pytest.raises(DamagedFileError, match=r"position cannot be read.*generate again"):
            scene.window("position", 30, 7)
    with pytest.raises(DamagedFileError, match="checksum is wrong"):
        Shard(written, check=True)


def test_the_record_says_what_is_in_the_shard(written):
    record = ShardRecord.read(record_path(written))
    assert record.bytes == written.stat().st_size
    assert [(s.id, s.valid, s.particles, s.attempts) for s in record.scenes] == [
        (3, True, PARTICLES, 1),
        (4, False, 0, 3),
        (5, True, 0, 1),
        (6, True, PARTICLES, 1),
    ]
    assert record.scenes[0].hash == content_hash(arrays(3)) != record.scenes[3].hash
    assert record.scenes[1].failure == FAILED["failure"] and record.scenes[1].motion is None
    assert record.scenes[2].motion.velocity.count == 0


def test_sums_are_those_of_numpy():
    given = [arrays(1, dim=3), arrays(2, dim=3)]
    motion = sum((motion_sums(a["position"], a["particle_type"]) for a in given[1:]), motion_sums(**types(given[0])))
    free = [a["position"][:, a["particle_type"] != 3].astype(np.float64) for a in given]
    velocity = np.concatenate([np.diff(x, axis=0).reshape(-1, 3) for x in free])
    acceleration = np.concatenate([np.diff(x, n=2, axis=0).reshape(-1, 3) for x in free])
    for sums, values in ((motion.velocity, velocity), (motion.acceleration, acceleration)):
        assert sums.count == len(values)
        np.testing.assert_allclose(sums.mean, values.mean(0), rtol=1e-9)
        np.testing.assert_allclose(sums.std, values.std(0), rtol=1e-12)


def types(scene):
    return {name: scene[name] for name in ("position", "particle_type")}


def test_the_hash_is_of_the_numbers():
    given = arrays(1)
    changed = {**given, "mass": given["mass"].copy()}
    changed["mass"][3] += 1e-7
    renamed = {("volume" if n == "mass" else n): a for n, a in given.items()}
    strided = {n: np.asfortranarray(a) for n, a in reversed(given.items())}
    assert content_hash(strided) == content_hash(given)
    assert len({content_hash(a) for a in (given, changed, renamed, {})}) == 4


def test_a_scene_that_is_not_finite_is_refused():
    given = arrays(1)
    given["position"][5, 3, 0] = np.nan
    with pytest.raises(ValueError, match="position must be finite"):
        prepare_scene(given)
    with pytest.raises(ValueError, match="must have position"):
        prepare_scene({"mass": given["mass"]})


def test_a_full_disk_leaves_nothing(path, monkeypatch):
    def full(fd):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with ShardWriter(path) as writer, monkeypatch.context() as patch:
        writer.add(0, prepare_scene(arrays(0)), VALID)
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            writer.finish()
    assert list(path.parent.iterdir()) == []


LIMITED = """
import resource, sys
from pathlib import Path
from small_dataset import write_shard
path, first, last, step = Path(sys.argv[1]), *map(int, sys.argv[2:])
for size in range(first, last, step):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    try:
        write_shard(path, 0)
    except OSError as error:
        assert "too large" in str(error), error
        assert not list((path / "shards").iterdir())
    else:
        raise AssertionError(f"there was room in {size} bytes")
print("survived")
"""


@pytest.mark.thorough
def test_hdf5_survives_a_disk_that_is_full_anywhere(path):
    """HDF5 crashes, now or at the end of the process, when it learns of a write that failed."""
    write_shard(path.parent.parent, 0)
    whole = shard_path(path.parent.parent, 0)
    size = whole.stat().st_size
    for made in (whole, record_path(whole)):
        made.unlink()
    words = [sys.executable, "-c", LIMITED, str(path.parent.parent), "1", str(size), str(size // 60)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "survived\n", "")


def test_a_writer_that_is_left_leaves_nothing(path):
    with pytest.raises(KeyboardInterrupt), ShardWriter(path) as writer:
        writer.add(0, prepare_scene(arrays(0)), VALID)
        raise KeyboardInterrupt
    assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize("size", [0, 1, 4096, 4097, 20_000])
def test_a_file_is_hashed_in_parts(tmp_path, monkeypatch, size):
    monkeypatch.setattr(whole_files, "PART_BYTES", 4096)
    data = np.random.default_rng(0).bytes(size)
    (tmp_path / "file").write_bytes(data)
    parts = [hashlib.sha256(data[k : k + 4096]).digest() for k in range(0, size, 4096)]
    assert whole_files.file_hash(tmp_path / "file") == hashlib.sha256(b"".join(parts)).hexdigest()


def test_a_shard_without_a_record_is_not_finished(written):
    record_path(written).unlink()
    with pytest.raises(FileNotFoundError):
        Shard(written)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{", "is no record"),
        (b"[" * 100_000, "is no record"),
        (b"3", "is no record"),
        (b'{"format": 99}', "not of this version"),
        (b'{"format": 2, "bytes": 1, "sha256": "", "scenes": [{"id": 1}]}', "is no record"),
    ],
)
def test_a_damaged_record(written, text, message):
    record_path(written).write_bytes(text)
    with pytest.raises(DamagedFileError, match=message):
        Shard(written)


def test_a_truncated_shard(written):
    with open(written, "r+b") as handle:
        handle.truncate(written.stat().st_size - 1)
    with pytest.raises(DamagedFileError, match="not as long as its record says"):
        Shard(written)


def external(file, tmp_path):
    file["scene_0000000/foreign"] = h5py.ExternalLink(tmp_path / "secret.h5", "/secret")


def soft(file, tmp_path):
    file["scene_0000000/foreign"] = h5py.SoftLink("/scene_0000000/position")


def raw(file, tmp_path):
    (tmp_path / "secret").write_bytes(b"x" * 80)
    file["scene_0000000"].create_dataset("foreign", (10,), "f8", external=[(tmp_path / "secret", 0, 80)])


def virtual(file, tmp_path):
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource(tmp_path / "secret.h5", "secret", (10,))
    file["scene_0000000"].create_virtual_dataset("foreign", layout)


def bomb(file, tmp_path):
    file["scene_0000000"].create_dataset("foreign", (2**50,), "f8", chunks=(2**20,), compression="gzip")


def references(file, tmp_path):
    file["scene_0000000"].create_dataset("foreign", (3,), h5py.ref_dtype)


def other_filter(file, tmp_path):
    file["scene_0000000"].create_dataset("foreign", data=np.zeros((100, 3)), compression="lzf")


def a_group(file, tmp_path):
    file["scene_0000000"].create_group("foreign")


def one_particle_less(file, tmp_path):
    values = file["scene_0000000/particle_type"][:-1]
    del file["scene_0000000/particle_type"]
    file["scene_0000000"]["particle_type"] = values


def other_bytes(file, tmp_path):
    values = file["scene_0000000/mass"][:].astype(">f4")
    del file["scene_0000000/mass"]
    file["scene_0000000"]["mass"] = values


def no_arrays(file, tmp_path):
    for name in list(file["scene_0000000"]):
        del file["scene_0000000"][name]


def other_shape(file, tmp_path):
    file["scene_0000000"]["velocity"] = file["scene_0000000/position"][..., 0]


def strange_attribute(file, tmp_path):
    file["scene_0000000"].attrs["where"] = file["scene_0000000"].ref


ATTACKS = [
    *(external, soft, raw, virtual, bomb, references, other_filter, a_group, strange_attribute),
    *(one_particle_less, other_bytes, other_shape, no_arrays),
]


@pytest.mark.parametrize("attack", ATTACKS)
def test_foreign_content_is_refused(path, tmp_path, attack):
    with ShardWriter(path) as writer:
        writer.add(0, prepare_scene(arrays(0)), VALID)
        record = writer.finish()
    with h5py.File(path, "r+") as file:
        attack(file, tmp_path)
    words = {"bytes": path.stat().st_size, "sha256": whole_files.file_hash(path), "scenes": record.scenes}
    ShardRecord(**words).write(record_path(path))
    with Shard(path, check=True) as read, pytest.raises(DamagedFileError, match=scene_name(0)):
        read.scene(0)


def test_the_record_is_strict_json(written):
    json.loads(record_path(written).read_text(), parse_constant=pytest.fail)


def test_a_file_is_blamed_only_where_it_has_changed(written, monkeypatch):
    """An error of HDF5 for a file with its checksum is one of memory, or of something else than the file."""
    words = "Can't synchronously read data ({})"
    for reason, kind, message in (
        ("memory allocation failed for data chunk", MemoryError, "position cannot be read, .*memory allocation failed"),
        ("inflate() failed", DamagedFileError, "though its checksum is right; another program"),
    ):
        with Shard(written) as read, monkeypatch.context() as patch:
            scene = read.scene(3)

            def fails(self, part, reason=reason):
                raise OSError(words.format(reason))

            patch.setattr(h5py.Dataset, "__getitem__", fails)
            with pytest.raises(kind, match=message) as raised:
                scene.window("position", 0, 5)
            assert "remove it" not in str(raised.value)


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: scene["motion"]["velocity"]["sum"].pop(),
        lambda scene: scene["motion"]["velocity"].update(sum=[0.0, "x"]),
        lambda scene: scene["motion"]["velocity"]["squares"].append(1.0),
        lambda scene: scene["motion"]["acceleration"].update(sum=[0.0] * 3, squares=[0.0] * 3),
        lambda scene: scene["motion"]["acceleration"].update(count=10**400),
        lambda scene: scene.update(particles=-1),
        lambda scene: scene.update(id=1.5),
        lambda scene: scene.update(attempts=[]),
    ],
)
def test_numbers_of_records_that_are_none(written, change):
    """With a checksum that fits."""
    forge(record_path(written), lambda words: change(words["scenes"][0]))
    with pytest.raises(DamagedFileError, match="is no record of a shard"):
        ShardRecord.read(record_path(written))
