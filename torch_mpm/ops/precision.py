"""Physics in the precision of the state, also where `torch.autocast` is active for the networks of a user."""

from __future__ import annotations

import contextlib
from typing import Any

import torch
from torch import Tensor

HALVES = (torch.float16, torch.bfloat16)


def full_precision(like: Tensor) -> contextlib.AbstractContextManager[Any]:
    """Context in which autocast is off on the device of `like`."""
    device = like.device.type
    if not torch.is_autocast_enabled(device):
        return contextlib.nullcontext()
    return torch.autocast(device, enabled=False)


def from_half(value: Any, like: Tensor) -> Any:
    """Result of a user function, in the dtype of `like` where it is a half precision, as under autocast."""
    return value.to(like.dtype) if isinstance(value, Tensor) and value.dtype in HALVES else value
