"""Changes of the process during a run: signals, and the switching interval of threads."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

from ..interrupts import RaiseLater, alarm

FRAME_SECONDS = 0.5
"""Time limit of the current frame after a signal [s]; a frame that takes longer is discarded."""
SWITCH_SECONDS = 1e-4
"""Switching interval of threads that are busy in Python [s]."""


class StopSignals:
    """Context manager in which SIGINT and SIGTERM request a stop after the frame; a second SIGINT stops at once.

    A signal after the last frame is sent again at the end of the context.

    Attributes:
        signal: number of the last signal; 0 for none.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._raise_later: RaiseLater | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        with contextlib.suppress(ValueError):  # Only the main thread may handle signals.
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        if self.signal and kind is None:
            signal.raise_signal(self.signal)

    @contextlib.contextmanager
    def within_frames(self) -> Iterator[None]:
        """Context in which a signal raises KeyboardInterrupt after `FRAME_SECONDS`, unless the frame ends before."""
        with alarm() as self._raise_later:
            try:
                yield
            finally:
                self._raise_later = None

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.signal and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = number
        if self._raise_later is not None:
            self._raise_later(KeyboardInterrupt, FRAME_SECONDS)


@contextlib.contextmanager
def prompt_turns() -> Iterator[None]:
    """Let a thread that has waited for a device continue soon, and launch work, although the writer is busy: not after
    the default 5 ms of Python, in which a device computes hundreds of substeps.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, SWITCH_SECONDS))
    try:
        yield
    finally:
        sys.setswitchinterval(before)
