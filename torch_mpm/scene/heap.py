"""Memory that the C library holds back, returned to the system."""

from __future__ import annotations

import ctypes
from typing import Any


def trim() -> None:
    """Return free memory of the C heap to the system, where the C library can (glibc).

    Tensors are aligned allocations, and glibc before 2.38 seldom reuses what they leave in its heap
    (https://sourceware.org/bugzilla/show_bug.cgi?id=14581): thousands of steps would grow to any size.
    """
    if _malloc_trim is not None:
        _malloc_trim(0)


def _find() -> Any:
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None


_malloc_trim = _find()
