"""Access to the folder of a data set: one configuration per folder, one process at a time per shard.

A process locks the byte of its shard in the file ``lock``. The lock ends with the process, however it ends. File
systems without locks do not exclude other processes; then each process generates the shards of its rank only.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from ..errors import DamagedFileError
from ..scene.folder import OutputError
from ..scene.folder import output_errors as folder_errors
from .folder import DATASET, LINKED, DatasetRecord
from .shard import Shard, ShardRecord, record_path, shard_path
from .whole_files import check_inside, remove_leftovers, write_whole
from .workers import Worker

CONFIGURATION, LOCK = "config.toml", "lock"
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
TABLE = 2**40
"""Byte that is locked during the claim of the folder, beyond those of all shards."""


def output_errors(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Errors that prevent this process from writing in a folder, as an OutputError."""
    kept = "The shards written so far are complete; free some space and generate again to continue"
    return folder_errors(folder, kept)


class Claim:
    """Folder that a process works in: ``with Claim(folder, record, text, worker) as claim``.

    Args:
        folder: created where it does not exist.
        record: its present or future content. `record` of the claim is that of the folder, which may have been
            extended.
        extend: total number of scenes by the name of a split, to extend the folder.
        text: text of the configuration.
        worker: this process.

    Raises:
        OutputError: for a folder with other content, or that cannot be written.
        DamagedFileError: for a damaged dataset.json, and for links out of the folder.
        MissingError, DatasetError: for `extend` with an unknown split, or with fewer scenes than there are.
    """

    def __init__(
        self, folder: Path, record: DatasetRecord, text: str, worker: Worker, extend: Mapping[str, int] | None = None
    ) -> None:
        self.folder, self.record, self.worker = folder, record, worker
        self._text, self._whole, self._extend = text, set[tuple[int, bool]](), extend or {}
        self._lock: IO[Any] | None = None
        self._locks = True

    def __enter__(self) -> Claim:
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{self.folder} is a file; choose a folder for the output")
        with output_errors(self.folder):
            self._refuse_others()
            (self.folder / "shards").mkdir(parents=True, exist_ok=True)
            for name in ("shards", LOCK):
                check_inside(self.folder, self.folder / name, LINKED)
            self._lock = open(self.folder / LOCK, "a+b")
            try:
                self._locked(TABLE, wait=True)
                self._refuse_others()
                for own in (self.folder, self.folder / "shards"):
                    remove_leftovers(own)
                if (self.folder / DATASET).exists():
                    self.record = DatasetRecord.read(self.folder)
                else:
                    write_whole(self.folder / CONFIGURATION, self._text.encode())
                    self.record.write(self.folder)
                if (extended := self.record.extended(self._extend)) != self.record:
                    self.record = extended
                    self.record.write(self.folder)
                self._unlock(TABLE)
            except BaseException:
                self._lock.close()
                raise
        return self

    def __exit__(self, *error: Any) -> None:
        assert self._lock is not None
        self._lock.close()

    def _refuse_others(self) -> None:
        """Raise for a folder with anything else than this data set."""
        if not self.folder.exists():
            return
        if not (self.folder / DATASET).is_file():
            known = (LOCK, CONFIGURATION, "shards")
            others = [p.name for p in self.folder.iterdir() if p.name not in known and p.suffix != ".building"]
            if others or next((self.folder / "shards").glob("shard_*"), None) is not None:
                raise OutputError(f"{self.folder} holds files that are no data set of torch_mpm; choose another folder")
            return
        found = DatasetRecord.read(self.folder)
        if found.configuration != self.record.configuration:
            raise OutputError(
                f"{self.folder} holds the data set of another configuration ({found.configuration[:12]}, this is "
                f"{self.record.configuration[:12]}); choose another folder, or remove it first. To add scenes, "
                "use --extend SPLIT=N with the configuration as it was"
            )
        ours, theirs = (r.versions.get("torch_mpm") for r in (self.record, found))
        if theirs != ours:
            raise OutputError(
                f"{self.folder} holds a data set that was begun with torch_mpm {theirs}, and this is {ours}, whose "
                f"results may differ; use version {theirs}, or choose another folder"
            )
        if found.device != self.record.device:
            raise OutputError(
                f"{self.folder} holds a data set that was begun on {found.device}, and process {self.worker.rank} of "
                f"{self.worker.size} would continue it on {self.record.device}, where results differ by rounding; "
                f'use device "{found.device}", or choose another folder'
            )

    # -- shards

    def unfinished(self, check: bool = False) -> Iterator[int]:
        """Shards that are neither finished nor locked by another process, each locked when it is yielded; `release` it.

        Args:
            check: compare finished shards with their checksums, and yield damaged ones.
        """
        count, rank, size = self.record.shards, self.worker.rank, self.worker.size
        own = range(rank, count, size)
        others = [k for k in range(count) if k % size != rank]
        for k in [*own, *others]:
            if self.is_finished(k, check) or (k not in own and not self._locks) or not self._locked(k):
                continue
            if self.is_finished(k, check):  # Finished by another process in the meantime.
                self.release(k)
                continue
            self._clean(k)
            yield k

    def release(self, shard: int) -> None:
        self._unlock(shard)

    def is_finished(self, shard: int, check: bool = False) -> bool:
        """Whether a shard has a record and a file of the length in it, or with `check` its scenes and these bytes."""
        if (shard, check) in self._whole:
            return True
        path = shard_path(self.folder, shard)
        for own in (path, record_path(path)):
            check_inside(self.folder, own, LINKED)
        try:
            record = ShardRecord.read(record_path(path))
            good = path.stat().st_size == record.bytes
            if good and check:
                Shard(path, check=True).close()
                good = not record.difference(self.record.configuration, self.record.ids(shard))
        except (FileNotFoundError, DamagedFileError):
            return False
        if good:
            self._whole.add((shard, check))
        return good

    def finished(self) -> list[int]:
        """The finished shards."""
        return [k for k in range(self.record.shards) if self.is_finished(k)]

    def finished_scenes(self) -> int:
        """Number of the scenes in finished shards."""
        return sum(len(self.record.ids(k)) for k in self.finished())

    def _clean(self, shard: int) -> None:
        """Remove the remains of an incomplete shard."""
        path = shard_path(self.folder, shard)
        record_path(path).unlink(missing_ok=True)
        for name in (path.name, record_path(path).name):
            for building in path.parent.glob(f".{name}.*.building"):
                building.unlink(missing_ok=True)

    def _locked(self, byte: int, wait: bool = False) -> bool:
        """Lock a byte of the lock; returns whether this succeeded."""
        assert self._lock is not None
        if not self._locks:
            return True
        try:
            fcntl.lockf(self._lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, byte, os.SEEK_SET)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):
                return False
            if error.errno not in NO_LOCKS:
                raise
            self._locks = False
        return True

    def _unlock(self, byte: int) -> None:
        assert self._lock is not None
        if self._locks:
            fcntl.lockf(self._lock, fcntl.LOCK_UN, 1, byte, os.SEEK_SET)
