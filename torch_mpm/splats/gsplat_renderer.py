"""Gaussians drawn by the package gsplat, which needs a GPU (Ye et al. 2025)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from .. import optional
from ..render.camera import Camera
from .gaussians import Gaussians
from .projection import BLUR, NEAR, View


def rasterise(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colours [H, W, 3] before a black background, and opacities [H, W], by `gsplat.rasterization`; float32.

    Raises:
        ImportError: without the package.
        ValueError: for Gaussians that are not on a GPU, or not in float32.
    """
    package = optional.load("gsplat", "the renderer gsplat", "splats")
    if not gaussians.x.is_cuda or gaussians.x.dtype.itemsize != 4:
        raise ValueError(
            "gsplat draws Gaussians in float32 on a GPU, got "
            f"{str(gaussians.x.dtype).removeprefix('torch.')} on {gaussians.x.device}; use backend='software'"
        )
    return draw(package, gaussians, camera)


def draw(package: Any, gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """The same by the function `rasterization` of a package, for the device of the Gaussians."""
    x = gaussians.x
    view = View.of(camera, x)
    width, height = camera.resolution
    pose = x.new_zeros(4, 4)
    pose[:3, :3], pose[:3, 3], pose[3, 3] = view.rotation, -view.rotation @ view.position, 1.0
    focal = view.focal
    intrinsics = x.new_tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    colors, alphas, _ = package.rasterization(
        means=x,
        quats=None,
        scales=None,
        opacities=gaussians.opacity,
        colors=gaussians.harmonics,
        viewmats=pose[None],
        Ks=intrinsics[None],
        width=width,
        height=height,
        near_plane=NEAR,
        eps2d=BLUR,
        sh_degree=gaussians.degree,
        covars=gaussians.covariance,
    )
    return colors[0, ..., :3], alphas[0, ..., 0]
