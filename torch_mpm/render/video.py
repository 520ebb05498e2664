"""MP4 files (H.264, yuv420p) by the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import IO

import numpy as np

from ..data.whole_files import replacing
from ..interrupts import held_signals
from .images import check_image, read_png
from .requires import RenderError, require
from .shapes import Array


class VideoWriter:
    """Write frames to `path` as H.264 at `fps` frames per second; use as a context manager.

    The file appears under its name when the writer closes without an error; until then, and after a kill, it does
    not exist there. Frames are uint8 [H, W, 3] of one size; an odd last row or column is repeated, as H.264 with
    halved chroma needs even sizes. `quality` is x264's constant rate factor (18 looks lossless, 28 is small).
    """

    def __init__(self, path: str | os.PathLike[str], fps: float, quality: int = 20) -> None:
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}")
        self.path, self.fps, self.quality = os.fspath(path), fps, quality
        self.frames = 0
        self._ffmpeg = require("imageio_ffmpeg").get_ffmpeg_exe()
        self._cleanup = ExitStack()
        self._shape: tuple[int, ...] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._abandon(kind, error, trace)
            return
        try:
            self.close()
        except BaseException as interrupted:
            self._abandon(type(interrupted), interrupted, None)
            raise

    def append(self, frame: Array) -> None:
        """Add one frame, uint8 [H, W, 3]."""
        if self._process is None:
            self._start(check_image("frame", frame))
        if frame.shape != self._shape:
            raise ValueError(f"frame must have shape {list(self._shape or ())} like the first, got {list(frame.shape)}")
        assert self._process is not None and self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(_even(frame)).tobytes())
        except BrokenPipeError:
            raise self._failure() from None
        self.frames += 1

    def close(self) -> None:
        """Finish the file and rename it. Raises RenderError when there is no frame or the encoder failed."""
        if self._process is None:
            raise RenderError(f"{self.path}: a video needs at least one frame")
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            raise self._failure() from None
        if self._process.wait() != 0:
            raise self._failure()
        self._process = None
        self._cleanup.close()

    def _start(self, frame: Array) -> None:
        temporary = self._cleanup.enter_context(replacing(self.path))
        self._log = self._cleanup.enter_context(tempfile.TemporaryFile())
        self._shape = frame.shape
        height, width = _even(frame).shape[:2]
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{self.fps}", "-i", "-"]
        codec = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", f"{self.quality}", "-preset", "medium"]
        command = [self._ffmpeg, "-y", "-loglevel", "error", *source, "-an", *codec, "-movflags", "+faststart"]
        words = [*command, "-f", "mp4", str(temporary)]
        with held_signals():  # Otherwise an encoder could start that is never stopped.
            self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=self._log)

    def _failure(self) -> RenderError:
        assert self._process is not None and self._log is not None
        self._process.wait()
        self._log.seek(0)
        message = self._log.read().decode(errors="replace").strip()
        error = RenderError(f"{self.path}: the video encoder failed: {message or self._process.returncode}")
        self._abandon(RenderError, error, None)
        return error

    def _abandon(self, kind: type[BaseException], error: BaseException | None, trace: TracebackType | None) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._process = None
        self._cleanup.__exit__(kind, error, trace)


def _even(frame: Array) -> Array:
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge") if height % 2 or width % 2 else frame


def assemble_video(png_paths: Sequence[str | os.PathLike[str]], out: str | os.PathLike[str], fps: float) -> None:
    """Encode PNG files, in the order given, into the MP4 file `out`."""
    with VideoWriter(out, fps) as video:
        for path in png_paths:
            video.append(read_png(path))
