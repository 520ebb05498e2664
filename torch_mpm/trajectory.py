"""Trajectories on disk: one HDF5 file that any HDF5 program reads, which no kill at any moment can damage.

All metadata and the room for all frames are written before the first frame; after that a frame is plain bytes at
known offsets, followed by the number of whole frames. So the file is valid HDF5 at every moment, half a frame is never
counted, and a disk that is too small is noticed before the run starts. Until it is complete the file is called
``trajectory.partial.h5``.

Layout: ``position``, ``velocity`` and the fields asked for are [T, N, ...], particle n being the one with id n;
``mass``, ``volume``, ``material``, ``scene`` are [N]; ``time``, ``particles``, ``substeps``, the energies and
``momentum`` are [T] or [T, D]; ``frames_written`` is [1]. Particles that an emitter has not yet released are NaN.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

FORMAT = 1
COMPLETE = "trajectory.h5"
PARTIAL = "trajectory.partial.h5"
STATICS = ("mass", "volume", "material", "scene")

UNITS = {
    "position": "m", "velocity": "m/s", "F": "1", "J": "1", "stress": "Pa", "C": "1/s", "temperature": "K",
    "liquid": "1", "heat": "J", "mass": "kg", "volume": "m^3",
    "material": "index into attribute names", "scene": "index into attribute names",
    "time": "s", "particles": "1", "substeps": "1", "kinetic_energy": "J", "elastic_energy": "J",
    "potential_energy": "J", "momentum": "kg m/s", "cfl": "1", "frames_written": "1",
}  # fmt: skip


def h5py_module() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("trajectories need h5py: pip install torch-mpm[data]") from error
    return h5py


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """HDF5 tells of a full disk as OSError without errno, or as RuntimeError: make it the OSError that it is."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = re.search(r"errno = (\d+)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from error


@dataclass(frozen=True)
class Layout:
    """What a trajectory holds.

    ``fields`` per particle and frame and ``scalars`` per frame map a name to (trailing shape, dtype); ``statics`` [N]
    are the arrays that do not change; ``attributes`` are texts and numbers about the whole file.
    """

    frames: int
    particles: int
    fields: Mapping[str, tuple[tuple[int, ...], str]]
    scalars: Mapping[str, tuple[tuple[int, ...], str]]
    statics: Mapping[str, Array] = field(default_factory=dict)
    names: Mapping[str, list[str]] = field(default_factory=dict)
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)

    @property
    def bytes(self) -> int:
        """Size of the frames [bytes]."""
        per_frame = sum(self.particles * math.prod(s) * np.dtype(t).itemsize for s, t in self.fields.values())
        return self.frames * (per_frame + sum(math.prod(s) * np.dtype(t).itemsize for s, t in self.scalars.values()))


def create(path: Path, layout: Layout) -> None:
    """Write an empty trajectory with room for all its frames; the file appears under ``path`` only when it is whole.

    Raises:
        OSError: when the disk has no room (ENOSPC).
    """
    h5py = h5py_module()
    building = path.with_suffix(".building")
    try:
        with disk_errors(building), h5py.File(building, "w", libver="v110") as out:
            for name, (shape, dtype) in layout.fields.items():
                _reserve(h5py, out, name, (layout.frames, layout.particles, *shape), dtype)
            for name, (shape, dtype) in layout.scalars.items():
                _reserve(h5py, out, name, (layout.frames, *shape), dtype)
            for name, values in layout.statics.items():
                out[name] = values
            out["frames_written"] = np.zeros(1, np.int64)
            for name, data in out.items():
                data.attrs["unit"] = UNITS.get(name, "")
            for name, names in layout.names.items():
                out[name].attrs["names"] = names
            out.attrs.update({"format": FORMAT, **layout.attributes})
        with open(building, "r+b") as handle:
            size = os.fstat(handle.fileno()).st_size
            os.posix_fallocate(handle.fileno(), 0, size)  # the holes of the file get their room now, not in frame 90
            os.fsync(handle.fileno())
    except BaseException:
        building.unlink(missing_ok=True)
        raise
    building.rename(path)


def _reserve(h5py: Any, out: Any, name: str, shape: tuple[int, ...], dtype: str) -> None:
    """A contiguous dataset with a fixed place in the file; its frames are not filled in."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    space = h5py.h5s.create_simple(shape)
    h5py.h5d.create(out.id, name.encode(), h5py.h5t.py_create(np.dtype(dtype)), space, properties)


class TrajectoryWriter:
    """Writes frames of a trajectory that `create` made, or goes on with one, from frame ``frames_written``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with h5py_module().File(path, "r") as source:
            self.frames_written = int(source["frames_written"][0])
            self._places = {
                name: (data.id.get_offset(), data.shape[1:], data.dtype)
                for name, data in source.items()
                if name not in (*STATICS, "frames_written")
            }
            self._count = source["frames_written"].id.get_offset()
            self.frames = len(source["time"])
        self._fd = os.open(path, os.O_WRONLY)

    def write(self, frame: int, values: Mapping[str, Array]) -> None:
        """Write frame ``frame`` and, when its bytes are on the disk, count it.

        Rows of particles that ``values`` lacks are NaN.
        """
        for name, value in values.items():
            offset, shape, dtype = self._places[name]
            row = np.full(shape, np.nan, dtype) if len(shape) and value.shape != shape else value
            if row is not value:
                row[: len(value)] = value
            data = np.ascontiguousarray(row, dtype)
            _write_all(self._fd, data, offset + frame * data.nbytes)
        os.fsync(self._fd)
        self.frames_written = frame + 1
        _write_all(self._fd, np.array([frame + 1], np.int64), self._count)

    def rewind(self, frames: int) -> None:
        """Forget the frames from number ``frames`` on."""
        self.frames_written = frames
        _write_all(self._fd, np.array([frames], np.int64), self._count)

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
    frame without the particles that are still to come. Works as a context manager.

    Raises:
        FileNotFoundError: when there is no trajectory.
        ImportError: when h5py is missing (extra ``data``).
    """

    def __init__(self, path: str | Path) -> None:
        self.path = find(path)
        self.file = h5py_module().File(self.path, "r")
        self.fields = [
            n for n, d in self.file.items() if d.ndim >= 2 and d.shape[:2] == self.file["position"].shape[:2]
        ]

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
        return len(self) == self.file["position"].shape[0]

    @property
    def attributes(self) -> dict[str, Any]:
        """Title, scene file, seed, versions, ... of the run."""
        return dict(self.file.attrs)

    def __len__(self) -> int:
        return int(self.file["frames_written"][0])

    def __getitem__(self, name: str) -> Array:
        """A field [frames, N, ...], a quantity per frame [frames, ...], or one per particle [N]."""
        data = self.file[name]
        array: Array = data[:] if name in (*STATICS, "frames_written") else data[: len(self)]
        return array

    def names(self, name: str) -> list[str]:
        """Names that the indices of ``material`` or ``scene`` stand for."""
        return [str(n) for n in self.file[name].attrs["names"]]

    def frame(self, k: int) -> dict[str, Array]:
        """Everything about frame ``k``: the fields and statics of its particles, and its scalars."""
        if not 0 <= k < len(self):
            raise IndexError(f"frame must be between 0 and {len(self) - 1}, got {k}")
        count = int(self.file["particles"][k])
        out = {name: self.file[name][k, :count] for name in self.fields}
        out |= {name: self.file[name][:count] for name in STATICS if name in self.file}
        rest = [n for n in self.file if n not in out and n != "frames_written"]
        return out | {name: self.file[name][k] for name in rest}

    def __iter__(self) -> Iterator[dict[str, Array]]:
        return (self.frame(k) for k in range(len(self)))


def find(path: str | Path) -> Path:
    """The trajectory file of a run folder, or the file itself."""
    path = Path(path)
    for candidate in (path / COMPLETE, path / PARTIAL) if path.is_dir() else (path,):
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f"there is no trajectory at {path}")
