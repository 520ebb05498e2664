"""Stresses in files: measures of arrays, and invariants."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

CAUCHY, KIRCHHOFF = "Cauchy", "Kirchhoff"
MEASURES = {
    **dict.fromkeys(("stress", "cauchy_stress", "out_of_plane_stress", "von_mises_stress", "pressure"), CAUCHY),
    "kirchhoff_stress": KIRCHHOFF,
}
"""Measure of each field of stress. In files without the attribute `measure`, "stress" is the Kirchhoff stress."""
TENSORS = ("stress", "cauchy_stress", "kirchhoff_stress")


def measure_of(name: str, attribute: Any) -> str:
    """Measure of an array of a file: its attribute, or that of older files without it.

    Raises:
        ValueError: for an attribute that is no measure, or not that of the field.
    """
    if attribute is None:
        return KIRCHHOFF if name == "stress" else MEASURES[name]
    known = (CAUCHY, KIRCHHOFF) if name == "stress" else (MEASURES[name],)
    if not isinstance(attribute, str) or attribute not in known:
        raise ValueError(f"{name} must have the measure {' or '.join(known)}, got {attribute!r:.100}")
    return attribute


def explicit_name(name: str, measure: str) -> str:
    """Name of a field with its measure: "stress" becomes `cauchy_stress` or `kirchhoff_stress`."""
    return f"{measure.lower()}_stress" if name == "stress" else name


def von_mises(stress: Array, out_of_plane: Array | None = None) -> Array:
    """Von Mises stress [...], √(3/2 s : s) with the deviator s, of stress tensors.

    Args:
        stress: [..., D, D].
        out_of_plane: σ_zz [...] of plane strain in 2-D. Without it, the stress in 2-D is the in-plane stress: √3 times
            the largest shear stress there, the von Mises stress where σ_zz is the mean stress in the plane.
    """
    normal = np.moveaxis(np.diagonal(stress, axis1=-2, axis2=-1), -1, 0)
    if stress.shape[-1] == 2:
        normal = np.stack([*normal, normal.mean(0) if out_of_plane is None else out_of_plane])
    shear = [(stress[..., i, j] + stress[..., j, i]) / 2 for i in range(stress.shape[-1]) for j in range(i)]
    deviator = normal - normal.mean(0)
    result: Array = np.sqrt(1.5 * (deviator**2).sum(0) + 3 * np.square(shear).sum(0))
    return result


class DrawnStress(NamedTuple):
    """Computation of the von Mises stress of pictures from the arrays of a file."""

    name: str
    """Array: the von Mises stress itself, or a tensor."""
    out_of_plane: str | None
    """Array that completes a tensor in 2-D."""
    label: str
    """Label of the picture, with the measure where it is not Cauchy's."""

    def values(self, arrays: Any) -> Array:
        """Von Mises stress [..., P] of arrays by name."""
        found: Array = np.asarray(arrays[self.name])
        if self.name == "von_mises_stress":
            return found
        return von_mises(found, None if self.out_of_plane is None else np.asarray(arrays[self.out_of_plane]))


def drawn_stress(names: Collection[str], measures: dict[str, str], dim: int) -> DrawnStress | None:
    """Best available stress among some arrays: Cauchy, with its out-of-plane component; None without a stress."""
    if "von_mises_stress" in names:
        return DrawnStress("von_mises_stress", None, "von Mises stress")
    tensors = [name for name in TENSORS if name in names]
    if not tensors:
        return None
    name = min(tensors, key=lambda n: measures[n])  # Cauchy before Kirchhoff.
    measure = "" if measures[name] == CAUCHY else f"{measures[name]} "
    whole = not measure and "out_of_plane_stress" in names
    where = "in-plane " if dim == 2 and not whole else ""
    return DrawnStress(name, "out_of_plane_stress" if dim == 2 and whole else None, f"{where}von Mises {measure}stress")
