"""Projection of Gaussians onto the picture of a pinhole camera (EWA splatting; Zwicker et al. 2001)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..render.camera import Camera
from .gaussians import Gaussians
from .harmonics import colors

NEAR = 0.01
"""Smallest distance along the view of a Gaussian that is drawn [m]."""
BLUR = 0.3
"""Added to the variances in the picture [pixels²] (Kerbl et al. 2023)."""
WIDEST = 1.3
"""Largest tangent of an angle of view at which the projection is linearised, relative to that of the picture."""
FAINTEST = 1 / 255
"""Smallest opacity that is drawn."""


class Spots(NamedTuple):
    """Gaussians in a picture, from the nearest to the farthest one.

    `center` [M, 2] (column, row) [pixels], inverse covariance `conic` [M, 3] (xx, xy, yy) [1/pixels²], `opacity` [M],
    `color` [M, 3], and the half edges `reach` [M, 2] [pixels] of the box beyond which the opacity is below `FAINTEST`.
    """

    center: Tensor
    conic: Tensor
    opacity: Tensor
    color: Tensor
    reach: Tensor


class View(NamedTuple):
    """Camera as tensors: `rotation` [3, 3] from the world to right, down and forward, `position` [3] [m], focal length
    [pixels].
    """

    rotation: Tensor
    position: Tensor
    focal: float

    @classmethod
    def of(cls, camera: Camera, like: Tensor) -> View:
        """View of a camera in the dtype and on the device of a tensor."""
        rows = [camera.right, -camera.up, camera.forward]
        rotation = torch.stack([like.new_tensor(row.tolist()) for row in rows])
        focal = 0.5 * camera.resolution[1] / math.tan(0.5 * math.radians(camera.view_angle))
        return cls(rotation, like.new_tensor(camera.position.tolist()), focal)


def _inverse(half_axes: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses (xx, xy, yy) [M, 3] of M Mᵀ + 0.3 1 for M [M, 2, 3] [pixels], and its diagonals [M, 2].

    The determinant is |m₁ × m₂|² + 0.3 (|m₁|² + |m₂|²) + 0.3², in which nothing cancels: long and thin spots stay
    positive definite in float32. Lengths are divided by the longer row, so that no square overflows.
    """
    length = half_axes.detach().square().sum(2).amax(1).clamp(min=BLUR).sqrt()
    first, second = (half_axes / length[:, None, None]).unbind(1)
    blur = BLUR / length.square()
    xx, yy, xy = first.square().sum(1) + blur, second.square().sum(1) + blur, (first * second).sum(1)
    determinant = torch.linalg.cross(first, second).square().sum(1) + blur * (xx + yy - blur)
    conic = torch.stack([yy, -xy, xx], 1) / (determinant * length.square())[:, None]
    return conic, torch.stack([xx, yy], 1) * length.square()[:, None]


def project(gaussians: Gaussians, camera: Camera) -> Spots:
    """Gaussians in front of the camera as spots: Σ₂ = J W Σ Wᵀ Jᵀ + 0.3 1 with the Jacobian J of the projection.

    J is that at the centre, as in Kerbl et al. (2023); the order is that of the centres.
    """
    view = View.of(camera, gaussians.x)
    width, height = camera.resolution
    local = (gaussians.x - view.position) @ view.rotation.T
    distance = local[:, 2].detach()
    order = torch.where(distance > NEAR, distance, math.inf).argsort(stable=True)[: int((distance > NEAR).sum())]
    x, y, z = local[order].unbind(1)
    middle = local.new_tensor([0.5 * width, 0.5 * height])
    center = middle + view.focal * torch.stack([x / z, y / z], 1)
    widest = WIDEST * middle / view.focal
    u, v = ((t / z).clamp(-limit, limit) for t, limit in zip((x, y), widest.tolist(), strict=True))
    zero = torch.zeros_like(z)
    rows = (torch.stack([1 / z, zero, -u / z], 1), torch.stack([zero, 1 / z, -v / z], 1))
    half_axes = view.focal * torch.stack(rows, 1) @ (view.rotation @ gaussians.axes[order])  # [M, 2, 3]
    conic, variances = _inverse(half_axes)
    opacity = gaussians.opacity[order]
    towards = torch.nn.functional.normalize(gaussians.x[order] - view.position, dim=1)
    deviations = (2 * (opacity.detach() / FAINTEST).log().clamp(min=0)).sqrt()
    reach = deviations[:, None] * variances.detach().sqrt()
    return Spots(center, conic, opacity, colors(gaussians.harmonics[order], towards), reach)
