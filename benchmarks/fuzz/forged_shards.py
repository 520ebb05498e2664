"""Forged shards: changed contents with records of valid checksums."""

from __future__ import annotations

import contextlib
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torch_mpm.data.packing import array_digest, content_hash
from torch_mpm.data.whole_files import CHECKSUM, file_hash, write_record

DTYPES = ("f2", "f8", ">f4", "i1", "u8", "S8", "c8", "?", "i4", "O")
VALUES = (np.nan, np.inf, -np.inf, 1e38, -1e30, 0.0, -1, 127)
TEXTS: tuple[Any, ...] = (
    *("", "{}", "[]", "null", "3", "{", "[" * 100_000, "\x00", "x" * 60_000, 7, -1, 1e300, np.nan),
    *(
        '{"gravity": "x"}',
        '{"gravity": [1, "a"]}',
        '{"gravity": [NaN, 1]}',
        '{"gravity": {"x": 1}}',
        '{"gravity": [1]}',
    ),
    *('{"material": [1]}', '{"material": {"jelly": 3}}', '{"material": {"jelly": {"E": "x"}}}', '{"body": 3}'),
    *('{"obstacle": [{"shape": "box"}]}', '{"obstacle": 7, "grid": []}', '{"obstacle": [3]}', '{"heat": 3}'),
)


def forge(folder: Path, rng: random.Random) -> tuple[str, bool]:
    """Change a shard of a data set; returns the change, and whether `verify` must detect it."""
    path = rng.choice(sorted((folder / "shards").glob("*.h5")))
    what = rng.choice(sorted(CHANGES))
    hidden = what in ("attributes", "text", "a foreign attribute", "measure")  # which have no checksum of their own
    with h5py.File(path, "r+") as file:
        scene = file[rng.choice(sorted(file))]
        before = content_hash(_arrays(scene))
        name = scene.name
        try:
            CHANGES[what](file, scene, rng)
        except (KeyError, TypeError, ValueError) as error:
            return f"{what}: not for this scene ({error})", False
    with contextlib.suppress(Exception), h5py.File(path) as file:
        hidden = hidden or content_hash(_arrays(file[name])) == before
    rehashed = rng.random() < 0.5
    _fit(path, rehashed)
    return f"{path.name}: {what}{', hashes of scenes too' if rehashed else ''}", not rehashed and not hidden


def _fit(path: Path, rehashed: bool) -> None:
    """Update the record of a shard, with the hashes of its scenes where these can be computed."""
    record = path.with_suffix(".json")
    words = json.loads(record.read_text())
    words.pop(CHECKSUM)
    words |= {"bytes": path.stat().st_size, "sha256": file_hash(path)}
    with contextlib.suppress(Exception), h5py.File(path) as file:
        for scene in words["scenes"] if rehashed else ():
            group = file[f"scene_{scene['id']:07d}"]
            arrays = _arrays(group)
            scene["hash"] = content_hash(arrays)
            plain = [name for name in arrays if group[name].chunks is None]
            scene["digests"] = {name: array_digest(arrays[name]).hex() for name in plain}
            scene["particles"] = arrays["position"].shape[1]
    write_record(record, words)


def _arrays(scene: Any) -> dict[str, Any]:
    return {name: scene[name][...] for name in scene if scene[name].nbytes < 10**8}


def _array(scene: Any, rng: random.Random) -> str:
    return rng.choice(sorted(scene))


def _replaced(scene: Any, name: str, **options: Any) -> None:
    attributes = dict(scene[name].attrs)
    del scene[name]
    scene.create_dataset(name, **options)
    scene[name].attrs.update(attributes)


def _dtype(file: Any, scene: Any, rng: random.Random) -> None:
    name, dtype = _array(scene, rng), rng.choice(DTYPES)
    values = scene[name][...]
    _replaced(scene, name, data=values.astype(dtype) if dtype != "O" else np.full(3, "text", object))


def _shape(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    values = scene[name][...]
    other = rng.choice(
        (
            values[:-1], values[:0], values[..., None], values.reshape(-1), values[None], np.concatenate([values] * 2),
            values[:, :-1] if values.ndim > 1 else values[:1], values[..., :1], values.reshape(-1)[0],
        )
    )  # fmt: skip
    _replaced(scene, name, data=other)


def _all_shapes(file: Any, scene: Any, rng: random.Random) -> None:
    """Remove one frame or particle from every array, consistently."""
    axis = rng.randrange(2)
    for name in list(scene):
        values = scene[name][...]
        if axis == 1 and values.ndim == 1:
            _replaced(scene, name, data=values[:-1])
        elif values.ndim > 1:
            _replaced(scene, name, data=values[:-1] if axis == 0 else values[:, :-1])


def _values(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    values = scene[name][...]
    value = rng.choice(VALUES)
    if values.dtype.kind != "f":
        value = rng.choice((-1, 127, 9))
    values.reshape(-1)[rng.randrange(values.size) if rng.randrange(2) else slice(None)] = value
    _replaced(scene, name, data=values, chunks=scene[name].chunks)


def _missing(file: Any, scene: Any, rng: random.Random) -> None:
    del scene[_array(scene, rng)]


def _empty(file: Any, scene: Any, rng: random.Random) -> None:
    for name in list(scene):
        del scene[name]


def _no_scene(file: Any, scene: Any, rng: random.Random) -> None:
    del file[scene.name]


def _more(file: Any, scene: Any, rng: random.Random) -> None:
    name = rng.choice(("x", "temperature", "C", "../x", "velocity.", "\N{SNOWMAN}", "a/b", "particle_type2"))
    scene.create_dataset(
        name, data=np.zeros(rng.choice(((), (0,), (3,), (4, 2, 2), (4, 5, 3, 3))), rng.choice(("f4", "i1")))
    )


def _group(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    del scene[name]
    scene.create_group(name).create_dataset("x", data=np.zeros(3))


def _huge(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    shape = list(scene[name].shape)
    shape[rng.randrange(len(shape))] = rng.choice((2**20, 2**31, 2**40, 2**60 // max(1, int(np.prod(shape)))))
    options = rng.choice(({}, {"chunks": True}, {"chunks": (1,) * len(shape)}, {"chunks": True, "compression": "gzip"}))
    _replaced(scene, name, shape=shape, dtype=scene[name].dtype, **options)


def _filled(file: Any, scene: Any, rng: random.Random) -> None:
    """An array that decompresses to far more than its file."""
    name = _array(scene, rng)
    shape = list(scene[name].shape)
    shape[-1] = 2**24
    _replaced(scene, name, data=np.zeros([min(s, 2**24) for s in shape[-1:]], "f4"), compression="gzip", chunks=True)


def _chunks(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    values = scene[name][...]
    if not values.ndim:
        raise TypeError("a scalar")
    _replaced(scene, name, data=values, chunks=(1,) * values.ndim)


def _compression(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    options = rng.choice(({"compression": "lzf"}, {"fletcher32": True}, {"scaleoffset": 2}, {"compression": "gzip"}))
    _replaced(scene, name, data=scene[name][...], **options)


def _outside(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    _replaced(scene, name, shape=(10,), dtype="i1", external=[("/etc/passwd", 0, 10)])


def _link(file: Any, scene: Any, rng: random.Random) -> None:
    name = _array(scene, rng)
    del scene[name]
    scene[name] = rng.choice(
        (h5py.SoftLink("/"), h5py.SoftLink(f"{scene.name}/mass"), h5py.ExternalLink("/etc/passwd", "/x"), file["/"])
    )


def _attributes(file: Any, scene: Any, rng: random.Random) -> None:
    name = rng.choice(sorted(scene.attrs))
    value = rng.choice((None, "", "x", -1, 10**6, np.nan, np.zeros(3), "7" * 4000, h5py.Empty("f4"), 1e300))
    if value is None:
        del scene.attrs[name]
    else:
        scene.attrs[name] = value


def _text(file: Any, scene: Any, rng: random.Random) -> None:
    scene.attrs[rng.choice(("scene", "materials"))] = rng.choice(TEXTS)


def _foreign(file: Any, scene: Any, rng: random.Random) -> None:
    target = rng.choice((file, scene, scene["position"]))
    target.attrs[rng.choice(("measure", "x", "format", "version"))] = rng.choice(
        (7, "x", np.zeros(9), file.ref, "\x01")
    )


def _measure(file: Any, scene: Any, rng: random.Random) -> None:
    scene["stress"].attrs["measure"] = rng.choice(
        ("Cauchy", "Kirchhoff", "x", 3, np.zeros(2), b"\xff", h5py.Empty("f4"))
    )


CHANGES: dict[str, Callable[[Any, Any, random.Random], None]] = {
    "type": _dtype, "shape": _shape, "all shapes": _all_shapes, "values": _values, "a missing array": _missing,
    "no arrays": _empty, "no scene": _no_scene, "one array more": _more, "a group": _group, "huge": _huge,
    "decompresses to much": _filled, "chunks": _chunks, "compression": _compression, "external storage": _outside,
    "a link": _link, "attributes": _attributes, "text": _text, "a foreign attribute": _foreign, "measure": _measure,
}  # fmt: skip
