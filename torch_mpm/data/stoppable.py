"""A single-thread executor whose running task can be stopped, so that a program ends soon after Ctrl-C."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class Stopped(BaseException):
    """Raised inside a task that is stopped."""


class StoppableExecutor(ThreadPoolExecutor):
    """One thread for tasks without side effects, which `stop` ends between two Python instructions."""

    def __init__(self, name: str = "") -> None:
        super().__init__(1, name)
        self._turn = threading.Lock()
        self._working: int | None = None

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **options: Any) -> Future[Any]:
        return super().submit(self._work, work, *arguments, **options)

    def stop(self) -> None:
        """Cancel pending tasks and raise `Stopped` in the running one, without waiting for its end."""
        self.shutdown(wait=False, cancel_futures=True)
        with self._turn:
            if self._working is not None:
                raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc
                raise_in(ctypes.c_ulong(self._working), ctypes.py_object(Stopped))

    def _work(self, work: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        with self._turn:
            self._working = threading.get_ident()
        try:
            return work(*arguments, **options)
        finally:
            with self._turn:  # the last place where `stop` can raise: the future still catches it
                self._working = None
