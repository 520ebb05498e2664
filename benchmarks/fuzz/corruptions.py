"""Damage to the files of a run folder: accidental, and forged with valid checksums."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from torch_mpm.data.hdf5 import FOOTER, seal
from torch_mpm.scene import folder as folders

Damage = Callable[[Path, random.Random], None]


def _bytes(change: Callable[[bytearray, random.Random], bytes | bytearray]) -> Damage:
    def damage(path: Path, rng: random.Random) -> None:
        path.write_bytes(change(bytearray(path.read_bytes()), rng))

    return damage


def _flip(data: bytearray, rng: random.Random) -> bytearray:
    for _ in range(rng.randint(1, 4)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return data


def _hole(data: bytearray, rng: random.Random) -> bytearray:
    begin = rng.randrange(len(data))
    data[begin : begin + 512] = bytes(len(data[begin : begin + 512]))
    return data


def _folder(path: Path, rng: random.Random) -> None:
    path.unlink()
    path.mkdir()


def _exchange(path: Path, rng: random.Random) -> None:
    other = rng.choice([p for p in path.parent.iterdir() if p.is_file() and p != path])
    shutil.copyfile(other, path)


ACCIDENTS: dict[str, Damage] = {
    "zeroed": _bytes(lambda data, rng: bytes(len(data))),
    "cut off": _bytes(lambda data, rng: data[: rng.randrange(len(data))]),
    "garbage": _bytes(lambda data, rng: rng.randbytes(len(data))),
    "empty": _bytes(lambda data, rng: b""),
    "flipped bits": _bytes(_flip),
    "hole": _bytes(_hole),
    "more at the end": _bytes(lambda data, rng: data + rng.randbytes(100)),
    "JSON": _bytes(lambda data, rng: rng.choice((b"{}", b"[]", b"null", b'"x"', b"[" * 100000, b"\xff"))),
    "a folder": _folder,
    "another file": _exchange,
}


# ---- forgeries: the seal is right, what is under it is not


def _replace(file: h5py.File, name: str, **options: object) -> None:
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, **options)
    file[name].attrs.update(attributes)


def _array(file: h5py.File, rng: random.Random) -> str:
    return rng.choice([name for name in file if isinstance(file[name], h5py.Dataset)])


def _record(**changes: object) -> Callable[[h5py.File, random.Random], None]:
    def change(file: h5py.File, rng: random.Random) -> None:
        if "record" in file.attrs:
            file.attrs["record"] = json.dumps({**json.loads(file.attrs["record"]), **changes})
        else:
            file["frames_written"][0] = 10**6

    return change


def _fill(file: h5py.File, rng: random.Random) -> None:
    name = _array(file, rng)
    file[name][...] = np.nan if file[name].dtype.kind == "f" else -7


def _outside(file: h5py.File, rng: random.Random) -> None:
    """References to data of another file (external storage of HDF5)."""
    name = _array(file, rng)
    shape, dtype = file[name].shape, file[name].dtype
    _replace(file, name, shape=shape, dtype=dtype, external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def _link(file: h5py.File, rng: random.Random) -> None:
    name = _array(file, rng)
    del file[name]
    file[name] = rng.choice((h5py.SoftLink("/" + _array(file, rng)), h5py.ExternalLink("other.h5", "/x")))


def _huge(file: h5py.File, rng: random.Random) -> None:
    name = _array(file, rng)
    _replace(file, name, shape=(2**40, *file[name].shape[1:]), dtype=file[name].dtype, chunks=True)


def _dtype(file: h5py.File, rng: random.Random) -> None:
    name = _array(file, rng)
    _replace(file, name, data=file[name][()].astype(rng.choice(("f2", "i1", "S8", "c8", "u8"))))


def _shape(file: h5py.File, rng: random.Random) -> None:
    name = _array(file, rng)
    _replace(file, name, data=file[name][()][:-1])


def _foreign(file: h5py.File, rng: random.Random) -> None:
    file[rng.choice(("x", "extra.y", "notes", "C"))] = rng.choice((1.0, "text", [1, 2, 3]))


def _missing(file: h5py.File, rng: random.Random) -> None:
    del file[_array(file, rng)]


FORGERIES: dict[str, Callable[[h5py.File, random.Random], None]] = {
    "frame out of range": _record(frame=10**6),
    "negative frame": _record(frame=-3),
    "layers out of range": _record(emitted=10**6),
    "record of another type": _record(totals=[1, 2], time="now"),
    "another fingerprint": _record(fingerprint="0" * 16),
    "numbers": _fill,
    "external storage": _outside,
    "a link": _link,
    "a huge shape": _huge,
    "another type": _dtype,
    "another shape": _shape,
    "a foreign field": _foreign,
    "a missing field": _missing,
}


def forge(path: Path, name: str, rng: random.Random) -> None:
    """Change the HDF5 file and recompute its checksum."""
    data = path.read_bytes()
    length, _, _ = FOOTER.unpack(data[-FOOTER.size :])
    path.write_bytes(data[: -FOOTER.size - length])
    try:
        with h5py.File(path, "r+") as file:
            FORGERIES[name](file, rng)
    except (KeyError, OSError, TypeError, ValueError):
        path.write_bytes(data)  # not for this file
        ACCIDENTS["hole"](path, rng)
        return
    with open(path, "r+b") as handle:
        seal(handle, [(0, path.stat().st_size)])


def corrupt(folder: Path, rng: random.Random) -> str:
    """Damage one file of a run folder; returns its name and the damage."""
    path = rng.choice(sorted(p for p in folder.iterdir() if p.is_file() and p.name != folders.LOCK))
    if path.suffix == ".h5" and rng.random() < 0.5:
        name = rng.choice(sorted(FORGERIES))
        forge(path, name, rng)
    else:
        name = rng.choice(sorted(ACCIDENTS))
        ACCIDENTS[name](path, rng)
    return f"{path.name}: {name}"
