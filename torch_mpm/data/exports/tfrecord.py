"""TFRecord files of "Learning to Simulate" (Sanchez-Gonzalez et al. 2020), which PhysicsNeMo reads too.

A record is a ``tf.train.SequenceExample`` in the framing of TensorFlow: length, its checksum, bytes, their checksum
(https://www.tensorflow.org/tutorials/load_data/tfrecord). The few required kinds of protocol buffer fields are written
here, without TensorFlow or a compiler of protocol buffers.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ... import optional
from ..folder import DatasetError, DatasetFolder
from ..whole_files import named_errors
from .common import Array, ExportedScene, as_float32, exported_ids, exporting, fields_of

log = logging.getLogger(__name__)


def export_tfrecord(
    dataset: str | Path | DatasetFolder,
    out: str | Path | None = None,
    fields: Sequence[str] = (),
    context: bool = False,
) -> Path:
    """Write a data set for DeepMind's reader and PhysicsNeMo: ``train.tfrecord``, ``valid.tfrecord``, ...

    A record has the context ``key`` (number in the split) and ``particle_type`` (int64 bytes), and one entry of
    ``position`` (float32 bytes) per frame. PhysicsNeMo uses the bounds of the first axis for all axes, which a warning
    states, and needs ``num_node_types=9`` for sand and goop. There is no ``.tfindex``: with one, PhysicsNeMo would
    begin at a random record, different in each process.

    Args:
        dataset: folder of the data set.
        out: folder to create; ``tfrecord`` in that of the data set by default.
        fields: further arrays [T, N, ...] of the scenes to write as features of every frame, float32 bytes, such as
            "stress", which is written as ``cauchy_stress``; readers skip fields that they do not name.
        context: whether every frame has ``step_context`` (float32 bytes), the gravity [D] of the scene; metadata.json
            then has ``context_mean`` and ``context_std``, by which DeepMind's reader detects it.

    Returns and errors as :func:`export_gns`; DatasetError also for a field that is missing or written twice;
    ImportError without google-crc32c (extra ``data``).
    """
    checksum = _crc32c()
    more: dict[str, Any] = {"more": _context_statistics} if context else {}
    with exporting(dataset, out, "tfrecord", **more) as export:
        source, record = export.dataset, export.dataset.record
        if len(set(zip(record.lower, record.upper, strict=True))) > 1:
            log.warning("PhysicsNeMo takes the bounds of the first axis for all axes; those of this data set differ")
        for split in record.splits:
            if not exported_ids(export.dataset, split):
                continue
            path = export.folder / f"{split}.tfrecord"
            with named_errors(path), open(path, "wb") as file:
                for k, scene in enumerate(export.scenes(split)):
                    frames = _frames(scene, fields, _gravity(source, scene.id) if context else None)
                    _write_record(file, _sequence_example(k, scene.particle_type, frames), checksum)
    return export.target


def _gravity(dataset: DatasetFolder, number: int) -> Array:
    """Gravity of a scene [D] [m/s^2]."""
    return np.array(dataset.scene(number).words.get("gravity") or [0.0] * dataset.record.dim, np.float32)


def _context_statistics(dataset: DatasetFolder) -> dict[str, list[float]]:
    """Statistics of the context, over all scenes."""
    values = np.stack([_gravity(dataset, scene.id) for scene in dataset.scenes()]).astype(np.float64)
    return {"context_mean": values.mean(0).tolist(), "context_std": values.std(0).tolist()}


def _frames(scene: ExportedScene, fields: Sequence[str], context: Array | None) -> dict[str, Array]:
    """Features of every frame, by name: arrays [T, ...]."""
    names = fields_of(scene, fields, ("step_context",))
    more = {name: as_float32(scene.arrays, field) for name, field in names.items()}
    if flat := [name for name, values in more.items() if len(values.shape) < 2]:
        raise DatasetError(f"fields must be arrays [T, N, ...], got {flat[0]!r}")
    steps = {} if context is None else {"step_context": np.tile(context, (len(scene.position), 1))}
    return {"position": scene.position, **more, **steps}


def _crc32c() -> Any:
    return optional.load("google_crc32c", "TFRecord files", "data").value


def _write_record(file: BinaryIO, data: bytes, checksum: Any) -> None:
    def masked(part: bytes) -> bytes:
        crc = checksum(part)
        return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)

    length = struct.pack("<Q", len(data))
    for part in (length, masked(length), data, masked(data)):
        file.write(part)


# ---- protocol buffers: a field is its number and kind, its length, its bytes


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _field(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _map(entries: dict[str, bytes]) -> bytes:
    return b"".join(_field(1, _field(1, name.encode()) + _field(2, data)) for name, data in entries.items())


def _bytes_feature(data: bytes) -> bytes:
    return _field(1, _field(1, data))


def _int_feature(value: int) -> bytes:
    return _field(3, _field(1, _varint(value)))


def _feature_list(features: Iterable[bytes]) -> bytes:
    return b"".join(_field(1, feature) for feature in features)


def _sequence_example(key: int, particle_type: Array, frames: Mapping[str, Array]) -> bytes:
    types = _bytes_feature(particle_type.astype("<i8").tobytes())
    context = _map({"key": _int_feature(key), "particle_type": types})
    lists = {
        name: _feature_list(_bytes_feature(np.asarray(frame, "<f4").tobytes()) for frame in values)
        for name, values in frames.items()
    }
    return _field(1, context) + _field(2, _map(lists))
