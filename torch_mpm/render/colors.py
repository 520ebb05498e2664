"""Colours of particles: the scalar behind each name, its unit, its range and its colour map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data.stress import von_mises
from .requires import require
from .shapes import Array

PLAIN = (0.20, 0.45, 0.78)
# Palette of Okabe and Ito (2008), distinguishable with any colour vision.
MATERIALS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#7F7F7F")
# Alternating light and dark sands, so that neighbouring layers differ.
LAYERS = ("#E9C98A", "#8A5A2B", "#D9A75B", "#5E4630", "#F2DFB4", "#A8743C")
PALETTES = {"material": MATERIALS, "layer": LAYERS}
"""Names of quantities that are categories."""


@dataclass(frozen=True)
class Quantity:
    """A particle quantity: label and unit for the scale, colour map, and whether the scale starts at zero."""

    label: str
    unit: str
    cmap: str
    from_zero: bool = False


QUANTITIES = {
    "speed": Quantity("speed", "m/s", "Spectral_r", from_zero=True),
    "stress": Quantity("von Mises stress", "Pa", "plasma", from_zero=True),
    "von_mises_stress": Quantity("von Mises stress", "Pa", "plasma", from_zero=True),
    "pressure": Quantity("pressure", "Pa", "viridis"),
    "temperature": Quantity("temperature", "K", "coolwarm"),
    "liquid": Quantity("liquid fraction", "", "viridis"),
    "material": Quantity("material", "", ""),
}


def numpy_of(value: Any) -> Array:
    """A numpy array from a torch tensor (any device) or anything that numpy accepts."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    return np.asarray(value)


def scalar_of(color_by: str, values: Array, count: int) -> Array:
    """One number per particle [P]: velocities [P, D] become speeds, stress tensors [P, 3, 3] von Mises stresses."""
    if color_by == "speed" and values.ndim == 2:
        values = np.linalg.norm(values, axis=1)
    elif color_by == "stress" and values.shape[1:] == (3, 3):
        values = von_mises(values)
    if values.shape != (count,):
        also = {"speed": " or [P, D]", "stress": " or [P, 3, 3] (with σ_zz in 2-D)"}.get(color_by, "")
        raise ValueError(f"scalars must have shape [P]{also} with P = {count} for {color_by}, got {list(values.shape)}")
    return values


def value_range(values: Array, from_zero: bool) -> tuple[float, float]:
    """Range of 98 per cent of the finite values; slightly widened around one value, (0, 1) without any."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = (float(q) for q in np.percentile(finite, (1, 99)))
    low = 0.0 if from_zero else low
    return (low, high) if high > low else (low, low + (abs(low) * 1e-3 or 1.0))


def map_colors(values: Array, limits: tuple[float, float], cmap: str) -> Array:
    """uint8 [P, 3]: `limits` are the ends of the colour map, values beyond them get the end colours, NaN is grey."""
    table = (require("matplotlib").colormaps[cmap](np.linspace(0, 1, 256))[:, :3] * 255).round().astype(np.uint8)
    unit = (values - limits[0]) / (limits[1] - limits[0])
    rgb = table[(np.clip(np.nan_to_num(unit, nan=0.0), 0, 1) * 255).round().astype(np.int64)]
    rgb[np.isnan(unit)] = 128
    return rgb


def palette_colors(numbers: Array, palette: Sequence[str] = MATERIALS) -> Array:
    """uint8 [P, 3] for the numbers [P] of materials or layers; the palette repeats after its last colour."""
    table = np.array([list(bytes.fromhex(color[1:])) for color in palette], np.uint8)
    return table[numbers.astype(np.int64) % len(palette)]
