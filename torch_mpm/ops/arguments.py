"""Argument forms and autograd helpers that the op families share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..cuda_graphs.capture import is_traced
from ..errors import LARGEST, REAL, check_like, shape_of


def check_kind_of_dt(dt: Any) -> None:
    """Raise TypeError for anything but a number or a tensor."""
    if not isinstance(dt, (Tensor, *REAL)):
        raise TypeError(f"dt must be a number of seconds or a tensor, got {type(dt).__name__} {dt!r}")


def split_dt(dt: float | Tensor, scenes: int, x: Tensor) -> tuple[float, Tensor | None]:
    """Time step [s] as an argument of ops: a number times an optional tensor [B].

    Args:
        dt: number, or tensor of shape [], [1] or [B].

    Raises:
        TypeError: for other types.
        ValueError: for a number that is not positive and finite in the dtype of x, or a wrong shape or device. Values
            of a tensor are not read, so that the device is not synchronised.
    """
    check_kind_of_dt(dt)
    if not isinstance(dt, Tensor):
        if not 0 < dt <= LARGEST.get(x.dtype, math.inf):
            raise ValueError(f"dt must be a positive number of seconds, got {dt} in {x.dtype}")
        return float(dt), None
    if dt.dim() > 1 or (dt.dim() == 1 and dt.shape[0] not in (1, scenes)):
        raise ValueError(f"dt must be a number or have shape [], [1] or [B] = [{scenes}], got {shape_of(dt)}")
    if not dt.is_floating_point():
        raise TypeError(f"dt must be a number or a floating tensor, got {dt.dtype}")
    if dt.device != x.device:
        raise ValueError(f"dt must be on the device of x, {x.device}, got {dt.device}")
    return 1.0, dt.to(x.dtype).expand(scenes)


def per_particle(value: Tensor, scene: Tensor | None, particles: int) -> Tensor:
    """A per-scene tensor [B, ...] as one row per particle; rows of particles without a scene have no meaning."""
    if value.shape[0] == 1:
        return value.expand(particles, *value.shape[1:])
    assert scene is not None
    return value.index_select(0, scene.clamp(0, value.shape[0] - 1))


def per_parameter(value: Tensor, scene: Tensor | None, particles: int) -> Tensor:
    """A parameter of shape [], [1], [B] or [P] as [P]."""
    if value.numel() == 1:
        return value.reshape(1).expand(particles)
    return value if value.numel() == particles else per_particle(value, scene, particles)


def sum_by_scene(value: Tensor, scene: Tensor | None, scenes: int) -> Tensor:
    """Sum of a per-particle tensor [P, ...] over the particles of each scene, [B, ...]; without absent particles."""
    if scene is None:
        return value.sum(0, keepdim=True)
    known = (scene >= 0) & (scene < scenes)
    value = torch.where(known.reshape(-1, *(1,) * (value.dim() - 1)), value, 0)
    return value.new_zeros(scenes, *value.shape[1:]).index_add_(0, torch.where(known, scene, 0), value)


def count_scenes(scene: Tensor) -> int | None:
    """Largest scene of a particle plus one, at least 1; None where this is unknown without waiting for a device, or
    unknown at all.
    """
    if not scene.is_cpu or is_traced(scene):
        return None
    return scenes_up_to(scene)


def scenes_up_to(scene: Tensor) -> int:
    """Largest scene of a particle plus one, at least 1; waits for the device."""
    return max(int(scene.max()) + 1, 1) if scene.numel() else 1


def soa_empty(like: Tensor, shape: Sequence[int]) -> Tensor:
    """An empty [P, ...] tensor with a contiguous particle index, in the form of results of ops
    (csrc/common/tensors.h).
    """
    pitch = shape[0]
    if like.device.type == "cpu":  # `particle_pitch` gives the reason.
        lines = -(-shape[0] * like.element_size() // 64)
        pitch = ((lines + 40) // 64 * 64 + 23) * 64 // like.element_size()
    strides = [1]
    for i in range(1, len(shape)):
        strides.append(pitch * math.prod(shape[i + 1 :]))
    return like.new_empty_strided(shape, strides)


def differentiate(
    function: Callable[..., Tensor | tuple[Tensor, ...]],
    inputs: Sequence[Tensor | None],
    grad_outputs: Sequence[Tensor | None],
) -> list[Tensor | None]:
    """Gradients of a composition of differentiable ops with respect to its tensor inputs; itself differentiable."""
    if torch._C._are_functorch_transforms_active():
        return _pull_back(function, inputs, grad_outputs)
    differentiable = torch.is_grad_enabled()
    with torch.enable_grad():
        # Aliases, because an input may depend on another one, whose share is not part of this composition.
        leaves = [t if t is None else t.view_as(t) if t.requires_grad else t.detach().requires_grad_() for t in inputs]
        outputs = function(*leaves)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        pairs = [(y, g) for y, g in zip(outputs, grad_outputs, strict=True) if g is not None and y.requires_grad]
        wanted = [t for t in leaves if t is not None]
        if not pairs or not wanted:
            return [None] * len(leaves)
        grads = torch.autograd.grad(
            [y for y, _ in pairs], wanted, [g for _, g in pairs], create_graph=differentiable, allow_unused=True
        )
    result = iter(grads)
    return [None if t is None else next(result) for t in leaves]


def _pull_back(
    function: Callable[..., Tensor | tuple[Tensor, ...]],
    inputs: Sequence[Tensor | None],
    grad_outputs: Sequence[Tensor | None],
) -> list[Tensor | None]:
    """As `differentiate`, inside a transform of torch.func, which forbids `requires_grad_`."""
    wanted = [i for i, t in enumerate(inputs) if t is not None]

    def outputs(*given: Tensor) -> tuple[Tensor, ...]:
        arguments = list(inputs)
        for i, t in zip(wanted, given, strict=True):
            arguments[i] = t
        result = function(*arguments)
        result = result if isinstance(result, tuple) else (result,)
        return tuple(y for y, g in zip(result, grad_outputs, strict=True) if g is not None)

    _, pull_back, *_ = torch.func.vjp(outputs, *(inputs[i] for i in wanted))
    grads = dict(zip(wanted, pull_back(tuple(g for g in grad_outputs if g is not None)), strict=True))
    return [grads.get(i) for i in range(len(inputs))]


def check_choice(name: str, value: object, choices: Iterable[str]) -> None:
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {sorted(choices)}, got {value!r}")


def check_parameter(name: str, value: Tensor, state: Tensor, scene: Tensor | None, scenes: int | None = None) -> None:
    """Check a parameter of a law: uniform, per scene or per particle; per particle is assumed where P = B."""
    P = state.shape[0]
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
    if value.dim() > 1 or value.numel() not in (1, P):
        least = None if scene is None or scenes is not None else count_scenes(scene)
        wrong = value.numel() != scenes if scenes is not None else value.numel() < (least or 1)
        if value.dim() > 1 or scene is None or wrong:
            batch = " without scene" if scene is None else ", or [B]"
            known = f" with B = {scenes}" if scenes is not None else f" with B at least {least}" if least else ""
            raise ValueError(f"{name} must have shape [], [1] or [P] = [{P}]{batch}, got {shape_of(value)}{known}")
    if value.dtype != state.dtype or value.device != state.device:
        check_like(name, value, state, tuple(value.shape), "")


def check_list(name: str, values: Any) -> Sequence[Any]:
    if not isinstance(values, (list, tuple)):
        raise TypeError(f"{name} must be a list, got {type(values).__name__}")
    return values


def check_tensors(law: str, kind: str, quantities: Sequence[Any], values: Sequence[Tensor]) -> None:
    """Check the number of tensors against the parameters or history variables of a law."""
    if len(check_list(kind, values)) != len(quantities):
        names = [q.name for q in quantities]
        raise ValueError(f"{law} has the {kind} {', '.join(names) or 'none'}, got {len(values)} tensors")


def sizes(t: Tensor, name: str, rank: int) -> torch.Size:
    """Shape of an argument of a fake kernel; the op itself checks the rank."""
    if t.dim() != rank:
        raise ValueError(f"{name} must have {rank} dimensions, got shape {shape_of(t)}")
    return t.shape


def refuse_vmap(name: str) -> None:
    """Raise an error with the alternative in `torch.vmap` over an op, and so in `torch.func.jacrev` and `hessian`."""

    def vmap(info: Any, in_dims: Any, *args: Any, **kwargs: Any) -> Any:
        raise no_vmap(f"torch_mpm::{name}")

    torch.library.register_vmap(f"torch_mpm::{name}", vmap)


def no_vmap(name: str) -> NotImplementedError:
    """Error for unsupported uses of `torch.vmap`."""
    return NotImplementedError(
        f"torch.vmap over {name} is not supported: pack the scenes into one call with `scene` and Grid(scenes=B), with "
        "parameters, gravity and dt of shape [B]; instead of torch.func.jacrev or hessian use those of "
        "torch.autograd.functional, or a loop over rows"
    )


def refuse_batched(name: str, value: Any) -> None:
    """Raise for a batched tensor inside `torch.vmap`."""
    if torch.compiler.is_compiling() or not isinstance(value, Tensor):
        return
    if torch._C._functorch.is_batchedtensor(value):
        raise no_vmap(name)
