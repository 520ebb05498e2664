"""Scenes with meshes and point files that are damaged, endless, huge, or not regular files."""

from __future__ import annotations

import json
import os
import random
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
FACES = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
NASTY = ("nan", "inf", "-inf", "1e300", "-1e300", "1e30", "x", "", "9" * 400, "1e-300")
INDICES = ("0", "-1", "5", "99999999999", "-99", "1.5", "nan", "x", "1/1/1/1", "//", "")
SCENE = """
device = "cpu"
duration = 0.01
fps = 100
grid = {{lower = [-0.2, -0.2, -0.2], upper = [1.2, 1.2, 1.2], dx = 0.2}}
material.jelly = {{law = "neo_hookean", E = 1e4}}
[[body]]
shape = "{shape}"
file = {file}
material = "jelly"
{more}
"""


def prepare(folder: Path) -> None:
    """Valid files, from which the hostile ones are made."""
    (folder / "mesh.obj").write_text(_obj(CORNERS, FACES))
    (folder / "mesh.ply").write_text(_ply(CORNERS, FACES))
    (folder / "mesh.stl").write_bytes(_stl(CORNERS, FACES))
    (folder / "mesh.glb").write_bytes(_glb({}, _binary(CORNERS, FACES)))
    np.save(folder / "points.npy", np.array(CORNERS, float) * 0.5)
    np.savez(folder / "points.npz", x=np.array(CORNERS, float) * 0.5, volume=np.full(4, 0.01))
    (folder / "points.csv").write_text("x,y,z,volume\n0.1,0.1,0.1,0.01\n0.3,0.3,0.3,0.01\n")
    (folder / "points.ply").write_text(_ply(CORNERS, []))


def hostile(folder: Path, out: Path, rng: random.Random) -> tuple[list[str], str]:
    """A command line with a scene of ``folder`` that names a hostile file, and the change of the file."""
    name = rng.choice([p.name for p in sorted(folder.iterdir()) if p.name.startswith(("mesh.", "points."))])
    kind = name.partition(".")[0]
    damages = {**DAMAGES, **(MESHES if kind == "mesh" else POINTS)}
    what = rng.choice(sorted(damages))
    damages[what](folder / name, rng)
    more = "volume = 0.1" if kind == "points" and not rng.randrange(2) else ""
    words = SCENE.format(shape=kind, file=json.dumps(name), more=more)
    if not rng.randrange(6):
        what += ", and the scene cut off or mixed up"
        at = rng.randrange(len(words))
        words = words[:at] + rng.choice(("", "[" * 3000, "= =", "\x00", "\n[[body]]\n", "{" * 3000, "'''", "\udcff"))
        words += rng.choice(("", SCENE[at:]))
    (folder / "hostile.toml").write_bytes(words.encode(errors="surrogateescape"))
    command = rng.choice((["check"], ["check"], ["info"], ["run", "-o", str(out), "--quiet"]))
    return [command[0], str(folder / "hostile.toml"), *command[1:]], f"{name}: {what}"


# ---- any file


def _cut(path: Path, rng: random.Random) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(len(data))])


def _flips(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(rng.randint(1, 8)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def _other(path: Path, rng: random.Random) -> None:
    others = sorted(p for p in path.parent.iterdir() if p.is_file() and p != path)
    path.write_bytes(rng.choice(others).read_bytes())


def _linked(path: Path, rng: random.Random) -> None:
    path.unlink()
    path.symlink_to(rng.choice(("/dev/zero", "/dev/random", "/proc/kmsg", str(path), "/nowhere", "/proc/self/mem")))


def _pipe(path: Path, rng: random.Random) -> None:
    path.unlink()
    os.mkfifo(path)


def _folder(path: Path, rng: random.Random) -> None:
    path.unlink()
    path.mkdir()


def _sparse(path: Path, rng: random.Random) -> None:
    """A sparse file of a given size."""
    os.truncate(path, rng.choice((2**30, 2**33, 2**40)))


def _unreadable(path: Path, rng: random.Random) -> None:
    path.chmod(0)


DAMAGES: dict[str, Callable[[Path, random.Random], None]] = {
    "cut off": _cut,
    "flipped bits": _flips,
    "empty": lambda path, rng: path.write_bytes(b"") and None,
    "garbage": lambda path, rng: path.write_bytes(rng.randbytes(3000)) and None,
    "another file": _other,
    "a link": _linked,
    "a pipe": _pipe,
    "a folder": _folder,
    "sparse": _sparse,
    "unreadable": _unreadable,
}


# ---- meshes


def _written(path: Path, corners: list[tuple], faces: list[tuple]) -> None:
    writers = {".obj": _obj, ".ply": _ply, ".stl": _stl, ".glb": lambda c, f: _glb({}, _binary(c, f))}
    made = writers[path.suffix](corners, faces)
    path.write_bytes(made if isinstance(made, bytes) else made.encode())


def _corner(path: Path, rng: random.Random) -> None:
    corners = [list(c) for c in CORNERS]
    corners[rng.randrange(4)][rng.randrange(3)] = rng.choice(NASTY if path.suffix in (".obj", ".ply") else _numbers())
    _written(path, [tuple(c) for c in corners], FACES)


def _numbers() -> tuple[float, ...]:
    return (float("nan"), float("inf"), 1e300, 1e30, -1e30, 1e-300)


def _index(path: Path, rng: random.Random) -> None:
    faces = [list(f) for f in FACES]
    text = path.suffix in (".obj", ".ply")
    faces[rng.randrange(4)][rng.randrange(3)] = rng.choice(INDICES) if text else rng.choice((4, 99, 2**32 - 1))
    _written(path, CORNERS, [tuple(f) for f in faces])


def _no_faces(path: Path, rng: random.Random) -> None:
    _written(path, CORNERS, rng.choice(([], FACES[:1], FACES * 2, [(0, 0, 0)] * 4, [(0, 1, 1), (1, 1, 1)])))


def _flat(path: Path, rng: random.Random) -> None:
    scale = rng.choice(((1, 1, 0), (0, 0, 0), (1e-20, 1e-20, 1e-20), (1e20, 1, 1), (1, 1, 1e-9)))
    _written(path, [tuple(a * b for a, b in zip(c, scale, strict=True)) for c in CORNERS], FACES)


def _header(path: Path, rng: random.Random) -> None:
    """Counts that are not those of the file; cyclic and missing parts of a GLB."""
    count = rng.choice((-1, 10**4, 10**9, 10**12, 2**32 - 1, 2**31))
    if path.suffix == ".stl":
        path.write_bytes(bytes(80) + struct.pack("<I", count % 2**32) + path.read_bytes()[84:])
    elif path.suffix == ".ply":
        text = _ply(CORNERS, FACES).replace(f"vertex {4}", f"vertex {count}", rng.randrange(2))
        path.write_text(text.replace(f"face {4}", f"face {count}", rng.randrange(2)))
    elif path.suffix == ".glb":
        changes = (
            {"nodes": [{"children": [1]}, {"children": [0], "mesh": 0}]},
            {"nodes": [{"children": [0], "mesh": 0}]},
            {"nodes": [{"mesh": 99}]},
            {"bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": count}] * 2},
            {"bufferViews": [{"buffer": 7, "byteOffset": 0, "byteLength": 48}] * 2},
            {"buffers": [{"byteLength": count, "uri": "/etc/passwd"}]},
            {"meshes": [{"primitives": [{"attributes": {"POSITION": 9}, "indices": 1}]}]},
            {"meshes": []},
            {"scenes": [{"nodes": [0] * 1000}]},
            {"accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}] * 2},
            {"extensionsRequired": ["KHR_draco_mesh_compression"]},
        )
        path.write_bytes(_glb(rng.choice(changes), _binary(CORNERS, FACES)))
    else:
        path.write_text(
            path.read_text() + rng.choice(("f 1 2\n", "f\n", "v 1 2\n", "mtllib /dev/zero\n", "usemtl x\n" * 9))
        )


MESHES: dict[str, Callable[[Path, random.Random], None]] = {
    "a corner": _corner, "an index": _index, "faces": _no_faces, "flat": _flat, "header": _header,
}  # fmt: skip


def _obj(corners: list[tuple], faces: list[tuple]) -> str:
    lines = [f"v {' '.join(map(str, c))}" for c in corners]
    return (
        "\n".join([*lines, *(f"f {' '.join(str(k + 1) if isinstance(k, int) else k for k in f)}" for f in faces)])
        + "\n"
    )


def _ply(corners: list[tuple], faces: list[tuple]) -> str:
    head = ["ply", "format ascii 1.0", f"element vertex {len(corners)}", *(f"property float {a}" for a in "xyz")]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices"] if faces else []
    rows = [" ".join(map(str, c)) for c in corners] + [f"3 {' '.join(map(str, f))}" for f in faces]
    return "\n".join([*head, "end_header", *rows]) + "\n"


def _stl(corners: list[tuple], faces: list[tuple]) -> bytes:
    rows = [corners[k % len(corners)] for f in faces for k in f]
    numbers = np.array([[float(np.float32(float(v))) for v in row] for row in rows]).reshape(-1, 9)
    data = bytes(80) + struct.pack("<I", len(faces))
    return data + b"".join(bytes(12) + row.astype("<f4").tobytes() + bytes(2) for row in numbers)


def _binary(corners: list[tuple], faces: list[tuple]) -> bytes:
    with np.errstate(over="ignore"):
        positions = np.array([[float(v) for v in c] for c in corners]).astype("<f4")
    return positions.tobytes() + np.array(faces, np.uint32).reshape(-1, 3).tobytes()


def _glb(changes: dict, binary: bytes) -> bytes:
    count = 3 * (len(binary) - 48) // 12
    views = [(0, 48), (48, len(binary) - 48)]
    words = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": count, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": a, "byteLength": n} for a, n in views],
        "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    text = json.dumps({**words, **changes}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


# ---- points


def _rows(path: Path, rng: random.Random) -> None:
    value = rng.choice(_numbers())
    rows = rng.choice(
        (
            [[0.1, 0.1, value]], [[0.1, 0.1, 0.1]] * 2, [], [[0.1]], [[0.1, 0.1]], [[0.1] * 9], [[5.0, 5.0, 5.0]],
            [[0.1, 0.1, 0.1, value]], [[0.1, 0.1, 0.1, -1.0]], [[0.1, 0.1, 0.1, 0.0]],
        )
    )  # fmt: skip
    array = np.array(rows)
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, **{rng.choice(("x", "y", "volume", "arr_0")): array})
    elif path.suffix == ".csv":
        head = rng.choice(("x,y,z\n", "x,y,z,volume\n", "X,Y,Z\n", "a,b\n", "x,x,x\n", ""))
        path.write_text(head + "\n".join(",".join(map(str, row)) for row in rows))
    else:
        path.write_text(_ply([tuple(row) for row in rows], []))


def _array(path: Path, rng: random.Random) -> None:
    """NumPy files of other types and shapes, pickles, and wrong headers."""
    arrays = (
        np.array([{"a": 1}], dtype=object), np.zeros((2, 3), complex), np.zeros((2, 3), "S3"), np.zeros((2, 3), bool),
        np.zeros((2, 3), int), np.zeros((2, 3, 4)), np.float64(3), np.zeros((0, 3)), np.zeros((3, 0)),
        np.zeros(2, [("x", "f4"), ("y", "f4")]), np.zeros((2, 3), np.float16), np.zeros((2, 3), ">f8"),
        np.zeros((2, 3), np.longdouble), np.zeros((2, 3), "M8[s]"),
    )  # fmt: skip
    if path.suffix == ".npz":
        np.savez(path, **{name: rng.choice(arrays) for name in ("x", "volume")})
    elif path.suffix == ".npy" and rng.randrange(3):
        np.save(path, rng.choice(arrays))
    elif path.suffix == ".npy":
        shape = rng.choice(("(1000000000000, 3)", "(-1, 3)", "(2, 3", "('a', 3)", "(" * 500))
        text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
        path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(48))
    else:
        _flips(path, rng)


TEXTS = (
    *("x,y,z\n1,2\n", "x,y,z\n0.1,0.1," + "9" * 5000, 'x,y,z\n"' + "a" * 200_000, "x;y;z\n0.1;0.1;0.1\n", "\x00" * 99),
    *("x,y,z\n0.1,0.1,nan\n", "\ufeffx,y,z\n0.1,0.1,0.1\n", "x,y,z\r0.1,0.1,0.1\r", "\n" * 1000, "0.1,0.1,0.1\n1,2\n"),
)


def _text(path: Path, rng: random.Random) -> None:
    path.write_bytes(rng.choice(TEXTS).encode())


POINTS: dict[str, Callable[[Path, random.Random], None]] = {"rows": _rows, "arrays": _array, "text": _text}
