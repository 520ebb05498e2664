"""Signals during ops of many substeps: their handlers run between the substeps, and end the op where they raise.

Python runs the handlers of signals on its main thread, between its own instructions. An op that takes long resumes the
generator here several times a second for that (csrc/common/signals.h).
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from typing import Any


class _Raised(threading.local):
    """What a handler has raised while an op of this thread was at work."""

    error: BaseException | None = None


_RAISED = _Raised()


def _run_handlers() -> Iterator[int]:
    """Each `next` runs the handlers of the signals that have come, and returns whether one of them has raised.

    A generator, because Python runs handlers where code begins or is resumed: a function would raise before it came to
    its `try`.
    """
    raised = 0
    while True:
        try:
            while True:
                yield raised
                raised = 0
        except GeneratorExit:
            return
        except BaseException as error:
            _RAISED.error, raised = error, 1


_HANDLERS = _run_handlers()
next(_HANDLERS)
_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int)(_HANDLERS.__next__)


def watch(library: ctypes.CDLL, backend: str) -> None:
    """From now on the ops of a library run handlers; those of a library from earlier sources hold signals back."""
    run_handlers = getattr(library, f"torch_mpm_run_handlers_{backend}", None)
    if run_handlers is not None:
        run_handlers(_CALLBACK)


def interruptible(call: Any, *arguments: Any) -> Any:
    """`call(*arguments)`, an op that checks signals.

    Raises:
        BaseException: what the handler of a signal has raised meanwhile, such as KeyboardInterrupt.
    """
    _RAISED.error = None
    try:
        return call(*arguments)
    except RuntimeError:
        if _RAISED.error is None:
            raise
        error, _RAISED.error = _RAISED.error, None
    raise error
