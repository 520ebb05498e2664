"""Peak memory of some work, measured in four ways."""

from __future__ import annotations

import gc
import os
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from .. import common

Work = Callable[[], Any]


class LiveTensors(TorchDispatchMode):
    """Largest sum of the sizes of living tensors that ops have returned [bytes]."""

    def __init__(self) -> None:
        super().__init__()
        self.now, self.most = 0, 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        for t in tree_leaves(result):
            if isinstance(t, Tensor) and t.untyped_storage()._cdata not in self._known:
                storage = t.untyped_storage()
                self._known.add(storage._cdata)
                self.now += storage.nbytes()
                self.most = max(self.most, self.now)
                weakref.finalize(storage, self._gone, storage._cdata, storage.nbytes())
        return result

    def _gone(self, key: int, size: int) -> None:
        self._known.discard(key)
        self.now -= size


def of_returned_tensors(work: Work) -> int:
    """Memory of tensors that ops return, on any device; internal memory of ops is not included [bytes]."""
    with LiveTensors() as tensors:
        work()
    return tensors.most


def of_host_allocator(work: Work) -> int:
    """Memory of PyTorch's allocator on the host, also within ops [bytes].

    Tensors of ops of 1 MiB or more are not included: the CPU library has an allocator of its own for these
    (csrc/cpu/memory_cache.h).
    """
    gc.collect()
    with torch.profiler.profile(activities=[ProfilerActivity.CPU], profile_memory=True, acc_events=True) as profile:
        work()
    events, allocations = list(profile.profiler.kineto_results.experimental_event_tree()), []
    while events:
        event = events.pop()
        events += event.children
        if event.name == "[memory]":
            fields = event.extra_fields
            allocations.append((event.start_time_ns, fields.total_allocated, fields.alloc_size))
    _, total, size = min(allocations, default=(0, 0, 0))
    return max((now for _, now, _ in allocations), default=0) - (total - size)


def of_cuda(work: Work) -> int:
    """Memory of PyTorch's allocator on CUDA, above that allocated before [bytes]."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    work()
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() - before


class Resident:
    """Resident memory of this process, above that at the creation of this object [bytes].

    Memory that allocators retain from earlier work counts, unless it was reused. Needs Linux's /proc/self/clear_refs.
    """

    available = os.access("/proc/self/clear_refs", os.W_OK)

    def __init__(self) -> None:
        common.release_memory()
        self._before = self._read("VmRSS")

    def peak(self, work: Work) -> int:
        gc.collect()
        common.release_memory()
        Path("/proc/self/clear_refs").write_text("5")  # The peak is now the present memory.
        work()
        return self._read("VmHWM") - self._before

    @staticmethod
    def _read(name: str) -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        (kilobytes,) = (line.split()[1] for line in lines if line.startswith(f"{name}:"))
        return 1024 * int(kilobytes)
