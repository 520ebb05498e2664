"""What steps from CUDA graphs depend on: keys by which their recordings are found again."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .boundaries import Walls
from .boundaries.motion import RigidMotion
from .capture import NUMBERS, Same, is_of_library, version
from .grid import Grid
from .laws.mixture import Mixture
from .parameters import has_hooks
from .state import State
from .step import Step


class StepKey:
    """What is known of a step while nobody changes it, as far as a recording depends on it.

    Attributes:
        own: its tensors that require gradients, by "step." and their name.
        key: what a recording has of it beside those.
        steps: those in it.
    """

    def __init__(self, step: nn.Module) -> None:
        self._step = step
        self.look()

    def look(self) -> None:
        """Again: the first steps make some of what steps keep."""
        step, modules = self._step, dict(self._step.named_modules())  # once: a device may be waiting
        named: dict[int, tuple[str, Tensor]] = {}  # each tensor by its first name
        for place, module in modules.items():
            for name, t in (*module._parameters.items(), *module._buffers.items()):
                if t is not None:
                    named.setdefault(id(t), (f"step.{place}.{name}" if place else f"step.{name}", t))
        self.own = {name: t for name, t in named.values() if t.requires_grad}
        # Not by the step, which keeps its recordings: it could only go with them where somebody looks for cycles.
        # Nor by the motions of obstacles in a control step, each of which has its own.
        self.key = tuple(
            (None if m is step or type(m) is RigidMotion else Same(m), *content_of(m)) for m in modules.values()
        )
        self.steps = [module for module in modules.values() if isinstance(module, Step)]
        self.mixes = any(isinstance(module, Mixture) for module in modules.values())
        self._sizes = {t.numel() for _, t in named.values() if not t.requires_grad}

    def by_content(self, state: State) -> list[str]:
        """Fields of which steps keep what follows from them, as indices, while they are the same."""
        names = ["material"] if self.mixes and state.material is not None else []
        return [*names, "ids"] if state.ids is not None and len(state) in self._sizes else names

    def pools(self) -> Hashable:
        """Of the grids, as large as they are now."""
        return tuple(step.grid.max_blocks for step in self.steps)

    def follow(self, state: State, unseen: int) -> None:
        """Let pools of grids that grow follow what was told of calls before. The host waits where that was so many
        calls ago that the scene may have grown out of them, but not for the latest call, which the device works at."""
        for grid in {step.grid: None for step in self.steps if step.grid.grows}:
            if unseen > 1:
                grid.wait()
            if grid.max_blocks is not None or isinstance(self._step, Step):
                grid.pool(state.x, state.scene)


_EVERY = frozenset(vars(nn.Module()))
"""Attributes of every module."""


def content_of(module: nn.Module) -> tuple[Hashable, ...]:
    """A module by its content as a part of a key. Of those of the library, and of classes made of them, all that may be
    assigned; of the user's own modules the tensors, but not the numbers, which may change in each call as a counter
    does."""
    classes = type(module).__mro__
    plain, of_library = is_of_library(classes[0]), any(map(is_of_library, classes))
    tensors = [(name, t) for name, t in (*module._parameters.items(), *module._buffers.items()) if t is not None]
    read = [
        (name, Same(t), t.data_ptr(), version(t) if of_library and not isinstance(module, Step) else None)
        for name, t in tensors
        if not t.requires_grad
    ]

    def attribute(value: Any) -> Hashable:
        if isinstance(value, Tensor):
            return None if plain else Same(value)  # the library keeps what follows from others
        return _value(value) if of_library else None

    # The length of steps, over which paths are differenced, is another in a control step than outside.
    unread = isinstance(module, RigidMotion) and not module.follows_path
    left_out = _EVERY | {"pace"} if unread else _EVERY
    values = [(name, attribute(value)) for name, value in vars(module).items() if name not in left_out]
    told = tuple((name, value) for name, value in values if value is not None)
    return module.training, has_hooks(module), tuple(read), told


def _value(value: Any) -> Hashable:
    """An attribute of a module as a part of a key; None for what steps keep there themselves."""
    if isinstance(value, NUMBERS):
        return value
    if isinstance(value, Walls):  # whose kinds and friction may be assigned
        return Same(value), repr(value)
    if isinstance(value, Grid) or callable(value):
        return Same(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)) and not any(isinstance(part, Tensor) for part in value):
        return tuple(_value(part) if isinstance(part, (*NUMBERS, list, tuple)) else Same(part) for part in value)
    return None


def autocast_of(device: torch.device) -> tuple[bool, torch.dtype]:
    return torch.is_autocast_enabled(device.type), torch.get_autocast_dtype(device.type)


def surroundings(device: torch.device) -> Hashable:
    """Settings of torch that decide what a recording computes."""
    precision = torch.get_float32_matmul_precision(), torch.are_deterministic_algorithms_enabled()
    return torch.is_grad_enabled(), autocast_of(device), precision
