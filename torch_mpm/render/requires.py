"""Optional packages of the `render` extra."""

from __future__ import annotations

import sys
from typing import Any

from .. import memory, optional

SIZES = {"vtk": 1.5e9}
"""Address space that the import of a package takes [bytes]: VTK crashes where it gets less."""


class RenderError(RuntimeError):
    """A picture cannot be made on this machine; the message says what to install."""


def require(module: str) -> Any:
    """Import `module` or say which extra brings it.

    Raises:
        ImportError, MemoryError: as `torch_mpm.optional.load`.
    """
    package = module.partition(".")[0]
    if package in SIZES and package not in sys.modules:
        memory.require(SIZES[package], f"the import of {package} for pictures")
    return optional.load(module, "pictures", "render")
