"""Vertices and triangles of .ply files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..geometry.point_files import PLY_ORDERS, PLY_TYPES
from ..geometry.surface_mesh import Array
from .polygons import triangulated

INDICES = ("vertex_indices", "vertex_index")
"""Names of the list of the corners of a face."""


class Property(NamedTuple):
    """A property of an element: its type, and for a list the type of its length, with their byte order."""

    name: str
    kind: np.dtype[Any]
    length: np.dtype[Any] | None


class Element(NamedTuple):
    name: str
    rows: int
    properties: list[Property]


class Column(NamedTuple):
    """Values of a property of R rows, one row after another, and their numbers, int64 [R]; all 1 for no list."""

    values: Array
    sizes: Array


def read(path: Path) -> tuple[Array, Array]:
    """Vertices float64 [V, 3] and triangles int64 [T, 3]; polygons are divided into triangles.

    ASCII or binary of either byte order, with any further properties and elements.

    Raises:
        ValueError: for other contents, fewer numbers than the header declares, and an index without a vertex.
    """
    data = path.read_bytes()
    is_ascii, elements, begin = _header(data)
    rest: Any = data[begin:].split() if is_ascii else memoryview(data)[begin:]
    found: dict[str, dict[str, Column]] = {}
    for element in elements:
        columns, used = (_ascii_rows if is_ascii else _binary_rows)(element, rest)
        found[element.name], rest = dict(zip([p.name for p in element.properties], columns, strict=True)), rest[used:]
    vertices, faces = found.get("vertex", {}), found.get("face", {})
    if not {"x", "y", "z"} <= vertices.keys():
        raise ValueError("it has no vertices with the properties x, y and z")
    x = np.stack([vertices[axis].values.astype(np.float64) for axis in "xyz"], 1)
    name = next((name for name in INDICES if name in faces), None)
    if name is None:
        return x, np.empty((0, 3), dtype=np.int64)
    corners = faces[name].values.astype(np.int64)
    wrong = (corners < 0) | (corners >= len(x))
    if wrong.any():
        raise ValueError(f"a face has the vertex {corners[wrong][0]}, counted from 0, and there are {len(x)}")
    return x, triangulated(x, corners, faces[name].sizes)


def _header(data: bytes) -> tuple[bool, list[Element], int]:
    """Whether the data are ASCII, the elements, and where the data begin."""
    order, elements, at = "", list[Element](), 0
    while True:
        end = data.find(b"\n", at, at + 2**12)
        if end < 0:
            raise ValueError("its header has no line end_header")
        words, first, at = data[at:end].decode("latin-1").split(), at == 0, end + 1
        match words:
            case ["ply"] if first:
                pass
            case ["end_header"] if order:
                return order == "=", elements, at
            case ["format", name, _] if name in PLY_ORDERS:
                order = PLY_ORDERS[name]
            case ["element", name, number] if number.isascii() and number.isdigit():
                elements.append(Element(name, int(number), []))
            case ["property", "list", length, kind, name] if order and elements and {length, kind} <= PLY_TYPES.keys():
                types = (np.dtype(order + PLY_TYPES[one]) for one in (kind, length))
                elements[-1].properties.append(Property(name, *types))
            case ["property", kind, name] if order and elements and kind in PLY_TYPES:
                elements[-1].properties.append(Property(name, np.dtype(order + PLY_TYPES[kind]), None))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise ValueError(f"its header has an unknown line: {' '.join(words)!r:.200}")


def _check_size(element: Element, least: int, available: int) -> None:
    """Raise ValueError for an element of more rows than fit; `least` is the smallest size of a row."""
    if element.rows * max(least, 1) > available:
        raise ValueError(f"its {element.rows} rows of the element {element.name} do not fit in the file")


def _ascii_rows(element: Element, words: list[bytes]) -> tuple[list[Column], int]:
    """Columns of an element at the beginning of words, and the number of words."""
    _check_size(element, len(element.properties), len(words))
    taken: list[list[bytes]] = [[] for _ in element.properties]
    sizes: list[list[int]] = [[] for _ in element.properties]
    at = 0
    for _ in range(element.rows):
        for k, part in enumerate(element.properties):
            size = 1 if part.length is None else int(words[at])
            at += part.length is not None
            if not 0 <= size <= len(words) - at:
                raise ValueError(f"a list of the element {element.name} does not fit in the file")
            taken[k] += words[at : at + size]
            sizes[k].append(size)
            at += size
    values = [np.array(words, dtype=bytes).astype(np.float64) if words else np.empty(0) for words in taken]
    return [Column(v, np.array(n, dtype=np.int64)) for v, n in zip(values, sizes, strict=True)], at


def _binary_rows(element: Element, data: memoryview) -> tuple[list[Column], int]:
    """Columns of an element at the beginning of binary data, and their size [bytes]."""
    _check_size(element, sum((p.length or p.kind).itemsize for p in element.properties), len(data))
    if element.rows == 0 or not element.properties:
        return [Column(np.empty(0, p.kind), np.empty(0, dtype=np.int64)) for p in element.properties], 0
    sizes, _ = _row(element, data, 0)
    row = np.dtype([(f"{k}", _field(p, n)) for k, (p, n) in enumerate(zip(element.properties, sizes, strict=True))])
    if element.rows * row.itemsize <= len(data):
        rows = np.frombuffer(data, row, element.rows)
        lists = [k for k, p in enumerate(element.properties) if p.length is not None]
        if all((rows[f"{k}"]["length"] == sizes[k]).all() for k in lists):
            values = [rows[f"{k}"]["values"] if k in lists else rows[f"{k}"] for k in range(len(sizes))]
            counts = (np.full(element.rows, n, dtype=np.int64) for n in sizes)
            return [Column(v.reshape(-1), n) for v, n in zip(values, counts, strict=True)], rows.nbytes
    return _uneven_rows(element, data)


def _field(part: Property, size: int) -> Any:
    """Type of a property in a row whose list has a size."""
    return part.kind if part.length is None else [("length", part.length), ("values", part.kind, (size,))]


def _uneven_rows(element: Element, data: memoryview) -> tuple[list[Column], int]:
    """As `_binary_rows`, for rows whose lists differ in length."""
    taken: list[list[memoryview]] = [[] for _ in element.properties]
    sizes, at = [], 0
    for _ in range(element.rows):
        row, ends = _row(element, data, at)
        sizes.append(row)
        for k, (part, size, end) in enumerate(zip(element.properties, row, ends, strict=True)):
            taken[k].append(data[end - size * part.kind.itemsize : end])
        at = ends[-1]
    values = (np.frombuffer(b"".join(parts), p.kind) for parts, p in zip(taken, element.properties, strict=True))
    return [Column(v, n) for v, n in zip(values, np.array(sizes, dtype=np.int64).T, strict=True)], at


def _row(element: Element, data: memoryview, at: int) -> tuple[list[int], list[int]]:
    """Number of values of each property of the row at a place, and where they end."""
    sizes, ends = [], []
    for part in element.properties:
        size = 1
        if part.length is not None:
            begin, at = at, at + part.length.itemsize
            size = int(np.frombuffer(data[begin:at], part.length, 1)[0])
        at += size * part.kind.itemsize
        if size < 0 or at > len(data):
            raise ValueError(f"a list of the element {element.name} does not fit in the file")
        sizes.append(size)
        ends.append(at)
    return sizes, ends
