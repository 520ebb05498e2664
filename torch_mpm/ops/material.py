"""Stress, energy and moduli of the compiled laws (csrc/laws): Python faces, fake kernels and autograd."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import FLOATING, check_index, check_like, shape_of
from ..reference import material as reference
from .arguments import (
    check_choice,
    check_parameter,
    check_tensors,
    differentiate,
    refuse_vmap,
    sizes,
    soa_empty,
    sum_by_scene,
)
from .autograd import dispatch, register_autograd

Parameters = Sequence[Tensor]


def material_stress(
    law: str,
    state: Tensor,
    parameters: Parameters,
    C: Tensor | None = None,
    scene: Tensor | None = None,
    dim: int | None = None,
) -> Tensor:
    """Kirchhoff stress τ [P, D, D] [Pa] of a compiled law, stored as structure of arrays.

    Args:
        law: "neo_hookean", "weakly_compressible" or "viscous_fluid"; see `torch_mpm.reference.material` for formulas.
        state: deformation gradient F [P, D, D], or the volume ratio J [P] of a fluid.
        parameters: of the law, in its order; each of shape [], [1], [B] (with `scene`) or [P] (also where
            P = B).
        C: velocity gradient [P, D, D] [1/s] of "viscous_fluid"; None for a fluid at rest.
        scene: scene of each particle, int32 [P].
        dim: D; needed where the state is J.

    Zero where det F or J is not positive, or the stress is not finite.

    Raises:
        ValueError, TypeError: for an unknown law, or wrong shapes, dtypes or devices.

    Differentiable with respect to state, parameters and C, twice in eager mode.
    """
    dim = _check(law, state, parameters, scene, dim)
    if C is not None and not reference.LAWS[law].viscous:
        raise ValueError(f"{law} has no viscosity: C must be None")
    check_like("C", C, state, (state.shape[0], dim, dim), "[P, D, D]")
    return dispatch(torch.ops.torch_mpm.material_stress, state, C, scene, parameters, law, dim)


def material_energy(
    law: str, state: Tensor, parameters: Parameters, scene: Tensor | None = None, dim: int | None = None
) -> Tensor:
    """Elastic energy per rest volume ψ [P] [Pa]; infinite where det F or J is not positive.

    Arguments as `material_stress`. Evaluated in float64 inside: near rest it is a small difference of large terms.

    Differentiable with respect to state and parameters, twice in eager mode.
    """
    dim = _check(law, state, parameters, scene, dim)
    return dispatch(torch.ops.torch_mpm.material_energy, state, scene, parameters, law, dim)


def material_wave_modulus(
    law: str, state: Tensor, parameters: Parameters, scene: Tensor | None = None, dim: int | None = None
) -> Tensor:
    """ρ₀ c² [P] [Pa] of the fastest elastic plane wave in the deformed material, never too small and at most 4/3 of it.

    Zero where the stress is; not differentiable. Arguments as `material_stress`.
    """
    dim = _check(law, state, parameters, scene, dim)
    return torch.ops.torch_mpm.material_wave_modulus(state, scene, parameters, law, dim)


def material_stiffness(
    law: str, state: Tensor, parameters: Parameters, scene: Tensor | None = None, dim: int | None = None
) -> Tensor:
    """Upper bound [P] [Pa] of the tangent modulus over all velocity gradients of unit norm, waves or not.

    Zero where the stress is; not differentiable. Arguments as `material_stress`.
    """
    dim = _check(law, state, parameters, scene, dim)
    return torch.ops.torch_mpm.material_stiffness(state, scene, parameters, law, dim)


def _check(law: str, state: Tensor, parameters: Parameters, scene: Tensor | None, dim: int | None) -> int:
    """Check all arguments but C; return the dimension."""
    check_choice("law", law, reference.LAWS)
    names, shear = reference.LAWS[law].parameters, reference.LAWS[law].shear
    if not isinstance(state, Tensor) or state.dtype not in FLOATING:
        raise TypeError(f"the state must be float32 or float64, got {getattr(state, 'dtype', type(state).__name__)}")
    if shear:
        if state.dim() != 3 or state.shape[1:] not in ((2, 2), (3, 3)):
            raise ValueError(f"F must have shape [P, 3, 3] or [P, 2, 2], got {shape_of(state)}")
        dim = state.shape[1]
    elif state.dim() != 1:
        raise ValueError(f"J must have shape [P], got {shape_of(state)}")
    if dim not in (2, 3):
        raise ValueError(f"dim must be 2 or 3, got {dim}")
    check_index("scene", scene, state, of="the state")
    check_tensors(law, "parameters", names, parameters)
    for name, value in zip(names, parameters, strict=True):
        check_parameter(name, value, state, scene)
    return dim


# ---- fake kernels: shapes and strides only


def _particles(state: Tensor) -> int:
    return sizes(state, "the state", 3 if state.dim() == 3 else 1)[0]


@torch.library.register_fake("torch_mpm::material_stress")
def _stress_fake(state, C, scene, parameters, law, dim):
    return soa_empty(state, (_particles(state), dim, dim))


def _adjoints_fake(state: Tensor, C: Tensor | None, parameters: Parameters, dim: int, needs: int) -> tuple[Tensor, ...]:
    P = _particles(state)
    shapes = (tuple(state.shape), (P, dim, dim), (P, len(parameters)))
    wanted = (needs & 1, needs & 2 and C is not None, needs & 4)
    return tuple(soa_empty(state, s) if w else state.new_empty(0) for s, w in zip(shapes, wanted, strict=True))


@torch.library.register_fake("torch_mpm::material_stress_backward")
def _stress_backward_fake(grad, state, C, scene, parameters, law, dim, needs):
    return _adjoints_fake(state, C, parameters, dim, needs)


@torch.library.register_fake("torch_mpm::material_energy_backward")
def _energy_backward_fake(grad, state, scene, parameters, law, dim, needs):
    grad_state, _, grad_parameters = _adjoints_fake(state, None, parameters, dim, needs)
    return grad_state, grad_parameters


def _scalar_fake(state, scene, parameters, law, dim):
    return state.new_empty(_particles(state))


# ---- autograd


def _sum_parameter(grad: Tensor, parameter: Tensor, scene: Tensor | None) -> Tensor:
    """The gradient per particle [P], summed over the particles that share a value."""
    if parameter.numel() == 1:
        return grad.sum().reshape(parameter.shape)
    if parameter.numel() == grad.numel():
        return grad
    return sum_by_scene(grad, scene, parameter.numel())


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    *tensors, parameters, ctx.law, ctx.dim = inputs
    ctx.save_for_backward(*tensors, *parameters)


def _shared_gradients(ctx: Any, grad: Tensor, parameters: Parameters, scene: Tensor | None) -> list[Tensor | None]:
    """Gradients of the parameters from those per particle [P, n]."""
    needed = ctx.needs_input_grad[-3]
    needed = [needed] * len(parameters) if isinstance(needed, bool) else needed
    return [
        _sum_parameter(grad[:, k], p, scene) if n else None
        for k, (p, n) in enumerate(zip(parameters, needed, strict=True))
    ]


def _needs(ctx: Any) -> int:
    """Bits for state 1, C 2, parameters 4, as csrc/laws/arguments.h has them."""
    need = ctx.needs_input_grad
    parameters = need[-3] if isinstance(need[-3], bool) else any(need[-3])
    return int(need[0]) | 2 * int(len(need) == 6 and need[1]) | 4 * int(parameters)


def _stress_backward(ctx, grad):
    state, C, scene, *parameters = ctx.saved_tensors
    needs = _needs(ctx)
    grad_state, grad_C, grad_parameters = dispatch(
        torch.ops.torch_mpm.material_stress_backward, grad, state, C, scene, parameters, ctx.law, ctx.dim, needs
    )
    shared = _shared_gradients(ctx, grad_parameters, parameters, scene) if needs & 4 else [None] * len(parameters)
    return grad_state if needs & 1 else None, grad_C if needs & 2 else None, None, shared, None, None


def _energy_backward(ctx, grad):
    state, scene, *parameters = ctx.saved_tensors
    needs = _needs(ctx)
    grad_state, grad_parameters = dispatch(
        torch.ops.torch_mpm.material_energy_backward, grad, state, scene, parameters, ctx.law, ctx.dim, needs
    )
    shared = _shared_gradients(ctx, grad_parameters, parameters, scene) if needs & 4 else [None] * len(parameters)
    return grad_state if needs & 1 else None, None, shared, None, None


def _backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    *tensors, parameters, ctx.law, ctx.dim, ctx.needs = inputs
    ctx.save_for_backward(*tensors, *parameters)


def _stress_double_backward(ctx, *grads):
    grad, state, C, scene, *parameters = ctx.saved_tensors

    def evaluate(state, C, *parameters):
        return reference.stress(ctx.law, state, parameters, C, None, ctx.dim)

    grad, state, C, *shared = _differentiate_adjoint(ctx, evaluate, (grad, state, C, *parameters), scene, grads)
    return grad, state, C, None, shared, None, None, None


def _energy_double_backward(ctx, grad_state, grad_parameters):
    grad, state, scene, *parameters = ctx.saved_tensors

    def evaluate(state, C, *parameters):
        return reference.energy(ctx.law, state, parameters, None, ctx.dim)

    inputs = (grad, state, None, *parameters)
    grad, state, _, *shared = _differentiate_adjoint(ctx, evaluate, inputs, scene, (grad_state, None, grad_parameters))
    return grad, state, None, shared, None, None, None


def _differentiate_adjoint(
    ctx: Any,
    evaluate: Callable[..., Tensor],
    inputs: Sequence[Tensor | None],
    scene: Tensor | None,
    grads: Sequence[Tensor | None],
) -> list[Tensor | None]:
    """Derivatives of a backward op by its inputs (grad, state, C, parameters...), from the reference in plain torch.

    `grads` belong to its outputs: the adjoints of state, C and, per particle, the parameters [P, n].
    """
    wanted = [bool(ctx.needs >> i & 1) for i in range(3)]

    def adjoint(grad, state, C, *parameters):
        values = [reference.per_particle(p, scene, state.shape[0]) for p in parameters]
        grad_state, grad_C, *shared = differentiate(evaluate, (state, C, *values), [grad])
        zero = state.new_zeros(state.shape[0])
        grad_parameters = torch.stack([zero if g is None else g for g in shared], 1)
        return tuple(g for g, w in zip((grad_state, grad_C, grad_parameters), wanted, strict=True) if w)

    return differentiate(adjoint, inputs, [g for g, w in zip(grads, wanted, strict=True) if w])


def _no_backward(ctx, grad):
    raise NotImplementedError(
        "wave speeds and stiffness bounds are not differentiable: compute them under torch.no_grad()"
    )


def _no_setup(ctx: Any, inputs: Any, output: Any) -> None:
    pass


for _name, _backward, _context in (
    ("material_stress", _stress_backward, _setup),
    ("material_energy", _energy_backward, _setup),
    ("material_stress_backward", _stress_double_backward, _backward_setup),
    ("material_energy_backward", _energy_double_backward, _backward_setup),
    ("material_wave_modulus", _no_backward, _no_setup),
    ("material_stiffness", _no_backward, _no_setup),
):
    register_autograd(_name, _backward, _context)
    refuse_vmap(_name)
for _name in ("material_energy", "material_wave_modulus", "material_stiffness"):
    torch.library.register_fake(f"torch_mpm::{_name}", _scalar_fake)
