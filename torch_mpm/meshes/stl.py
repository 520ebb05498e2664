"""Vertices and triangles of .stl files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..geometry.surface_mesh import Array

HEADER, TRIANGLE = 84, 50
"""Sizes in a binary file [bytes]: of the part before the triangles, which ends with their number, and of a triangle."""
BEGINNING = 1000
"""Bytes in which a binary file has a zero: the number of triangles has one below 2^24 of them."""


def read(path: Path) -> tuple[Array, Array]:
    """Vertices float64 [3 T, 3] and triangles int64 [T, 3] of a binary or ASCII file, with any number of solids.

    Bytes behind the triangles of a binary file, normals and attributes are skipped.

    Raises:
        ValueError: for other contents, and fewer triangles than a binary file declares.
    """
    data = path.read_bytes()
    is_ascii = data[:BEGINNING].lstrip()[:5].lower() == b"solid" and b"\0" not in data[:BEGINNING]
    vertices = _ascii(data) if is_ascii else _binary(data)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _ascii(data: bytes) -> Array:
    rows = [words[1:4] for line in data.splitlines() if (words := line.split()) and words[0].lower() == b"vertex"]
    if len(rows) % 3:
        raise ValueError(f"it has {len(rows)} vertices, which is no multiple of 3")
    return np.array(rows, dtype=bytes).astype(np.float64).reshape(-1, 3)


def _binary(data: bytes) -> Array:
    if len(data) < HEADER:
        raise ValueError("it is neither a binary .stl file nor an ASCII one, which begins with solid")
    (count,) = struct.unpack_from("<I", data, HEADER - 4)
    present = (len(data) - HEADER) // TRIANGLE
    if count > present or (count == 0 and present > 0):
        raise ValueError(f"its header declares {count} triangles, and it has {present}")
    row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners: Array = np.frombuffer(data, row, count, HEADER)["corners"].reshape(-1, 3).astype(np.float64)
    return corners
