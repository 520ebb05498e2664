"""Copies of tensors in host memory: from a GPU through pinned memory, while it computes or at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


@dataclass(frozen=True)
class Copies:
    """Fields of a frame in host memory. ``ready`` is recorded after the copies; ``sources`` keeps their origin alive
    until then.
    """

    fields: Mapping[str, Tensor]
    ready: torch.cuda.Event | None
    sources: list[Tensor]

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The fields, when their copies are complete."""
        if self.ready is not None:
            self.ready.synchronize()
            self.sources.clear()
        return {name: np.asarray(value) for name, value in self.fields.items()}


class Copier:
    """Copies of tensors into host memory: on CUDA on a separate stream, so that nothing waits."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None

    def begin(self, fields: Mapping[str, Tensor]) -> Copies:
        """Copies that may be pending. The fields are on one device; those on the CPU are returned as they are."""
        sources = list(fields.values())
        device = sources[0].device
        if device.type != "cuda":
            return Copies(fields, None, sources)
        if self._stream is None or self._stream.device != device:
            self._stream = torch.cuda.Stream(device)
        self._stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(self._stream):
            host = {name: _pinned(t).copy_(t, non_blocking=True) for name, t in fields.items()}
            ready = torch.cuda.Event()
            ready.record(self._stream)
        return Copies(host, ready, sources)


def copied(t: Tensor) -> Tensor:
    """A tensor of a GPU in pinned memory, when its copy is complete; one on the CPU as it is."""
    return _pinned(t).copy_(t) if t.device.type == "cuda" else t


def _pinned(t: Tensor) -> Tensor:
    """Buffer for a tensor in pinned memory, row after row, as in files."""
    return torch.empty(t.shape, dtype=t.dtype, device="cpu", pin_memory=True)
