"""P2G and G2P, and the underlying channel-wise scatter and gather: Python wrappers, fake kernels and autograd.

All of them are derivatives of one trilinear form of positions, particle values and node values,

    Φ = Σ_p Σ_i g_i · [N_i(x_p) (a_p + s B_p (x_i − x_p)) + G_p ∇N_i(x_p)],

`scatter` = ∂Φ/∂g, `gather` = ∂Φ/∂(a, B, G), `position_gradient` = ∂Φ/∂x. So they are each other's backward.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..errors import check_flag, check_like, check_number, check_particles, shape_of
from ..grid.grid import Blocks, check_blocks
from ..grid.topology import Topology
from . import composed
from .arguments import check_choice, differentiate, per_particle, refuse_vmap, sizes, soa_empty, split_dt, sum_by_scene
from .autograd import dispatch, register_autograd, save_with_topology, saved_with_topology

STRESS_FORMS = {"mls": 0, "gradient": 1}


def p2g(
    blocks: Blocks,
    x: Tensor,
    mass: Tensor,
    v: Tensor,
    C: Tensor | None = None,
    stress: Tensor | None = None,
    volume: Tensor | None = None,
    dt: float | Tensor | None = None,
    stress_form: str = "mls",
) -> Tensor:
    """Mass and momentum of the nodes from the particles.

    m_i = Σ N_i m_p and (mv)_i = Σ N_i [m_p v_p + Q_p (x_i − x_p)] with Q = m C (APIC, Jiang et al. 2015). Stress
    adds the impulse of a step: Q −= dt V D⁻¹ τ (MLS-MPM, Hu et al. 2018, eq. 18) or, for stress_form="gradient", the
    force −V τ ∇N_i of the B-spline gradient.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        mass: [P] [kg].
        v: velocities [P, D] [m/s].
        C: affine velocity field [P, D, D] [1/s]; None for PIC.
        stress: Kirchhoff stress τ [P, D, D] [Pa]; needs `volume` and `dt`.
        volume: rest volume [P] [m³].
        dt: time step [s]: a number, or a tensor of shape [], [1] or [B].
        stress_form: "mls" or "gradient".

    Returns:
        Node mass and momentum [N, 1 + D] [kg, kg m/s]. Particles outside the grid contribute nothing.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes, devices or values.

    Differentiable with respect to every floating tensor, twice in eager mode.
    """
    check_blocks(blocks)
    check_particles(x, blocks)
    P, D = x.shape
    check_like("mass", mass, x, (P,), "[P]", needed=True)
    check_like("v", v, x, (P, D), "[P, D]", needed=True)
    check_like("C", C, x, (P, D, D), "[P, D, D]")
    check_like("stress", stress, x, (P, D, D), "[P, D, D]")
    check_like("volume", volume, x, (P,), "[P]")
    check_choice("stress_form", stress_form, STRESS_FORMS)
    scene_dt = None
    if stress is None:
        dt = 0.0
    elif volume is None or dt is None:
        raise ValueError("stress needs volume and dt")
    else:
        dt, scene_dt = split_dt(dt, blocks.grid.scenes, x)
    return dispatch(
        torch.ops.torch_mpm.p2g,
        *(x, mass, v, C, stress, volume, scene_dt, dt, STRESS_FORMS[stress_form], *blocks.packed),
    )


def g2p(
    blocks: Blocks, x: Tensor, velocity: Tensor, affine: bool = True, gradient: bool = False
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Velocity, affine field and velocity gradient of the particles from the nodes.

    v_p = Σ N_i v_i, C_p = D⁻¹ Σ N_i v_i (x_i − x_p)ᵀ (Jiang et al. 2015) and (∇v)_p = Σ v_i ∇N_iᵀ.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        velocity: node velocities [N, D] [m/s]; rows need not be contiguous (a view [:, 1:] of mass and velocity is
            fastest).
        affine: whether to return C.
        gradient: whether to return ∇v.

    Returns:
        v [P, D] [m/s], C [P, D, D] [1/s] or None, ∇v [P, D, D] [1/s] or None; for particles outside the grid zero, or
        NaN where the position is not finite. No gradient passes through either.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Differentiable with respect to x and velocity, twice in eager mode.
    """
    check_blocks(blocks)
    check_particles(x, blocks)
    velocity = _check_nodes("velocity", velocity, blocks, x, blocks.grid.dim)
    wanted = check_flag("affine", affine), check_flag("gradient", gradient)
    return dispatch(torch.ops.torch_mpm.g2p, x, velocity, *wanted, *blocks.packed)


def scatter(
    blocks: Blocks,
    x: Tensor,
    value: Tensor,
    moment: Tensor | None = None,
    gradient: Tensor | None = None,
    moment_scale: float = 1.0,
) -> Tensor:
    """Scatter of particle features to the nodes: Σ_p N_i (value_p + s moment_p (x_i − x_p)) + gradient_p ∇N_i.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        value: features [P, K], in any unit u.
        moment: their affine field [P, K, D] [u/m] (for s = 1), or None.
        gradient: [P, K, D] [u m], or None.
        moment_scale: s.

    Returns:
        Sums on the nodes [N, K] [u]. Multiply features by mass and divide by the node mass of `p2g` for an average.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Differentiable with respect to every tensor, twice in eager mode.
    """
    check_blocks(blocks)
    check_particles(x, blocks)
    P, D = x.shape
    if not isinstance(value, Tensor) or value.dim() != 2:
        raise ValueError(f"value must have shape [P, K] = [{P}, K], got {shape_of(value)}")
    K = value.shape[1]
    check_like("value", value, x, (P, K), "[P, K]")
    check_like("moment", moment, x, (P, K, D), "[P, K, D]")
    check_like("gradient", gradient, x, (P, K, D), "[P, K, D]")
    check_number("moment_scale", moment_scale)
    return dispatch(torch.ops.torch_mpm.scatter, x, value, moment, gradient, moment_scale, *blocks.packed)


def gather(
    blocks: Blocks, x: Tensor, nodes: Tensor, moment: bool = False, gradient: bool = False, moment_scale: float = 1.0
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Gather of node features at the particles: Σ_i N_i g_i, s Σ_i N_i g_i (x_i − x_p)ᵀ and Σ_i g_i ∇N_iᵀ.

    Args:
        blocks: active blocks of these positions.
        x: positions [P, D] [m].
        nodes: features g [N, K], in any unit u.
        moment, gradient: whether to return these sums.
        moment_scale: s; `grid.inverse_inertia` makes the moment the APIC affine field.

    Returns:
        value [P, K] [u], moment [P, K, D] [s u m] or None, gradient [P, K, D] [u/m] or None; zero for particles
        outside the grid or without a finite position.

    Raises:
        ValueError, TypeError: for wrong shapes, dtypes or devices.

    Differentiable with respect to x and nodes, twice in eager mode.
    """
    check_blocks(blocks)
    check_particles(x, blocks)
    nodes = _check_nodes("nodes", nodes, blocks, x, None)
    check_number("moment_scale", moment_scale)
    wanted = check_flag("moment", moment), check_flag("gradient", gradient)
    return dispatch(torch.ops.torch_mpm.gather, x, nodes, moment_scale, *wanted, *blocks.packed)


def _check_nodes(name: str, nodes: Tensor, blocks: Blocks, x: Tensor, channels: int | None) -> Tensor:
    symbols = "[N, K]" if channels is None else "[N, D]"
    if not isinstance(nodes, Tensor) or nodes.dim() != 2:
        raise ValueError(f"{name} must have shape {symbols}, got {shape_of(nodes)}")
    check_like(name, nodes, x, (blocks.node_count, nodes.shape[1] if channels is None else channels), symbols)
    return nodes if nodes.shape[1] <= 1 or nodes.stride(1) == 1 else nodes.contiguous()


# ---- fake kernels: shapes and strides only


@torch.library.register_fake("torch_mpm::p2g")
def _p2g_fake(x, mass, v, C, stress, volume, scene_dt, dt, stress_form, *topology):
    return x.new_empty(Topology.unpack(*topology).node_count, 1 + sizes(x, "x", 2)[1])


@torch.library.register_fake("torch_mpm::p2g_backward")
def _p2g_backward_fake(grad_nodes, x, mass, v, C, stress, volume, scene_dt, dt, stress_form, needs, *topology):
    P, D = sizes(x, "x", 2)
    shapes = ((P, D), (P,), (P, D), (P, D, D), (P, D, D), (P,), (P,))
    present = (True, True, True, C is not None) + 3 * (stress is not None,)
    return tuple(
        soa_empty(x, shape) if needs >> i & 1 and here else None
        for i, (shape, here) in enumerate(zip(shapes, present, strict=True))
    )


@torch.library.register_fake("torch_mpm::scatter")
def _scatter_fake(x, value, moment, gradient, moment_scale, *topology):
    return x.new_empty(Topology.unpack(*topology).node_count, sizes(value, "value", 2)[1])


@torch.library.register_fake("torch_mpm::gather")
def _gather_fake(x, nodes, moment_scale, moment, gradient, *topology):
    (P, D), K = sizes(x, "x", 2), sizes(nodes, "nodes", 2)[1]
    sums = [soa_empty(x, (P, K, D)) if wanted else None for wanted in (moment, gradient)]
    return soa_empty(x, (P, K)), *sums


@torch.library.register_fake("torch_mpm::g2p")
def _g2p_fake(x, velocity, affine, gradient, *topology):
    return _gather_fake(x, velocity, 1.0, affine, gradient, *topology)


@torch.library.register_fake("torch_mpm::position_gradient")
def _position_gradient_fake(x, value, moment, gradient, nodes, moment_scale, *topology):
    return soa_empty(x, sizes(x, "x", 2))


# ---- autograd


def _scatter_setup(ctx, inputs, output):
    x, value, moment, gradient, scale, *topology = inputs
    save_with_topology(ctx, (x, value, moment, gradient), topology, scale=scale)


def _scatter_backward(ctx, grad):
    (x, value, moment, gradient), topology = saved_with_topology(ctx)
    need = ctx.needs_input_grad
    grad_x = grad_value = grad_moment = grad_gradient = None
    grad = grad.contiguous()
    if need[1] or need[2] or need[3]:
        grad_value, grad_moment, grad_gradient = dispatch(
            torch.ops.torch_mpm.gather, x, grad, ctx.scale, bool(need[2]), bool(need[3]), *topology
        )
    if need[0]:
        grad_x = dispatch(torch.ops.torch_mpm.position_gradient, x, value, moment, gradient, grad, ctx.scale, *topology)
    return (grad_x, grad_value, grad_moment, grad_gradient) + (None,) * 4


def _gather_setup(ctx, inputs, output):
    x, nodes, scale, _, _, *topology = inputs
    save_with_topology(ctx, (x, nodes), topology, scale=scale)


def _gather_backward(ctx, *grads):
    return _gather_adjoint(ctx, *grads) + (None,) * 6


def _gather_adjoint(ctx, *grads):
    (x, nodes), topology = saved_with_topology(ctx)
    grad_x = grad_nodes = None
    if ctx.needs_input_grad[0]:
        grad_x = dispatch(torch.ops.torch_mpm.position_gradient, x, *grads, nodes, ctx.scale, *topology)
    if ctx.needs_input_grad[1]:
        grad_nodes = dispatch(torch.ops.torch_mpm.scatter, x, *grads, ctx.scale, *topology)
    return grad_x, grad_nodes


def _g2p_setup(ctx, inputs, output):
    x, velocity, _, _, *topology = inputs
    scale = Topology.unpack(*topology).grid.inverse_inertia
    save_with_topology(ctx, (x, velocity), topology, scale=scale)


def _g2p_backward(ctx, *grads):
    return _gather_adjoint(ctx, *grads) + (None,) * 5


def _position_gradient_setup(ctx, inputs, output):
    x, value, moment, gradient, nodes, scale, *topology = inputs
    save_with_topology(ctx, (x, value, moment, gradient, nodes), topology, scale=scale)


def _position_gradient_backward(ctx, grad):
    tensors, topology = saved_with_topology(ctx)
    blocks = Topology.unpack(*topology)

    def function(x, value, moment, gradient, nodes):
        return composed.position_gradient(blocks, x, value, moment, gradient, nodes, ctx.scale)

    return (*differentiate(function, tensors, [grad]),) + (None,) * 4


def _p2g_setup(ctx, inputs, output):
    x, mass, v, C, stress, volume, scene_dt, dt, form, *topology = inputs
    save_with_topology(ctx, (x, mass, v, C, stress, volume, scene_dt), topology, dt=dt, form=form)


def _p2g_backward(ctx, grad):
    tensors, topology = saved_with_topology(ctx)
    needs = sum(1 << i for i, needed in enumerate(ctx.needs_input_grad[:7]) if needed)
    grads = list(
        dispatch(torch.ops.torch_mpm.p2g_backward, grad.contiguous(), *tensors, ctx.dt, ctx.form, needs, *topology)
    )
    if ctx.needs_input_grad[6] and tensors[4] is not None:
        blocks = Topology.unpack(*topology)
        grads[6] = ctx.dt * sum_by_scene(grads[6], blocks.particle_scene(), blocks.scenes)
    grads = [
        g if needed and t is not None else None
        for g, t, needed in zip(grads, tensors, ctx.needs_input_grad[:7], strict=True)
    ]
    return (*grads,) + (None,) * 5


def _p2g_backward_setup(ctx, inputs, output):
    tensors, (dt, form, needs), topology = inputs[:8], inputs[8:11], inputs[11:]
    save_with_topology(ctx, tensors, topology, dt=dt, form=form, needs=needs)


def _p2g_double_backward(ctx, *grads):
    tensors, topology = saved_with_topology(ctx)
    has_stress = tensors[5] is not None
    present = [True, True, True, tensors[4] is not None] + 3 * [has_stress]
    wanted = [bool(ctx.needs >> i & 1) and here for i, here in enumerate(present)]

    def function(*inputs):
        outputs = _composed_p2g_backward(inputs, ctx.dt, ctx.form, topology)
        return tuple(o for o, w in zip(outputs, wanted, strict=True) if w)

    given = [g for g, w in zip(grads, wanted, strict=True) if w]
    return (*differentiate(function, tensors, given),) + (None,) * 6


def _composed_p2g_backward(inputs, dt, form, topology):
    """`p2g_backward` made of differentiable ops: `adjoint` of csrc/transfer/momentum.h in plain torch."""
    grad, x, mass, v, C, stress, volume, scene_dt = inputs
    D = x.shape[1]
    mls = form == STRESS_FORMS["mls"]
    blocks = Topology.unpack(*topology)
    value, moment, gradient = dispatch(torch.ops.torch_mpm.gather, x, grad, 1.0, True, True, *topology)
    mass_sum, momentum_sum, moment_sum = value[:, 0], value[:, 1:], moment[:, 1:]
    grad_mass = mass_sum + (v * momentum_sum).sum(1)
    grad_v = mass[:, None] * momentum_sum
    a = torch.cat([mass[:, None], mass[:, None] * v], 1)
    B = x.new_zeros(x.shape[0], 1 + D, D)
    G = grad_C = grad_stress = grad_volume = grad_dt = None
    if C is not None:
        grad_mass = grad_mass + (C * moment_sum).sum((1, 2))
        grad_C = mass[:, None, None] * moment_sum
        B = B + torch.nn.functional.pad(mass[:, None, None] * C, (0, 0, 1, 0))
    if stress is not None:
        step = dt if scene_dt is None else dt * per_particle(scene_dt, blocks.particle_scene(), x.shape[0])
        scale = -blocks.grid.inverse_inertia if mls else -1.0
        total = moment_sum if mls else gradient[:, 1:]
        work = scale * (stress * total).sum((1, 2))
        impulse = scale * step * volume
        grad_stress = impulse[:, None, None] * total
        grad_volume = step * work
        grad_dt = volume * work
        padded = torch.nn.functional.pad(impulse[:, None, None] * stress, (0, 0, 1, 0))
        B, G = (B + padded, None) if mls else (B, padded)
    grad_x = dispatch(torch.ops.torch_mpm.position_gradient, x, a, B, G, grad, 1.0, *topology)
    return grad_x, grad_mass, grad_v, grad_C, grad_stress, grad_volume, grad_dt


for _name, _backward, _setup in (
    ("scatter", _scatter_backward, _scatter_setup),
    ("gather", _gather_backward, _gather_setup),
    ("g2p", _g2p_backward, _g2p_setup),
    ("position_gradient", _position_gradient_backward, _position_gradient_setup),
    ("p2g", _p2g_backward, _p2g_setup),
    ("p2g_backward", _p2g_double_backward, _p2g_backward_setup),
):
    register_autograd(_name, _backward, _setup)
    refuse_vmap(_name)
