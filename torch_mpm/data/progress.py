"""Progress bar over the frames of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from .. import optional

Progress = Callable[[int, int], None]
"""Called with the number of a complete frame and the number of all frames."""


def tqdm() -> Any:
    return optional.load("tqdm", "the progress bar, which --quiet disables", "scene").tqdm


@contextlib.contextmanager
def frame_bar(content: str, quiet: bool = False) -> Iterator[Progress | None]:
    """Bar that the yielded function advances; None for a quiet command.

    Args:
        content: what is made of each frame, such as "pictures".
        quiet: show no bar.
    """
    if quiet:
        yield None
        return
    make, bars = tqdm(), contextlib.ExitStack()
    shown: list[Any] = []

    def advance(frame: int, frames: int) -> None:
        if not shown:  # A command that fails before its first frame prints its error alone.
            shown.append(bars.enter_context(make(desc=content, unit="frame", total=frames)))
        shown[0].update(frame + 1 - shown[0].n)

    with bars:
        yield advance
