"""Every law with parameters: tests and benchmarks select from `LAWS` and `FORMS` by name or by trait.

A selection by trait includes a law that is added here, and a test compares `LAWS` with the public classes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

import torch_mpm as mpm
from torch_mpm.laws import CompiledLaw
from torch_mpm.ops import LAWS as REGISTRY

Value = float | Tensor
Arguments = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Law:
    """A law, made of its stiffness by a call.

    Attributes:
        make: the class, or a function that composes the law of others.
        arguments_of: arguments of `make` of Young's modulus E [Pa], Poisson's ratio and strength.
    """

    make: Callable[..., mpm.Material]
    arguments_of: Callable[[Any, Any, float], Arguments]

    def arguments(self, E: Value = 1e4, nu: Value = 0.3, strength: float = 0.003, **changes: Any) -> Arguments:
        """Arguments of `make`, for E and nu of shape [], [B] or [P].

        Args:
            E: Young's modulus of solids, bulk modulus of fluids [Pa].
            nu: Poisson's ratio of solids.
            strength: strain from which plastic laws flow, those with friction alone excepted; that of few steps of a
                moving body by default.
            changes: other values of arguments of `make`.
        """
        return self.arguments_of(E, nu, strength) | changes

    def __call__(self, E: Value = 1e4, nu: Value = 0.3, strength: float = 0.003, **changes: Any) -> mpm.Material:
        """The law; see `arguments`."""
        return self.make(**self.arguments(E, nu, strength, **changes))


def _solid(make: Callable[..., mpm.Material], others: Callable[[Any, float], Arguments] | None = None) -> Law:
    """A law of E and nu, and of others that follow from E and the strength."""
    return Law(make, lambda E, nu, s: {"E": E, "nu": nu, **(others(E, s) if others else {})})


def _sand(**options: Any) -> Law:
    return _solid(mpm.QuarticSand, lambda E, s: {"friction_angle": math.pi / 6, **options})


def _fluid(**options: Any) -> Law:
    return Law(mpm.WeaklyCompressible, lambda E, nu, s: {"bulk_modulus": E, **options})


def _custom(E: Value, **options: Any) -> mpm.Material:
    """The neo-Hookean stress of ν = 0, in torch."""
    return mpm.CustomLaw(
        lambda F: E / 2 * (F @ F.mT - torch.eye(F.shape[1], dtype=F.dtype, device=F.device)), **options
    )


def _custom_principal(E: Value, **options: Any) -> mpm.Material:
    """Hencky's stress in torch, of ν = 0.14."""
    return mpm.CustomPrincipalLaw(lambda s: E * (0.8 * s.log() + 0.3 * s.log().sum(1, keepdim=True)), **options)


def _active(E: Value, nu: Value, direction: Any) -> mpm.Material:
    return mpm.Active(mpm.NeoHookean(E=E, nu=nu), direction)


def _expansion(E: Value, nu: Value, coefficient: Any) -> mpm.Material:
    return mpm.ThermalExpansion(mpm.NeoHookean(E=E, nu=nu), coefficient)


def _melting(E: Value, nu: Value, **options: Any) -> mpm.Material:
    return mpm.Melting(mpm.FixedCorotated(E=E, nu=nu), mpm.WeaklyCompressible(E), **options)


def _mixture(E: Value, nu: Value, **sand: Any) -> mpm.Material:
    """Elastic, with a flow, and fluid: fields F and J."""
    laws = [mpm.NeoHookean(E=E, nu=nu), mpm.QuarticSand(E=E, nu=nu, **sand), mpm.WeaklyCompressible(E)]
    return mpm.Mixture(laws)


LAWS: dict[str, Law] = {
    "neo_hookean": _solid(mpm.NeoHookean),
    "fluid": _fluid(viscosity=1.0),
    "fixed_corotated": _solid(mpm.FixedCorotated),
    "hencky": _solid(mpm.Hencky),
    "von_mises": _solid(mpm.VonMises, lambda E, s: {"yield_stress": s * E, "hardening": 0.4 * s * E}),
    "herschel_bulkley": _solid(
        mpm.HerschelBulkley, lambda E, s: {"yield_stress": 0.4 * s * E, "consistency": 1e-3 * E, "exponent": 0.6}
    ),
    "snow": _solid(
        mpm.Snow, lambda E, s: {"critical_compression": 0.5 * s, "critical_stretch": 0.15 * s, "hardening": 10.0}
    ),
    "cam_clay": _solid(
        mpm.CamClay,
        lambda E, s: {"critical_slope": 1.2, "consolidation": 0.4 * s * E, "hardening": 10.0, "cohesion": 0.2},
    ),
    "viscoelastic": _solid(mpm.Viscoelastic, lambda E, s: {"branch_modulus": 0.3 * E, "relaxation_time": 0.01}),
    "sand": _sand(volume_correction=True),
    "custom": Law(_custom, lambda E, nu, s: {"E": E}),
    "custom_principal": Law(_custom_principal, lambda E, nu, s: {"E": E}),
    "mixture": Law(_mixture, lambda E, nu, s: {"E": E, "nu": nu}),
    "expansion": Law(_expansion, lambda E, nu, s: {"E": E, "nu": nu, "coefficient": 1e-4}),
    "melting": Law(_melting, lambda E, nu, s: {"E": E, "nu": nu}),
    "active": Law(_active, lambda E, nu, s: {"E": E, "nu": nu, "direction": (0.6, 0.8)}),
}
"""One law of every public class. Directions are 2-D."""

FORMS: dict[str, Law] = {
    "water": _fluid(),
    "perfectly_plastic": _solid(mpm.VonMises, lambda E, s: {"yield_stress": s * E}),
    "plastic_fluid": _solid(mpm.HerschelBulkley, lambda E, s: {"yield_stress": 0.4 * s * E, "consistency": 0.0}),
    **{f"sand_{energy}": _sand(energy=energy) for energy in ("unilateral", "full", "hencky", "mixed")},
    "sand_exact": _sand(energy="full", flow="exact"),
    "sand_keep": _sand(apex="keep"),
    "sand_hardening": _solid(mpm.QuarticSand, lambda E, s: {"hardening": (0.6, 0.15, 0.2, 0.17)}),
    "softening": Law(
        lambda E, nu: mpm.NeoHookean(E=mpm.Table([0.0, 1.0], [2 * E, E]), nu=nu), lambda E, nu, s: {"E": E, "nu": nu}
    ),
}
"""Other options of the same classes, by what differs from those of `LAWS`."""

TRAITS: dict[str, Callable[[mpm.Material], bool]] = {
    "compiled": lambda law: isinstance(law, CompiledLaw),
    "fluid": lambda law: law.state_fields == ("J",),
    "plastic": lambda law: isinstance(law, CompiledLaw) and REGISTRY[law.name].plastic,
    "history": lambda law: bool(law.extra_fields),
    "rate": lambda law: law.rate_dependent,
}
"""Properties that laws themselves have or have not."""


def having(*traits: str, without: str | tuple[str, ...] = (), of: Mapping[str, Law] = LAWS) -> dict[str, Law]:
    """Laws by name with all of some traits and none of others."""
    excluded = (without,) if isinstance(without, str) else without
    made = {name: law() for name, law in of.items()}

    def fits(law: mpm.Material) -> bool:
        return all(TRAITS[t](law) for t in traits) and not any(TRAITS[t](law) for t in excluded)

    return {name: of[name] for name, law in made.items() if fits(law)}


def named(*names: str) -> dict[str, Law]:
    """Laws and forms by name."""
    return {name: (LAWS | FORMS)[name] for name in names}
