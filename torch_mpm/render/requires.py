"""Optional packages of the `render` extra."""

from __future__ import annotations

import importlib
from typing import Any


class RenderError(RuntimeError):
    """A picture cannot be made on this machine; the message says what to install."""


def require(module: str) -> Any:
    """Import `module` or say which extra brings it. Raises ImportError."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"pictures need the package {module.partition('.')[0]!r}, which is not installed: "
            "pip install torch-mpm[render]"
        ) from error
