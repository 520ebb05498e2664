"""Text over a picture: the colour scale with its unit, material names, time stamp."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from .colors import MATERIALS, Quantity
from .requires import require
from .shapes import Array

INK = "#30343b"
DPI = 100


def figure(resolution: tuple[int, int]) -> Any:
    """A matplotlib figure of a size in pixels, drawn by Agg: no screen, no pyplot, no global state."""
    new = require("matplotlib.figure").Figure(figsize=(resolution[0] / DPI, resolution[1] / DPI), dpi=DPI)
    require("matplotlib.backends.backend_agg").FigureCanvasAgg(new)
    return new


def font_size(resolution: tuple[int, int]) -> float:
    """Font size in points: text has a fixed share of the picture, with a readable minimum."""
    return max(12.0 * min(resolution[1] / 720, resolution[0] / 1000), 7.0)


def scale_width(resolution: tuple[int, int]) -> float:
    """Share of the width of a colour bar with its numbers and label."""
    return 7.2 * font_size(resolution) * DPI / 72 / resolution[0]


def add_scale(target: Any, axes: Any, quantity: Quantity, limits: tuple[float, float], cmap: str, size: float) -> None:
    """A colour bar in `axes`, labelled with quantity and unit."""
    norm = require("matplotlib.colors").Normalize(*limits)
    mappable = require("matplotlib.cm").ScalarMappable(norm, cmap)
    bar = target.colorbar(mappable, cax=axes)
    bar.outline.set_visible(False)
    bar.formatter.set_powerlimits((-3, 4))
    bar.ax.tick_params(labelsize=size, colors=INK, length=3)
    bar.ax.yaxis.get_offset_text().set(size=size, color=INK)
    bar.set_label(
        f"{quantity.label} [{quantity.unit}]" if quantity.unit else quantity.label, size=1.08 * size, color=INK
    )


def material_handles(names: Sequence[str]) -> list[Any]:
    """Legend entries, one dot per material."""
    line = require("matplotlib.lines").Line2D
    return [
        line([], [], linestyle="", marker="o", markersize=8, color=MATERIALS[i % len(MATERIALS)], label=name)
        for i, name in enumerate(names)
    ]


@lru_cache(maxsize=4)
def scale_overlay(
    resolution: tuple[int, int],
    quantity: Quantity,
    limits: tuple[float, float] | None,
    cmap: str,
    names: tuple[str, ...],
) -> Array:
    """RGBA float32 [H, W, 4] with a colour bar, or with a legend of material `names`, on the right."""
    fig, size = figure(resolution), font_size(resolution)
    fig.patch.set_alpha(0)
    if limits is not None:
        add_scale(fig, fig.add_axes((1 - scale_width(resolution), 0.24, 0.014, 0.52)), quantity, limits, cmap, size)
    elif names:
        fig.legend(
            handles=material_handles(names), loc="center right", frameon=False, fontsize=1.1 * size, labelcolor=INK
        )
    fig.canvas.draw()
    return np.asarray(fig.canvas.buffer_rgba()).astype(np.float32) / 255


def blend(image: Array, overlay: Array) -> Array:
    """`overlay` RGBA float [H, W, 4] (not premultiplied) over uint8 [H, W, 3]."""
    rows, columns = np.nonzero(overlay[..., 3])
    if len(rows) == 0:
        return image
    part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    alpha = overlay[part][..., 3:]
    out = image.copy()
    out[part] = (image[part] * (1 - alpha) + overlay[part][..., :3] * 255 * alpha).round().astype(np.uint8)
    return out


def write_text(image: Array, text: str, corner: str, scale: float = 1.0) -> Array:
    """`text` in the "top left" or "bottom left" corner."""
    pil = require("PIL.Image").fromarray(image)
    pixels = font_size((image.shape[1], image.shape[0])) * DPI / 72 * scale
    path = require("matplotlib.font_manager").findfont("DejaVu Sans")
    font = require("PIL.ImageFont").truetype(path, max(8, round(pixels)))
    margin = 1.6 * pixels
    at = (margin, margin) if corner == "top left" else (margin, image.shape[0] - margin)
    anchor = "lt" if corner == "top left" else "ls"
    require("PIL.ImageDraw").Draw(pil).text(at, text, fill=INK, font=font, anchor=anchor)
    return np.array(pil)
