"""Files of points: NumPy arrays, tables of numbers, and PLY, which is written too."""

from __future__ import annotations

import codecs
import csv
import io
import itertools
import math
import os
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from ..data import host_memory
from ..data.whole_files import write_whole
from ..files import check_file
from .surface_mesh import Array

FAMILIES = ("", "points?", "positions?", "coordinates?", "coords?", "pos")
"""Prefixes of the names of coordinates, in order of preference: x, Points:0, position_x, ..."""
VOLUME = re.compile(r"(particle[ _])?vol(ume)?")
COMMENTS = ("#", "%", "//")
PROSE = {"a", "and", "are", "as", "by", "for", "in", "is", "not", "of", "on", "or", "over", "the", "to", "with"}
"""Words of comments that are sentences, such as "x and y", and not names of columns."""
PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class PointFile(NamedTuple):
    """Positions float64 [P, D] [m], volumes float64 [P] [m³] or None, and other properties of a .ply by name [P]."""

    x: Array
    volume: Array | None
    fields: dict[str, Array]


def read(path: str | Path, dim: int | None = None) -> PointFile:
    """Points of a file, by the end of its name.

    - .npy: positions [P, D].
    - .npz: positions ``x`` [P, D] and perhaps volumes ``volume`` [P].
    - .csv, .tsv, .txt: rows of numbers separated by commas, semicolons, tabs or spaces; lines that begin with #, % or
      // are comments. Numbers between semicolons may have a decimal comma. Names of the columns may stand in a first
      line, a comment or not: x, y, (z,) (volume) in any case and order, among others; also Points:0, position_x and the
      like, with the unit m: x [m], x (m), x/m or x_m. Without names the columns are the positions, then perhaps the
      volume: three columns are x, y, z, but x, y, volume with ``dim`` 2.
    - .ply: the properties x, y, z and perhaps volume of its vertices, ASCII or binary.

    Args:
        path: the file.
        dim: number of coordinates; None for those in the file. Where it is 2, a constant z is dropped.

    Raises:
        OSError: for a file that cannot be read.
        ValueError: for an unknown format, or other contents.
    """
    path = Path(path)
    check_file(path, "points")
    readers: dict[str, Callable[[Path, int | None], PointFile]] = {
        **{".npy": _read_npy, ".npz": _read_npz, ".ply": _read_ply},
        **{end: _read_table for end in (".csv", ".tsv", ".txt")},
    }
    if path.suffix.lower() not in readers:
        raise ValueError(f"points file must end in {', '.join(readers)}, got {path}")
    try:
        found = readers[path.suffix.lower()](path, dim)
    except Exception as error:  # Damaged archives and tables raise many kinds of errors.
        raise ValueError(f"points file {path} cannot be read: {error}") from error
    if dim == 2 and found.x.ndim == 2 and found.x.shape[1] == 3 and (found.x[:, 2] == found.x[:1, 2]).all():
        found = found._replace(x=found.x[:, :2])
    return found


# ---- NumPy


def _read_npy(path: Path, dim: int | None) -> PointFile:
    with path.open("rb") as handle:
        return PointFile(_array(handle, path.stat().st_size), None, {})


def _read_npz(path: Path, dim: int | None) -> PointFile:
    arrays = arrays_of(path, "x", "volume")
    if "x" not in arrays:
        with zipfile.ZipFile(path) as archive:
            names = sorted(item.filename.removesuffix(".npy") for item in archive.infolist())
        raise ValueError(f"it must hold an array 'x' of positions, got {names}")
    return PointFile(arrays["x"], arrays.get("volume"), {})


def arrays_of(path: Path, *names: str) -> dict[str, Array]:
    """Arrays of an .npz file by name, float64; names that the file lacks are skipped.

    Raises:
        zipfile.BadZipFile, ValueError: for a damaged file, or an array that holds no numbers or does not fit in memory.
    """
    with zipfile.ZipFile(path) as archive:
        sizes = {item.filename.removesuffix(".npy"): item.file_size for item in archive.infolist()}
        arrays = {}
        for name in (name for name in names if name in sizes):
            with archive.open(name + ".npy") as handle:
                arrays[name] = _array(handle, sizes[name])
    return arrays


def _array(handle: IO[bytes], size: int) -> Array:
    """Array of a .npy file of ``size`` bytes; nothing is allocated for a header that declares more."""
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(handle)
    if version not in read_header:
        raise ValueError(f"format {version} is not known")
    shape, fortran, dtype = read_header[version](handle)
    count = math.prod(shape)
    if dtype.kind not in "fiu":
        raise ValueError(f"it must hold numbers, got an array of {dtype}")
    if count * dtype.itemsize > min(size, host_memory.available() / 4):
        raise ValueError(f"its array {list(shape)} is larger than its {size} bytes, or than the free memory")
    values = np.frombuffer(handle.read(count * dtype.itemsize), dtype, count).astype(np.float64)
    return values.reshape(shape, order="F" if fortran else "C").copy()


# ---- tables


def _read_table(path: Path, dim: int | None) -> PointFile:
    lines = _text(path.read_bytes()).splitlines()
    names, first = _header(lines)
    if first == len(lines):
        raise ValueError("it has no rows of numbers")
    separator = _separator(lines[first])
    axes, volume = _named(names) if names else _unnamed(len(_cells(lines[first], separator)), dim)
    options: dict[str, Any] = {"delimiter": separator, "comments": None, "quotechar": '"', "ndmin": 2}
    values = np.loadtxt(_rows(lines, first, separator), usecols=axes + volume, **options)
    return PointFile(values[:, : len(axes)], values[:, -1] if volume else None, {})


def _text(data: bytes) -> str:
    """Text of a table: UTF-8, UTF-16 with its byte order mark, or Latin-1."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _rows(lines: Sequence[str], first: int, separator: str | None) -> Iterator[str]:
    """Lines of numbers from the first one on, without comments.

    Raises:
        ValueError: for a line with another number of cells than the first one.
    """
    expected = len(_cells(lines[first], separator))
    for number, line in enumerate(lines[first:], first + 1):
        text = line.partition("#")[0].strip()
        if not text or text.startswith(COMMENTS):
            continue
        text = _with_points(text, separator)
        quick = separator is not None and '"' not in text and not text.endswith(separator)
        count = text.count(separator) + 1 if separator and quick else len(_cells(text, separator))
        if count != expected:
            raise ValueError(f"line {number} has {count} columns, and the first row of numbers has {expected}")
        yield text


def _header(lines: Sequence[str]) -> tuple[list[str], int]:
    """Names of columns, or none, and the index of the first row of numbers."""
    names: list[str] = []
    remarks: list[list[str]] = []
    for index, line in enumerate(lines):
        text = line.strip()
        comment = text.startswith(COMMENTS)
        cells, titles = _cells(text, _separator(text)), _titles(text.lstrip("#%/ ") if comment else text)
        if comment:
            remarks.append(titles)
        elif _coordinates(titles) and not names:
            names = titles
        elif cells:
            names = names or _names_in(remarks, len(cells))
            _check_first(names, cells)
            return names, index
    return names, len(lines)


def _titles(text: str) -> list[str]:
    """Cells of a line that may name columns, with their units, without a heading such as "Columns:"."""
    heading = re.match(r"([^\W\d][\w ]*?)\s*[:=]\s*", text)
    if heading and not any(re.fullmatch(family, heading[1].lower().split()[-1]) for family in FAMILIES):
        text = text[heading.end() :]
    separator = _separator(text)
    return _cells(text if separator else re.sub(r"\s+(?=[\[(][^\W\d][^\s\])]*[\])])", "", text), separator)


def _names_in(remarks: Sequence[Sequence[str]], count: int) -> list[str]:
    """The last comment that names as many columns and is no prose; empty without one."""
    named = (cells for cells in reversed(remarks) if len(cells) == count and _coordinates(cells))
    return list(next((cells for cells in named if PROSE.isdisjoint(map(str.lower, cells))), []))


def _check_first(names: Sequence[str], cells: Sequence[str]) -> None:
    """Check the first row of numbers against the names of the columns. Columns that are not read may be texts."""
    if names and len(names) != len(cells):
        raise ValueError(f"it names {len(names)} columns {list(names)}, and has {len(cells)} numbers in a row")
    used = [cells[k] for columns in _named(names) for k in columns] if names else cells
    if all(map(_is_number, used)):
        return
    if names:
        raise ValueError(f"its first row must have numbers below the names {list(names)}, got {list(cells)}")
    raise ValueError(
        f"its first line must be numbers or name the columns x, y, (z,) (volume), got {list(cells)}; "
        "names such as Points:0 and position_x will do too"
    )


def _separator(line: str) -> str | None:
    """Separator of the cells of a line; None for spaces."""
    return next((mark for mark in ";\t," if mark in line), None)


def _cells(line: str, separator: str | None) -> list[str]:
    text = line.partition("#")[0].strip()
    cells = next(csv.reader([text], delimiter=separator, skipinitialspace=True), []) if separator else text.split()
    cells = [_with_points(cell.strip().strip("\"'"), separator) for cell in cells]
    return cells[:-1] if separator and cells and not cells[-1] else cells  # Lines may end with a separator.


def _with_points(text: str, separator: str | None) -> str:
    """Text with decimal points in place of decimal commas, which numbers between semicolons may have."""
    return re.sub(r"(?<=\d),(?=\d)", ".", text) if separator == ";" and "," in text else text


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _words_and_unit(name: str) -> tuple[str, str]:
    """A name such as "Position_X [m]", "x/m" or "x_m" in lower case, and its unit."""
    found = re.fullmatch(r"(.*?)(?:\s*[\[(]([^\W\d][^\])]*)[\])]|\s*/\s*([^\W\d]\w*)|_([cdkmnu]?m[23]?))", name.lower())
    return (found[1], (found[2] or found[3] or found[4]).strip()) if found else (name.lower(), "")


def _coordinates(names: Sequence[str]) -> list[list[int]]:
    """Columns with the names of x, y and perhaps z; empty where there are no such names."""
    texts = [_words_and_unit(name)[0] for name in names]
    for family in FAMILIES:
        found = []
        for axis, letter in enumerate("xyz"):
            form = rf"{family}[ _.:]?({letter}|{axis}|\[{axis}\])" if family else letter
            found.append([k for k, text in enumerate(texts) if re.fullmatch(form, text)])
        if found[0] and found[1]:
            return [columns for columns in found if columns]
    return []


def _named(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """Columns of the coordinates, and of the volume where there is one."""
    found = _coordinates(names)
    axes = [columns[0] for columns in found]
    volume = [k for k, name in enumerate(names) if VOLUME.fullmatch(_words_and_unit(name)[0])]
    if any(len(columns) > 1 for columns in (*found, volume)):
        raise ValueError(f"a coordinate or the volume has two columns in {list(names)}")
    for columns, units in ((axes, ("", "m")), (volume, ("", "m^3", "m3", "m³", "m^2", "m2", "m²"))):
        for k in columns:
            if _words_and_unit(names[k])[1] not in units:
                raise ValueError(f"the column {names[k]!r} must be in {units[1]}")
    return axes, volume


def _unnamed(count: int, dim: int | None) -> tuple[list[int], list[int]]:
    """Columns of a table without names."""
    allowed = (2, 3, 4) if dim is None else (dim, dim + 1)
    if count not in allowed:
        raise ValueError(
            f"its rows have {count} numbers without names, not {' or '.join(map(str, allowed))}: name the columns in a "
            "first line, such as x,y,z,volume"
        )
    axes = min(count, 3 if dim is None else dim)
    return list(range(axes)), list(range(axes, count))


# ---- PLY


def _read_ply(path: Path, dim: int | None) -> PointFile:
    with path.open("rb") as handle:
        order, count, names, dtype = _ply_header(handle)
        size = path.stat().st_size - handle.tell()
        least = 2 * len(names) - 1 if order == "=" else dtype.itemsize  # Bytes of a row.
        if count * least > size:
            raise ValueError(f"its {count} vertices do not fit in its {size} bytes")
        if count == 0:
            raise ValueError("it has no vertices")
        if order == "=":
            lines = (line for line in io.TextIOWrapper(handle, encoding="latin-1") if line.strip())
            values = np.loadtxt(itertools.islice(lines, count), ndmin=2, comments=None)
            if values.shape[1] != len(names):
                raise ValueError(f"its rows have {values.shape[1]} numbers, not {len(names)} as its header says")
            fields = {name: _declared(name, values[:, k], dtype[name]) for k, name in enumerate(names)}
        else:
            rows = np.frombuffer(handle.read(count * dtype.itemsize), dtype, count)
            fields = {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in names}
    if len(fields["x"]) != count:
        raise ValueError(f"it has {len(fields['x'])} of its {count} vertices")
    with np.errstate(invalid="ignore"):  # For NaN of all kinds.
        x = np.stack([fields.pop(axis).astype(np.float64) for axis in "xyz"], 1)
    volume = fields.pop("volume", None)
    return PointFile(x, None if volume is None else volume.astype(np.float64), fields)


def ply_header(rows: np.dtype[Any], count: int) -> bytes:
    """Header of a binary little-endian PLY file of vertices.

    Args:
        rows: dtype of a row, with a name for each property and types among `PLY_TYPES`.
        count: number of vertices.
    """
    types = {code: name for name, code in reversed(PLY_TYPES.items())}  # "float" rather than "float32".
    lines = [f"property {types[rows[name].str[1:]]} {name}" for name in rows.names or ()]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *lines, "end_header"]
    return ("\n".join(head) + "\n").encode()


def write_ply(path: str | os.PathLike[str], columns: Mapping[str, Array]) -> None:
    """Write a binary little-endian PLY file of vertices, which appears when it is complete.

    Args:
        path: the file.
        columns: the properties in their order, [P] each, in types among `PLY_TYPES`.

    Raises:
        OSError: when it cannot be written; nothing remains of it.
    """
    types = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    rows = np.empty(len(next(iter(columns.values()))), types)
    for name, values in columns.items():
        rows[name] = values
    write_whole(Path(path), ply_header(types, len(rows)) + rows.tobytes())


def _count(text: str) -> int:
    """Number of vertices of a header."""
    if not (text.isascii() and text.isdigit()):
        raise ValueError(f"the number of its vertices must be a whole number, got {text!r:.100}")
    return int(text)


def _declared(name: str, values: Array, dtype: np.dtype[Any]) -> Array:
    """Numbers of an ASCII file in the type of their property, if it is an integer; others stay in float64."""
    if dtype.kind == "f":
        return values
    ends = np.iinfo(dtype)
    if not ((values >= ends.min) & (values <= ends.max) & (values == np.floor(values))).all():
        raise ValueError(f"its property {name} has a number that is no {dtype.name}")
    return values.astype(dtype)


def _ply_header(handle: IO[bytes]) -> tuple[str, int, list[str], np.dtype[Any]]:
    """Byte order ("=" for ASCII), number of vertices, the names of their properties, and a row of them."""
    if handle.readline(80).strip() != b"ply":
        raise ValueError("it does not begin with 'ply'")
    order, elements, count, properties = "", 0, 0, []
    while (words := handle.readline(2**12).decode("latin-1").split()) != ["end_header"]:
        match words:
            case ["format", name, _] if name in PLY_ORDERS:
                order = PLY_ORDERS[name]
            case ["element", name, number]:
                elements += 1
                if elements == 1 and name != "vertex":
                    raise ValueError(f"its first element must be vertex, got {name}")
                count = _count(number) if elements == 1 else count
            case ["property", kind, name] if kind in PLY_TYPES:
                properties += [(name, order + PLY_TYPES[kind])] if elements == 1 else []
            case ["property", "list", _, _, _] if elements > 1:
                pass
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has an unknown line: {' '.join(words)!r}")
    names = [name for name, _ in properties]
    if twice := [name for name, uses in Counter(names).items() if uses > 1]:
        raise ValueError(f"its vertices have the property {twice[0]} twice")
    if not order:
        raise ValueError("its header has no line with the format, such as 'format ascii 1.0'")
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"its vertices must have the properties x, y and z, got {names}")
    return order, count, names, np.dtype(properties)
