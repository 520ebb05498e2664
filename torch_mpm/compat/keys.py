"""Keys of dictionaries in the conventions of other simulators."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping
from typing import Any


def check_keys(
    what: str, given: Iterable[Any], known: Collection[str], unsupported: Mapping[str, str] | None = None
) -> None:
    """Check that all keys are known.

    Args:
        what: description of the dictionary.
        given: its keys.
        known: allowed keys.
        unsupported: keys of related simulators, with their replacement.

    Raises:
        ValueError: for other keys, with the nearest known one of each.
    """
    problems = []
    for key in given:
        if unsupported and key in unsupported:
            problems.append(f"{key!r} is not supported: {unsupported[key]}")
        elif key not in known:
            problems.append(f"{key!r} is unknown, the nearest known key is {nearest(key, known)!r}")
    if problems:
        raise ValueError(f"{what} must have known keys: {'; '.join(problems)}")


def nearest(name: Any, known: Iterable[str]) -> str:
    """The known name that is most similar to a name."""
    (result,) = difflib.get_close_matches(str(name), list(known), 1, 0.0)
    return result


def checked_list(name: str, given: Any) -> list[Any]:
    """A list of mappings.

    Raises:
        TypeError: for anything else.
    """
    if isinstance(given, (str, Mapping)) or not isinstance(given, Iterable):
        raise TypeError(f"{name} must be a list of mappings, got {type(given).__name__}")
    entries = list(given)
    for k, entry in enumerate(entries):
        if not isinstance(entry, Mapping):
            raise TypeError(f"{name}[{k}] must be a mapping, got {type(entry).__name__}")
    return entries


def check_needed(what: str, given: Mapping[str, Any], needed: Iterable[str]) -> None:
    """Check that no key is missing.

    Raises:
        ValueError: with the missing keys.
    """
    if missing := [name for name in needed if name not in given]:
        raise ValueError(f"{what} must have {', '.join(missing)}, got {sorted(given)}")
