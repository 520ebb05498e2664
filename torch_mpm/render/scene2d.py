"""Two-dimensional pictures through matplotlib: particles as discs, axes in metres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .annotate import DPI, INK, add_scale, figure, font_size, material_handles, scale_width
from .colors import Quantity
from .requires import require
from .shapes import Array, Shape

Overlay = tuple[Array, str, str]

SMALLEST = 0.1
"""Least share of the width and the height for the axes; the text of smaller pictures is cut off."""


class Scene2D:
    """One figure that is drawn again for every frame; `to_pixels` gives where a point [m] lands in the picture."""

    def __init__(
        self,
        bounds: tuple[Array, Array],
        resolution: tuple[int, int],
        scale: bool,
        exaggeration: float = 1.0,
        origin: Array | None = None,
    ) -> None:
        self.figure, self.size = figure(resolution), font_size(resolution)
        self.resolution = resolution
        lower, upper = bounds
        left = min((5 if origin is None else 8) * self.size * DPI / 72 / resolution[0], 0.6)
        width = max(0.97 - left - (scale_width(resolution) if scale else 0), SMALLEST)
        line = self.size * DPI / 72 / resolution[1]  # Share of the height of a line of text.
        bottom, top = max(0.11, 3.8 * line), max(0.11, 2.6 * line)
        bottom, height = min(bottom, 0.6), max(1 - bottom - top, SMALLEST)
        aspect = exaggeration * (upper[1] - lower[1]) / (upper[0] - lower[0]) * resolution[0] / resolution[1]
        fitted = (width, width * aspect) if width * aspect <= height else (height / aspect, height)
        corner = (left + 0.5 * (width - fitted[0]), bottom + 0.5 * (height - fitted[1]))
        self.axes = self.figure.add_axes((*corner, *fitted))
        self.axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), facecolor="#fafbfc")
        self.axes.set_xlabel("x [m]", size=1.05 * self.size, color=INK)
        self.axes.set_ylabel("y [m]", size=1.05 * self.size, color=INK)
        self.axes.tick_params(labelsize=self.size, colors=INK)
        if origin is not None:
            self._label_in_coordinates(origin)
        for spine in self.axes.spines.values():
            spine.set_color("#9aa0a8")
        bar_height = max(fitted[1], 0.3)
        box = (corner[0] + fitted[0] + 0.02, corner[1] + 0.5 * (fitted[1] - bar_height), 0.013, bar_height)
        self.bar = self.figure.add_axes(box) if scale else None
        self.scale: object = None
        self.cloud = self.axes.scatter([], [], linewidths=0, zorder=2)
        self.changing: list[Any] = []
        self.title = self.axes.set_title("", loc="left", size=1.2 * self.size, color=INK)
        self.stamp = self.axes.set_title("", loc="right", size=1.1 * self.size, color=INK)
        self.figure.canvas.draw()
        self.pixels_per_metre = fitted[0] * resolution[0] / (upper[0] - lower[0])

    def _label_in_coordinates(self, origin: Array) -> None:
        """Numbers of the axes in coordinates to which those of the picture are relative."""
        for axis, zero in zip((self.axes.xaxis, self.axes.yaxis), origin, strict=True):
            axis.set_major_formatter(lambda at, _, zero=zero: f"{at + zero:.10g}")
            axis.set_major_locator(require("matplotlib.ticker").MaxNLocator(nbins=5))

    def to_pixels(self, points: Array) -> Array:
        """Pixel coordinates (column, row) [N, 2] of points [N, 2]."""
        xy = self.axes.transData.transform(points)
        return np.stack([xy[:, 0], self.resolution[1] - xy[:, 1]], axis=1)

    def set_scale(self, quantity: Quantity, limits: tuple[float, float], cmap: str) -> None:
        """Draw the colour bar, when it differs from the last frame's."""
        if self.bar is not None and self.scale != (quantity, limits, cmap):
            self.bar.clear()
            add_scale(self.figure, self.bar, quantity, limits, cmap, self.size)
            self.scale = (quantity, limits, cmap)

    def draw(
        self,
        x: Array,
        rgb: Array,
        radius: float,
        obstacles: Sequence[Shape],
        overlays: Sequence[Overlay],
        names: Sequence[str],
        title: str,
        stamp: str,
    ) -> Array:
        """The picture, uint8 [H, W, 3], of finite positions x [P, 2] m with colours uint8 [P, 3]."""
        for artist in self.changing:
            artist.remove()
        patches = require("matplotlib.patches")
        self.changing = [
            self.axes.add_patch(
                patches.Polygon(
                    o.world(), closed=True, facecolor=(*o.color, o.opacity), edgecolor=INK, linewidth=0.8, zorder=3
                )
            )
            for o in obstacles
        ]
        self.cloud.set_offsets(x)
        self.cloud.set_facecolors(rgb / 255)
        # A marker's size is the square of its diameter in points; discs below a pixel would fade away.
        diameter = max(2 * radius * self.pixels_per_metre, 1.3)
        self.cloud.set_sizes([(diameter * 72 / DPI) ** 2])
        for points, color, label in overlays:
            points = np.asarray(points)
            self.changing += self.axes.plot(
                points[:, 0], points[:, 1], color=color, label=label or None, linewidth=2, zorder=4
            )
        handles = material_handles(names) + [
            a for a in self.changing if a.get_label() and not a.get_label().startswith("_")
        ]
        if handles:
            legend = self.axes.legend(
                handles=handles, loc="upper right", fontsize=self.size, framealpha=0.9, labelcolor=INK
            )
            legend.set_zorder(5)
            self.changing.append(legend)
        self.title.set_text(title)
        self.stamp.set_text(stamp)
        self.figure.canvas.draw()
        return np.asarray(self.figure.canvas.buffer_rgba())[..., :3].copy()
