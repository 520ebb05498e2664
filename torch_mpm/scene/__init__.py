"""Scenes: from a scene file to a trajectory (`pip install torch-mpm[scene]`)."""

try:
    import pydantic as _pydantic  # noqa: F401
except ImportError as error:
    raise ImportError("scene files need pydantic: pip install torch-mpm[scene]") from error

from .explain import SceneError
from .scene import Scene
from .schema import json_schema

__all__ = ["Scene", "SceneError", "json_schema"]
