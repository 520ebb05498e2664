"""Files that appear when they are whole and on the disk, and their hashes."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import socket
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ..errors import DamagedFileError

NAME = re.compile(r"[A-Za-z0-9_-]+")
"""Names that may become a part of a path."""
LEFTOVER = re.compile(r"\.(?P<machine>\w+)-(?P<process>\d{1,18})\.building(\.\w+)?$")
"""End of the name of what is not whole yet."""
CHECKSUM = "checksum"
MOST = 2**53
"""Of the whole numbers in records: larger ones are no numbers of anything."""
PART_BYTES = 2**25
"""Of a file that is hashed in parts."""
MOST_HASHERS = 4
"""Threads that hash a file."""


def write_whole(path: Path, data: bytes) -> None:
    """Write a file that appears when all of it is on the disk, and stays there.

    Raises:
        OSError: when it cannot be written; nothing is left of it.
    """
    building = building_path(path)
    try:
        with open(building, "wb") as handle:
            handle.write(data)
            handle.flush()
            os.fsync(handle.fileno())
        appear(building, path)
    except BaseException:
        building.unlink(missing_ok=True)
        raise


def checksum(values: Mapping[str, Any]) -> str:
    """SHA-256 of values as JSON, whatever their order."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def write_record(path: Path, values: Mapping[str, Any]) -> None:
    """Write values as JSON with their checksum, in a file that appears when it is whole; OSError as `write_whole`."""
    plain = json.loads(json.dumps(values, allow_nan=False))  # tuples as lists, as they come back
    write_whole(path, json.dumps({**plain, CHECKSUM: checksum(plain)}, indent=1).encode())


def check_record(values: dict[str, Any], path: Path, remedy: str) -> None:
    """Compare the values of a record with their checksum, which is taken out of them.

    Raises:
        DamagedFileError: with ``remedy``, where they differ.
    """
    if values.pop(CHECKSUM, None) != checksum(values):
        raise DamagedFileError(path, "is damaged or was changed: its checksum is wrong", remedy)


def count(value: Any, least: int = 0) -> int:
    """A whole number of a record, at most `MOST`; anything else is a ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= MOST or value % 1:
        raise ValueError(f"a number must be whole and within {least} and {MOST}, got {value!r:.100}")
    return int(value)


def check_inside(folder: Path, path: Path, remedy: str) -> None:
    """Refuse a path in a folder that links lead out of it.

    Raises:
        DamagedFileError: with ``remedy``.
    """
    if not path.resolve().is_relative_to(folder.resolve()):
        raise DamagedFileError(path, f"is a link to a place outside of {folder}", remedy)


def building_path(path: Path, suffix: str = "") -> Path:
    """Name of a file or folder of this process that is not whole yet.

    Args:
        path: name of the whole file.
        suffix: end of the name, for programs that read the format from it.
    """
    return path.with_name(f".{path.name}.{_machine()}-{os.getpid()}.building{suffix}")


def remove_leftovers(folder: Path) -> None:
    """Remove the files and folders that processes of this machine, which are gone, have left unfinished in a folder."""
    for path in folder.glob(".*.building*"):
        found = LEFTOVER.search(path.name)
        if found is None or found["machine"] != _machine() or _runs(int(found["process"])):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _machine() -> str:
    """Name of what numbers processes: a container numbers its own, and may share the name of its host."""
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
    except (PermissionError, OverflowError):  # of another user; no process has such a number
        return True
    return True


def appear(building: Path, path: Path) -> None:
    """Give a file that is on the disk its name, for good."""
    building.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def file_hash(path: Path) -> str:
    """SHA-256 of the SHA-256 of all parts of ``PART_BYTES`` of a file, which are hashed side by side."""

    def part(first: int) -> bytes:
        digest = hashlib.sha256()
        with open(path, "rb", buffering=0) as handle:
            handle.seek(first)
            left = PART_BYTES
            while left and (data := handle.read(min(left, 1 << 20))):
                digest.update(data)
                left -= len(data)
        return digest.digest()

    with ThreadPoolExecutor(min(len(os.sched_getaffinity(0)), MOST_HASHERS)) as pool:
        return hashlib.sha256(b"".join(pool.map(part, range(0, path.stat().st_size, PART_BYTES)))).hexdigest()
