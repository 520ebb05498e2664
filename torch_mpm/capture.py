"""What outlives a call: tensors that CUDA graphs may read, and none that belongs to a transform of torch.func."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def is_captured(x: Tensor) -> bool:
    """Whether what is done with a tensor goes into a CUDA graph."""
    return x.is_cuda and not torch.compiler.is_compiling() and torch.cuda.is_current_stream_capturing()


def is_traced(x: Tensor) -> bool:
    """Whether a compiler or a fake tensor stands for values, which cannot be read."""
    return torch.compiler.is_compiling() or is_exported() or isinstance(x, torch._subclasses.FakeTensor)


def is_exported() -> bool:
    """Whether `torch.export` runs the code: what it writes to outlives the export, but not the values."""
    return torch.compiler.is_exporting()


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


class GraphCache:
    """The latest value by key: tensors on the device that no step waits for, made again when the key changes.

    A value that a CUDA graph has captured is kept for its replays, also when the key has changed since.
    """

    def __init__(self) -> None:
        self._latest: tuple[Any, Any] | None = None
        self._captured: list[Any] = []

    def get(self, key: tuple[Any, ...], make: Callable[[], Any], like: Tensor) -> Any:
        """The value of a key, of numbers and tensors (these by identity), for work on the device of `like`."""
        captured = is_captured(like)
        if self._latest is None or not _same(self._latest[0], key):
            with torch.inference_mode(False):  # such that a later step may differentiate through it
                made = make()
            # What is made in a graph has its value in replays only, in a transform of torch.func belongs to that.
            if captured or torch._C._are_functorch_transforms_active():
                return made
            self._latest = (key, made)
        value = self._latest[1]
        if captured:
            remember(self._captured, value)
        return value


def _same(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    """Equality of nested tuples, tensors by identity."""
    if len(a) != len(b):
        return False
    for s, t in zip(a, b, strict=True):
        if s is t:
            continue
        if isinstance(s, tuple) and isinstance(t, tuple):
            if not _same(s, t):
                return False
        elif isinstance(s, Tensor) or isinstance(t, Tensor) or s != t:
            return False
    return True
