"""Sand: the return map of the quartic energies, stress, energy and stiffness, as wrappers of the laws sand_*."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import (
    FLOATING,
    NUMBER_OR_TENSOR,
    check_count,
    check_flag,
    check_index,
    check_like,
    check_number,
    shape_of,
)
from .arguments import check_choice, check_parameter
from .law import APEX, BRANCH, ELASTIC, INVALID, NOT_CONVERGED, law_energy, law_stiffness, law_update
from .law import PLASTIC as CONE

__all__ = [
    "APEX",
    "CONE",
    "ELASTIC",
    "ENERGIES",
    "INVALID",
    "ReturnMap",
    "friction_alpha",
    "quartic_energy",
    "quartic_return_map",
    "quartic_stiffness",
    "quartic_stress",
]

ENERGIES = ("unilateral", "full", "hencky", "mixed")

Value = float | Tensor

ANGLE = "in radians, in [0, π/2), such as 0.5236 for 30°"
"""Condition on a friction angle."""


class ReturnMap(NamedTuple):
    """Result of `quartic_return_map`. The last three are None unless requested."""

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
    and the elastic energy that is lost at once: by sand that tears with a cohesion, and by compressed axes when a
    unilateral energy reaches the apex. Sand stores no energy by hardening.
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
    scenes: int | None = None,
) -> ReturnMap:
    """Drucker-Prager return map of sand in Hencky strains, with its stress: one decomposition of F.

    The mean strain does not change, except at the apex.

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
        apex: where the volume has grown, "zero" makes F a rotation; "keep" (unilateral energy only) preserves its
            volume and removes compressive strains, which is continuous and free of stress too.
        details: also return the multiplier and the dissipated energy.
        flow: "radial": the direction of the strain deviator does not change either (Gao et al. 2018, supplement, eq.
            28); "exact": the plastic strain increment is along the deviator of the stress on the yield surface (eq. 25
            to 27). Both are the same in 2-D and for the quadratic energy. In plane strain the exact flow mobilises more
            friction.
        cohesion: Hencky strain c ≥ 0, like mu: the tension on every axis at the apex of the cone, h = c (1, 1, 1). The
            yield function is that of h − c. Its stress is the tensile strength, 4aμ c³ + 2aλ (D c)³ for the full
            energy and (2μ + D λ) c for the quadratic one; the unilateral energy has none in tension. Without a volume
            correction sand flows at the apex under that tension.
        volume_correction: v_c [P], logarithm of the volume lost at the apex, zero at first and not negative (Tampubolon
            et al. 2017). With it, sand at the apex tears: F becomes a rotation for any cohesion, and v_c grows by log
            det of the trial F. Torn sand, v_c > 0, has neither stress nor cohesion until compression has closed the
            gap: the map uses h + v_c/D, is at the apex while its trace is not negative, and returns v_c to F once it
                is. With apex="keep" F keeps the volume itself, and v_c stays zero.
        scenes: number of scenes B, as in `law_update`.

    Returns:
        A `ReturnMap`. A trial F that is not finite or of det F ≤ 0 is returned unchanged, with zero stress.

    Differentiable once: every floating result with respect to F, mu, lam, the angle or α, cohesion and volume
    correction, by implicit differentiation at the root and divided differences, which are correct at equal principal
    stretches. On a boundary between branches the derivative is that of one of them. The gradient of float32 arguments
    computes strains and map in float64: it is exact to rounding at the given F.

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
    _check_deformation(F, scene, energy, scenes)
    check_like("volume_correction", volume_correction, F, (F.shape[0],), "[P]")
    _check_number("friction_angle", friction_angle, ANGLE, most=math.pi / 2)
    _check_number("alpha", alpha, "finite and not negative")
    _check_number("cohesion", cohesion, "finite and not negative")
    if alpha is None:
        alpha = friction_alpha(_parameter("friction_angle", friction_angle, F, scene, scenes), F.shape[1])
    given = (("mu", mu), ("lam", lam), ("alpha", alpha), ("cohesion", 0.0 if cohesion is None else cohesion))
    parameters = [_parameter(n, v, F, scene, scenes) for n, v in (*given, *_UNUSED)]
    history = () if volume_correction is None else (volume_correction,)
    result = law_update(
        law_name(energy, flow, F.shape[1]),
        F,
        parameters,
        history,
        scene=scene,
        options=["keep_apex"] if apex == "keep" else [],
        details=True if check_flag("details", details) else BRANCH,
        scenes=scenes,
    )
    assert result.branch is not None and result.converged is not None
    return ReturnMap(
        result.state,
        result.stress,
        result.branch,
        result.converged,
        result.multiplier,
        result.dissipated,
        result.history[0] if history else None,
    )


def law_name(energy: str, flow: str, dim: int) -> str:
    """Compiled law of an energy and a flow; for D = 2 and the quadratic energy the exact flow is the radial one."""
    exact = flow == "exact" and dim == 3 and energy != "hencky"
    return f"sand_{energy}_exact" if exact else f"sand_{energy}"


def friction_alpha(angle: Tensor, dim: int) -> Tensor:
    """Slope α of the cone |dev τ| + α tr τ ≤ 0 from a friction angle [rad].

    √(2/3) 2 sin φ/(3 − sin φ) in 3-D meets Mohr-Coulomb in triaxial compression; sin φ/√2 in 2-D is Mohr-Coulomb there.
    """
    sine = torch.sin(angle)
    return sine / math.sqrt(2) if dim == 2 else math.sqrt(2 / 3) * 2 * sine / (3 - sine)


def quartic_stress(
    F: Tensor,
    mu: Value,
    lam: Value,
    scene: Tensor | None = None,
    energy: str = "unilateral",
    scenes: int | None = None,
) -> Tensor:
    """Kirchhoff stress τ [P, D, D] [Pa] of F itself, without plasticity. Arguments as `quartic_return_map`.

    Differentiable once with respect to F, mu and lam.
    """
    parameters = _elastic(F, mu, lam, scene, energy, scenes)
    return law_update(f"sand_{energy}", F, parameters, scene=scene, options=["elastic"], scenes=scenes).stress


def quartic_energy(
    F: Tensor,
    mu: Value,
    lam: Value,
    scene: Tensor | None = None,
    energy: str = "unilateral",
    scenes: int | None = None,
) -> Tensor:
    """Elastic energy per rest volume [P] [J/m³] of F itself; infinite where det F ≤ 0 or F is not finite.

    Arguments as `quartic_return_map`; differentiable with respect to F, mu and lam, twice in eager mode.
    """
    return law_energy(f"sand_{energy}", F, _elastic(F, mu, lam, scene, energy, scenes), scene=scene, scenes=scenes)


def quartic_stiffness(
    F: Tensor,
    mu: Value,
    lam: Value,
    scene: Tensor | None = None,
    energy: str = "unilateral",
    smallest_strain: float = 0.0,
    scenes: int | None = None,
) -> Tensor:
    """Upper bound [P] [Pa] of the elastic tangent modulus over all velocity gradients of unit norm.

    The tangent of the quartic energies grows with the square of the strain and vanishes at rest: strains below
    `smallest_strain` count as that. Zero where det F ≤ 0 or F is not finite. Other arguments as `quartic_return_map`;
    not differentiable.
    """
    parameters = _elastic(F, mu, lam, scene, energy, scenes, smallest_strain)
    return law_stiffness(f"sand_{energy}", F, parameters, scene=scene, scenes=scenes)


def _elastic(
    F: Tensor,
    mu: Value,
    lam: Value,
    scene: Tensor | None,
    energy: str,
    scenes: int | None,
    smallest_strain: float = 0.0,
) -> list[Tensor]:
    """Parameters of a law of sand for functions that need no yield surface."""
    _check_deformation(F, scene, energy, scenes)
    values = (("mu", mu), ("lam", lam), ("alpha", 0.0), ("cohesion", 0.0), ("smallest_strain", smallest_strain))
    return [_parameter(name, value, F, scene, scenes) for name, value in (*values, *_UNUSED[1:])]


_UNUSED = (("smallest_strain", 0.0), ("h1", 0.0), ("h2", 0.0), ("h3", 0.0))
"""Parameters of the stiffness and of hardening."""


def _check_deformation(F: Tensor, scene: Tensor | None, energy: str, scenes: int | None = None) -> None:
    check_choice("energy", energy, ENERGIES)
    if not isinstance(F, Tensor) or F.dim() != 3 or F.shape[1:] not in ((2, 2), (3, 3)):
        raise ValueError(f"F must have shape [P, 3, 3] or [P, 2, 2], got {shape_of(F)}")
    if F.dtype not in FLOATING:
        raise TypeError(f"F must be float32 or float64, got {F.dtype}")
    check_index("scene", scene, F, of="F")
    if scenes is not None:
        check_count("scenes", scenes)


def _check_number(name: str, value: Value | None, expected: str, most: float = math.inf) -> None:
    """A tensor is not checked: reading it would wait for its device."""
    if value is not None and not isinstance(value, Tensor):
        check_number(name, value, expected, lambda v: 0 <= v < most, NUMBER_OR_TENSOR)


def _parameter(name: str, value: Value | None, F: Tensor, scene: Tensor | None, scenes: int | None) -> Tensor:
    if not isinstance(value, Tensor):
        check_number(name, value, kinds=NUMBER_OR_TENSOR)
        number = float(value)  # type: ignore[arg-type]
        return torch.full((), number, dtype=F.dtype, device=F.device)  # Not a copy from the host, which graphs refuse.
    check_parameter(name, value, F, scene, scenes)
    return value


# ---- torch.ops.torch_mpm.quartic_return_map, the name used by training code

_LIBRARY = torch.library.Library("torch_mpm", "FRAGMENT")
_LIBRARY.define(
    "quartic_return_map(Tensor F, Tensor mu, Tensor lam, Tensor alpha, Tensor? cohesion, Tensor? volume, "
    "Tensor? scene, str energy, str flow, str apex, bool details) -> "
    "(Tensor F, Tensor stress, Tensor branch, Tensor multiplier, Tensor dissipated, Tensor volume)"
)


def _composed(
    F: Tensor,
    mu: Tensor,
    lam: Tensor,
    alpha: Tensor,
    cohesion: Tensor | None,
    volume: Tensor | None,
    scene: Tensor | None,
    energy: str,
    flow: str,
    apex: str,
    details: bool,
) -> tuple[Tensor, ...]:
    _check_deformation(F, scene, energy)
    if F.dim() == 3:
        check_like("volume", volume, F, (F.shape[0],), "[P]")
    r = quartic_return_map(
        F, mu, lam, None, alpha, scene, energy, apex, details, flow, cohesion, volume_correction=volume
    )
    absent = F.new_empty(0)
    scalars = (absent if t is None else t for t in (r.multiplier, r.dissipated, r.volume_correction))
    return r.F, r.stress, torch.where(r.converged, r.branch, r.branch + NOT_CONVERGED), *scalars


_LIBRARY.impl("quartic_return_map", _composed, "CompositeImplicitAutograd")
