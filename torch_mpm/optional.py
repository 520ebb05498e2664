"""Packages of the extras, which may be missing."""

from __future__ import annotations

import importlib
import sys
from typing import Any

from .data import host_memory
from .interrupts import held_signals


def load(module: str, purpose: str, extra: str) -> Any:
    """Import a module of an optional package.

    Args:
        module: such as "scipy.spatial".
        purpose: the feature that needs it, such as "the repair of a mesh".
        extra: the extra of torch_mpm that installs it.

    Raises:
        ImportError: for a package that is not installed, or cannot be imported, with the reason.
        MemoryError: where memory is insufficient to import it.
    """
    package = module.partition(".")[0]
    try:
        if module in sys.modules:
            return importlib.import_module(module)
        with held_signals():  # An import in C++ turns an interrupt into another error, or is incomplete after it.
            return importlib.import_module(module)
    except (ImportError, OSError, MemoryError, RuntimeError) as error:
        if host_memory.is_short(error):
            raise MemoryError(f"{purpose}: too little memory to import {package} ({error})") from error
        if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == package:
            raise ImportError(
                f"{purpose}: the package {package} is not installed: pip install torch-mpm[{extra}]"
            ) from error
        raise ImportError(f"{purpose}: the package {package} is installed and cannot be imported: {error}") from error
