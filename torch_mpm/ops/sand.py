"""Return map, stress, energy and stiffness of sand (csrc/laws/quartic*.h)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import FLOATING, NUMBER_OR_TENSOR, check_index, check_like, check_number, check_real, shape_of
from ..reference.sand import APEX, CONE, ELASTIC, ENERGIES, INVALID, friction_alpha
from .arguments import (
    check_choice,
    check_parameter,
    refuse_vmap,
    sizes,
    soa_empty,
    sum_by_scene,
)
from .autograd import dispatch, register_autograd
from .material import _no_setup

__all__ = [
    "APEX",
    "CONE",
    "ELASTIC",
    "INVALID",
    "ReturnMap",
    "quartic_energy",
    "quartic_return_map",
    "quartic_stiffness",
]

Value = float | Tensor

ANGLE = "in radians, in [0, π/2), such as 0.5236 for 30°"
"""What a friction angle must be."""


class ReturnMap(NamedTuple):
    """Result of `quartic_return_map`. The last three are None unless asked for."""

    F: Tensor
    """Projected deformation gradient [P, D, D]; bitwise the trial one where elastic."""
    stress: Tensor
    """Kirchhoff stress τ [P, D, D] [Pa] of the projected F."""
    branch: Tensor
    """int32 [P]: ELASTIC = 0, CONE = 1, APEX = 2, INVALID = 3 (det F ≤ 0 or not finite)."""
    converged: Tensor
    """bool [P]: whether the root on the cone was found."""
    multiplier: Tensor | None
    """Plastic multiplier [P]: norm of the plastic increment of the Hencky strain, trial less mapped. With details."""
    dissipated: Tensor | None
    """Energy that the map turns into heat, per rest volume [P] [J/m³], not negative. With details.

    It is the work of the mapped stress on the plastic increment, τ · (h − H) (backward Euler; Simo and Hughes 1998),
    and the elastic energy that is lost at once: of sand that tears with a cohesion, and of the axes that are compressed
    when a unilateral energy reaches the apex. Sand stores no energy by hardening.
    """
    volume_correction: Tensor | None
    """v_c [P] after the map. With a volume correction."""


def quartic_return_map(
    F: Tensor,
    mu: Value,
    lam: Value,
    friction_angle: Value | None = None,
    alpha: Value | None = None,
    scene: Tensor | None = None,
    energy: str = "unilateral",
    apex: str = "zero",
    details: bool = False,
    flow: str = "radial",
    cohesion: Value | None = None,
    volume_correction: Tensor | None = None,
) -> ReturnMap:
    """Drucker-Prager return map of sand in Hencky strains, with its stress: one decomposition of F.

    The mean strain stays, except at the apex.

    Args:
        F: trial deformation gradient [P, 3, 3] or [P, 2, 2], float32 or float64.
        mu, lam: Lamé parameters [Pa]: numbers or tensors of shape [], [1], [B] (with `scene`) or [P]. Where P = B, [P]
            is meant. Without μ > 0 there is no shear stress and therefore no cone, only the apex.
        friction_angle: [rad], 0 to π/2, like mu; or
        alpha: the slope α of the cone |dev τ| + α tr τ ≤ 0. From an angle φ it is √(2/3) 2 sin φ/(3 − sin φ) in 3-D,
            which meets Mohr-Coulomb in triaxial compression, and sin φ/√2 in 2-D, which is Mohr-Coulomb.
        scene: scene of each particle, int32 [P].
        energy: "unilateral" or "full" quartic energy; "hencky", the quadratic one (Klár et al. 2016); "mixed": map of
            the full energy, stress of the unilateral one. With the unilateral energy and α > 1/√6 (36.87° in 3-D) there
            are directions without a yield surface: such states are elastic at any stretch.
        apex: where the volume has grown, "zero" makes F a rotation; "keep" (unilateral energy only) keeps its volume
            and removes what is compressed, which is continuous and free of stress as well.
        details: also return the multiplier and the dissipated energy.
        flow: "radial": the direction of the strain deviator stays too (Gao et al. 2018, supplement, eq. 28); "exact":
            the plastic strain increment is along the deviator of the stress on the yield surface (eq. 25 to 27). They
            are the same in 2-D and for the quadratic energy. In plane strain the exact flow mobilises more friction.
        cohesion: Hencky strain c ≥ 0, like mu: the tension on every axis at the apex of the cone, h = c (1, 1, 1). The
            yield function is that of h − c. Its stress is the tensile strength, 4aμ c³ + 2aλ (D c)³ for the full
            energy and (2μ + D λ) c for the quadratic one; the unilateral energy has none in tension. Without a volume
            correction sand flows at the apex under that tension.
        volume_correction: v_c [P], logarithm of the volume that was lost at the apex, zero at first and not negative
            (Tampubolon et al. 2017). With it, what reaches the apex tears: F becomes a rotation whatever the cohesion,
            and v_c grows by log det of the trial F. Torn sand, v_c > 0, has neither stress nor cohesion until
            compression has closed the gap: the map sees h + v_c/D, is at the apex while its trace is not negative, and
            gives v_c back to F once it is. With apex="keep" F keeps the volume itself, and v_c stays zero.

    Returns:
        A `ReturnMap`. A trial F that is not finite or of det F ≤ 0 is returned as it is, with zero stress.

    Differentiable once: every floating result with respect to F, mu, lam, the angle or α, cohesion and volume
    correction, by implicit differentiation at the root and divided differences that hold at equal principal stretches.
    On a boundary between branches the derivative is that of one of them. Of float32 arguments the gradient takes
    strains and map in float64: it is right to rounding at the F that is given.

    Raises:
        ValueError, TypeError: for an unknown option, a number out of range, or wrong shapes, dtypes or devices. Values
            in tensors are not read.
    """
    if (friction_angle is None) == (alpha is None):
        raise ValueError("either friction_angle or alpha must be given")
    if apex not in ("zero", "keep"):
        raise ValueError(f"apex must be 'zero' or 'keep', got {apex!r}")
    if apex == "keep" and energy != "unilateral":
        raise ValueError(f"apex='keep' needs energy='unilateral', got {energy!r}")
    if flow not in ("radial", "exact"):
        raise ValueError(f"flow must be 'radial' or 'exact', got {flow!r}")
    _check_deformation(F, scene, energy)
    check_like("volume_correction", volume_correction, F, (F.shape[0],), "[P]")
    _check_number("friction_angle", friction_angle, ANGLE, most=math.pi / 2)
    _check_number("alpha", alpha, "finite and not negative")
    _check_number("cohesion", cohesion, "finite and not negative")
    slope = (
        friction_alpha(_parameter("friction_angle", friction_angle, F, scene), F.shape[1]) if alpha is None else alpha
    )
    parameters = [_parameter(n, v, F, scene) for n, v in (("mu", mu), ("lam", lam), ("alpha", slope))]
    shift = None if cohesion is None else _parameter("cohesion", cohesion, F, scene)
    mapped, stress, code, *scalars = dispatch(
        torch.ops.torch_mpm.quartic_return_map,
        *(F, *parameters, shift, volume_correction, scene, energy, flow, apex, details),
    )
    wanted = (details, details, volume_correction is not None)
    return ReturnMap(
        mapped, stress, code & 3, code < 4, *(t if w else None for t, w in zip(scalars, wanted, strict=True))
    )


def quartic_stress(F: Tensor, mu: Value, lam: Value, scene: Tensor | None = None, energy: str = "unilateral") -> Tensor:
    """Kirchhoff stress τ [P, D, D] [Pa] of F itself, without plasticity. Arguments as `quartic_return_map`.

    Differentiable once with respect to F, mu and lam.
    """
    _check_deformation(F, scene, energy)
    mu, lam = _parameter("mu", mu, F, scene), _parameter("lam", lam, F, scene)
    options = (scene, energy, "radial", "none", False)
    return dispatch(torch.ops.torch_mpm.quartic_return_map, F, mu, lam, mu.detach(), None, None, *options)[1]


def quartic_energy(F: Tensor, mu: Value, lam: Value, scene: Tensor | None = None, energy: str = "unilateral") -> Tensor:
    """Elastic energy per rest volume [P] [J/m³] of F itself; infinite where det F ≤ 0 or F is not finite.

    Arguments as `quartic_return_map`; differentiable with respect to F, mu and lam.
    """
    _check_deformation(F, scene, energy)
    mu, lam = _parameter("mu", mu, F, scene), _parameter("lam", lam, F, scene)
    return dispatch(torch.ops.torch_mpm.quartic_energy, F, mu, lam, scene, energy)


def quartic_stiffness(
    F: Tensor,
    mu: Value,
    lam: Value,
    scene: Tensor | None = None,
    energy: str = "unilateral",
    smallest_strain: float = 0.0,
) -> Tensor:
    """Upper bound [P] [Pa] of the elastic tangent modulus over all velocity gradients of unit norm.

    The tangent of the quartic energies grows with the square of the strain and vanishes at rest: strains below
    `smallest_strain` count as that. Zero where det F ≤ 0 or F is not finite. Other arguments as `quartic_return_map`;
    not differentiable.
    """
    _check_deformation(F, scene, energy)
    mu, lam = _parameter("mu", mu, F, scene), _parameter("lam", lam, F, scene)
    return torch.ops.torch_mpm.quartic_stiffness(F, mu, lam, scene, energy, smallest_strain)


def _check_deformation(F: Tensor, scene: Tensor | None, energy: str) -> None:
    check_choice("energy", energy, ENERGIES)
    if not isinstance(F, Tensor) or F.dim() != 3 or F.shape[1:] not in ((2, 2), (3, 3)):
        raise ValueError(f"F must have shape [P, 3, 3] or [P, 2, 2], got {shape_of(F)}")
    if F.dtype not in FLOATING:
        raise TypeError(f"F must be float32 or float64, got {F.dtype}")
    check_index("scene", scene, F, of="F")


def _check_number(name: str, value: Value | None, expected: str, most: float = math.inf) -> None:
    """A tensor is left alone: to read it would wait for its device."""
    if value is not None and not isinstance(value, Tensor):
        check_number(name, value, expected, lambda v: 0 <= v < most, NUMBER_OR_TENSOR)


def _parameter(name: str, value: Value | None, F: Tensor, scene: Tensor | None) -> Tensor:
    if not isinstance(value, Tensor):
        check_real(name, value, NUMBER_OR_TENSOR)
        return torch.tensor(value, dtype=F.dtype, device=F.device)
    check_parameter(name, value, F, scene)
    return value


# ---- fake kernels


@torch.library.register_fake("torch_mpm::quartic_return_map")
def _return_map_fake(F, mu, lam, alpha, cohesion, volume, scene, energy, flow, apex, details):
    P = sizes(F, "F", 3)[0]
    scalars = [F.new_empty(P if wanted else 0) for wanted in (details, details, volume is not None)]
    return soa_empty(F, F.shape), soa_empty(F, F.shape), F.new_empty(P, dtype=torch.int32), *scalars


@torch.library.register_fake("torch_mpm::quartic_return_map_backward")
def _return_map_backward_fake(
    grad_F, grad_stress, grad_multiplier, grad_dissipated, grad_volume,
    F, mu, lam, alpha, cohesion, volume, scene, energy, flow, apex, needs_F, needs_parameters,
):  # fmt: skip
    P = sizes(F, "F", 3)[0]
    return (
        soa_empty(F, F.shape) if needs_F else F.new_empty(0),
        soa_empty(F, (P, 4)) if needs_parameters else F.new_empty(0),
        F.new_empty(0 if volume is None else P),
    )


@torch.library.register_fake("torch_mpm::quartic_energy")
def _energy_fake(F: Tensor, mu: Tensor, lam: Tensor, scene: Tensor | None, energy: str) -> Tensor:
    return F.new_empty(sizes(F, "F", 3)[0])


@torch.library.register_fake("torch_mpm::quartic_stiffness")
def _stiffness_fake(F: Tensor, mu: Tensor, lam: Tensor, scene: Tensor | None, energy: str, floor: float) -> Tensor:
    return F.new_empty(sizes(F, "F", 3)[0])


# ---- autograd


def _shared(grad: Tensor, parameter: Tensor, scene: Tensor | None) -> Tensor:
    """The gradient per particle [P], summed over the particles that share a value."""
    if parameter.numel() == 1:
        return grad.sum().reshape(parameter.shape)
    return grad if parameter.numel() == grad.numel() else sum_by_scene(grad, scene, parameter.numel())


def _return_map_setup(ctx: Any, inputs: Any, output: Any) -> None:
    *tensors, ctx.energy, ctx.flow, ctx.apex, ctx.details = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors)


def _return_map_backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    grad_F, grad_stress, _, *details, grad_volume = grads
    saved = ctx.saved_tensors  # once: a checkpointed region unpacks a tensor only once
    _, mu, lam, alpha, cohesion, volume, scene = saved
    if not ctx.details:
        details = [None, None]
    given = [grad_F, grad_stress, *details, grad_volume if volume is not None else None]
    needs_F, *needs, needs_volume = ctx.needs_input_grad[:6]
    if all(g is None for g in given) or not (needs_F or any(needs) or needs_volume):
        return (None,) * 11
    adjoint_F, adjoint_parameters, adjoint_volume = dispatch(
        torch.ops.torch_mpm.quartic_return_map_backward,
        *(*given, *saved, ctx.energy, ctx.flow, ctx.apex, needs_F, any(needs)),
    )
    shared = [
        _shared(adjoint_parameters[:, k], p, scene) if n else None
        for k, (p, n) in enumerate(zip((mu, lam, alpha, cohesion), needs, strict=True))
    ]
    return adjoint_F if needs_F else None, *shared, adjoint_volume if needs_volume else None, *(None,) * 5


def _energy_setup(ctx: Any, inputs: Any, output: Any) -> None:
    *tensors, ctx.energy = inputs
    ctx.save_for_backward(*tensors)


def _energy_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    """dψ = τ F⁻ᵀ : dF, and ψ is linear in μ and λ."""
    F, mu, lam, scene = ctx.saved_tensors
    needs_F, *needs = ctx.needs_input_grad[:3]
    one, zero = torch.ones_like(mu).detach(), torch.zeros_like(lam).detach()
    meaningful = dispatch(torch.ops.torch_mpm.quartic_energy, F.detach(), one, zero, scene, ctx.energy).isfinite()
    grad = torch.where(meaningful, grad, 0)
    grad_F = None
    if needs_F:
        safe = torch.where(meaningful[:, None, None], F, torch.eye(F.shape[1], dtype=F.dtype, device=F.device))
        stress = quartic_stress(safe, mu, lam, scene, ctx.energy)
        grad_F = grad[:, None, None] * (stress @ torch.linalg.inv_ex(safe)[0].mT)
    shared: list[Tensor | None] = []
    for parameter, wanted, share in zip((mu, lam), needs, (0, 1), strict=True):
        if not wanted:
            shared.append(None)
            continue
        unit = one.new_ones(()), one.new_zeros(())
        value = dispatch(torch.ops.torch_mpm.quartic_energy, F, unit[share], unit[1 - share], scene, ctx.energy)
        shared.append(_shared(grad * torch.where(meaningful, value, 0), parameter, scene))
    return grad_F, *shared, None, None


def _no_second_derivative(ctx: Any, *grads: Tensor | None) -> Sequence[Tensor | None]:
    raise NotImplementedError("the return map of sand has no second derivatives: differentiate it once")


def _no_backward(ctx: Any, grad: Tensor) -> Tensor:
    raise NotImplementedError("stiffness bounds are not differentiable: compute them under torch.no_grad()")


for _name, _backward, _setup in (
    ("quartic_return_map", _return_map_backward, _return_map_setup),
    ("quartic_return_map_backward", _no_second_derivative, _no_setup),
    ("quartic_energy", _energy_backward, _energy_setup),
    ("quartic_stiffness", _no_backward, _no_setup),
):
    register_autograd(_name, _backward, _setup)
    refuse_vmap(_name)
