"""Records of runs and data sets (JSON files) with mistakes, with a valid or an old checksum."""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

from torch_mpm.data.whole_files import CHECKSUM, checksum

METADATA = "set/metadata.json"
SHARDS = ("set/shards/shard_00000.json", "set/shards/shard_00001.json")
RECORDS = ("set/dataset.json", *SHARDS, "run/run.json", METADATA)
NASTY: list[Any] = [
    *(0, -1, 1, 2, 3, 0.5, 1e300, -1e30, 1e-300, 2**31, 2**63, 2**64, 10**40, 10**400, True, False, None),
    *("", "x", "0", "nan", "../x", "/tmp/x", "a" * 5000, "\x00", "\udcff", "train", "position", "2024-01-01"),
    *([], [0], [0, 1], [[0, 1]], [-1, 3], [0, 10**12], ["x"], [None], [[]], [10**400], {}, {"a": 1}, {"x": [0, 3]}),
]
TEXTS = (
    b"",
    b"{}",
    b"[]",
    b"null",
    b"3",
    b"[" * 200_000,
    b"\xff\xfe",
    b'{"format": 1}',
    b'{"format": 2}',
    b'{"format": 3}',
    b"NaN",
)


def mutate(inputs: Path, rng: random.Random) -> tuple[str, bool]:
    """Change a record; returns the change, and whether the command that checks it must fail.

    A record without a fitting checksum must be refused. One with a checksum that fits may be right by chance.
    """
    name = rng.choice(RECORDS)
    path = inputs / name
    data = path.read_bytes()
    words = json.loads(data)
    if rng.random() < 0.25:
        done, changed = _bytes(data, rng)
        path.write_bytes(changed)
        return f"{name}: {done}", name != METADATA and _differ(words, changed)
    before = copy.deepcopy(words)
    done = ", ".join(_words(words, rng) for _ in range(rng.choice((1, 1, 1, 2, 3))))
    fits = rng.random() < 0.7
    if fits and CHECKSUM in words:
        words[CHECKSUM] = checksum({key: value for key, value in words.items() if key != CHECKSUM})
    path.write_text(json.dumps(words))
    wrong = not fits and words != before and name != METADATA
    return f"{name}: {done}{', with a checksum that fits' if fits else ''}", wrong


def _differ(words: Any, data: bytes) -> bool:
    try:
        return bool(json.loads(data) != words)
    except (ValueError, RecursionError):
        return True


def _bytes(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    kind, at = rng.choice(("flip", "flip", "cut", "text", "twice", "hole")), rng.randrange(len(data))
    if kind == "flip":
        return f"bit at {at}", data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == "cut":
        return f"cut at {at}", data[:at]
    if kind == "hole":
        return f"zeros at {at}", data[:at] + bytes(len(data[at : at + 64])) + data[at + 64 :]
    if kind == "twice":
        return "twice", data + data
    text = rng.choice(TEXTS)
    return f"{text[:20]!r}", text


def _words(words: Any, rng: random.Random) -> str:
    """One change at any depth."""
    places = list(_places(words, ""))
    if not places:
        return "nothing"
    path, holder, key = rng.choice(places)
    kind = rng.choice(("value", "value", "value", "delete", "rename", "add", "repeat", "number"))
    if kind == "delete":
        del holder[key]
    elif kind == "rename" and isinstance(holder, dict):
        holder[rng.choice(("x", "", "../x", "\x00", str(key).upper()))] = holder.pop(key)
    elif kind == "add" and isinstance(holder, dict):
        holder[rng.choice(("x", "added", "format", "../x"))] = copy.deepcopy(rng.choice(NASTY))
    elif kind == "repeat" and isinstance(holder, list):
        holder.append(copy.deepcopy(holder[key]))
    elif kind == "number" and isinstance(holder[key], (int, float)):
        holder[key] = rng.choice(
            (holder[key] + 1, -holder[key], float(holder[key]), str(holder[key]), holder[key] * 10**6)
        )
    else:
        holder[key] = copy.deepcopy(rng.choice(NASTY))
    return f"{kind} {path}"


def _places(words: Any, path: str) -> list[tuple[str, Any, Any]]:
    """(path, container, key) of every value at any depth but the checksum."""
    found: list[tuple[str, Any, Any]] = []
    for key, value in words.items() if isinstance(words, dict) else enumerate(words):
        if key == CHECKSUM:
            continue
        place = f"{path}.{key}" if path else str(key)
        found.append((place, words, key))
        if isinstance(value, (dict, list)):
            found += _places(value, place)
    return found
