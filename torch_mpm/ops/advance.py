"""The end of a step: x ← x + dt v, F ← (I + dt C) F, J ← J (1 + dt tr C)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..errors import check_count, check_index, check_like, shape_of
from .arguments import differentiate, per_particle, refuse_vmap, sizes, soa_empty, split_dt, sum_by_scene
from .autograd import dispatch, register_autograd


def advance(
    x: Tensor,
    v: Tensor,
    dt: float | Tensor,
    C: Tensor | None = None,
    F: Tensor | None = None,
    J: Tensor | None = None,
    scene: Tensor | None = None,
    scenes: int = 1,
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Update positions, and deformations with the velocity gradient C.

    Args:
        x: positions [P, D] [m].
        v: velocities [P, D] [m/s].
        dt: time step [s]: a number, or a tensor of shape [], [1] or [B].
        C: velocity gradient [P, D, D] [1/s]; needed with F or J.
        F: deformation gradient [P, D, D], or None.
        J: volume ratio [P], or None.
        scene: scene of each particle, int32 [P]; needed for a dt that differs between scenes. With a dt per scene, a
            particle of a scene that is not below B has the dt NaN.
        scenes: number of scenes B.

    Returns:
        x, F and J after the step (F and J None where not given).

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes, devices, or dt ≤ 0.

    Differentiable with respect to every floating tensor, twice in eager mode.
    """
    if not isinstance(x, Tensor) or x.dim() != 2 or x.shape[1] not in (2, 3):
        raise ValueError(f"x must have shape [P, 2] or [P, 3], got {shape_of(x)}")
    P, D = x.shape
    check_like("v", v, x, (P, D), "[P, D]", needed=True)
    check_like("C", C, x, (P, D, D), "[P, D, D]")
    check_like("F", F, x, (P, D, D), "[P, D, D]")
    check_like("J", J, x, (P,), "[P]")
    if C is None and (F is not None or J is not None):
        raise ValueError("F and J need C")
    check_index("scene", scene, x)
    number, scene_dt = split_dt(dt, check_count("scenes", scenes), x)
    if scene is None and scene_dt is not None and len(scene_dt) > 1:
        raise ValueError(f"scene must be given, int32 [P], for a dt of {len(scene_dt)} scenes")
    return dispatch(torch.ops.torch_mpm.advance, x, v, C, F, J, scene, scene_dt, number)


@torch.library.register_fake("torch_mpm::advance")
def _advance_fake(x, v, C, F, J, scene, scene_dt, dt):
    P, D = sizes(x, "x", 2)
    return (
        soa_empty(x, (P, D)),
        None if F is None else soa_empty(x, (P, D, D)),
        None if J is None else x.new_empty(P),
    )


@torch.library.register_fake("torch_mpm::advance_backward")
def _advance_backward_fake(grad_x, grad_F, grad_J, x, v, C, F, J, scene, scene_dt, dt, needs):
    P, D = sizes(x, "x", 2)
    shapes = ((P, D), (P, D, D), (P, D, D), (P,), (P,))
    present = (True, C is not None, F is not None, J is not None, True)
    return tuple(
        soa_empty(x, shape) if needs >> i & 1 and here else None
        for i, (shape, here) in enumerate(zip(shapes, present, strict=True))
    )


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    x, v, C, F, J, scene, scene_dt, dt = inputs
    ctx.save_for_backward(x, v, C, F, J, scene, scene_dt)
    ctx.dt = dt


def _backward(ctx, grad_x, grad_F, grad_J):
    x, v, C, F, J, scene, scene_dt = ctx.saved_tensors
    need = ctx.needs_input_grad
    needs = sum(1 << i for i, needed in enumerate((*need[1:5], need[6])) if needed)
    grads = dispatch(
        torch.ops.torch_mpm.advance_backward,
        *(grad_x, grad_F, grad_J, x, v, C, F, J, scene, scene_dt, ctx.dt, needs),
    )
    grad_v, grad_C, grad_F, grad_J, grad_dt = (
        g if needs >> i & 1 and t is not None else None
        for i, (g, t) in enumerate(zip(grads, (v, C, F, J, scene_dt), strict=True))
    )
    if grad_dt is not None:
        grad_dt = ctx.dt * sum_by_scene(grad_dt, scene if scene_dt.shape[0] > 1 else None, scene_dt.shape[0])
    return grad_x if need[0] else None, grad_v, grad_C, grad_F, grad_J, None, grad_dt, None


def _backward_setup(ctx: Any, inputs: Any, output: Any) -> None:
    *tensors, dt, needs = inputs
    ctx.save_for_backward(*tensors)
    ctx.dt, ctx.needs = dt, needs


def _double_backward(ctx, *grads):
    grad_x, grad_F, grad_J, x, v, C, F, J, scene, scene_dt = ctx.saved_tensors
    present = (True, C is not None, F is not None, J is not None, True)
    wanted = [bool(ctx.needs >> i & 1) and here for i, here in enumerate(present)]

    def adjoint(grad_x, grad_F, grad_J, v, C, F, J, scene_dt):
        """`advance_particle_backward` of csrc/transfer/advance.h in plain torch."""
        dt = torch.tensor(ctx.dt, dtype=x.dtype, device=x.device)
        dt = dt.expand(x.shape[0]) if scene_dt is None else dt * per_particle(scene_dt, scene, x.shape[0])
        step = dt[:, None, None]
        lost = ~x.isfinite().all(1)
        v = v.masked_fill(lost[:, None], 0)
        C = None if C is None else C.masked_fill(lost[:, None, None], 0)
        out_v, out_dt = dt[:, None] * grad_x, (v * grad_x).sum(1)
        out_C = out_F = out_J = None
        if C is not None:
            out_C = torch.zeros_like(C)
        if F is not None:
            out_F = grad_F + step * (C.mT @ grad_F)
            out_C = out_C + step * (grad_F @ F.mT)
            out_dt = out_dt + ((C @ F) * grad_F).sum((1, 2))
        if J is not None:
            rate = C.diagonal(dim1=1, dim2=2).sum(1)
            out_J = grad_J * (1 + dt * rate)
            out_C = out_C + (dt * J * grad_J)[:, None, None] * torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
            out_dt = out_dt + rate * J * grad_J
        return tuple(o for o, w in zip((out_v, out_C, out_F, out_J, out_dt), wanted, strict=True) if w)

    inputs = (grad_x, grad_F, grad_J, v, C, F, J, scene_dt)
    gx, gF, gJ, gv, gC, g_F, g_J, gdt = differentiate(
        adjoint, inputs, [g for g, w in zip(grads, wanted, strict=True) if w]
    )
    return gx, gF, gJ, None, gv, gC, g_F, g_J, None, gdt, None, None


register_autograd("advance", _backward, _setup)
register_autograd("advance_backward", _double_backward, _backward_setup)
refuse_vmap("advance")
refuse_vmap("advance_backward")
