"""Files that appear when they are complete and on the disk, and their hashes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import socket
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ..errors import DamagedFileError

LONGEST_NAME = 100
"""Length of the longest name in paths [bytes]; file systems allow 255, with the suffix of an incomplete file."""
NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{LONGEST_NAME}}}")
"""Names that are allowed in paths, except `RESERVED`."""
RESERVED = re.compile(r"con|prn|aux|nul|(com|lpt)\d", re.IGNORECASE)
"""Names that Windows reserves for devices."""
LEFTOVER = re.compile(r"\.(?P<machine>\w+)-(?P<process>\d{1,18})\.building(\.\w+)?$")
"""Suffix of incomplete files."""
CHECKSUM = "checksum"
MOST = 2**53
"""Maximum of the integers in records."""
PART_BYTES = 2**25
"""Size of the parts of a hashed file."""
MOST_HASHERS = 4
"""Number of threads that hash a file."""


def write_whole(path: Path, data: bytes) -> None:
    """Write a file that appears when all of it is on the disk, durably.

    Raises:
        OSError: when it cannot be written; nothing remains of it.
    """
    building = building_path(path)
    try:
        with named_errors(path, building):
            with open(building, "wb") as handle:
                handle.write(data)
                handle.flush()
                os.fsync(handle.fileno())
            appear(building, path)
    except BaseException:
        building.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Temporary path beside ``path`` that is renamed to it when the block succeeds and removed when it fails."""
    target = Path(path)
    temporary = building_path(target, target.suffix)
    try:
        with named_errors(target, temporary):
            yield temporary
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
            os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def named_errors(path: Path, building: Path | None = None) -> Iterator[None]:
    """Name a file in the errors of the operating system in the block.

    Args:
        path: the file where an error names none, as for a failed write.
        building: the incomplete file or folder that becomes ``path``, which errors name in its place.
    """
    try:
        yield
    except OSError as error:
        if error.strerror:
            named = Path(os.fsdecode(error.filename)) if isinstance(error.filename, (str, bytes)) else path
            if building is not None and named.is_relative_to(building):
                named = path / named.relative_to(building)
            error.filename = str(named)
        raise


def checksum(values: Mapping[str, Any]) -> str:
    """SHA-256 of values as JSON, for any order of keys."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def write_record(path: Path, values: Mapping[str, Any]) -> None:
    """Write values as JSON with their checksum, in a file that appears when it is complete; OSError as
    `write_whole`.
    """
    plain = json.loads(json.dumps(values, allow_nan=False))  # Tuples as lists, the form in which they are read.
    write_whole(path, json.dumps({**plain, CHECKSUM: checksum(plain)}, indent=1).encode())


def check_record(values: dict[str, Any], path: Path, remedy: str) -> None:
    """Compare the values of a record with their checksum, which is removed from them.

    Raises:
        DamagedFileError: with ``remedy``, where they differ.
    """
    if values.pop(CHECKSUM, None) != checksum(values):
        raise DamagedFileError(path, "is damaged or was changed: its checksum is wrong", remedy)


def count(value: Any, least: int = 0) -> int:
    """Integer of a record, at most `MOST`; anything else is a ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= MOST or value % 1:
        raise ValueError(f"a number must be whole and within {least} and {MOST}, got {value!r:.100}")
    return int(value)


def check_inside(folder: Path, path: Path, remedy: str) -> None:
    """Refuse a path that leads out of a folder by links.

    Raises:
        DamagedFileError: with ``remedy``.
    """
    if not path.resolve().is_relative_to(folder.resolve()):
        raise DamagedFileError(path, f"is a link to a place outside of {folder}", remedy)


def is_name(text: str) -> bool:
    """Whether a text from a file may be a part of a path."""
    return bool(NAME.fullmatch(text) and not RESERVED.fullmatch(text))


def file_name(text: str) -> str:
    """Name of a file from any text, "" for one without letters: long texts are cut and end with their hash."""
    name = re.sub(r"\W+", "_", text).strip("_").lower()
    if len(name.encode()) > LONGEST_NAME:
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        name = f"{name.encode()[: LONGEST_NAME - 17].decode(errors='ignore')}_{digest}"
    return f"{name}_" if RESERVED.fullmatch(name) else name


def output_path(folder: Path, name: str, out: str | Path | None = None) -> Path:
    """``out``, or by default ``name`` in a folder, which may be a received one.

    Raises:
        DamagedFileError: where the default is a link to a place outside of the folder.
    """
    if out is not None:
        return Path(out)
    check_inside(folder, folder / name, "remove the link, or choose another output")
    return folder / name


@contextlib.contextmanager
def output_folder(path: Path) -> Iterator[None]:
    """Create a folder for the files of the block, without the remains of ended processes; a block that fails before its
    first file leaves no new folder.
    """
    new = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path)
    try:
        yield
    except BaseException:
        if new:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def building_path(path: Path, suffix: str = "") -> Path:
    """Name of an incomplete file or folder of this process.

    Args:
        path: name of the complete file.
        suffix: end of the name, for programs that derive the format from it.
    """
    return path.with_name(f".{path.name}.{_machine()}-{os.getpid()}.building{suffix}")


def remove_leftovers(folder: Path) -> None:
    """Remove incomplete files and folders in a folder that ended processes of this machine have left."""
    for path in folder.glob(".*.building*"):
        found = LEFTOVER.search(path.name)
        if found is None or found["machine"] != _machine() or _runs(int(found["process"])):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _machine() -> str:
    """Name of the process number space: a container has its own, and may share the name of its host."""
    try:
        space = os.stat("/proc/self/ns/pid").st_ino
    except OSError:
        space = 0
    return re.sub(r"\W", "_", f"{socket.gethostname()}_{space}")


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # Process of another user; or no process has such a number.
        return True
    return True


def appear(building: Path, path: Path) -> None:
    """Rename a file on the disk to its name, durably."""
    building.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def file_hash(path: Path) -> str:
    """SHA-256 of the SHA-256 of all parts of ``PART_BYTES`` of a file, which are hashed in parallel."""

    def part(first: int) -> bytes:
        digest = hashlib.sha256()
        with open(path, "rb", buffering=0) as handle:
            handle.seek(first)
            left = PART_BYTES
            while left and (data := handle.read(min(left, 1 << 20))):
                digest.update(data)
                left -= len(data)
        return digest.digest()

    with ThreadPoolExecutor(min(len(os.sched_getaffinity(0)), MOST_HASHERS)) as executor:
        return hashlib.sha256(b"".join(executor.map(part, range(0, path.stat().st_size, PART_BYTES)))).hexdigest()
