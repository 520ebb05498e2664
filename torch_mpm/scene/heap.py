"""Release of free memory held by the C library."""

from __future__ import annotations

import ctypes
from typing import Any


def trim() -> None:
    """Return free memory of the C heap to the system, where the C library supports it (glibc).

    Tensors are aligned allocations, and glibc before 2.38 seldom reuses the holes of freed ones
    (https://sourceware.org/bugzilla/show_bug.cgi?id=14581): memory would grow without bound over thousands of steps.
    """
    if _malloc_trim is not None:
        _malloc_trim(0)


def _find() -> Any:
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None


_malloc_trim = _find()
