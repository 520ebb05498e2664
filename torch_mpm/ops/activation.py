"""Fake kernels of `activate`, `cell_order` and `take`, which `Grid.activate` and `State.sorted` call."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .arguments import refuse_vmap, sizes, soa_empty
from .autograd import register_autograd


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


@torch.library.register_fake("torch_mpm::take")
def _take_fake(fields: Sequence[Tensor], particles: Tensor) -> list[Tensor]:
    (count,) = sizes(particles, "particles", 1)
    return [soa_empty(t, (count, *t.shape[1:])) for t in fields]


def _no_backward(ctx: Any, *grads: Tensor) -> None:
    raise NotImplementedError("fields that `take` gives are not differentiable: State.select is")


register_autograd("take", _no_backward)
for _name in ("activate", "cell_order", "take"):
    refuse_vmap(_name)
