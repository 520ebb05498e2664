"""Exports are read by the steps of the loaders that they are for, with NumPy, h5py and a TFRecord reader from PyPI."""

import errno
import json
import shutil

import numpy as np
import pytest
import small_dataset as datasets
import torch

h5py = pytest.importorskip("h5py")
pytest.importorskip("google_crc32c")

from torch_mpm import data  # noqa: E402
from torch_mpm.data import whole_files  # noqa: E402
from torch_mpm.data.exports import common, lagrangebench  # noqa: E402
from torch_mpm.data.folder import DatasetError, DatasetFolder  # noqa: E402
from torch_mpm.data.packing import prepare_scene  # noqa: E402
from torch_mpm.data.shard import record_path, shard_path  # noqa: E402
from torch_mpm.data.shard_writer import ShardWriter  # noqa: E402
from torch_mpm.errors import DamagedFileError  # noqa: E402

IDS = {"train": [0, 1, 2, 4], "valid": [5, 6], "test": [7, 8, 9]}
FRAMES = datasets.FRAMES
ALL = [
    data.export_gns,
    data.export_lagrangebench,
    data.export_neuralmpm,
    data.export_tfrecord,
    data.export_well,
]


@pytest.fixture(scope="module", params=[2, 3])
def source(request, tmp_path_factory):
    return datasets.make_dataset(tmp_path_factory.mktemp("data") / "set", dim=request.param)


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    return datasets.make_dataset(tmp_path_factory.mktemp("data") / "set")


def dim_of(source):
    return DatasetFolder(source).record.dim


def expected(source, split):
    return [datasets.arrays(k, dim_of(source)) for k in IDS[split]]


def metadata_of(folder):
    return json.loads((folder / "metadata.json").read_text())


# ---- geoelements/gns


def gns_samples(path, sequence=6):
    """Its SamplesDataset and collate_fn."""
    with np.load(path, allow_pickle=True) as file:
        data = file["gns_data"]
    assert data.ndim == 1
    material = len(data[0]) >= 3
    for trajectory in data:
        positions, types = trajectory[0], trajectory[1]
        for t in range(sequence, len(positions)):
            window = np.transpose(positions[t - sequence : t], (1, 0, 2))
            sample = [window, np.full(len(window), types, dtype=int), positions[t]]
            if material:
                sample.append(np.full(len(window), trajectory[2], dtype=float))
            yield [torch.tensor(a) for a in sample]


def test_gns_reads_it(source, tmp_path):
    folder = data.export_gns(source, tmp_path / "gns")
    for split in IDS:
        given, samples = expected(source, split), list(gns_samples(folder / f"{split}.npz"))
        assert len(samples) == len(given) * (FRAMES - 6)
        window, types, label = samples[-1]
        np.testing.assert_array_equal(window.transpose(0, 1), given[-1]["position"][-7:-1])
        np.testing.assert_array_equal(types, given[-1]["particle_type"])
        np.testing.assert_array_equal(label, given[-1]["position"][-1])
        assert window.dtype == torch.float32
    words = metadata_of(folder)["rollout"]
    assert words["sequence_length"] - 6 == len(samples) / len(given)  # steps of its rollout
    assert "nnode_in" not in words


def test_gns_with_a_material(source, tmp_path):
    folder = data.export_gns(source, tmp_path / "gns", material="friction_angle")
    given = expected(source, "valid")
    *_, material = list(gns_samples(folder / "valid.npz"))[-1]
    np.testing.assert_allclose(material, np.tan(np.radians(given[-1]["friction_angle"])), rtol=1e-6)
    dim = dim_of(source)
    for block in ("train", "rollout"):
        words = metadata_of(folder)[block]
        assert (words["nnode_in"], words["nedge_in"]) == {2: (31, 3), 3: (38, 4)}[dim]


def test_gns_of_equal_scenes_is_no_table(tmp_path, monkeypatch):
    """Tuples of arrays of one shape would become an array of objects with more than one dimension."""
    source = datasets.make_dataset(tmp_path / "set")
    same = [common.ExportedScene(0, np.zeros((FRAMES, 4, 2), "f4"), np.zeros(4, "i1"), None)] * 2
    monkeypatch.setattr(common.Export, "scenes", lambda *_: iter(same))
    with np.load(data.export_gns(source) / "train.npz", allow_pickle=True) as file:
        assert file["gns_data"].shape == (2,) and file["gns_data"][1][0].shape == (FRAMES, 4, 2)


def test_a_material_that_is_not_there(flat, tmp_path):
    for name in ("cohesion", "position"):
        with pytest.raises(ValueError, match="material must be the name of an array"):
            data.export_gns(flat, tmp_path / "gns", material=name)
    assert list(tmp_path.iterdir()) == []


# ---- LagrangeBench


def test_lagrangebench_reads_it(source, tmp_path):
    folder = data.export_lagrangebench(source, tmp_path / "out")
    words = metadata_of(folder)
    for split in IDS:
        with h5py.File(folder / f"{split}.h5", "r") as file:
            keys = list(file.keys())
            assert len(keys) == len(IDS[split]) and file["00000/position"].shape[0] == FRAMES
            for key, given in zip(keys, expected(source, split), strict=True):
                position, kind = file[key]["position"][2:9], file[key]["particle_type"][:]
                np.testing.assert_array_equal(position, given["position"][2:9])
                codes = np.full(9, -1)
                codes[[datasets.WATER, datasets.SAND, datasets.BOUNDARY]] = [0, 4, 1]
                np.testing.assert_array_equal(kind, codes[given["particle_type"]])
                pad = words["num_particles_max"] - len(kind) + 1
                assert pad >= 1 and file[key]["position"].compression == "gzip"
    dim = dim_of(source)
    assert words["periodic_boundary_conditions"] == [False] * dim and words["write_every"] == 1
    assert words["dx"] == pytest.approx(0.05 / 4 ** (1 / dim))
    assert len(words["vel_mean"]) == dim


def test_lagrangebench_codes():
    position = np.zeros((3, 4, 2), "f4")
    position[:, 1, 0] = position[:, 3, 0] = [0, 1, 2]
    scene = common.ExportedScene(0, position, np.array([3, 3, 0, 7]), None)
    assert lagrangebench._types(scene, {7: 0}).tolist() == [1, 2, 3, 0]
    assert lagrangebench._types(scene, {5: 0, 7: 4}).tolist() == [1, 2, 3, 4]


# ---- DeepMind, PhysicsNeMo


def physicsnemo_records(folder, split):
    """Its _load_tfrecord_dataset and _decode_record; the reader compares no checksums, `test_checksums` does."""
    from tfrecord.torch.dataset import TFRecordDataset

    dataset = TFRecordDataset(
        str(folder / f"{split}.tfrecord"),
        None,
        {"key": "int", "particle_type": "byte"},
        sequence_description={"position": "byte"},
    )
    for context, sequence in dataset:
        position = np.stack([np.frombuffer(frame, np.float32) for frame in sequence["position"]])
        yield context["key"], np.frombuffer(context["particle_type"], np.int64), position


def test_deepmind_and_physicsnemo_read_it(source, tmp_path, caplog):
    pytest.importorskip("tfrecord")
    folder = data.export_tfrecord(source, tmp_path / "out")
    assert "bounds of the first axis" in caplog.text
    words = metadata_of(folder)
    for split in IDS:
        records = list(physicsnemo_records(folder, split))
        assert [int(np.ravel(key)[0]) for key, _, _ in records] == list(range(len(IDS[split])))
        for (_, kind, position), given in zip(records, expected(source, split), strict=True):
            shaped = position.reshape(words["sequence_length"] + 1, -1, words["dim"])  # DeepMind's
            np.testing.assert_array_equal(shaped, given["position"])
            np.testing.assert_array_equal(kind, given["particle_type"])
            assert kind.max() < 9


def test_checksums_are_those_of_tensorflow(flat, tmp_path):
    crc32c = pytest.importorskip("crc32c").crc32c
    found = (data.export_tfrecord(flat, tmp_path / "out") / "valid.tfrecord").read_bytes()

    def unmasked(at):
        rotated = (int.from_bytes(found[at : at + 4], "little") - 0xA282EAD8) & 0xFFFFFFFF
        return ((rotated >> 17) | (rotated << 15)) & 0xFFFFFFFF

    at = records = 0
    while at < len(found):
        length = int.from_bytes(found[at : at + 8], "little")
        assert crc32c(found[at : at + 8]) == unmasked(at + 8)
        assert crc32c(found[at + 12 : at + 12 + length]) == unmasked(at + 12 + length)
        at, records = at + 16 + length, records + 1
    assert records == 2 and crc32c(b"123456789") == 0xE3069283


# ---- NeuralMPM


def test_neuralmpm_reads_it(source, tmp_path, caplog):
    """The steps of its NMPMParser."""
    folder = data.export_neuralmpm(source, tmp_path / "WaterRamps")
    assert ("NeuralMPM reads scenes in 2-D alone" in caplog.text) == (dim_of(source) == 3)
    for split in IDS:
        files = sorted((folder / split).glob("*.h5"))
        assert [int(p.name.split("_")[-1].split(".")[0]) for p in files] == list(range(len(IDS[split])))
        for path, given in zip(files, expected(source, split), strict=True):
            with h5py.File(path, "r") as file:
                assert set(file) == {"particles", "boundary", "types"}
                particles, boundary, types = (torch.tensor(file[n][()]) for n in ("particles", "boundary", "types"))
            sim = torch.cat([boundary, particles], dim=1)
            types = torch.cat([torch.zeros(boundary.shape[1], dtype=types.dtype), types])
            wall = given["particle_type"] == 3
            order = np.argsort(~wall, kind="stable")
            np.testing.assert_array_equal(sim, given["position"][:, order])
            np.testing.assert_array_equal(types, np.where(wall, 0, given["particle_type"])[order])


# ---- The Well


def well_sample(file, sample, first, steps):
    """Its _build_metadata and _reconstruct_fields, for what these need of a file."""
    axes = file["dimensions"].attrs["spatial_dims"]
    size = [file["dimensions"][d].shape[-1] for d in axes]
    fields = {}
    for order in range(3):
        group = file[f"t{order}_fields"]
        for name in group.attrs["field_names"]:
            data = group[name]
            assert data.attrs["time_varying"] and data.attrs["sample_varying"] and all(data.attrs["dim_varying"])
            fields[name] = torch.as_tensor(data[(sample, slice(first, first + steps, 1))])
            assert fields[name].shape == (steps, *size, *[len(axes)] * order)
    scalars = {}
    for name in file["scalars"].attrs["field_names"]:
        data = file["scalars"][name]
        assert data.attrs["sample_varying"] and not data.attrs["time_varying"]
        scalars[str(name)] = float(torch.as_tensor(data[(sample,)]))
    closed = {}
    for wall in file["boundary_conditions"].values():
        (axis,) = wall.attrs["associated_dims"]
        assert wall.attrs["bc_type"] == "WALL"
        closed[str(axis)] = bool(wall["mask"][0] and wall["mask"][-1])
    return fields, closed, scalars


def test_the_well_reads_it(source, tmp_path):
    folder = data.export_well(source, tmp_path / "out", dx=0.1)
    dim, statistics = dim_of(source), json.loads((folder / "stats.yaml").read_text())
    for split in IDS:
        with h5py.File(folder / "data" / split / "numbers.hdf5") as file:
            assert file.attrs["n_trajectories"] == len(IDS[split]) and file.attrs["n_spatial_dims"] == dim
            assert file["dimensions"]["time"].shape == (FRAMES,)
            for k, given in enumerate(expected(source, split)):
                fields, closed, scalars = well_sample(file, k, 3, 5)
                gravity = {"gravity_x": 0.0, "gravity_y": pytest.approx(-9.8), "gravity_z": 0.0}
                assert scalars == dict(list(gravity.items())[:dim])
                assert closed == dict.fromkeys("xyz"[:dim], True)
                free = given["particle_type"] != 3
                mass = fields["density"].double().sum(tuple(range(1, dim + 1))) * 0.1**dim
                np.testing.assert_allclose(mass, given["mass"][free].sum(dtype="f8"), rtol=1e-5)
                momentum = (fields["velocity"] * fields["density"][..., None]).double()
                momentum = momentum.sum(tuple(range(1, dim + 1))) * 0.1**dim
                wanted = np.einsum("n,tnd->td", given["mass"][free].astype("f8"), given["velocity"][3:8, free])
                np.testing.assert_allclose(momentum, wanted, atol=1e-5 * np.abs(wanted).max())
            if split == "train":
                density = file["t0_fields/density"][:].astype("f8")
                assert statistics["mean"]["density"] == pytest.approx(density.mean())
                assert statistics["std_delta"]["density"] == pytest.approx(np.diff(density, axis=1).std(), rel=1e-6)
                assert len(statistics["mean_delta"]["velocity"]) == dim


def with_arrays(source, change):
    """The first shard of a data set, with scenes of changed arrays."""
    dim = DatasetFolder(source).record.dim
    with ShardWriter(shard_path(source, 0)) as writer:
        for k in range(4):
            writer.add(k, prepare_scene(change(datasets.arrays(0, dim))), datasets.scene_attributes(k, dim=dim))
        writer.finish()


def with_words(source, words):
    """The scenes of a data set with other scene files."""
    data = DatasetFolder(source)
    shutil.rmtree(source / "shards")
    (source / "shards").mkdir()
    dim = data.record.dim
    for index in range(3):
        ids = range(4 * index, min(4 * index + 4, 10))
        with ShardWriter(shard_path(source, index)) as writer:
            for k in ids:
                valid = k != datasets.FAILED
                scene = prepare_scene(datasets.arrays(k, dim) if valid else {})
                attributes = {**datasets.scene_attributes(k, valid), "scene": json.dumps(words(k))}
                writer.add(k, scene, attributes)
            writer.finish()


def test_the_well_has_obstacles_and_scalars(tmp_path):
    """A ball that moves to the right, and a floor; each scene with a material of its own."""
    source = datasets.make_dataset(tmp_path / "set")

    def words(k):
        ball = {"shape": "sphere", "center": [0.3, 1.0], "radius": 0.2, "velocity": [20.0, 0.0]}
        floor = {"shape": "box", "center": [0.5, 0.09], "size": [1.0, 0.18]}
        sand = {"law": "quartic_sand", "E": 1e6 + k, "friction_angle": 30.0 + k, "volume_correction": True}
        return {"gravity": [0.0, -9.8], "material": {"sand": sand}, "obstacle": [ball, floor]}

    with_words(source, words)
    folder = data.export_well(source, tmp_path / "out", dx=0.1)
    x, y = (0.1 * (np.arange(n) + 0.5) for n in (10, 20))
    with h5py.File(folder / "data" / "valid" / "numbers.hdf5") as file:
        for k, number in enumerate(IDS["valid"]):
            fields, _, scalars = well_sample(file, k, 0, FRAMES)
            assert scalars == {
                "gravity_x": 0.0, "gravity_y": pytest.approx(-9.8), "sand_E": pytest.approx(1e6 + number),
                "sand_friction_angle": 30.0 + number,
            }  # fmt: skip
            for t in (0, 5, 11):
                away = (x[:, None] - 0.3 - 20 * 0.0025 * t) ** 2 + (y - 1.0) ** 2
                expected = (away <= 0.2**2) | (y <= 0.18)
                clear = abs(away - 0.2**2) > 1e-9
                np.testing.assert_array_equal(fields["obstacle"][t].numpy()[clear], expected[clear])
    assert json.loads((folder / "stats.yaml").read_text())["std"]["obstacle"] > 0.1


TITLES = ["x" * 400, "é" * 200, "沙" * 300, "con", "A title / with: signs\\"]


@pytest.mark.parametrize("title", TITLES, ids=range(len(TITLES)))
def test_files_of_the_well_have_names_for_every_file_system(tmp_path, title):
    source = datasets.make_dataset(tmp_path / "set", shards=1, title=title)
    (path,) = (data.export_well(source, dx=0.5) / "data" / "train").iterdir()
    assert len(path.name.encode()) <= 110 and not whole_files.RESERVED.fullmatch(path.stem)
    with h5py.File(path) as file:
        assert file.attrs["dataset_name"] == path.stem


def test_long_titles_give_different_names():
    names = {whole_files.file_name("x" * 200 + end) for end in ("", "y", "z")}
    assert len(names) == 3 and whole_files.file_name("Sand in 2-D!") == "sand_in_2_d"


# ---- physics_jepa, which reads the files of The Well in its own way


def jepa_samples(folder, split, frames):
    """Its WellDatasetForJEPA: (context, target) [C, T, H, W] of windows that follow each other, and all scalars."""
    for path in sorted((folder / "data" / split).rglob("*.hdf5")):
        with h5py.File(path, "r", libver="latest", swmr=True) as file:
            scalars = torch.tensor(np.array([file["scalars"][name][()] for name in file["scalars"]]))
            fields = [data for k in range(3) for data in file[f"t{k}_fields"].values()]
            scenes, length, height, width = next(iter(file["t0_fields"].values())).shape
            for scene in range(scenes):
                for first in range(0, length - 2 * frames + 1, frames):
                    channels = []
                    for field in fields:
                        part = np.empty((2 * frames, height, width, *field.shape[4:]), field.dtype)
                        field.read_direct(part, source_sel=np.s_[scene, first : first + 2 * frames])
                        channels.append(part.reshape(2 * frames, height, width, -1))
                    both = torch.from_numpy(np.concatenate(channels, -1)).permute(3, 0, 1, 2)
                    yield scene, first, both[:, :frames], both[:, frames:], scalars


def test_a_jepa_reads_it(tmp_path):
    """Channels by name: density, obstacle, velocity; scenes differ in a number of their material."""
    source = datasets.make_dataset(tmp_path / "set")
    floor = {"shape": "box", "center": [0.5, 0.1], "size": [1.0, 0.2]}
    gravity = [0.0, -9.8]
    sand = [{"law": "neo_hookean", "E": 1e6 + k} for k in range(10)]
    with_words(source, lambda k: {"gravity": gravity, "material": {"sand": sand[k]}, "obstacle": [floor]})
    folder, frames = data.export_well(source, tmp_path / "out", dx=0.1), 3
    for split in IDS:
        samples, given = list(jepa_samples(folder, split, frames)), expected(source, split)
        assert len(samples) == len(given) * (FRAMES // frames - 1)
        for scene, first, context, target, scalars in samples:
            assert context.shape == target.shape == (4, frames, 10, 20)
            np.testing.assert_allclose(scalars[0], 0.0)  # gravity_x, gravity_y, sand_E
            np.testing.assert_allclose(scalars[1], -9.8, rtol=1e-6)
            np.testing.assert_array_equal(scalars[2], [1e6 + k for k in IDS[split]])
            free, mass = given[scene]["particle_type"] != 3, given[scene]["mass"]
            for start, window in ((first, context), (first + frames, target)):
                density, obstacle, velocity = window[0].double(), window[1], window[2:].double()
                np.testing.assert_allclose(density.sum((1, 2)) * 0.1**2, mass[free].sum(dtype="f8"), rtol=1e-5)
                assert obstacle[:, :, :2].all() and not obstacle[:, :, 2:].any()
                moved = given[scene]["velocity"][start : start + frames, free].astype("f8")
                momentum = np.einsum("n,tnd->dt", mass[free].astype("f8"), moved)
                found = (density * velocity).sum((2, 3)) * 0.1**2
                np.testing.assert_allclose(found, momentum, atol=1e-5 * np.abs(momentum).max())


@pytest.mark.parametrize("export", [data.export_lagrangebench, data.export_neuralmpm])
def test_further_fields(flat, tmp_path, export):
    folder = export(flat, tmp_path / "out", fields=["velocity", "mass"])
    given = datasets.arrays(IDS["valid"][0])
    if export is data.export_lagrangebench:
        with h5py.File(folder / "valid.h5") as file:
            found = {name: file["00000"][name][()] for name in ("velocity", "mass")}
    else:
        free = given["particle_type"] != datasets.BOUNDARY
        given = {"velocity": given["velocity"][:, free], "mass": given["mass"][free]}
        with h5py.File(folder / "valid" / "sim_0.h5") as file:
            found = {name: file[name][()] for name in ("velocity", "mass")}
    for name in found:
        np.testing.assert_array_equal(found[name], given[name])


def test_features_and_context_of_tfrecords(flat, tmp_path):
    pytest.importorskip("tfrecord")
    from tfrecord.torch.dataset import TFRecordDataset

    folder = data.export_tfrecord(flat, tmp_path / "out", fields=["velocity"], context=True)
    assert metadata_of(folder)["context_mean"] == pytest.approx([0.0, -9.8])
    assert metadata_of(folder)["context_std"] == [0.0, 0.0]
    kinds = {name: "byte" for name in ("position", "step_context", "velocity")}
    path, context = str(folder / "valid.tfrecord"), {"key": "int", "particle_type": "byte"}
    for (_, frames), given in zip(
        TFRecordDataset(path, None, context, sequence_description=kinds), expected(flat, "valid"), strict=True
    ):
        for name in ("position", "velocity"):
            values = np.stack([np.frombuffer(frame, np.float32) for frame in frames[name]])
            np.testing.assert_array_equal(values.reshape(given[name].shape), given[name])
        steps = np.stack([np.frombuffer(frame, np.float32) for frame in frames["step_context"]])
        np.testing.assert_allclose(steps, np.tile([0.0, -9.8], (FRAMES, 1)), rtol=1e-6)


@pytest.mark.parametrize("export", [data.export_lagrangebench, data.export_neuralmpm, data.export_tfrecord])
def test_fields_that_are_not_there(flat, tmp_path, export):
    with pytest.raises(ValueError, match=r"fields must be of .*velocity.*, got 'stress', which scene 0 does not have"):
        export(flat, tmp_path / "out", fields=["stress"])
    assert list(tmp_path.iterdir()) == []
    if export is data.export_tfrecord:
        with pytest.raises(ValueError, match=r"fields must be arrays \[T, N, ...\], got 'mass'"):
            export(flat, tmp_path / "out", fields=["mass"])


@pytest.mark.parametrize("name", ["position", "particle_type"])
@pytest.mark.parametrize("export", [data.export_lagrangebench, data.export_neuralmpm, data.export_tfrecord])
def test_fields_that_every_export_has(flat, tmp_path, export, name):
    with pytest.raises(DatasetError, match=f"fields must be of .*, got '{name}', which every export has"):
        export(flat, tmp_path / "out", fields=["velocity", name])
    assert list(tmp_path.iterdir()) == []


OWN_NAMES = [
    (data.export_neuralmpm, "particles"),
    (data.export_neuralmpm, "boundary"),
    (data.export_neuralmpm, "types"),
    (data.export_tfrecord, "step_context"),
]


@pytest.mark.parametrize(("export", "name"), OWN_NAMES)
def test_fields_with_a_name_of_the_format(tmp_path, export, name):
    source = datasets.make_dataset(tmp_path / "set", shards=0)
    with_arrays(source, lambda arrays: {**arrays, name: arrays["velocity"]})
    with pytest.raises(DatasetError, match=f"fields: '{name}' would be written as '{name}', a name of another array"):
        export(source, tmp_path / "out", fields=[name])


def test_two_fields_with_one_name(tmp_path):
    """A stress without a measure in its name becomes that with it."""
    source = datasets.make_dataset(tmp_path / "set", shards=0)
    stress = np.zeros((FRAMES, 20, 2, 2), np.float32)
    with_arrays(source, lambda arrays: {**arrays, "stress": stress, "cauchy_stress": stress})
    data.export_lagrangebench(source, tmp_path / "once", fields=["stress", "stress"])
    with pytest.raises(DatasetError, match="fields: 'cauchy_stress' would be written as 'cauchy_stress', a name"):
        data.export_lagrangebench(source, tmp_path / "out", fields=["stress", "cauchy_stress"])


# ---- for people


def test_scenes_for_paraview(source, tmp_path):
    meshio = pytest.importorskip("meshio")
    folder = data.export_scenes_vtk(source, tmp_path / "out", scenes=[4, 7])
    assert sorted(p.name for p in folder.iterdir()) == ["scene_0000004", "scene_0000007"]
    mesh = meshio.read(folder / "scene_0000007" / "frame_00003.vtu")
    given, dim = datasets.arrays(7, dim_of(source)), dim_of(source)
    np.testing.assert_array_equal(mesh.points[:, :dim], given["position"][3])
    np.testing.assert_array_equal(mesh.point_data["velocity"][:, :dim], given["velocity"][3])
    np.testing.assert_array_equal(mesh.point_data["particle_type"], given["particle_type"])
    assert 'timestep="0.0075"' in (folder / "scene_0000007" / "run.pvd").read_text()
    clouds = data.export_scenes_ply(source, tmp_path / "ply")
    cloud = meshio.read(clouds / "scene_0000000" / "frame_00011.ply")
    np.testing.assert_array_equal(cloud.points[:, :dim], datasets.arrays(0, dim)["position"][-1])
    with pytest.raises(KeyError, match="no finished and valid scene 3"):
        data.export_scenes_vtk(source, tmp_path / "none", scenes=[3])


# ---- all of them


@pytest.mark.parametrize("export", ALL)
def test_metadata_serves_every_reader(flat, tmp_path, export):
    words = metadata_of(export(flat, tmp_path / "out"))
    assert words["sequence_length"] == FRAMES - 1
    for block in ("train", "rollout"):
        assert words[block]["sequence_length"] == FRAMES
        assert {"bounds", "dim", "dt", "vel_mean", "acc_std", "default_connectivity_radius"} <= set(words[block])
    assert words["bounds"] == [[0.0, 1.0], [0.0, 2.0]] and words["dt"] == 0.0025


OF_SCENES = [data.export_scenes_vtk, data.export_scenes_ply]


@pytest.mark.parametrize(
    "export", [*ALL, *OF_SCENES, lambda source, out: data.export_tfrecord(source, out, context=True)]
)
def test_a_data_set_without_a_valid_scene(tmp_path, export):
    source = datasets.make_dataset(tmp_path / "set", shards=0)
    with pytest.raises(ValueError, match="has no valid scene yet"):
        export(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("export", ALL)
def test_an_export_appears_whole_or_not_at_all(flat, tmp_path, export, monkeypatch):
    scenes = common.Export.scenes

    def killed(self, split):
        yield next(scenes(self, split))
        raise KeyboardInterrupt

    monkeypatch.setattr(common.Export, "scenes", killed)
    with pytest.raises(KeyboardInterrupt):
        export(flat, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    assert (export(flat, tmp_path / "out") / "metadata.json").exists()
    with pytest.raises(FileExistsError, match="choose another folder"):
        export(flat, tmp_path / "out")


def test_unfinished_and_empty_splits_are_left_out(tmp_path):
    source = datasets.make_dataset(tmp_path / "set", shards=1)  # scenes 0 to 3; scene 3 failed
    folder = data.export_gns(source)
    assert sorted(p.name for p in folder.iterdir()) == ["metadata.json", "train.npz"]
    assert len(list(gns_samples(folder / "train.npz"))) == 3 * (FRAMES - 6)
    for export in ALL[1:]:
        export(source)
    assert not list(source.rglob("valid.*")) and not list(source.rglob("sim_3.h5"))


def test_what_loaders_cannot_read_is_refused(tmp_path):
    source = datasets.make_dataset(tmp_path / "set", frames=FRAMES + 1)
    shutil.rmtree(source / "shards")
    (source / "shards").mkdir()
    datasets.write_shard(source, 0)
    with pytest.raises(ValueError, match="scene_0000000 has 12 frames in 2-D, not 13 in 2-D"):
        data.export_gns(source)


def test_a_damaged_shard_is_noticed(tmp_path):
    source = datasets.make_dataset(tmp_path / "set")
    path = shard_path(source, 1)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(DamagedFileError, match="checksum is wrong"):
        data.export_gns(source)
    assert not (source / "gns").exists()
    record_path(path).unlink()  # as `verify` leaves it, to be generated again
    data.export_gns(source)


def test_a_disk_without_room(flat, tmp_path, monkeypatch):
    monkeypatch.setattr(common.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1, 1, 0))
    with pytest.raises(OSError, match="the positions need") as caught:
        data.export_gns(flat, tmp_path / "out")
    assert caught.value.errno == errno.ENOSPC and list(tmp_path.iterdir()) == []
