"""Optional packages of the `render` extra."""

from __future__ import annotations

import sys
from typing import Any

from .. import optional
from ..data import host_memory

SIZES = {"vtk": 7e8, "vtkmodules": 7e8, "matplotlib": 2e8}
"""Maximum memory of the import of a package [bytes]: VTK and kiwisolver end the process where it fails."""


VTK_SPACE = 1.4e9
"""Maximum address space of VTK up to its first picture, with the threads of a software OpenGL [bytes]."""


class RenderError(RuntimeError):
    """A picture cannot be made on this machine; the message names the packages to install."""


def require(module: str) -> Any:
    """Import `module` or raise an error that names the extra that provides it.

    Raises:
        ImportError, MemoryError: as `torch_mpm.optional.load`.
    """
    package = module.partition(".")[0]
    if package in SIZES and package not in sys.modules:
        host_memory.require(SIZES[package], f"the import of {package} for pictures")
        if package.startswith("vtk"):
            host_memory.require_address_space(VTK_SPACE, "a picture by vtk")
    return optional.load(module, "pictures", "render")
