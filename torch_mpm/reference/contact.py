"""The contact condition in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def contact_velocity(relative: Tensor, normal: Tensor, kind: str, friction: float | Tensor) -> Tensor:
    """Velocity relative to a surface after contact with it: the rule of csrc/boundary/contact.h.

    Args:
        relative: velocity relative to the surface [..., D] [m/s].
        normal: unit normal into the material [..., D]; with a zero normal the velocity stays as it is.
        kind: "sticky", "slip" or "separate".
        friction: Coulomb coefficient, broadcast to [..., 1].

    Differentiable with respect to every tensor; gradients are finite also where nothing slides.
    """
    if kind == "sticky":
        return torch.zeros_like(relative)
    approach = -(relative * normal).sum(-1, keepdim=True)
    tangential = relative + approach * normal
    result = tangential
    if isinstance(friction, Tensor) or friction != 0:
        squared = (tangential * tangential).sum(-1, keepdim=True)
        speed = torch.where(squared > 0, torch.where(squared > 0, squared, 1).sqrt(), 0)
        lost = friction * approach
        slides = (speed > lost) & (speed > 0)
        kept = 1 - torch.where(slides, lost, 0) / torch.where(slides, speed, 1)
        stuck = (lost > 0) & ~slides
        result = torch.where(approach > 0, torch.where(stuck, 0, kept) * tangential, tangential)
    return torch.where(approach > 0, result, relative) if kind == "separate" else result
