"""G2P and `advance` in one pass over the particles: Python wrapper, fake kernel and autograd."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..errors import check_flag, check_like, check_particles
from ..grid.grid import Blocks, check_blocks
from ..grid.topology import Topology
from .arguments import check_choice, refuse_vmap, sizes, soa_empty, split_dt, sum_by_scene
from .autograd import dispatch, register_autograd, save_with_topology, saved_with_topology
from .transfer import STRESS_FORMS, _check_nodes


def g2p_advance(
    blocks: Blocks,
    x: Tensor,
    velocity: Tensor,
    dt: float | Tensor,
    F: Tensor | None = None,
    J: Tensor | None = None,
    affine: bool = True,
    stress_form: str = "mls",
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """End of a step: `g2p` followed by `advance`, except for rounding and particles outside, and faster.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        velocity: node velocities [N, D] [m/s].
        dt: time step [s]: a number, or a tensor of shape [], [1] or [B].
        F: deformation gradient [P, D, D], or None.
        J: volume ratio [P], or None.
        affine: whether to return C.
        stress_form: "mls" (update of F and J with C) or "gradient" (with ∇v), as in `p2g`.

    Returns:
        x at the end of the step, v [m/s], C [1/s] or None, F and J at the end of the step (None where not given).
        Particles outside the grid are unchanged, with v and C zero, or NaN where the position is not finite.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes, devices, or dt ≤ 0.

    Differentiable with respect to every floating tensor, twice in eager mode.
    """
    return g2p_advance_compensated(blocks, x, None, velocity, dt, F, J, affine, stress_form)[:5]


def g2p_advance_compensated(
    blocks: Blocks,
    x: Tensor,
    residual: Tensor | None,
    velocity: Tensor,
    dt: float | Tensor,
    F: Tensor | None = None,
    J: Tensor | None = None,
    affine: bool = True,
    stress_form: str = "mls",
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """`g2p_advance` with the accumulated rounding error of x [P, D] [m], which is constant for autograd; returns that
    of the new positions last. None does not compensate positions.
    """
    check_blocks(blocks)
    grid = blocks.grid
    check_particles(x, blocks)
    P, D = x.shape
    check_like("residual", residual, x, (P, D), "[P, D]")
    check_like("F", F, x, (P, D, D), "[P, D, D]")
    check_like("J", J, x, (P,), "[P]")
    check_choice("stress_form", stress_form, STRESS_FORMS)
    affine = check_flag("affine", affine)
    velocity = _check_nodes("velocity", velocity, blocks, x, D)
    number, scene_dt = split_dt(dt, grid.scenes, x)
    residual = None if residual is None else residual.detach()
    *advanced, rest = dispatch(
        torch.ops.torch_mpm.g2p_advance,
        *(x, velocity, F, J, residual, scene_dt, number, affine, STRESS_FORMS[stress_form], *blocks.packed),
    )
    return (*advanced, None if rest is None else rest.detach())


@torch.library.register_fake("torch_mpm::g2p_advance")
def _fake(x, velocity, F, J, residual, scene_dt, dt, affine, stress_form, *topology):
    P, D = sizes(x, "x", 2)
    shapes = ((P, D), (P, D), (P, D, D), (P, D, D), (P,), (P, D))
    present = (True, True, affine, F is not None, J is not None, residual is not None)
    return tuple(soa_empty(x, shape) if here else None for shape, here in zip(shapes, present, strict=True))


def _setup(ctx: Any, inputs: Any, output: Any) -> None:
    x, velocity, F, J, _, scene_dt, dt, affine, stress_form, *topology = inputs
    _, v, C, _, _, _ = output
    # The backward pass reads v and C, which the next step stores anyway.
    save_with_topology(ctx, (x, velocity, F, J, scene_dt, v, C), topology, dt=dt, affine=affine, mls=stress_form == 0)


def _backward(ctx, grad_x, grad_v, grad_C, grad_F, grad_J, _grad_residual):
    (x, velocity, F, J, scene_dt, v, C), topology = saved_with_topology(ctx)
    need_x, need_velocity, need_F, need_J, _, need_dt = ctx.needs_input_grad[:6]
    need_nodes, moves = need_x or need_velocity, F is not None or J is not None
    blocks = Topology.unpack(*topology)
    scale = blocks.grid.inverse_inertia
    L = C if ctx.mls else None  # Velocity gradient that updated F and J.
    if moves and not (ctx.mls and ctx.affine):
        _, C, grad_v_field = dispatch(torch.ops.torch_mpm.gather, x, velocity, scale, ctx.mls, not ctx.mls, *topology)
        L = C if ctx.mls else grad_v_field
    scene = blocks.particle_scene() if scene_dt is not None and scene_dt.shape[0] > 1 else None
    wanted = (need_nodes, need_nodes and moves, need_F, need_J, need_dt)
    needs = sum(1 << i for i, needed in enumerate(wanted) if needed)
    L = L if moves else None
    more_v, grad_L, grad_F, grad_J, grad_dt = dispatch(
        torch.ops.torch_mpm.advance_backward,
        *(grad_x, grad_F, grad_J, x, v, L, F, J, scene, scene_dt, ctx.dt, needs),
    )
    grad_velocity = None
    if need_nodes:
        grad_v = grad_v + more_v
        moment, gradient = grad_C, None
        if moves and ctx.mls:
            moment = grad_L if moment is None else moment + grad_L
        elif moves:
            gradient = grad_L
        if need_x:
            grad_x = grad_x + dispatch(
                torch.ops.torch_mpm.position_gradient, x, grad_v, moment, gradient, velocity, scale, *topology
            )
        if need_velocity:
            grad_velocity = dispatch(torch.ops.torch_mpm.scatter, x, grad_v, moment, gradient, scale, *topology)
    if need_dt:
        grad_dt = ctx.dt * sum_by_scene(grad_dt, scene, scene_dt.shape[0])
    grads = zip((grad_x, grad_velocity, grad_F, grad_J, None, grad_dt), ctx.needs_input_grad[:6], strict=True)
    return (*(g if needed else None for g, needed in grads),) + (None,) * 6


register_autograd("g2p_advance", _backward, _setup)
refuse_vmap("g2p_advance")
