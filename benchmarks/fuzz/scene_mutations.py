"""Scene files with a few mistakes."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

JELLY = {"law": "neo_hookean", "E": 1e4}
SQUARE = {"lower": [0.0, 0.0], "upper": [1.0, 1.0], "dx": 0.1}
CUBE = {"lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0, 1.0], "dx": 0.2}
BASES: list[dict[str, Any]] = [
    {
        "device": "cpu", "gravity": [0.0, -10.0], "duration": 0.04, "fps": 50, "grid": SQUARE,
        "material": {"jelly": JELLY, "water": {"law": "weakly_compressible", "bulk_modulus": 1e4}},
        "body": [
            {"shape": "sphere", "center": [0.4, 0.3], "radius": 0.2, "spin": 3.0, "material": "jelly"},
            {"shape": "points", "file": "points.npy", "volume": 0.01, "material": "water"},
        ],
        "emitter": [{"center": [0.8, 0.7], "radius": 0.1, "velocity": [-1.0, 0.5], "material": "jelly"}],
        "obstacle": [{"shape": "plane", "center": [0.0, 0.05], "normal": [0.0, 1.0], "contact": "slip"}],
        "output": {"fields": ["F"]}, "render": {"resolution": [160, 120], "video": False, "range": [0.0, 1.0]},
    },
    {
        "device": "cpu", "gravity": [0.0, 0.0, -10.0], "duration": 0.02, "fps": 50, "grid": CUBE, "dt": 1e-3,
        "material": {"sand": {"law": "quartic_sand", "E": 1e5}},
        "body": [
            {"shape": "box", "lower": [0.1, 0.1, 0.1], "upper": [0.4, 0.4, 0.4], "material": "sand"},
            {"shape": "cylinder", "a": [0.7, 0.7, 0.1], "b": [0.7, 0.7, 0.5], "radius": 0.2, "material": "sand"},
            {"shape": "mesh", "file": "mesh.obj", "scale": 0.2, "offset": [0.2, 0.7, 0.7], "material": "sand"},
        ],
        "obstacle": [{"shape": "revolved", "outline": [[0.0, 0.0], [0.1, 0.0], [0.1, 0.1]], "center": [0.2, 0.8, 0.2]}],
    },
    {
        "device": "cpu", "duration": 0.02, "fps": 50, "grid": SQUARE, "heat": {"reference": 300.0},
        "material": {"metal": {"law": "von_mises", "E": 1e5, "yield_stress": 1e3, "conductivity": 50.0,
                               "specific_heat": 500.0, "melting_point": 400.0, "latent_heat": 1e4}},
        "body": [{"shape": "box", "lower": [0.2, 0.2], "upper": [0.6, 0.5], "material": "metal", "temperature": 350.0}],
        "scene": [{"gravity": [0.0, -1.0]}, {"gravity": [0.0, -2.0], "name": "heavy"}],
    },
]  # fmt: skip
NASTY: list[Any] = [
    *(0, -1, 1, 3, 0.5, 1e-9, 1e9, 1e30, -1e30, 1e300, 1e-300, 5e-324, 2**31, 2**63, 10**400, True),
    *(math.nan, math.inf, -math.inf, "", "jelly", "a" * 10000, "\u0000", "../..", ".", "none.npy", "slip"),
    *([], [1.0], [1e30, 1e30], [0, 0, 0], [math.nan] * 2, [[1, 2], [3]], ["slip", "slip"], [9.5, 9.5, 9.5]),
    *({}, {"law": "hencky"}, {"a": {"b": 1}}, [{}]),
]


def prepare(folder: Path) -> None:
    """Files named by the scenes."""
    np.save(folder / "points.npy", np.array([[0.8, 0.2], [0.85, 0.2]]))
    corners = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1"]
    faces = ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 1 4 3"]
    (folder / "mesh.obj").write_text("\n".join(corners + faces) + "\n")


def mutated(rng: random.Random) -> tuple[str, bool]:
    """Text of a scene file with one to three mistakes, and whether it cannot be right."""
    words = copy.deepcopy(rng.choice(BASES))
    wrong = mistakes(words, NASTY, rng)
    text = toml(words)
    if rng.random() < 0.1:
        return text[: rng.randrange(len(text))] + rng.choice(("", "[" * 5000, "= =", "\x00", "\udcff")), False
    return text, wrong


def mistakes(words: dict[str, Any], values: list[Any], rng: random.Random) -> bool:
    """Make one to three mistakes in the words of a file; return whether one of them is an unknown key, so that the file
    must be refused."""
    wrong = False
    for _ in range(rng.randint(1, 3)):
        holder, key = rng.choice(list(_places(words)))
        kind = rng.choice(("value", "value", "value", "scale", "delete", "unknown", "repeat"))
        if kind == "value":
            holder[key] = copy.deepcopy(rng.choice(values))
        elif kind == "scale" and isinstance(holder[key], float):
            holder[key] *= rng.choice((-1.0, 1e-6, 1e6, 1e12))
        elif kind == "delete":
            del holder[key]
        elif kind == "unknown" and isinstance(words.get("grid"), dict):
            words["grid"]["colour"] = 1
        elif kind == "repeat" and isinstance(holder, list):
            holder.append(copy.deepcopy(holder[key]))
        wrong = "colour" in (words["grid"] if isinstance(words.get("grid"), dict) else {})
    return wrong


def _places(words: Any) -> Iterator[tuple[Any, Any]]:
    """(container, key) of every value at any depth."""
    for key, value in list(words.items() if isinstance(words, dict) else enumerate(words)):
        yield words, key
        if isinstance(value, (dict, list)):
            yield from _places(value)


def toml(words: dict[str, Any]) -> str:
    """A scene file with these words."""
    return "\n".join(f"{json.dumps(str(key))} = {_toml(value)}" for key, value in words.items())


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return str(value) if isinstance(value, float) and not math.isfinite(value) else json.dumps(value)
