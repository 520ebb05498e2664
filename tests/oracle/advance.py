"""End of a step in plain torch: x ← x + dt v, F ← (I + dt C) F, J ← J (1 + dt tr C)."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_mpm.grid.grid import Blocks

from . import transfer


def advance(
    x: Tensor, v: Tensor, dt: Tensor | float, C: Tensor, F: Tensor | None = None, J: Tensor | None = None
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """x, F and J at the end of the step; `dt` is a number or one value per particle. See `torch_mpm.ops.advance`."""
    dt = torch.as_tensor(dt, dtype=x.dtype, device=x.device).expand(x.shape[0])
    F = None if F is None else F + dt[:, None, None] * (C @ F)
    J = None if J is None else J * (1 + dt * C.diagonal(dim1=1, dim2=2).sum(1))
    return x + dt[:, None] * v, F, J


def g2p_advance(
    blocks: Blocks,
    x: Tensor,
    velocity: Tensor,
    dt: Tensor | float,
    F: Tensor | None = None,
    J: Tensor | None = None,
    stress_form: str = "mls",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
    """x, v, C, F and J; `dt` is a number or one value per particle. See `torch_mpm.ops.g2p_advance`."""
    v, C, grad_v = transfer.g2p(blocks, x, velocity)
    lost = ~x.isfinite().all(1)  # Particles that are unchanged.
    moved, L = v.masked_fill(lost[:, None], 0), C if stress_form == "mls" else grad_v
    next_x, F, J = advance(x, moved, dt, L.masked_fill(lost[:, None, None], 0), F, J)
    return next_x, v, C, F, J
