"""Finalisation of a complete data set: its metadata, and a check of its content."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DamagedFileError
from ..files import check_file
from .folder import LINKED, DatasetFolder, DatasetRecord, finished_shards
from .metadata import METADATA, metadata, write_metadata
from .packing import content_hash
from .shard import REMEDY, SceneRecord, Shard, ShardRecord, StoredScene, record_path, shard_path
from .statistics import BOUNDARY, Motion, motion_sums
from .whole_files import CHECKSUM, check_inside, check_record, checksum

STATISTICS = 1e-9
"""Relative difference of sums of a scene that is explained by rounding."""
GAIN = 0.05
"""Maximum relative gain of the mechanical energy of a scene above that of rest on the floor."""


class IncompleteError(ValueError):
    """A data set with missing shards, or without a valid scene."""


def finalize(folder: str | Path) -> dict[str, Any]:
    """Merge the statistics of all shards into ``metadata.json``; repeated calls write the same file.

    Returns:
        Content of metadata.json.

    Raises:
        IncompleteError: for a data set that is not complete.
        FileNotFoundError, DamagedFileError: as `DatasetFolder`.
    """
    dataset = DatasetFolder(folder)
    if missing := dataset.record.missing(dataset.finished):
        raise IncompleteError(f"{folder} lacks {missing}; generate them")
    _check_files(dataset)
    if not dataset.scenes():
        raise IncompleteError(f"{folder} has no valid scene: {dataset.attempted()[0].failure}")
    try:
        words = metadata(dataset)
        words[CHECKSUM] = checksum(json.loads(json.dumps(words)))
        write_metadata(dataset.path, words)
    finally:
        dataset.close()
    return words


def _check_files(dataset: DatasetFolder) -> None:
    """Check the list of finished shards, without reading them.

    Raises:
        DamagedFileError: for a shard that is missing, of another size, or superfluous.
    """
    for index in finished_shards(dataset.path):
        path = shard_path(dataset.path, index)
        if index >= dataset.record.shards:
            raise _superfluous(path, dataset.record)
        recorded = ShardRecord.read(record_path(path))
        if not path.is_file() or path.stat().st_size != recorded.bytes:
            raise DamagedFileError(path, "is gone, or not as long as its record says", REMEDY)


def _superfluous(path: Path, record: DatasetRecord) -> DamagedFileError:
    return DamagedFileError(path, f"is beyond the {record.shards} shards of the data set", "remove it and its .json")


def verify(folder: str | Path) -> Iterator[str]:
    """All problems of the finished shards of a data set and of its ``metadata.json``, one line each.

    Every file is compared with its checksum and every scene with its hash; the positions of a valid scene must be
    finite and in the domain, other fields finite, and its energy must not grow.

    Raises:
        FileNotFoundError, DamagedFileError: for a folder without a readable ``dataset.json``.
    """
    finished = finished_shards(Path(folder))  # Before the record, which is extended before shards are added.
    record = DatasetRecord.read(Path(folder))
    if missing := record.missing(finished):
        yield f"{folder}: {missing} are not there or not finished; generate them"
    yield from _metadata_problems(Path(folder), record)
    for index in finished:
        path = shard_path(Path(folder), index)
        if index >= record.shards:
            yield str(_superfluous(path, record))
            continue
        try:
            with Shard(path, check=True) as shard:
                yield from _shard_problems(shard, record, index)
        except FileNotFoundError:
            yield f"{path}: is not there; generate again"
        except DamagedFileError as error:
            yield f"{error} (--check does so for all damaged shards)"
        except OSError as error:  # Such as a pipe, or a file of another user.
            yield str(error)


def _metadata_problems(folder: Path, record: DatasetRecord) -> Iterator[str]:
    """Problem of ``metadata.json``, which may be missing, be without a checksum or be older than an extension."""
    path, remedy = folder / METADATA, f"torch-mpm finalize {folder} writes it again"
    try:
        check_inside(folder, path, LINKED)
        check_file(path, "metadata", may_be_empty=True)
        words = json.loads(path.read_bytes())
        if words.get("configuration", record.configuration) != record.configuration:
            raise DamagedFileError(path, "is of another data set", remedy)
        if CHECKSUM in words:
            check_record(words, path, remedy)
    except FileNotFoundError:
        return
    except (DamagedFileError, OSError) as error:
        yield str(error)
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        yield f"{path}: is no metadata of a data set ({error}); {remedy}"


def _shard_problems(shard: Shard, record: DatasetRecord, index: int) -> Iterator[str]:
    if difference := shard.record.difference(record.configuration, record.ids(index)):
        yield f"{record_path(shard.path)}: {difference}; {REMEDY} (--check does so for all damaged shards)"
    for recorded in shard.record.scenes:
        try:
            problems = list(_scene_problems(shard.scene(recorded.id), recorded, record))
        except DamagedFileError as error:
            yield f"{error} (--check does so for all damaged shards)"
        else:
            yield from (f"{shard.path}: scene {recorded.id} {problem}" for problem in problems)


def _scene_problems(stored: StoredScene, recorded: SceneRecord, record: DatasetRecord) -> Iterator[str]:
    arrays = {name: stored[name] for name in stored.names}
    if content_hash(arrays) != recorded.hash:
        yield "has another hash than its record says"
    if stored.attributes.get("failure", recorded.failure) != recorded.failure:
        yield "has another failure in its record than in its file"
    if not recorded.valid:
        return
    if lacking := [name for name in record.fields if name not in arrays]:
        yield f"lacks {', '.join(lacking)}"
    if len(arrays["position"]) != record.frames:
        yield f"has {len(arrays['position'])} frames, not {record.frames}"
    broken = [name for name, values in arrays.items() if values.dtype.kind == "f" and not np.isfinite(values).all()]
    if broken:
        yield f"has numbers that are not finite in {', '.join(broken)}"
        return
    if not _same_motion(motion_sums(arrays["position"], arrays.get("particle_type")), recorded.motion):
        yield "has other statistics than its record says"
    free = arrays.get("particle_type", np.zeros(stored.particles)) != BOUNDARY
    x = arrays["position"][:, free]
    slack = record.dx
    if (x < np.array(record.lower) - slack).any() or (x > np.array(record.upper) + slack).any():
        yield "has particles outside of the domain"
    gain = energy_gain(stored, arrays, record)
    if gain is not None and gain > GAIN:
        yield f"gains {gain:.1%} of its energy"


def _same_motion(found: Motion, recorded: Motion | None) -> bool:
    """Whether sums agree: those of a device are added in another order, with differences far below `STATISTICS`."""
    if recorded is None:
        return False
    for a, b in ((found.velocity, recorded.velocity), (found.acceleration, recorded.acceleration)):
        # Bound of |sum|, by the Cauchy-Schwarz inequality.
        scale = np.sqrt(np.maximum(np.array(a.squares) * a.count, 1e-300))
        if a.count != b.count or len(a.sum) != len(b.sum) or len(a.squares) != len(b.squares):
            return False
        if not np.all(np.abs(np.subtract(a.sum, b.sum)) <= STATISTICS * scale):
            return False
        if not np.allclose(a.squares, b.squares, rtol=STATISTICS, atol=0):
            return False
    return True


def energy_gain(stored: StoredScene, arrays: Any, record: DatasetRecord) -> float | None:
    """Largest gain of kinetic and potential energy over the first frame, as a share of it; None where energy may enter:
    by moving obstacles or heat.

    A body starts without elastic energy, so that its mechanical energy can only decrease. Heights are measured from the
    floor, the lowest corner of the domain. Without stored velocities those between frames are used.
    """
    words = stored.words
    if "heat" in words or any("velocity" in o or "spin" in o for o in words.get("obstacle", [])):
        return None
    gravity = np.array(words.get("gravity") or [0.0] * record.dim)
    floor = np.where(gravity < 0, record.lower, record.upper)
    x, mass = arrays["position"].astype(np.float64), arrays.get("mass", np.ones(stored.particles)).astype(np.float64)
    if "velocity" in arrays:
        v = arrays["velocity"].astype(np.float64)
    else:
        v = np.diff(x, axis=0) / record.frame_interval
        x = 0.5 * (x[1:] + x[:-1])
    kinetic = 0.5 * np.einsum("n,tnd->t", mass, v**2)
    potential = -np.einsum("n,tnd,d->t", mass, x - floor, gravity)
    energy = kinetic + potential
    return float((energy.max() - energy[0]) / max(energy[0], 1e-300))
