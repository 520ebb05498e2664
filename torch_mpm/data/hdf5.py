"""Protection of HDF5 files against a full disk, which HDF5 cannot handle, damaged bytes, and links to other files.

HDF5 crashes at exit after a failed write, so failures are hidden from it: it writes to memory, or to a file that stores
the error. A *seal* at the end of a file holds the SHA-256 of the constant bytes; it is checked before HDF5 reads any of
them, and HDF5 ignores data after its own end. A seal detects damage, not forgery, so the content of a file is checked
too.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from .. import optional
from ..errors import DamagedFileError
from ..files import check_file
from . import host_memory
from .whole_files import named_errors

Extents = Sequence[tuple[int, int]]
"""Parts of a file: (offset, length) [bytes]."""
MAGIC = b"torch_mpm seal 1"
FOOTER = struct.Struct("<I32s16s")
"""The end of a seal: length of its JSON text, SHA-256, magic."""
CHUNK = 1 << 20
MOST_EXPANSION = 1032
"""Bytes that one compressed byte can become (zlib's own limit)."""


HDF5_SPACE = 2**24
"""Address space for a call of HDF5, which may crash with less [bytes]."""


def h5py_module() -> Any:
    host_memory.require_address_space(HDF5_SPACE, "a file in HDF5")
    return sys.modules.get("h5py") or optional.load("h5py", "trajectories", "data")


class _File:
    """File interface of h5py without reading, writing and truncating: size and position."""

    def __init__(self) -> None:
        self.size = self._at = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self.size}[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        raise NotImplementedError

    def read(self, length: int) -> bytes:
        buffer = bytearray(length)
        self.readinto(buffer)
        return bytes(buffer)

    def flush(self) -> None:
        """Nothing is buffered."""


class QuietFile(_File):
    """File on the disk for h5py; the first write error is stored in ``error``, and later data is not written.

    Args:
        path: path of the file, which is truncated.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.error: OSError | None = None
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        count, self._at = len(view), self._at + len(view)
        self.size = max(self.size, self._at)
        try:
            while self.error is None and len(view):
                view = view[os.pwrite(self._descriptor, view, self._at - len(view)) :]
        except OSError as error:
            self.error = error
        return count

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        found = os.preadv(self._descriptor, [view], self._at)
        view[found:] = bytes(len(view) - found)
        self._at += len(view)
        return len(view)

    def truncate(self, size: int) -> None:
        self.size = size
        try:
            os.ftruncate(self._descriptor, size)
        except OSError as error:
            self.error = self.error or error

    def check(self) -> None:
        """Raise the OSError of data that could not be written."""
        if self.error is not None:
            raise self.error

    def sync(self) -> None:
        """Wait until all data is on the disk.

        Raises:
            OSError: for data that could not be written.
        """
        self.check()
        os.fsync(self._descriptor)

    def close(self) -> None:
        os.close(self._descriptor)


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[tuple[Any, QuietFile]]:
    """New h5py.File, and the file below it, whose `check` ends a long block early when the disk is full.

    Raises:
        OSError: with the path, for data that could not be written.
        ImportError: when h5py is missing (extra ``data``).
    """
    with named_errors(path), contextlib.closing(QuietFile(path)) as disk:
        try:
            with h5py_module().File(disk, "w") as file:
                yield file, disk
        except READ_ERRORS:
            disk.check()  # HDF5 cannot read back what was not written.
            raise
        disk.sync()


class SparseFile(_File):
    """File in memory that allocates only written pages: h5py creates an HDF5 file of any size in it."""

    PAGE = 4096

    def __init__(self) -> None:
        super().__init__()
        self._pages: dict[int, bytearray] = {}
        self._written: list[tuple[int, int]] = []

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        self._written.append((self._at, len(view)))
        for page, inside, part in self._parts(view):
            self._pages.setdefault(page, bytearray(self.PAGE))[inside : inside + len(part)] = part
        self.size = max(self.size, self._at)
        return len(view)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        for page, inside, part in self._parts(view):
            part[:] = self._pages.get(page, bytes(self.PAGE))[inside : inside + len(part)]
        return len(view)

    def truncate(self, size: int) -> None:
        self.size = size

    def extents(self) -> list[tuple[int, int]]:
        """Written data, in order and without overlap."""
        merged: list[tuple[int, int]] = []
        for offset, length in sorted(self._written):
            begin, size = merged[-1] if merged else (0, 0)
            if merged and offset <= begin + size:
                merged[-1] = (begin, max(size, offset + length - begin))
            else:
                merged.append((offset, length))
        return merged

    def _parts(self, view: memoryview) -> list[tuple[int, int, memoryview]]:
        """(page, offset in it, part of ``view``) from the present position on, which advances to the end of
        ``view``.
        """
        parts, done = [], 0
        while done < len(view):
            page, inside = divmod(self._at, self.PAGE)
            part = view[done : done + self.PAGE - inside]
            parts.append((page, inside, part))
            done += len(part)
            self._at += len(part)
        return parts


# ---- seals


def seal(handle: BinaryIO, extents: Extents) -> str:
    """Append the seal of these parts to a file that is open for reading and writing; returns its SHA-256."""
    text = json.dumps([list(part) for part in extents]).encode()
    digest = _digest(handle, extents, text)
    handle.seek(0, os.SEEK_END)
    handle.write(text + FOOTER.pack(len(text), digest, MAGIC))
    return digest.hex()


def check_seal(path: Path, remedy: str) -> str:
    """Compare the parts under the seal of a file with its SHA-256, which is returned.

    Raises:
        DamagedFileError: with ``remedy``, where they differ.
    """
    check_file(path, "HDF5", largest=None, may_be_empty=True)
    with open(path, "rb") as handle:
        size = handle.seek(0, os.SEEK_END)
        handle.seek(max(0, size - FOOTER.size))
        footer = handle.read(FOOTER.size)
        length, digest, magic = FOOTER.unpack(footer) if len(footer) == FOOTER.size else (0, b"", b"")
        end = size - FOOTER.size - length
        if magic != MAGIC or end < 0:
            raise DamagedFileError(path, "is truncated, or not a file of this version of torch_mpm", remedy)
        handle.seek(end)
        text = handle.read(length)
        try:
            extents = [(int(offset), int(count)) for offset, count in json.loads(text)]
        except (ValueError, TypeError, RecursionError):
            extents = [(-1, 0)]
        inside = all(0 <= offset <= offset + count <= end for offset, count in extents)
        if not inside or sum(count for _, count in extents) > end or _digest(handle, extents, text) != digest:
            raise DamagedFileError(path, "is damaged: its checksum is wrong", remedy)
        return digest.hex()


def outside(extents: Extents, size: int) -> list[tuple[int, int]]:
    """Parts of a file of ``size`` bytes outside of other parts, in order."""
    begins, ends = [], [0]
    for offset, length in sorted(extents):
        begins.append(offset)
        ends.append(max(ends[-1], offset + length))
    return [(end, begin - end) for end, begin in zip(ends, [*begins, size], strict=True) if begin > end]


def _digest(handle: BinaryIO, extents: Extents, text: bytes) -> bytes:
    digest = hashlib.sha256(text)
    for offset, length in extents:
        handle.seek(offset)
        while length > 0 and (data := handle.read(min(length, CHUNK))):
            digest.update(data)
            length -= len(data)
    return digest.digest()


# ---- reading

READ_ERRORS = (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError)
"""Errors of h5py where a file cannot be read."""
INTACT = "another program has made it, or its disk or the memory of this machine is at fault"


def unreadable(path: Path, problem: str, error: BaseException, remedy: str, intact: Callable[[], bool]) -> Exception:
    """Error to raise where HDF5 fails to read a file: DamagedFileError only where the file was changed.

    Args:
        problem: description of the unreadable data.
        error: error of h5py.
        remedy: advice for a damaged file.
        intact: whether the checksum of the file is correct.
    """
    if not intact():
        return DamagedFileError(path, f"{problem} ({error})", remedy)
    if host_memory.is_short(error):
        return MemoryError(f"{path}: {problem}, {host_memory.shortage(error)}")
    return DamagedFileError(path, f"{problem} ({error}), though its checksum is right", INTACT)


def open_sealed(path: Path, remedy: str, in_memory: bool = False) -> Any:
    """h5py.File of a sealed file without external data; ``in_memory`` leaves no file open.

    Raises:
        DamagedFileError: with ``remedy``.
        OSError: for a file that cannot be read.
        ImportError: when h5py is missing (extra ``data``).
    """
    h5py = h5py_module()
    check_seal(path, remedy)
    try:
        file = h5py.File(io.BytesIO(path.read_bytes()) if in_memory else path, "r")
    except READ_ERRORS as error:  # Below a valid seal.
        raise unreadable(path, "is not an HDF5 file", error, remedy, lambda: True) from None
    problem = _foreign(h5py, file, path.stat().st_size)
    if problem:
        file.close()
        raise DamagedFileError(path, problem, remedy)
    return file


def _foreign(h5py: Any, file: Any, size: int) -> str:
    """Item of a file that is not a plain array of numbers stored in it: links, external data, filters, groups."""
    try:
        for name in file:
            if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                return f"{name!r} is a link"
            data = file[name]
            if not isinstance(data, h5py.Dataset) or data.dtype.kind not in "fiu":
                return f"{name!r} is no array of numbers"
            properties = data.id.get_create_plist()
            if properties.get_layout() != h5py.h5d.CONTIGUOUS or properties.get_external_count():
                return f"{name!r} is not stored as a plain array in the file"
            offset = data.id.get_offset()
            if data.nbytes and (offset is None or offset + data.nbytes > size):
                return f"{name!r} is larger than the file"
        dict(file.attrs)
    except READ_ERRORS as error:
        if host_memory.is_short(error):
            raise
        return f"it cannot be read ({error})"
    return ""


def storage_problem(h5py: Any, data: Any, size: int) -> str:
    """Reason why the numbers of a dataset, plain or chunked, are not all in this file or could fill the memory; "" if
    none.
    """
    properties = data.id.get_create_plist()
    filters = {properties.get_filter(k)[0] for k in range(properties.get_nfilters())}
    if properties.get_external_count() or not filters <= {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}:
        return "which is stored in another way than torch_mpm does"
    if properties.get_layout() == h5py.h5d.CHUNKED:
        wanted = math.prod(-(-n // c) for n, c in zip(data.shape, data.chunks, strict=True))
        stored = data.id.get_storage_size()
        whole = data.id.get_num_chunks() == wanted and stored <= size
        return "" if whole and data.nbytes <= MOST_EXPANSION * stored else "which is not whole"
    if properties.get_layout() != h5py.h5d.CONTIGUOUS:
        return "which is stored in another way than torch_mpm does"
    offset = data.id.get_offset()
    return "which is larger than the file" if data.nbytes and (offset is None or offset + data.nbytes > size) else ""
