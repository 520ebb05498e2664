"""Contact with a surface, case by case."""

from __future__ import annotations

import torch
from torch import Tensor


def contact_velocity(u: Tensor, normal: Tensor, kind: str, friction: float) -> Tensor:
    """Velocity [N, D] relative to a surface after contact, from that before, u [N, D].

    The impulse of the surface per mass is p n + f, with its unit normal n into the material [N, D]. Sticky: it stops
    the node. Otherwise p stops the normal velocity, for "separate" only where it points into the surface; and f opposes
    the tangential velocity: |f| = friction p where the node slides, less where it sticks (Coulomb).
    """
    if kind == "sticky":
        return torch.zeros_like(u)
    p = -(u * normal).sum(1, keepdim=True)
    tangential = u + p * normal
    leaves = p[:, 0] <= 0
    slides = ~leaves & (tangential.detach().norm(dim=1) > friction * p[:, 0])
    after = torch.zeros_like(u)  # Of the sticking nodes.
    after = after.index_put((leaves,), (u if kind == "separate" else tangential)[leaves])
    t, p = tangential[slides], p[slides]
    return after.index_put((slides,), t - friction * p * t / t.norm(dim=1, keepdim=True))
