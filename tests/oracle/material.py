"""The compiled laws of csrc/laws in plain torch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Law:
    """One law. `stress` and `energy` take (F or J, C or None, one tensor [P] per parameter) and the dimension.

    Attributes:
        parameters: names, in the order of the op.
        shear: its state is F; otherwise J.
        viscous: its stress depends on C.
    """

    parameters: tuple[str, ...]
    shear: bool
    viscous: bool
    stress: Callable[..., Tensor]
    energy: Callable[..., Tensor]


def _identity(tensor: Tensor, dim: int) -> Tensor:
    return torch.eye(dim, dtype=tensor.dtype, device=tensor.device)


def _spherical(pressure: Tensor, dim: int) -> Tensor:
    return pressure[:, None, None] * _identity(pressure, dim)


def _neo_hookean_stress(F: Tensor, C: Tensor | None, mu: Tensor, lam: Tensor, dim: int) -> Tensor:
    log_J = torch.linalg.det(F).log()
    return mu[:, None, None] * (F @ F.mT - _identity(F, dim)) + _spherical(lam * log_J, dim)


def _neo_hookean_energy(F: Tensor, C: Tensor | None, mu: Tensor, lam: Tensor, dim: int) -> Tensor:
    log_J = torch.linalg.det(F).log()
    return mu * ((F.square().sum((1, 2)) - dim) / 2 - log_J) + lam / 2 * log_J**2


def _fluid_stress(J: Tensor, C: Tensor | None, K: Tensor, gamma: Tensor, dim: int) -> Tensor:
    return _spherical(-J * K / gamma * (J**-gamma - 1), dim)


def _fluid_energy(J: Tensor, C: Tensor | None, K: Tensor, gamma: Tensor, dim: int) -> Tensor:
    linear = (1 - gamma).abs() < 1e-12  # then ∫ (J^−γ − 1) dJ has a logarithm
    a = torch.where(linear, 1, 1 - gamma)
    return K / gamma * (J - 1 - torch.where(linear, J.log(), (J**a - 1) / a))


def _viscous_fluid_stress(J: Tensor, C: Tensor | None, K: Tensor, gamma: Tensor, eta: Tensor, dim: int) -> Tensor:
    elastic = _fluid_stress(J, C, K, gamma, dim)
    if C is None:
        return elastic
    rate = (C + C.mT) / 2
    deviator = rate - _spherical(rate.diagonal(dim1=1, dim2=2).sum(1) / dim, dim)
    return elastic + (2 * J * eta)[:, None, None] * deviator


def _viscous_fluid_energy(J: Tensor, C: Tensor | None, K: Tensor, gamma: Tensor, eta: Tensor, dim: int) -> Tensor:
    return _fluid_energy(J, C, K, gamma, dim)


def _fibre_stress(F: Tensor, C: Tensor | None, a: Tensor, *direction: Tensor, dim: int) -> Tensor:
    stretched = F @ torch.stack(direction[:dim], 1)[:, :, None]
    return a[:, None, None] * (stretched @ stretched.mT)


def _fibre_energy(F: Tensor, C: Tensor | None, a: Tensor, *direction: Tensor, dim: int) -> Tensor:
    stretched = F @ torch.stack(direction[:dim], 1)[:, :, None]
    return a / 2 * (stretched.square().sum((1, 2)) - 1)


LAWS = {
    "fibre": Law(
        ("activation", "direction_x", "direction_y", "direction_z"), True, False, _fibre_stress, _fibre_energy
    ),
    "neo_hookean": Law(("mu", "lam"), True, False, _neo_hookean_stress, _neo_hookean_energy),
    "weakly_compressible": Law(("bulk_modulus", "gamma"), False, False, _fluid_stress, _fluid_energy),
    "viscous_fluid": Law(
        ("bulk_modulus", "gamma", "viscosity"), False, True, _viscous_fluid_stress, _viscous_fluid_energy
    ),
}


def per_particle(parameter: Tensor, scene: Tensor | None, particles: int) -> Tensor:
    """A parameter of shape [], [1], [B] or [P] as [P]."""
    if parameter.numel() == 1:
        return parameter.reshape(1).expand(particles)
    if parameter.numel() == particles:
        return parameter
    assert scene is not None
    return parameter.index_select(0, scene)


def _at_meaningful(state: Tensor) -> tuple[Tensor, Tensor]:
    """Particles with a finite state of positive volume, bool [P], and the state with the others at rest."""
    if state.dim() == 1:
        meaningful = (state > 0) & state.isfinite()
        return meaningful, torch.where(meaningful, state, 1)
    finite = state.isfinite().all(2).all(1)
    meaningful = finite & (torch.linalg.det(torch.where(finite[:, None, None], state, 0)) > 0)
    return meaningful, torch.where(meaningful[:, None, None], state, _identity(state, state.shape[1]))


def stress(
    law: str,
    state: Tensor,
    parameters: Sequence[Tensor],
    C: Tensor | None = None,
    scene: Tensor | None = None,
    dim: int | None = None,
) -> Tensor:
    """See `torch_mpm.ops.material_stress`."""
    dim = state.shape[1] if dim is None else dim
    values = [per_particle(p, scene, state.shape[0]) for p in parameters]
    meaningful, state = _at_meaningful(state)
    return torch.where(meaningful[:, None, None], LAWS[law].stress(state, C, *values, dim=dim), 0)


def energy(
    law: str, state: Tensor, parameters: Sequence[Tensor], scene: Tensor | None = None, dim: int | None = None
) -> Tensor:
    """See `torch_mpm.ops.material_energy`."""
    dim = state.shape[1] if dim is None else dim
    values = [per_particle(p, scene, state.shape[0]) for p in parameters]
    meaningful, state = _at_meaningful(state)
    return torch.where(meaningful, LAWS[law].energy(state, None, *values, dim=dim), torch.inf)
