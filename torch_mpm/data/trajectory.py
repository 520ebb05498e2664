"""Trajectories on disk: one HDF5 file, readable by any HDF5 program, that a kill at any moment cannot damage.

All metadata and the space of all frames are written before the first frame; after that a frame is plain bytes at known
offsets, followed by the number of complete frames. So the file is valid HDF5 at every moment, an incomplete frame is
never counted, and a disk that is too small is detected before the run starts. Until it is complete the file is called
``trajectory.partial.h5``. Its metadata and constant arrays are sealed (:mod:`torch_mpm.hdf5`), and every frame has a
checksum: damaged data raise DamagedFileError when they are read.

Layout: ``position``, ``velocity`` and the requested fields are [T, N, ...], where particle n has id n; stresses have an
attribute ``measure``, "Cauchy" or "Kirchhoff" (without it, ``stress`` is the Kirchhoff stress); ``mass``, ``volume``,
``material``, ``scene`` are [N]; ``time``, ``particles``, ``substeps``, the energies and ``momentum`` are [T] or [T, D];
``frames_written`` is [1]; ``checksum`` [T, K] is the CRC-32 of each frame of the K arrays that its attribute ``names``
lists. Particles that are not yet emitted are NaN.
"""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import DamagedFileError
from .hdf5 import SparseFile, h5py_module, open_sealed, seal
from .stress import MEASURES, measure_of
from .whole_files import building_path

Array = npt.NDArray[Any]

FORMAT = 2
COMPLETE = "trajectory.h5"
PARTIAL = "trajectory.partial.h5"
STATICS = ("mass", "volume", "material", "scene", "gaussian")
COUNTERS = ("frames_written", "checksum")

UNITS = {
    "position": "m", "velocity": "m/s", "F": "1", "J": "1", "C": "1/s", "temperature": "K",
    **dict.fromkeys(MEASURES, "Pa"),
    "liquid": "1", "heat": "J", "mass": "kg", "volume": "m^3",
    "material": "index into attribute names", "scene": "index into attribute names",
    "gaussian": "number of the Gaussian; -1 inside an object, -2 elsewhere",
    "time": "s", "particles": "1", "substeps": "1", "kinetic_energy": "J", "elastic_energy": "J",
    "potential_energy": "J", "momentum": "kg m/s", "cfl": "1", "frames_written": "1",
    "checksum": "CRC-32",
}  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """Content of a trajectory.

    ``fields`` per particle and frame and ``scalars`` per frame map a name to (trailing shape, dtype); ``statics`` [N]
    are the constant arrays; ``attributes`` are texts and numbers about the whole file.
    """

    frames: int
    particles: int
    fields: Mapping[str, tuple[tuple[int, ...], str]]
    scalars: Mapping[str, tuple[tuple[int, ...], str]]
    statics: Mapping[str, Array] = field(default_factory=dict)
    names: Mapping[str, list[str]] = field(default_factory=dict)
    attributes: Mapping[str, str | int | float | Sequence[float]] = field(default_factory=dict)

    @property
    def bytes(self) -> int:
        """Size of the frames [bytes]."""
        per_frame = sum(self.particles * math.prod(s) * np.dtype(t).itemsize for s, t in self.fields.values())
        return self.frames * (per_frame + sum(math.prod(s) * np.dtype(t).itemsize for s, t in self.scalars.values()))

    def describes(self, trajectory: Trajectory) -> bool:
        """Whether a trajectory has these arrays and this fingerprint."""
        arrays = {name: ((self.frames, self.particles, *shape), dtype) for name, (shape, dtype) in self.fields.items()}
        arrays |= {name: ((self.frames, *shape), dtype) for name, (shape, dtype) in self.scalars.items()}
        arrays |= {name: (values.shape, values.dtype.str) for name, values in self.statics.items()}
        found = {name: (d.shape, d.dtype.str) for name, d in trajectory.file.items() if name not in COUNTERS}
        same = found == {name: (shape, np.dtype(dtype).str) for name, (shape, dtype) in arrays.items()}
        return same and trajectory.attributes.get("fingerprint") == self.attributes.get("fingerprint")


def create(path: Path, layout: Layout) -> None:
    """Write an empty trajectory with space for all its frames; the file appears under ``path`` only when it is
    complete.

    Raises:
        OSError: when the disk is full (ENOSPC).
    """
    image = SparseFile()
    places = _metadata(image, layout)
    building = building_path(path)
    try:
        with open(building, "w+b") as handle:
            fd, extents = handle.fileno(), image.extents()
            os.posix_fallocate(fd, 0, image.size)  # The holes of the file are allocated now, not in frame 90.
            for offset, length in extents:
                image.seek(offset)
                _write_all(fd, np.frombuffer(image.read(length), np.uint8), offset)
            for name, values in layout.statics.items():
                _write_all(fd, np.ascontiguousarray(values), places[name])
            seal(handle, [*extents, *((places[name], values.nbytes) for name, values in layout.statics.items())])
            handle.flush()
            os.fsync(fd)
    except BaseException:
        building.unlink(missing_ok=True)
        raise
    building.rename(path)


def _metadata(image: SparseFile, layout: Layout) -> dict[str, int]:
    """Write all of a trajectory except its numbers; returns the offsets of the arrays [bytes]."""
    h5py = h5py_module()
    columns = sorted([*layout.fields, *layout.scalars])
    with h5py.File(image, "w", libver="v110") as out:
        for name, (shape, dtype) in layout.fields.items():
            _reserve(h5py, out, name, (layout.frames, layout.particles, *shape), dtype)
        for name, (shape, dtype) in layout.scalars.items():
            _reserve(h5py, out, name, (layout.frames, *shape), dtype)
        for name, values in layout.statics.items():
            _reserve(h5py, out, name, values.shape, values.dtype.str)
        _reserve(h5py, out, "frames_written", (1,), "i8")
        _reserve(h5py, out, "checksum", (layout.frames, len(columns)), "u4")
        for name, data in out.items():
            data.attrs["unit"] = UNITS.get(name, "")
            if name in MEASURES:
                data.attrs["measure"] = MEASURES[name]
        for name, names in {**layout.names, "checksum": columns}.items():
            out[name].attrs["names"] = names
        out.attrs.update({"format": FORMAT, **layout.attributes})
        return {name: data.id.get_offset() for name, data in out.items()}


def _reserve(h5py: Any, out: Any, name: str, shape: tuple[int, ...], dtype: str) -> None:
    """Contiguous dataset at a fixed position in the file; its frames are not filled in."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    properties.set_obj_track_times(False)  # equal runs write equal files
    space = h5py.h5s.create_simple(shape)
    h5py.h5d.create(out.id, name.encode(), h5py.h5t.py_create(np.dtype(dtype)), space, properties)


class TrajectoryWriter:
    """Writer of the frames of a trajectory created by `create`; continues from frame ``frames_written``.

    Raises:
        DamagedFileError: for a file that is not a complete trajectory.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with Trajectory(path) as source:
            self.frames_written, self.frames = len(source), source.frames
            data = {name: source.file[name] for name in (*source.columns, *COUNTERS)}
            self._places = {name: (d.id.get_offset(), d.shape[1:], d.dtype) for name, d in data.items()}
            self._columns = source.columns
        self._fd = os.open(path, os.O_WRONLY)

    def write(self, frame: int, values: Mapping[str, Array]) -> None:
        """Write frame ``frame`` and, when its bytes are on the disk, count it.

        Rows of particles that ``values`` lacks are NaN.
        """
        checksums = []
        for name in self._columns:
            offset, shape, dtype = self._places[name]
            row = value = values[name]
            if len(shape) and value.shape != shape:
                row = np.full(shape, np.nan, dtype)
                row[: len(value)] = value
            data = np.ascontiguousarray(row, dtype)
            _write_all(self._fd, data, offset + frame * data.nbytes)
            checksums.append(zlib.crc32(data.data))
        row = np.array(checksums, np.uint32)
        _write_all(self._fd, row, self._places["checksum"][0] + frame * row.nbytes)
        os.fsync(self._fd)
        self._count(frame + 1)

    def _count(self, frames: int) -> None:
        self.frames_written = frames
        _write_all(self._fd, np.array([frames], np.int64), self._places["frames_written"][0])

    def rewind(self, frames: int) -> None:
        """Discard the frames from number ``frames`` on."""
        self._count(frames)

    def close(self) -> None:
        """Close the file, under its final name if it is complete."""
        os.fsync(self._fd)
        os.close(self._fd)
        if self.frames_written == self.frames:
            self.path = self.path.rename(self.path.with_name(COMPLETE))


def _write_all(fd: int, data: Array, offset: int) -> None:
    rest = memoryview(np.atleast_1d(data).view(np.uint8).reshape(-1))  # type: ignore[arg-type]
    while rest:
        written = os.pwrite(fd, rest, offset)
        rest, offset = rest[written:], offset + written


class Trajectory:
    """A trajectory, complete or still growing: ``Trajectory("out/demo")`` or the path of an HDF5 file.

    ``trajectory["position"]`` is the array [frames, N, D] of the frames written so far, ``trajectory.frame(k)`` one
    frame without particles that are not yet emitted. Works as a context manager.

    Raises:
        FileNotFoundError: when there is no trajectory.
        DamagedFileError: for a file that is not a trajectory or is damaged; later, where damaged frames are read.
        ImportError: when h5py is missing (extra ``data``).
    """

    def __init__(self, path: str | Path) -> None:
        self.path = find(path)
        self.file = open_sealed(self.path, self._remedy)
        try:
            problem = _problem(self.file)
        except (KeyError, TypeError, ValueError, IndexError) as error:  # Attributes of another kind.
            problem = f"is no trajectory: {error}"
        if not problem and self.path.name == COMPLETE and len(self) < len(self.file["time"]):
            problem = f"states that {len(self)} of its {len(self.file['time'])} frames are written, and was complete"
        if problem:
            self.file.close()
            raise DamagedFileError(self.path, problem, self._remedy)
        self.frames, self.particles = self.file["position"].shape[:2]
        self.fields = [n for n, d in self.file.items() if d.ndim >= 2 and d.shape[:2] == (self.frames, self.particles)]
        self.columns = [str(name) for name in self.file["checksum"].attrs["names"]]

    @property
    def _remedy(self) -> str:
        if self.path.name == PARTIAL:
            return "remove it and add --resume to simulate from the start"
        return "remove it and the rest of its folder, and simulate again"

    def __enter__(self) -> Trajectory:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self.file.close()

    @property
    def complete(self) -> bool:
        return len(self) == self.frames

    @property
    def attributes(self) -> dict[str, Any]:
        """Title, scene file, seed, versions, ... of the run."""
        return dict(self.file.attrs)

    def __len__(self) -> int:
        return int(self.file["frames_written"][0])

    def __getitem__(self, name: str) -> Array:
        """A field [frames, N, ...], a quantity per frame [frames, ...], or one per particle [N]."""
        data = self.file[name]
        if name in (*STATICS, *COUNTERS):
            array: Array = data[:]
            return array
        array = data[: len(self)]
        for k, row in enumerate(array):
            self._check(name, k, row)
        return array

    @property
    def statics(self) -> dict[str, Array]:
        """The quantities per particle [N]: mass, volume, material, and in a batch scene."""
        return {name: self.file[name][:] for name in STATICS if name in self.file}

    def verify(self, frames: int) -> None:
        """Read the first frames and raise DamagedFileError for one that was changed."""
        for k in range(frames):
            for name in self.columns:
                self._check(name, k, self.file[name][k])

    def _check(self, name: str, k: int, row: Any) -> None:
        expected = int(self.file["checksum"][k, self.columns.index(name)])
        if zlib.crc32(np.ascontiguousarray(row).data) != expected:
            raise DamagedFileError(self.path, f"{name} of frame {k} is damaged: its checksum is wrong", self._remedy)

    def names(self, name: str) -> list[str]:
        """Names of the indices of ``material`` or ``scene``."""
        return [str(n) for n in self.file[name].attrs["names"]]

    @property
    def measures(self) -> dict[str, str]:
        """Measure of each stress, "Cauchy" or "Kirchhoff"; the latter for "stress" without the attribute `measure`."""
        stresses = [name for name in self.fields if name in MEASURES]
        try:
            return {name: measure_of(name, self.file[name].attrs.get("measure")) for name in stresses}
        except ValueError as error:
            raise DamagedFileError(self.path, str(error), self._remedy) from None

    def frame(self, k: int) -> dict[str, Array]:
        """All of frame ``k``: the fields and constants of its particles, and its scalars."""
        if not 0 <= k < len(self):
            raise IndexError(f"frame must be between 0 and {len(self) - 1}, got {k}")
        rows = {name: self.file[name][k] for name in self.columns}
        for name, row in rows.items():
            self._check(name, k, row)
        count = int(rows["particles"])
        out = {name: rows.pop(name)[:count] for name in self.fields}
        return out | {name: self.file[name][:count] for name in STATICS if name in self.file} | rows

    def __iter__(self) -> Iterator[dict[str, Array]]:
        return (self.frame(k) for k in range(len(self)))


def find(path: str | Path) -> Path:
    """The trajectory file of a run folder, or the file itself."""
    path = Path(path)
    for candidate in (path / COMPLETE, path / PARTIAL) if path.is_dir() else (path,):
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f"there is no trajectory at {path}")


def _problem(file: Any) -> str:
    """Reason why a file of plain arrays is not a trajectory; "" if it is one."""
    if not np.array_equal(file.attrs.get("format"), FORMAT):
        return "is no trajectory of this version of torch_mpm"
    shapes = {name: data.shape for name, data in file.items()}
    needed = ("position", "velocity", "mass", "volume", "material", "time", "particles", *COUNTERS)
    missing = [name for name in needed if name not in shapes]
    if missing or len(shapes["position"]) != 3:
        return f"is no trajectory: it lacks {', '.join(missing) or 'positions [T, N, D]'}"
    frames, particles = shapes["position"][:2]
    names = {name: len(file[name].attrs.get("names", ())) for name in ("material", "scene", "checksum") if name in file}
    columns = [str(name) for name in file["checksum"].attrs.get("names", ())]
    expected: dict[str, tuple[int, ...]] = {name: (particles,) for name in STATICS if name in shapes}
    expected |= {"frames_written": (1,), "checksum": (frames, len(columns))}
    expected |= {name: (frames, *shape[1:]) for name, shape in shapes.items() if name not in expected}
    wrong = [name for name, shape in shapes.items() if shape != expected[name]]
    if wrong or sorted(columns) != sorted(set(shapes) - {*STATICS, *COUNTERS}) or not all(names.values()):
        return f"is no trajectory: {', '.join(wrong) or 'its arrays'} cannot be understood"
    for name, count in names.items():
        if name != "checksum" and particles and not 0 <= file[name][:].min() <= file[name][:].max() < count:
            return f"{name} has a number that stands for nothing"
    for name in ("mass", "volume"):
        if not (np.isfinite(file[name][:]) & (file[name][:] > 0)).all():
            return f"{name} has a number that is not positive"
    written = int(file["frames_written"][0])
    if not 0 <= written <= frames:
        return f"it states that {written} of its {frames} frames are written"
    counts = file["particles"][:written]
    return f"it has frames of more than its {particles} particles" if (counts > particles).any() else ""
