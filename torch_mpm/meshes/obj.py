"""Vertices and triangles of Wavefront .obj files."""

from __future__ import annotations

import codecs
import re
from array import array
from pathlib import Path

import numpy as np

from ..geometry.surface_mesh import Array
from .polygons import triangulated


def read(path: Path) -> tuple[Array, Array]:
    """Vertices float64 [V, 3] and triangles int64 [T, 3].

    Objects, groups and materials are one mesh. A negative index counts back from the latest vertex above its line.
    Polygons are divided into triangles; lines, textures and normals are skipped.

    Raises:
        ValueError: for a vertex or a face that is not of numbers, and an index without a vertex, with its line, where
            continued lines count as one.
    """
    text = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    text = re.sub(rb"#[^\r\n]*", b"", text) if b"#" in text else text
    text = re.sub(rb"\\(\r\n|\r|\n)", b" ", text) if b"\\" in text else text
    vertices, corners, sizes, number, line = array("d"), array("q"), array("q"), 0, b""
    try:
        for line in text.splitlines():
            number += 1
            words = line.split()
            if words and words[0] == b"v":
                x, y, z = words[1:4]
                vertices.extend((float(x), float(y), float(z)))
            elif words and words[0] == b"f":
                corners.extend([_index(word, len(vertices) // 3) for word in words[1:]])
                sizes.append(len(words) - 1)
    except ValueError as error:
        found = line.decode(errors="replace").strip()[:80]
        raise ValueError(f"its line {number} is not a vertex or a face: {found!r}, {error}") from None
    positions, used = np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(corners, dtype=np.int64)
    if used.size and used.max() >= len(positions):
        raise ValueError(f"a face has the vertex {used.max() + 1}, and there are {len(positions)}")
    return positions, triangulated(positions, used, np.array(sizes, dtype=np.int64))


def _index(word: bytes, count: int) -> int:
    """Index of a vertex, from zero, of a corner such as 7/1/2 or -1; `count` vertices stand above it."""
    index = int(word.partition(b"/")[0])
    if index == 0 or index < -count:
        raise ValueError(f"there is no vertex {index}")
    return index - 1 if index > 0 else count + index
