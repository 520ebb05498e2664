"""Physics in the precision of the state, also where `torch.autocast` surrounds it for the networks of a user."""

from __future__ import annotations

import contextlib
from typing import Any

import torch
from torch import Tensor

HALVES = (torch.float16, torch.bfloat16)


def full_precision(like: Tensor) -> contextlib.AbstractContextManager[Any]:
    """Where autocast does not act on the device of `like`."""
    device = like.device.type
    if not torch.is_autocast_enabled(device):
        return contextlib.nullcontext()
    return torch.autocast(device, enabled=False)


def from_half(value: Any, like: Tensor) -> Any:
    """What a function of a user returned, in the dtype of `like` where it is a half, as autocast makes it."""
    return value.to(like.dtype) if isinstance(value, Tensor) and value.dtype in HALVES else value
