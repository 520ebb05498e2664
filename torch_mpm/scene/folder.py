"""Folder of a run: ownership, locks, its record run.json, and full disks."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..data.hdf5 import h5py_module
from ..data.host_memory import in_words
from ..data.trajectory import COMPLETE, PARTIAL, Layout, Trajectory, create, find
from ..data.whole_files import check_inside, check_record, write_record
from ..errors import DamagedFileError, is_finite
from ..files import check_file
from .scene import Scene

RUN, CHECKPOINT, LAST_GOOD, LOCK = "run.json", "checkpoint.h5", "last_good.h5", "run.lock"
SUMMARY = "summary"
KINDS = {"fingerprint": str, "scene": dict, "folder": str, SUMMARY: dict}
"""Types of the entries of a record of a run, and of its final summary."""
SUMMARY_NUMBERS = ("frames", "particles", "substeps", "mass_drift", "largest_cfl", "particles_lost")
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
REMEDY = "choose another folder, or remove this one"


class OutputError(RuntimeError):
    """The output folder cannot be used, or its disk is full."""


def claim(folder: Path, fingerprint: str, resume: bool) -> None:
    """Refuse a folder with anything else than an unfinished run of this scene that is to be resumed."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; choose a folder for the output")
    # A lock, and a file in progress when a run was killed, do not count.
    if not folder.exists() or all(p.name == LOCK or p.suffix == ".building" for p in folder.iterdir()):
        return
    _check_links(folder)
    if not (folder / RUN).is_file():
        raise OutputError(f"{folder} holds files that are not a run of torch_mpm; choose an empty or a new folder")
    if read_run(folder)["fingerprint"] != fingerprint:
        raise OutputError(f"{folder} holds the run of another scene; choose another folder, or remove it first")
    if (folder / COMPLETE).exists():
        raise OutputError(f"{folder} holds the complete run of this scene; choose another folder, or remove it first")
    if not resume:
        raise OutputError(
            f"{folder} holds an unfinished run of this scene; add --resume to continue, or remove it first"
        )


def _check_links(folder: Path) -> None:
    """Refuse a folder with links to files or folders elsewhere: a received folder must not name files to be read or
    written.

    Raises:
        DamagedFileError: for such a link.
    """
    for path in folder.iterdir():
        check_inside(folder, path, REMEDY)


def finished(folder: Path, fingerprint: str) -> dict[str, Any] | None:
    """Summary of a complete run of a scene; None where there is none. Empty where a kill prevented its writing.

    Frames are not read: their checksums are compared when they are used.

    Raises:
        DamagedFileError: for a damaged record, and for a trajectory that is damaged or of another run.
        OSError: for a trajectory that cannot be read.
    """
    if not (folder / RUN).is_file() or not os.path.lexists(folder / COMPLETE):
        return None
    record = read_run(folder)
    if record["fingerprint"] != fingerprint:
        return None
    _check_trajectory(folder / COMPLETE, fingerprint)
    summary: dict[str, Any] = record.get(SUMMARY, {})
    return summary


def _check_trajectory(path: Path, fingerprint: str) -> None:
    check_file(path, "trajectory", largest=None, may_be_empty=True)
    with Trajectory(path) as trajectory:
        if trajectory.attributes.get("fingerprint") != fingerprint:
            raise DamagedFileError(path, f"is not the trajectory of the run in {RUN}", REMEDY)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create a folder and exclude other processes from it. The lock ends with this process, however it ends.

    A file system without locks (some network file systems) does not exclude other processes.

    Raises:
        OutputError: when another process runs in the folder.
        DamagedFileError: where links lead out of the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _check_links(folder)
    with open(folder / LOCK, "w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"another process is working in {folder}; wait until it has finished, or choose another folder"
            ) from None
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL):
                raise
        yield


def prepare(folder: Path, scene: Scene, layout: Layout, fingerprint: str) -> None:
    """Write the record and the empty trajectory of a run, where they do not exist."""
    if not (folder / RUN).exists():
        words = json.loads(scene.model_dump_json())
        write_record(folder / RUN, {"fingerprint": fingerprint, "scene": words, "folder": str(scene.folder.resolve())})
    if not (folder / PARTIAL).exists():
        (folder / CHECKPOINT).unlink(missing_ok=True)
        free = shutil.disk_usage(folder).free
        if layout.bytes > free:
            raise OutputError(
                f"the trajectory needs {in_words(layout.bytes)} in {folder}, where {in_words(free)} are free; "
                "free some space, lower fps or remove output.fields"
            )
        create(folder / PARTIAL, layout)


KEPT = "The frames written so far are complete; free some space and add --resume to continue"


@contextlib.contextmanager
def output_errors(folder: Path, kept: str = KEPT) -> Iterator[None]:
    """Errors that prevent this process from writing in a folder, as an OutputError; `kept` names what remains on a full
    disk.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno not in FULL:
            raise OutputError(f"cannot use {error.filename or folder} for the output: {reason}") from error
        raise OutputError(f"no room on the disk of {folder}: {reason}. {kept}") from error


# ---- run.json


def read_run(folder: Path) -> dict[str, Any]:
    """The record of a run: its ``fingerprint``, ``scene``, ``folder`` (of the scene file), and ``summary`` at its end.

    Raises:
        DamagedFileError: for a record that was changed.
        OSError: for a record that cannot be read.
    """
    path = folder / RUN
    check_file(path, "run", may_be_empty=True)
    try:
        values = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(path, f"is damaged ({error})", REMEDY) from None
    if not isinstance(values, dict):
        raise DamagedFileError(path, "is no record of a run", REMEDY)
    check_record(values, path, REMEDY)
    if missing := [name for name in KINDS if name not in values and name != SUMMARY]:
        raise DamagedFileError(path, f"lacks {', '.join(missing)}", REMEDY)
    if wrong := [name for name, kind in KINDS.items() if name in values and not isinstance(values[name], kind)]:
        raise DamagedFileError(path, f"has {wrong[0]} = {values[wrong[0]]!r:.100}", REMEDY)
    if SUMMARY in values and not _is_summary(values[SUMMARY]):
        raise DamagedFileError(path, f"has a {SUMMARY} that is none", REMEDY)
    return values


def _is_summary(words: dict[str, Any]) -> bool:
    """Whether the entries of a summary exist and are numbers; only times where a kill has removed the rest."""
    seconds, energy = words.get("seconds"), words.get("energy", {})
    if not (isinstance(seconds, dict) and isinstance(energy, dict)):
        return False
    numbers = list(seconds.values())
    if words.keys() != {"seconds"}:
        numbers += [words.get(name) for name in SUMMARY_NUMBERS] + [energy.get(name) for name in ("first", "last")]
    return all(is_finite(n) for n in numbers)


def record_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Store the summary of a run with its scene in run.json.

    Raises:
        OutputError: when the disk is full.
    """
    with output_errors(folder):
        write_record(folder / RUN, {**read_run(folder), SUMMARY: summary})


def load_run(folder: str | Path, overrides: list[str] | None = None) -> Scene:
    """The scene of a run folder, with overrides as for :meth:`Scene.load`.

    Raises:
        FileNotFoundError: when the folder has no run.
        DamagedFileError: when its record is damaged, or its trajectory is that of another scene.
    """
    folder = Path(folder)
    if not (folder / RUN).is_file():
        raise FileNotFoundError(f"there is no run in {folder}")
    _check_links(folder)
    h5py_module()
    record = read_run(folder)
    _check_trajectory(find(folder), record["fingerprint"])
    return Scene.from_words(record["scene"], overrides, Path(record["folder"]), source=str(folder / RUN))
