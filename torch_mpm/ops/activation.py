"""The fake kernels of `activate` and `cell_order`; their Python faces are `Grid.activate` and `State.sorted`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from .arguments import refuse_vmap, sizes


@torch.library.register_fake("torch_mpm::activate")
def _activate_fake(
    x: Tensor,
    scene: Tensor | None,
    ids: Tensor | None,
    previous_status: Tensor | None,
    scenes: int,
    max_blocks: int,
    lattice: Sequence[float],
    layout: Sequence[int],
) -> tuple[Tensor, ...]:
    def ints(*shape: int) -> Tensor:
        return x.new_empty(shape, dtype=torch.int32)

    P, dim = sizes(x, "x", 2)
    schedule = 16 + (8 + 4**dim // 2) * (max_blocks + P // 128) + P  # csrc/grid/topology.h
    return (
        ints(scenes * math.prod(layout[2:])),
        ints(max_blocks),
        ints(max_blocks + 1),
        ints(x.shape[0]),
        ints(schedule),
        ints(1 + scenes, 8),
    )


@torch.library.register_fake("torch_mpm::cell_order")
def _cell_order_fake(x: Tensor, *topology: object) -> Tensor:
    return x.new_empty(sizes(x, "x", 2)[0], dtype=torch.int32)


refuse_vmap("activate")
refuse_vmap("cell_order")
