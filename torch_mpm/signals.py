"""Signals during ops of many substeps: their handlers run between the substeps, and an exception ends the op.

Python runs the handlers of signals on its main thread, between its own instructions. A long op therefore resumes the
generator of this module several times a second (csrc/common/signals.h).
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from typing import Any


class _Raised(threading.local):
    """Exception of a handler that ran during an op of this thread."""

    error: BaseException | None = None


_RAISED = _Raised()


def _run_handlers() -> Iterator[int]:
    """Generator that runs the handlers of pending signals at each `next`, and yields whether one of them has raised.

    A generator, because Python runs handlers where code begins or is resumed: a function would raise before it entered
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
    """Let the ops of a library run handlers from now on; libraries of earlier sources delay signals."""
    run_handlers = getattr(library, f"torch_mpm_run_handlers_{backend}", None)
    if run_handlers is not None:
        run_handlers(_CALLBACK)


def interruptible(call: Any, *arguments: Any) -> Any:
    """`call(*arguments)` of an op that checks signals.

    Raises:
        BaseException: raised by the handler of a signal during the call, such as KeyboardInterrupt.
    """
    _RAISED.error = None
    try:
        return call(*arguments)
    except RuntimeError:
        if _RAISED.error is None:
            raise
        error, _RAISED.error = _RAISED.error, None
    raise error
