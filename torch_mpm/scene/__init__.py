"""Scenes: from a scene file to a trajectory (`pip install torch-mpm[scene]`)."""

try:
    import pydantic as _pydantic  # noqa: F401
except (ImportError, MemoryError):
    from ..optional import load as _load

    _load("pydantic", "scene files", "scene")  # Raises with the reason.

from .explain import SceneError
from .scene import Scene
from .schema import json_schema

__all__ = ["Scene", "SceneError", "json_schema"]
