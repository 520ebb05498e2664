"""Checks of the files that users name: regular files of a bounded size, so that no read is unbounded."""

from __future__ import annotations

import os
import stat
from pathlib import Path

LARGEST_TEXT = 2**24
"""Size of the largest scene file or configuration [bytes]."""
LARGEST = 2**32
"""Size of the largest file of points or of a mesh [bytes]."""
VARIABLE = "TORCH_MPM_LARGEST_FILE"
"""Environment variable with a number of bytes that raises both limits."""
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def check_file(
    path: str | os.PathLike[str], kind: str, largest: int | None = LARGEST, may_be_empty: bool = False
) -> None:
    """Raise unless a path is a readable regular file of bounded size that is not empty. Links are followed.

    Args:
        path: the file.
        kind: its content, for messages, such as "mesh".
        largest: maximum size [bytes], None for any; a larger `TORCH_MPM_LARGEST_FILE` in the environment overrides it.
        may_be_empty: accept an empty file, as for records, whose reader reports it as damaged.

    Raises:
        OSError: with the path; also as FileNotFoundError, IsADirectoryError or PermissionError.
        TypeError: for anything but a path.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"{kind} file must be given by its path, got {type(path).__name__}")
    try:
        status = os.stat(path)
        if stat.S_ISREG(status.st_mode):
            open(path, "rb").close()
    except FileNotFoundError:
        raise FileNotFoundError(f"{kind} file {path} does not exist") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the name.
        raise PermissionError(f"{kind} file {path} cannot be read: {error}") from None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(f"{kind} file {path} is a folder")
    if not stat.S_ISREG(status.st_mode):
        found = KINDS.get(stat.S_IFMT(status.st_mode), "of another kind")
        raise OSError(f"{kind} file {path} is {found}, not a regular file")
    if not (status.st_size or may_be_empty):
        raise OSError(f"{kind} file {path} is empty")
    if largest is not None and status.st_size > (limit := max(largest, _raised_limit())):
        raise OSError(
            f"{kind} file {path} is too large: {status.st_size} bytes, where {limit} are allowed; "
            f"the environment variable {VARIABLE} raises the limit"
        )


def read_text(path: str | Path, kind: str) -> str:
    """The text of a scene file or a configuration, UTF-8, of at most `LARGEST_TEXT` bytes; see `check_file`.

    Raises:
        OSError: as `check_file`.
        UnicodeDecodeError: for a file that is not UTF-8.
    """
    check_file(path, kind, LARGEST_TEXT)
    return Path(path).read_text(encoding="utf-8-sig")  # Editors of Windows write a byte order mark.


def _raised_limit() -> int:
    text = os.environ.get(VARIABLE, "0")
    if not text.isdecimal():
        raise ValueError(f"the environment variable {VARIABLE} must be a number of bytes, got {text!r}")
    return int(text)
