"""Signals that are deferred to the end of a block, and exceptions that are raised in the main thread after a delay."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

RaiseLater = Callable[[type[BaseException], float], None]
"""Function of an exception class and the delay until it is raised [s]; each call replaces the previous one."""


@contextlib.contextmanager
def alarm() -> Iterator[RaiseLater]:
    """Return a function that raises an exception in the main thread after a delay, unless the context has ended.

    The function uses SIGALRM. Call it in the main thread; signal handlers may call it, where threads cannot be started.
    """
    previous: list[Any] = []

    def raise_later(error: type[BaseException], seconds: float) -> None:
        def ring(number: int, frame: FrameType | None) -> None:
            raise error

        before = signal.signal(signal.SIGALRM, ring)
        previous.append(before)
        signal.setitimer(signal.ITIMER_REAL, seconds)

    try:
        yield raise_later
    finally:
        if previous:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, previous[0])


@contextlib.contextmanager
def held_signals() -> Iterator[None]:
    """Defer SIGINT and SIGTERM to the end of the context. Outside the main thread nothing changes."""
    came: list[int] = []
    previous: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # not the main thread, which alone may handle signals
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for held, handler in previous.items():
            signal.signal(held, handler)
        if came:
            signal.raise_signal(came[0])
