"""3-D Gaussians with colours: their covariances, opacities and spherical harmonics."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import FLOATING, check_like, shape_of
from ..ops.svd import svd3
from .harmonics import COUNTS, check_harmonics


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussians of 3-D Gaussian splatting (Kerbl et al. 2023).

    Attributes:
        x: centres [N, 3] [m].
        axes: A [N, 3, 3] [m] with the covariance Σ = A Aᵀ. Its columns are the principal half axes after reading, and
            any other factor of Σ after a deformation.
        opacity_logit: logit of the opacity [N].
        harmonics: coefficients of the colour [N, K, 3] (red, green, blue) with K = 1, 4, 9 or 16 real spherical
            harmonics of the degrees 0 to 3; see `torch_mpm.splats.basis`.

    All have the dtype (float32 or float64) and the device of x. Gradients pass through all functions of Gaussians
    except `factors`.

    Raises:
        ValueError, TypeError: for another shape, dtype or device.
    """

    x: Tensor
    axes: Tensor
    opacity_logit: Tensor
    harmonics: Tensor

    def __post_init__(self) -> None:
        x = self.x
        check_centres(x)
        N = len(x)
        check_like("axes", self.axes, x, (N, 3, 3), "[N, 3, 3]", needed=True)
        check_like("opacity_logit", self.opacity_logit, x, (N,), "[N]", needed=True)
        check_harmonics(self.harmonics)
        check_like("harmonics", self.harmonics, x, (N, self.harmonics.shape[1], 3), "[N, K, 3]")

    @classmethod
    def from_factors(
        cls, x: Tensor, scale: Tensor, quaternion: Tensor, opacity: Tensor, harmonics: Tensor
    ) -> Gaussians:
        """Gaussians with Σ = R diag(scale²) Rᵀ.

        Args:
            x: centres [N, 3] [m].
            scale: standard deviations along the principal axes [N, 3] [m].
            quaternion: rotations R as w, x, y, z [N, 4], of any length but zero.
            opacity: [N], above 0 and below 1.
            harmonics: [N, K, 3].

        Raises:
            ValueError, TypeError: for another shape, dtype or device, a quaternion of zeros, or an opacity out of
                range.
        """
        check_centres(x)
        check_like("scale", scale, x, (len(x), 3), "[N, 3]", needed=True)
        check_like("quaternion", quaternion, x, (len(x), 4), "[N, 4]", needed=True)
        check_like("opacity", opacity, x, (len(x),), "[N]", needed=True)
        check_rows("quaternion must not be zero", (quaternion == 0).all(1))
        check_rows("opacity must be above 0 and below 1", ~((opacity > 0) & (opacity < 1)))
        axes = rotation_of(quaternion) * scale[:, None, :]
        return cls(x, axes, opacity.logit(), harmonics)

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, rows: Tensor | slice) -> Gaussians:
        """Some of the Gaussians, by a mask, indices or a slice."""
        return Gaussians(self.x[rows], self.axes[rows], self.opacity_logit[rows], self.harmonics[rows])

    @property
    def opacity(self) -> Tensor:
        """[N], between 0 and 1."""
        return self.opacity_logit.sigmoid()

    @property
    def covariance(self) -> Tensor:
        """Σ [N, 3, 3] [m²]."""
        return self.axes @ self.axes.mT

    @property
    def degree(self) -> int:
        """Largest degree of the harmonics, 0 to 3."""
        return COUNTS.index(self.harmonics.shape[1])

    def factors(self) -> tuple[Tensor, Tensor]:
        """Standard deviations [N, 3] [m], descending, and quaternions w, x, y, z [N, 4] of the principal axes.

        By the singular values of `axes`, so that also a deviation of 1e-6 of the largest one is accurate in float32.
        Without gradients, because principal axes are not continuous where two deviations are equal.
        """
        U, sigma, _ = svd3(self.axes.detach())
        return sigma.abs(), quaternion_of(U)

    def replace(self, **changes: Tensor) -> Gaussians:
        """A copy with some attributes changed; errors as for the class."""
        return dataclasses.replace(self, **changes)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """The same on a device and in a dtype, float32 or float64."""
        values = (self.x, self.axes, self.opacity_logit, self.harmonics)
        return Gaussians(*(value.to(device=device, dtype=dtype) for value in values))


def check_gaussians(value: object, name: str = "gaussians") -> None:
    """Raise TypeError for anything but `Gaussians`."""
    if not isinstance(value, Gaussians):
        raise TypeError(f"{name} must be Gaussians, got {shape_of(value)}")


def check_centres(x: Tensor) -> None:
    """Raise ValueError or TypeError unless centres are [N, 3] in float32 or float64."""
    if not isinstance(x, Tensor) or x.dim() != 2 or x.shape[1] != 3:
        raise ValueError(f"x must have shape [N, 3], got {shape_of(x)}")
    if x.dtype not in FLOATING:
        raise TypeError(f"x must be float32 or float64, got {x.dtype}")


def check_rows(expected: str, bad: Tensor) -> None:
    """Raise ValueError that names the first of the Gaussians that are `bad`, bool [N]."""
    if bool(bad.any()):
        raise ValueError(f"{expected}, which Gaussian {int(bad.int().argmax())} violates")


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """Gaussians of several objects as one; missing harmonics of higher degrees are zero.

    Raises:
        ValueError: without parts.
        TypeError: for a part that is no `Gaussians`.
    """
    if not parts:
        raise ValueError("parts must hold at least one object of Gaussians, got none")
    for k, part in enumerate(parts):
        check_gaussians(part, f"parts[{k}]")
    count = max(part.harmonics.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.harmonics, (0, 0, 0, count - part.harmonics.shape[1])) for part in parts]
    return Gaussians(
        torch.cat([part.x for part in parts]),
        torch.cat([part.axes for part in parts]),
        torch.cat([part.opacity_logit for part in parts]),
        torch.cat(padded),
    )


def rotation_of(quaternion: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions w, x, y, z [N, 4] of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=1, eps=0.0).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def quaternion_of(rotation: Tensor) -> Tensor:
    """Unit quaternions w, x, y, z [N, 4] with w >= 0 of rotation matrices [N, 3, 3].

    Each row of 4 q qᵀ is a multiple of q; the one with the largest diagonal entry is accurate (Shepperd 1978). It is
    chosen by comparisons, since an argmax over four columns is slow on the CPU.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(1) for row in rotation.unbind(1))
    x, y, z = h - f, c - g, d - b
    xy, xz, yz = b + d, c + g, f + h
    ww, xx, yy, zz = 1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i
    first = _larger((ww, ww, x, y, z), (xx, x, xx, xy, xz))
    second = _larger((yy, y, xy, yy, yz), (zz, z, xz, yz, zz))
    q = torch.nn.functional.normalize(torch.stack(_larger(first, second)[1:], 1), dim=1)
    return torch.where(q[:, :1] < 0, -q, q)


def _larger(first: Sequence[Tensor], second: Sequence[Tensor]) -> list[Tensor]:
    """Those of two rows whose first entry is the larger one, tensors [N]."""
    chosen = second[0] > first[0]
    return [torch.where(chosen, b, a) for a, b in zip(first, second, strict=True)]
