"""The contact condition in torch operations."""

from __future__ import annotations

import torch
from torch import Tensor

from ..geometry.vectors import norm


def contact_change(relative: Tensor, normal: Tensor, kind: str, friction: float | Tensor) -> Tensor:
    """Change of velocity by contact with a surface: the rule of csrc/grid/friction.h.

    Args:
        relative: velocity relative to the surface [..., D] [m/s].
        normal: unit normal into the material [..., D]; a zero normal changes nothing, except under "sticky".
        kind: "sticky", "slip" or "separate".
        friction: Coulomb coefficient, broadcast to [..., 1].

    Differentiable with respect to every floating tensor; gradients are finite also where nothing slides.
    """
    if kind == "sticky":
        return -relative
    approach = -(relative * normal).sum(-1, keepdim=True)
    pressure = approach.clamp_min(0)
    change = (pressure if kind == "separate" else approach) * normal
    if not isinstance(friction, Tensor) and friction == 0:
        return change
    tangential = relative + approach * normal
    speed = norm(tangential)[..., None]
    lost = friction * pressure
    slides = (speed > lost) & (speed > 0)
    share = torch.where(slides, lost, 0) / torch.where(slides, speed, 1)
    return change - torch.where(slides, share, torch.where(lost > 0, 1, 0)) * tangential
