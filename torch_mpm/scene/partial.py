"""Further problems in a scene that could not be read as a whole: checks of the valid parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from . import check, schema
from .entry import ResolvedEntry

LISTS = {"body": schema.AnyBody, "obstacle": schema.AnyObstacle, "emitter": schema.Emitter}


def problems(words: dict[str, Any]) -> list[str]:
    """One line for each problem that can be found in spite of the others; none for unreadable parts."""
    names = ("grid", "origin", "duration", "fps", "render", "gravity", "precision")
    scene = schema.SceneData.model_construct(**{name: _field(name, words) for name in names})
    heat = words.get("heat")
    scene.heat = None if heat is None else _piece(schema.Heat, heat) or schema.Heat()
    return check.problems(scene, _entries(words))


def file_problems(words: dict[str, Any], folder: Path) -> list[str]:
    """Files of the readable bodies."""
    return list(dict.fromkeys(p for entry in _entries(words) for p in check.file_problems(entry, folder)))


def _entries(words: dict[str, Any]) -> list[ResolvedEntry]:
    own = _content(words)
    scenes = [entry for entry in _list(words.get("scene")) if isinstance(entry, dict)]
    if not scenes:
        return [ResolvedEntry.resolved(own)]
    return [ResolvedEntry.resolved(_content(entry), own, k) for k, entry in enumerate(scenes)]


def _content(words: dict[str, Any]) -> schema.Entry:
    """Scene of a batch, or the shared part, with None in place of invalid parts."""
    lists: dict[str, Any] = {
        name: [_piece(kind, item) for item in _list(words.get(name))] for name, kind in LISTS.items()
    }
    materials = words.get("material")
    pieces = {
        str(name): _piece(schema.Material, value)
        for name, value in (materials.items() if isinstance(materials, dict) else ())
    }
    return schema.Entry.model_construct(gravity=_field("gravity", words), material=pieces, **lists)


def _field(name: str, words: dict[str, Any]) -> Any:
    """Value of a key of the scene, its default where absent, None where invalid or missing."""
    field = schema.SceneData.model_fields[name]
    if name not in words:
        return None if field.is_required() else field.get_default()
    return _piece(field.rebuild_annotation(), words[name])


def _piece(kind: Any, value: Any) -> Any:
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError:
        return None


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (list, tuple)) else []
