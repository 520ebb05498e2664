"""Rows of a new result that are slower than those of the committed result of the same device."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from . import common

SLOWER = 1.1
"""Factor over the committed time."""

Times = Callable[[dict[str, Any]], Iterable[tuple[str, float]]]
"""Names and times of the rows of a result."""


def show(name: str, result: dict[str, Any], times: Times, directory: Path = common.RESULTS) -> None:
    """Print rows that became slower than those of `name`.json in the directory, before it is overwritten."""
    file = directory / f"{name}.json"
    if file.exists():
        for row, before, now in slower(json.loads(file.read_text()), result, times):
            print(f"SLOWER: {row}: {now:.3g}, was {before:.3g} ({now / before:.2f} times)")


def slower(committed: dict[str, Any], result: dict[str, Any], times: Times) -> list[tuple[str, float, float]]:
    """Rows of both results that take longer than SLOWER times the committed time: name, time before, time now."""
    if _place(committed) != _place(result):
        return []
    before = dict(times(committed))
    return [(name, before[name], now) for name, now in times(result) if now > SLOWER * before.get(name, now)]


def _place(result: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(result["environment"].get(key) for key in ("device", "threads"))
