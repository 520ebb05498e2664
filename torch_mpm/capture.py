"""What outlives a call: tensors that CUDA graphs may read, and none that belongs to a transform of torch.func."""

from __future__ import annotations

import collections
import contextlib
import copy
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor


def is_captured(x: Tensor) -> bool:
    """Whether what is done with a tensor goes into a CUDA graph."""
    return x.is_cuda and not torch.compiler.is_compiling() and torch.cuda.is_current_stream_capturing()


@contextlib.contextmanager
def capturing(graph: torch.cuda.CUDAGraph, pool: Any, device: torch.device) -> Iterator[None]:
    """Capture the work of the current stream into a graph whose memory comes from a pool; other threads may go on.

    Args:
        graph: an empty graph.
        pool: the pool of another graph, or None for a new one.
        device: device of the stream.

    A capture that fails leaves the allocator as it was.
    """
    pool = torch.cuda.graph_pool_handle() if pool is None else pool
    try:
        graph.capture_begin(pool, capture_error_mode="thread_local")
        yield
        graph.capture_end()
    except BaseException:
        with contextlib.suppress(RuntimeError):  # the error that is raised says why the capture failed
            graph.capture_end()
        # In torch before 2.12 the allocator stays in a capture whose end failed, and reads the graph at every later
        # allocation, even when the graph is gone (pytorch #180395). Later versions refuse to end it again.
        with contextlib.suppress(RuntimeError):
            torch._C._cuda_endAllocateToPool(device.index, pool)
        raise


def is_traced(x: Tensor) -> bool:
    """Whether a compiler or a fake tensor stands for values, which cannot be read."""
    return torch.compiler.is_compiling() or is_exported() or isinstance(x, torch._subclasses.FakeTensor)


def is_exported() -> bool:
    """Whether `torch.export` runs the code: what it writes to outlives the export, but not the values."""
    return torch.compiler.is_exporting()


def is_transformed() -> bool:
    """Whether a transform of torch.func, or forward differentiation, runs the code."""
    return torch._C._are_functorch_transforms_active() or torch.autograd.forward_ad._current_level >= 0


NUMBERS = (bool, int, float, str, torch.dtype, torch.device)
"""Types of what a graph has by value."""


def is_of_library(kind: type) -> bool:
    """Whether a class is one of torch_mpm itself."""
    return kind.__module__.startswith("torch_mpm.")


def without_transforms(t: Tensor) -> Tensor:
    """The plain tensor below the levels of torch.func.grad and its like, which may be kept when they have ended."""
    if torch.compiler.is_compiling():
        return t
    while torch._C._functorch.is_gradtrackingtensor(t):
        t = torch._C._functorch.get_unwrapped(t)
    return t


def outside_transforms() -> contextlib.AbstractContextManager[Any]:
    """Where what is kept may be written to, which a transform of torch.func forbids."""
    active = not torch.compiler.is_compiling() and torch._C._are_functorch_transforms_active()
    return torch._C._DisableFuncTorch() if active else contextlib.nullcontext()


def version(t: Tensor) -> int | None:
    """Of the values of a tensor, which count what is written to it; None for those that do not."""
    return None if t.is_inference() else t._version


def remember(kept: list[Any], value: Any) -> None:
    """Keep a value, by identity, that a graph reads or writes."""
    if not any(value is known for known in kept):
        kept.append(value)


COMPARED = 2**16
"""Entries of a tensor on the CPU whose contents are always compared; beyond it, those of at most as many entries as the
tensors that a step computes with have."""


class Remembered:
    """A tensor as it was at a time, to find out whether it has been changed since.

    Contents are compared on the CPU. A write by any way is seen there: in place, by `.data`, by an array that shares
    the memory. On another device, and of tensors on the CPU with more than `most` entries, the version counter and the
    address are compared, which takes no synchronisation: writes through `.data` and by others that share the memory
    change neither.
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
        """Of the copy of the tensor, if that was copied before; else of the tensor itself."""
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
    """Whether a tensor has memory of its own that can be read: no wrapper of a transform, no subclass."""
    plain = type(t) in (Tensor, torch.nn.Parameter) and t.layout == torch.strided
    return plain and not torch._C._functorch.is_functorch_wrapped_tensor(t)


def _address(t: Tensor) -> int:
    return t.data_ptr() if _is_plain(t) else 0


def as_remembered(value: Any, most: int = COMPARED) -> Any:
    """A value as a part of a key: tensors as `Remembered`; lists, tuples and arrays as tuples; others as they are."""
    if isinstance(value, Tensor):
        return Remembered(value, most)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, (list, tuple)):
        return value
    parts = tuple(as_remembered(part, most) for part in value)
    unchanged = isinstance(value, tuple) and all(a is b for a, b in zip(parts, value, strict=True))
    return value if unchanged else parts  # which `is_same` knows at once


def is_same(known: Any, value: Any) -> bool:
    """Whether a value is still what `as_remembered` made a part of a key of."""
    if known is value:  # no tensor, list or array
        return True
    if isinstance(known, Remembered):
        return known.is_now(value)
    if isinstance(value, Tensor):
        return False
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, (list, tuple)):
        return known is value or bool(known == value)
    same_length = isinstance(known, tuple) and len(known) == len(value)
    return same_length and all(is_same(a, b) for a, b in zip(known, value, strict=True))


class GraphCache:
    """The latest value by key: tensors on the device that no step waits for, made again when the key changes, or what
    is in its lists, arrays and tensors (see `Remembered`).

    A value that a CUDA graph has captured is kept for its replays, also when the key has changed since.
    """

    def __init__(self) -> None:
        self._latest: tuple[Any, Any] | None = None
        self._captured: list[Any] = []

    def get(self, key: tuple[Any, ...], make: Callable[[], Any], like: Tensor) -> Any:
        """The value of a key, of numbers, tensors and lists of these, for work on the device of `like`."""
        captured = is_captured(like)
        if self._latest is None or not is_same(self._latest[0], key):
            with torch.inference_mode(False):  # such that a later step may differentiate through it
                made = make()
            # What is made in a graph has its value in replays only, in a transform of torch.func belongs to that.
            if captured or torch._C._are_functorch_transforms_active():
                return made
            self._latest = (as_remembered(key, max(COMPARED, like.numel())), made)
        value = self._latest[1]
        if captured:
            remember(self._captured, value)
        return value


class Same:
    """A thing as a part of a key, by identity; the key keeps it, so that no other thing gets its place in memory."""

    def __init__(self, thing: Any) -> None:
        self._thing = thing

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self._thing is other._thing

    def __hash__(self) -> int:
        return id(self._thing)


class Recordings:
    """What was recorded in CUDA graphs, by key; those that were not used for longest go. They share memory, so that one
    spoils what another has left there. Neither copies nor pickles: a copy of a step begins without.

    Attributes:
        most: how many are kept.
        latest: the mark of the call whose results are in the memory; None where they are spoilt.
        unseen: calls since a device was asked how many blocks are active.
    """

    most = 8

    def __init__(self) -> None:
        self.latest: Any = None
        self.unseen = 0
        self._done: torch.cuda.Event | None = None  # the latest replay
        self._kept: collections.OrderedDict[Hashable, Any] = collections.OrderedDict()
        self._contents: dict[str, list[Tensor]] = {}
        self._latest_content: dict[str, tuple[Tensor | None, int | None, Tensor]] = {}

    @contextlib.contextmanager
    def in_turn(self, device: torch.device) -> Iterator[None]:
        """Where graphs are replayed, after those that were replayed on other streams."""
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

    def __reduce__(self) -> tuple[type[Recordings], tuple[()]]:
        return Recordings, ()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable) -> Any:
        """What was kept under a key, or None."""
        if key in self._kept:
            self._kept.move_to_end(key)
        return self._kept.get(key)

    def keep(self, key: Hashable, recording: Any) -> None:
        self._kept[key] = recording
        self._kept.move_to_end(key)
        if len(self._kept) > self.most:
            self._kept.popitem(last=False)

    def some(self) -> Any:
        """One of those that are kept, or None."""
        return next(iter(self._kept.values()), None)

    def same_content(self, name: str, t: Tensor) -> Tensor:
        """A tensor with the entries of t, the same one for the same entries: for what is kept of it by identity. Waits
        for the device where t is another tensor than the last time."""
        given, before, content = self._latest_content.get(name, (None, None, t))
        now = version(t)
        if t is given and now is not None and now == before:
            return content
        known = self._contents.setdefault(name, [])
        alike = [c for c in known if (c.shape, c.device) == (t.shape, t.device) and torch.equal(c, t)]
        if not alike:
            with torch.inference_mode(False):  # such that autograd may keep it later
                alike = [t.detach().clone()]
            known[:] = [*known[1 - self.most :], *alike]
        content = alike[0]
        self._latest_content[name] = t, now, content
        return content
