"""Vertices and triangles of .off files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..geometry.surface_mesh import Array
from .polygons import triangulated

HEADER = re.compile(rb"\s*(ST)?(C)?(N)?OFF\b")
"""First word: vertices may have texture coordinates (ST), a colour (C) and a normal (N) behind their positions."""


def read(path: Path) -> tuple[Array, Array]:
    """Vertices float64 [V, 3] and triangles int64 [T, 3]; polygons are divided into triangles, colours are skipped.

    Raises:
        ValueError: for other contents, fewer numbers than the first line declares, and an index without a vertex.
    """
    text = re.sub(rb"#[^\r\n]*", b"", path.read_bytes())
    header = HEADER.match(text)
    if header is None:
        raise ValueError("it does not begin with OFF")
    lines = [words for line in text[header.end() :].splitlines() if (words := line.split())]
    V, F = (int(word) for word in lines[0][:2]) if lines else (0, 0)
    if V < 0 or F < 0 or V + F >= len(lines):
        raise ValueError(f"its {V} vertices and {F} faces do not fit in its {len(lines)} lines")
    x = np.array([line[:3] for line in lines[1 : V + 1]], dtype=bytes).astype(np.float64).reshape(-1, 3)
    faces = [line[1 : 1 + int(line[0])] for line in lines[V + 1 : V + 1 + F]]
    sizes = np.array([int(line[0]) for line in lines[V + 1 : V + 1 + F]], dtype=np.int64)
    corners = np.array([int(word) for face in faces for word in face], dtype=np.int64)
    if len(corners) != sizes.sum():
        raise ValueError("a face has fewer vertices than it declares")
    if corners.size and not 0 <= corners.min() <= corners.max() < V:
        raise ValueError(f"a face has a vertex outside of 0 to {V - 1}")
    return x, triangulated(x, corners, sizes)
