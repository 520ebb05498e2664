"""Exceptions that come later in the main thread: where a handler of a signal cannot wait, nor start a thread."""

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
