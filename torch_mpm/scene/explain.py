"""Messages about problems of a scene: the key, its accepted values, and the probable intention."""

from __future__ import annotations

import difflib
import json
import re
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from .schema import SceneData

MOST_LINES = 20
"""Maximum number of problems in the message of an error."""
MOST_LETTERS = 1000
"""Maximum length of a problem in the message: values of files may be long."""
UNWRITABLE = re.compile(r"\\u0000|[\ud800-\udfff]")
"""Null characters and lone surrogates in a JSON text."""
BOOLEANS = ("deterministic", "volume_correction", "vtk", "ply", "video", "project", "surface", "obstacles", "fill")
"""Keys of scene files and of [dataset] that are true or false."""


class SceneError(ValueError):
    """Invalid scene. ``problems`` has one line for each problem."""

    def __init__(self, problems: Sequence[str], source: str = "") -> None:
        self.problems = list(problems)
        head = f"{source}: " if source else ""
        lines = [f"{head}{_shortened(problem)}" for problem in self.problems[:MOST_LINES]]
        rest = len(self.problems) - len(lines)
        super().__init__("\n".join([*lines, *([f"{head}and {rest} more problems"] if rest else [])]))


def _shortened(line: str) -> str:
    if len(line) <= MOST_LETTERS:
        return line
    return f"{line[: MOST_LETTERS // 2]} [{len(line) - MOST_LETTERS} letters] {line[-MOST_LETTERS // 2 :]}"


def text_problems(words: Any) -> list[str]:
    """One line for each text, or name of a key, that cannot be written: with a null character or a lone surrogate."""
    try:
        suspicious = UNWRITABLE.search(json.dumps(words, ensure_ascii=False, default=str))
        unwritable = suspicious is not None
    except (TypeError, ValueError, RecursionError):  # as for keys that are not texts, or numbers of 5000 digits
        unwritable = True
    return list(_unwritable(words, "")) if unwritable else []  # slower, and data sets check every batch of scenes


def _unwritable(words: Any, path: str) -> Iterator[str]:
    if isinstance(words, dict):
        for key, value in words.items():
            place = f"{path}.{key}" if path else str(key)
            yield from _unwritable(str(key), f"{ascii(place)[1:-1]} (a key)")
            yield from _unwritable(value, place)
    elif isinstance(words, (list, tuple)):
        for k, item in enumerate(words):
            yield from _unwritable(item, f"{path}[{k}]")
    elif isinstance(words, str) and ("\0" in words or any("\ud800" <= letter <= "\udfff" for letter in words)):
        yield f"{path}: has letters that no file can hold, got {words!a}"


def boolean_problems(words: Any, path: str = "") -> Iterator[str]:
    """One line for each true or false of a key that takes numbers: pydantic would read them as 1 and 0."""
    if isinstance(words, dict):
        for key, value in words.items():
            if key not in BOOLEANS:
                yield from boolean_problems(value, f"{path}.{key}" if path else str(key))
    elif isinstance(words, (list, tuple)):
        for k, item in enumerate(words):
            yield from boolean_problems(item, f"{path}[{k}]")
    elif isinstance(words, bool):
        yield f"{path}: takes no true or false, got {str(words).lower()}"


def explain(error: ValidationError, root: type[BaseModel] = SceneData) -> list[str]:
    """One line per problem of a validation against ``root``."""
    problems = error.errors(include_url=False)
    return [_line(item, root) for item in problems if not _lacks_invalid_entries(item)]


def _lacks_invalid_entries(item: Any) -> bool:
    """Whether a list has enough entries, but not enough valid ones. Each invalid entry is a problem of its own."""
    return bool(item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"])


def _line(item: Any, root: type[BaseModel]) -> str:
    model, path, annotation, description = _locate(item["loc"], root)
    kind, given = item["type"], item["input"]
    if kind == "extra_forbidden":
        key = str(item["loc"][-1])
        keys = list(model.model_fields)
        return f"{path}: unknown key{_did_you_mean(key, keys)}; {_takes_keys(model, keys)}"
    if kind in ("union_tag_invalid", "literal_error") or kind == "union_tag_not_found":
        choices = _choices(annotation)
        tag = item.get("ctx", {}).get("discriminator", "").strip("'")
        where = f"{path}.{tag}" if tag else path
        if kind == "union_tag_not_found":
            return f"{where}: missing; takes one of {_listed(choices)}"
        value = str(given.get(tag) if tag and isinstance(given, dict) else given)
        return f"{where}: takes one of {_listed(choices)}, got {value!r}{_did_you_mean(value, choices)}"
    takes = f"; takes: {description}" if description else ""
    if kind == "missing":
        return f"{path}: missing{takes}"
    if kind == "string_pattern_mismatch":
        return f"{path}: takes {description}, got {given!r}"
    if kind in ("too_short", "too_long"):
        least = kind == "too_short"
        count = f"at least {item['ctx']['min_length']}" if least else f"at most {item['ctx']['max_length']}"
        return f"{path}: should have {count} entries, not {len(given)}, got {given!r}{takes}"
    message = item["msg"][0].lower() + item["msg"][1:]
    return f"{path}: {message.removeprefix('input ')}, got {given!r}{takes}"


def _locate(loc: Sequence[int | str], root: type[BaseModel]) -> tuple[type[BaseModel], str, Any, str]:
    """Model with the key, its path in the notation of a file, its type and its description.

    The location that pydantic reports has the tag of a union as one more entry, which a file does not have.
    """
    model: type[BaseModel] = root
    annotation: Any = root
    path, description = "", ""
    for entry in loc:
        tagged = _tagged(annotation, entry)
        if tagged is not None:
            model = annotation = tagged
        elif isinstance(entry, int):
            path += f"[{entry}]"
            annotation = (typing.get_args(annotation) or (annotation,))[0]
        elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
            path += f".{entry}" if path else entry
            field = annotation.model_fields.get(entry)
            model = annotation
            if field is None:
                continue
            annotation, description = _plain(field.annotation), " ".join((field.description or "").split())
        elif typing.get_origin(annotation) is dict:
            path += f".{entry}"
            annotation = _plain(typing.get_args(annotation)[1])
        # Any other entry names a branch of a plain union, which a file does not have either.
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            model = annotation
    return model, path, annotation, description


def _plain(annotation: Any) -> Any:
    """Type without Annotated and without None."""
    while typing.get_origin(annotation) is typing.Annotated:
        annotation = typing.get_args(annotation)[0]
    members = [a for a in _members(annotation) if a is not type(None)]
    return members[0] if len(members) == 1 else annotation


def _members(annotation: Any) -> tuple[Any, ...]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return typing.get_args(annotation)
    if typing.get_origin(annotation) is typing.Annotated:
        return _members(typing.get_args(annotation)[0])
    return (annotation,)


def _tags(annotation: Any) -> Iterator[tuple[str, type[BaseModel]]]:
    for member in _members(annotation):
        if isinstance(member, type) and issubclass(member, BaseModel):
            for name in ("shape", "law"):
                if name in member.model_fields:
                    yield str(member.model_fields[name].default), member


def _tagged(annotation: Any, entry: int | str) -> type[BaseModel] | None:
    return dict(_tags(annotation)).get(str(entry)) if len(_members(annotation)) > 1 else None


def _choices(annotation: Any) -> list[str]:
    tags = [tag for tag, _ in _tags(annotation)]
    if tags:
        return tags
    return [str(value) for member in _members(annotation) for value in _literals(member)]


def _literals(annotation: Any) -> Iterator[Any]:
    if typing.get_origin(annotation) is typing.Literal:
        yield from typing.get_args(annotation)
    else:
        for member in typing.get_args(annotation):
            yield from _literals(member)


def _listed(choices: Sequence[str]) -> str:
    return ", ".join(repr(choice) for choice in dict.fromkeys(choices))


def _did_you_mean(key: str, choices: Sequence[str]) -> str:
    near = difflib.get_close_matches(key, choices, 1, 0.6) or [c for c in choices if c.lower() == key.lower()]
    return f"; did you mean {near[0]!r}?" if near else ""


def _takes_keys(model: type[BaseModel], keys: Sequence[str]) -> str:
    name = (model.__doc__ or model.__name__).splitlines()[0].rstrip(".")
    return f"the keys here ({name[0].lower() + name[1:]}) are {', '.join(sorted(keys))}"
