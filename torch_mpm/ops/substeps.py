"""The op behind `torch_mpm.rollout`: n steps in one call. Fake kernel and autograd.

    torch.ops.torch_mpm.substeps(x, v, mass, volume, C, F, J, history, scene, ids, material, previous_status, laws,
        options, parameters, variables, n, dt, apic, wants_C, stress_form, gravity, wall_kind, wall_plane,
        wall_friction, obstacles, data, shape, sizes, contact, obstacle_scene, start, end, time, scenes,
        max_blocks, grows, lattice, layout) -> (x, v, C, F, J, history, status)

Particles and their history are those of `State`, the grid's arguments those of `activate`, `grid_update` and
`contact`. `laws` are names of `LAWS` parted by commas, law k for the particles of material k; their options,
parameters and history variables follow one another, `variables` of the latter for each law. The time step dt [s] is
part of the parameters of laws that flow in time. Results that a call does not have are None; `history` has the entries
of all laws side by side, [P, m]. With `grows` the pool follows the scene on the CPU; otherwise the op stops there where
the pool is full, and the status tells. On CUDA nothing is waited for.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .arguments import refuse_vmap, sizes, soa_empty
from .autograd import register_autograd


@torch.library.register_fake("torch_mpm::substeps")
def _fake(
    x: Tensor, v: Tensor, mass: Tensor, volume: Tensor, C: Any, F: Any, J: Any, history: list[Tensor], *rest: Any
) -> tuple[Tensor | None, ...]:
    P, D = sizes(x, "x", 2)
    wants_C, scenes = rest[10], rest[-5]
    entries = sum(h.shape[1] ** 2 if h.dim() == 3 else 1 for h in history)
    return (
        soa_empty(x, (P, D)),
        soa_empty(x, (P, D)),
        soa_empty(x, (P, D, D)) if wants_C else None,
        None if F is None else soa_empty(x, (P, D, D)),
        None if J is None else soa_empty(x, (P,)),
        soa_empty(x, (P, entries)) if history else None,
        x.new_empty((1 + scenes, 8), dtype=torch.int32),
    )


def _no_backward(ctx: Any, *grads: Any) -> None:
    raise NotImplementedError("substeps has no gradient: take single steps, as torch_mpm.rollout does")


register_autograd("substeps", _no_backward)
refuse_vmap("substeps")
