"""Files of frames, written by threads while the next frames are computed."""

from __future__ import annotations

import os
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from ..data.host_copies import Copier, Copies
from ..errors import check_count
from .gaussians import Gaussians, check_gaussians
from .ply import rows_of, write_rows


class _Frame(NamedTuple):
    """Rows of a file and their sum, whose copies may be pending."""

    path: Path
    harmonics: int
    copies: Copies


class FrameWriter:
    """Context in which the PLY files of frames are written by threads while the next frames are computed.

        with splats.FrameWriter() as files:
            for k in range(100):
                state = mpm.rollout(step, state, 20, dt)
                files.write(f"{k:05d}.ply", splats.moved(mug, state))

    The files are those of `torch_mpm.splats.write`: each appears when it is complete. All are on the disk when the
    context ends. Rows of files are assembled on the device of the Gaussians and copied to pinned memory on a separate
    stream, so that the host does not wait for a GPU.

    An exception in the context is raised when the frames before it are written. Ctrl-C and other exceptions that are no
    `Exception` discard frames whose files are not begun, and wait for the others.

    Args:
        threads: number of files that are written at the same time.
        most: largest number of frames in memory; `write` waits for the file of an earlier one.

    Raises:
        ValueError, TypeError: for a number that is not a whole number of 1 or more.
        OSError, ValueError: of the file of a frame, as `torch_mpm.splats.write`, from the next call of `write` or at
            the end of the context. Frames whose files are not begun are discarded.
    """

    def __init__(self, threads: int = 4, most: int = 8) -> None:
        check_count("threads", threads, 1)
        check_count("most", most, 1)
        self.threads, self.most = threads, most
        self._copier = Copier()
        self._room = threading.BoundedSemaphore(most)
        self._frames: deque[_Frame] = deque()
        self._paths: set[Path] = set()
        self._error: BaseException | None = None
        self._executor: ThreadPoolExecutor | None = None

    def __enter__(self) -> FrameWriter:
        if self._executor is not None:
            raise RuntimeError("the context of this FrameWriter has begun already; make another one")
        self._executor = ThreadPoolExecutor(self.threads, "torch_mpm splats")
        return self

    def write(self, path: str | os.PathLike[str], gaussians: Gaussians) -> None:
        """Queue the file of a frame; the Gaussians may change after the return.

        Raises:
            RuntimeError: outside of the context.
            TypeError: for anything but `Gaussians`.
            ValueError: for the path of an earlier frame.
            OSError, ValueError: of the file of an earlier frame.
        """
        if self._executor is None:
            raise RuntimeError("frames are written in the context of a FrameWriter, as in: with FrameWriter() as files")
        check_gaussians(gaussians)
        target = Path(path)
        place = target.parent.resolve() / target.name
        if place in self._paths:
            raise ValueError(f"path must be another one for each frame, got {target} twice")
        self._room.acquire()
        try:
            self._raise()
            frame = self._begun(target, gaussians)
        except BaseException:
            self._room.release()
            raise
        self._paths.add(place)
        self._frames.append(frame)
        self._executor.submit(self._work)

    def _begun(self, path: Path, gaussians: Gaussians) -> _Frame:
        rows = rows_of(gaussians)
        copies = self._copier.begin({"rows": rows, "sum": rows.sum()})
        return _Frame(path, gaussians.harmonics.shape[1], copies)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._executor is not None
        executor, self._executor = self._executor, None
        stopped = error is not None and not isinstance(error, Exception)
        try:
            executor.shutdown(cancel_futures=stopped)
        except BaseException:  # Ctrl-C during the wait.
            executor.shutdown(cancel_futures=True)
            raise
        finally:
            self._frames.clear()  # Pinned memory must not outlive CUDA.
        if not stopped and error is not self._error:
            self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        """Write the next file, and release its memory before there is room for another frame."""
        try:
            self._write_one(self._frames.popleft())
        except BaseException as error:
            self._error = self._error or error
        finally:
            self._room.release()

    def _write_one(self, frame: _Frame) -> None:
        if self._error is None:
            found = frame.copies.arrays()
            write_rows(frame.path, found["rows"], float(found["sum"]), frame.harmonics)
