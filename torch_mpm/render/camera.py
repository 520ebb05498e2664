"""A pinhole camera that frames a box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .shapes import Array, vector


@dataclass(frozen=True)
class Camera:
    """Position, orthonormal view basis and opening of a pinhole camera; pixel (0, 0) is the top left corner."""

    position: Array
    right: Array
    up: Array
    forward: Array
    view_angle: float  # Vertical, degrees.
    resolution: tuple[int, int]

    def project(self, points: Array) -> Array:
        """Pixel coordinates (column, row) and distance along the view [m] of points [N, 3], as [N, 3]."""
        rel = np.asarray(points, dtype=np.float64) - self.position
        depth = rel @ self.forward
        width, height = self.resolution
        scale = 0.5 * height / np.tan(0.5 * np.radians(self.view_angle)) / depth
        return np.stack(
            [0.5 * width + scale * (rel @ self.right), 0.5 * height - scale * (rel @ self.up), depth], axis=1
        )


def framing(
    lower: Array,
    upper: Array,
    up: Array,
    resolution: tuple[int, int],
    azimuth: float,
    elevation: float,
    view_angle: float = 28.0,
    fill: tuple[float, float] = (0.80, 0.84),
) -> Camera:
    """Camera that shows the whole box [lower, upper] inside the share `fill` of the width and the height.

    `azimuth` and `elevation` in degrees, around and above the plane normal to `up`. The smallest distance that keeps
    the corner p inside is |p . right| / tan(angle) - p . forward, so the nearest camera is a maximum over corners.
    """
    side, front = horizontal_axes(up)
    a, e = np.radians(azimuth), np.radians(elevation)
    forward = -(np.cos(e) * (np.sin(a) * side + np.cos(a) * front) + np.sin(e) * up)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    top = np.cross(right, forward)
    tan_v = np.tan(0.5 * np.radians(view_angle)) * fill[1]
    tan_h = np.tan(0.5 * np.radians(view_angle)) * resolution[0] / resolution[1] * fill[0]
    corners = np.array([[upper[k] if i >> k & 1 else lower[k] for k in range(3)] for i in range(8)])
    center = 0.5 * (lower + upper)
    for _ in range(3):  # Perspective makes the near side larger: recentre on the visible part, then measure again.
        rel = corners - center
        depth = rel @ forward
        distance = max(np.max(np.abs(rel @ right) / tan_h - depth), np.max(np.abs(rel @ top) / tan_v - depth))
        seen = np.stack([rel @ right, rel @ top], axis=1) / (distance + depth)[:, None]
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * distance
        center = center + middle[0] * right + middle[1] * top
    return Camera(center - distance * forward, right, top, forward, view_angle, resolution)


def up_axis(gravity: npt.ArrayLike | None) -> Array:
    """Unit vector against gravity [3]; y without gravity."""
    down = np.array([0.0, -1.0, 0.0]) if gravity is None else vector("gravity", gravity, 3)
    length = float(np.linalg.norm(down))
    return np.array([0.0, 1.0, 0.0]) if length == 0 else -down / length


def horizontal_axes(up: Array) -> tuple[Array, Array]:
    """Two unit vectors normal to `up`, which form a right-handed frame (side, up, front) with it."""
    reference = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    side = reference - (reference @ up) * up
    side /= np.linalg.norm(side)
    return side, np.cross(side, up)


LIGHTS = (0.85, 0.40)  # Strengths of the key light and of the fill light.


def light_directions(camera: Camera) -> tuple[Array, Array]:
    """Unit vectors towards the key light (above, left of the camera, behind it) and the fill light (right)."""
    key = -0.55 * camera.right + 0.9 * camera.up - 0.55 * camera.forward
    fill = 0.75 * camera.right - 0.15 * camera.up - 0.6 * camera.forward
    return key / np.linalg.norm(key), fill / np.linalg.norm(fill)
