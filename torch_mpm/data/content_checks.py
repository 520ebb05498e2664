"""Checks of the differing parts of a configuration that need no sample."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from typing import Any

from ..scene.schema import VECTOR_KEYS
from .distribution import CHOICE, Words, is_distribution, is_number

LISTS = ("body", "obstacle")
VECTORS = ("lower", "upper", "velocity", *VECTOR_KEYS)
"""Keys of bodies and obstacles with a number per axis."""


def shape_problems(words: Words) -> Iterator[str]:
    """One line for each body, obstacle or material that is not a table, and for any date."""
    for key in LISTS:
        items = words.get(key, [])
        if not isinstance(items, list):
            yield f"{key}: takes a list of tables, [[{key}]], got {items!r}"
            continue
        for k, item in enumerate(items):
            if not _is_table(item):
                yield f"{key}[{k}]: takes a table, or a choice of tables, got {item!r}"
    materials = words.get("material", {})
    if not isinstance(materials, dict) or CHOICE in materials:
        yield f"material: takes a table of materials by their names, got {materials!r}"
    else:
        for name, material in materials.items():
            if not _is_table(material):
                yield f"material.{name}: takes a table, or a choice of tables, got {material!r}"
    yield from _date_problems(words, "")


def value_problems(words: Words, particles: bool, obstacles: bool) -> Iterator[str]:
    """One line for each value that data sets do not support, for words without `shape_problems`.

    Args:
        words: words of the configuration.
        particles: whether the number of particles of a scene is given.
        obstacles: whether obstacles are in the data.
    """
    for key in LISTS:
        for k, item in enumerate(words.get(key, [])):
            if not _is_count(item.get("count", 1)):
                yield (
                    f"{key}[{k}].count: takes a whole number that is not negative, integers of such or a choice of "
                    f"them, got {item['count']!r}"
                )
    yield from _vector_problems(words)
    for k, item in enumerate(words.get("body", [])):
        for kind in ("points", "splats") if particles else ():
            if kind in _values(item, "shape"):
                yield f"body[{k}].shape: {kind} have a number of their own; remove dataset.particles or the body"
    for k, item in enumerate(words.get("obstacle", [])):
        if obstacles and (any(v != 0 for v in _values(item, "start")) or _values(item, "end")):
            yield (
                f"obstacle[{k}]: start and end are not for obstacles that are in the data as particles; "
                "remove them, or set dataset.obstacles = false"
            )


def _vector_problems(words: Words) -> Iterator[str]:
    for key in LISTS:
        for k, item in enumerate(words.get(key, [])):
            for name in VECTORS:
                for value in _values(item, name):
                    one = is_distribution(value) and value.keys().isdisjoint({"in_box", "direction"})
                    if one or is_number(value):
                        yield (
                            f"{key}[{k}].{name}: takes a number or distribution for each axis, "
                            f"such as [0.2, {{ uniform = [0.1, 0.3] }}], got {value!r}"
                        )


def _is_table(item: Any) -> bool:
    """Whether words give a table for every choice."""
    if not isinstance(item, dict):
        return False
    if CHOICE in item:
        choices = item[CHOICE]
        # Another check reports a value that is not a list.
        return not isinstance(choices, list) or all(map(_is_table, choices))
    return not is_distribution(item)


def _is_count(count: Any) -> bool:
    if isinstance(count, int) and not isinstance(count, bool):
        return count >= 0
    if not is_distribution(count):
        return False
    if CHOICE in count:
        return isinstance(count[CHOICE], list) and all(map(_is_count, count[CHOICE]))
    ends = count.get("integers")
    return isinstance(ends, list) and all(map(_is_count, ends))


def _values(item: Any, key: str) -> list[Any]:
    """All possible values of a key of a table: its own, those of its choices and those of chosen tables."""
    if not isinstance(item, dict):
        return []
    found = _chosen(item[key]) if key in item else []
    choices = item.get(CHOICE)
    return found + [v for one in (choices if isinstance(choices, list) else []) for v in _values(one, key)]


def _chosen(value: Any) -> list[Any]:
    if not isinstance(value, dict) or not isinstance(value.get(CHOICE), list):
        return [value]
    return [v for one in value[CHOICE] for v in _chosen(one)]


def _date_problems(words: Any, path: str) -> Iterator[str]:
    if isinstance(words, (datetime.date, datetime.time)):
        yield f"{path}: takes no date or time, got {words}"
    elif isinstance(words, dict):
        for key, value in words.items():
            yield from _date_problems(value, f"{path}.{key}" if path else key)
    elif isinstance(words, list):
        for k, item in enumerate(words):
            yield from _date_problems(item, f"{path}[{k}]")
