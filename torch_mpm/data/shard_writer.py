"""Writing of shards, scene by scene."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from .hdf5 import QuietFile, h5py_module, outside, seal
from .packing import GZIP_LEVEL, Array, Compressed, PreparedScene
from .shard import FORMAT, SceneRecord, ShardRecord, record_path, scene_name
from .stress import MEASURES
from .whole_files import appear, building_path, file_hash

Attributes = Mapping[str, str | int | float]


class ShardWriter:
    """Writer of a shard, to which scenes are added in any order; :meth:`finish` publishes it.

    A context manager; without `finish`, nothing remains.

    Args:
        path: path of the shard.
        attributes: texts and numbers about the whole shard.
        configuration: hash of the configuration of its data set.

    Raises:
        ImportError: when h5py is missing (extra ``data``).
        OSError: where no file can be created.
    """

    def __init__(self, path: Path, attributes: Attributes | None = None, configuration: str = "") -> None:
        h5py = h5py_module()
        self._configuration = configuration
        self._path, self._building = path, building_path(path)
        self._disk = QuietFile(self._building)
        self._file = h5py.File(self._disk, "w", libver="v110")
        self._file.attrs.update({"format": FORMAT, **(attributes or {})})
        self._scenes: list[SceneRecord] = []
        self._numbers: list[tuple[int, int]] = []

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._file.close()
        finally:
            self._disk.close()
            self._building.unlink(missing_ok=True)

    def add(self, scene_id: int, scene: PreparedScene, attributes: Attributes) -> None:
        """Add a scene.

        Args:
            scene_id: its number in the data set.
            scene: result of :func:`torch_mpm.data.packing.prepare_scene`.
            attributes: must have ``valid`` (0 or 1); ``attempts`` and ``failure`` also go into the record.

        Raises:
            OSError: for a full disk, among others.
        """
        group = _new_group(self._file.id, scene_name(scene_id))
        for name, value in {"id": scene_id, **attributes}.items():
            _write_attribute(group, name, value)
        for name, values in scene.arrays.items():
            if isinstance(values, Compressed):
                self._numbers += _write_chunks(group, name, values)
            else:
                self._numbers += _write_array(group, name, values)
        self._disk.check()
        record = SceneRecord(
            scene_id,
            bool(attributes["valid"]),
            scene.particles,
            scene.hash,
            int(attributes.get("attempts", 1)),
            str(attributes.get("failure", "")),
            scene.motion,
            scene.digests,
        )
        self._scenes.append(record)

    def finish(self) -> ShardRecord:
        """Write the rest of the shard and then its record; each appears when it is complete and on the disk.

        Every array of numbers has a checksum. A seal, one more checksum, covers the rest of the file. A reader compares
        the seal before HDF5 opens the file, and does not read the whole shard.

        Raises:
            OSError: for a full disk, among others.
        """
        self._file.close()
        self._disk.check()
        with open(self._building, "r+b") as handle:
            sealed = seal(handle, outside(self._numbers, self._disk.size))
        with ThreadPoolExecutor(1) as beside:  # A disk and a hash take about as long.
            digest = beside.submit(file_hash, self._building)
            self._disk.sync()
        appear(self._building, self._path)
        scenes = sorted(self._scenes, key=lambda scene: scene.id)
        record = ShardRecord(self._path.stat().st_size, digest.result(), scenes, sealed, self._configuration)
        record.write(record_path(self._path))
        return record


# ---- by the functions of HDF5 itself: those of h5py take twice as long, and hold Python's lock


def _new_group(parent: Any, name: str) -> Any:
    h5py = h5py_module()
    properties = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    properties.set_obj_track_times(False)  # Equal runs write equal files.
    return h5py.h5g.create(parent, name.encode(), gcpl=properties)


def _write_attribute(group: Any, name: str, value: str | int | float) -> None:
    h5py = h5py_module()
    kind = h5py.string_dtype() if isinstance(value, str) else np.asarray(value).dtype
    stored = h5py.h5t.py_create(kind, logical=True)
    attribute = h5py.h5a.create(group, name.encode(), stored, h5py.h5s.create(h5py.h5s.SCALAR))
    attribute.write(np.array(value, kind), mtype=h5py.h5t.py_create(kind))


def _write_array(group: Any, name: str, values: Array) -> list[tuple[int, int]]:
    """Write an array; returns the offset and the length of its numbers in the file [bytes]."""
    values = np.ascontiguousarray(values)
    data = _new_dataset(group, name, values.shape, values.dtype)
    data.write(h5py_module().h5s.ALL, h5py_module().h5s.ALL, values)
    return [(data.get_offset(), values.nbytes)] if values.nbytes else []


def _write_chunks(group: Any, name: str, values: Compressed) -> list[tuple[int, int]]:
    """Write a compressed array; returns the offset and the length of each chunk in the file [bytes]."""
    chunk = (values.chunk_frames, *values.shape[1:])
    data = _new_dataset(group, name, values.shape, values.dtype, chunk)
    for k, packed in enumerate(values.chunks):
        data.write_direct_chunk((k * values.chunk_frames, *(0,) * (len(chunk) - 1)), packed)
    stored: list[tuple[int, int]] = []
    # `get_chunk_info` takes a time proportional to the number of chunks, for each of them.
    data.chunk_iter(lambda info: stored.append((info.byte_offset, info.size)))
    return stored


def _new_dataset(
    group: Any, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], chunk: tuple[int, ...] | None = None
) -> Any:
    h5py = h5py_module()
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    if chunk is not None:
        properties.set_chunk(chunk)
        properties.set_shuffle()
        properties.set_deflate(GZIP_LEVEL)
    space = h5py.h5s.create_simple(shape)
    data = h5py.h5d.create(group, name.encode(), h5py.h5t.py_create(dtype), space, dcpl=properties)
    if name in MEASURES:
        _write_attribute(data, "measure", MEASURES[name])
    return data
