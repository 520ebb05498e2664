"""Keys of captured CUDA graphs: the properties of a step that its graphs depend on."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..boundaries import Walls
from ..boundaries.motion import RigidMotion
from ..grid.grid import Grid
from ..laws.mixture import Mixture
from ..laws.parameters import has_hooks
from ..state.state import State
from ..step.step import Step
from .capture import NUMBERS, Same, is_of_library, version


class StepKey:
    """Properties of an unchanged step that its captured graphs depend on.

    Attributes:
        own: its tensors that require gradients, by "step." and their name.
        key: other parts of the key of captured graphs.
        steps: the steps in it.
    """

    def __init__(self, step: nn.Module) -> None:
        self._step = step
        self.refresh()

    def refresh(self) -> None:
        """Read the step again: the first steps create some of its tensors."""
        step, modules = self._step, dict(self._step.named_modules())  # Once, since a device may be waiting.
        named: dict[int, tuple[str, Tensor]] = {}  # Each tensor by its first name.
        for place, module in modules.items():
            for name, t in (*module._parameters.items(), *module._buffers.items()):
                if t is not None:
                    named.setdefault(id(t), (f"step.{place}.{name}" if place else f"step.{name}", t))
        self.own = {name: t for name, t in named.values() if t.requires_grad}
        # The key does not hold the step, which owns its captured graphs: a cycle would delay their release.
        self.key = tuple(
            (None if m is step or type(m) is RigidMotion else Same(m), *content_of(m)) for m in modules.values()
        )
        self.steps = [module for module in modules.values() if isinstance(module, Step)]
        self.mixes = any(isinstance(module, Mixture) for module in modules.values())
        self._sizes = {t.numel() for _, t in named.values() if not t.requires_grad}

    def by_content(self, state: State) -> list[str]:
        """Fields from which steps derive cached values, such as indices, while they are the same."""
        names = ["material"] if self.mixes and state.material is not None else []
        return [*names, "ids"] if state.ids is not None and len(state) in self._sizes else names

    def pools(self) -> Hashable:
        """Sizes of the grids at present."""
        return tuple(step.grid.max_blocks for step in self.steps)

    def follow(self, state: State, unseen: int) -> None:
        """Adapt pools of growing grids to the block counts of earlier calls. The host waits for a count so old that the
        scene may have outgrown it, but not for the latest call, which the device is computing.
        """
        for grid in {step.grid: None for step in self.steps if step.grid.grows}:
            if unseen > 1:
                grid.wait()
            if grid.max_blocks is not None or isinstance(self._step, Step):
                grid.pool(state.x, state.scene)


_EVERY = frozenset(vars(nn.Module()))
"""Attributes of every module."""


def content_of(module: nn.Module) -> tuple[Hashable, ...]:
    """Module as a part of a key, by content. Modules of the library and derived classes contribute everything that can
    be assigned. User modules contribute their tensors, but not their numbers, which may change in each call, such as a
    counter.
    """
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
            return None if plain else Same(value)  # The library derives this from other attributes.
        return _value(value) if of_library else None

    # The length of steps, over which paths are differenced, differs between a control step and outside.
    unread = isinstance(module, RigidMotion) and not module.follows_path
    excluded = _EVERY | {"pace"} if unread else _EVERY
    values = [(name, attribute(value)) for name, value in vars(module).items() if name not in excluded]
    assigned = tuple((name, value) for name, value in values if value is not None)
    return module.training, has_hooks(module), tuple(read), assigned


def _value(value: Any) -> Hashable:
    """Attribute of a module as a part of a key; None for values that steps store there."""
    if isinstance(value, NUMBERS):
        return value
    if isinstance(value, Walls):  # Their kinds and friction may be assigned.
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
    """Settings of torch that affect a capture."""
    precision = torch.get_float32_matmul_precision(), torch.are_deterministic_algorithms_enabled()
    return torch.is_grad_enabled(), autocast_of(device), precision
