"""Files that appear when they are whole and on the disk, and their hashes."""

from __future__ import annotations

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

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


def building_path(path: Path) -> Path:
    """What a file is called that is not whole yet."""
    return path.with_name(f".{path.name}.{os.getpid()}.building")


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
