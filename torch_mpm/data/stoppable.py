"""A single-thread executor whose running task can be stopped, so that a program ends soon after Ctrl-C."""

from __future__ import annotations

import ctypes
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

WAITS = tuple(0.02 * 2**k for k in range(9))
"""Times for which `stop` waits for the end of a task after each exception [s]."""


class Stopped(BaseException):
    """Raised inside a task that is stopped."""


class StoppableExecutor(ThreadPoolExecutor):
    """One thread for tasks without side effects, which `stop` ends between two Python instructions."""

    def __init__(self, name: str = "") -> None:
        super().__init__(1, name)
        self._turn = threading.Lock()
        self._working: int | None = None
        self._idle = threading.Event()
        self._idle.set()

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        return super().submit(self._work, work, *arguments, **options)

    def stop(self) -> None:
        """Cancel pending tasks, raise `Stopped` in the running one and wait for its end, at most the sum of `WAITS`.

        Python drops exceptions in destructors and in callbacks of weak references, so that `Stopped` is raised again.
        """
        self.shutdown(wait=False, cancel_futures=True)
        hook = sys.unraisablehook
        sys.unraisablehook = lambda dropped: None if dropped.exc_type is Stopped else hook(dropped)
        try:
            for seconds in WAITS:
                self._raise()
                if self._idle.wait(seconds):
                    break
        finally:
            sys.unraisablehook = hook

    def _raise(self) -> None:
        with self._turn:
            if self._working is not None:
                raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc
                raise_in(ctypes.c_ulong(self._working), ctypes.py_object(Stopped))

    def _work(self, work: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        with self._turn:
            self._working = threading.get_ident()
            self._idle.clear()
        try:
            return work(*arguments, **options)
        finally:
            try:
                self._leave()
            finally:
                self._leave()  # `stop` may have raised in the first call

    def _leave(self) -> None:
        """From now on `stop` does not raise."""
        with self._turn:
            self._working = None
            self._idle.set()
