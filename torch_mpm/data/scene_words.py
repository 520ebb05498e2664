"""Scene files of the scenes of data sets, checked when they are read."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import torch

from ..errors import LARGEST, is_finite

KINDS = {"material": dict, "body": list, "obstacle": list}
"""Types of the keys of a scene file that hold tables."""


def read_words(text: str, dim: int) -> dict[str, Any]:
    """Scene file of a scene with ``dim`` dimensions from its JSON.

    All numbers, gravity and the kinds of tables are checked; with the extra ``scene``, also texts, materials and
    obstacles.

    Raises:
        ValueError: for a text that is no scene file, with its first key that is wrong.
    """
    try:
        words = json.loads(text)
        problems = [*_table_problems(words, dim), *number_problems(words)] or _model_problems(words, dim)
    except RecursionError:
        raise ValueError("it has too many tables within tables") from None
    if problems:
        raise ValueError(problems[0])
    return dict(words)


def number_problems(words: Any) -> list[str]:
    """One line for each number that float32 cannot hold, the type of positions in data sets and of most exports."""
    most = LARGEST[torch.float32]
    return [
        f"{key}: must be finite and at most {most:.3g}, the largest number in float32, got {value!r:.100}"
        for key, value in _numbers(words, "")
        if not (is_finite(value) and abs(value) <= most)
    ]


def _numbers(words: Any, path: str) -> Iterator[tuple[str, int | float]]:
    """(key, value) of all numbers."""
    if isinstance(words, dict):
        for key, value in words.items():
            yield from _numbers(value, f"{path}.{key}" if path else key)
    elif isinstance(words, (list, tuple)):
        for k, item in enumerate(words):
            yield from _numbers(item, f"{path}[{k}]")
    elif isinstance(words, (int, float)):
        yield path, words


def _table_problems(words: Any, dim: int) -> Iterator[str]:
    if not isinstance(words, dict):
        yield f"a scene file is a table, got {words!r:.100}"
        return
    gravity = words.get("gravity")
    if gravity is not None and not (isinstance(gravity, list) and len(gravity) == dim and all(map(is_finite, gravity))):
        yield f"gravity: must be {dim} numbers, got {gravity!r:.100}"
    for key, kind in KINDS.items():
        things = words.get(key, kind())
        items = things.values() if isinstance(things, dict) else things
        if not isinstance(things, kind) or not all(isinstance(item, dict) for item in items):
            yield f"{key}: must be tables, got {things!r:.100}"


def _model_problems(words: dict[str, Any], dim: int) -> list[str]:
    """Problems of texts, materials and obstacles, as those of scene files; none without the extra ``scene``."""
    try:
        from pydantic import ValidationError

        from ..scene import check, explain, schema
    except ImportError:
        return []
    if problems := explain.text_problems(words):
        return problems
    try:
        content = schema.Content(**{key: words[key] for key in ("material", "obstacle") if key in words})
    except ValidationError as error:
        return explain.explain(error, schema.Content)
    return [p for k, item in enumerate(content.obstacle) for p in check.obstacle_problems(f"obstacle[{k}]", item, dim)]
