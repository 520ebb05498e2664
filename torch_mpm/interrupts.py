"""Signals that wait for the end of what must not be cut off, and exceptions that come later in the main thread."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

RaiseLater = Callable[[type[BaseException], float], None]
"""A function of an exception and the time until it is raised [s]; it replaces the one before."""


@contextlib.contextmanager
def alarm() -> Iterator[RaiseLater]:
    """A function that raises an exception in the main thread after some time, unless the context has ended before.

    The function is to be called in the main thread, in handlers of signals too. It uses SIGALRM.
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
    """SIGINT and SIGTERM wait for the end of the context; in other threads than the main one nothing is changed."""
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
