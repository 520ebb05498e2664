"""Pictures of Gaussians, by gsplat or in software."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import check_vector, shape_of
from ..render.camera import Camera
from . import gsplat_renderer, rasteriser
from .gaussians import Gaussians, check_gaussians

BACKENDS = ("auto", "software", "gsplat")


class Picture(NamedTuple):
    """`color` [H, W, 3], red, green and blue, 0 to 1 and above where harmonics exceed 1, and `opacity` [H, W]."""

    color: Tensor
    opacity: Tensor


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] | Tensor = (1.0, 1.0, 1.0),
    backend: str = "auto",
) -> Picture:
    """Picture of Gaussians; differentiable.

    Args:
        gaussians: those to draw; they are sorted by the distance of their centres.
        camera: a `torch_mpm.render.camera.Camera`, for example by `torch_mpm.render.camera.framing`.
        background: a colour, three numbers, or a picture [H, W, 3].
        backend: "software", plain torch on any device and in float32 or float64; "gsplat", for float32 on a GPU; or
            "auto": gsplat where it is installed and can draw these Gaussians.

    Raises:
        ValueError, TypeError: for another backend or background, or anything but Gaussians and a camera.
        ImportError: where backend is "gsplat" and the package is missing.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
    check_gaussians(gaussians)
    if not isinstance(camera, Camera):
        raise TypeError(f"camera must be a Camera, got {shape_of(camera)}")
    width, height = camera.resolution
    given = background if isinstance(background, Tensor) else check_vector("background", background, 3)
    behind = torch.as_tensor(given)
    if behind.shape not in ((3,), (height, width, 3)):
        raise ValueError(f"background must have shape [3] or [{height}, {width}, 3], got {list(behind.shape)}")
    chosen = chosen_backend(gaussians) if backend == "auto" else backend
    draw = gsplat_renderer.rasterise if chosen == "gsplat" else rasteriser.rasterise
    color, opacity = draw(gaussians, camera)
    return Picture(color + (1 - opacity)[..., None] * behind.to(color), opacity)


def chosen_backend(gaussians: Gaussians) -> str:
    """Backend of "auto"."""
    fits = gaussians.x.is_cuda and gaussians.x.dtype.itemsize == 4
    return "gsplat" if fits and importlib.util.find_spec("gsplat") is not None else "software"
