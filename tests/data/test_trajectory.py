"""Trajectory files: whole frames only, readable by plain h5py at every moment, and the exports made from them."""

import dataclasses

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")

from torch_mpm.data import trajectory  # noqa: E402
from torch_mpm.data.export import export_ply, export_vtk  # noqa: E402
from torch_mpm.data.trajectory import COMPLETE, PARTIAL, Layout, Trajectory, TrajectoryWriter, create  # noqa: E402
from torch_mpm.errors import DamagedFileError  # noqa: E402

FRAMES, PARTICLES = 4, 5


@pytest.fixture
def layout():
    scalars = {"time": ((), "f8"), "particles": ((), "i8"), "momentum": ((2,), "f8")}
    return Layout(
        frames=FRAMES,
        particles=PARTICLES,
        fields={"position": ((2,), "f4"), "velocity": ((2,), "f4"), "stress": ((2, 2), "f4")},
        scalars=scalars,
        statics={
            "mass": np.arange(1.0, PARTICLES + 1),
            "volume": np.ones(PARTICLES),
            "material": np.zeros(PARTICLES, np.int32),
        },
        names={"material": ["water"]},
        attributes={"title": "test", "scene": "x" * 100_000, "seed": 3},
    )


def frame(k, count=PARTICLES):
    rng = np.random.default_rng(k)
    fields = {"position": (2,), "velocity": (2,), "stress": (2, 2)}
    values = {name: rng.random((count, *shape), np.float32) for name, shape in fields.items()}
    return values | {"time": np.array(0.1 * k), "particles": np.array(count), "momentum": rng.random(2)}


@pytest.fixture
def written(tmp_path, layout):
    create(tmp_path / PARTIAL, layout)
    writer = TrajectoryWriter(tmp_path / PARTIAL)
    for k in range(FRAMES):
        writer.write(k, frame(k, PARTICLES if k else 3))
    writer.close()
    return tmp_path


def test_what_is_written_is_read(written):
    with Trajectory(written) as read:
        assert read.complete and len(read) == FRAMES and read.path.name == COMPLETE
        assert read.names("material") == ["water"]
        assert read.attributes["title"] == "test" and len(read.attributes["scene"]) == 100_000
        for k, got in enumerate(read):
            for name, value in frame(k, PARTICLES if k else 3).items():
                np.testing.assert_array_equal(got[name], value)
        assert read["position"].shape == (FRAMES, PARTICLES, 2)
        assert np.isnan(read["position"][0, 3:]).all()  # not yet emitted
        with pytest.raises(IndexError, match="between 0 and 3, got 4"):
            read.frame(4)


def test_plain_h5py_reads_it_with_units(written):
    with h5py.File(written / COMPLETE) as file:
        np.testing.assert_array_equal(file["position"][2], frame(2)["position"])
        assert file["position"].attrs["unit"] == "m"
        assert file["stress"].attrs["unit"] == "Pa"
        assert list(file["material"].attrs["names"]) == ["water"]
        assert file.attrs["seed"] == 3


def test_a_frame_counts_only_when_it_is_whole(tmp_path, layout, monkeypatch):
    create(tmp_path / PARTIAL, layout)
    writer = TrajectoryWriter(tmp_path / PARTIAL)
    writer.write(0, frame(0))
    writes = []

    def killed(fd, data, offset):
        if len(writes) == 2:
            raise KeyboardInterrupt
        writes.append(offset)
        written(fd, data, offset)

    written = trajectory._write_all
    monkeypatch.setattr(trajectory, "_write_all", killed)
    with pytest.raises(KeyboardInterrupt):
        writer.write(1, frame(1))
    with Trajectory(tmp_path) as read:
        assert len(read) == 1 and not read.complete and read.path.name == PARTIAL
        np.testing.assert_array_equal(read["position"], frame(0)["position"][None])
    monkeypatch.undo()
    again = TrajectoryWriter(tmp_path / PARTIAL)
    assert again.frames_written == 1
    for k in range(1, FRAMES):
        again.write(k, frame(k))
    again.close()
    with Trajectory(tmp_path) as read:
        np.testing.assert_array_equal(read["stress"], np.stack([frame(k)["stress"] for k in range(FRAMES)]))


def test_a_rewound_trajectory_is_not_complete(written):
    (written / COMPLETE).rename(written / PARTIAL)
    writer = TrajectoryWriter(written / PARTIAL)
    writer.rewind(2)
    writer.close()
    with Trajectory(written) as read:
        assert len(read) == 2 and not read.complete


def test_no_room_leaves_nothing(tmp_path, layout):
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_500, hard))
    try:
        with pytest.raises(OSError):
            create(tmp_path / PARTIAL, layout)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_missing_things(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="there is no trajectory"):
        Trajectory(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    (tmp_path / COMPLETE).touch()
    with pytest.raises(ImportError, match=r"pip install torch-mpm\[data\]"):
        Trajectory(tmp_path)


@pytest.mark.parametrize("reads", ["arrays", "frames", "ply", "vtk"])
def test_flipped_bits_are_not_read(tmp_path, layout, reads):
    """A read returns the written values, or raises: metadata, arrays, numbers of frames, checksums."""
    layout = dataclasses.replace(layout, attributes={"title": "test", "seed": 3})
    create(tmp_path / PARTIAL, layout)
    writer = TrajectoryWriter(tmp_path / PARTIAL)
    for k in range(FRAMES):
        writer.write(k, frame(k))
    writer.close()
    file, found = tmp_path / COMPLETE, 0
    data = file.read_bytes()
    with h5py.File(file) as read:
        counter = read["frames_written"].id.get_offset()
    with Trajectory(tmp_path) as read:
        described = read.attributes, read.measures
    exports = {"ply": export_ply, "vtk": export_vtk}
    for place in [counter, *range(0, len(data), len(data) // (150 if reads in ("arrays", "frames") else 12))]:
        file.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        try:
            if reads in exports:
                exports[reads](tmp_path, tmp_path / f"{reads}{place}")
                continue
            with Trajectory(tmp_path) as read:
                assert len(read) == FRAMES
                assert (read.attributes, read.measures) == described
                arrays = [{name: read[name][k] for name in read.columns} for k in range(FRAMES)]
                for k, got in enumerate(arrays if reads == "arrays" else read):
                    for name, value in frame(k).items():
                        np.testing.assert_array_equal(got[name], value)
        except DamagedFileError:
            found += 1
    assert found > (30 if reads in ("arrays", "frames") else 3)


def test_vtk_holds_the_stress(written):
    meshio = pytest.importorskip("meshio")
    index = export_vtk(written)
    assert 'timestep="0.2" file="frame_00002.vtu"' in index.read_text().replace("0.200000003", "0.2")
    mesh = meshio.read(written / "vtk" / "frame_00002.vtu")
    stress = mesh.point_data["cauchy_stress"].reshape(-1, 3, 3)
    np.testing.assert_array_equal(stress[:, :2, :2], frame(2)["stress"])
    assert (stress[:, 2, :2] == 0).all() and np.isnan(stress[:, 2, 2]).all() and (mesh.points[:, 2] == 0).all()
    np.testing.assert_array_equal(mesh.points[:, :2], frame(2)["position"])
    assert len(meshio.read(written / "vtk" / "frame_00000.vtu").points) == 3
    assert not [p for p in (written / "vtk").iterdir() if p.name.startswith(".")]


def test_ply_holds_the_velocity(written):
    meshio = pytest.importorskip("meshio")
    cloud = meshio.read(export_ply(written) / "frame_00001.ply")
    np.testing.assert_array_equal(cloud.points[:, :2], frame(1)["position"])
    velocity = frame(1)["velocity"]
    np.testing.assert_array_equal(cloud.point_data["vx"], velocity[:, 0])
    np.testing.assert_allclose(cloud.point_data["speed"], np.linalg.norm(velocity, axis=1), rtol=1e-6)


def test_export_without_meshio_names_the_extra(written, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "meshio", None)
    with pytest.raises(ImportError, match=r"pip install torch-mpm\[data\]"):
        export_vtk(written)
