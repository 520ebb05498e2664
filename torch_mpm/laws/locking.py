"""Locking of nearly incompressible elastic bodies: how little they may bend, by their moduli and the cells across them.

The volume of each particle is held by a lattice that has fewer degrees of freedom than there are particles, so that a
body bends as if it were stiffer as λ/μ grows (as finite elements of full integration do, Hughes 2000, section 4.4).
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from ..cuda_graphs.capture import without_transforms
from ..errors import LockingWarning
from .compiled import SolidLaw
from .parameters import PerMaterial

LARGEST = {"quadratic": 50.0, "cubic": 500.0}
"""λ/μ above which a law is reported, by kernel: Poisson's ratios of 0.4902 and 0.499."""
CELLS = (4, 8)
"""Across a body, in the report."""


def least_bending(ratio: float, cells: int, kernel: str) -> float:
    """The least share of its deflection that a bent body has, a bound of benchmarks/results/locking.md.

    Args:
        ratio: λ/μ.
        cells: across the body, at least 2.
        kernel: of the grid.
    """
    excess = 0.034 * ratio / cells**2 if kernel == "quadratic" else 0.0125 * ratio**0.5 / cells
    return 1 / (1.06 + excess)


def problem(law: nn.Module, kernel: str, devices: bool = True) -> str:
    """A sentence about the elastic laws that lock most; "" where none is nearly incompressible.

    Args:
        law: of a step.
        kernel: of its grid.
        devices: whether values on other devices than the CPU are read, which waits for these.
    """
    found = [(_largest(part, devices), type(part).__name__) for part in law.modules() if isinstance(part, SolidLaw)]
    ratio, name = max(found, default=(0.0, ""))
    if not ratio > LARGEST[kernel]:
        return ""
    nu = ratio / (2 * (1 + ratio))
    shares = " and ".join(f"{least_bending(ratio, n, kernel):.2g} with {n}" for n in CELLS)
    remedy = 'reduce nu, or use kernel="cubic"' if kernel == "quadratic" else "reduce nu"
    return (
        f"{name} with λ/μ = {ratio:.4g} (ν = {nu:.6g}) is nearly incompressible and locks: of its deflection a bent "
        f"body may have as little as the share {shares} cells across it; {remedy} (docs/limitations.md)"
    )


def warn(law: nn.Module, kernel: str, devices: bool = True) -> None:
    """Warn of laws that lock, see `problem`.

    Warns:
        LockingWarning: by law and λ/μ.
    """
    if found := problem(law, kernel, devices):
        warnings.warn(found, LockingWarning, stacklevel=3)


def _largest(law: SolidLaw, devices: bool) -> float:
    """The largest λ/μ of a law; 0 for fluids (μ = 0) and functions of temperature."""
    if law.engineering:
        return max((_maximum(2 * nu / (1 - 2 * nu)) for nu in _values(law.nu, devices)), default=0.0)
    shear, volume = list(_values(law.mu, devices)), list(_values(law.lam, devices))
    same = len(shear) == len(volume)
    pairs = zip(shear, volume, strict=True) if same else itertools.product(shear, volume)
    return max((_maximum(torch.where(mu > 0, lam / mu, 0)) for mu, lam in pairs if _fit(mu, lam)), default=0.0)


def _fit(mu: Tensor, lam: Tensor) -> bool:
    return mu.shape == lam.shape or 1 in (mu.numel(), lam.numel())


def _maximum(ratio: Tensor) -> float:
    return float(ratio.max()) if ratio.numel() else 0.0


def _values(value: Any, devices: bool) -> Iterator[Tensor]:
    """Each of the numbers and tensors of a parameter, in float64 on the CPU."""
    if isinstance(value, PerMaterial):
        for one in value.values():
            yield from _values(one, devices)
    elif isinstance(value, Tensor):
        if not value.is_meta and (devices or value.device.type == "cpu"):
            yield without_transforms(value.detach()).cpu().double()
    elif not callable(value):
        yield torch.tensor(float(value), dtype=torch.float64, device="cpu")
