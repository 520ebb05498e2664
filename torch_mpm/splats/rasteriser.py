"""Software renderer of Gaussians in plain torch: tiles, alpha blending from front to back, gradients by autograd."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ..render.camera import Camera
from .gaussians import Gaussians
from .projection import FAINTEST, Spots, project

TILE = 16
"""Edge of a tile [pixels]."""
PART = 256
"""Number of spots of a tile that are blended together."""
OPAQUE = 1e-4
"""Share of the light at which a pixel is opaque (Kerbl et al. 2023)."""
MOST_OPACITY = 0.99
"""Largest opacity of a spot in a pixel (Kerbl et al. 2023)."""


def rasterise(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colours [H, W, 3] before a black background, and opacities [H, W] between 0 and 1.

    c = Σᵢ cᵢ αᵢ Πⱼ (1 − αⱼ) over the spots i at the centre of a pixel and those j in front of them, with
    αᵢ = min(0.99, σᵢ exp(−½ dᵀ Σ₂⁻¹ d)), left out below 1/255; a tile ends where all its pixels are opaque. Gradients
    pass to all attributes of the Gaussians.
    """
    spots = project(gaussians, camera)
    width, height = camera.resolution
    across, down = -(-width // TILE), -(-height // TILE)
    empty = spots.center.new_zeros(TILE * TILE, 4)
    rows = []
    for row in range(down):
        tiles = dict(_members(spots, row, across))
        line = [_tile(spots, tiles[k], row, k) if k in tiles else empty for k in range(across)]
        rows.append(torch.stack(line).reshape(across, TILE, TILE, 4).transpose(0, 1).flatten(1, 2))
    picture = torch.cat(rows)[:height, :width]
    return picture[..., :3], picture[..., 3]


def _members(spots: Spots, row: int, across: int) -> Iterator[tuple[int, Tensor]]:
    """Tiles of a row that spots touch, and the spots of each, in order [n]."""
    top, bottom = (spots.center[:, 1].detach() + sign * spots.reach[:, 1] for sign in (-1, 1))
    (near,) = ((bottom > row * TILE) & (top < (row + 1) * TILE) & (spots.opacity >= FAINTEST)).nonzero(as_tuple=True)
    middle, reach = spots.center[near, 0].detach(), spots.reach[near, 0]
    first = ((middle - reach) / TILE).floor().clamp(0, across).long()
    last = ((middle + reach) / TILE).ceil().clamp(0, across).long()
    counts = (last - first).clamp(min=0)
    owner = torch.repeat_interleave(torch.arange(len(near), device=near.device), counts)
    tile = first[owner] + torch.arange(len(owner), device=near.device) - (counts.cumsum(0) - counts)[owner]
    tile, order = tile.sort(stable=True)
    found, sizes = tile.unique_consecutive(return_counts=True)
    return zip(found.tolist(), near[owner[order]].split(sizes.tolist()), strict=True)


def _tile(spots: Spots, members: Tensor, row: int, column: int) -> Tensor:
    """Colours and opacity of the pixels of a tile [TILE², 4]."""
    center = spots.center
    across, down = (torch.arange(TILE, device=center.device) + TILE * k + 0.5 for k in (column, row))
    pixels = torch.cartesian_prod(down, across).flip(1).to(center)
    light = center.new_ones(len(pixels))
    color = center.new_zeros(len(pixels), 3)
    for part in members.split(PART):
        dx, dy = (pixels - center[part][:, None]).unbind(2)  # [n, TILE²]
        xx, xy, yy = spots.conic[part][:, :, None].unbind(1)
        fall = torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
        alpha = (spots.opacity[part][:, None] * fall).clamp(max=MOST_OPACITY)
        alpha = torch.where(alpha < FAINTEST, 0, alpha)
        passed = light * torch.cumprod(1 - alpha, 0)
        before = torch.cat([light[None], passed[:-1]])
        color = color + (alpha * before).mT @ spots.color[part]
        light = passed[-1]
        if float(light.detach().max()) < OPAQUE:
            break
    return torch.cat([color, 1 - light[:, None]], 1)
