"""The ground: a plane with a fine ruling and soft shadows, fading into the background."""

from __future__ import annotations

import numpy as np

from .camera import horizontal_axes
from .cloud import box_blur
from .shapes import Array

BACKGROUND = np.array([0.965, 0.97, 0.98])
GROUND = np.array([0.88, 0.89, 0.905])


class Ground:
    """Square plate under the box [lower, upper], with a `texture` that depends on the bodies above it.

    Shadows are drawn into the texture: everything is projected along `light` (the direction in which it shines), and
    blurred more the higher it is, as a lamp of finite size does.
    """

    def __init__(self, lower: Array, upper: Array, up: Array, light: Array, texels: int = 768) -> None:
        self.up, self.texels = up, texels
        self.side, self.front = horizontal_axes(up)
        center = 0.5 * (lower + upper)
        corners = np.stack([lower, upper]) @ up
        self.level = float(corners.min())
        self.origin = center - (center @ up - self.level) * up
        self.diameter = float(np.linalg.norm(upper - lower))
        self.half = 2.2 * self.diameter
        self.light = light
        self.base = self._ruling(upper - lower)
        axis = (np.arange(texels) + 0.5) / texels * 2 - 1
        radius = np.hypot(axis[:, None], axis[None, :])
        fade = np.clip((1.0 - radius) / 0.75, 0, 1)
        self.fade = (fade * fade * (3 - 2 * fade))[..., None]

    def corners(self) -> Array:
        """Corners [4, 3] of the plate, in the order of the texture's (0, 0), (1, 0), (1, 1), (0, 1)."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self.half
        return self.origin - 2e-3 * self.diameter * self.up + signs[:, :1] * self.side + signs[:, 1:] * self.front

    def texture(self, points: Array, radii: Array) -> Array:
        """uint8 [T, T, 3] with the shadows of spheres at `points` [N, 3] with `radii` [N]."""
        shade = 1.0 - 0.55 * self._shadow(points, radii)
        color = self.base * shade[..., None]
        return ((self.fade * color + (1 - self.fade) * BACKGROUND) * 255).round().astype(np.uint8)

    def _shadow(self, points: Array, radii: Array) -> Array:
        n = self.texels // 2
        texel = 2 * self.half / n
        points, radii = self._spread(points, radii, texel)
        rel = points - self.origin
        height = rel @ self.up
        foot = rel - (height / (self.light @ self.up))[:, None] * self.light
        ij = np.floor((np.stack([foot @ self.front, foot @ self.side], axis=1) / self.half + 1) * (n / 2)).astype(
            np.int64
        )
        keep = (height > -radii) & np.all((ij >= 0) & (ij < n), axis=1)
        index = ij[keep] @ np.array([n, 1])
        cover = np.pi * radii[keep] ** 2 / texel**2
        layer = np.clip(height[keep] / (0.15 * self.diameter), 0, 2)
        light = np.ones((n, n))
        for k, width in enumerate((5, 9, 19)):
            weight = cover * np.clip(1 - np.abs(layer - k), 0, 1)
            depth = np.bincount(index, weights=weight, minlength=n * n).reshape(n, n)
            light *= 1 - box_blur(1 - np.exp(-1.5 * depth), width, (0, 1))
        return box_blur(np.kron(1 - light, np.ones((2, 2))), 3, (0, 1), passes=2)

    def _spread(self, points: Array, radii: Array, texel: float) -> tuple[Array, Array]:
        """Replace spheres wider than a texel by small ones over their cross-section, which add up to its area."""
        wide = radii > texel
        if not wide.any():
            return points, radii
        count = int(min((radii[wide].max() / texel) ** 2 + 1, 256))
        k = np.arange(count)
        radius, angle = np.sqrt((k + 0.5) / count), k * np.pi * (3 - np.sqrt(5))  # Vogel's sunflower (1979)
        u = np.cross(self.light, self.side)
        u /= np.linalg.norm(u)
        disc = radius[:, None] * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.cross(self.light, u))
        spread = points[wide][:, None] + radii[wide][:, None, None] * disc
        small = np.repeat(radii[wide] / np.sqrt(count), count)
        return np.concatenate([points[~wide], spread.reshape(-1, 3)]), np.concatenate([radii[~wide], small])

    def _ruling(self, extent: Array) -> Array:
        """Base colour [T, T, 3]: thin lines every round length, about a fifth of the scene apart."""
        step = 10 ** np.floor(np.log10(self.diameter / 3))
        step *= max(m for m in (1, 2, 5) if m * step <= self.diameter / 3)
        axis = ((np.arange(self.texels) + 0.5) / self.texels * 2 - 1) * self.half
        texel = 2 * self.half / self.texels
        lines = []
        for direction in (self.front, self.side):
            phase = (axis + self.origin @ direction) / step
            lines.append(np.clip(1.2 - np.abs(phase - np.round(phase)) * step / texel, 0, 1))
        ruled = np.maximum(lines[0][:, None], lines[1][None, :])
        return GROUND * (1 - 0.05 * ruled[..., None])
