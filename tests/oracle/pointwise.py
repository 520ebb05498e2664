"""Functions of csrc/pointwise in plain torch, with the arguments and results of `torch_mpm.ops.pointwise`."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_mpm.geometry.vectors import determinant, norm


def heat_weights(rest: Tensor, J: Tensor, F: Tensor, C: Tensor, kappa: Tensor, mass: Tensor, dt: Tensor, L: Tensor,
                 dx: Tensor) -> tuple[Tensor, ...]:  # fmt: skip
    volume = rest * J * determinant(F)
    capacity, conductance = C * mass, torch.where(kappa >= 0, kappa, torch.nan) * volume
    number = dt * conductance / (torch.where(capacity > 0, capacity, 1) * dx**2)
    strain = norm((0.5 * (L + L.mT)).flatten(1))
    return volume, capacity, conductance, (4 * number + dt * strain).clamp(max=1), number


def heat_moments_1(theta: Tensor, g: Tensor, w: Tensor, share: Tensor) -> tuple[Tensor, ...]:
    return _moments(theta, g, w[:, None])


def heat_moments_2(theta: Tensor, g: Tensor, w: Tensor, share: Tensor) -> tuple[Tensor, ...]:
    return _moments(theta, g, torch.stack([w, w * share], 1))


def _moments(theta: Tensor, g: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
    moment = weights[:, :, None] * g[:, None]
    return torch.cat([weights * theta[:, None], weights], 1), torch.cat([moment, torch.zeros_like(moment)], 1)


def heat_means_1(sums: Tensor) -> tuple[Tensor, ...]:
    total, weight = sums.chunk(2, 1)
    full = weight > 0
    return weight, torch.where(full, total / torch.where(full, weight, 1), 0)


heat_means_2 = heat_means_1


def heat_update_1(value: Tensor, moment: Tensor, theta: Tensor, g: Tensor, beta: Tensor, L: Tensor, dt: Tensor,
                  ) -> tuple[Tensor, ...]:  # fmt: skip
    after = (1 - beta[:, None]) * g + moment[:, 0]
    return (1 - beta) * theta + value[:, 0], _convected(after, L, dt)


def heat_update_2(value: Tensor, moment: Tensor, theta: Tensor, g: Tensor, beta: Tensor, L: Tensor, dt: Tensor,
                  ) -> tuple[Tensor, ...]:  # fmt: skip
    after = g + moment[:, 0] + beta[:, None] * (moment[:, 1] - g)
    return theta + value[:, 0] + beta * (value[:, 1] - theta), _convected(after, L, dt)


def _convected(g: Tensor, L: Tensor, dt: Tensor) -> Tensor:
    rate = L.mT * dt[:, None, None]
    first = (rate @ g[..., None])[..., 0]
    return g - first + (rate @ first[..., None])[..., 0]


def heat_melt(theta: Tensor, liquid: Tensor, point: Tensor, C: Tensor, latent: Tensor, number: Tensor,
              ) -> tuple[Tensor, ...]:  # fmt: skip
    ratio = C / latent
    after = (liquid + ratio * (theta - point)).clamp(0, 1)
    return theta - (after - liquid) / ratio, after, torch.where(after != liquid, number, 0)


def heat_layer(distance: Tensor, width: Tensor) -> tuple[Tensor, ...]:
    rest = 1 - (distance / width).clamp(0, 1) ** 2
    return 1 - rest**3, 6 / width**2 * rest**2


def heat_exchange(left: Tensor, conductance: Tensor, rate: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
    return conductance * rate, left - conductance * rate / scale


def heat_radiation(emitting: Tensor, sigma: Tensor, theta: Tensor, ambient: Tensor, reference: Tensor,
                   ) -> tuple[Tensor, ...]:  # fmt: skip
    kelvin = (theta + reference).clamp_min(0)
    black, slope = emitting * sigma, 4 * kelvin**3
    return black * slope, black * slope * theta + black * ((ambient + reference) ** 4 - kelvin**4)


def surface_normals(volume: Tensor, dim: int) -> tuple[Tensor, ...]:
    axes = torch.eye(dim, dtype=volume.dtype, device=volume.device)
    return torch.zeros_like(volume)[:, None].expand(-1, dim), volume[:, None, None] * axes


def length(v: Tensor) -> tuple[Tensor, ...]:
    return (norm(v),)


def box_distance(x: Tensor, size: Tensor) -> tuple[Tensor, ...]:
    depth = x.abs() - 0.5 * size
    return (norm(depth.clamp_min(0)) + depth.amax(1).clamp_max(0),)


def thermal_stretch(J: Tensor, F: Tensor, alpha: Tensor, theta: Tensor, expand: Tensor) -> tuple[Tensor, ...]:
    stretch = 1 + alpha * theta
    factor = torch.where(expand > 0, stretch, 1 / stretch)
    return J * factor ** F.shape[1], F * factor[:, None, None]


def melting_parts(J: Tensor, F: Tensor, liquid: Tensor, coherency: Tensor) -> tuple[Tensor, ...]:
    dim, flows = F.shape[1], liquid >= coherency
    root = J.where(flows & (J > 0), 1) ** (1 / dim)
    isotropic = torch.diag_embed(root[:, None].expand(-1, dim))
    return torch.where(flows, J, determinant(F)), torch.where(flows[:, None, None], isotropic, F)


def melting_stress(solid: Tensor, liquid: Tensor, fraction: Tensor, coherency: Tensor) -> tuple[Tensor, ...]:
    flows = (fraction >= coherency)[:, None, None]
    return (torch.where(flows, liquid, torch.lerp(solid, liquid, fraction[:, None, None])),)
