"""The constitutive models of MPM-PyTorch: modules F -> Kirchhoff stress, and F -> F after plastic flow."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ... import constitutive
from ...gradients import number, refuse_grad

__all__ = [
    "CorotatedElasticity",
    "DruckerPragerPlasticity",
    "Elasticity",
    "FluidElasticity",
    "IdentityPlasticity",
    "Plasticity",
    "SigmaElasticity",
    "SigmaPlasticity",
    "StVKElasticity",
    "VolumeElasticity",
    "VonMisesPlasticity",
    "get_constitutive",
]


class _Model(nn.Module):
    """Model with buffers `log_E` [1] and `nu` [1], which a call may override, [] or [P].

    Arguments must not require grad: assign a tensor that requires grad to the attribute of the model.
    """

    log_E: Tensor
    nu: Tensor

    def __init__(self, E: float = 2e6, nu: float = 0.4, **others: float) -> None:
        super().__init__()
        refuse_grad("a model copies its arguments; give log_E in the call, or assign model.log_E", E=E)
        for name, value in {"nu": nu, **others}.items():
            refuse_grad(f"a model copies its arguments; assign model.{name}", **{name: value})
        for name, value in {"nu": nu, **others}.items():
            self.register_buffer(name, torch.tensor([number(name, value)]))
        self.register_buffer("log_E", torch.tensor([number("E", E)]).log())

    def moduli(self, log_E: Tensor | None, nu: Tensor | None) -> tuple[Tensor, Tensor]:
        """μ and λ [Pa], [1] or [P]."""
        E, nu = (self.log_E if log_E is None else log_E).exp(), self.nu if nu is None else nu
        return constitutive.lame(E.reshape(-1), nu.reshape(-1))

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        """Result for F [P, 3, 3]; `log_E` and `nu`, [] or [P], override those of the model."""
        raise NotImplementedError


class Elasticity(_Model):
    """F [P, 3, 3] -> Kirchhoff stress [P, 3, 3] [Pa].

    Args:
        E: Young's modulus [Pa]
        nu: Poisson's ratio.
    """


class Plasticity(_Model):
    """F [P, 3, 3] -> F after plastic flow.

    Args:
        E, nu: as for `Elasticity`.
    """


class CorotatedElasticity(Elasticity):
    """2 μ (F − R) Fᵀ + λ J (J − 1)"""

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return constitutive.corotated(F, *self.moduli(log_E, nu))


class SigmaElasticity(Elasticity):
    """The quadratic energy of the logarithms of the stretches."""

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return constitutive.hencky(F, *self.moduli(log_E, nu))


class StVKElasticity(Elasticity):
    """μ F (Fᵀ F − 1) + λ J (J − 1), as in MPM-PyTorch."""

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return constitutive.stvk(F, *self.moduli(log_E, nu))


class VolumeElasticity(Elasticity):
    """λ J (J − 1); K (J − 1/J) where `mode` is "ziran"."""

    mode = "taichi"

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        mu, lam = self.moduli(log_E, nu)
        if self.mode.casefold() == "ziran":
            return constitutive.equation_of_state(F, mu, lam)
        if self.mode.casefold() != "taichi":
            raise ValueError(f"mode must be 'taichi' or 'ziran', got {self.mode!r}")
        return constitutive.volume(F, lam)


class FluidElasticity(Elasticity):
    """λ J (J − 1)"""

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return constitutive.volume(F, self.moduli(log_E, nu)[1])


class IdentityPlasticity(Plasticity):
    """No plastic flow."""

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return F


class SigmaPlasticity(Plasticity):
    """Fluid: J^(1/3) 1 with J between 0.05 and 1.2."""

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return constitutive.isochoric_reset(F, 0.05, 1.2)


class VonMisesPlasticity(Plasticity):
    """|dev 2 μ ε| ≤ σ_y

    Args:
        E, nu: as for `Elasticity`.
        sigma_y: bound of the norm of the stress deviator [Pa], √(2/3) of the yield stress in tension.
    """

    sigma_y: Tensor

    def __init__(self, E: float = 2e6, nu: float = 0.4, sigma_y: float = 1e3) -> None:
        super().__init__(E, nu, sigma_y=sigma_y)

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return constitutive.von_mises(F, self.moduli(log_E, nu)[0], self.sigma_y)


class DruckerPragerPlasticity(Plasticity):
    """Dry sand (Klár et al. 2016).

    Args:
        E, nu: as for `Elasticity`.
        friction_angle: [degrees]
        cohesion: strain along every axis at the apex of the cone.
    """

    friction_angle: Tensor
    cohesion: Tensor

    def __init__(self, E: float = 2e6, nu: float = 0.4, friction_angle: float = 25.0, cohesion: float = 0.0) -> None:
        super().__init__(E, nu, friction_angle=friction_angle, cohesion=cohesion)

    def forward(self, F: Tensor, log_E: Tensor | None = None, nu: Tensor | None = None) -> Tensor:
        return constitutive.drucker_prager(F, *self.moduli(log_E, nu), self.friction_angle, self.cohesion)


def get_constitutive(constitutive_name: str, device: torch.device | str | None = None) -> nn.Module:
    """A model with its default parameters, by the name of its class.

    Raises:
        ValueError: for an unknown name.
    """
    names = [name for name in __all__ if name.endswith("icity") and name not in ("Elasticity", "Plasticity")]
    if constitutive_name not in names:
        raise ValueError(f"constitutive_name must be one of {names}, got {constitutive_name!r}")
    model: nn.Module = globals()[constitutive_name]()
    return model.to(device)
