"""Parameters of shapes and obstacles: numbers or tensors, one for all scenes of a batch or one per scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..cuda_graphs.capture import DeviceConstantCache
from ..errors import check_number, shape_of
from ..laws.parameters import TensorModule

Value = float | Sequence[float] | Tensor


class SceneParameters(TensorModule):
    """Module whose parameters are numbers or tensors, one for all scenes or one per scene."""

    _constants: dict[tuple[str, torch.device, torch.dtype], DeviceConstantCache]

    RANKS: ClassVar[dict[str, int | None]] = {}
    """Number of dimensions of a value of each parameter that may be given per scene; None for that of an angle."""

    def __new__(cls, *arguments: Any, **named: Any) -> Any:
        module = super().__new__(cls, *arguments, **named)
        module._constants = {}
        return module

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
            value, rank = getattr(self, name, None), (0 if dim == 2 else 1) if given is None else given
            if isinstance(value, Tensor) and value.dim() == rank + 1 and value.shape[0] not in (1, scenes):
                batch = ["B", *value.shape[1:]]
                raise ValueError(
                    f"{name} must be given once or per scene, {batch} with B = {scenes}, got {shape_of(value)}".replace(
                        "'", ""
                    )
                )

    def at_nodes(self, name: str, like: Tensor, shape: tuple[int, ...], scene: Tensor | None) -> Tensor:
        """A parameter as a tensor of `shape`, or one per node [N, *shape] where it differs from scene to scene."""
        return per_node(self.parameter(name, like, shape), len(shape), scene)

    def of_scene(self, name: str, rank: int, scene: int) -> Tensor:
        """A parameter of `rank` dimensions of one scene, float64 on the CPU."""
        value = getattr(self, name)
        if not isinstance(value, Tensor):
            return torch.tensor(value, dtype=torch.float64, device="cpu")
        value = value.detach().to("cpu", torch.float64)
        return value if value.dim() == rank else value[scene if len(value) > 1 else 0]

    def _constant(self, name: str, value: Any, like: Tensor) -> Tensor:
        """Numbers as a tensor; copied to a device once, so that later steps neither wait nor prevent capture."""
        if isinstance(value, (list, tuple)) and any(isinstance(part, Tensor) for part in value):
            raise TypeError(f"{name} must be numbers or one tensor, got tensors in a list: stack them (torch.stack)")
        if torch.compiler.is_compiling() or type(like) not in (Tensor, torch.nn.Parameter):
            return filled(value, like)
        kept = self._constants.setdefault((name, like.device, like.dtype), DeviceConstantCache())
        result: Tensor = kept.get((value,), lambda: filled(value, like), like)
        return result


def filled(value: Any, like: Tensor) -> Tensor:
    """Numbers as a tensor with the dtype and device of `like`. Few numbers are filled in on the device, which does not
    wait for it as a copy from the host does.
    """
    numbers = value if isinstance(value, (tuple, list)) else (value,)
    if like.is_cpu or not 0 < len(numbers) <= 3 or not all(isinstance(a, (int, float)) for a in numbers):
        return torch.tensor(value, dtype=like.dtype, device=like.device)
    entries = [torch.full((), a, dtype=like.dtype, device=like.device) for a in numbers]
    return entries[0] if numbers is not value else torch.stack(entries)


def per_node(value: Tensor, rank: int, scene: Tensor | None) -> Tensor:
    """A value of `rank` dimensions unchanged, or values per scene as values per node."""
    if value.dim() == rank:
        return value
    if scene is None and value.shape[0] != 1:
        raise ValueError(f"a value per scene must have one entry where there is one scene, got {shape_of(value)}")
    if scene is None or value.shape[0] == 1:
        return value[0]
    return value.index_select(0, scene.clamp(0, value.shape[0] - 1))


# ---- checks of arguments; tensors are stored unchanged, and their values are not read


def floats(name: str, value: Any) -> tuple[float, ...]:
    """A number or a sequence of them."""
    if isinstance(value, (Mapping, Set)):
        raise TypeError(f"{name} must be numbers in an order, got {type(value).__name__}")
    values = value if hasattr(value, "__len__") and not isinstance(value, (str, type)) else (value,)
    return tuple(float(check_number(name, a, "a number", lambda v: True)) for a in values)


def finite(name: str, value: Any) -> Any:
    """Numbers, checked and made immutable; None unchanged."""
    if value is None or isinstance(value, Tensor):
        return value
    numbers = floats(name, value)
    if not all(math.isfinite(a) for a in numbers):
        raise ValueError(f"{name} must be finite, got {value}")
    return numbers if hasattr(value, "__len__") else numbers[0]


def constant(name: str, value: Any) -> Any:
    """Whether a value is neither None nor a function."""
    if value is None or callable(value):
        raise TypeError(f"{name} must be numbers or a tensor, got {shape_of(value)}")
    return finite(name, value)


def direction(name: str, value: Any) -> Any:
    """Numbers that are not all zero."""
    if not isinstance(constant(name, value), Tensor) and not any(floats(name, value)):
        raise ValueError(f"{name} must not be zero, got {value}")
    return finite(name, value)


def extent(name: str, value: Any) -> Any:
    """Lengths, non-negative and without gradient."""
    value = constant(name, value)
    if isinstance(value, Tensor):
        if value.requires_grad:
            raise ValueError(f"{name} must not require grad: which nodes are inside is not differentiable")
    elif min(floats(name, value), default=-1) < 0:
        raise ValueError(f"{name} must be >= 0, got {value}")
    return value
