"""Laws in principal strains (csrc/laws/principal*.h): return map with stress, energy, moduli."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import FLOATING, check_index, check_like, shape_of
from ..reference.principal import ELASTIC, INVALID, LAWS, PLASTIC
from .arguments import (
    check_choice,
    check_parameter,
    check_tensors,
    refuse_vmap,
    sizes,
    soa_empty,
    sum_by_scene,
)
from .autograd import dispatch, register_autograd
from .material import _no_backward, _no_setup

__all__ = [
    "ELASTIC",
    "INVALID",
    "PLASTIC",
    "PrincipalUpdate",
    "principal_energy",
    "principal_stiffness",
    "principal_update",
    "principal_wave_modulus",
]

Tensors = Sequence[Tensor]


class PrincipalUpdate(NamedTuple):
    """Result of `principal_update`."""

    F: Tensor
    """Deformation gradient after the return map [P, D, D]; bitwise the trial one where elastic."""
    stress: Tensor
    """Kirchhoff stress τ [P, D, D] [Pa] of that F."""
    history: tuple[Tensor, ...]
    """History variables after the return map, [P] each."""
    dissipated: Tensor | None
    """Energy that the map turns into heat, per rest volume [P] [J/m³], not negative. With details only.

    It is the plastic work τ · (h − H) of the mapped stress on the plastic increment of the Hencky strains (backward
    Euler; Simo and Hughes 1998) less what hardening stores: ½ H ε̄² of "von_mises", what "snow" adds to its elastic
    energy, nothing of the others.
    """
    branch: Tensor | None
    """int32 [P]: ELASTIC = 0, PLASTIC = 1, INVALID = 3 (det F ≤ 0, not finite, or it overflows). With details only."""
    converged: Tensor | None
    """bool [P]: whether the root of the flow rule was found. With details only."""


def principal_update(
    law: str,
    F: Tensor,
    parameters: Tensors,
    history: Tensors = (),
    scene: Tensor | None = None,
    details: bool = False,
) -> PrincipalUpdate:
    """Return map and stress of a law in principal strains: one decomposition of F.

    Args:
        law: "fixed_corotated", "hencky", "von_mises", "herschel_bulkley", "snow" or "cam_clay"; their formulas, and the
            names and order of parameters and history, are in `torch_mpm.reference.principal`.
        F: trial deformation gradient [P, 3, 3] or [P, 2, 2], float32 or float64.
        parameters: of the law, in its order; each of shape [], [1], [B] (with `scene`) or [P] (also where P = B).
        history: history variables of the law, [P] each.
        scene: scene of each particle, int32 [P].
        details: also return dissipated energy, branch and convergence.

    A trial F that is not finite or of det F ≤ 0 is returned as it is with its history, and has zero stress.

    Differentiable once: F, stress, history and dissipated energy with respect to F, parameters and history, by dual
    numbers in principal axes, implicit differentiation at roots, and divided differences that hold at equal stretches.
    On a boundary between branches the derivative is that of the elastic branch.

    Raises:
        ValueError, TypeError: for an unknown law, or wrong shapes, dtypes or devices.
    """
    _check(law, F, parameters, history, scene)
    mapped, stress, moved, dissipated, code = dispatch(
        torch.ops.torch_mpm.principal_update, F, parameters, history, scene, law, details
    )
    return PrincipalUpdate(
        mapped if LAWS[law].flow is not None else F,
        stress,
        tuple(moved[:, k] for k in range(len(history))),
        dissipated if details else None,
        code & 3 if details else None,
        code < 4 if details else None,
    )


def principal_energy(
    law: str, F: Tensor, parameters: Tensors, history: Tensors = (), scene: Tensor | None = None
) -> Tensor:
    """Elastic energy per rest volume [P] [J/m³] of F itself; infinite where det F ≤ 0 or it is not finite.

    Arguments as `principal_update`; differentiable once with respect to F, parameters and history.
    """
    _check(law, F, parameters, history, scene)
    return dispatch(torch.ops.torch_mpm.principal_energy, F, parameters, history, scene, law)


def principal_stiffness(
    law: str, F: Tensor, parameters: Tensors, history: Tensors = (), scene: Tensor | None = None
) -> Tensor:
    """Upper bound [P] [Pa] of the elastic tangent modulus over all velocity gradients of unit norm, after the map.

    Zero where the stress is; not differentiable. Arguments as `principal_update`.
    """
    _check(law, F, parameters, history, scene)
    return torch.ops.torch_mpm.principal_stiffness(F, parameters, history, scene, law)


def principal_wave_modulus(
    law: str, F: Tensor, parameters: Tensors, history: Tensors = (), scene: Tensor | None = None
) -> Tensor:
    """Upper bound [P] [Pa] of ρ₀ c² of elastic plane waves in the material after the map, exact at rest.

    Zero where the stress is; not differentiable. Arguments as `principal_update`.
    """
    _check(law, F, parameters, history, scene)
    return torch.ops.torch_mpm.principal_wave_modulus(F, parameters, history, scene, law)


def _check(law: str, F: Tensor, parameters: Tensors, history: Tensors, scene: Tensor | None) -> None:
    check_choice("law", law, LAWS)
    if not isinstance(F, Tensor) or F.dim() != 3 or F.shape[1:] not in ((2, 2), (3, 3)):
        raise ValueError(f"F must have shape [P, 3, 3] or [P, 2, 2], got {shape_of(F)}")
    if F.dtype not in FLOATING:
        raise TypeError(f"F must be float32 or float64, got {F.dtype}")
    check_index("scene", scene, F, of="F")
    check_tensors(law, "parameters", LAWS[law].parameters, parameters)
    check_tensors(law, "history variables", LAWS[law].history, history)
    for name, value in zip(LAWS[law].parameters, parameters, strict=True):
        check_parameter(name, value, F, scene)
    for name, value in zip(LAWS[law].history, history, strict=True):
        if value is None:
            raise TypeError(f"{name} must be a tensor, got None")
        check_like(name, value, F, F.shape[:1], "[P]")


# ---- fake kernels


@torch.library.register_fake("torch_mpm::principal_update")
def _update_fake(F, parameters, history, scene, law, details):
    P = sizes(F, "F", 3)[0]
    check_choice("law", law, LAWS)
    return (
        soa_empty(F, F.shape) if LAWS[law].flow is not None else F.new_empty(0),
        soa_empty(F, F.shape),
        soa_empty(F, (P, len(history))),
        F.new_empty(P if details else 0),
        F.new_empty(P if details else 0, dtype=torch.int32),
    )


def _adjoints_fake(F: Tensor, parameters: Tensors, history: Tensors, needs: int) -> tuple[Tensor, ...]:
    P = sizes(F, "F", 3)[0]
    shapes = (tuple(F.shape), (P, len(parameters)), (P, len(history)))
    return tuple(soa_empty(F, s) if needs >> i & 1 else F.new_empty(0) for i, s in enumerate(shapes))


@torch.library.register_fake("torch_mpm::principal_update_backward")
def _update_backward_fake(
    grad_F, grad_stress, grad_history, grad_dissipated, F, parameters, history, scene, law, needs
):
    return _adjoints_fake(F, parameters, history, needs)


@torch.library.register_fake("torch_mpm::principal_energy_backward")
def _energy_backward_fake(grad_energy, F, parameters, history, scene, law, needs):
    return _adjoints_fake(F, parameters, history, needs)


def _scalar_fake(F, parameters, history, scene, law):
    return F.new_empty(sizes(F, "F", 3)[0])


# ---- autograd


def _needed(need: bool | Sequence[bool], count: int) -> list[bool]:
    """Which tensors of a list need a gradient."""
    return [need] * count if isinstance(need, bool) else list(need)


def _gradients(ctx: Any, op: Any, grads: Sequence[Tensor | None]) -> tuple[Any, Any, Any]:
    """Gradients of F, parameters and history by a backward op."""
    F, scene, *rest = ctx.saved_tensors
    parameters, history = rest[: ctx.parameters], rest[ctx.parameters :]
    wanted = [_needed(n, len(t)) for n, t in zip(ctx.needs_input_grad[1:3], (parameters, history), strict=True)]
    needs = int(ctx.needs_input_grad[0]) | 2 * any(wanted[0]) | 4 * any(wanted[1])
    if not needs or all(g is None for g in grads):
        return None, [None] * len(parameters), [None] * len(history)
    grad_F, grad_parameters, grad_history = op(*grads, F, parameters, history, scene, ctx.law, needs)

    def shared(k: int, parameter: Tensor) -> Tensor:
        grad = grad_parameters[:, k]
        if parameter.numel() == 1:
            return grad.sum().reshape(parameter.shape)
        return grad if parameter.numel() == grad.numel() else sum_by_scene(grad, scene, parameter.numel())

    return (
        grad_F if needs & 1 else None,
        [shared(k, p) if w else None for k, (p, w) in enumerate(zip(parameters, wanted[0], strict=True))],
        [grad_history[:, k] if w else None for k, w in enumerate(wanted[1])],
    )


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    F, parameters, history, scene, ctx.law = inputs[:5]
    ctx.parameters = len(parameters)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(F, scene, *parameters, *history)


def _update_backward(ctx, grad_F, grad_stress, grad_history, grad_dissipated, _):
    grads = [g if g is not None and g.numel() else None for g in (grad_F, grad_stress, grad_history, grad_dissipated)]
    return *_gradients(ctx, torch.ops.torch_mpm.principal_update_backward, grads), None, None, None


def _energy_backward(ctx, grad):
    return *_gradients(ctx, torch.ops.torch_mpm.principal_energy_backward, (grad,)), None, None


def _no_second_derivative(ctx, *grads):
    raise NotImplementedError("laws in principal strains have no second derivatives: differentiate them once")


for _name, _backward, _context in (
    ("principal_update", _update_backward, _setup),
    ("principal_energy", _energy_backward, _setup),
    ("principal_update_backward", _no_second_derivative, _no_setup),
    ("principal_energy_backward", _no_second_derivative, _no_setup),
    ("principal_stiffness", _no_backward, _no_setup),
    ("principal_wave_modulus", _no_backward, _no_setup),
):
    register_autograd(_name, _backward, _context)
    refuse_vmap(_name)
for _name in ("principal_energy", "principal_stiffness", "principal_wave_modulus"):
    torch.library.register_fake(f"torch_mpm::{_name}", _scalar_fake)
