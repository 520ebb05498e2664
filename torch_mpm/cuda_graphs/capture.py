"""Objects that outlive a call: tensors that CUDA graphs may read, but no tensors of torch.func transforms."""

from __future__ import annotations

import collections
import contextlib
import copy
import gc
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor


def is_captured(x: Tensor) -> bool:
    """Whether operations on a tensor are captured in a CUDA graph."""
    return x.is_cuda and not torch.compiler.is_compiling() and torch.cuda.is_current_stream_capturing()


@contextlib.contextmanager
def capturing(graph: torch.cuda.CUDAGraph, memory: Any, device: torch.device) -> Iterator[None]:
    """Capture the work of the current stream into a graph with given memory; other threads continue.

    Args:
        graph: an empty graph.
        memory: the memory of another graph, as `graph.pool()`, or None for new memory.
        device: device of the stream.

    A failed capture leaves the allocator unchanged.
    """
    pool = torch.cuda.graph_pool_handle() if memory is None else memory
    try:
        with _without_garbage_collection():
            graph.capture_begin(pool, capture_error_mode="thread_local")
            yield
            graph.capture_end()
    except BaseException:
        with contextlib.suppress(RuntimeError):  # The original exception states why the capture failed.
            graph.capture_end()
        # In torch before 2.12 the allocator stays in a capture whose end failed, and reads the graph at every later
        # allocation, even when the graph is gone (pytorch #180395). Later versions refuse to end it again.
        with contextlib.suppress(RuntimeError):
            torch._C._cuda_endAllocateToPool(device.index, pool)
        raise


@contextlib.contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """A graph in a cycle of references is destroyed by the garbage collector, which invalidates a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def is_traced(x: Tensor) -> bool:
    """Whether values are those of a compiler or a fake tensor, which cannot be read."""
    return torch.compiler.is_compiling() or is_exported() or isinstance(x, torch._subclasses.FakeTensor)


def is_exported() -> bool:
    """Whether `torch.export` runs the code: written tensors outlive the export, but their values do not."""
    return torch.compiler.is_exporting()


def is_transformed() -> bool:
    """Whether a transform of torch.func, or forward differentiation, runs the code."""
    return torch._C._are_functorch_transforms_active() or torch.autograd.forward_ad._current_level >= 0


def is_eager(x: Tensor) -> bool:
    """Whether operations on a tensor run at once: neither compiled, exported, captured nor transformed."""
    if torch.compiler.is_compiling() or is_exported() or is_transformed():
        return False
    return not (isinstance(x, torch._subclasses.FakeTensor) or is_captured(x))


NUMBERS = (bool, int, float, str, torch.dtype, torch.device)
"""Types that a graph stores by value."""
_BY_VALUE = frozenset(NUMBERS)


def is_of_library(kind: type) -> bool:
    """Whether a class belongs to torch_mpm."""
    return kind.__module__.startswith("torch_mpm.")


def without_transforms(t: Tensor) -> Tensor:
    """Plain tensor below the levels of torch.func.grad and similar transforms, which may be stored after they end."""
    if torch.compiler.is_compiling():
        return t
    while torch._C._functorch.is_gradtrackingtensor(t):
        t = torch._C._functorch.get_unwrapped(t)
    return t


def outside_transforms() -> contextlib.AbstractContextManager[Any]:
    """Context in which stored tensors may be written to, which a transform of torch.func forbids."""
    active = not torch.compiler.is_compiling() and torch._C._are_functorch_transforms_active()
    return torch._C._DisableFuncTorch() if active else contextlib.nullcontext()


def version(t: Tensor) -> int | None:
    """Version counter of a tensor, which counts writes; None for tensors without one."""
    return None if t.is_inference() else t._version


def remember(kept: list[Any], value: Any) -> None:
    """Store a value, by identity, that a graph reads or writes."""
    if not any(value is known for known in kept):
        kept.append(value)


COMPARED = 2**16
"""Number of entries up to which tensors on the CPU are always compared by content. Larger tensors are compared if they
have no more entries than the tensors that a step computes with.
"""


class Remembered:
    """Tensor at a point in time, to detect later changes.

    On the CPU contents are compared. This detects every write: in place, by `.data`, by an array that shares the
    memory. On other devices, and for tensors on the CPU with more than `most` entries, the version counter and the
    address are compared, without synchronisation. Writes through `.data` and by other owners of the memory change
    neither.
    """

    def __init__(self, t: Tensor, most: int = COMPARED) -> None:
        self._tensor, self._version, self._contents = t, None, None
        if torch.compiler.is_compiling():
            return
        self._version = version(t), _address(t)
        if _is_plain(t) and t.is_cpu and t.numel() <= most:
            with torch.inference_mode(False):
                self._contents = t.detach().clone()

    def __deepcopy__(self, memo: dict[int, Any]) -> Remembered:
        """Version of the copy of the tensor if it was copied before, otherwise of the tensor itself."""
        t = memo.get(id(self._tensor))
        if t is None:
            return self
        remembered = copy.copy(self)
        remembered._tensor = t
        remembered._version = (version(t), _address(t)) if self.is_now(self._tensor) else None
        return remembered

    def is_now(self, t: Any) -> bool:
        """Whether a value is that tensor, unchanged."""
        if t is not self._tensor or torch.compiler.is_compiling():
            return t is self._tensor
        if self._contents is not None:
            return self._contents.shape == t.shape and torch.equal(self._contents, t)
        return self._version == (version(t), _address(t))


def _is_plain(t: Tensor) -> bool:
    """Whether a tensor has readable memory: neither a wrapper of a transform nor a subclass."""
    plain = type(t) in (Tensor, torch.nn.Parameter) and t.layout == torch.strided
    return plain and not torch._C._functorch.is_functorch_wrapped_tensor(t)


def is_readable(t: Tensor) -> bool:
    """Whether the values of a tensor can be read without waiting for a device or ending a compiled function."""
    return not torch.compiler.is_compiling() and t.is_cpu and _is_plain(t)


def _address(t: Tensor) -> int:
    return t.data_ptr() if _is_plain(t) else 0


def as_remembered(value: Any, most: int = COMPARED) -> Any:
    """Value as a part of a key: tensors as `Remembered`; lists, tuples and arrays as tuples; others unchanged."""
    if isinstance(value, Tensor):
        return Remembered(value, most)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, (list, tuple)):
        return value
    parts = tuple(as_remembered(part, most) for part in value)
    unchanged = isinstance(value, tuple) and all(a is b for a, b in zip(parts, value, strict=True))
    return value if unchanged else parts  # `is_same` recognises these at once.


def is_same(known: Any, value: Any) -> bool:
    """Whether a value still equals the part of a key that `as_remembered` made of it."""
    if known is value:  # Neither a tensor nor a list or array.
        return True
    if type(value) in _BY_VALUE:
        return bool(known == value)
    if isinstance(known, Remembered):
        return known.is_now(value)
    if isinstance(value, (tuple, list)):
        if not isinstance(known, tuple) or len(known) != len(value):
            return False
        for a, b in zip(known, value, strict=True):  # A generator takes longer than most comparisons.
            if a is not b and not is_same(a, b):
                return False
        return True
    if isinstance(value, Tensor):
        return False
    if isinstance(value, np.ndarray):
        return is_same(known, value.tolist())
    return bool(known == value)


class DeviceConstantCache:
    """Latest value by key: tensors on the device, computed without waiting for it. A value is recomputed when the key
    changes, or the contents of its lists, arrays and tensors (see `Remembered`).

    A value captured by a CUDA graph is kept for its replays, also after the key has changed.
    """

    def __init__(self) -> None:
        self._latest: tuple[Any, Any] | None = None
        self._captured: list[Any] = []

    def get(self, key: tuple[Any, ...], make: Callable[[], Any], like: Tensor) -> Any:
        """Value of a key, made of numbers, tensors and lists of these, for work on the device of `like`."""
        captured = is_captured(like)
        if self._latest is None or not is_same(self._latest[0], key):
            with torch.inference_mode(False):  # A later step may then differentiate through it.
                made = make()
            # A value computed inside a graph exists in replays only; one inside a transform of torch.func belongs to
            # the transform.
            if captured or torch._C._are_functorch_transforms_active():
                return made
            self._latest = (as_remembered(key, max(COMPARED, like.numel())), made)
        value = self._latest[1]
        if captured:
            remember(self._captured, value)
        return value


class Same:
    """Object as a part of a key, by identity; the key holds a reference, so that its address is not reused."""

    def __init__(self, thing: Any) -> None:
        self._thing = thing

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self._thing is other._thing

    def __hash__(self) -> int:
        return id(self._thing)


class CapturedGraphs:
    """Captured CUDA graphs by key, with eviction of the least recently used. They share memory, so that each overwrites
    the results of the others. Neither copied nor pickled: a copy of a step begins without captured graphs.

    Attributes:
        most: maximum number of keys.
        latest: mark of the call whose results are in the memory; None where they are overwritten.
        unseen: calls since the last query of the number of active blocks.
    """

    most = 8

    def __init__(self) -> None:
        self.latest: Any = None
        self.unseen = 0
        self._done: torch.cuda.Event | None = None  # The latest replay.
        self._kept: collections.OrderedDict[Hashable, Any] = collections.OrderedDict()
        self._contents: dict[str, list[Tensor]] = {}
        self._latest_content: dict[str, tuple[Tensor | None, int | None, Tensor]] = {}

    @contextlib.contextmanager
    def in_turn(self, device: torch.device) -> Iterator[None]:
        """Stream for replays, after those that were replayed on other streams."""
        if device.type != "cuda":
            yield
            return
        stream = torch.cuda.current_stream(device)
        if self._done is not None:
            stream.wait_event(self._done)
        try:
            yield
        finally:
            self._done = torch.cuda.Event()
            self._done.record(stream)

    def __reduce__(self) -> tuple[type[CapturedGraphs], tuple[()]]:
        return CapturedGraphs, ()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable) -> Any:
        """The captured graphs of a key, or None."""
        if key in self._kept:
            self._kept.move_to_end(key)
        return self._kept.get(key)

    def keep(self, key: Hashable, captured: Any) -> None:
        self._kept[key] = captured
        self._kept.move_to_end(key)
        if len(self._kept) > self.most:
            self._kept.popitem(last=False)

    def some(self) -> Any:
        """The captured graphs of one of the keys, or None."""
        return next(iter(self._kept.values()), None)

    def same_content(self, name: str, t: Tensor) -> Tensor:
        """Tensor with the entries of t, the same object for the same entries: for caches by identity. Waits for the
        device where t is another tensor than in the previous call.
        """
        given, before, content = self._latest_content.get(name, (None, None, t))
        now = version(t)
        if t is given and now is not None and now == before:
            return content
        known = self._contents.setdefault(name, [])
        alike = [c for c in known if (c.shape, c.device) == (t.shape, t.device) and torch.equal(c, t)]
        if not alike:
            with torch.inference_mode(False):  # Autograd may then store it later.
                alike = [t.detach().clone()]
            known[:] = [*known[1 - self.most :], *alike]
        content = alike[0]
        self._latest_content[name] = t, now, content
        return content
