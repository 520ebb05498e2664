"""The compiled laws (csrc/laws): update with stress, energy and moduli; Python wrappers, fake kernels and autograd."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import FLOATING, check_count, check_flag, check_index, check_like, shape_of
from .arguments import check_choice, check_parameter, check_tensors, refuse_vmap, sizes, soa_empty, sum_by_scene
from .autograd import dispatch, register_autograd
from .implicit import tangent_entries
from .registry import LAWS, LawInfo

ELASTIC, PLASTIC, APEX, INVALID = 0, 1, 2, 3
"""Branches of an update. States at the apex of a yield surface flow too."""
NOT_CONVERGED = 4
DISSIPATED, MULTIPLIER, BRANCH = 1, 2, 4
"""Bits of `details` in csrc/laws/law.op.cpp."""
STATE, VELOCITY_GRADIENT, PARAMETERS, HISTORY = 1, 2, 4, 8
"""Bits of `needs` in csrc/laws/law.op.cpp."""

Tensors = Sequence[Tensor]


class LawUpdate(NamedTuple):
    """Result of `law_update`."""

    state: Tensor
    """F [P, D, D] after the return map, bitwise the trial one where elastic; J [P] of a fluid, unchanged."""
    stress: Tensor
    """Kirchhoff stress τ [P, D, D] [Pa] of that state, stored as structure of arrays."""
    history: tuple[Tensor, ...]
    """History variables after the update, each in its original shape."""
    dissipated: Tensor | None
    """Energy that the map turns into heat, per rest volume [P] [J/m³], not negative. With details.

    The plastic work τ · (h − H) of the mapped stress on the plastic increment of the Hencky strains (backward Euler;
    Simo and Hughes 1998), minus the energy stored by hardening, plus the energy that is lost at once (see `ReturnMap`
    for sand).
    """
    multiplier: Tensor | None
    """Length of the plastic increment of the Hencky strains, trial less mapped [P]. With details."""
    branch: Tensor | None
    """int32 [P]: ELASTIC = 0, PLASTIC = 1, APEX = 2 (sand), INVALID = 3. With details."""
    converged: Tensor | None
    """bool [P]: whether the root of the flow rule was found. With details."""


def law_update(
    law: str,
    state: Tensor,
    parameters: Tensors,
    history: Tensors = (),
    C: Tensor | None = None,
    scene: Tensor | None = None,
    dim: int | None = None,
    options: Sequence[str] = (),
    details: bool | int = False,
    scenes: int | None = None,
) -> LawUpdate:
    """Return map and Kirchhoff stress of a compiled law.

    Args:
        law: a name in `torch_mpm.ops.LAWS`, which lists its parameters, history and options.
        state: trial deformation gradient F [P, D, D], or the volume ratio J [P] of a fluid; float32 or float64.
        parameters: parameters of the law, in its order; each of shape [], [1], [B] (with `scene`) or [P] (also where P
            = B).
        history: history variables of the law, [P] or [P, D, D] each.
        C: velocity gradient [P, D, D] [1/s] of a viscous law; None at rest.
        scene: scene of each particle, int32 [P].
        dim: D; needed where the state is J.
        options: names of switches of the law.
        details: whether to return dissipated energy, multiplier, branch and convergence too; or some of them, as bits.
        scenes: number of scenes B of parameters [B]. None for any number above the largest scene; on CUDA that one is
            unknown, and a particle of a scene without an entry is invalid.

    A state that is not finite, of det F ≤ 0 or J ≤ 0, or with a stress that overflows, is returned unchanged with its
    history, with zero stress and no derivatives.

    Differentiable: every floating result with respect to state, parameters, C and history; twice in eager mode where
        the law supports it. On a boundary between branches the derivative is that of one of them; at equal principal
        stretches it is correct.

    Raises:
        ValueError, TypeError: for an unknown law or option, or wrong shapes, dtypes or devices.
    """
    dim = _check(law, state, parameters, history, scene, dim, scenes, options)
    if C is not None and not LAWS[law].viscous:
        raise ValueError(f"{law} has no viscosity: C must be None")
    check_like("C", C, state, (state.shape[0], dim, dim), "[P, D, D]")
    if not isinstance(details, int):
        raise TypeError(f"details must be True, False or bits, got {details!r}")
    bits = option_bits(law, options) if options else 0
    wanted = (DISSIPATED | MULTIPLIER | BRANCH if details else 0) if isinstance(details, bool) else details
    mapped, stress, moved, dissipated, multiplier, code = dispatch(
        torch.ops.torch_mpm.law_update, state, C, parameters, history, scene, law, dim, bits, wanted
    )
    return LawUpdate(
        state if mapped is None else mapped,
        stress,
        _split(moved, history) if history else (),
        dissipated,
        multiplier,
        None if code is None else code & 3,
        None if code is None else code < NOT_CONVERGED,
    )


def option_bits(law: str, options: Sequence[str]) -> int:
    """Names of options as the bits of the compiled law."""
    bits = 0
    for option in options:
        check_choice("an option", option, LAWS[law].options)
        bits |= 1 << LAWS[law].options.index(option)
    return bits


def law_energy(
    law: str,
    state: Tensor,
    parameters: Tensors,
    history: Tensors = (),
    scene: Tensor | None = None,
    dim: int | None = None,
    scenes: int | None = None,
) -> Tensor:
    """Elastic energy per rest volume ψ [P] [J/m³] of the state itself; infinite where `law_update` has no stress.

    Arguments as `law_update`; differentiable in the same way.
    """
    dim = _check(law, state, parameters, history, scene, dim, scenes)
    return dispatch(torch.ops.torch_mpm.law_energy, state, parameters, history, scene, law, dim)


def law_stiffness(
    law: str,
    state: Tensor,
    parameters: Tensors,
    history: Tensors = (),
    scene: Tensor | None = None,
    dim: int | None = None,
    scenes: int | None = None,
) -> Tensor:
    """Upper bound [P] [Pa] of the elastic tangent modulus over all velocity gradients of unit norm, after the map.

    Zero where the stress is zero; not differentiable. Arguments as `law_update`.
    """
    dim = _check(law, state, parameters, history, scene, dim, scenes)
    return torch.ops.torch_mpm.law_stiffness(state, parameters, history, scene, law, dim)


def law_wave_modulus(
    law: str,
    state: Tensor,
    parameters: Tensors,
    history: Tensors = (),
    scene: Tensor | None = None,
    dim: int | None = None,
    scenes: int | None = None,
) -> Tensor:
    """ρ₀ c² [P] [Pa] of the fastest elastic plane wave in the material after the map, or an upper bound.

    Zero where the stress is zero; not differentiable. Arguments as `law_update`.
    """
    dim = _check(law, state, parameters, history, scene, dim, scenes)
    return torch.ops.torch_mpm.law_wave_modulus(state, parameters, history, scene, law, dim)


def law_energy_gradient(
    law: str,
    state: Tensor,
    parameters: Tensors,
    history: Tensors = (),
    scene: Tensor | None = None,
    dim: int | None = None,
    scenes: int | None = None,
) -> Tensor:
    """∂ψ/∂F [P, D, D] or ∂ψ/∂J [P] [Pa] of the state itself, without a return map; zero where ψ is infinite.

    Arguments as `law_update`. Differentiable with respect to state and parameters for laws with
    `twice_differentiable_energy`.
    """
    dim = _check(law, state, parameters, history, scene, dim, scenes)
    by_state, _, _ = dispatch(
        torch.ops.torch_mpm.law_energy_backward,
        *(torch.ones_like(state[:, 0, 0] if state.dim() == 3 else state), state, parameters, history, scene),
        *(law, dim, STATE),
    )
    return by_state


def law_tangent(
    law: str,
    state: Tensor,
    before: Tensor,
    weight: Tensor,
    parameters: Tensors,
    history: Tensors = (),
    scene: Tensor | None = None,
    dim: int | None = None,
    projected: bool = True,
    scenes: int | None = None,
) -> Tensor:
    """Second derivative of the energy of each particle by velocity gradients L, in the form of csrc/laws/tangent.h.

    A trial deformation F changes by dF = L F₀, or J by dJ = J₀ tr L; the second derivative maps L to dP F₀ᵀ. It is
    stored in principal axes (Teran et al. 2005): [P, 30] in 3-D, [P, 13] in 2-D, zero for meaningless states.

    Args:
        law: as in `law_update`.
        state: trial F [P, D, D], or J [P].
        before: F₀ or J₀, the start of the trial; of the same shape.
        weight: factor [P]: dt² V for the Hessian of an implicit step.
        parameters, history, scene, dim, scenes: as in `law_update`. History is constant, and there is no flow.
        projected: whether negative eigenvalues are removed.

    Raises:
        NotImplementedError: for a law without a tangent.
        ValueError, TypeError: as `law_update`.

    Not differentiable.
    """
    dim = _check(law, state, parameters, history, scene, dim, scenes)
    if not LAWS[law].has_tangent:
        raise NotImplementedError(f"the law {law} has no tangent, which an implicit step needs")
    check_like("before", before, state, tuple(state.shape), "as the state", needed=True)
    check_like("weight", weight, state, tuple(state.shape[:1]), "[P]", needed=True)
    projected = check_flag("projected", projected)
    return dispatch(
        torch.ops.torch_mpm.law_tangent, state, before, weight, parameters, history, scene, law, dim, projected
    )


def _check(
    law: str,
    state: Tensor,
    parameters: Tensors,
    history: Tensors,
    scene: Tensor | None,
    dim: int | None,
    scenes: int | None,
    options: Sequence[str] | None = None,
) -> int:
    """Checks shared by all ops, and those of history for the options of an op with options; returns the dimension."""
    check_choice("law", law, LAWS)
    info = LAWS[law]
    dim = _check_state(info, state, dim)
    check_index("scene", scene, state, of="the state")
    if scenes is not None:
        check_count("scenes", scenes)
    check_tensors(law, "parameters", info.parameters, parameters)
    for quantity, value in zip(info.parameters, parameters, strict=True):
        check_parameter(quantity.name, value, state, scene, scenes)
    variables = info.history if options is None else info.history_with(options)
    if info.optional_history:
        variables = variables[: len(history)]
    check_tensors(law, "history variables", variables, history)
    for quantity, value in zip(variables, history, strict=True):
        P = state.shape[0]
        if value is None:
            raise TypeError(f"{quantity.name} must be a tensor, got None")
        shape = (P, dim, dim) if quantity.matrix else (P,)
        check_like(quantity.name, value, state, shape, "[P, D, D]" if quantity.matrix else "[P]")
    return dim


def _check_state(info: LawInfo, state: Tensor, dim: int | None) -> int:
    if not isinstance(state, Tensor) or state.dtype not in FLOATING:
        raise TypeError(f"{info.field} must be float32 or float64, got {getattr(state, 'dtype', type(state).__name__)}")
    if info.field == "F":
        if state.dim() != 3 or state.shape[1:] not in ((2, 2), (3, 3)):
            raise ValueError(f"F must have shape [P, 3, 3] or [P, 2, 2], got {shape_of(state)}")
        if dim is not None and dim != state.shape[1]:
            raise ValueError(f"dim must be that of F, {state.shape[1]}, or None, got {dim!r}")
        dim = state.shape[1]
    elif state.dim() != 1:
        raise ValueError(f"J must have shape [P], got {shape_of(state)}")
    if dim is None or dim not in ((2, 3) if info.in_2d else (3,)):
        raise ValueError(f"dim must be {'2 or 3' if info.in_2d else '3'}, got {dim!r}")
    return dim


def _split(columns: Tensor, history: Tensors) -> tuple[Tensor, ...]:
    """Entries [P, m] of all history variables, one view each."""
    result, first = [], 0
    for variable in history:
        if variable.dim() == 1:
            result.append(columns[:, first])
            first += 1
        else:
            D = variable.shape[1]
            result.append(columns[:, first : first + D * D].unflatten(1, (D, D)))
            first += D * D
    return tuple(result)


def _entries(history: Tensors) -> int:
    return sum(h.shape[1] ** 2 if h.dim() == 3 else 1 for h in history)


# ---- fake kernels: shapes and strides only


def _particles(state: Tensor) -> int:
    return sizes(state, "the state", 3 if state.dim() == 3 else 1)[0]


@torch.library.register_fake("torch_mpm::law_update")
def _update_fake(state, C, parameters, history, scene, law, dim, options, details):
    P = _particles(state)
    check_choice("law", law, LAWS)
    matrices = (P, dim, dim)
    return (
        soa_empty(state, matrices) if LAWS[law].plastic else None,
        soa_empty(state, matrices),
        soa_empty(state, (P, _entries(history))) if history else None,
        state.new_empty(P) if details & DISSIPATED else None,
        state.new_empty(P) if details & MULTIPLIER else None,
        state.new_empty(P, dtype=torch.int32) if details & BRANCH else None,
    )


def _adjoints_fake(
    state: Tensor, C: Tensor | None, parameters: Tensors, history: Tensors, dim: int, needs: int
) -> tuple[Tensor | None, ...]:
    P = _particles(state)
    shapes = (tuple(state.shape), (P, dim, dim), (P, len(parameters)), (P, _entries(history)))
    by_C, by_history = needs & VELOCITY_GRADIENT and C is not None, needs & HISTORY and history
    wanted = (needs & STATE, by_C, needs & PARAMETERS, by_history)
    return tuple(soa_empty(state, s) if w else None for s, w in zip(shapes, wanted, strict=True))


@torch.library.register_fake("torch_mpm::law_update_backward")
def _update_backward_fake(
    grad_state, grad_stress, grad_history, grad_dissipated, grad_multiplier,
    state, C, parameters, history, scene, law, dim, options, needs,
):  # fmt: skip
    return _adjoints_fake(state, C, parameters, history, dim, needs)


@torch.library.register_fake("torch_mpm::law_update_double_backward")
def _update_double_backward_fake(
    along_state, along_C, along_parameters, grad_stress, state, C, parameters, scene, law, dim, needs
):
    adjoints = _adjoints_fake(state, C, parameters, (), dim, needs)
    return soa_empty(state, (_particles(state), dim, dim)), *adjoints[:3]


@torch.library.register_fake("torch_mpm::law_energy_backward")
def _energy_backward_fake(grad_energy, state, parameters, history, scene, law, dim, needs):
    by_state, _, by_parameters, by_history = _adjoints_fake(state, None, parameters, history, dim, needs)
    return by_state, by_parameters, by_history


@torch.library.register_fake("torch_mpm::law_energy_double_backward")
def _energy_double_backward_fake(along_state, along_parameters, grad_energy, state, parameters, scene, law, dim, needs):
    by_state, _, by_parameters, _ = _adjoints_fake(state, None, parameters, (), dim, needs)
    return state.new_empty(_particles(state)), by_state, by_parameters


@torch.library.register_fake("torch_mpm::law_tangent")
def _tangent_fake(state, before, weight, parameters, history, scene, law, dim, projected):
    return soa_empty(state, (_particles(state), tangent_entries(dim)))


def _scalar_fake(state, parameters, history, scene, law, dim):
    return state.new_empty(_particles(state))


# ---- autograd


def _of_parameters(grads: Tensor, parameters: Tensors, wanted: Sequence[bool], scene: Tensor | None) -> list[Any]:
    """Gradients of the parameters: those per particle [P, n], summed over the particles that share a value."""

    def shared(grad: Tensor, parameter: Tensor) -> Tensor:
        if parameter.numel() == 1:
            return grad.sum().reshape(parameter.shape)
        return grad if parameter.numel() == grad.numel() else sum_by_scene(grad, scene, parameter.numel())

    if not any(wanted):
        return [None] * len(parameters)
    pairs = zip(parameters, wanted, strict=True)
    return [shared(grads[:, k], p) if w else None for k, (p, w) in enumerate(pairs)]


def _of_history(grads: Tensor, history: Tensors, wanted: Sequence[bool]) -> list[Any]:
    if not any(wanted):
        return [None] * len(history)
    return [part if w else None for part, w in zip(_split(grads, history), wanted, strict=True)]


class _Saved:
    """Tensors of a call in one order: state, C, scene, parameters, history."""

    def __init__(self, ctx: Any) -> None:
        self.state, self.C, self.scene, *rest = ctx.saved_tensors  # Once: a checkpointed region unpacks it only once.
        self.parameters, self.history = rest[: ctx.parameters], rest[ctx.parameters :]


def _save(ctx: Any, state: Any, C: Any, scene: Any, parameters: Tensors, history: Tensors, *others: Any) -> None:
    ctx.parameters = len(parameters)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(state, C, scene, *parameters, *history, *others)


def _update_setup(ctx: Any, inputs: Any, output: Any) -> None:
    state, C, parameters, history, scene, ctx.law, ctx.dim, ctx.options, _ = inputs
    _save(ctx, state, C, scene, parameters, history)


def _update_backward(ctx, *grads):
    saved = _Saved(ctx)
    need_state, need_C, need_parameters, need_history = ctx.needs_input_grad[:4]
    needs = (
        STATE * need_state
        + VELOCITY_GRADIENT * need_C
        + PARAMETERS * any(need_parameters)
        + HISTORY * any(need_history)
    )
    given = grads[:5]
    if not needs or all(g is None for g in given):
        return None, None, [None] * len(saved.parameters), [None] * len(saved.history), *(None,) * 5
    grad_state, grad_C, grad_parameters, grad_history = dispatch(
        torch.ops.torch_mpm.law_update_backward,
        *(*given, saved.state, saved.C, saved.parameters, saved.history, saved.scene),
        *(ctx.law, ctx.dim, ctx.options, needs),
    )
    return (
        grad_state if need_state else None,
        grad_C if need_C else None,
        _of_parameters(grad_parameters, saved.parameters, need_parameters, saved.scene),
        _of_history(grad_history, saved.history, need_history),
        *(None,) * 5,
    )


def _update_backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    *grads, state, C, parameters, history, scene, ctx.law, ctx.dim, _, ctx.needs = inputs
    ctx.history = len(history)
    _save(ctx, state, C, scene, parameters, (), grads[1])


def _update_double_backward(ctx, along_state, along_C, along_parameters, _):
    _check_twice(LAWS[ctx.law].twice_differentiable, "the stress", ctx.law)
    saved = _Saved(ctx)
    (grad_stress,) = saved.history
    _, need_grad, *_, need_state, need_C, need_parameters = ctx.needs_input_grad[:8]
    nothing = (*(None,) * 7, [None] * len(saved.parameters), [None] * ctx.history, *(None,) * 5)
    along = (along_state, along_C, along_parameters)
    if grad_stress is None or all(t is None for t in along):
        return nothing
    needs = STATE * need_state + VELOCITY_GRADIENT * need_C + PARAMETERS * any(need_parameters)
    by_grad, by_state, by_C, grad_parameters = dispatch(
        torch.ops.torch_mpm.law_update_double_backward,
        *(*along, grad_stress, saved.state, saved.C, saved.parameters, saved.scene, ctx.law, ctx.dim, needs),
    )
    return (
        None,
        by_grad if need_grad else None,
        *(None,) * 3,
        by_state if need_state else None,
        by_C if need_C else None,
        _of_parameters(grad_parameters, saved.parameters, need_parameters, saved.scene),
        *nothing[8:],
    )


def _energy_setup(ctx: Any, inputs: Any, output: Any) -> None:
    state, parameters, history, scene, ctx.law, ctx.dim = inputs
    _save(ctx, state, None, scene, parameters, history)


def _energy_backward(ctx, grad):
    saved = _Saved(ctx)
    need_state, need_parameters, need_history = ctx.needs_input_grad[:3]
    needs = STATE * need_state + PARAMETERS * any(need_parameters) + HISTORY * any(need_history)
    if not needs or grad is None:
        return None, [None] * len(saved.parameters), [None] * len(saved.history), *(None,) * 3
    grad_state, grad_parameters, grad_history = dispatch(
        torch.ops.torch_mpm.law_energy_backward,
        *(grad, saved.state, saved.parameters, saved.history, saved.scene, ctx.law, ctx.dim, needs),
    )
    return (
        grad_state if need_state else None,
        _of_parameters(grad_parameters, saved.parameters, need_parameters, saved.scene),
        _of_history(grad_history, saved.history, need_history),
        *(None,) * 3,
    )


def _energy_backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    grad, state, parameters, history, scene, ctx.law, ctx.dim, ctx.needs = inputs
    ctx.history = len(history)
    _save(ctx, state, None, scene, parameters, (), grad)


def _energy_double_backward(ctx, along_state, along_parameters, _):
    _check_twice(LAWS[ctx.law].twice_differentiable_energy, "the energy", ctx.law)
    saved = _Saved(ctx)
    (grad,) = saved.history
    need_grad, need_state, need_parameters = ctx.needs_input_grad[:3]
    along = (along_state, along_parameters)
    if all(t is None for t in along):
        return None, None, [None] * len(saved.parameters), [None] * ctx.history, *(None,) * 4
    needs = STATE * need_state + PARAMETERS * any(need_parameters)
    by_grad, by_state, grad_parameters = dispatch(
        torch.ops.torch_mpm.law_energy_double_backward,
        *(*along, grad, saved.state, saved.parameters, saved.scene, ctx.law, ctx.dim, needs),
    )
    return (
        by_grad if need_grad else None,
        by_state if need_state else None,
        _of_parameters(grad_parameters, saved.parameters, need_parameters, saved.scene),
        [None] * ctx.history,
        *(None,) * 4,
    )


def _check_twice(differentiable: bool, what: str, law: str) -> None:
    if not differentiable:
        raise NotImplementedError(f"{what} of the law {law} has no second derivatives: differentiate it once")


def _no_backward(ctx, grad):
    raise NotImplementedError(
        "wave speeds, stiffness bounds and tangents are not differentiable: compute them under torch.no_grad()"
    )


def _no_third_derivative(ctx, *grads):
    raise NotImplementedError("laws have no third derivatives: differentiate them twice")


def _no_setup(ctx: Any, inputs: Any, output: Any) -> None:
    pass


for _name, _backward, _context in (
    ("law_update", _update_backward, _update_setup),
    ("law_update_backward", _update_double_backward, _update_backward_setup),
    ("law_update_double_backward", _no_third_derivative, _no_setup),
    ("law_energy", _energy_backward, _energy_setup),
    ("law_energy_backward", _energy_double_backward, _energy_backward_setup),
    ("law_energy_double_backward", _no_third_derivative, _no_setup),
    ("law_stiffness", _no_backward, _no_setup),
    ("law_tangent", _no_backward, _no_setup),
    ("law_wave_modulus", _no_backward, _no_setup),
):
    register_autograd(_name, _backward, _context)
    refuse_vmap(_name)
for _name in ("law_energy", "law_stiffness", "law_wave_modulus"):
    torch.library.register_fake(f"torch_mpm::{_name}", _scalar_fake)
