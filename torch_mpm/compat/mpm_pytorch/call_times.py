"""Times of calls of a solver, for calls that `torch.utils.checkpoint` recomputes in the backward pass.

A solver that counts its own time has no time for the first recomputed call. A recomputed call gets the
same tensors, or tensors that share their storage, so the time is stored by storage. Within a recomputed function of
several calls, the result of one call has the time of the next.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef

from ...cuda_graphs.capture import is_traced, version

Moment = tuple[float, int]
"""Time [s], and number of changes of the conditions."""
LEAST_ENTRIES = 256
"""Number of entries from which on those of freed storages are removed."""


def is_recomputed() -> bool:
    """Whether the code runs within a backward pass."""
    return torch._C._current_graph_task_id() != -1


class CallTimes:
    """Moments at which storages were arguments of calls."""

    def __init__(self) -> None:
        self._entries: dict[int, tuple[StorageWeakRef, int, frozenset[Moment]]] = {}
        self._limit = LEAST_ENTRIES

    def store(self, tensors: Iterable[Tensor], moment: Moment) -> None:
        """Store the moment of a call that has these arguments."""
        for t in tensors:
            if not _has_storage(t):
                continue
            storage = StorageWeakRef(t.untyped_storage())
            before = self._of(storage.cdata, t._version)
            self._entries[storage.cdata] = storage, t._version, before | {moment}
        if len(self._entries) > self._limit:
            self._entries = {k: e for k, e in self._entries.items() if not e[0].expired()}
            self._limit = max(2 * len(self._entries), LEAST_ENTRIES)

    def of(self, tensors: Iterable[Tensor]) -> frozenset[Moment]:
        """Moments at which all known ones of these tensors were arguments; empty where none is known."""
        known = [found for t in tensors if _has_storage(t) and (found := self._of(_key(t), t._version))]
        return frozenset.intersection(*known) if known else frozenset()

    def _of(self, key: int, version: int) -> frozenset[Moment]:
        entry = self._entries.get(key)
        return entry[2] if entry is not None and entry[1] == version else frozenset()


def _key(t: Tensor) -> int:
    return StorageWeakRef(t.untyped_storage()).cdata


def _has_storage(t: Tensor) -> bool:
    """Whether a tensor has memory that autograd may store, outside compilers and transforms of torch.func."""
    return not (is_traced(t) or torch._C._functorch.is_functorch_wrapped_tensor(t)) and version(t) is not None
