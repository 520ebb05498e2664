"""Parameters of shapes and obstacles: numbers or tensors, one for all scenes of a batch or one per scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..cuda_graphs.capture import DeviceConstantCache
from ..errors import shape_of
from ..laws.parameters import TensorModule
from .values import as_value, filled, shape_of_value

WRITABLE = (list, np.ndarray)
"""Types of numbers that may be written to."""


class SceneParameters(TensorModule):
    """Module whose parameters are numbers or tensors, one for all scenes or one per scene.

    A parameter is checked when it is assigned, in the constructor and later. Lists and arrays of numbers are stored as
    they are, so that a later write to them acts like an assignment; `value_of` reads them.
    """

    _constants: dict[tuple[str, torch.device, torch.dtype], DeviceConstantCache]

    RANKS: ClassVar[dict[str, int | None]] = {}
    """Number of dimensions of a value of each parameter that may be given per scene; None for that of an angle."""
    CHECKS: ClassVar[dict[str, Callable[[str, Any], Any]]] = {}
    """Functions of name and value that return the stored form of a parameter, or raise (see `geometry.values`)."""

    def __new__(cls, *arguments: Any, **named: Any) -> Any:
        module = super().__new__(cls, *arguments, **named)
        module._constants = {}
        return module

    def __setattr__(self, name: str, value: Any) -> None:
        check = self.CHECKS.get(name)
        if check is not None:
            checked = check(name, value)
            value = value if isinstance(value, WRITABLE) else checked
        super().__setattr__(name, value)

    def value_of(self, name: str) -> Any:
        """A parameter as a number, a tuple of numbers or of such tuples, a tensor, a function, or None."""
        value = getattr(self, name, None)
        return self.CHECKS.get(name, as_value)(name, value) if isinstance(value, WRITABLE) else value

    def parameter(self, name: str, like: Tensor, shape: tuple[int, ...]) -> Tensor:
        """A parameter as a tensor of `shape` or [B, *shape], with the dtype and device of `like`.

        Raises:
            ValueError: for another shape, or a tensor on another device.
        """
        value = getattr(self, name)
        if not isinstance(value, Tensor):
            value = self._constant(name, value, like)
        per_scene = value.dim() == len(shape) + 1 and value.shape[0] > 0
        if not (per_scene or value.dim() == len(shape)) or tuple(value.shape)[value.dim() - len(shape) :] != shape:
            alternatives = f"{list(shape)} or {['B', *shape]}".replace("'", "")
            raise ValueError(f"{name} must have shape {alternatives}, got {shape_of(value)}")
        if value.is_complex() or value.dtype == torch.bool:
            raise TypeError(f"{name} must have a real dtype, got {value.dtype}")
        if value.device != like.device:
            raise ValueError(f"{name} must be on the device of the nodes, {like.device}, got {value.device}")
        return value.to(like.dtype)

    def check_scenes(self, dim: int, scenes: int) -> None:
        """Check the parameters that are given per scene, for a batch of B scenes in D dimensions.

        Raises:
            ValueError: for another number of values than one or B.
        """
        for name, given in self.RANKS.items():
            value, rank = self.value_of(name), (0 if dim == 2 else 1) if given is None else given
            shape = () if value is None or callable(value) else shape_of_value(value)
            if len(shape) == rank + 1 and shape[0] not in (1, scenes):
                batch = str(["B", *shape[1:]]).replace("'", "")
                raise ValueError(
                    f"{name} must be given once or per scene, {batch} with B = {scenes}, got {list(shape)}"
                )

    def at_nodes(self, name: str, like: Tensor, shape: tuple[int, ...], scene: Tensor | None) -> Tensor:
        """A parameter as a tensor of `shape`, or one per node [N, *shape] where it differs from scene to scene."""
        return per_node(self.parameter(name, like, shape), len(shape), scene)

    def of_scene(self, name: str, rank: int, scene: int) -> Tensor:
        """A parameter of `rank` dimensions of one scene, float64 on the CPU."""
        value = self.value_of(name)
        if not isinstance(value, Tensor):
            value = torch.tensor(value, dtype=torch.float64, device="cpu")
        value = value.detach().to("cpu", torch.float64)
        return value if value.dim() == rank else value[scene if len(value) > 1 else 0]

    def _constant(self, name: str, value: Any, like: Tensor) -> Tensor:
        """Numbers as a tensor; copied to a device once, so that later steps neither wait nor prevent capture."""
        if torch.compiler.is_compiling() or type(like) not in (Tensor, torch.nn.Parameter):
            return filled(self.value_of(name), like)
        kept = self._constants.setdefault((name, like.device, like.dtype), DeviceConstantCache())
        result: Tensor = kept.get((value,), lambda: filled(self.value_of(name), like), like)
        return result


def per_node(value: Tensor, rank: int, scene: Tensor | None) -> Tensor:
    """A value of `rank` dimensions unchanged, or values per scene as values per node."""
    if value.dim() == rank:
        return value
    if scene is None and value.shape[0] != 1:
        raise ValueError(f"a value per scene must have one entry where there is one scene, got {shape_of(value)}")
    if scene is None or value.shape[0] == 1:
        return value[0]
    return value.index_select(0, scene.clamp(0, value.shape[0] - 1))
