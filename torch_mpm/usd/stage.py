"""A USD file in progress: its frames are moved to the disk as they accumulate, so that memory is bounded."""

from __future__ import annotations

import contextlib
import errno
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import optional
from ..data.trajectory import Array
from ..data.whole_files import replacing

SUFFIXES = (".usdc", ".usda", ".usd")
SAVED_BYTES = 2**26
"""Size of the frames that are kept in memory [bytes]. Each move to the disk repeats the index of the file."""
MESSAGE = re.compile(r"'(?:Error occurred writing file: |: )?([^'\n]{1,200})'\s*$", re.MULTILINE)
"""Message in a line of an error of USD."""
PURPOSE, EXTRA = "USD files", "usd"


class UsdError(ValueError):
    """A run or options without a USD file."""


def pxr(module: str) -> Any:
    """A module of USD, such as "UsdGeom"."""
    return optional.load(f"pxr.{module}", PURPOSE, EXTRA)


class Stage:
    """A USD stage in a new file.

    Attributes:
        stage: the `Usd.Stage`.
        frame: the time code of the values that are set.
    """

    def __init__(self, path: Path, rate: float, last: int, up: str, title: str) -> None:
        """
        Args:
            path: the file, whose suffix decides the format.
            rate: time codes per second; a frame is a time code.
            last: number of the last frame.
            up: upward axis, "Y" or "Z".
            title: documentation of the file.

        Raises:
            OSError: when USD cannot create it.
        """
        try:
            self.stage = pxr("Usd").Stage.CreateNew(str(path))
        except pxr("Tf").ErrorException as failure:
            raise OSError(errno.EIO, _reason(failure), str(path)) from failure
        self.stage.SetStartTimeCode(0)
        self.stage.SetEndTimeCode(last)
        self.stage.SetTimeCodesPerSecond(rate)
        self.stage.SetFramesPerSecond(rate)
        pxr("UsdGeom").SetStageUpAxis(self.stage, up)
        pxr("UsdGeom").SetStageMetersPerUnit(self.stage, 1.0)
        if title:
            self.stage.GetRootLayer().documentation = title
        self._path, self._unsaved = path, 0

    def set(self, attribute: Any, values: Array, frame: int | None = None) -> None:
        """Set an array attribute in its USD type, at a frame or for all times."""
        typed = array_of(attribute, values)
        attribute.Set(typed) if frame is None else attribute.Set(typed, float(frame))
        self._unsaved += values.nbytes
        if self._unsaved > SAVED_BYTES:
            self.save()

    def save(self) -> None:
        """Move all values to the disk.

        Raises:
            OSError: when USD cannot write them.
        """
        error = pxr("Tf").ErrorException
        try:
            saved = self.stage.GetRootLayer().Save()
        except error as failure:
            raise OSError(errno.EIO, _reason(failure), str(self._path)) from failure
        if not saved:
            raise OSError(errno.EIO, "USD cannot write the file", str(self._path))
        self._unsaved = 0


def _reason(error: Exception) -> str:
    """The first message of USD. A message is a line that ends with a quoted text."""
    found = MESSAGE.search(str(error))
    return f"USD cannot write the file: {found[1]}" if found else "USD cannot write the file"


@contextlib.contextmanager
def new_stage(path: Path, **words: Any) -> Iterator[Stage]:
    """A stage whose file appears under its name when the block succeeds; arguments as `Stage`.

    Raises:
        OSError: when the file cannot be written; nothing remains of it.
    """
    with replacing(path) as building:
        stage = Stage(building, **words)
        yield stage
        stage.save()
        del stage


def array_of(attribute: Any, values: Array) -> Any:
    """An array in the type of a USD attribute: float3[], int64[], ..."""
    vt, name = pxr("Vt"), str(attribute.GetTypeName())
    kinds = {
        "int[]": (vt.IntArray, np.int32),
        "int64[]": (vt.Int64Array, np.int64),
        "float[]": (vt.FloatArray, np.float32),
        **dict.fromkeys(
            ("point3f[]", "vector3f[]", "normal3f[]", "color3f[]", "float3[]"), (vt.Vec3fArray, np.float32)
        ),
    }
    kind, dtype = kinds[name]
    return kind.FromNumpy(np.ascontiguousarray(values, dtype))


def child_path(parent: str, name: str) -> str:
    """Path of a prim, whose name is made valid."""
    return f"{parent}/{pxr('Tf').MakeValidIdentifier(name)}"
